//! The fleet's coordinator: from the robots' states to missions and authorities, once per control
//! period. A pure state machine; what carries the messages, and how badly, it does not know.

#[cfg(test)]
mod closed_loop_tests;
pub mod counters;
mod legacy;
pub mod parameters;
pub mod policy;
pub mod roster;
pub mod safe;
pub mod sections;

use core::fmt::Debug;

use crate::coordinator::counters::CoordinatorCounters;
use crate::coordinator::legacy::LegacyRules;
use crate::coordinator::parameters::{CoordinatorMode, CoordinatorParameters};
use crate::coordinator::policy::OrderingPolicy;
use crate::coordinator::roster::Roster;
use crate::coordinator::safe::SafeRules;
use crate::coordinator::safe::reservation::Traffic;
use crate::messages::{Mission, State, ToRobot};
use crate::mission::MissionSource;
use crate::scenario::Scene;
use crate::world::Vehicle;
use hil_core::time::Instant;

/// What rules decide on, and with, in one control cycle.
pub(crate) struct Cycle<'a> {
    pub(crate) now: Instant,
    pub(crate) roster: &'a mut Roster,
    pub(crate) policy: &'a dyn OrderingPolicy,
    pub(crate) counters: &'a mut CoordinatorCounters,
    pub(crate) send: &'a mut dyn FnMut(ToRobot),
}

/// Rules that give robots their way: what differs between the coordinator's modes.
pub(crate) trait Rules: Debug {
    /// Decides and sends authorities. The roster is settled: missions that ended, and sections
    /// that were passed, are gone from it; missions that begin are in it.
    fn decide(&mut self, cycle: &mut Cycle<'_>);

    /// Whether missions may be given out yet; before, what robots have told is put into the roster.
    fn prepare(
        &mut self,
        _now: Instant,
        _roster: &mut Roster,
        _missions: &mut MissionSource,
    ) -> bool {
        true
    }

    /// Makes a mission one of these rules.
    fn address(&self, _mission: &mut Mission) {}

    /// Sees every state as it arrives, also those the roster does not take.
    fn on_state(&mut self, _now: Instant, _state: &State) {}

    /// The way each robot has to itself, if the rules keep account of it.
    fn reservations(&self) -> Option<&Traffic> {
        None
    }

    /// Whether a robot that makes no way may be put at its goal.
    fn resets_stuck_robots(&self) -> bool {
        true
    }
}

/// Way a vehicle at `speed_mps` makes at most in `time_s` and then needs to stop, metres, if it speeds up by
/// `pessimism_ratio` better and brakes by as much worse than it should.
pub(crate) fn reach_m(vehicle: &Vehicle, pessimism_ratio: f64, speed_mps: f64, time_s: f64) -> f64 {
    let speed_mps = speed_mps.max(0.0);
    let speeding_up_mps2 = (1.0 + pessimism_ratio) * vehicle.acceleration_mps2;
    let braking_mps2 = (1.0 - pessimism_ratio) * vehicle.acceleration_mps2;
    let to_full_s = ((vehicle.speed_max_mps - speed_mps) / speeding_up_mps2).max(0.0);
    let speeding_up_s = to_full_s.min(time_s);
    let fast_mps = speed_mps + speeding_up_mps2 * speeding_up_s;
    0.5 * (speed_mps + fast_mps) * speeding_up_s
        + fast_mps * (time_s - speeding_up_s)
        + fast_mps * fast_mps / (2.0 * braking_mps2)
}

/// One fleet's coordinator.
#[derive(Debug)]
pub struct Coordinator {
    /// What it knows of its robots.
    pub(crate) roster: Roster,
    rules: Box<dyn Rules>,
    policy: Box<dyn OrderingPolicy>,
    missions: MissionSource,
    counters: CoordinatorCounters,
}

impl Coordinator {
    /// The coordinator of fleet `fleet_id`, its robots parked where the scene starts them.
    pub fn new(
        scene: &Scene,
        parameters: &CoordinatorParameters,
        fleet_id: u32,
        missions: MissionSource,
    ) -> Self {
        let rules: Box<dyn Rules> = match parameters.mode {
            CoordinatorMode::Legacy => Box::new(LegacyRules::new(scene, parameters)),
            CoordinatorMode::Safe => {
                let robot_count = scene.starts.len();
                Box::new(SafeRules::new(
                    &scene.world,
                    robot_count,
                    parameters,
                    fleet_id,
                ))
            }
        };
        Self {
            roster: Roster::new(scene, parameters, fleet_id),
            rules,
            policy: parameters.policy.policy(),
            missions,
            counters: CoordinatorCounters::default(),
        }
    }

    /// Takes a robot's state in.
    pub fn on_state(&mut self, now: Instant, state: &State) {
        self.roster.on_state(now, state, &mut self.counters.counts);
        self.rules.on_state(now, state);
    }

    /// Takes in a robot's true state, past all channels: what the original does in simulation.
    /// Then only commands suffer from the network.
    pub fn observe(&mut self, now: Instant, state: &State) {
        self.roster.observe(now, state, &mut self.counters.counts);
        self.rules.on_state(now, state);
    }

    /// One control cycle; gives each message to `send`.
    pub fn on_cycle(&mut self, now: Instant, send: &mut dyn FnMut(ToRobot)) {
        self.roster.settle(&mut self.counters.counts);
        let is_ready = self
            .rules
            .prepare(now, &mut self.roster, &mut self.missions);
        if is_ready {
            let rules = &self.rules;
            self.roster
                .dispatch(now, &mut self.missions, &mut |mut message| {
                    if let ToRobot::Mission(mission) = &mut message {
                        rules.address(mission);
                    }
                    send(message);
                });
        }
        self.rules.decide(&mut Cycle {
            now,
            roster: &mut self.roster,
            policy: self.policy.as_ref(),
            counters: &mut self.counters,
            send,
        });
        if self.rules.resets_stuck_robots() {
            self.roster
                .reset_stuck(now, &mut self.counters.counts, send);
        }
    }

    /// The way each robot has to itself; `None` in the legacy mode.
    pub fn reservations(&self) -> Option<&Traffic> {
        self.rules.reservations()
    }

    /// What it counted so far.
    pub fn counters(&self) -> &CoordinatorCounters {
        &self.counters
    }
}
