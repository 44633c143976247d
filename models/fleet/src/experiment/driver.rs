//! One fleet in virtual time, fast: the same coordinator, robots and referee that run as
//! processes, with messages as values instead of bytes and no log.

use core::time::Duration;

use crate::controller::coordinator_of;
use crate::coordinator::Coordinator;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::experiment::cells::FleetTally;
use crate::messages::{Authority, Mission, State, ToRobot, Truth};
use crate::mission::MissionParameters;
use crate::referee::{Incident, Referee, SCAN_PERIOD};
use crate::robot::{Robot, RobotParameters};
use crate::robots::robot_stream;
use crate::scenario::Scene;
use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::random::RandomStream;
use hil_core::simulation::{Due, Medium, Model, Network, Observe, Simulation};
use hil_core::time::Instant;
use hil_link::impaired::{ImpairedLink, Impairments, LinkCounts};
use hil_link::spec::Way;
use hil_link::wifi::{WifiLink, WifiSpec};

/// The number of the only fleet of an experiment.
const FLEET: u32 = 0;

/// A fleet at some instant of its run, with its referee.
#[derive(Debug)]
pub struct Experiment {
    simulation: Simulation<FleetModel>,
    watch: RefereeWatch,
}

impl Experiment {
    /// A fleet at the start of its run: all robots parked.
    ///
    /// # Errors
    /// When an impairment is outside its range.
    pub fn new(scene: &Scene, setup: &Setup, seed: u64) -> Result<Self, ParameterError> {
        setup.check()?;
        let network = FleetLinks {
            commands: Path::new(&setup.links, Way::Forward, seed)?,
            status: Path::new(&setup.links, Way::Backward, seed)?,
        };
        Ok(Self {
            simulation: Simulation::of(FleetModel::new(scene, setup, seed), network),
            watch: RefereeWatch {
                referee: Referee::new(scene, 1),
                next_scan: Instant::ZERO,
            },
        })
    }

    /// Runs until just before `end`.
    pub fn run_until<O: Observe<FleetModel>>(&mut self, end: Instant, observer: &mut O) {
        let Self { simulation, watch } = self;
        simulation.run_until(end, &mut (watch, observer));
    }

    /// When this fleet is.
    pub fn now(&self) -> Instant {
        self.simulation.now()
    }

    /// Critical sections passed so far.
    pub fn section_count(&self) -> u64 {
        self.referee().tally().sections_passed_count
    }

    /// What came of the run so far.
    pub fn tally(&self) -> FleetTally {
        let (model, network) = (self.simulation.model(), self.simulation.network());
        let counters = model.coordinator.counters();
        let run_s = self.now().seconds_since(Instant::ZERO);
        FleetTally {
            referee: *self.referee().tally(),
            coordinator: counters.counts,
            safe: counters.safe,
            commands: network.commands.counts(),
            status: network.status.counts(),
            superseded_count: model.superseded_count,
            run_s,
            robot_s: run_s * model.robots.len() as f64,
            ..FleetTally::default()
        }
    }

    /// What must not have happened, in order of time.
    pub fn incidents(&self) -> &[Incident] {
        self.referee().incidents()
    }

    pub(crate) fn referee(&self) -> &Referee {
        &self.watch.referee
    }
}

/// The referee as it observes a simulation.
#[derive(Debug)]
struct RefereeWatch {
    referee: Referee,
    next_scan: Instant,
}

impl Observe<FleetModel> for RefereeWatch {
    fn recorded(&mut self, _now: Instant, truth: &Truth) {
        self.referee.on_truth(truth);
    }

    fn next_tick(&self) -> Option<Instant> {
        Some(self.next_scan)
    }

    fn ticked(&mut self, now: Instant) {
        self.referee.scan(now);
        self.next_scan = now + SCAN_PERIOD;
    }
}

/// The coordinator and the robots of a fleet.
#[derive(Debug)]
pub struct FleetModel {
    coordinator: Coordinator,
    robots: Vec<Robot>,
    agenda: Agenda,
    cycle: Cycle,
    status_path: StatusPath,
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

/// A message between coordinator and robots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FleetMessage {
    /// To the coordinator.
    State(State),
    /// To a robot.
    Authority(Authority),
    /// To a robot.
    Mission(Mission),
}

