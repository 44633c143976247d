//! The safe coordinator: acknowledged movement authority. It gives a robot only way that no other
//! robot may be on, whatever messages are lost, late, repeated or overtaken, and only as long as
//! every robot can still finish. It needs no clock but its own.
//!
//! - `interlocking`: the decisions, without time or floats; `search_tests` searches them exhaustively.
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
mod interlocking;
pub mod ledger;
mod liveness;
pub mod reservation;
#[cfg(test)]
mod search_tests;
#[cfg(test)]
mod tests;

use core::time::Duration;
use std::sync::Arc;

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::roster::Roster;
use crate::coordinator::safe::interlocking::{Heard, Interlocking};
use crate::coordinator::safe::ledger::StateEffect;
use crate::coordinator::safe::liveness::StopMargin;
use crate::coordinator::safe::reservation::Traffic;
use crate::coordinator::{Cycle, Rules};
use crate::geometry::floor_index;
use crate::messages::{Mission, State, ToRobot, first_id};
use crate::mission::MissionSource;
use crate::world::{BayIndex, World};
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
    core: Interlocking,
    /// It has begun to ask the robots.
    is_asking: bool,
    /// Missions are given out: the roster knows what the robots have told.
    is_ready: bool,
    robots: Vec<SafeRobot>,
    counts: SafeCounts,
    order: Vec<grants::Candidate>,
    /// Per robot its place in `order`.
    places: Vec<Option<usize>>,
}

/// What the safe rules know of a robot beyond its reservation.
#[derive(Debug, Clone)]
struct SafeRobot {
    /// As it last told when it had not told before; for the roster.
    told: Option<State>,
    /// The bay it stood in then without a mission.
    told_bay: Option<BayIndex>,
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
    is_counted_restarted: bool,
    /// Robots that wait for this one, as of the last cycle.
    held_up_count: u32,
    /// Who stops it, as of the last cycle.
    stopped_by: Option<usize>,
    /// Authority was taken back from it; not again before.
    spared_until: Instant,
}

impl SafeRules {
    /// Rules for the robots of fleet `fleet_id`, of which nothing is known until they tell.
    pub(crate) fn new(
        world: &Arc<World>,
        robot_count: usize,
        parameters: &CoordinatorParameters,
        fleet_id: u32,
    ) -> Self {
        let margin = parameters.safe.stop_margin(world);
        let robot = SafeRobot {
            told: None,
            told_bay: None,
            round_trip: RoundTrip::default(),
            speed_mps: 0.0,
            header_id: 0,
            waiting_since: None,
            waited_since: None,
            moved: Instant::ZERO,
            is_counted_stuck: false,
            is_counted_restarted: false,
            held_up_count: 0,
            stopped_by: None,
            spared_until: Instant::ZERO,
        };
        Self {
            fleet_id,
            core: Interlocking::new(world, margin, robot_count, 0),
            is_asking: false,
            is_ready: false,
            control_period: parameters.control_period(),
            cycles: CycleTime::default(),
            patience: parameters.safe.patience(),
            stuck_after: parameters.stuck_after(),
            reserve_ms: parameters.safe.reserve_ms,
            takes_back: parameters.safe.takes_back,
            robots: vec![robot; robot_count],
            counts: SafeCounts::default(),
            order: Vec::with_capacity(robot_count),
            places: vec![None; robot_count],
            world: Arc::clone(world),
        }
    }

    fn send_all(&mut self, cycle: &mut Cycle<'_>) {
        for (robot, view) in self.robots.iter_mut().enumerate() {
            let question = self.core.question(robot);
            let Some(mut authority) = question.or_else(|| self.core.command(robot)) else {
                continue;
            };
            view.header_id = view.header_id.wrapping_add(1);
            if question.is_none() {
                view.round_trip.sent(cycle.now, authority.sequence);
            }
            authority.header.fleet_id = self.fleet_id;
            authority.header.header_id = view.header_id;
            authority.header.sent_ns = cycle.now.as_ns();
            (cycle.send)(ToRobot::Authority(authority));
        }
    }

    /// Takes over missions that began or ended since the last cycle.
    fn follow_roster(&mut self, cycle: &Cycle<'_>) {
        for (robot, known) in cycle.roster.robots().iter().enumerate() {
            let Some(mission) = &known.mission else {
                continue;
            };
            if mission.id == self.core.members[robot].ledger.mission_id() {
                continue;
            }
            self.core.begin(robot, mission.id, mission.route.path);
            let view = &mut self.robots[robot];
            view.round_trip.forget_question();
            view.speed_mps = 0.0;
            (view.waiting_since, view.waited_since) = (None, None);
            view.moved = cycle.now;
            view.is_counted_stuck = false;
        }
        self.core.forget_passed();
    }

