//! Builds the world of a scenario: lines, a built-in map as often as robots need it, or the map a
//! user gave. What parameters may say is not its business but [`scenario`](super::scenario)'s.

use std::sync::Arc;

use crate::geometry::{Pose, wrap_angle};
use crate::map::{Map, MapBay};
use crate::path::{Path, PathLibrary};
use crate::planner::At;
use crate::scenario::{
    BaySide, Connection, Connector, Line, Network, PlanningSummary, Scene, WorldParameters, lifted,
};
use crate::world::{Bay, Route, Vehicle, World};
use hil_core::case_study::ParameterError;

/// How near the ends of a given path must be to its bays, metres and radians.
const END_TOLERANCE: f64 = 1e-3;

impl WorldParameters {
    /// A built-in map, as often as the robots need it. Robots start in left bays.
    pub(super) fn hall(&self, vehicle: Vehicle, tile: &Map) -> Result<Scene, ParameterError> {
        let (radius_m, spacing_m) = (self.turning_radius_m(), self.path_spacing_m);
        let count = self.tiles();
        let (bay_count, height_m) = (tile.bays.len(), tile.height_m());
        let mut connector = Connector::new(tile, &vehicle, radius_m, spacing_m)?;
        let within = connector.connect(&|_, _| true)?;
        let mut planning = connector.summary;
        let mut network = Network::default();
        for number in 0..count {
            for connection in &within {
                let lifted = lifted(connection, number, bay_count, height_m);
                network.add(&lifted, self.path_spacing_m)?;
            }
        }
        if count > 1 {
            let pair = tile.stacked(2);
            let mut connector = Connector::new(&pair, &vehicle, radius_m, spacing_m)?;
            // To the nearer bays of the neighbour only, lest paths grow in number with no use.
            let near_m = pair.bays[..2 * bay_count].iter();
            let near: Vec<_> = near_m
                .map(|bay| (bay.pose.y_m - pair.bounds.y_min_m - height_m).abs() < 0.5 * height_m)
                .collect();
            let across = connector.connect(&|from, to| {
                from / bay_count != to / bay_count && near[from] && near[to]
            })?;
            planning.planned_count += connector.summary.planned_count;
            planning.expanded_count += connector.summary.expanded_count;
            for number in 0..count - 1 {
                for connection in &across {
                    let lifted = lifted(connection, number, bay_count, height_m);
                    network.add(&lifted, self.path_spacing_m)?;
                }
            }
        }
        let bays: Vec<_> = tile.stacked(count).bays;
        Ok(self.scene(vehicle, &bays, network, planning))
    }

    pub(super) fn custom_map(&self) -> Result<Map, ParameterError> {
        let Some(bounds) = self.bounds else {
            let problem = "is missing, and scenario = \"custom\" needs it";
            return Err(ParameterError::new("world.bounds", problem));
        };
        let bays = self.bays.0.iter().map(|bay| MapBay {
            pose: Pose::new(bay.x_m, bay.y_m, bay.heading_rad),
            side: bay.side,
        });
        Ok(Map {
            bounds,
            obstacles: self.obstacles.0.clone(),
            bays: bays.collect(),
            gates: Vec::new(),
            clearance_m: self.clearance_m(),
        })
    }

    pub(super) fn custom(&self, vehicle: Vehicle) -> Result<Scene, ParameterError> {
        let map = self.custom_map()?;
        for side in [BaySide::Left, BaySide::Right] {
            if map.bays_of(side).next().is_none() {
                let problem = format!("has no {side} one; robots need one on each side");
                return Err(ParameterError::new("world.bays", problem));
            }
        }
        let (radius_m, spacing_m) = (self.turning_radius_m(), self.path_spacing_m);
        let mut connector = Connector::new(&map, &vehicle, radius_m, spacing_m)?;
        let connections = if self.paths.0.is_empty() {
            connector.connect(&|_, _| true)?
        } else {
            self.given_connections(&map, &connector)?
        };
        let mut network = Network::default();
        for connection in &connections {
            network.add(connection, self.path_spacing_m)?;
        }
        Ok(self.scene(vehicle, &map.bays, network, connector.summary))
    }

