//! One fleet in virtual time over channels that lose, delay, repeat and reorder, with the
//! referee beside it and the safety invariant checked in every cycle.

use core::time::Duration;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::coordinator::Coordinator;
use crate::coordinator::parameters::{CoordinatorMode, CoordinatorParameters};
use crate::messages::{State, ToRobot};
use crate::mission::{MissionMode, MissionParameters, MissionSource};
use crate::referee::{Referee, SCAN_PERIOD};
use crate::robot::{Robot, RobotParameters};
use crate::scenario::Scene;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// What both channels do to messages.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Chaos {
    pub(super) loss_ratio: f64,
    pub(super) delay_min_s: f64,
    pub(super) delay_max_s: f64,
    pub(super) copies: u32,
    /// Every half minute nothing arrives for so long.
    pub(super) stall_s: f64,
}

pub(super) const CONDITIONS: [(&str, Chaos); 6] = {
    const CLEAN: Chaos = Chaos {
        loss_ratio: 0.0,
        delay_min_s: 0.0,
        delay_max_s: 0.0,
        copies: 1,
        stall_s: 0.0,
    };
    [
        ("clean", CLEAN),
        (
            "loss 30 %",
            Chaos {
                loss_ratio: 0.3,
                ..CLEAN
            },
        ),
        (
            "delay U[0, 1 s]",
            Chaos {
                delay_max_s: 1.0,
                ..CLEAN
            },
        ),
        (
            "delay 1 s",
            Chaos {
                delay_min_s: 1.0,
                delay_max_s: 1.0,
                ..CLEAN
            },
        ),
        (
            "stalls of 3 s",
            Chaos {
                stall_s: 3.0,
                ..CLEAN
            },
        ),
        (
            "all",
            Chaos {
                loss_ratio: 0.3,
                delay_max_s: 1.0,
                copies: 3,
                stall_s: 3.0,
                ..CLEAN
            },
        ),
    ]
};

#[derive(Debug)]
enum Letter {
    ToRobot(ToRobot),
    State(State),
}

#[derive(Debug)]
pub(super) struct Rig {
    now: Instant,
    pub(super) coordinator: Coordinator,
    pub(super) robots: Vec<Robot>,
    pub(super) referee: Referee,
    chaos: Chaos,
    random: RandomStream,
    queue: BinaryHeap<Reverse<(Instant, u64)>>,
    letters: Vec<Option<Letter>>,
    free: Vec<usize>,
    scene: Scene,
    parameters: CoordinatorParameters,
    missions: MissionParameters,
    seed: u64,
    restart_every: Option<Duration>,
    pub(super) restart_count: u64,
    robot_restart_at: Option<Duration>,
}

pub(super) struct RigSetup {
    pub(super) coordinator: CoordinatorParameters,
    pub(super) robot: RobotParameters,
    pub(super) missions_per_robot: u32,
    pub(super) mode: MissionMode,
    pub(super) chaos: Chaos,
    /// The coordinator restarts so often; it is away for less time than messages may be under way.
    pub(super) restart_every: Option<Duration>,
    /// From when on the first robot restarts once, as soon as it drives far from every bay.
    pub(super) robot_restart_at: Option<Duration>,
}

pub(super) fn safe_parameters() -> CoordinatorParameters {
    CoordinatorParameters {
        mode: CoordinatorMode::Safe,
        ..CoordinatorParameters::default()
    }
}

const CYCLE: Duration = Duration::from_secs(1);
const RESTART: Duration = Duration::from_secs(1);

pub(super) fn coordinator(
    scene: &Scene,
    parameters: &CoordinatorParameters,
    missions: &MissionParameters,
    seed: u64,
) -> Coordinator {
    let random = RandomStream::new(seed, "missions");
    let source = MissionSource::new(missions, scene, random);
    Coordinator::new(scene, parameters, 0, source)
}

impl Rig {
    pub(super) fn new(scene: &Scene, setup: &RigSetup, seed: u64) -> Self {
        let stream = |name: &str| RandomStream::new(seed, name);
        let missions = MissionParameters {
            mode: setup.mode,
            missions_per_robot: setup.missions_per_robot,
            ..MissionParameters::default()
        };
        let robot = |number: u32| {
            let random = stream(&format!("robot {number}"));
            Robot::new(scene, &setup.robot, 0, number, random)
        };
        let count = u32::try_from(scene.starts.len()).unwrap();
        Self {
            now: Instant::ZERO,
            coordinator: coordinator(scene, &setup.coordinator, &missions, seed),
            robots: (0..count).map(robot).collect(),
            referee: Referee::new(scene, 1),
            chaos: setup.chaos,
            random: stream("channel"),
            queue: BinaryHeap::new(),
            letters: Vec::new(),
            free: Vec::new(),
            scene: scene.clone(),
            parameters: setup.coordinator.clone(),
            missions,
            seed,
            restart_every: setup.restart_every,
            restart_count: 0,
            robot_restart_at: setup.robot_restart_at,
        }
    }