/// What comes first of several things at one instant: the coordinator takes states and decides,
/// the robots take authorities, then missions, then move. An endpoint polls its ports in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FleetRank {
    /// The coordinator takes a state.
    State,
    /// The coordinator decides.
    Cycle,
    /// A robot takes an authority.
    Authority,
    /// A robot takes a mission.
    Mission,
    /// A robot moves.
    Robot,
}

impl FleetModel {
    fn new(scene: &Scene, setup: &Setup, seed: u64) -> Self {
        let robot_ids = 0..u32::try_from(scene.starts.len()).expect("a few hundred robots");
        let robots: Vec<_> = robot_ids
            .map(|robot| {
                let random = robot_stream(seed, FLEET, robot);
                Robot::new(scene, &setup.robot, FLEET, robot, random)
            })
            .collect();
        let keeps_order = setup.links.status_keeps_order;
        Self {
            coordinator: coordinator_of(scene, &setup.coordinator, &setup.missions, FLEET, seed),
            agenda: Agenda::new(robots.len()),
            cycle: Cycle {
                next: Instant::ZERO,
                period: setup.coordinator.control_period(),
                overrun_max_s: setup.overrun_max_s,
                random: RandomStream::new(seed, "fleet overrun"),
            },
            status_path: setup.links.status_path,
            newest_status: keeps_order.then(|| vec![0; robots.len()]),
            superseded_count: 0,
            robots,
        }
    }

    /// One control cycle.
    fn decide<O: Observe<Self>>(&mut self, medium: &mut Medium<'_, Self, O>) {
        let now = medium.now;
        let Self {
            coordinator,
            robots,
            agenda,
            status_path,
            ..
        } = self;
        let is_bypassed = *status_path == StatusPath::Bypass;
        if is_bypassed {
            for robot in robots.iter() {
                coordinator.observe(now, &robot.state(now));
            }
        }
        coordinator.on_cycle(now, &mut |message| match message {
            ToRobot::Mission(mission) if is_bypassed => {
                // The original hands a mission over in shared memory.
                let index = mission.header.robot_id as usize;
                if let Some(robot) = robots.get_mut(index) {
                    robot.on_mission(now, &mission, &mut |truth| medium.record(&truth));
                    agenda.set(index, robot.next_event());
                }
            }
            ToRobot::Mission(mission) => medium.send(&FleetMessage::Mission(mission)),
            ToRobot::Authority(authority) => medium.send(&FleetMessage::Authority(authority)),
        });
        self.cycle.advance();
    }

