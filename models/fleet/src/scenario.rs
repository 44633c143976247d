//! `[case.parameters.world]`: which vehicle, which map, how many robots; checked and built into
//! the [`World`] a fleet shares. It says nothing about who goes when.
//!
//! The small scenarios are straight lines without obstacles, whose critical sections, waiting points
//! and times have a closed form. On a map the paths between bays are planned so that it is
//! well-formed: robots leave and enter bays straight, and no path touches a vehicle parked in a
//! third bay.

use std::sync::Arc;

use crate::geometry::{Bounds, Footprint, Pose};
use crate::map::{self, BAYS_PER_SIDE, Map, raised};
use crate::path::{Path, PathLibrary};
use crate::planner::space::Space;
use crate::planner::{At, Planner, Segment};
use crate::section::MergePolicy;
use crate::world::{BayIndex, Route, Vehicle, World};
use hil_core::case_study::ParameterError;
use hil_core::options::{ANY_NUMBER, Rows};

hil_core::words! {
    /// Where the fleet drives.
    #[derive(Default)]
    pub enum Scenario {
        /// Container yard, 400 m x 220 m, vehicles of 14.8 m x 3 m (Table I).
        Harbor = "harbor",
        /// Hall with racks, 80 m x 44 m, vehicles of 2 m x 0.5 m (Table I).
        #[default]
        Warehouse = "warehouse",
        /// Two straight paths at a right angle.
        Crossing = "crossing",
        /// Two robots swap sides through a corridor for one.
        HeadOn = "head-on",
        /// One robot behind another on the same line.
        Following = "following",
        /// Three straight paths that cross in a triangle.
        ThreeCycle = "three-cycle",
        /// Bounds, obstacles and bays as given.
        Custom = "custom",
    }
}

hil_core::options! {
    /// `[case.parameters.world]`. What is not given is the scenario's own.
    pub struct WorldParameters {
        /// Where the fleet drives.
        scenario: Scenario = Scenario::Warehouse;
        /// Number of robots. Harbor and warehouse grow by one yard or hall for every 7; the
        /// other scenarios have as many robots as starts, at most this many.
        robots: u32 = 7, in 1..=448;
        /// Way between neighbouring path poses at most, metres.
        path_spacing_m: f64 = 0.3, in 0.01..=5.0;
        /// Which overlaps count as one critical section.
        merge: MergePolicy = MergePolicy::WithinVehicle;
        /// Vehicle length, metres.
        length_m: Option<f64> = None, in 0.05..=100.0;
        /// Vehicle width, metres.
        width_m: Option<f64> = None, in 0.05..=100.0;
        /// Largest speed, m/s.
        speed_max_mps: Option<f64> = None, in 0.01..=100.0;
        /// Largest acceleration and deceleration, m/s^2.
        acceleration_mps2: Option<f64> = None, in 0.01..=100.0;
        /// Smallest turning radius of planned paths, metres.
        turning_radius_m: Option<f64> = None, in 0.05..=1000.0;
        /// What planned paths keep between vehicle and everything else, metres.
        clearance_m: Option<f64> = None, in 0.0..=100.0;
        /// `custom`: the ground, metres.
        bounds: Option<Bounds>;
        /// `custom`: what no vehicle may touch.
        obstacles: Rows<Bounds>;
        /// `custom`: where robots park.
        bays: Rows<BayParameters>;
        /// `custom`: paths given pose by pose. When there are any, none is planned.
        paths: Rows<PathParameters>;
    }
    check WorldParameters::check_custom;
}

hil_core::words! {
    /// Which end of the paths a bay is.
    pub enum BaySide {
        /// Forward paths begin here, and robots start here.
        Left = "left",
        /// Forward paths end here.
        Right = "right",
    }
}

hil_core::options! {
    /// `[[case.parameters.world.bays]]`.
    #[derive(Copy)]
    pub struct BayParameters {
        /// Metres.
        x_m: f64, in ANY_NUMBER;
        /// Metres.
        y_m: f64, in ANY_NUMBER;
        /// Radians; the heading of a vehicle that parks here, whichever way it came.
        heading_rad: f64 = 0.0, in ANY_NUMBER;
        /// Robots go from left bays to right ones and back.
        side: BaySide;
    }
}

hil_core::options! {
    /// `[[case.parameters.world.paths]]`.
    pub struct PathParameters {
        /// Index of the left bay in `bays`.
        from: u32, in 0..=u32::MAX;
        /// Index of the right bay in `bays`.
        to: u32, in 0..=u32::MAX;
        /// Poses from bay to bay.
        poses: Rows<Pose>;
    }
}

