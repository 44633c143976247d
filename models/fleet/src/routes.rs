//! Plans the paths between the bays of a map so that it is well-formed: robots leave and enter
//! bays straight, and no path touches a vehicle parked in a third bay.

use crate::geometry::Pose;
use crate::map::{Map, raised};
use crate::path::{Path, PathLibrary};
use crate::planner::space::Space;
use crate::planner::{At, Planner, Segment};
use crate::scenario::{BaySide, PlanningSummary};
use crate::world::{BayIndex, Route, Vehicle};
use hil_core::case_study::ParameterError;

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
