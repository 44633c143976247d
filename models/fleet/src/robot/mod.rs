//! A robot of the fleet as a state machine: it follows the path of its mission as far as its
//! authority goes, reports its state, and tells the recorder what truly happens. It knows nothing
//! of other robots and reads no clock.

pub(crate) mod authority;
#[cfg(test)]
mod exact_tests;
#[cfg(test)]
mod legacy_tests;
#[cfg(test)]
pub(crate) mod tests;
mod tracker;

use core::time::Duration;
use std::sync::Arc;

use crate::geometry::{Pose, floor_index};
use crate::messages::{
    Authority, Header, MessageOrder, Mission, Phase, State, Truth, TruthKind, first_id,
};
use crate::path::{Path, PathId};
use crate::robot::authority::{Heard, Holder, MissionVerdict, Standing, Verdict, is_newer};
use crate::robot::tracker::{Limits, Tracker};
use crate::scenario::Scene;
use crate::world::{BayIndex, Vehicle, World};
use hil_core::random::RandomStream;
use hil_core::time::{Instant, duration_ns};

/// `path_id` of the truth of a robot whose starting bay no path begins or ends at.
pub const NO_PATH: u32 = u32::MAX;

/// One robot.
#[derive(Debug, Clone)]
pub struct Robot {
    world: Arc<World>,
    fleet_id: u32,
    number: u32,
    order: MessageOrder,
    tracking_period_ns: i64,
    parked_period_ns: i64,
    inflation_ns: f64,
    random: RandomStream,
    stand: Pose,
    path: Option<Arc<Path>>,
    tracker: Tracker,
    holder: Holder,
    /// Where the robot last stood or was accounted for, metres along its path.
    accounted_m: f64,
    newest_authority_header: Option<u32>,
    newest_mission_header: Option<u32>,
    next_report: Instant,
    counters: RobotCounters,
}

impl Robot {
    /// Robot `robot_id` of fleet `fleet_id`, parked in its starting bay. `random` gives the phase
    /// of its ticks and their inflation.
    ///
    /// # Panics
    /// When the scene has no such robot.
    pub fn new(
        scene: &Scene,
        parameters: &RobotParameters,
        fleet_id: u32,
        robot_id: u32,
        random: RandomStream,
    ) -> Self {
        let world = Arc::clone(&scene.world);
        let bay = *scene
            .starts
            .get(robot_id as usize)
            .expect("the scene has a start for each of its robots");
        let (path_id, way_m) = standing_way(&world, bay);
        let path = world.paths.get(PathId(path_id)).map(Arc::clone);
        let mut tracker = Tracker::new(parameters, Limits::of(&world.vehicle));
        let end_m = path.as_ref().map_or(0.0, |path| path.length_m());
        tracker.place(Instant::ZERO, way_m, end_m);
        Self {
            fleet_id,
            number: robot_id,
            order: parameters.message_order,
            tracking_period_ns: duration_ns(parameters.tracking_period()),
            parked_period_ns: duration_ns(parameters.parked_period()),
            inflation_ns: 1e6 * parameters.inflation_ms(),
            random,
            stand: world.bays[bay].pose,
            path,
            tracker,
            holder: Holder::new(path_id, 0),
            accounted_m: way_m,
            newest_authority_header: None,
            newest_mission_header: None,
            next_report: Instant::ZERO,
            counters: RobotCounters::default(),
            world,
        }
    }

    /// Begins at `now`: the first state follows within a tracking period, at a phase of the
    /// robot's own.
    pub fn start(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) {
        let phase_ns = self.random.uniform() * self.tracking_period_ns as f64;
        self.next_report = after(now, whole_ns(phase_ns));
        self.holder = Holder::new(self.holder.path_id, first_id(now));
        let way_m = self.tracker.motion(now).way_m;
        let end_m = self.path.as_ref().map_or(0.0, |path| path.length_m());
        self.tracker.place(now, way_m, end_m);
        truth(self.record(now, TruthKind::Motion, 0));
    }

    /// When [`Robot::on_event`] is next due.
    pub fn next_event(&self) -> Instant {
        let change = self.tracker.next_change();
        change.map_or(self.next_report, |at| at.min(self.next_report))
    }

