//! The fleet as its messages tell of it: where each robot last was, how far it may go, who waits.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::{Receiver, TryRecvError};

use hil_fleet::geometry::{Footprint, Pose};
use hil_fleet::messages::{NO_AUTHORITY, Phase, State, TO_GOAL};
use hil_fleet::path::{Path, PathId};
use hil_fleet::scenario::Scene;
use hil_fleet::world::World;
use serde::Serialize;
use serde_json::Value;

use super::collisions::{Collision, Collisions};
use super::ground::{self, Ground, MapPicture, points};
use super::sections::{Areas, OnPath, Point, SectionPicture, of_pair};
use super::{Told, rounded, seconds};

/// A state older than this is shown as stale.
const STALE_NS: i64 = 1_000_000_000;
/// Points of a way ahead.
const AHEAD_MAX: usize = 24;
/// Robots of a fleet beyond which sections, a matter of pairs, are not worked out.
const PAIRED_MAX: usize = 64;
/// Sections listed.
const SECTIONS_MAX: usize = 400;
/// Robots shown at all: a damaged record must not fill the memory.
const ROBOTS_MAX: usize = 64 * 448;

/// `/live/fleet`.
#[derive(Debug, Serialize)]
pub(crate) struct FleetPicture {
    pub(crate) at_s: f64,
    pub(crate) robots: Vec<RobotPicture>,
    /// `None` where the ground is not known, or a fleet is too large to look at its pairs.
    pub(crate) sections: Option<Vec<SectionPicture>>,
    pub(crate) collisions: VecDeque<Collision>,
    collision_count: Option<u64>,
    basis: &'static str,
}

/// A robot of it.
#[derive(Debug, Default, Serialize)]
pub(crate) struct RobotPicture {
    pub(crate) fleet: u32,
    pub(crate) id: u32,
    pub(crate) x_m: f64,
    pub(crate) y_m: f64,
    pub(crate) heading_rad: f64,
    speed_mps: f64,
    pub(crate) age_s: f64,
    pub(crate) is_stale: bool,
    pub(crate) phase: &'static str,
    pub(crate) is_waiting: bool,
    mission: Option<u32>,
    path: Option<u32>,
    goal: Option<usize>,
    path_index: Option<usize>,
    granted_index: Option<usize>,
    last_index: Option<usize>,
    granted_m: Option<f64>,
    pub(crate) ahead: Vec<Point>,
    pub(crate) granted: Vec<Point>,
}

/// Which robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Id {
    fleet: u32,
    robot: u32,
}

/// The fleets of a run.
#[derive(Debug, Default)]
pub(crate) struct FleetView {
    robots: BTreeMap<Id, Robot>,
    collisions: Collisions,
    vehicle: Option<Footprint>,
    making: Option<Receiver<Result<Box<Ground>, String>>>,
    ground: Option<Box<Ground>>,
    areas: Option<Areas>,
    /// From the robots' monotonic clock to the axis.
    offset_ns: i64,
    /// Why there is no map.
    pub(crate) problem: Option<String>,
}

#[derive(Debug, Default)]
struct Robot {
    state: Option<(State, i64)>,
    /// Mission and path, the newest two: a state may still tell of the one before.
    missions: [(u32, u32); 2],
}

impl Robot {
    fn learn(&mut self, mission: u32, path: u32) {
        if mission != 0 && self.missions[0].0 != mission {
            self.missions = [(mission, path), self.missions[0]];
        }
    }

    fn path_of(&self, mission: u32) -> Option<PathId> {
        let mut known = self.missions.iter().filter(|_| mission != 0);
        let (_, path) = known.find(|(known, _)| *known == mission)?;
        Some(PathId(*path))
    }
}

impl FleetView {
    /// A fleet with these `[case.parameters]`; its ground is made from now on.
    pub(crate) fn new(parameters: &Value) -> Self {
        let world = serde_json::from_value::<hil_fleet::FleetParameters>(parameters.clone());
        let vehicle = world.as_ref().ok().map(|one| one.world.vehicle().footprint);
        Self {
            vehicle,
            making: Some(ground::make(parameters.clone())),
            ..Self::default()
        }
    }

