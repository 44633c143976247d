//! What the coordinator knows of its robots: the newest states, their missions, the bays and the
//! sections ahead of them. It sends missions; who may go how far is decided elsewhere.

use core::time::Duration;
use std::collections::VecDeque;
use std::sync::Arc;

use crate::coordinator::counters::CoordinatorCounts;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::policy::Contender;
use crate::coordinator::sections::SectionBook;
use crate::messages::{Header, MessageOrder, Mission, Phase, State, ToRobot, first_id};
use crate::mission::MissionSource;
use crate::path::{Path, PathId};
use crate::scenario::Scene;
use crate::world::{BayIndex, Route, World};
use hil_core::time::Instant;

/// The robots of a fleet as their coordinator sees them.
#[derive(Debug)]
pub struct Roster {
    world: Arc<World>,
    /// The fleet's number.
    pub(crate) fleet_id: u32,
    message_order: MessageOrder,
    missions_per_cycle: u32,
    stuck_after: Duration,
    robots: Vec<RobotView>,
    /// The sections that driving robots have ahead of them.
    pub(crate) sections: SectionBook,
    /// Robots that stand in, leave or head for each bay.
    bay_users: Vec<u32>,
    /// Parked robots, the one that parked first in front.
    parked: VecDeque<usize>,
    next_reset: Instant,
}

/// After a reset, how long no other robot is reset: those it held up need time to show way.
const RESET_PAUSE: Duration = Duration::from_secs(10);

impl Roster {
    /// The robots of fleet `fleet_id`, each parked where the scene starts it.
    ///
    /// # Panics
    /// When a start is no bay of the world.
    pub fn new(scene: &Scene, parameters: &CoordinatorParameters, fleet_id: u32) -> Self {
        let mut bay_users = vec![0; scene.world.bays.len()];
        let mut robots = Vec::with_capacity(scene.starts.len());
        for &bay in &scene.starts {
            assert!(bay < bay_users.len(), "bay {bay} of {}", bay_users.len());
            bay_users[bay] += 1;
            robots.push(RobotView {
                bay,
                ..RobotView::default()
            });
        }
        Self {
            fleet_id,
            message_order: parameters.message_order,
            missions_per_cycle: parameters.missions_per_cycle,
            stuck_after: parameters.stuck_after(),
            sections: SectionBook::new(robots.len()),
            parked: (0..robots.len()).collect(),
            robots,
            bay_users,
            world: Arc::clone(&scene.world),
            next_reset: Instant::ZERO,
        }
    }

    /// Takes over what the robots have told a coordinator that knew nothing: per robot its state, and the bay it stands
    /// in if it had no mission. What they do not tell, when they began and how long they parked, counts from `now`.
    pub(crate) fn resume(
        &mut self,
        now: Instant,
        told: impl Iterator<Item = (Option<State>, Option<BayIndex>)>,
        missions: &mut MissionSource,
    ) {
        let world = Arc::clone(&self.world);
        self.bay_users.fill(0);
        self.parked.clear();
        for (robot, (state, bay)) in told.enumerate() {
            let Some(state) = state else {
                continue;
            };
            let mission_id = state.header.mission_id;
            let path = PathId(state.path_id);
            let route = world.routes.iter().find(|route| route.path == path);
            let view = &mut self.robots[robot];
            view.newest_mission_id = mission_id;
            view.mission_header_id = first_id(now);
            missions.resume(robot, mission_id);
            let bay = match (mission_id, route) {
                (1.., Some(route)) if state.phase != Phase::Done as u8 => {
                    self.resume_mission(now, robot, mission_id, *route, &state);
                    continue;
                }
                (1.., Some(route)) => {
                    view.parked_since = Some(now);
                    route.to
                }
                _ => bay.unwrap_or(view.bay),
            };
            view.bay = bay;
            self.bay_users[bay] += 1;
            self.parked.push_back(robot);
        }
    }

    fn resume_mission(&mut self, now: Instant, robot: usize, id: u32, route: Route, state: &State) {
        self.bay_users[route.from] += 1;
        self.robots[robot].bay = route.from;
        self.set_out(now, robot, id, route);
        self.robots[robot].take(now, state);
    }