    /// False for a state that a newer one has deleted from the queue on its way. Dropping it on
    /// arrival comes to the same, since a newer one arrived first.
    fn is_news(&mut self, state: &State) -> bool {
        let newest = self.newest_status.as_mut();
        let Some(newest) = newest.and_then(|all| all.get_mut(state.header.robot_id as usize))
        else {
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

impl Model for FleetModel {
    type Message = FleetMessage;
    type Record = Truth;
    type Network = FleetLinks;
    type Rank = FleetRank;

    fn rank(message: &FleetMessage) -> FleetRank {
        match message {
            FleetMessage::State(_) => FleetRank::State,
            FleetMessage::Authority(_) => FleetRank::Authority,
            FleetMessage::Mission(_) => FleetRank::Mission,
        }
    }

    fn start<O: Observe<Self>>(&mut self, medium: &mut Medium<'_, Self, O>) {
        for (index, robot) in self.robots.iter_mut().enumerate() {
            robot.start(medium.now, &mut |truth| medium.record(&truth));
            self.agenda.set(index, robot.next_event());
        }
    }

    fn next(&self) -> Option<Due<FleetRank>> {
        let robot = Due {
            at: self.agenda.first().0,
            rank: FleetRank::Robot,
        };
        let cycle = Due {
            at: self.cycle.next,
            rank: FleetRank::Cycle,
        };
        Some(robot.min(cycle))
    }

    fn advance<O: Observe<Self>>(&mut self, rank: FleetRank, medium: &mut Medium<'_, Self, O>) {
        if rank == FleetRank::Cycle {
            self.decide(medium);
            return;
        }
        let (_, index) = self.agenda.first();
        let robot = &mut self.robots[index];
        let state = robot.on_event(medium.now, &mut |truth| medium.record(&truth));
        self.agenda.set(index, robot.next_event());
        if let Some(state) = state.filter(|_| self.status_path == StatusPath::Network) {
            medium.send(&FleetMessage::State(state));
        }
    }

    fn receive<O: Observe<Self>>(
        &mut self,
        message: FleetMessage,
        medium: &mut Medium<'_, Self, O>,
    ) {
        let now = medium.now;
        let header = match &message {
            FleetMessage::State(state) => {
                if self.is_news(state) {
                    self.coordinator.on_state(now, state);
                }
                return;
            }
            FleetMessage::Authority(authority) => &authority.header,
            FleetMessage::Mission(mission) => &mission.header,
        };
        let index = header.robot_id as usize;
        let Some(robot) = self.robots.get_mut(index) else {
            return;
        };
        let mut record = |truth: Truth| medium.record(&truth);
        match &message {
            FleetMessage::Authority(authority) => robot.on_authority(now, authority, &mut record),
            FleetMessage::Mission(mission) => robot.on_mission(now, mission, &mut record),
            FleetMessage::State(_) => {}
        }
        self.agenda.set(index, robot.next_event());
    }
}

/// What lies between coordinator and robots, in one run.
#[derive(Debug)]
pub struct FleetLinks {
    commands: Path,
    status: Path,
}

/// Header of a datagram between gateways; only a radio's airtime depends on it.
const HEADER_BYTES: usize = 72;

impl Network<FleetMessage> for FleetLinks {
    fn offer(
        &mut self,
        now: Instant,
        message: &FleetMessage,
        mut deliver: impl FnMut(Instant, FleetMessage),
    ) {
        let (path, size_bytes) = match message {
            FleetMessage::State(_) => (&mut self.status, size_of::<State>()),
            FleetMessage::Authority(_) => (&mut self.commands, size_of::<Authority>()),
            FleetMessage::Mission(_) => (&mut self.commands, size_of::<Mission>()),
        };
        for at in path.offer(now, HEADER_BYTES + size_bytes).arrivals() {
            deliver(at, *message);
        }
    }
}

/// One direction.
#[derive(Debug)]
enum Path {
    Impaired(Box<ImpairedLink>),
    Wifi(Box<WifiLink>),
}

impl Path {
    /// Commands go forward, states backward.
    ///
    /// # Errors
    /// When a number of `links` is outside its range.
    fn new(links: &Links, way: Way, seed: u64) -> Result<Self, ParameterError> {
        let (impairments, name) = match way {
            Way::Forward => (links.commands, "fleet commands"),
            Way::Backward => (links.status, "fleet status"),
        };
        let own = RandomStream::new(seed, name);
        Ok(match &links.wifi {
            None => {
                let stalls = RandomStream::new(seed, "fleet stalls");
                Self::Impaired(Box::new(ImpairedLink::new(impairments, own, stalls)?))
            }
            Some(wifi) => {
                let shared = RandomStream::new(seed, "fleet radio");
                Self::Wifi(Box::new(WifiLink::new(wifi, way, own, shared)?))
            }
        })
    }

    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        match self {
            Self::Impaired(link) => link.offer(now, length_bytes),
            Self::Wifi(link) => link.offer(now, length_bytes),
        }
    }

    /// What became of the messages so far.
    fn counts(&self) -> LinkCounts {
        match self {
            Self::Impaired(link) => link.counts(),
            Self::Wifi(link) => {
                let counts = link.counts();
                LinkCounts {
                    offered_count: counts.offered_count,
                    lost_count: counts.offered_count - counts.delivered_count,
                    held_count: counts.held_count,
                    ..LinkCounts::default()
                }
            }
        }
    }
}

/// No event.
const NEVER: Instant = Instant::from_ns(i64::MAX);

/// A tournament over a fixed number of entries: the first is known at once, a change costs the
/// logarithm of their number. Of entries at one instant, the lowest index wins.
#[derive(Debug, Clone)]
struct Agenda {
    /// Node `i` has the children `2 i` and `2 i + 1`; the leaves begin at `leaf_start`. A node
    /// holds the winner's index.
    winners: Vec<u32>,
    due: Vec<Instant>,
    leaf_start: usize,
}

impl Agenda {
    /// An agenda of `count` entries without events.
    fn new(count: usize) -> Self {
        let leaf_start = count.max(1).next_power_of_two();
        let index = |leaf: usize| u32::try_from(leaf).expect("fewer than 2^32 robots");
        let mut winners = vec![0; 2 * leaf_start];
        for leaf in 0..leaf_start {
            winners[leaf_start + leaf] = index(leaf);
        }
        let mut agenda = Self {
            winners,
            due: vec![NEVER; leaf_start],
            leaf_start,
        };
        for node in (1..leaf_start).rev() {
            agenda.play(node);
        }
        agenda
    }

    /// The earliest event and whose it is.
    fn first(&self) -> (Instant, usize) {
        let winner = self.winners[1] as usize;
        (self.due[winner], winner)
    }

    /// Sets the next event of `entry`.
    fn set(&mut self, entry: usize, due: Instant) {
        self.due[entry] = due;
        let mut node = (self.leaf_start + entry) >> 1;
        while node > 0 {
            self.play(node);
            node /= 2;
        }
    }

    fn play(&mut self, node: usize) {
        let (left, right) = (self.winners[2 * node], self.winners[2 * node + 1]);
        let is_right = self.due[right as usize] < self.due[left as usize];
        self.winners[node] = if is_right { right } else { left };
    }
}

/// How the coordinator learns what the robots do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum StatusPath {
    /// It reads their true state at each decision, whatever the network does; missions reach the
    /// robots at once. The original since 2020.
    Bypass,
    /// By messages over the network.
    #[default]
    Network,
}

/// What lies between coordinator and robots.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Links {
    /// Whether states go over the network at all.
    pub status_path: StatusPath,
    /// A radio, commands forward and states backward, in place of both impairments.
    pub wifi: Option<WifiSpec>,
    /// What authorities and missions meet.
    pub commands: Impairments,
    /// What states meet.
    pub status: Impairments,
    /// A newer state deletes those still under way that it overtakes, as in the original.
    pub status_keeps_order: bool,
}

