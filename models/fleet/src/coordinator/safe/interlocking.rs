//! The decisions of the safe mode: who may be where, and what is said to whom. Whole numbers only; it knows neither
//! time nor motion nor merit. What runs and what is searched exhaustively (`search_tests`) are this type.
//!
//! **Who knows what.** A coordinator that starts, for the first time or again, knows nothing. It asks every robot; the
//! *question* is a number that grows from start to start. A robot that hears a newer question answers it in each state
//! from then on, and takes no command any more that rests on an earlier state (`robot::authority::Holder`). So a state
//! that answers the question tells what the robot holds, and nothing sent before, by whomever, can change that. Until
//! every robot has answered, no mission and no authority is given: what robots still hold was kept apart by the
//! coordinator before.
//!
//! A robot that restarts has forgotten its authority and the question, brakes, and takes no command that rests on a
//! state of the time before. Its states answer no question then and are passed over, so the way it had stays its own.

use std::hash::{Hash, Hasher};
use std::sync::Arc;

use crate::coordinator::safe::ledger::{Ledger, StateEffect};
use crate::coordinator::safe::liveness::{Plan, StopMargin, section_start};
use crate::coordinator::safe::reservation::Traffic;
use crate::messages::{Authority, Header, Mission, State, TO_GOAL};
use crate::path::PathId;
use crate::robot::authority::is_newer;
use crate::section::Span;
use crate::world::{BayIndex, World};

/// All robots of a fleet: what each may hold and has to itself, and the order in which all can finish.
#[derive(Debug, Clone)]
pub(crate) struct Interlocking {
    world: Arc<World>,
    pub(crate) margin: StopMargin,
    pub(crate) traffic: Traffic,
    pub(crate) plan: Plan,
    pub(crate) members: Vec<Member>,
    question: u32,
    /// All have answered.
    is_complete: bool,
    /// All stood apart, at their guarded footprints, when the last one answered.
    pub(crate) stands_apart: bool,
}

/// One robot.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Member {
    /// The account of its mission; of the last one when it is parked.
    pub(crate) ledger: Ledger,
    /// The plan has its mission.
    pub(crate) is_admitted: bool,
    /// `header_id` of the state with which it answered first; `None` before.
    answered: Option<u32>,
    /// `header_id` of the newest state that answers; commands rest on it.
    pub(crate) newest_header_id: u32,
}

/// What a state did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Heard {
    /// It does not answer the question, or is older than the first answer.
    PassedOver,
    /// A robot that had answered does no more: it has restarted.
    Restarted,
    /// It answers first, but says what cannot be, or the robot stands outside every bay without a mission.
    Unplaced,
    /// The robot has answered first.
    Answered,
    /// What it did to the robot's account.
    Known(StateEffect),
}

/// Result of an extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Extension {
    pub(crate) is_given: bool,
    /// Whose reservation ends the way.
    pub(crate) stopped_by: Option<usize>,
    /// Ends not given because no order was found in which all could still finish.
    pub(crate) withheld_count: u64,
}

/// Ends that are tried for one extension, each nearer than the one before.
const ENDS_MAX: usize = 4;

impl Interlocking {
    /// A coordinator of `robot_count` robots that knows nothing of them and asks `question`.
    pub(crate) fn new(
        world: &Arc<World>,
        margin: StopMargin,
        robot_count: usize,
        question: u32,
    ) -> Self {
        let member = Member {
            ledger: Ledger::new(0, 0),
            is_admitted: false,
            answered: None,
            newest_header_id: 0,
        };
        Self {
            traffic: Traffic::new(world, robot_count),
            plan: Plan::new(margin, robot_count),
            members: vec![member; robot_count],
            world: Arc::clone(world),
            margin,
            question,
            is_complete: false,
            stands_apart: false,
        }
    }

    /// True once every robot has answered; before, nothing is given.
    pub(crate) fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// The question to `robot`, until it has answered.
    pub(crate) fn question(&self, robot: usize) -> Option<Authority> {
        self.members[robot].answered.is_none().then(|| Authority {
            header: header(robot, 0),
            sequence: self.question,
            flags: Authority::ACKNOWLEDGED | Authority::QUESTION,
            ..Authority::default()
        })
    }