    /// Every robot, by number.
    pub fn robots(&self) -> &[RobotView] {
        &self.robots
    }

    /// Takes over a robot's state, if it is one of the robot's present mission.
    pub fn on_state(&mut self, now: Instant, state: &State, counts: &mut CoordinatorCounts) {
        let header = &state.header;
        let Some(view) = view_of(&mut self.robots, self.fleet_id, header) else {
            counts.states_unknown += 1;
            return;
        };
        if !state.is_sound() {
            counts.states_unsound += 1;
            return;
        }
        let order = view
            .newest_header_id
            .map_or(1, |newest| ahead_of(header.header_id, newest));
        match order {
            0 => counts.states_duplicate += 1,
            ..0 => counts.states_reordered += 1,
            1.. => view.newest_header_id = Some(header.header_id),
        }
        if order <= 0 && self.message_order == MessageOrder::Strict {
            counts.states_dropped += 1;
            return;
        }
        self.observe(now, state, counts);
    }

    /// The same for a state that came by no channel, so that it has no place in the order of
    /// messages: what a coordinator that looks at the simulated robots themselves sees.
    pub fn observe(&mut self, now: Instant, state: &State, counts: &mut CoordinatorCounts) {
        let header = &state.header;
        let Some(view) = view_of(&mut self.robots, self.fleet_id, header)
            .filter(|view| ahead_of(header.mission_id, view.newest_mission_id) <= 0)
        else {
            counts.states_unknown += 1;
            return;
        };
        let mission = view.mission.as_ref();
        let Some(mission) = mission.filter(|mission| mission.id == header.mission_id) else {
            counts.states_outdated += 1;
            return;
        };
        let last_index = mission.path.last_index();
        let is_on_path = usize::try_from(state.path_index).is_ok_and(|index| index <= last_index);
        if is_on_path && state.is_sound() {
            counts.states_accepted += 1;
            view.take(now, state);
        } else {
            counts.states_unsound += 1;
        }
    }

    /// Draws the consequences of the states since the last cycle: missions that ended, sections
    /// that were passed, bays that were left.
    pub fn settle(&mut self, counts: &mut CoordinatorCounts) {
        for robot in 0..self.robots.len() {
            let view = &mut self.robots[robot];
            let index = view.index();
            let has_moved = core::mem::take(&mut view.has_moved);
            let Some(mission) = &mut view.mission else {
                continue;
            };
            if index >= mission.clear_index && !mission.has_left_bay {
                mission.has_left_bay = true;
                self.bay_users[mission.route.from] -= 1;
            }
            if mission.done_at.is_some() {
                self.finish(robot, counts);
            } else if has_moved {
                counts.sections_obsolete += self.sections.remove_passed(robot, index);
            }
        }
    }

    fn finish(&mut self, robot: usize, counts: &mut CoordinatorCounts) {
        let view = &mut self.robots[robot];
        let Some(mission) = view.mission.take() else {
            return;
        };
        let removed_count = self.sections.remove_all(robot);
        if mission.is_reset {
            counts.sections_abandoned += removed_count;
        } else {
            counts.sections_obsolete += removed_count;
        }
        if !mission.has_left_bay {
            self.bay_users[mission.route.from] -= 1;
        }
        counts.missions_done += 1;
        view.bay = mission.route.to;
        view.parked_since = mission.done_at;
        view.state = None;
        view.waiting_since = None;
        self.parked.push_back(robot);
    }

    /// Begins missions of robots that parked long enough and repeats those no state showed yet.
    pub fn dispatch(
        &mut self,
        now: Instant,
        missions: &mut MissionSource,
        send: &mut dyn FnMut(ToRobot),
    ) {
        let parking = missions.parking;
        let mut begun_count = 0;
        let mut position = 0;
        while begun_count < self.missions_per_cycle
            && let Some(&robot) = self.parked.get(position)
        {
            let view = &self.robots[robot];
            let is_rested = view.parked_since.is_none_or(|since| now >= since + parking);
            if !is_rested {
                // Those behind it parked later still.
                break;
            }
            let bay_users = &self.bay_users;
            let is_free = |bay: BayIndex| bay_users.get(bay) == Some(&0);
            let route = missions.next(robot, view.bay, &is_free);
            let Some(route) = route.filter(|route| route.from == view.bay && is_free(route.to))
            else {
                position += 1;
                continue;
            };
            self.parked.remove(position);
            self.begin(now, robot, route);
            begun_count += 1;
        }
        for (robot_id, view) in (0..).zip(&mut self.robots) {
            let needs_repeat = |mission: &ActiveMission| !mission.is_shown || mission.is_reset;
            if view.mission.as_ref().is_some_and(needs_repeat) {
                send(view.mission_message(now, self.fleet_id, robot_id));
            }
        }
    }

