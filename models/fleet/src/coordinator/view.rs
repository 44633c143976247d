//! What the coordinator knows of one robot and of its mission. It judges nothing.

use std::sync::Arc;

use crate::coordinator::policy::Contender;
use crate::messages::{Header, Mission, Phase, State, ToRobot};
use crate::path::Path;
use crate::world::{BayIndex, Route};
use hil_core::time::Instant;

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
        match Phase::of(state.phase) {
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
        if Phase::of(state.phase) == Some(Phase::Done) {
            mission.done_at.get_or_insert(now);
        }
    }
}
