//! Plans the paths between the bays of a map so that it is well-formed: robots leave and enter
//! bays straight, and no path touches a vehicle parked in a third bay.

use crate::case_study::ParameterError;
use crate::fleet::geometry::Pose;
use crate::fleet::map::{Map, first_blocker, raised};
use crate::fleet::path::{Path, PathLibrary};
use crate::fleet::planner::{Planner, Segment};
use crate::fleet::scenario::{BaySide, PlanningSummary};
use crate::fleet::world::{BayIndex, Route, Vehicle};

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
    spacing_m: f64,
    pub(crate) summary: PlanningSummary,
}

impl<'a> Connector<'a> {
    pub(crate) fn new(
        map: &'a Map,
        vehicle: &'a Vehicle,
        (turning_radius_m, spacing_m): (f64, f64),
    ) -> Result<Self, ParameterError> {
        map.check(vehicle)?;
        let planner = Planner::around_parked(map, vehicle, turning_radius_m)
            .map_err(|error| ParameterError::new("world.turning_radius_m", error.to_string()))?;
        Ok(Self {
            map,
            vehicle,
            planner,
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
        let (leave, enter) = (ahead(&start, straight_m), ahead(&goal, -straight_m));
        let plan = self.planner.plan(&leave, &enter).map_err(|error| {
            let key = format!("world.bays[{from}]");
            ParameterError::new(&key, format!("has no path to bay {to}: {error}"))
        })?;
        self.summary.planned_count += 1;
        self.summary.expanded_count += plan.expanded_count();
        let fine_m = 0.1 * self.spacing_m;
        let mut poses = vec![start];
        poses.extend(plan.poses(fine_m));
        poses.push(goal);
        let connection = Connection { from, to, poses };
        check_connection(self.map, self.vehicle, &connection, "world.bays")?;
        Ok(connection)
    }
}

/// Checks that a path keeps half the map's clearance from obstacles, the edge and vehicles in
/// third bays.
pub(crate) fn check_connection(
    map: &Map,
    vehicle: &Vehicle,
    connection: &Connection,
    key: &str,
) -> Result<(), ParameterError> {
    let (from, to) = (connection.from, connection.to);
    let space = map.space_between(vehicle, [from, to]);
    // Straight stretches are given by their ends; fill them in.
    let step_m = 0.25 * vehicle.footprint.width_m.min(vehicle.footprint.length_m);
    let path = Path::new(&connection.poses, step_m);
    let poses = path.as_ref().map_or(&[] as &[Pose], |path| path.poses());
    if let Some((index, blocker)) = first_blocker(&space, poses) {
        let problem = format!(
            "the path from bay {from} to bay {to} comes nearer than {} m to {blocker} at {}",
            0.5 * map.clearance_m,
            crate::fleet::planner::At(&poses[index])
        );
        return Err(ParameterError::new(key, problem));
    }
    Ok(())
}

/// The connection, so many tiles of `bay_count` bays and `height_m` higher up.
pub(crate) fn lifted(
    connection: &Connection,
    tile: usize,
    (bay_count, height_m): (usize, f64),
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

#[cfg(test)]
mod tests {
    use crate::fleet::scenario::{Scenario, WorldParameters};

    #[test]
    fn statistics() {
        for scenario in [Scenario::Warehouse, Scenario::Harbor] {
            let parameters = WorldParameters {
                scenario,
                ..WorldParameters::default()
            };
            #[allow(clippy::disallowed_methods)]
            let begin = std::time::Instant::now();
            let scene = parameters.build().unwrap();
            let took = begin.elapsed();
            println!("{scenario:?} {:?} {took:?}", scene.planning);
            let world = &scene.world;
            for r in world.routes.iter().filter(|r| r.from < 7) {
                let p = world.path(r.path);
                println!("route {} {} {:.1}", r.from, r.to, p.length_m());
            }
        }
    }
}