    /// Does what is due at `now`; may be called early and then does nothing. Gives the state to
    /// report when a tick was due.
    pub fn on_event(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) -> Option<State> {
        self.advance(now, truth);
        if now < self.next_report {
            return None;
        }
        self.tick(now, truth);
        self.schedule(now);
        self.holder.header_id = self.holder.header_id.wrapping_add(1);
        self.counters.states_count += 1;
        Some(self.state(now))
    }

    /// The robot's true state at `now`, which must not lie beyond [`Robot::next_event`] nor before
    /// the last call.
    pub fn state(&self, now: Instant) -> State {
        let motion = self.tracker.motion(now);
        let braking_m = Limits::of(&self.world.vehicle).braking_m(motion.speed_mps);
        let place = match &self.path {
            Some(path) => Place::on(path, motion.way_m, braking_m),
            None => Place {
                pose: self.stand,
                index: 0,
                stop_index: 0,
            },
        };
        let has_mission = self.holder.mission_id != 0;
        let mut state = State {
            header: Header {
                fleet_id: self.fleet_id,
                robot_id: self.number,
                sent_ns: now.as_ns(),
                ..Header::default()
            },
            sampled_ns: now.as_ns(),
            x_m: place.pose.x_m,
            y_m: place.pose.y_m,
            heading_rad: place.pose.heading_rad,
            travelled_m: if has_mission { motion.way_m } else { 0.0 },
            speed_mps: single(motion.speed_mps),
            path_index: if has_mission { place.index } else { -1 },
            stop_index: if has_mission { place.stop_index } else { -1 },
            ..State::default()
        };
        self.holder.describe(&mut state);
        state
    }

    /// What it has counted.
    pub fn counters(&self) -> &RobotCounters {
        &self.counters
    }

    /// Brings motion up to `now`.
    fn advance(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) {
        while let Some(at) = self.tracker.next_change().filter(|at| *at <= now) {
            self.tracker.change();
            self.settle(at, truth);
        }
    }

    /// A tick of the legacy tracker.
    fn tick(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) {
        let was_at_rest = self.tracker.is_at_rest();
        if let Tracker::Legacy(tracker) = &mut self.tracker {
            tracker.tick(now);
            if self.holder.is_under_way() && !was_at_rest {
                self.settle(now, truth);
            }
        }
    }

    /// Draws the conclusions from a change of motion: under way, at its authority or at its goal.
    fn settle(&mut self, at: Instant, truth: &mut dyn FnMut(Truth)) {
        let kind = self.update_phase(at);
        truth(self.record(at, kind, self.holder.grant.applied.unwrap_or(0)));
    }

    fn update_phase(&mut self, at: Instant) -> TruthKind {
        let way_m = self.tracker.motion(at).way_m;
        self.account(way_m);
        let Some(path) = &self.path else {
            return TruthKind::Motion;
        };
        let is_at_rest = self.tracker.is_at_rest();
        let last_index = path.last_index();
        if is_at_rest && self.holder.phase == Phase::Driving {
            let error_m = way_m - path.way_to_m(self.holder.grant.reach(last_index));
            let worst_m = if self.holder.grant.is_late {
                &mut self.counters.late_overshoot_max_m
            } else {
                &mut self.counters.stop_error_max_m
            };
            *worst_m = worst_m.max(error_m);
        }
        let passed = path.index_at(way_m);
        if self.holder.settle(is_at_rest, passed, last_index) {
            self.counters.missions_done_count += 1;
            return TruthKind::MissionDone;
        }
        TruthKind::Motion
    }

    fn account(&mut self, way_m: f64) {
        self.counters.travelled_m += (way_m - self.accounted_m).max(0.0);
        self.accounted_m = way_m;
    }

    fn record(&self, at: Instant, kind: TruthKind, caused_by_sequence: u32) -> Truth {
        let motion = self.tracker.true_motion(at);
        Truth {
            at_ns: at.as_ns(),
            fleet_id: self.fleet_id,
            robot_id: self.number,
            mission_id: self.holder.mission_id,
            path_id: self.holder.path_id,
            travelled_m: motion.way_m,
            speed_mps: motion.speed_mps,
            acceleration_mps2: motion.acceleration_mps2,
            authority_index: self.holder.grant.index,
            caused_by_sequence,
            kind: kind as u32,
            reserved: 0,
        }
    }