    /// The newest authority of `robot`, until a state shows it.
    pub(crate) fn command(&self, robot: usize) -> Option<Authority> {
        let member = &self.members[robot];
        let (sequence, index) = member.ledger.newest();
        if sequence == 0 || member.ledger.is_acknowledged() || member.ledger.is_done() {
            return None;
        }
        let is_goal = index == self.traffic.last(robot);
        let to = i32::try_from(index).expect("paths have fewer than 2^31 poses");
        Some(Authority {
            header: header(robot, member.ledger.mission_id()),
            sequence,
            authority_index: if is_goal { TO_GOAL } else { to },
            echo_header_id: member.newest_header_id,
            flags: Authority::ACKNOWLEDGED,
            ..Authority::default()
        })
    }

    /// Makes a mission one that rests on the newest state of its robot.
    pub(crate) fn address(&self, mission: &mut Mission) {
        mission.flags |= Mission::ACKNOWLEDGED;
        let member = self.members.get(mission.header.robot_id as usize);
        mission.echo_header_id = member.map_or(0, |member| member.newest_header_id);
    }

    /// Takes over what a state of `robot` proves. `bay` tells in which bay the robot stands, if in any.
    pub(crate) fn on_state(
        &mut self,
        robot: usize,
        state: &State,
        bay: impl FnOnce() -> Option<BayIndex>,
    ) -> Heard {
        let member = &mut self.members[robot];
        let header_id = state.header.header_id;
        let is_newest = is_newer(header_id, member.newest_header_id);
        if state.answered != self.question {
            let has_forgotten = member.answered.is_some() && is_newest;
            return if has_forgotten {
                Heard::Restarted
            } else {
                Heard::PassedOver
            };
        }
        match member.answered {
            None => self.on_answer(robot, state, bay()),
            Some(first) if is_newer(first, header_id) => Heard::PassedOver,
            Some(_) => {
                if is_newest {
                    member.newest_header_id = header_id;
                }
                let effect = member.ledger.on_state(state);
                if !matches!(effect, StateEffect::Nothing | StateEffect::Impossible) {
                    self.update_span(robot);
                    if self.members[robot].ledger.is_done() {
                        self.plan.finish(robot);
                    }
                }
                Heard::Known(effect)
            }
        }
    }

    fn on_answer(&mut self, robot: usize, state: &State, bay: Option<BayIndex>) -> Heard {
        if state.header.mission_id == 0 {
            let Some(bay) = bay else {
                return Heard::Unplaced;
            };
            self.traffic.park(robot, bay);
        } else {
            let path = PathId(state.path_id);
            let last = self.world.paths.get(path).map(|path| path.last_index());
            let Some(ledger) = last.and_then(|last| Ledger::shown(last, state)) else {
                return Heard::Unplaced;
            };
            self.members[robot].ledger = ledger;
            self.traffic.put(robot, path, Span::at(0));
            self.update_span(robot);
        }
        let member = &mut self.members[robot];
        member.answered = Some(state.header.header_id);
        member.newest_header_id = state.header.header_id;
        self.is_complete = self.members.iter().all(|member| member.answered.is_some());
        if self.is_complete {
            self.stands_apart = self.traffic.first_overlap().is_none();
        }
        Heard::Answered
    }

    /// The robots that are to be admitted still.
    fn is_waiting(&self, robot: usize) -> bool {
        let member = &self.members[robot];
        !member.is_admitted && member.ledger.mission_id() != 0 && !member.ledger.is_done()
    }

    /// `robot`, which is parked, is given the mission `mission_id` along `path`.
    pub(crate) fn begin(&mut self, robot: usize, mission_id: u32, path: PathId) {
        let last = self.world.path(path).last_index();
        let member = &mut self.members[robot];
        member.ledger = Ledger::new(mission_id, last);
        member.is_admitted = false;
        self.plan.finish(robot);
        self.traffic.put(robot, path, Span::at(0));
    }

    /// Takes in the missions that a plan is found for; gives, per robot with a mission that is not taken in, a call of
    /// `deferred`.
    pub(crate) fn admit_all(&mut self, may_reorder: bool, mut deferred: impl FnMut(usize)) {
        if !self.is_complete {
            return;
        }
        // Robots that were under way when the coordinator started have no order yet: they get one together.
        let is_under_way =
            |robot: usize| self.is_waiting(robot) && self.traffic.span(robot) != Span::at(0);
        let under_way: Vec<usize> = (0..self.members.len())
            .filter(|&robot| is_under_way(robot))
            .collect();
        if !under_way.is_empty() && self.plan.admit_together(&self.traffic, &under_way) {
            for &robot in &under_way {
                self.members[robot].is_admitted = true;
            }
        }
        for robot in 0..self.members.len() {
            if !self.is_waiting(robot) {
                continue;
            }
            let is_at_start = self.traffic.span(robot) == Span::at(0);
            let is_admitted = is_at_start && self.plan.admit(&self.traffic, robot, may_reorder);
            self.members[robot].is_admitted = is_admitted;
            if !is_admitted {
                deferred(robot);
            }
        }
    }