    fn begin(&mut self, now: Instant, robot: usize, route: Route) {
        let view = &mut self.robots[robot];
        view.newest_mission_id += 1;
        let id = view.newest_mission_id;
        self.set_out(now, robot, id, route);
    }

    fn set_out(&mut self, now: Instant, robot: usize, id: u32, route: Route) {
        let world = Arc::clone(&self.world);
        let path = world.path(route.path);
        let view = &mut self.robots[robot];
        view.state = None;
        view.waiting_since = None;
        view.has_moved = false;
        view.mission = Some(ActiveMission {
            id,
            route,
            path: Arc::clone(path),
            started: now,
            is_shown: false,
            is_reset: false,
            clear_index: clear_index(&world, route.from, path),
            has_left_bay: false,
            done_at: None,
            best_index: 0,
            last_progress: now,
        });
        self.bay_users[route.to] += 1;
        for other in (0..self.robots.len()).filter(|&other| other != robot) {
            let view = &self.robots[other];
            let Some(mission) = &view.mission else {
                continue;
            };
            let (theirs, index) = (mission.route.path, view.index());
            let (robots, paths, indices) = if robot < other {
                ([robot, other], [route.path, theirs], [0, index])
            } else {
                ([other, robot], [theirs, route.path], [index, 0])
            };
            let sections = world.sections.between(paths[0], paths[1]);
            self.sections.add(robots, sections, indices);
        }
    }

    /// Puts the robot that made no way for the longest time at its goal, if that time is too
    /// long; at most one per pause. The mission goes out again, marked, until a state shows it.
    pub fn reset_stuck(
        &mut self,
        now: Instant,
        counts: &mut CoordinatorCounts,
        send: &mut dyn FnMut(ToRobot),
    ) {
        if now < self.next_reset {
            return;
        }
        let stalled = (0..).zip(&mut self.robots).filter_map(|(robot_id, view)| {
            let mission = view.mission.as_ref()?;
            let stalled_ns = now.ns_since(mission.last_progress);
            (!mission.is_reset).then_some((stalled_ns, robot_id, view))
        });
        let longest = stalled.max_by_key(|(stalled_ns, ..)| *stalled_ns);
        let Some((stalled_ns, robot_id, view)) = longest else {
            return;
        };
        if i128::from(stalled_ns) <= self.stuck_after.as_nanos().cast_signed() {
            return;
        }
        if let Some(mission) = &mut view.mission {
            mission.is_reset = true;
        }
        counts.resets += 1;
        self.next_reset = now + RESET_PAUSE;
        send(view.mission_message(now, self.fleet_id, robot_id));
    }
}

/// The robot a message names, if it is one of fleet `fleet_id`.
fn view_of<'a>(
    robots: &'a mut [RobotView],
    fleet_id: u32,
    header: &Header,
) -> Option<&'a mut RobotView> {
    robots
        .get_mut(header.robot_id as usize)
        .filter(|_| header.fleet_id == fleet_id)
}

/// How far header `id` is ahead of `newest`, across the wrap of the counter.
fn ahead_of(id: u32, newest: u32) -> i32 {
    id.wrapping_sub(newest).cast_signed()
}

/// First pose of `path` at which a vehicle no longer meets one parked in `bay`.
fn clear_index(world: &World, bay: BayIndex, path: &Path) -> usize {
    let footprint = &world.vehicle.footprint;
    let parked = footprint.at(&world.bays[bay].pose);
    path.poses()
        .iter()
        .position(|pose| !footprint.at(pose).overlaps(&parked))
        .unwrap_or(path.last_index())
}

