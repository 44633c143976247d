//! The role "robots": every robot of every fleet, driven by whichever event is next. It routes
//! messages by their ids and decides nothing.

use crate::messages::{FromRobot, Header, ToRobot, Truth};
use crate::robot::{Robot, RobotParameters};
use crate::scenario::Scene;
use hil_core::component::{Component, Outbox};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// Robots handled per call, so that what they give fits an outbox; the rest are due at once.
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
    fn start_robot(&mut self, index: usize, truth: &mut dyn FnMut(Truth)) {
        if let (Some(started), false) = (self.started, self.is_running[index]) {
            self.members[index].start(started, truth);
            self.due[index] = self.members[index].next_event();
            self.is_running[index] = true;
        }
    }
}

/// The random stream of a robot in a run with `seed`.
pub fn robot_stream(seed: u64, fleet_id: u32, robot_id: u32) -> RandomStream {
    RandomStream::new(seed, &format!("fleet/{fleet_id}/robot/{robot_id}"))
}

impl Component for Robots {
    type Input = ToRobot;
    type Output = FromRobot;

    fn on_start(&mut self, now: Instant) {
        self.started = Some(now);
    }

    fn on_message(&mut self, now: Instant, input: &ToRobot, out: &mut Outbox<FromRobot>) {
        let header = match input {
            ToRobot::Authority(authority) => &authority.header,
            ToRobot::Mission(mission) => &mission.header,
        };
        let Some(index) = self.index_of(header).filter(|_| self.started.is_some()) else {
            self.unknown_count += 1;
            return;
        };
        let mut truth = |record| out.send(FromRobot::Truth(record));
        self.start_robot(index, &mut truth);
        let robot = &mut self.members[index];
        match input {
            ToRobot::Authority(authority) => robot.on_authority(now, authority, &mut truth),
            ToRobot::Mission(mission) => robot.on_mission(now, mission, &mut truth),
        }
        self.due[index] = robot.next_event();
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<FromRobot>) {
        let count = self.members.len();
        if self.started_count < count {
            let end = count.min(self.started_count + ROBOTS_PER_CALL);
            for index in self.started_count..end {
                self.start_robot(index, &mut |record| out.send(FromRobot::Truth(record)));
            }
            self.started_count = end;
            return;
        }
        let mut handled = 0;
        for (robot, due) in self.members.iter_mut().zip(&mut self.due) {
            if *due > now {
                continue;
            }
            let state = robot.on_event(now, &mut |record| out.send(FromRobot::Truth(record)));
            *due = robot.next_event();
            if let Some(state) = state {
                out.send(FromRobot::State(state));
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
    use crate::messages::{Authority, TO_GOAL};
    use crate::robot::RobotCounters;
    use crate::robot::tests::{authority, mission, scene};
    use crate::scenario::Scenario;
    use hil_core::component::OUTBOX_CAPACITY;

    fn drive(seed: u64, until: Instant) -> (Vec<FromRobot>, u64, RobotCounters) {
        let scene = scene(Scenario::ThreeCycle);
        let mut robots = Robots::new(&scene, &RobotParameters::default(), 20, seed);
        let mut out = Outbox::with_capacity(OUTBOX_CAPACITY);
        let mut given = Vec::new();
        robots.on_start(Instant::ZERO);
        for fleet_id in 0..25 {
            let mut mission = mission(&scene, 1, 1, 2);
            mission.header.fleet_id = fleet_id;
            robots.on_message(Instant::ZERO, &ToRobot::Mission(mission), &mut out);
            let mut go: Authority = authority(1, 1, TO_GOAL, 0);
            (go.header.fleet_id, go.header.robot_id) = (fleet_id, 1);
            robots.on_message(Instant::ZERO, &ToRobot::Authority(go), &mut out);
            given.extend(out.drain());
        }
        while let Some(due) = robots.next_tick().filter(|due| *due <= until) {
            robots.on_tick(due, &mut out);
            given.extend(out.drain());
        }
        assert_eq!(robots.unknown_count(), 10);
        (given, out.dropped_count(), robots.counters())
    }

    #[test]
    fn every_robot_of_every_fleet_reports_and_nothing_is_dropped() {
        let (given, dropped_count, counters) = drive(1, Instant::from_ns(60_000_000_000));
        assert_eq!(dropped_count, 0);
        assert_eq!(counters.missions_done_count, 20);
        assert_eq!(counters.skipped_ticks_count, 0);
        let states = given.iter().filter_map(|message| match message {
            FromRobot::State(state) => Some((state.header.fleet_id, state.header.robot_id)),
            FromRobot::Truth(_) => None,
        });
        let mut ids: Vec<_> = states.collect();
        assert_eq!(ids.len() as u64, counters.states_count);
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), 60);
    }

    #[test]
    fn equal_seeds_give_equal_robots_and_other_seeds_other_phases() {
        let until = Instant::from_ns(3_000_000_000);
        assert_eq!(drive(1, until), drive(1, until));
        assert_ne!(drive(1, until).0, drive(2, until).0);
    }
}