    fn given_connections(
        &self,
        map: &Map,
        connector: &Connector<'_>,
    ) -> Result<Vec<Connection>, ParameterError> {
        let mut connections = Vec::<Connection>::new();
        for (index, path) in self.paths.0.iter().enumerate() {
            let key = format!("world.paths[{index}]");
            let error = |problem: String| Err(ParameterError::new(&key, problem));
            let ends = [(path.from, BaySide::Left), (path.to, BaySide::Right)];
            for (bay, side) in ends {
                if !map.bays_of(side).any(|known| known == bay as usize) {
                    return error(format!("names bay {bay}, which is no {side} bay"));
                }
            }
            let connection = Connection {
                from: path.from as usize,
                to: path.to as usize,
                poses: path.poses.0.clone(),
            };
            let is_known = |known: &Connection| (known.from, known.to);
            let pair = is_known(&connection);
            if connections.iter().any(|known| is_known(known) == pair) {
                return error(format!("joins bays {} and {} again", path.from, path.to));
            }
            // Names a NaN pose before anything compares with it.
            if let Err(problem) = Path::new(&path.poses.0, self.path_spacing_m) {
                return error(problem.to_string());
            }
            let ends = [
                (path.poses.0.first(), path.from),
                (path.poses.0.last(), path.to),
            ];
            for (pose, bay) in ends {
                let parked = map.bays[bay as usize].pose;
                let is_there = |pose: &Pose| {
                    let turn = wrap_angle(pose.heading_rad - parked.heading_rad);
                    pose.distance_m(&parked) < END_TOLERANCE && turn.abs() < END_TOLERANCE
                };
                if !pose.is_some_and(is_there) {
                    return error(format!("does not end in bay {bay}, at {}", At(&parked)));
                }
            }
            connector.check(&connection, &key)?;
            connections.push(connection);
        }
        Ok(connections)
    }

    /// Robots in the first left bays of every seven, each left bay's shuttle line leading to
    /// the right bay of equal rank.
    fn scene(
        &self,
        vehicle: Vehicle,
        bays: &[MapBay],
        network: Network,
        planning: PlanningSummary,
    ) -> Scene {
        let of = |side| {
            let numbered = bays.iter().enumerate();
            let own = numbered.filter(move |(_, bay)| bay.side == side);
            own.map(|(index, _)| index).collect::<Vec<_>>()
        };
        let (left, right) = (of(BaySide::Left), of(BaySide::Right));
        let mut partners = vec![None; bays.len()];
        for (&from, &to) in left.iter().zip(&right) {
            partners[from] = Some(to);
            partners[to] = Some(from);
        }
        let bays = bays.iter().map(|bay| Bay { pose: bay.pose }).collect();
        let Network { paths, routes } = network;
        Scene {
            world: Arc::new(World::new(vehicle, bays, routes, paths, self.merge)),
            starts: left.into_iter().take(self.robots as usize).collect(),
            partners,
            planning,
        }
    }

    /// A world of one line per robot; bay `i` is where robot `i` starts, bay `n + i` where its
    /// line ends.
    pub(super) fn lines(&self, vehicle: Vehicle, lines: &[Line]) -> Result<Scene, ParameterError> {
        let count = lines.len();
        let ends = |pick: fn(&Line) -> Option<&Pose>| lines.iter().filter_map(pick);
        let bays = ends(|line| line.first()).chain(ends(|line| line.last()));
        let bays: Vec<_> = bays.map(|&pose| Bay { pose }).collect();
        let (mut paths, mut routes) = (PathLibrary::default(), Vec::new());
        for (from, line) in lines.iter().enumerate() {
            let path = Path::new(line, self.path_spacing_m)
                .map_err(|error| ParameterError::new("world.path_spacing_m", error.to_string()))?;
            let path = paths.add(path);
            let to = count + from;
            routes.push(Route { from, to, path });
            let (from, to, path) = (to, from, path.reversed());
            routes.push(Route { from, to, path });
        }
        let robot_count = count.min(self.robots as usize);
        Ok(Scene {
            world: Arc::new(World::new(vehicle, bays, routes, paths, self.merge)),
            starts: (0..robot_count).collect(),
            partners: (0..2 * count)
                .map(|bay| Some((bay + count) % (2 * count)))
                .collect(),
            planning: PlanningSummary::default(),
        })
    }
}

#[cfg(test)]
#[path = "scene_tests.rs"]
mod tests;