    /// Sets the next tick: on the grid of the robot's own phase, which `step_inflation` moves with each tick of the legacy tracker
    /// under way, as the original waits a period from when it has done. A host that is late moves no grid: robots that it
    /// serves together would step together from then on.
    fn schedule(&mut self, now: Instant) {
        let period_ns = if !self.holder.is_under_way() {
            self.parked_period_ns
        } else if self.inflation_ns > 0.0 && matches!(self.tracker, Tracker::Legacy(_)) {
            self.tracking_period_ns + whole_ns(self.random.uniform() * self.inflation_ns)
        } else {
            self.tracking_period_ns
        };
        self.next_report = after(self.next_report, period_ns);
        if self.next_report <= now {
            let missed = now.ns_since(self.next_report) / period_ns + 1;
            self.next_report = after(self.next_report, missed * period_ns);
            self.counters.skipped_ticks_count += missed.unsigned_abs();
        }
    }

    /// Brings the next tick forward to within a tracking period, on its grid.
    fn hasten(&mut self, now: Instant) {
        let wait_ns = self.next_report.ns_since(now);
        let spare = (wait_ns - 1).max(0) / self.tracking_period_ns;
        self.next_report = after(self.next_report, -spare * self.tracking_period_ns);
    }
}

/// The path and way by which a robot that has not moved yet stands in `bay`.
fn standing_way(world: &World, bay: BayIndex) -> (u32, f64) {
    let arriving = world.routes.iter().find(|route| route.to == bay);
    let leaving = world.routes_from(bay).first();
    match (arriving, leaving) {
        (Some(route), _) => (route.path.0, world.path(route.path).length_m()),
        (None, Some(route)) => (route.path.0, 0.0),
        (None, None) => (NO_PATH, 0.0),
    }
}

/// What a state says of a way along a path.
struct Place {
    pose: Pose,
    index: i32,
    stop_index: i32,
}

impl Place {
    /// Positions within a nanometre short of a pose count as at it, as [`Path::index_at`] has it.
    fn on(path: &Path, way_m: f64, braking_m: f64) -> Self {
        const TOLERANCE: f64 = 1e-9;
        let (poses, last) = (path.poses(), path.last_index());
        let position = way_m / path.spacing_m();
        let before = floor_index(position).min(last - 1);
        let ratio = (position - before as f64).clamp(0.0, 1.0);
        let stop = position + braking_m / path.spacing_m() - TOLERANCE;
        let stop_before = floor_index(stop);
        let stop_index = stop_before + usize::from(stop > stop_before as f64);
        Self {
            pose: poses[before].towards(&poses[before + 1], ratio),
            index: index_i32(floor_index(position + TOLERANCE).min(last)),
            stop_index: index_i32(stop_index.min(last)),
        }
    }
}

fn index_i32(index: usize) -> i32 {
    i32::try_from(index).unwrap_or(i32::MAX)
}

fn after(at: Instant, ns: i64) -> Instant {
    Instant::from_ns(at.as_ns().saturating_add(ns))
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "a share of a period, far below 2^63 ns"
)]
fn whole_ns(value: f64) -> i64 {
    value as i64
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "the message carries speed and acceleration in single precision"
)]
fn single(value: f64) -> f32 {
    value as f32
}

impl Robot {
    /// Takes a mission when it is newer, fits the robot's map and place, and none is under way. A
    /// mission flagged [`Mission::REPLACE`], newer or the one under way, puts the robot at its end.
    pub fn on_mission(&mut self, now: Instant, mission: &Mission, truth: &mut dyn FnMut(Truth)) {
        self.advance(now, truth);
        let is_in_order = in_order(&mut self.newest_mission_header, &mission.header);
        if !is_in_order {
            self.counters.out_of_order_count += 1;
        }
        let is_passed_over = !is_in_order && self.order == MessageOrder::Strict;
        let verdict = match self.holder.judge_mission(mission) {
            _ if is_passed_over => MissionVerdict::Stale,
            verdict => verdict,
        };
        match verdict {
            MissionVerdict::Stale => {
                self.counters.missions_repeated_count += 1;
                truth(self.record(now, TruthKind::MessageStale, 0));
                return;
            }
            MissionVerdict::Busy => {
                self.counters.missions_busy_count += 1;
                return;
            }
            MissionVerdict::Begin | MissionVerdict::Replace => {}
        }
        let path = self.path_of(mission).filter(|path| {
            verdict == MissionVerdict::Replace || self.stands_at_start_of(now, path)
        });
        let Some(path) = path else {
            self.counters.missions_refused_count += 1;
            return;
        };
        if verdict == MissionVerdict::Replace {
            self.replace(now, mission, path, truth);
            return;
        }
        let kept = self.begin(now, mission, path);
        self.hasten(now);
        self.counters.missions_started_count += 1;
        truth(self.record(now, TruthKind::MissionStarted, 0));
        if let Some(authority) = kept {
            self.hear(now, &authority, truth);
        }
    }