/// A world with its robots in their starting bays.
#[derive(Debug, Clone)]
pub struct Scene {
    /// What never changes.
    pub world: Arc<World>,
    /// Per robot, the bay it starts in.
    pub starts: Vec<BayIndex>,
    /// Per bay, the bay at the other end of its shuttle line.
    pub partners: Vec<Option<BayIndex>>,
    /// What planning the paths took.
    pub planning: PlanningSummary,
}

/// What planning a world's paths took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PlanningSummary {
    /// Paths the planner was asked for; paths which repeat another one elsewhere are not.
    pub planned_count: u64,
    /// States it expanded for them.
    pub expanded_count: u64,
}

impl WorldParameters {
    /// Checks the parameters and builds the world.
    ///
    /// # Errors
    /// Names the key, below `world`, and what is wrong with it.
    pub fn build(&self) -> Result<Scene, ParameterError> {
        self.check().map_err(|error| error.below("world"))?;
        let vehicle = self.vehicle();
        match self.scenario {
            Scenario::Crossing => self.lines(vehicle, &crossing(&vehicle)),
            Scenario::HeadOn => self.lines(vehicle, &head_on(&vehicle)),
            Scenario::Following => self.lines(vehicle, &following(&vehicle)),
            Scenario::ThreeCycle => self.lines(vehicle, &three_cycle(&vehicle)),
            Scenario::Harbor => self.hall(vehicle, &map::harbor(self.clearance_m())),
            Scenario::Warehouse => self.hall(vehicle, &map::warehouse(self.clearance_m())),
            Scenario::Custom => self.custom(vehicle),
        }
    }

    /// The map of the scenario; `None` for the small scenarios, whose ground has neither edge nor
    /// obstacles.
    ///
    /// # Errors
    /// When `custom` lacks its bounds.
    pub fn map(&self) -> Result<Option<Map>, ParameterError> {
        Ok(match self.scenario {
            Scenario::Harbor => Some(map::harbor(self.clearance_m()).stacked(self.tiles())),
            Scenario::Warehouse => Some(map::warehouse(self.clearance_m()).stacked(self.tiles())),
            Scenario::Custom => Some(self.custom_map()?),
            _ => None,
        })
    }

    /// The smallest turning radius of planned paths: as given, or 10 m in the harbor, else 4 m.
    pub fn turning_radius_m(&self) -> f64 {
        let own = match self.scenario {
            Scenario::Harbor => 10.0,
            _ => 4.0,
        };
        self.turning_radius_m.unwrap_or(own)
    }

    /// What planned paths keep between vehicle and obstacles, as given or half a width.
    pub fn clearance_m(&self) -> f64 {
        let own = 0.5 * self.vehicle().footprint.width_m;
        self.clearance_m.unwrap_or(own)
    }

    pub(super) fn tiles(&self) -> usize {
        (self.robots as usize).div_ceil(BAYS_PER_SIDE).max(1)
    }

    /// The vehicle: that of Table I for the scenario (the warehouse's unless harbor), with what
    /// the parameters override.
    pub fn vehicle(&self) -> Vehicle {
        let table = match self.scenario {
            Scenario::Harbor => [14.8, 3.0, 6.0, 2.0],
            _ => [2.0, 0.5, 2.0, 1.0],
        };
        Vehicle {
            footprint: Footprint {
                length_m: self.length_m.unwrap_or(table[0]),
                width_m: self.width_m.unwrap_or(table[1]),
            },
            speed_max_mps: self.speed_max_mps.unwrap_or(table[2]),
            acceleration_mps2: self.acceleration_mps2.unwrap_or(table[3]),
        }
    }

    fn check_custom(&self) -> Result<(), ParameterError> {
        if self.scenario != Scenario::Custom {
            let given = [
                ("bounds", self.bounds.is_some()),
                ("obstacles", !self.obstacles.0.is_empty()),
                ("bays", !self.bays.0.is_empty()),
                ("paths", !self.paths.0.is_empty()),
            ];
            if let Some((key, _)) = given.iter().find(|(_, is_given)| *is_given) {
                let problem = "is for scenario = \"custom\"; this one has its own";
                return Err(ParameterError::new(key, problem));
            }
        }
        Ok(())
    }
}

