//! The role "controller": one coordinator per fleet, each with its own beat. It routes messages
//! and keeps time; what is decided is the coordinator's business.

use core::time::Duration;
use std::collections::VecDeque;

use crate::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_STATE};
use crate::coordinator::Coordinator;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::messages::{Authority, Mission, State, ToRobot};
use crate::mission::{MissionParameters, MissionSource};
use crate::scenario::Scene;
use hil_core::component::{Component, OUTPUT_CAPACITY, Output, Role, Timer};
use hil_core::random::RandomStream;
use hil_core::time::{Instant, PeriodicTimer};

/// All coordinators of a run.
#[derive(Debug)]
pub struct Controller {
    fleets: Vec<Beat>,
    /// Decided but not given yet: a port holds less than a large fleet can be told at once.
    waiting: VecDeque<ToRobot>,
    authority: Output<Authority>,
    mission: Output<Mission>,
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
            waiting: VecDeque::with_capacity(OUTPUT_CAPACITY),
            authority: Output::default(),
            mission: Output::default(),
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

impl Controller {
    /// The role of it.
    pub fn into_role(self) -> Box<dyn Role> {
        Component::of(self)
            .input(FLEET_STATE, Self::on_state)
            .output(FLEET_AUTHORITY, |own| &mut own.authority)
            .output(FLEET_MISSION, |own| &mut own.mission)
            .start(Self::start)
            .timer(Timer {
                next: Self::next_tick,
                tick: Self::tick,
                skipped: Self::skipped_ticks,
            })
            .into_role()
    }

    fn on_state(&mut self, now: Instant, state: &State) {
        if let Some(beat) = self.fleets.get_mut(state.header.fleet_id as usize) {
            beat.coordinator.on_state(now, state);
        }
    }

    fn start(&mut self, now: Instant) {
        for beat in &mut self.fleets {
            beat.timer.start(now + beat.offset);
        }
    }

    fn tick(&mut self, now: Instant) {
        if self.waiting.is_empty() {
            let mut due = self.fleets.iter_mut();
            let due = due.find_map(|beat| beat.timer.poll(now).map(|_| &mut beat.coordinator));
            if let Some(coordinator) = due {
                let waiting = &mut self.waiting;
                coordinator.on_cycle(now, &mut |message| waiting.push_back(message));
            }
        }
        let given_count = self.waiting.len().min(OUTPUT_CAPACITY);
        for message in self.waiting.drain(..given_count) {
            match message {
                ToRobot::Authority(authority) => self.authority.send(authority),
                ToRobot::Mission(mission) => self.mission.send(mission),
            }
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
