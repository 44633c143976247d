//! The safe coordinator: acknowledged movement authority. It gives a robot only way that no other
//! robot may be on, whatever messages are lost, late, repeated or overtaken, and only as long as
//! every robot can still finish. It needs no clock but its own.
//!
//! - `ledger`: what a robot may hold, proved from its states.
//! - `reservation`: which poses each robot has to itself; the safety invariant.
//! - `liveness`: why every mission ends.
//! - `grants`: who gets how much in a control cycle.
//! - `horizon`: how much a robot needs so as not to brake for want of a message.
//! - `lease`: authorities that end by themselves, where delays have a measured bound.
//!
//! **Safety.** Let `G` be the ledger's bound of a robot and `l` the furthest pose it is known to
//! have passed. The robot never passes its authority by more than the stop margin `m`, so it is
//! within the poses `l..=G + m` now and until more is sent. The coordinator sends more only when
//! the poses added are apart from every other robot's `l..=G + m`, and lowers `G` only on proof.
//! So these ranges are apart at all times, and with them the robots (see `reservation`). For
//! each pair of overlapping poses at most one is ever granted.

mod grants;
mod horizon;
mod lease;
pub mod ledger;
mod liveness;
pub mod parameters;
pub mod reservation;
#[cfg(test)]
mod tests;

use core::time::Duration;
use std::sync::Arc;

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::safe::horizon::{CycleTime, RoundTrip};
use crate::coordinator::safe::lease::LeaseWatch;
use crate::coordinator::safe::ledger::{Ledger, StateEffect};
use crate::coordinator::safe::liveness::{Plan, StopMargin};
use crate::coordinator::safe::reservation::Traffic;
use crate::coordinator::{Cycle, Rules};
use crate::messages::{Authority, Header, State, TO_GOAL, ToRobot};
use crate::path::PathId;
use crate::section::Span;
use crate::world::World;
use hil_core::time::Instant;

/// The rules of the safe mode.
#[derive(Debug)]
pub(crate) struct SafeRules {
    world: Arc<World>,
    fleet_id: u32,
    control_period: Duration,
    cycles: CycleTime,
    patience: Duration,
    stuck_after: Duration,
    reserve_ms: f64,
    takes_back: bool,
    margin: StopMargin,
    traffic: Traffic,
    plan: Plan,
    robots: Vec<SafeRobot>,
    lease: LeaseWatch,
    counts: SafeCounts,
    order: Vec<grants::Candidate>,
    /// Per robot its place in `order`.
    places: Vec<Option<usize>>,
    /// The robots were parked apart at their guarded footprints. Where not, no plan holds for a
    /// mission of theirs, and none is admitted.
    starts_apart: bool,
}

/// What the safe rules know of a robot beyond its reservation.
#[derive(Debug, Clone)]
struct SafeRobot {
    /// The account of its mission; of the last one when it is parked.
    ledger: Ledger,
    /// The plan has its mission.
    is_admitted: bool,
    round_trip: RoundTrip,
    speed_mps: f64,
    header_id: u32,
    /// Since when it could use more authority and gets none, or is not admitted.
    waiting_since: Option<Instant>,
    /// Since when it had waited for the way it got last; `None` once it has come further. Should
    /// that way be taken back, it has waited since then.
    waited_since: Option<Instant>,
    /// Last time it was seen further on, or its mission given.
    moved: Instant,
    is_counted_stuck: bool,
    /// Robots that wait for this one, as of the last cycle.
    held_up_count: u32,
    /// Who stops it, as of the last cycle.
    stopped_by: Option<usize>,
    /// Authority was taken back from it; not again before.
    spared_until: Instant,
    /// When authority was last taken back.
    retracted: Instant,
    /// When the state that shows it furthest arrived.
    heard: Instant,
}