    /// Judges an authority by the rules its flag names and does as they say.
    pub fn on_authority(
        &mut self,
        now: Instant,
        authority: &Authority,
        truth: &mut dyn FnMut(Truth),
    ) {
        self.advance(now, truth);
        let is_in_order = in_order(&mut self.newest_authority_header, &authority.header);
        if !is_in_order {
            self.counters.out_of_order_count += 1;
        }
        if !is_in_order && self.order == MessageOrder::Strict {
            self.counters.stale_count += 1;
            truth(self.record(now, TruthKind::MessageStale, authority.sequence));
            return;
        }
        self.hear(now, authority, truth);
    }

    fn hear(&mut self, now: Instant, authority: &Authority, truth: &mut dyn FnMut(Truth)) {
        let (path, tracker) = (&self.path, &self.tracker);
        let path_m = |index: usize| path.as_ref().map_or(0.0, |path| path.way_to_m(index));
        let standing = Standing {
            last_index: path.as_ref().map_or(0, |path| path.last_index()),
            passed: (path.as_ref()).map_or(0, |path| path.index_at(tracker.motion(now).way_m)),
            can_stop_at: &|index| tracker.can_stop_at(now, path_m(index)),
        };
        let last_index = standing.last_index;
        let heard = self.holder.on_authority(authority, &standing);
        let kind = match heard {
            Heard::Question => return,
            Heard::Kept => {
                self.counters.early_count += 1;
                return;
            }
            Heard::Early => {
                self.counters.early_count += 1;
                TruthKind::MessageStale
            }
            Heard::Stale => {
                self.counters.stale_count += 1;
                TruthKind::MessageStale
            }
            Heard::Meaningless => TruthKind::MessageStale,
            Heard::Judged(verdict) => {
                self.count(verdict);
                verdict.kind()
            }
        };
        let is_taken = matches!(heard, Heard::Judged(Verdict::Apply | Verdict::ApplyLate));
        if is_taken && let Some(path) = &self.path {
            let reach_m = path.way_to_m(self.holder.grant.reach(last_index));
            self.tracker.aim(now, reach_m);
        }
        truth(self.record(now, kind, authority.sequence));
        if is_taken && self.update_phase(now) == TruthKind::MissionDone {
            truth(self.record(now, TruthKind::MissionDone, authority.sequence));
        }
    }

    fn count(&mut self, verdict: Verdict) {
        let counters = &mut self.counters;
        match verdict {
            Verdict::Apply => {}
            Verdict::ApplyLate => counters.late_count += 1,
            Verdict::Unchanged => counters.unchanged_count += 1,
            Verdict::Ignore => counters.ignored_count += 1,
            Verdict::Refuse => counters.refused_count += 1,
            Verdict::Stale => counters.stale_count += 1,
        }
    }

    /// The path a mission names, if this robot's map agrees with it.
    fn path_of(&self, mission: &Mission) -> Option<Arc<Path>> {
        let path = self.world.paths.get(PathId(mission.path_id))?;
        let is_whole = mission.end_index as usize == path.last_index();
        (is_whole && mission.path_hash == path.hash()).then(|| Arc::clone(path))
    }

    /// True when the path begins within one pose spacing of where the robot stands.
    fn stands_at_start_of(&self, now: Instant, path: &Path) -> bool {
        let here = match &self.path {
            Some(own) => own.pose_at(self.tracker.motion(now).way_m),
            None => self.stand,
        };
        here.distance_m(&path.poses()[0]) <= path.spacing_m()
    }

