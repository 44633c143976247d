//! Tests of the planner over random maps.

use super::*;
use crate::geometry::{Bounds, Footprint, wrap_angle};
use crate::map::Map;
use crate::path::Path;
use crate::world::Vehicle;
use hil_core::random::RandomStream;

const CART: Vehicle = Vehicle {
    footprint: Footprint {
        length_m: 2.0,
        width_m: 0.8,
    },
    speed_max_mps: 2.0,
    acceleration_mps2: 1.0,
};
const RADIUS_M: f64 = 3.0;

fn random_map(random: &mut RandomStream) -> Map {
    let obstacles = (0..12).map(|_| {
        let (x_m, y_m) = (30.0 * random.uniform(), 20.0 * random.uniform());
        Bounds {
            x_min_m: x_m,
            x_max_m: x_m + 0.5 + 4.0 * random.uniform(),
            y_min_m: y_m,
            y_max_m: y_m + 0.5 + 3.0 * random.uniform(),
        }
    });
    Map {
        bounds: Bounds {
            x_min_m: -5.0,
            x_max_m: 35.0,
            y_min_m: -5.0,
            y_max_m: 25.0,
        },
        obstacles: obstacles.collect(),
        bays: Vec::new(),
        gates: Vec::new(),
        clearance_m: 0.3,
    }
}

/// Plans alone, with a planner of its own.
fn plan(map: &Map, radius_m: f64, start: &Pose, goal: &Pose) -> Result<Plan, PlanError> {
    Planner::new(map.space(&CART), radius_m)?.plan(start, goal)
}

fn random_pose(random: &mut RandomStream) -> Pose {
    let at = [random.uniform(), random.uniform(), random.uniform()];
    Pose::new(30.0 * at[0], 20.0 * at[1], core::f64::consts::TAU * at[2])
}

/// Checks ends, curvature and freedom of a plan's poses.
fn assert_sound(map: &Map, plan: &Plan, start: Pose, goal: Pose) {
    let poses = plan.poses(0.05);
    assert_eq!((poses[0], poses[poses.len() - 1]), (start, goal));
    let upright = |bounds: &Bounds| {
        let middle = |low: f64, high: f64| (0.5 * (low + high), high - low);
        let (x_m, length_m) = middle(bounds.x_min_m, bounds.x_max_m);
        let (y_m, width_m) = middle(bounds.y_min_m, bounds.y_max_m);
        Footprint { length_m, width_m }.at(&Pose::new(x_m, y_m, 0.0))
    };
    let obstacles: Vec<_> = map.obstacles.iter().map(upright).collect();
    for pose in &poses {
        let covered = CART.footprint.at(pose);
        assert!(
            map.bounds.contains(&covered.bounds()),
            "{pose:?} leaves the ground"
        );
        let nearest_m = obstacles
            .iter()
            .map(|obstacle| obstacle.distance_m(&covered))
            .fold(f64::INFINITY, f64::min);
        assert!(
            nearest_m > 0.45 * map.clearance_m,
            "{pose:?} is {nearest_m} m from an obstacle"
        );
    }
    let path = Path::new(&plan.poses(0.03), 0.3).unwrap();
    for two in path.poses().windows(2) {
        let turn = wrap_angle(two[1].heading_rad - two[0].heading_rad).abs();
        assert!(
            turn <= path.spacing_m() / RADIUS_M * 1.001 + 1e-6,
            "{turn} rad in one step"
        );
        // No sideways motion: the chord has the middle heading.
        let chord = (two[1].y_m - two[0].y_m).atan2(two[1].x_m - two[0].x_m);
        assert!(wrap_angle(chord - two[0].towards(&two[1], 0.5).heading_rad).abs() < 0.06);
    }
}

#[test]
fn plans_over_random_maps_are_free_smooth_and_exact_at_both_ends() {
    let mut random = RandomStream::new(11, "planner maps");
    let (mut found_count, mut refused_count) = (0, 0);
    for _ in 0..25 {
        let map = random_map(&mut random);
        let mut planner = Planner::new(map.space(&CART), RADIUS_M).unwrap();
        for _ in 0..4 {
            let (start, goal) = (random_pose(&mut random), random_pose(&mut random));
            match planner.plan(&start, &goal) {
                Ok(plan) => {
                    assert_sound(&map, &plan, start, goal);
                    let length_m: f64 = plan.segments.iter().map(|one| one.length_m).sum();
                    assert!(length_m >= start.distance_m(&goal) - 1e-9);
                    found_count += 1;
                }
                Err(PlanError::StartBlocked { .. } | PlanError::GoalBlocked { .. }) => {
                    refused_count += 1;
                }
                Err(PlanError::NoPath { .. }) => {}
                Err(error) => panic!("{error}"),
            }
        }
    }
    assert!(
        found_count > 20 && refused_count > 10,
        "{found_count} planned, {refused_count} refused"
    );
}

#[test]
fn equal_questions_have_equal_answers_whatever_was_asked_before() {
    let mut random = RandomStream::new(12, "planner maps");
    let map = random_map(&mut random);
    let mut planner = Planner::new(map.space(&CART), RADIUS_M).unwrap();
    for _ in 0..10 {
        let (start, goal) = (random_pose(&mut random), random_pose(&mut random));
        let fresh = plan(&map, RADIUS_M, &start, &goal);
        assert_eq!(planner.plan(&start, &goal), fresh);
    }
}

#[test]
fn what_cannot_be_planned_is_refused_by_name() {
    let mut map = random_map(&mut RandomStream::new(13, "planner maps"));
    map.obstacles = vec![Bounds {
        x_min_m: 10.0,
        x_max_m: 11.0,
        y_min_m: -5.0,
        y_max_m: 25.0,
    }];
    let (here, there) = (Pose::new(0.0, 0.0, 0.0), Pose::new(20.0, 0.0, 0.0));
    let error = |radius_m, start: Pose, goal: Pose| {
        let refused = plan(&map, radius_m, &start, &goal).unwrap_err();
        refused.to_string()
    };
    assert!(error(3.0, here, there).starts_with("no path from (0.000 m, 0.000 m, 0.000 rad)"));
    let inside = Pose::new(10.5, 3.0, 0.0);
    assert!(error(3.0, here, inside).contains("goal (10.500 m, 3.000 m, 0.000 rad) is blocked"));
    assert!(error(3.0, inside, there).contains("by obstacle 0"));
    let outside = Pose::new(-4.5, 3.0, 0.0);
    assert!(error(3.0, outside, there).contains("the edge of the ground"));
    assert!(error(3.0, Pose::new(f64::NAN, 0.0, 0.0), there).contains("not finite"));
    assert!(error(0.0, here, there).contains("turning radius 0"));
    assert!(error(0.01, here, there).contains("too large"));
}
