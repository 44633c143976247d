//! The role "controller": one coordinator per fleet, each with its own beat. It routes messages
//! and keeps time; what is decided is the coordinator's business.

use core::time::Duration;
use std::collections::VecDeque;

use crate::coordinator::Coordinator;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::messages::{State, ToRobot};
use crate::mission::{MissionParameters, MissionSource};
use crate::scenario::Scene;
use hil_core::component::{Component, OUTBOX_CAPACITY, Outbox};
use hil_core::random::RandomStream;
use hil_core::time::{Instant, PeriodicTimer};

/// All coordinators of a run.
#[derive(Debug)]
pub struct Controller {
    fleets: Vec<Beat>,
    /// Decided but not given yet: an outbox holds less than a large fleet can be told at once.
    waiting: VecDeque<ToRobot>,
}

/// A coordinator and its timer.
#[derive(Debug)]
struct Beat {
    coordinator: Coordinator,
    timer: PeriodicTimer,
    offset: Duration,
}

impl Controller {
    /// `fleet_count` coordinators of the scene's robots, their beats spread evenly over a control
    /// period.
    pub fn new(
        scene: &Scene,
        parameters: &CoordinatorParameters,
        missions: &MissionParameters,
        fleet_count: u32,
        seed: u64,
    ) -> Self {
        let period = parameters.control_period();
        let fleets = (0..fleet_count).map(|fleet| Beat {
            coordinator: coordinator_of(scene, parameters, missions, fleet, seed),
            timer: PeriodicTimer::new(period),
            offset: period * fleet / fleet_count.max(1),
        });
        Self {
            fleets: fleets.collect(),
            waiting: VecDeque::with_capacity(OUTBOX_CAPACITY),
        }
    }
}

/// The coordinator of one fleet of a run with a seed.
pub(crate) fn coordinator_of(
    scene: &Scene,
    parameters: &CoordinatorParameters,
    missions: &MissionParameters,
    fleet: u32,
    seed: u64,
) -> Coordinator {
    let random = RandomStream::new(seed, &format!("fleet/{fleet}/missions"));
    let source = MissionSource::new(missions, scene, random);
    Coordinator::new(scene, parameters, fleet, source)
}

impl Component for Controller {
    type Input = State;
    type Output = ToRobot;

    fn on_start(&mut self, now: Instant) {
        for beat in &mut self.fleets {
            beat.timer.start(now + beat.offset);
        }
    }

    fn on_message(&mut self, now: Instant, input: &State, _out: &mut Outbox<ToRobot>) {
        if let Some(beat) = self.fleets.get_mut(input.header.fleet_id as usize) {
            beat.coordinator.on_state(now, input);
        }
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<ToRobot>) {
        let Self {
            fleets, waiting, ..
        } = self;
        if waiting.is_empty() {
            let mut due = fleets.iter_mut();
            let due = due.find_map(|beat| beat.timer.poll(now).map(|_| &mut beat.coordinator));
            if let Some(coordinator) = due {
                coordinator.on_cycle(now, &mut |message| waiting.push_back(message));
            }
        }
        for message in waiting.drain(..waiting.len().min(OUTBOX_CAPACITY)) {
            out.send(message);
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        if !self.waiting.is_empty() {
            return Some(Instant::ZERO);
        }
        let ticks = self.fleets.iter().filter_map(|beat| beat.timer.next());
        ticks.min()
    }

    fn skipped_ticks(&self) -> u64 {
        self.fleets
            .iter()
            .map(|beat| beat.timer.skipped_total())
            .sum()
    }
}
