//! A robot of the fleet as a state machine: it follows the path of its mission as far as its
//! authority goes, reports its state, and tells the recorder what truly happens. It knows nothing
//! of other robots and reads no clock.

mod authority;
mod counters;
mod exact;
mod legacy;
mod orders;
mod parameters;
mod tracker;

#[cfg(test)]
mod exact_tests;
#[cfg(test)]
mod legacy_tests;
#[cfg(test)]
pub(crate) mod tests;

use std::sync::Arc;

pub use self::counters::RobotCounters;
pub use self::parameters::{RobotParameters, TrackerKind};

use crate::geometry::{Pose, floor_index};
use crate::messages::{Authority, Header, MessageOrder, Phase, State, Truth, TruthKind};
use crate::path::{Path, PathId};
use crate::robot::authority::Grant;
use crate::robot::tracker::{Limits, Tracker};
use crate::scenario::Scene;
use crate::world::{BayIndex, World};
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
    path_id: u32,
    mission_id: u32,
    phase: Phase,
    tracker: Tracker,
    grant: Grant,
    /// Where the robot last stood or was accounted for, metres along its path.
    accounted_m: f64,
    /// An authority that overtook its mission.
    early: Option<Authority>,
    newest_authority_header: Option<u32>,
    newest_mission_header: Option<u32>,
    header_id: u32,
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
            path_id,
            mission_id: 0,
            phase: Phase::Parked,
            tracker,
            grant: Grant::NONE,
            accounted_m: way_m,
            early: None,
            newest_authority_header: None,
            newest_mission_header: None,
            header_id: 0,
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
        let way_m = self.tracker.motion(now).way_m;
        let end_m = self.path.as_ref().map_or(0.0, |path| path.length_m());
        self.tracker.place(now, way_m, end_m);
        truth(self.record(now, TruthKind::Motion, 0));
    }

    /// When [`Robot::on_event`] is next due.
    pub fn next_event(&self) -> Instant {
        let changes = [self.tracker.next_change(), self.grant.lease_end];
        changes
            .into_iter()
            .flatten()
            .fold(self.next_report, Instant::min)
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
        self.header_id = self.header_id.wrapping_add(1);
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
        let has_mission = self.mission_id != 0;
        State {
            header: Header {
                fleet_id: self.fleet_id,
                robot_id: self.number,
                header_id: self.header_id,
                mission_id: self.mission_id,
                sent_ns: now.as_ns(),
            },
            sampled_ns: now.as_ns(),
            x_m: place.pose.x_m,
            y_m: place.pose.y_m,
            heading_rad: place.pose.heading_rad,
            travelled_m: if has_mission { motion.way_m } else { 0.0 },
            speed_mps: single(motion.speed_mps),
            acceleration_mps2: single(motion.acceleration_mps2),
            path_index: if has_mission { place.index } else { -1 },
            authority_index: self.grant.index,
            applied_sequence: self.grant.applied.unwrap_or(0),
            stop_index: if has_mission { place.stop_index } else { -1 },
            phase: self.phase as u8,
            flags: if self.grant.is_refused {
                State::REFUSED
            } else {
                0
            },
            reserved: [0; 6],
        }
    }

    /// What it has counted.
    pub fn counters(&self) -> &RobotCounters {
        &self.counters
    }

    fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Driving | Phase::AtPoint)
    }

    /// Brings motion and lease up to `now`, in order of time.
    fn advance(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) {
        loop {
            let change = self.tracker.next_change().filter(|at| *at <= now);
            let lease_end = self.grant.lease_end.filter(|at| *at <= now);
            match (change, lease_end) {
                (Some(at), end) if end.is_none_or(|end| at <= end) => {
                    self.tracker.change();
                    self.settle(at, truth);
                }
                (_, Some(at)) => {
                    self.grant.lease_end = None;
                    self.grant.has_lapsed = true;
                    self.tracker.brake(at);
                    self.counters.leases_ended_count += 1;
                    self.note(at, TruthKind::LeaseEnded, truth);
                }
                _ => return,
            }
        }
    }

    /// A tick of the legacy tracker.
    fn tick(&mut self, now: Instant, truth: &mut dyn FnMut(Truth)) {
        let was_at_rest = self.tracker.is_at_rest();
        if let Tracker::Legacy(tracker) = &mut self.tracker {
            tracker.tick(now);
            if self.is_under_way() && !was_at_rest {
                self.settle(now, truth);
            }
        }
    }

    /// Draws the conclusions from a change of motion: under way, at its authority or at its goal.
    fn settle(&mut self, at: Instant, truth: &mut dyn FnMut(Truth)) {
        let kind = self.update_phase(at);
        truth(self.record(at, kind, self.grant.applied.unwrap_or(0)));
    }

    /// The same, with a record of `kind` for a cause other than motion itself.
    fn note(&mut self, at: Instant, kind: TruthKind, truth: &mut dyn FnMut(Truth)) {
        let sequence = self.grant.applied.unwrap_or(0);
        truth(self.record(at, kind, sequence));
        if self.update_phase(at) == TruthKind::MissionDone {
            truth(self.record(at, TruthKind::MissionDone, sequence));
        }
    }

    fn update_phase(&mut self, at: Instant) -> TruthKind {
        let way_m = self.tracker.motion(at).way_m;
        self.account(way_m);
        let Some(path) = &self.path else {
            return TruthKind::Motion;
        };
        if !self.tracker.is_at_rest() {
            self.phase = Phase::Driving;
            return TruthKind::Motion;
        }
        if self.phase == Phase::Driving {
            let reach_m = path.way_to_m(self.grant.reach(path.last_index()));
            let error_m = way_m - reach_m;
            self.counters.stop_count += 1;
            let worst_m = if self.grant.is_late {
                &mut self.counters.late_overshoot_max_m
            } else {
                &mut self.counters.stop_error_max_m
            };
            *worst_m = worst_m.max(error_m);
        }
        let last_index = path.last_index();
        let is_goal = self.grant.is_given() && self.grant.reach(last_index) == last_index;
        if is_goal && path.index_at(way_m) == last_index {
            self.phase = Phase::Done;
            self.grant.lease_end = None;
            self.counters.missions_done_count += 1;
            return TruthKind::MissionDone;
        }
        self.phase = Phase::AtPoint;
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
            mission_id: self.mission_id,
            path_id: self.path_id,
            travelled_m: motion.way_m,
            speed_mps: motion.speed_mps,
            acceleration_mps2: motion.acceleration_mps2,
            authority_index: self.grant.index,
            caused_by_sequence,
            kind: kind as u32,
            reserved: 0,
        }
    }

    /// Sets the next tick: on the grid of the robot's own phase, but for the legacy tracker under
    /// way, which waits a period from whenever it has done.
    fn schedule(&mut self, now: Instant) {
        if self.is_under_way() && matches!(self.tracker, Tracker::Legacy(_)) {
            let extra_ns = if self.inflation_ns > 0.0 {
                whole_ns(self.random.uniform() * self.inflation_ns)
            } else {
                0
            };
            self.next_report = after(now, self.tracking_period_ns + extra_ns);
            return;
        }
        let period_ns = if self.is_under_way() {
            self.tracking_period_ns
        } else {
            self.parked_period_ns
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
