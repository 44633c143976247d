//! Critical sections as ground: for two robots on their paths, where their vehicles can meet, who
//! is in it and whose grant reaches into it. Who should go first is the coordinator's business.

use std::collections::BTreeMap;

use hil_fleet::geometry::{Footprint, Pose};
use hil_fleet::path::{Path, PathId};
use hil_fleet::section::{Side, Span};
use hil_fleet::world::World;
use serde_json::{Value, json};

use super::polygon::{Point, hull, shared};
use super::rounded;

/// Poses of a path's part whose ground makes its hull.
const POSES_MAX: usize = 40;
/// Lengths of the vehicle from which on a section is drawn as a strip along the first path: the hull
/// of a long shared lane would cover the hall.
const STRIP_LENGTHS: f64 = 2.0;
/// Areas that are remembered; beyond, all are forgotten and worked out again.
const AREAS_MAX: usize = 20_000;

/// The ground of critical sections, worked out once each.
#[derive(Debug)]
pub(crate) struct Areas {
    vehicle: Footprint,
    known: BTreeMap<(u32, u32, usize), Vec<Point>>,
}

impl Areas {
    /// Of vehicles with this ground plan.
    pub(crate) const fn new(vehicle: Footprint) -> Self {
        Self {
            vehicle,
            known: BTreeMap::new(),
        }
    }

    /// The ground of a section of two paths of `world`, by its place among theirs: what both
    /// vehicles can cover, as a polygon around it. Empty when there is no such section.
    pub(crate) fn of(
        &mut self,
        world: &World,
        one: PathId,
        other: PathId,
        section: usize,
    ) -> &[Point] {
        if self.known.len() > AREAS_MAX {
            self.known.clear();
        }
        let vehicle = self.vehicle;
        let key = (one.0, other.0, section);
        self.known.entry(key).or_insert_with(|| {
            let sections = world.sections.between(one, other);
            let Some(section) = sections.get(section) else {
                return Vec::new();
            };
            let ground = |side, path: PathId| {
                let (from, to) = (section.start(side), section.end(side));
                hull(covered(world.path(path), from, to, &vehicle))
            };
            let (from, to) = (section.start(Side::First), section.end(Side::First));
            let path = world.path(one);
            let long_m = STRIP_LENGTHS * vehicle.length_m + vehicle.width_m;
            if path.way_to_m(to.min(path.last_index())) - path.way_to_m(from) > long_m {
                return strip(path, from, to, &vehicle);
            }
            let area = shared(&ground(Side::First, one), &ground(Side::Second, other));
            area.iter().map(|point| point.map(rounded)).collect()
        })
    }
}

/// Corners of the vehicle at poses of the path's part, its ends among them.
fn covered(path: &Path, from: usize, to: usize, vehicle: &Footprint) -> Vec<Point> {
    let to = to.min(path.last_index());
    let step = to.saturating_sub(from).div_ceil(POSES_MAX).max(1);
    let poses = path.poses();
    let part = (from..to).step_by(step).chain([to]);
    let at = |pose: &Pose| vehicle.at(pose).corners();
    part.flat_map(|index| at(&poses[index])).collect()
}

/// The strip that a vehicle covers along the path's part.
fn strip(path: &Path, from: usize, to: usize, vehicle: &Footprint) -> Vec<Point> {
    let to = to.min(path.last_index());
    let step = to.saturating_sub(from).div_ceil(POSES_MAX).max(1);
    let part = (from..to).step_by(step).chain([to]);
    let beside = |index: usize, side: f64| {
        let pose = &path.poses()[index];
        let (sine, cosine) = pose.heading_rad.sin_cos();
        let across_m = 0.5 * side * vehicle.width_m;
        // A vehicle at an end of the part reaches beyond it by half its length.
        let along_m = match index {
            index if index == from => -0.5 * vehicle.length_m,
            index if index == to => 0.5 * vehicle.length_m,
            _ => 0.0,
        };
        // Backwards, the way goes against the heading.
        let along_m = if is_backwards(path) {
            -along_m
        } else {
            along_m
        };
        let x_m = pose.x_m + along_m * cosine - across_m * sine;
        let y_m = pose.y_m + along_m * sine + across_m * cosine;
        [rounded(x_m), rounded(y_m)]
    };
    let indices: Vec<usize> = part.collect();
    let left = indices.iter().map(|index| beside(*index, 1.0));
    let right = indices.iter().rev().map(|index| beside(*index, -1.0));
    left.chain(right).collect()
}

/// True when the vehicle reverses along the path.
fn is_backwards(path: &Path) -> bool {
    let [one, other] = [&path.poses()[0], &path.poses()[1]];
    let (sine, cosine) = one.heading_rad.sin_cos();
    (other.x_m - one.x_m) * cosine + (other.y_m - one.y_m) * sine < 0.0
}

/// A robot on a mission.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OnPath {
    /// Its number.
    pub(crate) robot: u32,
    /// Its path.
    pub(crate) path: PathId,
    /// The last pose it passed.
    pub(crate) index: usize,
    /// The last pose it may reach.
    pub(crate) granted: usize,
}