    /// Drops what is over: sections passed, moves done.
    pub(crate) fn forget_passed(&mut self) {
        for robot in 0..self.members.len() {
            self.traffic.forget_passed(robot);
        }
        self.plan.drop_done(&self.traffic);
    }

    /// True when `robot` may be given more way at all.
    pub(crate) fn is_open(&self, robot: usize) -> bool {
        let member = &self.members[robot];
        let ledger = &member.ledger;
        self.is_complete
            && member.is_admitted
            && !ledger.is_done()
            && !ledger.is_shrinking()
            && ledger.bound() < self.traffic.last(robot)
    }

    /// Gives `robot`, which is open, as much of the way to `want` as it may have.
    pub(crate) fn extend(&mut self, robot: usize, want: usize, may_reorder: bool) -> Extension {
        let mut extension = Extension::default();
        let (last, margin) = (self.traffic.last(robot), self.margin);
        let bound = self.members[robot].ledger.bound();
        let from = self.traffic.span(robot).upper + 1;
        let to = margin.upper(want, last);
        let conflict = self
            .traffic
            .first_conflict(robot, from, to, &self.traffic.spans);
        let mut end = want;
        if let Some((index, other)) = conflict {
            extension.stopped_by = Some(other);
            end = (index - 1).saturating_sub(margin.poses);
        }
        let free_end = end;
        for _ in 0..ENDS_MAX {
            if end <= bound {
                break;
            }
            let upper = margin.upper(end, last);
            if self.plan.extend(&self.traffic, robot, upper, may_reorder) {
                extension.is_given = self.send(robot, end);
                return extension;
            }
            extension.withheld_count += 1;
            let start = section_start(self.traffic.contacts(robot), upper);
            end = start.saturating_sub(margin.poses + 1);
        }
        // What the plan itself foresees next is always possible.
        let planned = self.plan.next_end(robot).map_or(0, |end| end.min(free_end));
        if planned > bound {
            let upper = margin.upper(planned, last);
            if self.plan.extend(&self.traffic, robot, upper, false) {
                extension.is_given = self.send(robot, planned);
            }
        }
        extension
    }

    /// Asks `robot` to keep its way down to `end`; false when too much is unanswered.
    pub(crate) fn shrink(&mut self, robot: usize, end: usize) -> bool {
        self.members[robot].ledger.send(end).is_some()
    }

    fn send(&mut self, robot: usize, end: usize) -> bool {
        let is_sent = self.members[robot].ledger.send(end).is_some();
        if is_sent {
            self.update_span(robot);
        }
        is_sent
    }

    /// Brings the reservation of `robot` in line with its account.
    fn update_span(&mut self, robot: usize) {
        let ledger = &self.members[robot].ledger;
        let last = self.traffic.last(robot);
        let (lower, bound) = (ledger.lower(), ledger.bound());
        // A robot without authority stands on the pose it parked at, to the dot.
        let upper = if bound == 0 && lower == 0 {
            0
        } else {
            // One that went too far is at least between its last pose and the next.
            self.margin.upper(bound, last).max((lower + 1).min(last))
        };
        self.traffic.reserve(robot, Span { lower, upper });
    }
}

fn header(robot: usize, mission_id: u32) -> Header {
    Header {
        robot_id: u32::try_from(robot).expect("fewer than 2^32 robots"),
        mission_id,
        ..Header::default()
    }
}

/// The world is one and the same, and scratch space says nothing.
impl PartialEq for Interlocking {
    fn eq(&self, other: &Self) -> bool {
        self.members == other.members
            && self.traffic == other.traffic
            && self.plan == other.plan
            && self.question == other.question
    }
}

impl Eq for Interlocking {}

impl Hash for Interlocking {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.members.hash(state);
        self.traffic.hash(state);
        self.plan.hash(state);
        self.question.hash(state);
    }
}

#[cfg(test)]
impl Member {
    /// The header ids it keeps: of its first answer, and the newest.
    pub(crate) fn header_ids(&mut self) -> (Option<&mut u32>, &mut u32) {
        (self.answered.as_mut(), &mut self.newest_header_id)
    }
}

#[cfg(test)]
impl Interlocking {
    /// A planted fault: takes over what was planted in the account of `robot`.
    pub(crate) fn plant_span(&mut self, robot: usize) {
        self.update_span(robot);
    }
}