    fn begin(&mut self, now: Instant, mission: &Mission, path: Arc<Path>) -> Option<Authority> {
        self.tracker.place(now, 0.0, path.length_m());
        self.path = Some(path);
        self.accounted_m = 0.0;
        self.holder.begin(mission)
    }

    fn replace(
        &mut self,
        now: Instant,
        mission: &Mission,
        path: Arc<Path>,
        truth: &mut dyn FnMut(Truth),
    ) {
        let length_m = path.length_m();
        self.account(self.tracker.motion(now).way_m);
        self.begin(now, mission, path);
        self.tracker.place(now, length_m, length_m);
        self.accounted_m = length_m;
        self.holder.phase = Phase::Done;
        self.hasten(now);
        truth(self.record(now, TruthKind::Replaced, 0));
    }
}

/// Notes a message's `header_id`; false when it is not newer than the newest.
fn in_order(newest: &mut Option<u32>, header: &Header) -> bool {
    if newest.is_some_and(|newest| !is_newer(header.header_id, newest)) {
        return false;
    }
    *newest = Some(header.header_id);
    true
}

/// Counted since the robot was made.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RobotCounters {
    /// Missions begun.
    pub missions_started_count: u64,
    /// Missions driven to their goal.
    pub missions_done_count: u64,
    /// Missions passed over because they were the present one again, or an older one.
    pub missions_repeated_count: u64,
    /// Missions not taken because another was under way.
    pub missions_busy_count: u64,
    /// Missions refused: unknown path, another hash, another range, or not where the robot stands.
    pub missions_refused_count: u64,
    /// Authorities that named the authority in force already (original's rules).
    pub unchanged_count: u64,
    /// Authorities that came too late to stop at; the robot went past (original's rules).
    pub late_count: u64,
    /// Authorities behind the robot, ignored; it drove on (original's rules).
    pub ignored_count: u64,
    /// Authorities refused because the robot could not stop at them (acknowledged rules).
    pub refused_count: u64,
    /// Authorities passed over: older, repeated, or for a mission that is over.
    pub stale_count: u64,
    /// Authorities that came before their mission: passed over by the original's rules, kept for
    /// it by the acknowledged ones.
    pub early_count: u64,
    /// Authorities and missions whose `header_id` was not newer than the newest of their kind.
    pub out_of_order_count: u64,
    /// Farthest it came to rest past an authority that came in time, metres.
    pub stop_error_max_m: f64,
    /// Farthest it came to rest past an authority that came too late, metres.
    pub late_overshoot_max_m: f64,
    /// Way driven, metres.
    pub travelled_m: f64,
    /// States given.
    pub states_count: u64,
    /// Ticks that went by without a call.
    pub skipped_ticks_count: u64,
}

#[cfg(test)]
impl RobotCounters {
    /// Adds the counts of another robot.
    pub(crate) fn add(&mut self, other: &Self) {
        self.missions_started_count += other.missions_started_count;
        self.missions_done_count += other.missions_done_count;
        self.missions_repeated_count += other.missions_repeated_count;
        self.missions_busy_count += other.missions_busy_count;
        self.missions_refused_count += other.missions_refused_count;
        self.unchanged_count += other.unchanged_count;
        self.late_count += other.late_count;
        self.ignored_count += other.ignored_count;
        self.refused_count += other.refused_count;
        self.stale_count += other.stale_count;
        self.early_count += other.early_count;
        self.out_of_order_count += other.out_of_order_count;
        self.stop_error_max_m = self.stop_error_max_m.max(other.stop_error_max_m);
        self.late_overshoot_max_m = self.late_overshoot_max_m.max(other.late_overshoot_max_m);
        self.travelled_m += other.travelled_m;
        self.states_count += other.states_count;
        self.skipped_ticks_count += other.skipped_ticks_count;
    }
}

hil_core::words! {
    /// How a robot follows its path.
    #[derive(Default)]
    pub enum TrackerKind {
        /// Piecewise constant acceleration in closed form; stops at its authority without error.
        #[default]
        Exact = "exact",
        /// The original's: a numerical integration whose decisions fall on its ticks.
        LegacyRk4 = "legacy-rk4",
    }
}

