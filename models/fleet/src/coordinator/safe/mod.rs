//! The safe coordinator: acknowledged movement authority. It gives a robot only way that no other
//! robot may be on, whatever messages are lost, late, repeated or overtaken, and only as long as
//! every robot can still finish. It needs no clock but its own.
//!
//! - `ledger`: what a robot may hold, proved from its states.
//! - `reservation`: which poses each robot has to itself; the safety invariant.
//! - `liveness`: why every mission ends.
//! - `grants`: who gets how much in a control cycle.
//! - `RoundTrip`, `CycleTime`: how much a robot needs so as not to brake for want of a message.
//!
//! **Safety.** Let `G` be the ledger's bound of a robot and `l` the furthest pose it is known to
//! have passed. The robot never passes its authority by more than the stop margin `m`, so it is
//! within the poses `l..=G + m` now and until more is sent. The coordinator sends more only when
//! the poses added are apart from every other robot's `l..=G + m`, and lowers `G` only on proof.
//! So these ranges are apart at all times, and with them the robots (see `reservation`). For
//! each pair of overlapping poses at most one is ever granted.

mod grants;
pub mod ledger;
mod liveness;
pub mod reservation;
#[cfg(test)]
mod tests;

use core::time::Duration;
use std::sync::Arc;

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::safe::ledger::{Ledger, StateEffect};
use crate::coordinator::safe::liveness::{Plan, StopMargin};
use crate::coordinator::safe::reservation::Traffic;
use crate::coordinator::{Cycle, Rules};
use crate::geometry::floor_index;
use crate::messages::{Authority, Header, State, TO_GOAL, ToRobot};
use crate::path::PathId;
use crate::section::Span;
use crate::world::{Vehicle, World};
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
            let view = &mut self.robots[robot];
            let (sequence, index) = view.ledger.newest();
            if sequence == 0 || view.ledger.is_acknowledged() || view.ledger.is_done() {
                continue;
            }
            view.header_id = view.header_id.wrapping_add(1);
            view.round_trip.sent(cycle.now, sequence);
            let is_goal = index == self.traffic.last(robot);
            let to = i32::try_from(index).expect("paths have fewer than 2^31 poses");
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
                echo_header_id: view.ledger.newest_header_id(),
                flags: Authority::ACKNOWLEDGED,
                ..Authority::default()
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
        let view = &mut self.robots[robot];
        let was_lower = view.ledger.lower();
        let is_newest = header.header_id >= view.ledger.newest_header_id();
        let effect = view.ledger.on_state(state);
        match effect {
            StateEffect::Nothing => return,
            StateEffect::Impossible => {
                self.counts.states_impossible += 1;
                return;
            }
            StateEffect::Exceeded => self.counts.authorities_exceeded += 1,
            StateEffect::Refused | StateEffect::News => {}
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

/// Time from sending an authority to the first state that shows it, as seen by the sender alone,
/// so that no clocks are compared. It follows a longer one at once and a shorter one slowly.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RoundTrip {
    estimate_s: f64,
    asked: Option<(u32, Instant)>,
}

/// A peer that is silent for longer is not waited for with ever more authority.
const ROUND_TRIP_MAX_S: f64 = 10.0;
/// Part of the difference by which a shorter round trip lowers the estimate.
const DECAY: f64 = 0.1;

impl RoundTrip {
    /// An authority with a new sequence is sent; one is timed at a time.
    pub(crate) fn sent(&mut self, now: Instant, sequence: u32) {
        if self.asked.is_none() {
            self.asked = Some((sequence, now));
        }
    }

    /// A state shows `sequence` applied.
    pub(crate) fn shown(&mut self, now: Instant, sequence: u32) {
        let Some((asked, at)) = self.asked else {
            return;
        };
        if sequence < asked {
            return;
        }
        self.asked = None;
        let sample_s = now.seconds_since(at).clamp(0.0, ROUND_TRIP_MAX_S);
        self.estimate_s = follow(self.estimate_s, sample_s);
    }

    /// A new mission numbers its authorities anew; the estimate is kept.
    pub(crate) fn forget_question(&mut self) {
        self.asked = None;
    }
}

/// Time from one control cycle to the next as it really is: a host that overruns its period gives
/// authority less often, so robots need more of it at once.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CycleTime {
    estimate_s: f64,
    last: Option<Instant>,
}

impl CycleTime {
    /// A cycle begins.
    pub(crate) fn begin(&mut self, now: Instant) {
        if let Some(last) = self.last.replace(now) {
            let sample_s = now.seconds_since(last).clamp(0.0, ROUND_TRIP_MAX_S);
            self.estimate_s = follow(self.estimate_s, sample_s);
        }
    }

    /// What to expect, at least the nominal period.
    pub(crate) fn expected_s(&self, nominal: Duration) -> f64 {
        self.estimate_s.max(nominal.as_secs_f64())
    }
}