impl SafeRules {
    /// Rules for the robots of fleet `fleet_id` that stand in bays `starts`.
    pub(crate) fn new(
        world: &Arc<World>,
        starts: &[usize],
        parameters: &CoordinatorParameters,
        fleet_id: u32,
    ) -> Self {
        let margin = parameters.safe.stop_margin(world);
        let robot = SafeRobot {
            ledger: Ledger::new(0, 0),
            is_admitted: false,
            round_trip: RoundTrip::default(),
            speed_mps: 0.0,
            header_id: 0,
            waiting_since: None,
            waited_since: None,
            moved: Instant::ZERO,
            is_counted_stuck: false,
            held_up_count: 0,
            stopped_by: None,
            spared_until: Instant::ZERO,
            retracted: Instant::ZERO,
            heard: Instant::ZERO,
        };
        let traffic = Traffic::new(world, starts);
        Self {
            fleet_id,
            starts_apart: traffic.first_overlap().is_none(),
            control_period: parameters.control_period(),
            cycles: CycleTime::default(),
            patience: parameters.safe.patience(),
            stuck_after: parameters.stuck_after(),
            reserve_ms: parameters.safe.reserve_ms,
            takes_back: parameters.safe.takes_back,
            margin,
            traffic,
            plan: Plan::new(margin, starts.len()),
            robots: vec![robot; starts.len()],
            lease: LeaseWatch::new(&parameters.safe, parameters.clock_is_shared),
            counts: SafeCounts::default(),
            order: Vec::with_capacity(starts.len()),
            places: vec![None; starts.len()],
            world: Arc::clone(world),
        }
    }

    /// `robot` is given the mission `mission_id` along `path`.
    fn begin(&mut self, now: Instant, robot: usize, mission_id: u32, path: PathId) {
        let last = self.world.path(path).last_index();
        let view = &mut self.robots[robot];
        view.ledger = Ledger::new(mission_id, last);
        view.is_admitted = false;
        view.round_trip.forget_question();
        view.speed_mps = 0.0;
        (view.waiting_since, view.waited_since) = (None, None);
        view.moved = now;
        view.is_counted_stuck = false;
        self.plan.finish(robot);
        self.traffic.put(robot, path, Span::at(0));
    }

    /// Brings the reservation of `robot` in line with its account.
    fn update_span(&mut self, robot: usize) {
        let view = &self.robots[robot];
        let last = self.traffic.last(robot);
        let (lower, bound) = (view.ledger.lower(), view.ledger.bound());
        // A robot without authority stands on the pose it parked at, to the dot.
        let upper = if bound == 0 && lower == 0 {
            0
        } else {
            // One that went too far is at least between its last pose and the next.
            self.margin.upper(bound, last).max((lower + 1).min(last))
        };
        self.traffic.reserve(robot, Span { lower, upper });
    }

    fn send_all(&mut self, cycle: &mut Cycle<'_>) {
        for robot in 0..self.robots.len() {
            let renews = self.lease.renews(&self.robots[robot].ledger);
            if renews {
                let ledger = &mut self.robots[robot].ledger;
                // What was refused is not asked again; robots renew only what they apply.
                let index = if ledger.is_acknowledged() {
                    ledger.bound()
                } else {
                    ledger.newest().1
                };
                ledger.send(index);
            }
            let view = &mut self.robots[robot];
            let (sequence, index) = view.ledger.newest();
            if sequence == 0 || view.ledger.is_acknowledged() || view.ledger.is_done() {
                continue;
            }
            view.header_id = view.header_id.wrapping_add(1);
            view.round_trip.sent(cycle.now, sequence);
            let is_goal = index == self.traffic.last(robot);
            let to = i32::try_from(index).expect("paths have fewer than 2^31 poses");
            self.counts.messages += 1;
            (cycle.send)(ToRobot::Authority(Authority {
                header: Header {
                    fleet_id: self.fleet_id,
                    robot_id: u32::try_from(robot).expect("fewer than 2^32 robots"),
                    header_id: view.header_id,
                    mission_id: view.ledger.mission_id(),
                    sent_ns: cycle.now.as_ns(),
                },
                sequence,
                authority_index: if is_goal { TO_GOAL } else { to },
                lease_ns: self.lease.lease_ns(),
                echo_header_id: view.ledger.newest_header_id(),
                flags: Authority::ACKNOWLEDGED,
            }));
        }
    }