/// One experiment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Setup {
    /// How robots drive and take orders.
    pub robot: RobotParameters,
    /// Who goes first, and how it is told.
    pub coordinator: CoordinatorParameters,
    /// Where robots are sent.
    pub missions: MissionParameters,
    /// What lies between.
    pub links: Links,
    /// A control cycle takes up to this much longer than its period, uniform, seconds.
    pub overrun_max_s: f64,
}

impl Setup {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let below = |table| move |error: ParameterError| error.below(table);
        self.robot.check().map_err(below("robot"))?;
        self.coordinator.check().map_err(below("coordinator"))?;
        self.missions.check().map_err(below("missions"))?;
        if let Some(wifi) = &self.links.wifi {
            wifi.check()?;
        }
        self.links.commands.check()?;
        self.links.status.check()?;
        let overrun_s = self.overrun_max_s;
        ParameterError::check("overrun_max_s", overrun_s, 0.0..=600.0, "0 to 600")
    }
}

#[cfg(test)]
mod agenda_tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn the_first_entry_is_the_earliest_whatever_changed() {
        for count in [1, 2, 3, 7, 8, 100] {
            let mut agenda = Agenda::new(count);
            let mut plain = vec![NEVER; count];
            assert_eq!(agenda.first(), (NEVER, 0));
            let mut random = RandomStream::new(count as u64, "agenda");
            for _ in 0..2_000 {
                let entry = usize::try_from(random.next_u64() % count as u64).unwrap();
                let at = Instant::from_ns(i64::try_from(random.next_u64() % 50).unwrap());
                agenda.set(entry, at);
                plain[entry] = at;
                let expected = (0..count).min_by_key(|&entry| plain[entry]).unwrap();
                assert_eq!(agenda.first(), (plain[expected], expected));
            }
        }
    }
}
