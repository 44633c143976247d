//! The role "robots": every robot of every fleet, driven by whichever event is next. It routes
//! messages by their ids and decides nothing.

use crate::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_STATE, FLEET_TRUTH};
use crate::messages::{Authority, Header, Mission, State, Truth};
use crate::robot::{Robot, RobotParameters};
use crate::scenario::Scene;
use hil_core::component::{Component, Output, Role, Timer};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// Robots handled per call, so that what they give fits the ports; the rest are due at once.
const ROBOTS_PER_CALL: usize = 8;

/// All robots of a run.
#[derive(Debug)]
pub struct Robots {
    members: Vec<Robot>,
    /// Per robot, its next event.
    due: Vec<Instant>,
    per_fleet: usize,
    is_running: Vec<bool>,
    /// Robots before this one run.
    started_count: usize,
    started: Option<Instant>,
    unknown_count: u64,
    state: Output<State>,
    truth: Output<Truth>,
}

impl Robots {
    /// `fleet_count` fleets of the scene's robots, each with random streams of `seed` of its own.
    pub fn new(scene: &Scene, parameters: &RobotParameters, fleet_count: u32, seed: u64) -> Self {
        let per_fleet = scene.starts.len();
        let ids = (0..fleet_count).flat_map(|fleet| {
            let robots = u32::try_from(per_fleet).unwrap_or(u32::MAX);
            (0..robots).map(move |robot| (fleet, robot))
        });
        let members: Vec<_> = ids
            .map(|(fleet, robot)| {
                let random = robot_stream(seed, fleet, robot);
                Robot::new(scene, parameters, fleet, robot, random)
            })
            .collect();
        Self {
            due: vec![Instant::ZERO; members.len()],
            is_running: vec![false; members.len()],
            members,
            per_fleet,
            started_count: 0,
            started: None,
            unknown_count: 0,
            state: Output::default(),
            truth: Output::default(),
        }
    }

    /// Messages to robots that are not here.
    pub fn unknown_count(&self) -> u64 {
        self.unknown_count
    }

    fn index_of(&self, header: &Header) -> Option<usize> {
        let robot = header.robot_id as usize;
        let index = (header.fleet_id as usize)
            .checked_mul(self.per_fleet)?
            .checked_add(robot)?;
        (robot < self.per_fleet && index < self.members.len()).then_some(index)
    }

    /// Starts robot `index` unless it runs already.
    fn start_robot(&mut self, index: usize) {
        if let (Some(started), false) = (self.started, self.is_running[index]) {
            let truth = &mut self.truth;
            self.members[index].start(started, &mut |record| truth.send(record));
            self.due[index] = self.members[index].next_event();
            self.is_running[index] = true;
        }
    }

    /// Hands a message with this header to its robot.
    fn hear(&mut self, header: &Header, take: impl FnOnce(&mut Robot, &mut dyn FnMut(Truth))) {
        let Some(index) = self.index_of(header).filter(|_| self.started.is_some()) else {
            self.unknown_count += 1;
            return;
        };
        self.start_robot(index);
        let truth = &mut self.truth;
        take(&mut self.members[index], &mut |record| truth.send(record));
        self.due[index] = self.members[index].next_event();
    }

    fn on_authority(&mut self, now: Instant, authority: &Authority) {
        self.hear(&authority.header, |robot, truth| {
            robot.on_authority(now, authority, truth);
        });
    }

    fn on_mission(&mut self, now: Instant, mission: &Mission) {
        self.hear(&mission.header, |robot, truth| {
            robot.on_mission(now, mission, truth);
        });
    }
}

/// The random stream of a robot in a run with `seed`.
pub fn robot_stream(seed: u64, fleet_id: u32, robot_id: u32) -> RandomStream {
    RandomStream::new(seed, &format!("fleet/{fleet_id}/robot/{robot_id}"))
}

impl Robots {
    /// The role of them.
    pub fn into_role(self) -> Box<dyn Role> {
        Component::of(self)
            .input(FLEET_AUTHORITY, Self::on_authority)
            .input(FLEET_MISSION, Self::on_mission)
            .output(FLEET_STATE, |own| &mut own.state)
            .output(FLEET_TRUTH, |own| &mut own.truth)
            .start(Self::start)
            .timer(Timer {
                next: Self::next_tick,
                tick: Self::tick,
                skipped: Self::skipped_ticks,
            })
            .into_role()
    }