    /// Takes over missions that began or ended since the last cycle.
    fn follow_roster(&mut self, cycle: &Cycle<'_>) {
        for (robot, known) in cycle.roster.robots().iter().enumerate() {
            let Some(mission) = &known.mission else {
                continue;
            };
            if mission.id != self.robots[robot].ledger.mission_id() {
                self.begin(cycle.now, robot, mission.id, mission.route.path);
            }
        }
        for robot in 0..self.robots.len() {
            self.traffic.forget_passed(robot);
        }
        self.plan.drop_done(&self.traffic);
    }

    fn count_stuck(&mut self, now: Instant) {
        for view in &mut self.robots {
            let is_stuck = view.ledger.mission_id() != 0
                && !view.ledger.is_done()
                && now > view.moved + self.stuck_after;
            if is_stuck && !view.is_counted_stuck {
                view.is_counted_stuck = true;
                self.counts.stuck += 1;
            }
        }
    }
}

impl Rules for SafeRules {
    fn on_state(&mut self, now: Instant, state: &State) {
        let header = &state.header;
        let robot = header.robot_id as usize;
        if robot >= self.robots.len() || header.fleet_id != self.fleet_id || !state.is_sound() {
            return;
        }
        self.lease.on_state(now, state, &mut self.counts);
        let view = &mut self.robots[robot];
        let was_shrinking = view.ledger.is_shrinking();
        let was_lower = view.ledger.lower();
        let tells_place = state.path_index >= i32::try_from(was_lower).unwrap_or(i32::MAX)
            && header.mission_id == view.ledger.mission_id();
        let is_newest = header.header_id >= view.ledger.newest_header_id();
        let effect = view.ledger.on_state(state);
        // An impossible state raises no lower end, so it must not make the robot look nearer.
        if tells_place && effect != StateEffect::Impossible {
            view.heard = now;
        }
        match effect {
            StateEffect::Nothing => return,
            StateEffect::Impossible => {
                self.counts.states_impossible += 1;
                return;
            }
            StateEffect::Exceeded => self.counts.authorities_exceeded += 1,
            StateEffect::Refused => self.counts.shrinks_refused += 1,
            StateEffect::News => {
                let is_agreed = was_shrinking && !view.ledger.is_shrinking();
                self.counts.shrinks_acknowledged += u64::from(is_agreed);
            }
        }
        view.round_trip.shown(now, state.applied_sequence);
        if is_newest {
            view.speed_mps = f64::from(state.speed_mps);
        }
        if view.ledger.lower() > was_lower {
            view.moved = now;
            view.waited_since = None;
            view.is_counted_stuck = false;
        }
        let (lower, bound) = (view.ledger.lower(), view.ledger.bound());
        if lower >= bound + self.margin.above && lower < self.traffic.last(robot) {
            self.counts.margins_exceeded += 1;
        }
        let is_done = view.ledger.is_done();
        self.update_span(robot);
        if is_done {
            self.plan.finish(robot);
        }
    }

    fn decide(&mut self, cycle: &mut Cycle<'_>) {
        self.cycles.begin(cycle.now);
        self.follow_roster(cycle);
        self.expire_leases(cycle.now);
        self.grant_all(cycle);
        self.send_all(cycle);
        self.count_stuck(cycle.now);
        cycle.counters.safe = self.counts;
        debug_assert!(
            !self.starts_apart || self.traffic.first_overlap().is_none(),
            "reservations overlap: {:?}",
            self.traffic.first_overlap()
        );
    }

    fn reservations(&self) -> Option<&Traffic> {
        Some(&self.traffic)
    }

    fn resets_stuck_robots(&self) -> bool {
        false
    }
}