/// The sections that two robots of `fleet` still have before them or are in, as `/live/fleet`
/// lists them.
pub(crate) fn of_pair(
    world: &World,
    areas: &mut Areas,
    fleet: u32,
    one: &OnPath,
    other: &OnPath,
) -> Vec<Value> {
    let mut list = Vec::new();
    let sections = world.sections.between(one.path, other.path);
    for (index, section) in sections.iter().enumerate() {
        let sides = [(one, Side::First), (other, Side::Second)];
        if sides
            .iter()
            .any(|(robot, side)| robot.index > section.end(*side))
        {
            continue;
        }
        let that = |is: &dyn Fn(&OnPath, Side) -> bool| -> Vec<u32> {
            let robots = sides.iter().filter(|(robot, side)| is(robot, *side));
            robots.map(|(robot, _)| robot.robot).collect()
        };
        let inside = that(&|robot, side| robot.index >= section.start(side));
        let may_pass = that(&|robot, side| robot.granted >= section.start(side));
        // One may follow the other through it, as long as no two poses that they may take meet.
        let other_way = Span {
            lower: other.index,
            upper: other.granted,
        };
        let meeting = section.first_conflict(Side::First, one.index, other_way);
        let is_contested = meeting.is_some_and(|pose| pose <= one.granted);
        list.push(json!({
            "id": format!("{fleet}:{}-{}:{index}", one.robot, other.robot),
            "fleet": fleet,
            "robots": [one.robot, other.robot],
            "may_pass": may_pass,
            "inside": inside,
            "is_contested": is_contested,
            "polygon": areas.of(world, one.path, other.path, index),
        }));
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_fleet::scenario::{Scenario, Scene, WorldParameters};

    fn crossing() -> Scene {
        let parameters = WorldParameters {
            scenario: Scenario::Crossing,
            path_spacing_m: 0.1,
            ..WorldParameters::default()
        };
        parameters.build().unwrap()
    }

    fn at(robot: u32, index: usize, granted: usize) -> OnPath {
        OnPath {
            robot,
            path: PathId(2 * robot),
            index,
            granted,
        }
    }

    fn listed(scene: &Scene, one: &OnPath, other: &OnPath) -> Vec<Value> {
        let mut areas = Areas::new(scene.world.vehicle.footprint);
        of_pair(&scene.world, &mut areas, 0, one, other)
    }

    #[test]
    fn a_crossing_is_the_square_that_both_can_cover() {
        let scene = crossing();
        let mut areas = Areas::new(scene.world.vehicle.footprint);
        let area = areas.of(&scene.world, PathId(0), PathId(2), 0);
        let spread = |axis: usize| {
            let values = area.iter().map(|point| point[axis]);
            values.clone().fold(f64::MIN, f64::max) - values.fold(f64::MAX, f64::min)
        };
        assert!(
            (spread(0) - 0.5).abs() < 1e-9 && (spread(1) - 0.5).abs() < 1e-9,
            "{area:?}"
        );
        assert!(areas.of(&scene.world, PathId(0), PathId(2), 9).is_empty());
    }

    #[test]
    fn who_is_granted_the_crossing_may_pass_and_two_contest_it() {
        let scene = crossing();
        // The section has the poses 188 to 212 of both.
        let list = listed(&scene, &at(0, 190, 400), &at(1, 150, 180));
        assert_eq!(
            (&list[0]["may_pass"], &list[0]["inside"]),
            (&json!([0]), &json!([0]))
        );
        assert_eq!(
            (&list[0]["is_contested"], &list[0]["id"]),
            (&json!(false), &json!("0:0-1:0"))
        );
        let both = listed(&scene, &at(0, 150, 400), &at(1, 150, 400));
        assert_eq!(
            (&both[0]["may_pass"], &both[0]["is_contested"]),
            (&json!([0, 1]), &json!(true))
        );
        assert_eq!(
            listed(&scene, &at(0, 213, 400), &at(1, 150, 400)),
            Vec::<Value>::new()
        );
    }

    #[test]
    fn a_long_lane_is_a_strip_as_wide_as_the_vehicle() {
        let parameters = WorldParameters {
            scenario: Scenario::HeadOn,
            ..WorldParameters::default()
        };
        let scene = parameters.build().unwrap();
        let mut areas = Areas::new(scene.world.vehicle.footprint);
        let area = areas.of(&scene.world, PathId(0), PathId(2), 0);
        let path = scene.world.path(PathId(0));
        assert!(area.len() > 20);
        // Its corners stand by twos beside the path.
        for (left, right) in area.iter().zip(area.iter().rev()) {
            let wide_m = (left[0] - right[0]).hypot(left[1] - right[1]);
            assert!(
                (wide_m - scene.world.vehicle.footprint.width_m).abs() < 0.01,
                "{wide_m}"
            );
        }
        assert!(path.length_m() > 20.0);
    }
}