/// Planned paths are handed on as poses so much nearer than those of the path: the chord is
/// shorter than its arc by less than a ten-thousandth.
const FINER: f64 = 0.25;

/// Poses of a path from bay to bay.
#[derive(Debug, Clone)]
pub(crate) struct Connection {
    pub(crate) from: BayIndex,
    pub(crate) to: BayIndex,
    pub(crate) poses: Vec<Pose>,
}

/// Paths and routes in the making.
#[derive(Debug, Default)]
pub(crate) struct Network {
    pub(crate) paths: PathLibrary,
    pub(crate) routes: Vec<Route>,
}

impl Network {
    /// Adds a connection and the way back.
    pub(crate) fn add(
        &mut self,
        connection: &Connection,
        spacing_m: f64,
    ) -> Result<(), ParameterError> {
        let (from, to) = (connection.from, connection.to);
        let path = Path::new(&connection.poses, spacing_m).map_err(|error| {
            ParameterError::new(
                "world.paths",
                format!("from bay {from} to bay {to}: {error}"),
            )
        })?;
        let path = self.paths.add(path);
        self.routes.push(Route { from, to, path });
        self.routes.push(Route {
            from: to,
            to: from,
            path: path.reversed(),
        });
        Ok(())
    }
}

/// Plans connections on one map.
pub(crate) struct Connector<'a> {
    map: &'a Map,
    vehicle: &'a Vehicle,
    planner: Planner,
    space: Space,
    spacing_m: f64,
    pub(crate) summary: PlanningSummary,
}

impl<'a> Connector<'a> {
    pub(crate) fn new(
        map: &'a Map,
        vehicle: &'a Vehicle,
        turning_radius_m: f64,
        spacing_m: f64,
    ) -> Result<Self, ParameterError> {
        map.check(vehicle)?;
        let planner = Planner::new(map.space_around_parked(vehicle), turning_radius_m)
            .map_err(|error| ParameterError::new("world.turning_radius_m", error.to_string()))?;
        Ok(Self {
            map,
            vehicle,
            planner,
            space: map.space_with_half_clearance(vehicle),
            spacing_m,
            summary: PlanningSummary::default(),
        })
    }

    /// The connections from every left bay to every right bay for which `is_wanted`.
    pub(crate) fn connect(
        &mut self,
        is_wanted: &dyn Fn(BayIndex, BayIndex) -> bool,
    ) -> Result<Vec<Connection>, ParameterError> {
        let mut connections = Vec::new();
        // The goal in the outer loop: the planner keeps what it knows of a goal.
        for to in self.map.bays_of(BaySide::Right) {
            for from in self.map.bays_of(BaySide::Left) {
                if is_wanted(from, to) {
                    connections.push(self.connection(from, to)?);
                }
            }
        }
        connections.sort_by_key(|connection| (connection.from, connection.to));
        Ok(connections)
    }

    fn connection(&mut self, from: BayIndex, to: BayIndex) -> Result<Connection, ParameterError> {
        let [start, goal] = [from, to].map(|bay| self.map.bays[bay].pose);
        // So far from its bay that a vehicle keeps its clearance from one parked there.
        let straight_m = self.vehicle.footprint.length_m + 2.0 * self.map.clearance_m;
        let ahead = |pose: &Pose, way_m: f64| {
            let straight = Segment {
                curvature_per_m: 0.0,
                length_m: way_m,
            };
            straight.pose_after(pose, way_m)
        };
        let mut stops = vec![ahead(&start, straight_m)];
        stops.extend(self.map.lanes_between(from, to));
        stops.push(ahead(&goal, -straight_m));
        let mut poses = vec![start];
        for leg in stops.windows(2) {
            let plan = self.planner.plan(&leg[0], &leg[1]).map_err(|error| {
                let key = format!("world.bays[{from}]");
                ParameterError::new(&key, format!("has no path to bay {to}: {error}"))
            })?;
            self.summary.expanded_count += plan.expanded_count;
            poses.extend(plan.poses(FINER * self.spacing_m));
        }
        poses.push(goal);
        self.summary.planned_count += 1;
        let connection = Connection { from, to, poses };
        self.check(&connection, "world.bays")?;
        Ok(connection)
    }