    /// The bay a robot stands in that says so, within a pose.
    fn bay_at(world: &World, state: &State) -> Option<BayIndex> {
        let spacing_m = spacing_min_m(world);
        let distance_m = |bay: BayIndex| {
            let pose = &world.bays[bay].pose;
            (pose.x_m - state.x_m).hypot(pose.y_m - state.y_m)
        };
        let nearest =
            (0..world.bays.len()).min_by(|a, b| distance_m(*a).total_cmp(&distance_m(*b)));
        nearest.filter(|bay| distance_m(*bay) <= spacing_m)
    }

    fn count_stuck(&mut self, now: Instant) {
        for (view, member) in self.robots.iter_mut().zip(&self.core.members) {
            let is_stuck = member.ledger.mission_id() != 0
                && !member.ledger.is_done()
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
        let is_ours = robot < self.robots.len() && header.fleet_id == self.fleet_id;
        if !self.is_asking || !is_ours || !state.is_sound() {
            return;
        }
        let was_lower = self.core.members[robot].ledger.lower();
        let was_newest = self.core.members[robot].newest_header_id;
        let world = &self.world;
        let bay = core::cell::Cell::new(None);
        let heard = self.core.on_state(robot, state, || {
            bay.set(Self::bay_at(world, state));
            bay.get()
        });
        let member = &self.core.members[robot];
        let view = &mut self.robots[robot];
        match heard {
            Heard::Known(StateEffect::Nothing) | Heard::PassedOver => return,
            Heard::Known(StateEffect::Impossible) => {
                self.counts.states_impossible += 1;
                return;
            }
            Heard::Restarted => {
                self.counts.robots_restarted += u64::from(!view.is_counted_restarted);
                view.is_counted_restarted = true;
                return;
            }
            Heard::Unplaced => {
                self.counts.answers_unplaced += 1;
                return;
            }
            Heard::Answered => {
                view.told = Some(*state);
                view.told_bay = bay.get();
                view.moved = now;
                return;
            }
            Heard::Known(StateEffect::Exceeded) => self.counts.authorities_exceeded += 1,
            Heard::Known(StateEffect::Refused | StateEffect::News) => {}
        }
        view.round_trip.shown(now, state.applied_sequence);
        if member.newest_header_id == header.header_id || was_newest == header.header_id {
            view.speed_mps = f64::from(state.speed_mps);
        }
        if member.ledger.lower() > was_lower {
            view.moved = now;
            view.waited_since = None;
            view.is_counted_stuck = false;
        }
        let (lower, bound) = (member.ledger.lower(), member.ledger.bound());
        if lower >= bound + self.core.margin.poses && lower < self.core.traffic.last(robot) {
            self.counts.margins_exceeded += 1;
        }
    }

    fn prepare(&mut self, now: Instant, roster: &mut Roster, missions: &mut MissionSource) -> bool {
        if !self.is_asking {
            self.is_asking = true;
            let (margin, count) = (self.core.margin, self.robots.len());
            let first = first_id(now);
            // 0 is no question.
            self.core = Interlocking::new(&self.world, margin, count, first.max(1));
            for view in &mut self.robots {
                view.header_id = first;
            }
        }
        if !self.is_ready && self.core.is_complete() {
            self.is_ready = true;
            let told = self
                .robots
                .iter_mut()
                .map(|view| (view.told.take(), view.told_bay));
            roster.resume(now, told, missions);
        }
        self.is_ready
    }

    fn address(&self, mission: &mut Mission) {
        self.core.address(mission);
    }

    fn decide(&mut self, cycle: &mut Cycle<'_>) {
        self.cycles.begin(cycle.now);
        self.follow_roster(cycle);
        self.grant_all(cycle);
        self.send_all(cycle);
        self.count_stuck(cycle.now);
        cycle.counters.safe = self.counts;
        debug_assert!(
            !self.core.stands_apart || self.core.traffic.first_overlap().is_none(),
            "reservations overlap: {:?}",
            self.core.traffic.first_overlap()
        );
    }

    fn reservations(&self) -> Option<&Traffic> {
        Some(&self.core.traffic)
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

/// Seconds until an authority sent a control cycle from now is sure to be at the robot, counted
/// from when the state known now was sampled.
pub(crate) fn lookahead_s(cycle_s: f64, round_trip_s: f64, reserve_ms: f64) -> f64 {
    cycle_s + round_trip_s + 1e-3 * reserve_ms
}

fn spacing_min_m(world: &World) -> f64 {
    let paths = world.paths.ids().filter_map(|id| world.paths.get(id));
    paths
        .map(|path| path.spacing_m())
        .fold(f64::INFINITY, f64::min)
}

hil_core::options! {
    /// `[case.parameters.coordinator.safe]`.
    #[derive(Copy)]
    pub struct SafeParameters {
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
        let spacing_m = spacing_min_m(world);
        let poses = floor_index((self.stop_error_m / spacing_m).ceil()) + 1;
        StopMargin { poses }
    }
}

#[cfg(test)]
mod horizon_tests {
    use super::*;
    use crate::coordinator::reach_m;
    use crate::geometry::Footprint;
    use crate::world::Vehicle;

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
            let reach = reach_m(&CART, 0.0, speed, time);
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