    fn post(&mut self, letter: impl Fn() -> Letter) {
        let chaos = self.chaos;
        for _ in 0..chaos.copies.max(1) {
            if self.random.chance(chaos.loss_ratio) {
                continue;
            }
            let spread_s = chaos.delay_max_s - chaos.delay_min_s;
            let delay_s = chaos.delay_min_s + spread_s * self.random.uniform();
            let mut at = self.now + Duration::from_secs_f64(delay_s);
            let phase_s = (at.as_ns() as f64 * 1e-9) % 30.0;
            if phase_s < chaos.stall_s {
                at = at + Duration::from_secs_f64(chaos.stall_s - phase_s);
            }
            let slot = self.free.pop().unwrap_or(self.letters.len());
            if slot == self.letters.len() {
                self.letters.push(None);
            }
            self.letters[slot] = Some(letter());
            self.queue.push(Reverse((at, slot as u64)));
        }
    }

    /// The first robot restarts where it is, if it is to and drives far from every bay.
    fn restart_robot(&mut self) {
        let state = self.robots[0].state(self.now);
        let bays = &self.scene.world.bays;
        let is_far = bays.iter().all(|bay| {
            let (x_m, y_m) = (bay.pose.x_m - state.x_m, bay.pose.y_m - state.y_m);
            x_m.hypot(y_m) > 4.0
        });
        let is_due = |at: &Duration| Instant::ZERO + *at <= self.now && is_far;
        if self.robot_restart_at.take_if(|at| is_due(at)).is_some() {
            let referee = &mut self.referee;
            self.robots[0].start(self.now, &mut |truth| referee.on_truth(&truth));
        }
    }

    /// Runs until `end`, or until `is_over` says so at a cycle; gives the time.
    pub(super) fn run(&mut self, end: Instant, mut is_over: impl FnMut(&Self) -> bool) -> Instant {
        let (mut next_cycle, mut next_scan) = (Instant::ZERO, Instant::ZERO);
        let mut next_restart = self.restart_every.map(|every| Instant::ZERO + every);
        for robot in &mut self.robots {
            let referee = &mut self.referee;
            robot.start(Instant::ZERO, &mut |truth| referee.on_truth(&truth));
        }
        loop {
            let letter = self.queue.peek().map(|Reverse((at, _))| *at);
            let (robot_at, robot) = (0..)
                .zip(&self.robots)
                .map(|(number, robot): (usize, _)| (robot.next_event(), number))
                .min()
                .unwrap();
            let times = [letter, Some(robot_at), Some(next_cycle), Some(next_scan)];
            let at = times.into_iter().flatten().min().unwrap();
            self.now = at;
            if at >= end {
                return at;
            }
            if letter == Some(at) {
                self.deliver();
            } else if robot_at == at {
                let referee = &mut self.referee;
                let state = self.robots[robot].on_event(at, &mut |truth| referee.on_truth(&truth));
                if let Some(state) = state {
                    self.post(|| Letter::State(state));
                }
            } else if next_cycle == at && next_restart.is_some_and(|restart| restart <= at) {
                self.restart_count += 1;
                let seed = self.seed + self.restart_count;
                self.coordinator = coordinator(&self.scene, &self.parameters, &self.missions, seed);
                next_restart = self.restart_every.map(|every| at + every);
                next_cycle = at + RESTART;
            } else if next_cycle == at {
                self.restart_robot();
                let mut out = Vec::new();
                self.coordinator
                    .on_cycle(at, &mut |message| out.push(message));
                for message in out {
                    self.post(|| Letter::ToRobot(message));
                }
                if cfg!(debug_assertions)
                    && let Some(traffic) = self.coordinator.reservations()
                {
                    assert_eq!(traffic.first_overlap_by_library(), None, "at {at:?}");
                    assert_eq!(traffic.first_overlap(), None, "at {at:?}");
                }
                next_cycle = at + CYCLE;
                if is_over(self) {
                    return at;
                }
            } else {
                self.referee.scan(at);
                next_scan = at + SCAN_PERIOD;
            }
        }
    }

    fn deliver(&mut self) {
        let Some(Reverse((at, slot))) = self.queue.pop() else {
            return;
        };
        let slot = usize::try_from(slot).unwrap();
        self.free.push(slot);
        let referee = &mut self.referee;
        let mut truth = |truth| referee.on_truth(&truth);
        match self.letters[slot].take().unwrap() {
            Letter::State(state) => self.coordinator.on_state(at, &state),
            Letter::ToRobot(ToRobot::Authority(message)) => {
                let robot = message.header.robot_id as usize;
                self.robots[robot].on_authority(at, &message, &mut truth);
            }
            Letter::ToRobot(ToRobot::Mission(message)) => {
                let robot = message.header.robot_id as usize;
                self.robots[robot].on_mission(at, &message, &mut truth);
            }
        }
    }
}