    /// Checks that a path keeps half the map's clearance from obstacles, the edge and vehicles in
    /// third bays.
    pub(crate) fn check(&self, connection: &Connection, key: &str) -> Result<(), ParameterError> {
        let (from, to) = (connection.from, connection.to);
        let error = |problem: String| Err(ParameterError::new(key, problem));
        // Straight stretches are given by their ends; fill them in.
        let footprint = &self.vehicle.footprint;
        let step_m = 0.25 * footprint.width_m.min(footprint.length_m);
        let path = match Path::new(&connection.poses, step_m) {
            Ok(path) => path,
            Err(problem) => return error(problem.to_string()),
        };
        for pose in path.poses() {
            if let Some(blocker) = self.space.blocker_but(&[from, to], pose) {
                return error(format!(
                    "path from bay {from} to bay {to} comes nearer than {} m to {blocker} at {}",
                    0.5 * self.map.clearance_m,
                    At(pose)
                ));
            }
        }
        Ok(())
    }
}

/// The connection, so many tiles of `bay_count` bays and `height_m` higher up.
pub(crate) fn lifted(
    connection: &Connection,
    tile: usize,
    bay_count: usize,
    height_m: f64,
) -> Connection {
    let rise_m = tile as f64 * height_m;
    Connection {
        from: connection.from + tile * bay_count,
        to: connection.to + tile * bay_count,
        poses: connection
            .poses
            .iter()
            .map(|pose| raised(pose, rise_m))
            .collect(),
    }
}

/// What a small scenario lays out for one robot: the way from its start to its goal, as corner
/// poses.
pub(crate) type Line = Vec<Pose>;

/// Half the way of the crossing and the way before and beyond the triangle, in vehicle lengths.
const APPROACH: f64 = 10.0;
/// Half the corridor of the head-on scenario, in vehicle lengths.
const CORRIDOR: f64 = 5.0;
/// From a bay of the head-on scenario to where the vehicle bears away, in vehicle lengths.
const RUN_UP: f64 = 3.0;
/// From the corridor's axis to a bay's, in vehicle widths.
const BEARING_AWAY: f64 = 3.0;
/// From the follower's start to the leader's, in vehicle lengths.
const HEADWAY: f64 = 3.0;

/// Robot 0 drives east, robot 1 north; the lines cross at the origin, half way of both.
pub(crate) fn crossing(vehicle: &Vehicle) -> Vec<Line> {
    let way_m = APPROACH * vehicle.footprint.length_m;
    let north = core::f64::consts::FRAC_PI_2;
    vec![
        vec![Pose::new(-way_m, 0.0, 0.0), Pose::new(way_m, 0.0, 0.0)],
        vec![Pose::new(0.0, -way_m, north), Pose::new(0.0, way_m, north)],
    ]
}

/// Two robots swap sides through a corridor for one: both bear to their left at its end, into
/// bays beside each other. They keep their heading while they bear away (all wheels steered), so
/// that all footprints stay upright and overlap has a closed form.
pub(crate) fn head_on(vehicle: &Vehicle) -> Vec<Line> {
    let corridor_m = CORRIDOR * vehicle.footprint.length_m;
    let aside_m = BEARING_AWAY * vehicle.footprint.width_m;
    let end_m = corridor_m + aside_m + RUN_UP * vehicle.footprint.length_m;
    let along = |side: f64, heading_rad: f64| {
        [
            (-end_m, aside_m),
            (-corridor_m - aside_m, aside_m),
            (-corridor_m, 0.0),
            (corridor_m, 0.0),
            (corridor_m + aside_m, aside_m),
            (end_m, aside_m),
        ]
        .map(|(x_m, y_m)| Pose::new(side * x_m, side * y_m, heading_rad))
        .to_vec()
    };
    vec![along(1.0, 0.0), along(-1.0, core::f64::consts::PI)]
}

/// Robot 1 follows robot 0 along one line and stops as far behind it as it began.
pub(crate) fn following(vehicle: &Vehicle) -> Vec<Line> {
    let headway_m = HEADWAY * vehicle.footprint.length_m;
    let way_m = 2.0 * APPROACH * vehicle.footprint.length_m;
    let from = |x_m| vec![Pose::new(x_m, 0.0, 0.0), Pose::new(x_m + way_m, 0.0, 0.0)];
    vec![from(headway_m), from(0.0)]
}

