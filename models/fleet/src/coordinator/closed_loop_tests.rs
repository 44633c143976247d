//! Coordinator and robots in one virtual-time loop with a channel that delays and loses messages.
//! A test bench in small; experiments and their statistics have their own driver.

use std::collections::BTreeMap;

use crate::coordinator::Coordinator;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::messages::{State, ToRobot, Truth};
use crate::mission::{MissionParameters, MissionSource};
use crate::referee::{Referee, SCAN_PERIOD};
use crate::robot::{Robot, RobotParameters};
use crate::scenario::Scene;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// What happens to every message.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Channel {
    pub(crate) delay_min_ns: i64,
    pub(crate) delay_max_ns: i64,
    pub(crate) command_loss_ratio: f64,
    pub(crate) status_loss_ratio: f64,
}

#[derive(Debug, Clone, Copy)]
enum Parcel {
    Up(State),
    Down(ToRobot),
}

/// A fleet under way.
pub(crate) struct ClosedLoop {
    pub(crate) coordinator: Coordinator,
    pub(crate) robots: Vec<Robot>,
    channel: Channel,
    random: RandomStream,
    under_way: BTreeMap<(Instant, u64), Parcel>,
    sent_count: u64,
    period_ns: i64,
    next_cycle: Instant,
    next_scan: Instant,
    pub(crate) referee: Referee,
    truth: Vec<Truth>,
    up: Vec<State>,
}

impl ClosedLoop {
    pub(crate) fn new(
        scene: &Scene,
        parameters: &CoordinatorParameters,
        robot: &RobotParameters,
        missions: &MissionParameters,
        channel: Channel,
        seed: u64,
    ) -> Self {
        parameters.check().unwrap();
        let stream = |name: &str| RandomStream::new(seed, name);
        let source = MissionSource::new(missions, scene, stream("missions"));
        let mut referee = Referee::new(scene, 1);
        let robots: Vec<_> = (0..u32::try_from(scene.starts.len()).unwrap())
            .map(|id| {
                let mut made = Robot::new(scene, robot, 0, id, stream(&format!("robot {id}")));
                made.start(Instant::ZERO, &mut |truth| referee.on_truth(&truth));
                made
            })
            .collect();
        Self {
            coordinator: Coordinator::new(scene, parameters, 0, source),
            robots,
            channel,
            random: stream("channel"),
            under_way: BTreeMap::new(),
            sent_count: 0,
            period_ns: i64::try_from(parameters.control_period().as_nanos()).unwrap(),
            next_cycle: Instant::ZERO,
            next_scan: Instant::ZERO,
            referee,
            truth: Vec::new(),
            up: Vec::new(),
        }
    }

    pub(crate) fn run_until(&mut self, end: Instant) {
        loop {
            let parcel_at = self.under_way.keys().next().map(|key| key.0);
            let robot_at = self.robots.iter().map(Robot::next_event).min();
            let next = [
                Some(self.next_cycle),
                Some(self.next_scan),
                parcel_at,
                robot_at,
            ];
            let now = next.into_iter().flatten().min().unwrap();
            if now > end {
                return;
            }
            if parcel_at == Some(now) {
                let (_, parcel) = self.under_way.pop_first().unwrap();
                self.deliver(now, parcel);
            } else if robot_at == Some(now) {
                self.move_robots(now);
            } else if self.next_cycle == now {
                let mut messages = Vec::new();
                self.coordinator
                    .on_cycle(now, &mut |message| messages.push(message));
                for message in messages {
                    self.send(now, Parcel::Down(message));
                }
                self.next_cycle = Instant::from_ns(now.as_ns() + self.period_ns);
            } else {
                self.referee.scan(now);
                self.next_scan = now + SCAN_PERIOD;
            }
        }
    }

    fn move_robots(&mut self, now: Instant) {
        let truth = &mut self.truth;
        for robot in 0..self.robots.len() {
            if self.robots[robot].next_event() > now {
                continue;
            }
            let state = self.robots[robot].on_event(now, &mut |record| truth.push(record));
            if let Some(state) = state {
                self.up.push(state);
            }
        }
        while let Some(state) = self.up.pop() {
            self.send(now, Parcel::Up(state));
        }
        self.judge();
    }

    fn judge(&mut self) {
        for record in self.truth.drain(..) {
            self.referee.on_truth(&record);
        }
    }