    /// Begins again on the same ground.
    pub(crate) fn rewind(&mut self) {
        self.robots.clear();
        self.collisions = Collisions::default();
        if let Some(ground) = &self.ground {
            self.collisions.begin(ground);
        }
    }

    /// Takes what was told at `at_ns`; `offset_ns` leads from its producer's clock to the axis.
    pub(crate) fn take(&mut self, told: &Told, at_ns: i64, offset_ns: i64) {
        match *told {
            Told::State(state) => {
                self.offset_ns = offset_ns;
                let header = state.header;
                if let Some(robot) = self.robot(header.fleet_id, header.robot_id) {
                    robot.state = Some((state, at_ns));
                }
            }
            Told::Mission(mission) => {
                let header = mission.header;
                if let Some(robot) = self.robot(header.fleet_id, header.robot_id) {
                    robot.learn(header.mission_id, mission.path_id);
                }
            }
            Told::Truth(truth) => {
                self.offset_ns = offset_ns;
                if let Some(robot) = self.robot(truth.fleet_id, truth.robot_id) {
                    robot.learn(truth.mission_id, truth.path_id);
                }
                self.collisions.on_truth(truth);
            }
            Told::Command(..) | Told::Feedback(..) => {}
        }
    }

    fn robot(&mut self, fleet: u32, robot: u32) -> Option<&mut Robot> {
        let id = Id { fleet, robot };
        if self.robots.len() >= ROBOTS_MAX && !self.robots.contains_key(&id) {
            return None;
        }
        Some(self.robots.entry(id).or_default())
    }

    /// Looks whether the ground has been made; the map, the first time.
    pub(crate) fn new_map(&mut self) -> Option<&MapPicture> {
        match self.making.as_ref()?.try_recv() {
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => {
                self.problem = Some("no map of the fleet: making the map failed".to_owned());
            }
            Ok(Err(why)) => self.problem = Some(format!("no map of the fleet: {why}")),
            Ok(Ok(ground)) => {
                self.collisions.begin(&ground);
                self.areas = Some(Areas::new(ground.scene.world.vehicle.footprint));
                self.ground = Some(ground);
            }
        }
        self.making = None;
        self.map()
    }

    /// `/live/map`, once it is known.
    pub(crate) fn map(&self) -> Option<&MapPicture> {
        self.ground.as_ref().map(|ground| &ground.map)
    }

    /// Length and width of a vehicle, metres.
    pub(crate) fn vehicle_size_m(&self) -> Option<[f64; 2]> {
        self.vehicle
            .map(|vehicle| [vehicle.length_m, vehicle.width_m])
    }

    /// How many robots there are.
    pub(crate) fn robot_count(&self) -> usize {
        self.robots.len()
    }

    /// `/live/fleet` at `now_ns`; `origin_ns` is the run's beginning, both on the axis.
    pub(crate) fn picture(&mut self, now_ns: i64, origin_ns: i64) -> FleetPicture {
        let at_s = seconds(now_ns - origin_ns);
        let offset_ns = self.offset_ns;
        self.collisions
            .look(now_ns - offset_ns, origin_ns - offset_ns);
        self.look_at_states(now_ns, at_s);
        let scene = self.ground.as_ref().map(|ground| &ground.scene);
        let robots = self.robots.iter();
        let robots = robots
            .filter_map(|(id, robot)| picture_of(*id, robot, scene, now_ns))
            .collect();
        let sections = self.sections();
        let collisions = &self.collisions;
        let basis = if collisions.has_truth {
            "truth"
        } else {
            "states"
        };
        FleetPicture {
            at_s,
            robots,
            sections,
            collisions: collisions.listed.clone(),
            collision_count: collisions.count(),
            basis,
        }
    }

    fn look_at_states(&mut self, now_ns: i64, at_s: f64) {
        let Some(vehicle) = self.vehicle.filter(|_| !self.collisions.has_truth) else {
            return;
        };
        let mut fleets: BTreeMap<u32, Vec<(u32, Pose)>> = BTreeMap::new();
        for (id, robot) in &self.robots {
            if let Some((state, at_ns)) = robot.state
                && now_ns - at_ns < STALE_NS
            {
                let pose = Pose::new(state.x_m, state.y_m, state.heading_rad);
                fleets.entry(id.fleet).or_default().push((id.robot, pose));
            }
        }
        for (fleet, robots) in fleets {
            if robots.len() <= PAIRED_MAX {
                let collisions = &mut self.collisions;
                collisions.look_at_states(fleet, &robots, &vehicle, at_s);
            }
        }
    }