/// Three robots, each along one side of a triangle and beyond. The sides are one vehicle long, so
/// a robot stands in its first section as long as it waits for its second: when each goes first
/// at its first corner, none can leave.
pub(crate) fn three_cycle(vehicle: &Vehicle) -> Vec<Line> {
    let side_m = vehicle.footprint.length_m;
    let way_m = APPROACH * side_m;
    (0..3)
        .map(|side| {
            let heading_rad = f64::from(side) * core::f64::consts::TAU / 3.0;
            let (sine, cosine) = heading_rad.sin_cos();
            // The middle of the side lies to the right of the centre, an inradius away.
            let inradius_m = side_m / 12.0_f64.sqrt();
            let middle = [inradius_m * sine, -inradius_m * cosine];
            [-1.0, 1.0]
                .map(|end| {
                    let way_m = end * (0.5 * side_m + way_m);
                    let (x_m, y_m) = (middle[0] + way_m * cosine, middle[1] + way_m * sine);
                    Pose::new(x_m, y_m, crate::geometry::wrap_angle(heading_rad))
                })
                .to_vec()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::PathId;
    use crate::section::Side;

    fn scene(scenario: Scenario) -> Scene {
        let parameters = WorldParameters {
            scenario,
            path_spacing_m: 0.1,
            ..WorldParameters::default()
        };
        parameters.build().unwrap()
    }

    /// The only section of the forward paths of two lines.
    fn only_section(scene: &Scene, first: u32, second: u32) -> crate::section::Section {
        let (first, second) = (PathId(2 * first), PathId(2 * second));
        let sections = scene.world.sections.between(first, second);
        assert_eq!(sections.len(), 1, "{first} {second}");
        sections[0].clone()
    }

    #[test]
    fn crossing_has_the_section_of_its_closed_form() {
        let scene = scene(Scenario::Crossing);
        assert_eq!(scene.starts, [0, 1]);
        assert!((scene.world.path(PathId(0)).length_m() - 40.0).abs() < 1e-9);
        let section = only_section(&scene, 0, 1);
        // Overlap while both are nearer to the middle, 20 m, than half of 2 m + 0.5 m.
        for side in [Side::First, Side::Second] {
            let expected = (188..=212, 188, 212);
            assert!(expected.0.contains(&section.start(side)));
            assert_eq!(
                (section.start(side), section.end(side)),
                (expected.1, expected.2)
            );
        }
    }

    #[test]
    fn head_on_robots_meet_in_one_section_but_not_in_their_bays() {
        let scene = scene(Scenario::HeadOn);
        let section = only_section(&scene, 0, 1);
        let path = scene.world.path(PathId(0));
        // From the bay: 6 m straight, then 1.5 m aside at 45 degrees, then 20 m of corridor.
        let length_m = 2.0 * 6.0 + 2.0 * 1.5 * 2.0_f64.sqrt() + 20.0;
        assert!((path.length_m() - length_m).abs() < 1e-9);
        for side in [Side::First, Side::Second] {
            let start_m = path.way_to_m(section.start(side));
            let end_m = path.way_to_m(section.end(side));
            // Leaning out by y needs the other within 0.5 - y of the axis: the section begins
            // when bearing away by less than 0.5 m and 2 m of length behind.
            assert!(start_m > 4.0 && start_m < 8.2, "{start_m}");
            assert!((start_m + end_m - length_m).abs() < 0.2);
        }
        let bays = &scene.world.bays;
        let covered = |bay: usize| scene.world.vehicle.footprint.at(&bays[bay].pose);
        assert!(!covered(0).overlaps(&covered(3)) && !covered(1).overlaps(&covered(2)));
    }

    #[test]
    fn a_follower_keeps_its_headway_from_start_to_end() {
        let scene = scene(Scenario::Following);
        let (leader, follower) = (scene.world.bays[0].pose, scene.world.bays[1].pose);
        assert!((leader.distance_m(&follower) - 6.0).abs() < 1e-12);
        let section = only_section(&scene, 1, 0);
        // The follower's front reaches the leader's rear after 4 m; those poses only touch.
        assert_eq!(
            (section.start(Side::First), section.start(Side::Second)),
            (41, 0)
        );
    }

    #[test]
    fn in_the_three_cycle_each_waits_within_its_first_section() {
        let scene = scene(Scenario::ThreeCycle);
        for robot in 0..3_u32 {
            let (next, last) = ((robot + 1) % 3, (robot + 2) % 3);
            let second = only_section(&scene, robot, next);
            let first = only_section(&scene, robot, last);
            assert!(first.start(Side::First) < second.start(Side::First));
            assert!(first.end(Side::First) > second.start(Side::First) + 3);
            // A robot just before its second section does not yet overlap the next one in its.
            let waiting = second.start(Side::First) - 4;
            assert!(waiting > first.start(Side::First));
        }
    }
}