    fn send(&mut self, now: Instant, parcel: Parcel) {
        let channel = self.channel;
        let loss_ratio = match parcel {
            Parcel::Up(_) => channel.status_loss_ratio,
            Parcel::Down(_) => channel.command_loss_ratio,
        };
        if loss_ratio > 0.0 && self.random.chance(loss_ratio) {
            return;
        }
        if channel.delay_max_ns == 0 {
            return self.deliver(now, parcel);
        }
        let spread_ns = (channel.delay_max_ns - channel.delay_min_ns) as f64;
        #[allow(clippy::cast_possible_truncation, reason = "a share of a delay")]
        let delay_ns = channel.delay_min_ns + (self.random.uniform() * spread_ns) as i64;
        self.sent_count += 1;
        let at = Instant::from_ns(now.as_ns() + delay_ns);
        self.under_way.insert((at, self.sent_count), parcel);
    }

    fn deliver(&mut self, now: Instant, parcel: Parcel) {
        let truth = &mut self.truth;
        let mut note = |record| truth.push(record);
        match parcel {
            Parcel::Up(state) => self.coordinator.on_state(now, &state),
            Parcel::Down(ToRobot::Mission(mission)) => {
                self.robots[mission.header.robot_id as usize].on_mission(now, &mission, &mut note);
            }
            Parcel::Down(ToRobot::Authority(authority)) => {
                let robot = authority.header.robot_id as usize;
                self.robots[robot].on_authority(now, &authority, &mut note);
            }
        }
        self.judge();
    }
}

mod tests {
    use super::*;
    use crate::mission::MissionMode;
    use crate::scenario::{Scenario, WorldParameters};

    fn scene(scenario: Scenario) -> Scene {
        let parameters = WorldParameters {
            scenario,
            ..WorldParameters::default()
        };
        parameters.build().unwrap()
    }

    fn shuttle(scenario: Scenario, channel: Channel, seed: u64) -> ClosedLoop {
        let missions = MissionParameters {
            mode: MissionMode::Shuttle,
            ..MissionParameters::default()
        };
        let robot = RobotParameters::default();
        let coordinator = CoordinatorParameters::default();
        ClosedLoop::new(
            &scene(scenario),
            &coordinator,
            &robot,
            &missions,
            channel,
            seed,
        )
    }

    #[test]
    fn small_scenarios_run_for_an_hour_without_collision_on_a_clean_channel() {
        for scenario in [
            Scenario::Crossing,
            Scenario::HeadOn,
            Scenario::Following,
            Scenario::ThreeCycle,
        ] {
            let mut fleet = shuttle(scenario, Channel::default(), 3);
            fleet.run_until(Instant::from_ns(3_600_000_000_000));
            let (tally, counts) = (fleet.referee.tally(), fleet.coordinator.counters().counts);
            assert_eq!(tally.overlaps_count, 0, "{scenario:?}");
            assert_eq!(counts.resets, 0, "{scenario:?}: {counts:?}");
            assert!(counts.missions_done > 150, "{scenario:?}: {counts:?}");
        }
    }

    #[test]
    fn lost_commands_collide_and_lost_states_do_not() {
        let collisions = |channel| {
            let mut fleet = shuttle(Scenario::ThreeCycle, channel, 11);
            fleet.run_until(Instant::from_ns(4 * 3_600_000_000_000));
            fleet.referee.tally().overlaps_count
        };
        let lossy = Channel {
            command_loss_ratio: 0.3,
            ..Channel::default()
        };
        assert!(collisions(lossy) > 0);
        let blind = Channel {
            status_loss_ratio: 0.3,
            ..Channel::default()
        };
        assert_eq!(collisions(blind), 0);
    }

    #[test]
    fn equal_seeds_give_equal_runs() {
        let channel = Channel {
            delay_max_ns: 400_000_000,
            command_loss_ratio: 0.1,
            status_loss_ratio: 0.1,
            ..Channel::default()
        };
        let run = |seed| {
            let mut fleet = shuttle(Scenario::ThreeCycle, channel, seed);
            fleet.run_until(Instant::from_ns(1_000_000_000_000));
            let counts = fleet.coordinator.counters().counts;
            (counts, format!("{:?}", fleet.referee.tally()))
        };
        assert_eq!(run(5), run(5));
        assert_ne!(run(5), run(6));
    }
}