/// A mission on its way.
#[derive(Debug, Clone)]
pub struct ActiveMission {
    /// Its number, from 1, per robot.
    pub id: u32,
    /// From where to where, on which path.
    pub route: Route,
    /// The path's poses.
    pub path: Arc<Path>,
    /// When it was first sent.
    pub started: Instant,
    /// A state showed it.
    pub is_shown: bool,
    /// The robot was told to stand at its goal at once.
    pub is_reset: bool,
    /// First pose at which the robot is clear of the bay it left.
    pub(super) clear_index: usize,
    pub(super) has_left_bay: bool,
    /// When a state first showed the goal reached.
    pub(super) done_at: Option<Instant>,
    pub(super) best_index: usize,
    pub(super) last_progress: Instant,
}

/// What the coordinator knows of one robot.
#[derive(Debug, Clone, Default)]
pub struct RobotView {
    /// Newest state of the present mission; `None` before the first.
    pub state: Option<State>,
    /// The mission; `None` while the robot is parked.
    pub mission: Option<ActiveMission>,
    /// Where it is parked, or where its mission began.
    pub bay: BayIndex,
    /// When its last mission ended; `None` before the first.
    pub parked_since: Option<Instant>,
    /// Since when it stands at the end of its authority.
    pub waiting_since: Option<Instant>,
    pub(super) newest_header_id: Option<u32>,
    pub(super) newest_mission_id: u32,
    pub(super) mission_header_id: u32,
    /// The index changed since the sections were last looked at.
    pub(super) has_moved: bool,
}

impl RobotView {
    /// Last pose of its path the robot reported to have passed; 0 before the first report.
    pub fn index(&self) -> usize {
        self.state
            .map_or(0, |state| usize::try_from(state.path_index).unwrap_or(0))
    }

    /// Last pose of its mission's path; 0 without a mission.
    pub fn last_index(&self) -> usize {
        self.mission
            .as_ref()
            .map_or(0, |mission| mission.path.last_index())
    }

    /// The robot as an ordering policy sees it before a section that starts at `start`.
    pub fn contender(&self, robot: usize, start: usize) -> Contender {
        let index = self.index();
        Contender {
            robot,
            index,
            speed_mps: self.state.map_or(0.0, |state| f64::from(state.speed_mps)),
            to_start: start.saturating_sub(index),
            path_poses_left: self.last_index().saturating_sub(index),
            mission_started: self
                .mission
                .as_ref()
                .map_or(Instant::ZERO, |mission| mission.started),
            waiting_since: self.waiting_since,
            held_up_count: 0,
        }
    }

    /// The message of the present mission; without one, of mission 0, which robots ignore.
    pub(super) fn mission_message(
        &mut self,
        now: Instant,
        fleet_id: u32,
        robot_id: u32,
    ) -> ToRobot {
        self.mission_header_id = self.mission_header_id.wrapping_add(1);
        let mut message = Mission {
            header: Header {
                fleet_id,
                robot_id,
                header_id: self.mission_header_id,
                mission_id: 0,
                sent_ns: now.as_ns(),
            },
            ..Mission::default()
        };
        if let Some(mission) = &self.mission {
            message.header.mission_id = mission.id;
            message.path_id = mission.route.path.0;
            message.end_index = u32::try_from(mission.path.last_index()).unwrap_or(u32::MAX);
            message.flags = u32::from(mission.is_reset) * Mission::REPLACE;
            message.path_hash = mission.path.hash();
        }
        ToRobot::Mission(message)
    }

    pub(super) fn take(&mut self, now: Instant, state: &State) {
        let old_index = self.index();
        self.state = Some(*state);
        let index = self.index();
        self.has_moved |= index != old_index;
        match Phase::from_number(state.phase) {
            Some(Phase::AtPoint) => self.waiting_since = self.waiting_since.or(Some(now)),
            _ => self.waiting_since = None,
        }
        let Some(mission) = &mut self.mission else {
            return;
        };
        mission.is_shown = true;
        if index > mission.best_index {
            mission.best_index = index;
            mission.last_progress = now;
        }
        if Phase::from_number(state.phase) == Some(Phase::Done) {
            mission.done_at.get_or_insert(now);
        }
    }
}

#[cfg(test)]
#[path = "roster_tests.rs"]
mod tests;
