//! Critical sections as ground: for two robots on their paths, where their vehicles can meet, who
//! is in it and whose grant reaches into it. Who should go first is the coordinator's business.

use std::collections::BTreeMap;

use hil_fleet::geometry::Footprint;
use hil_fleet::path::{Path, PathId};
use hil_fleet::section::{Side, Span};
use hil_fleet::world::World;
use serde::Serialize;

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

/// Some poses of the path's part, its ends among them.
fn part(path: &Path, from: usize, to: usize) -> Vec<usize> {
    let to = to.min(path.last_index());
    let step = to.saturating_sub(from).div_ceil(POSES_MAX).max(1);
    (from..to).step_by(step).chain([to]).collect()
}

/// Corners of the vehicle along the path's part.
fn covered(path: &Path, from: usize, to: usize, vehicle: &Footprint) -> Vec<Point> {
    let part = part(path, from, to).into_iter();
    part.flat_map(|index| vehicle.at(&path.poses()[index]).corners())
        .collect()
}

/// The strip that a vehicle covers along the path's part.
fn strip(path: &Path, from: usize, to: usize, vehicle: &Footprint) -> Vec<Point> {
    let indices = part(path, from, to);
    let last = indices.last().copied();
    let beside = |index: usize, side: f64| {
        let pose = &path.poses()[index];
        let (sine, cosine) = pose.heading_rad.sin_cos();
        let across_m = 0.5 * side * vehicle.width_m;
        // A vehicle at an end of the part reaches beyond it by half its length.
        let along_m = match index {
            index if index == from => -0.5 * vehicle.length_m,
            index if Some(index) == last => 0.5 * vehicle.length_m,
            _ => 0.0,
        };
        // Backwards, the way goes against the heading.
        let along_m = along_m * if is_backwards(path) { -1.0 } else { 1.0 };
        let x_m = pose.x_m + along_m * cosine - across_m * sine;
        let y_m = pose.y_m + along_m * sine + across_m * cosine;
        [rounded(x_m), rounded(y_m)]
    };
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

/// A point, metres. Corners of convex polygons go counter-clockwise.
pub(crate) type Point = [f64; 2];

/// Twice the area of the triangle; above 0 when it goes counter-clockwise.
fn turn(a: Point, b: Point, c: Point) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// The convex hull of `points` (Andrew's monotone chain); fewer than three corners when they lie on
/// a line.
fn hull(mut points: Vec<Point>) -> Vec<Point> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut corners: Vec<Point> = Vec::with_capacity(points.len());
    let half = |corners: &mut Vec<Point>, point: Point, floor: usize| {
        while corners.len() >= floor + 2
            && turn(
                corners[corners.len() - 2],
                corners[corners.len() - 1],
                point,
            ) <= 0.0
        {
            corners.pop();
        }
        corners.push(point);
    };
    for point in &points {
        half(&mut corners, *point, 0);
    }
    let floor = corners.len() - 1;
    for point in points.iter().rev().skip(1) {
        half(&mut corners, *point, floor);
    }
    corners.pop();
    corners
}

/// What two convex polygons share (Sutherland and Hodgman 1974); empty when they do not meet.
fn shared(one: &[Point], other: &[Point]) -> Vec<Point> {
    let mut left = one.to_vec();
    for (index, from) in other.iter().enumerate() {
        let to = other[(index + 1) % other.len()];
        let corners = core::mem::take(&mut left);
        for (index, corner) in corners.iter().enumerate() {
            let next = corners[(index + 1) % corners.len()];
            let (here, there) = (turn(*from, to, *corner), turn(*from, to, next));
            if here >= 0.0 {
                left.push(*corner);
            }
            if (here > 0.0 && there < 0.0) || (here < 0.0 && there > 0.0) {
                let share = here / (here - there);
                left.push([0, 1].map(|axis| corner[axis] + share * (next[axis] - corner[axis])));
            }
        }
    }
    if left.len() < 3 { Vec::new() } else { left }
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

/// A section of two robots.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct SectionPicture {
    pub(crate) id: String,
    pub(crate) fleet: u32,
    pub(crate) robots: [u32; 2],
    pub(crate) may_pass: Vec<u32>,
    pub(crate) inside: Vec<u32>,
    pub(crate) is_contested: bool,
    pub(crate) polygon: Vec<Point>,
}

/// The sections that two robots of `fleet` still have before them or are in, as `/live/fleet`
/// lists them.
pub(crate) fn of_pair(
    world: &World,
    areas: &mut Areas,
    fleet: u32,
    one: &OnPath,
    other: &OnPath,
) -> Vec<SectionPicture> {
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
        let own_way = Span::between(one.index, one.granted);
        let other_way = Span::between(other.index, other.granted);
        let meeting = section.first_conflict(Side::First, own_way, other_way);
        list.push(SectionPicture {
            id: format!("{fleet}:{}-{}:{index}", one.robot, other.robot),
            fleet,
            robots: [one.robot, other.robot],
            may_pass,
            inside,
            is_contested: meeting.is_some(),
            polygon: areas.of(world, one.path, other.path, index).to_vec(),
        });
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_fleet::scenario::{Scenario, Scene, WorldParameters};
    use serde_json::{Value, json};

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
        let list = of_pair(&scene.world, &mut areas, 0, one, other);
        list.iter().map(|section| json!(section)).collect()
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

    fn area_of(corners: &[Point]) -> f64 {
        let count = corners.len();
        let parts = 1..count.saturating_sub(1);
        0.5 * parts
            .map(|index| turn(corners[0], corners[index], corners[index + 1]))
            .sum::<f64>()
    }

    #[test]
    fn a_hull_has_the_corners_only() {
        let inside =
            (0..50).map(|n| [f64::from(n % 7) / 7.0 + 0.05, f64::from(n % 5) / 5.0 + 0.05]);
        let mut points: Vec<Point> = inside.collect();
        points.extend([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.0]]);
        let corners = hull(points);
        assert_eq!(corners.len(), 4);
        assert!((area_of(&corners) - 1.0).abs() < 1e-12);
        assert_eq!(hull(vec![[1.0, 1.0]; 9]).len(), 1);
    }

    #[test]
    fn squares_share_their_overlap() {
        let square =
            |x: f64, y: f64| hull(vec![[x, y], [x + 2.0, y], [x + 2.0, y + 2.0], [x, y + 2.0]]);
        let both = shared(&square(0.0, 0.0), &square(1.5, 1.0));
        assert!((area_of(&both) - 0.5).abs() < 1e-12, "{both:?}");
        assert!(shared(&square(0.0, 0.0), &square(5.0, 0.0)).is_empty());
        assert!((area_of(&shared(&square(0.0, 0.0), &square(0.0, 0.0))) - 4.0).abs() < 1e-12);
    }
}
