//! One fleet in virtual time, fast: the same coordinator, robots and referee that run as
//! processes, with messages as values instead of bytes and no log. It decides nothing; what it
//! adds is the order of events.

use core::time::Duration;

use crate::controller::coordinator_of;
use crate::coordinator::Coordinator;
use crate::experiment::agenda::Agenda;
use crate::experiment::path::Path;
use crate::experiment::post::{Letter, Post, Rank};
use crate::experiment::setup::{Setup, StatusPath};
use crate::experiment::tally::FleetTally;
use crate::messages::{State, ToRobot, Truth};
use crate::referee::{Incident, Referee, SCAN_PERIOD};
use crate::robot::{Robot, RobotParameters};
use crate::robots::robot_stream;
use crate::scenario::Scene;
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_link::impaired::LinkCounts;
use hil_link::spec::Way;

/// The number of the only fleet of an experiment.
const FLEET: u32 = 0;

/// A fleet at some instant of its run.
#[derive(Debug)]
pub struct Experiment {
    now: Instant,
    coordinator: Coordinator,
    robots: Vec<Robot>,
    agenda: Agenda,
    referee: Referee,
    network: Network,
    cycle: Cycle,
    next_scan: Instant,
}

/// The channels between coordinator and robots.
#[derive(Debug)]
struct Network {
    status_path: StatusPath,
    commands: Path,
    status: Path,
    post: Post,
    /// Per robot, the newest state that arrived; `None` where states may overtake each other.
    newest_status: Option<Vec<u32>>,
    superseded_count: u64,
}

/// When the coordinator decides.
#[derive(Debug)]
struct Cycle {
    next: Instant,
    period: Duration,
    overrun_max_s: f64,
    random: RandomStream,
}

impl Cycle {
    /// Sets the next cycle: a control period after this one, and later by what this one overran.
    fn advance(&mut self) {
        self.next = self.next + self.period;
        if self.overrun_max_s > 0.0 {
            let overrun_s = self.overrun_max_s * self.random.uniform();
            self.next = self.next + Duration::from_secs_f64(overrun_s);
        }
    }
}

/// Takes each record of the robots' motion, beside the referee.
pub type Observer<'a> = &'a mut dyn FnMut(&Truth);

impl Experiment {
    /// A fleet at the start of its run: all robots parked.
    ///
    /// # Errors
    /// When an impairment is outside its range.
    pub fn new(scene: &Scene, setup: &Setup, seed: u64) -> Result<Self, ParameterError> {
        setup.check()?;
        let robots: Vec<_> = (0..scene.starts.len())
            .map(|robot| robot_of(scene, &setup.robot, seed, robot))
            .collect();
        let links = &setup.links;
        let status_count = links.status_keeps_order.then_some(scene.starts.len());
        Ok(Self {
            now: Instant::ZERO,
            coordinator: coordinator_of(scene, &setup.coordinator, &setup.missions, FLEET, seed),
            agenda: Agenda::new(robots.len()),
            robots,
            referee: Referee::new(scene, 1),
            network: Network {
                status_path: links.status_path,
                commands: Path::new(links, Way::Forward, seed)?,
                status: Path::new(links, Way::Backward, seed)?,
                post: Post::default(),
                newest_status: status_count.map(|count| vec![0; count]),
                superseded_count: 0,
            },
            cycle: Cycle {
                next: Instant::ZERO,
                period: setup.coordinator.control_period(),
                overrun_max_s: setup.overrun_max_s,
                random: RandomStream::new(seed, "fleet overrun"),
            },
            next_scan: Instant::ZERO,
        })
    }

    /// Starts the robots; call once, first.
    pub fn start(&mut self, observe: Observer<'_>) {
        let Self {
            robots,
            referee,
            agenda,
            ..
        } = self;
        for (index, robot) in robots.iter_mut().enumerate() {
            robot.start(Instant::ZERO, &mut |truth| {
                referee.on_truth(&truth);
                observe(&truth);
            });
            agenda.set(index, robot.next_event());
        }
    }

    /// Runs until just before `end`.
    pub fn run_until(&mut self, end: Instant, observe: Observer<'_>) {
        loop {
            let (at, rank) = self.next();
            if at >= end {
                break;
            }
            self.now = at;
            match rank {
                Rank::Cycle => self.control(observe),
                Rank::State | Rank::Authority | Rank::Mission => self.deliver(observe),
                Rank::Robot => self.move_robot(observe),
                Rank::Scan => {
                    self.referee.scan(at);
                    self.next_scan = at + SCAN_PERIOD;
                }
            }
        }
        self.now = end;
    }

    /// What comes next, and when.
    fn next(&self) -> (Instant, Rank) {
        let robot = (self.agenda.first().0, Rank::Robot);
        let first = robot
            .min((self.cycle.next, Rank::Cycle))
            .min((self.next_scan, Rank::Scan));
        self.network
            .post
            .next()
            .map_or(first, |post| first.min(post))
    }

