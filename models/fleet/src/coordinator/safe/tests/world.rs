//! Random worlds for tests: bays on two sides and curved ways between them, with straight pieces
//! before the bays so that no way leads through another's bay.

use std::sync::Arc;

use crate::geometry::{Footprint, Pose};
use crate::path::{Path, PathLibrary};
use crate::scenario::{PlanningSummary, Scene};
use crate::section::MergePolicy;
use crate::world::{Bay, Route, Vehicle, World};
use hil_core::random::RandomStream;

pub(super) const CART: Vehicle = Vehicle {
    footprint: Footprint {
        length_m: 2.0,
        width_m: 0.5,
    },
    speed_max_mps: 2.0,
    acceleration_mps2: 1.0,
};

const POSES: u32 = 200;

/// `robot_count` robots, each with a bay on the left and one on the right, and a way between
/// each two bays of different sides.
pub(super) fn random_scene(robot_count: usize, random: &mut RandomStream) -> Scene {
    let length_m = 20.0 + 20.0 * random.uniform();
    let gap_m = 1.2 + 2.0 * random.uniform();
    let mut bays = Vec::new();
    for x_m in [0.0, length_m] {
        for row in 0..robot_count {
            let pose = Pose::new(x_m, gap_m * row as f64, 0.0);
            bays.push(Bay { pose });
        }
    }
    let (mut paths, mut routes) = (PathLibrary::default(), Vec::new());
    for from in 0..robot_count {
        for to in robot_count..2 * robot_count {
            let path = curve(&bays[from].pose, &bays[to].pose, random);
            let path = paths.add(Path::new(&path, 0.3).unwrap());
            routes.push(Route { from, to, path });
            let (from, to, path) = (to, from, path.reversed());
            routes.push(Route { from, to, path });
        }
    }
    let merge = MergePolicy::WithinVehicle;
    Scene {
        world: Arc::new(World::new(CART, bays, routes, paths, merge)),
        starts: (0..robot_count).collect(),
        partners: (0..2 * robot_count)
            .map(|bay| Some((bay + robot_count) % (2 * robot_count)))
            .collect(),
        planning: PlanningSummary::default(),
    }
}

/// From one bay to the other, straight for two vehicle lengths at the ends, wavy between.
fn curve(from: &Pose, to: &Pose, random: &mut RandomStream) -> Vec<Pose> {
    let straight_m = 4.0;
    let waves = 1.0 + 2.0 * random.uniform();
    let free_m = to.x_m - from.x_m - 2.0 * straight_m;
    // Curves too tight for a cart would make the guarded footprints of neighbouring bays meet.
    let wave_m = 0.08 * free_m * (2.0 * random.uniform() - 1.0);
    let height_m = |x_m: f64| {
        let ratio = ((x_m - from.x_m - straight_m) / free_m).clamp(0.0, 1.0);
        let blend = ratio * ratio * (3.0 - 2.0 * ratio);
        // Flat at both ends, as the square of the window is.
        let window = (core::f64::consts::PI * ratio).sin().powi(2);
        from.y_m
            + blend * (to.y_m - from.y_m)
            + wave_m * window * (core::f64::consts::PI * waves * ratio).sin()
    };
    (0..=POSES)
        .map(|step| {
            let x_m = from.x_m + (to.x_m - from.x_m) * f64::from(step) / f64::from(POSES);
            let slope = (height_m(x_m + 0.01) - height_m(x_m - 0.01)) / 0.02;
            Pose::new(x_m, height_m(x_m), slope.atan())
        })
        .collect()
}