hil_core::options! {
    /// `[case.parameters.robot]`.
    pub struct RobotParameters {
        /// How a robot follows its path.
        tracker: TrackerKind = TrackerKind::Exact;
        /// From tick to tick, and so from state to state, of a robot under way, ms.
        tracking_period_ms: f64 = 30.0, in 1.0..=1000.0;
        /// From state to state of a robot without a mission, ms.
        parked_period_ms: f64 = 300.0, in 1.0..=10_000.0;
        /// True lengthens each tick of the legacy tracker by U[0, `inflation_delay_ms`), as the
        /// original does when a message delay is configured. Without effect on the exact tracker.
        step_inflation: bool = false;
        /// How much `step_inflation` lengthens a tick at most, ms.
        inflation_delay_ms: f64 = 0.0, in 0.0..=10_000.0;
        /// What becomes of authorities and missions that arrive out of order or twice.
        message_order: MessageOrder = MessageOrder::Legacy;
    }
}

impl RobotParameters {
    /// How far past an authority that came in time a robot can come to rest, at most.
    ///
    /// The exact tracker: 0. The legacy tracker: `3 v T + v TT / 2` with `v` the largest speed,
    /// `T` the longest tick and `TT` the tracking period: it brakes up to a tick late, it may have
    /// gone past `v` by what a tick adds, its braking table has steps of half a period, and it
    /// judges whether an order comes in time by where its last tick left it. Without the last of
    /// these the bound is `2 v T + v TT / 2`, which orders of the last moment do pass.
    pub fn stop_error_bound_m(&self, vehicle: &Vehicle) -> f64 {
        match self.tracker {
            TrackerKind::Exact => 0.0,
            TrackerKind::LegacyRk4 => {
                let period_s = 1e-3 * self.tracking_period_ms;
                let longest_s = period_s + 1e-3 * self.inflation_ms();
                vehicle.speed_max_mps * (3.0 * longest_s + 0.5 * period_s)
            }
        }
    }

    /// Longest time that a robot under way stands still because of its tracker.
    pub(crate) fn longest_tick(&self) -> Duration {
        match self.tracker {
            TrackerKind::Exact => Duration::ZERO,
            TrackerKind::LegacyRk4 => {
                Duration::from_secs_f64(1e-3 * (self.tracking_period_ms + self.inflation_ms()))
            }
        }
    }

    pub(crate) fn tracking_period(&self) -> Duration {
        Duration::from_secs_f64(1e-3 * self.tracking_period_ms)
    }

    pub(crate) fn parked_period(&self) -> Duration {
        Duration::from_secs_f64(1e-3 * self.parked_period_ms)
    }

    pub(crate) fn inflation_ms(&self) -> f64 {
        if self.step_inflation && self.tracker == TrackerKind::LegacyRk4 {
            self.inflation_delay_ms
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod parameters_tests {
    use super::*;
    use crate::geometry::Footprint;

    #[test]
    fn each_number_outside_its_range_is_refused_by_name() {
        let check = |key: &str, change: fn(&mut RobotParameters)| {
            let mut parameters = RobotParameters::default();
            change(&mut parameters);
            assert_eq!(parameters.check().unwrap_err().key, key);
        };
        check("tracking_period_ms", |p| p.tracking_period_ms = 0.0);
        check("parked_period_ms", |p| p.parked_period_ms = f64::NAN);
        check("inflation_delay_ms", |p| p.inflation_delay_ms = -1.0);
        assert_eq!(RobotParameters::default().check(), Ok(()));
    }

    #[test]
    fn the_harbor_bound_at_100_ms_is_the_sum_of_its_terms() {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 14.8,
                width_m: 3.0,
            },
            speed_max_mps: 6.0,
            acceleration_mps2: 2.0,
        };
        let mut parameters = RobotParameters {
            tracker: TrackerKind::LegacyRk4,
            step_inflation: true,
            inflation_delay_ms: 100.0,
            ..RobotParameters::default()
        };
        assert!((parameters.stop_error_bound_m(&vehicle) - 2.43).abs() < 1e-12);
        parameters.step_inflation = false;
        assert!((parameters.stop_error_bound_m(&vehicle) - 0.63).abs() < 1e-12);
        parameters.tracker = TrackerKind::Exact;
        assert!(parameters.stop_error_bound_m(&vehicle).abs() < f64::EPSILON);
    }
}