    fn sections(&mut self) -> Option<Vec<SectionPicture>> {
        let world = &self.ground.as_ref()?.scene.world;
        let areas = self.areas.as_mut()?;
        let mut fleets: BTreeMap<u32, Vec<OnPath>> = BTreeMap::new();
        for (id, robot) in &self.robots {
            fleets
                .entry(id.fleet)
                .or_default()
                .extend(on_path(id.robot, robot, world));
        }
        let mut list = Vec::new();
        for (fleet, robots) in &fleets {
            if robots.len() > PAIRED_MAX {
                return None;
            }
            for (index, one) in robots.iter().enumerate() {
                for other in &robots[index + 1..] {
                    if list.len() < SECTIONS_MAX {
                        list.extend(of_pair(world, areas, *fleet, one, other));
                    }
                }
            }
        }
        list.truncate(SECTIONS_MAX);
        Some(list)
    }
}

fn on_path(id: u32, robot: &Robot, world: &World) -> Option<OnPath> {
    let (state, _) = robot.state?;
    let (Phase::Driving | Phase::AtPoint) = Phase::from_number(state.phase)? else {
        return None;
    };
    let path = robot.path_of(state.header.mission_id)?;
    let index = usize::try_from(state.path_index).ok()?;
    let granted = granted(&state, world.paths.get(path)?).unwrap_or(index);
    Some(OnPath {
        robot: id,
        path,
        index,
        granted,
    })
}

/// The last pose that the robot may reach; `None` before it was told.
fn granted(state: &State, path: &Path) -> Option<usize> {
    match state.authority_index {
        TO_GOAL => Some(path.last_index()),
        NO_AUTHORITY => None,
        index => Some(usize::try_from(index).ok()?.min(path.last_index())),
    }
}

fn picture_of(id: Id, robot: &Robot, scene: Option<&Scene>, now_ns: i64) -> Option<RobotPicture> {
    let (state, at_ns) = robot.state?;
    let phase = Phase::from_number(state.phase)?;
    let word = match phase {
        Phase::Parked => "parked",
        Phase::Driving => "driving",
        Phase::AtPoint => "at-point",
        Phase::Done => "done",
    };
    let is_standing = state.speed_mps.abs() < 1e-3;
    let mission = state.header.mission_id;
    let mut picture = RobotPicture {
        fleet: id.fleet,
        id: id.robot,
        x_m: rounded(state.x_m),
        y_m: rounded(state.y_m),
        heading_rad: rounded(state.heading_rad),
        speed_mps: rounded(state.speed_mps.into()),
        age_s: seconds((now_ns - at_ns).max(0)),
        is_stale: now_ns - at_ns > STALE_NS,
        phase: word,
        is_waiting: phase == Phase::AtPoint || (phase == Phase::Driving && is_standing),
        mission: (mission != 0).then_some(mission),
        ..RobotPicture::default()
    };
    if let (Some(id), Some(scene)) = (robot.path_of(mission), scene)
        && let Some(path) = scene.world.paths.get(id)
    {
        let last = path.last_index();
        let here = usize::try_from(state.path_index).unwrap_or(0).min(last);
        let granted = granted(&state, path);
        let mut routes = scene.world.routes.iter();
        picture.path = Some(id.0);
        picture.goal = routes.find(|one| one.path == id).map(|route| route.to);
        picture.path_index = Some(here);
        picture.last_index = Some(last);
        picture.granted_index = granted;
        if matches!(phase, Phase::Driving | Phase::AtPoint) {
            picture.ahead = points(path, here, last, AHEAD_MAX);
        }
        if let Some(granted) = granted {
            let way_m = path.way_to_m(granted) - state.travelled_m;
            picture.granted_m = Some(rounded(way_m.max(0.0)));
            if granted > here {
                picture.granted = points(path, here, granted, AHEAD_MAX);
            }
        }
    }
    Some(picture)
}

#[cfg(test)]
#[path = "fleet_tests.rs"]
mod tests;