    fn start(&mut self, now: Instant) {
        self.started = Some(now);
    }

    fn tick(&mut self, now: Instant) {
        let count = self.members.len();
        if self.started_count < count {
            let end = count.min(self.started_count + ROBOTS_PER_CALL);
            for index in self.started_count..end {
                self.start_robot(index);
            }
            self.started_count = end;
            return;
        }
        let mut handled = 0;
        for (robot, due) in self.members.iter_mut().zip(&mut self.due) {
            if *due > now {
                continue;
            }
            let state = robot.on_event(now, &mut |record| self.truth.send(record));
            *due = robot.next_event();
            if let Some(state) = state {
                self.state.send(state);
            }
            handled += 1;
            if handled == ROBOTS_PER_CALL {
                return;
            }
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        if self.started_count < self.members.len() {
            return self.started;
        }
        self.due.iter().min().copied()
    }

    fn skipped_ticks(&self) -> u64 {
        self.members
            .iter()
            .map(|robot| robot.counters().skipped_ticks_count)
            .sum()
    }
}

#[cfg(test)]
impl Robots {
    /// What all robots together have counted.
    pub(crate) fn counters(&self) -> crate::robot::RobotCounters {
        let mut sum = crate::robot::RobotCounters::default();
        for robot in &self.members {
            sum.add(robot.counters());
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::TO_GOAL;
    use crate::robot::RobotCounters;
    use crate::robot::tests::{authority, mission, scene};
    use crate::scenario::Scenario;

    /// What 20 fleets said and counted.
    #[derive(Debug, PartialEq)]
    struct Outcome {
        states: Vec<State>,
        truths: Vec<Truth>,
        dropped_count: u64,
        counters: RobotCounters,
    }

    fn drive(seed: u64, until: Instant) -> Outcome {
        let scene = scene(Scenario::ThreeCycle);
        let mut robots = Robots::new(&scene, &RobotParameters::default(), 20, seed);
        let (mut states, mut truths) = (Vec::new(), Vec::new());
        let mut listen = |robots: &mut Robots| {
            states.extend(robots.state.drain());
            truths.extend(robots.truth.drain());
        };
        robots.start(Instant::ZERO);
        for fleet_id in 0..25 {
            let mut mission = mission(&scene, 1, 1, 2);
            mission.header.fleet_id = fleet_id;
            robots.on_mission(Instant::ZERO, &mission);
            let mut go: Authority = authority(1, 1, TO_GOAL, 0);
            (go.header.fleet_id, go.header.robot_id) = (fleet_id, 1);
            robots.on_authority(Instant::ZERO, &go);
            listen(&mut robots);
        }
        while let Some(due) = robots.next_tick().filter(|due| *due <= until) {
            robots.tick(due);
            listen(&mut robots);
        }
        assert_eq!(robots.unknown_count(), 10);
        Outcome {
            states,
            truths,
            dropped_count: robots.state.dropped_count() + robots.truth.dropped_count(),
            counters: robots.counters(),
        }
    }

    #[test]
    fn every_robot_of_every_fleet_reports_and_nothing_is_dropped() {
        let outcome = drive(1, Instant::from_ns(60_000_000_000));
        assert_eq!(outcome.dropped_count, 0);
        assert_eq!(outcome.counters.missions_done_count, 20);
        assert_eq!(outcome.counters.skipped_ticks_count, 0);
        let states = outcome.states.iter();
        let ids = states.map(|state| (state.header.fleet_id, state.header.robot_id));
        let mut ids: Vec<_> = ids.collect();
        assert_eq!(ids.len() as u64, outcome.counters.states_count);
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), 60);
    }

    #[test]
    fn equal_seeds_give_equal_robots_and_other_seeds_other_phases() {
        let until = Instant::from_ns(3_000_000_000);
        let (first, again, other) = (drive(1, until), drive(1, until), drive(2, until));
        assert_eq!(first, again);
        assert_ne!((first.states, first.truths), (other.states, other.truths));
    }
}