/// Follows a larger sample at once and a smaller one slowly.
fn follow(estimate_s: f64, sample_s: f64) -> f64 {
    sample_s.max(estimate_s + DECAY * (sample_s - estimate_s))
}

/// Way a robot at `speed_mps` makes at most in `time_s`, and then needs to stop.
pub(crate) fn reach_m(vehicle: &Vehicle, speed_mps: f64, time_s: f64) -> f64 {
    let (speed_max_mps, acceleration_mps2) = (vehicle.speed_max_mps, vehicle.acceleration_mps2);
    let speed_mps = speed_mps.clamp(0.0, speed_max_mps);
    let accelerating_s = ((speed_max_mps - speed_mps) / acceleration_mps2).min(time_s);
    let end_mps = speed_mps + acceleration_mps2 * accelerating_s;
    0.5 * (speed_mps + end_mps) * accelerating_s
        + end_mps * (time_s - accelerating_s)
        + end_mps * end_mps / (2.0 * acceleration_mps2)
}

/// Seconds until an authority sent a control cycle from now is sure to be at the robot, counted
/// from when the state known now was sampled.
pub(crate) fn lookahead_s(cycle_s: f64, round_trip_s: f64, reserve_ms: f64) -> f64 {
    cycle_s + round_trip_s + 1e-3 * reserve_ms
}

hil_core::parameters! {
    /// `[case.parameters.coordinator.safe]`.
    #[derive(Copy)]
    pub struct SafeParameters in "coordinator.safe." {
        /// How far robots may stop from the end of their authority, m; 0 for the exact
        /// tracker, [`RobotParameters::stop_error_bound_m`](crate::robot::RobotParameters::stop_error_bound_m) for the stepped one.
        stop_error_m: f64 = 0.0, in 0.0..=1000.0;
        /// Authority beyond what a robot needs in order not to brake before the next one comes, as
        /// time at its speed, ms.
        reserve_ms: f64 = 200.0, in 0.0..=60_000.0;
        /// How long a robot waits before the order of all is kept until it is through, s.
        patience_s: f64 = 60.0, in 1.0..=100_000.0;
        /// Take authority back, by acknowledged shrinks, where the policy prefers another robot.
        takes_back: bool = true;
    }
}

impl SafeParameters {
    /// See [`SafeParameters::patience_s`].
    pub fn patience(&self) -> Duration {
        Duration::from_secs_f64(self.patience_s)
    }

    /// The stop error in poses of `world`'s paths, one pose for rounding added.
    pub(crate) fn stop_margin(&self, world: &World) -> StopMargin {
        let spacing_m = world
            .paths
            .ids()
            .filter_map(|id| world.paths.get(id))
            .map(|path| path.spacing_m())
            .fold(f64::INFINITY, f64::min);
        let poses = floor_index((self.stop_error_m / spacing_m).ceil()) + 1;
        StopMargin {
            below: poses,
            above: poses,
        }
    }
}

#[cfg(test)]
mod horizon_tests {
    use super::*;
    use crate::geometry::Footprint;

    const CART: Vehicle = Vehicle {
        footprint: Footprint {
            length_m: 2.0,
            width_m: 0.5,
        },
        speed_max_mps: 2.0,
        acceleration_mps2: 1.0,
    };

    #[test]
    fn reach_follows_its_closed_form() {
        let check = |speed, time, expected: f64| {
            let reach = reach_m(&CART, speed, time);
            assert!((reach - expected).abs() < 1e-12, "{reach} {expected}");
        };
        check(2.0, 0.0, 2.0);
        check(2.0, 1.5, 5.0);
        check(0.0, 1.0, 1.0);
        check(0.0, 3.0, 2.0 + 2.0 + 2.0);
    }

    #[test]
    fn cycles_that_overrun_count_as_long_as_they_are() {
        let mut cycles = CycleTime::default();
        let nominal = Duration::from_secs(1);
        for s in [0, 1, 2, 6] {
            cycles.begin(Instant::from_ns(s * 1_000_000_000));
        }
        assert!((cycles.expected_s(nominal) - 4.0).abs() < 1e-12);
        for s in 7..100 {
            cycles.begin(Instant::from_ns(s * 1_000_000_000));
        }
        assert!((cycles.expected_s(nominal) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_longer_round_trip_counts_at_once_and_a_shorter_one_slowly() {
        let mut trip = RoundTrip::default();
        let at = |ms: i64| Instant::from_ns(ms * 1_000_000);
        trip.sent(at(0), 1);
        trip.sent(at(1000), 2);
        trip.shown(at(1400), 0);
        trip.shown(at(1500), 2);
        assert!((trip.estimate_s - 1.5).abs() < 1e-12);
        trip.sent(at(2000), 3);
        trip.shown(at(2100), 3);
        assert!((trip.estimate_s - 1.36).abs() < 1e-12);
    }
}