    /// One control cycle.
    fn control(&mut self, observe: Observer<'_>) {
        let now = self.now;
        let Self {
            coordinator,
            robots,
            agenda,
            referee,
            network,
            ..
        } = self;
        let is_bypassed = network.status_path == StatusPath::Bypass;
        if is_bypassed {
            for robot in robots.iter() {
                coordinator.observe(now, &robot.state(now));
            }
        }
        coordinator.on_cycle(now, &mut |message| match message {
            ToRobot::Mission(mission) if is_bypassed => {
                // The original hands a mission over in shared memory.
                let index = mission.header.robot_id as usize;
                let Some(robot) = robots.get_mut(index) else {
                    return;
                };
                robot.on_mission(now, &mission, &mut |truth| {
                    referee.on_truth(&truth);
                    observe(&truth);
                });
                agenda.set(index, robot.next_event());
            }
            ToRobot::Mission(mission) => network.command(now, Letter::Mission(mission)),
            ToRobot::Authority(authority) => network.command(now, Letter::Authority(authority)),
        });
        self.cycle.advance();
    }

    fn deliver(&mut self, observe: Observer<'_>) {
        let now = self.now;
        let Self {
            coordinator,
            robots,
            agenda,
            referee,
            network,
            ..
        } = self;
        let mut take = |truth: Truth| {
            referee.on_truth(&truth);
            observe(&truth);
        };
        let index = match network.post.take() {
            Some(Letter::State(state)) => {
                if network.is_news(&state) {
                    coordinator.on_state(now, &state);
                }
                return;
            }
            Some(Letter::Authority(authority)) => {
                let index = authority.header.robot_id as usize;
                if let Some(robot) = robots.get_mut(index) {
                    robot.on_authority(now, &authority, &mut take);
                }
                index
            }
            Some(Letter::Mission(mission)) => {
                let index = mission.header.robot_id as usize;
                if let Some(robot) = robots.get_mut(index) {
                    robot.on_mission(now, &mission, &mut take);
                }
                index
            }
            None => return,
        };
        if let Some(robot) = robots.get(index) {
            agenda.set(index, robot.next_event());
        }
    }

    fn move_robot(&mut self, observe: Observer<'_>) {
        let now = self.now;
        let Self {
            robots,
            referee,
            agenda,
            network,
            ..
        } = self;
        let (_, index) = agenda.first();
        let robot = &mut robots[index];
        let state = robot.on_event(now, &mut |truth| {
            referee.on_truth(&truth);
            observe(&truth);
        });
        agenda.set(index, robot.next_event());
        if let Some(state) = state {
            network.report(now, state);
        }
    }

    /// When this fleet is.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// Critical sections passed so far.
    pub fn section_count(&self) -> u64 {
        self.referee.tally().sections_passed_count
    }

    /// What came of the run so far.
    pub fn tally(&self) -> FleetTally {
        FleetTally::of(self)
    }

    /// What must not have happened, in order of time.
    pub fn incidents(&self) -> &[Incident] {
        self.referee.incidents()
    }

    pub(crate) fn coordinator(&self) -> &Coordinator {
        &self.coordinator
    }

    pub(crate) fn robots(&self) -> &[Robot] {
        &self.robots
    }

    pub(crate) fn referee(&self) -> &Referee {
        &self.referee
    }

    /// What became of commands and of states on their way.
    pub(crate) fn link_counts(&self) -> [LinkCounts; 2] {
        [self.network.commands.counts(), self.network.status.counts()]
    }

    pub(crate) fn superseded_count(&self) -> u64 {
        self.network.superseded_count
    }
}

impl Network {
    /// Sends a command to its robot.
    fn command(&mut self, now: Instant, letter: Letter) {
        let Self { commands, post, .. } = self;
        let length_bytes = letter.length_bytes();
        commands.offer(now, length_bytes, &mut |at| post.post(at, letter));
    }

    /// Sends a state to the coordinator, unless that reads the robots itself.
    fn report(&mut self, now: Instant, state: State) {
        if self.status_path == StatusPath::Bypass {
            return;
        }
        let Self { status, post, .. } = self;
        let letter = Letter::State(state);
        let length_bytes = letter.length_bytes();
        status.offer(now, length_bytes, &mut |at| post.post(at, letter));
    }

    /// False for a state that a newer one has deleted from the queue on its way. Dropping it on
    /// arrival comes to the same, since a newer one arrived first.
    fn is_news(&mut self, state: &State) -> bool {
        let Some(newest) = &mut self.newest_status else {
            return true;
        };
        let Some(newest) = newest.get_mut(state.header.robot_id as usize) else {
            return true;
        };
        if state.header.header_id < *newest {
            self.superseded_count += 1;
            return false;
        }
        *newest = state.header.header_id;
        true
    }
}

fn robot_of(scene: &Scene, parameters: &RobotParameters, seed: u64, robot: usize) -> Robot {
    let robot = u32::try_from(robot).expect("at most a few hundred robots");
    let random = robot_stream(seed, FLEET, robot);
    Robot::new(scene, parameters, FLEET, robot, random)
}
