//! One fleet in virtual time, fast: the same coordinator, robots and referee that run as
//! processes, with messages as values instead of bytes and no log. It decides nothing; what it
//! adds is the order of events.

use core::cmp::Reverse;
use core::time::Duration;
use std::collections::BinaryHeap;

use serde::{Deserialize, Serialize};

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
use hil_core::link_model::LinkModel;
use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_link::impaired::{ImpairedLink, Impairments, LinkCounts};
use hil_link::spec::Way;
use hil_link::wifi::{WifiLink, WifiSpec};

/// The number of the only fleet of an experiment.
const FLEET: u32 = 0;

/// A fleet at some instant of its run.
#[derive(Debug)]
pub struct Experiment {
    now: Instant,
    pub(crate) coordinator: Coordinator,
    robots: Vec<Robot>,
    agenda: Agenda,
    pub(crate) referee: Referee,
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
    queue: MessageQueue,
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
                queue: MessageQueue::default(),
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
            .queue
            .next()
            .map_or(first, |queue| first.min(queue))
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
            ToRobot::Mission(mission) => network.command(now, QueuedMessage::Mission(mission)),
            ToRobot::Authority(authority) => {
                network.command(now, QueuedMessage::Authority(authority));
            }
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
        let index = match network.queue.take() {
            Some(QueuedMessage::State(state)) => {
                if network.is_news(&state) {
                    coordinator.on_state(now, &state);
                }
                return;
            }
            Some(QueuedMessage::Authority(authority)) => {
                let index = authority.header.robot_id as usize;
                if let Some(robot) = robots.get_mut(index) {
                    robot.on_authority(now, &authority, &mut take);
                }
                index
            }
            Some(QueuedMessage::Mission(mission)) => {
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

    pub(crate) fn robots(&self) -> &[Robot] {
        &self.robots
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
    fn command(&mut self, now: Instant, queued: QueuedMessage) {
        let Self {
            commands, queue, ..
        } = self;
        let length_bytes = queued.length_bytes();
        commands.offer(now, length_bytes, &mut |at| queue.queue(at, queued));
    }

    /// Sends a state to the coordinator, unless that reads the robots itself.
    fn report(&mut self, now: Instant, state: State) {
        if self.status_path == StatusPath::Bypass {
            return;
        }
        let Self { status, queue, .. } = self;
        let queued = QueuedMessage::State(state);
        let length_bytes = queued.length_bytes();
        status.offer(now, length_bytes, &mut |at| queue.queue(at, queued));
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

/// No event.
pub(crate) const NEVER: Instant = Instant::from_ns(i64::MAX);

/// A tournament over a fixed number of entries: the first is known at once, a change costs the
/// logarithm of their number. Of entries at one instant, the lowest index wins.
#[derive(Debug, Clone)]
pub(crate) struct Agenda {
    /// Node `i` has the children `2 i` and `2 i + 1`; the leaves begin at `leaf_start`. A node
    /// holds the winner's index.
    winners: Vec<u32>,
    due: Vec<Instant>,
    leaf_start: usize,
}

impl Agenda {
    /// An agenda of `count` entries without events.
    pub(crate) fn new(count: usize) -> Self {
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
    pub(crate) fn first(&self) -> (Instant, usize) {
        let winner = self.winners[1] as usize;
        (self.due[winner], winner)
    }

    /// Sets the next event of `entry`.
    pub(crate) fn set(&mut self, entry: usize, due: Instant) {
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

/// One direction.
#[derive(Debug)]
pub(crate) enum Path {
    Impaired(Box<ImpairedLink>),
    Wifi(Box<WifiLink>),
}

impl Path {
    /// Commands go forward, states backward.
    ///
    /// # Errors
    /// When a number of `links` is outside its range.
    pub(crate) fn new(links: &Links, way: Way, seed: u64) -> Result<Self, ParameterError> {
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

    /// Offers a message; hands each of its arrivals to `deliver`.
    pub(crate) fn offer(
        &mut self,
        now: Instant,
        length_bytes: usize,
        deliver: &mut dyn FnMut(Instant),
    ) {
        match self {
            Self::Impaired(link) => link.offer(now, deliver),
            Self::Wifi(link) => {
                if let Some(at) = link.offer(now, length_bytes).arrival() {
                    deliver(at);
                }
            }
        }
    }

    /// What became of the messages so far.
    pub(crate) fn counts(&self) -> LinkCounts {
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

/// Header of a datagram between gateways; only a radio's airtime depends on it.
const HEADER_BYTES: usize = 72;

/// A message under way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum QueuedMessage {
    /// To the coordinator.
    State(State),
    /// To a robot.
    Authority(Authority),
    /// To a robot.
    Mission(Mission),
}

impl QueuedMessage {
    /// Bytes of the message behind our datagram's header.
    pub(crate) const fn length_bytes(&self) -> usize {
        HEADER_BYTES
            + match self {
                Self::State(_) => size_of::<State>(),
                Self::Authority(_) => size_of::<Authority>(),
                Self::Mission(_) => size_of::<Mission>(),
            }
    }

    /// At one instant, ports are served in the order in which an endpoint polls them.
    const fn rank(&self) -> Rank {
        match self {
            Self::State(_) => Rank::State,
            Self::Authority(_) => Rank::Authority,
            Self::Mission(_) => Rank::Mission,
        }
    }
}

/// What comes first of several things at one instant: the coordinator takes states and decides,
/// the robots take authorities, then missions, then move; last the referee looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Rank {
    State,
    Cycle,
    Authority,
    Mission,
    Robot,
    Scan,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Flight {
    at: Instant,
    rank: Rank,
    order: u64,
    slot: usize,
}

/// Letters under way, the earliest arrival first; of those at one instant and port, the one
/// posted first.
#[derive(Debug, Default)]
pub(crate) struct MessageQueue {
    flights: BinaryHeap<Reverse<Flight>>,
    queued_messages: Vec<QueuedMessage>,
    free: Vec<usize>,
    posted_count: u64,
}

impl MessageQueue {
    /// Puts a letter under way.
    pub(crate) fn queue(&mut self, at: Instant, queued: QueuedMessage) {
        let slot = if let Some(slot) = self.free.pop() {
            self.queued_messages[slot] = queued;
            slot
        } else {
            self.queued_messages.push(queued);
            self.queued_messages.len() - 1
        };
        self.flights.push(Reverse(Flight {
            at,
            rank: queued.rank(),
            order: self.posted_count,
            slot,
        }));
        self.posted_count += 1;
    }

    /// When the next letter arrives and at which port.
    pub(crate) fn next(&self) -> Option<(Instant, Rank)> {
        let Reverse(flight) = self.flights.peek()?;
        Some((flight.at, flight.rank))
    }

    /// Takes the next letter, whenever it arrives.
    pub(crate) fn take(&mut self) -> Option<QueuedMessage> {
        let Reverse(flight) = self.flights.pop()?;
        self.free.push(flight.slot);
        Some(self.queued_messages[flight.slot])
    }
}

/// How the coordinator learns what the robots do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StatusPath {
    /// It reads their true state at each decision, whatever the network does; missions reach the
    /// robots at once. The original since 2020.
    Bypass,
    /// By messages over the network.
    #[default]
    Network,
}

/// What lies between coordinator and robots.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
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
        self.robot.check()?;
        self.coordinator.check()?;
        self.missions.check()?;
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

#[cfg(test)]
mod post_tests {
    use super::*;
    use crate::messages::Header;

    fn authority(sequence: u32) -> QueuedMessage {
        QueuedMessage::Authority(Authority {
            sequence,
            ..Authority::default()
        })
    }

    #[test]
    fn letters_arrive_by_time_then_port_then_order() {
        let (early, late) = (Instant::from_ns(1), Instant::from_ns(2));
        let mut queue = MessageQueue::default();
        let mission = QueuedMessage::Mission(Mission::default());
        let state = QueuedMessage::State(State {
            header: Header::default(),
            ..State::default()
        });
        queue.queue(late, authority(1));
        for queued in [mission, authority(2), authority(3), state] {
            queue.queue(early, queued);
        }
        assert_eq!(queue.next(), Some((early, Rank::State)));
        let taken: Vec<_> = core::iter::from_fn(|| queue.take()).collect();
        let expected = [state, authority(2), authority(3), mission, authority(1)];
        assert_eq!(taken, expected);
        queue.queue(late, mission);
        assert_eq!(queue.queued_messages.len(), 5, "a slot is used again");
    }
}
