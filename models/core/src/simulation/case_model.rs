//! The roles of a case as a model: the same endpoints that run as processes, joined by link models
//! instead of channels. Its messages are bytes, as in shared memory.

use core::convert::Infallible;
use core::time::Duration;
use std::collections::{BTreeMap, VecDeque};

use crate::case_study::{CaseStudy, ChannelSpec, channels_of};
use crate::component::{Port, Role};
use crate::endpoint::{Endpoint, InputPort, OutputPort, PortError};
use crate::link_model::{LinkModel, LossCauses, PerfectLink};
use crate::message::Envelope;
use crate::run_log::RunLog;
use crate::simulation::{Due, Medium, Model, Network, Observe, Simulation};
use crate::time::Instant;

/// Endpoints may answer each other without delay this often at one instant before that is called
/// an endless loop.
const ROUNDS_PER_INSTANT_MAX: u32 = 10_000;

/// What carries the messages of one channel: a link model, or in tests the real wire codec.
pub trait Carrier: core::fmt::Debug {
    /// Offers a message; every arrival it causes goes to `deliver` with its time.
    fn offer(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
        deliver: &mut dyn FnMut(Instant, Envelope, &[u8]),
    );

    /// What the messages lost so far were lost to; `None` for one that does not tell causes apart.
    fn losses(&self) -> Option<LossCauses> {
        None
    }
}

impl<L: LinkModel> Carrier for L {
    fn offer(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
        deliver: &mut dyn FnMut(Instant, Envelope, &[u8]),
    ) {
        let fate = self.offer_numbered(now, payload.len(), envelope.into());
        for at in fate.arrivals() {
            deliver(at, *envelope, payload);
        }
    }

    fn losses(&self) -> Option<LossCauses> {
        self.loss_causes()
    }
}

/// Why there is no simulation, or why it stopped early.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SimulationError {
    /// A channel was named that the case does not have.
    #[error("case {case} has no channel {channel}")]
    UnknownChannel {
        /// The case.
        case: &'static str,
        /// The unknown name.
        channel: String,
    },
    /// The case's roles and channels contradict each other.
    #[error(transparent)]
    Ports(PortError),
    /// The case lists a role it cannot make.
    #[error("case {case} lists role {role} but makes none")]
    MissingRole {
        /// The case.
        case: &'static str,
        /// The role.
        role: &'static str,
    },
    /// A carrier was given for a channel that nothing carries.
    #[error("channel {channel} of case {case} is only recorded; nothing carries it")]
    RecordedChannel {
        /// The case.
        case: &'static str,
        /// The channel.
        channel: &'static str,
    },
    /// Roles kept answering each other without any delay.
    #[error("roles answer each other without delay at {at}; give one of them a period")]
    ZeroDelayLoop {
        /// Where virtual time stood.
        at: Instant,
    },
}

/// How one channel fared in virtual time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ChannelCounts {
    /// Messages published.
    pub published_count: u64,
    /// Of these, those that never arrive.
    pub lost_count: u64,
    /// Messages that arrived and were taken; duplicates count again.
    pub taken_count: u64,
    /// Arrivals still under way when the run ended.
    pub in_flight_count: u64,
    /// What the lost ones were lost to, where the carrier tells causes apart.
    pub losses: Option<LossCauses>,
}

/// The outcome of a run in virtual time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SimulationResult {
    /// Every published message, and every one that was only recorded.
    pub log: RunLog,
    /// Counts by name of channel between two roles.
    pub channels: BTreeMap<&'static str, ChannelCounts>,
    /// Messages by name of channel that is only recorded.
    pub recorded_counts: BTreeMap<&'static str, u64>,
}

/// A message on a channel of a case.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelMessage {
    /// Its channel.
    pub spec: &'static ChannelSpec,
    /// Sequence, epoch and publication time.
    pub envelope: Envelope,
    /// The payload as published.
    pub payload: Vec<u8>,
    /// The channel's place in the list of the case.
    channel: usize,
}

impl Observe<CaseModel> for RunLog {
    fn offered(&mut self, _now: Instant, message: &ChannelMessage) {
        self.push(message.spec.name, message.envelope, &message.payload);
    }

    fn recorded(&mut self, now: Instant, message: &ChannelMessage) {
        Observe::<CaseModel>::offered(self, now, message);
    }
}

/// The roles of a case.
#[derive(Debug)]
pub struct CaseModel {
    endpoints: Vec<Endpoint<Inbox, Outbox>>,
    /// Per endpoint, when it has something to do.
    due: Vec<Option<Instant>>,
    /// Per endpoint, the channels of its output ports.
    outputs: Vec<Vec<usize>>,
    /// The instant that endpoints are polled at, in turn and round after round.
    instant: Instant,
    turn: usize,
    round_count: u32,
    /// Where endpoints answer each other for ever.
    loops_at: Option<Instant>,
}

/// The channels of a case and what carries them.
#[derive(Debug)]
pub struct Channels(Vec<Channel>);

#[derive(Debug)]
struct Channel {
    spec: &'static ChannelSpec,
    carrier: Box<dyn Carrier>,
    /// Where it ends; `None` when it is only recorded.
    to: Option<PortPlace>,
    counts: ChannelCounts,
}

#[derive(Debug, Clone, Copy)]
struct PortPlace {
    endpoint: usize,
    port: usize,
}

/// What comes first of several things at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum CaseRank {
    /// A message reaches the inbox of its port.
    Arrival,
    /// An endpoint is polled.
    Poll,
}

impl Network<ChannelMessage> for Channels {
    fn offer(
        &mut self,
        now: Instant,
        message: &ChannelMessage,
        mut deliver: impl FnMut(Instant, ChannelMessage),
    ) {
        let &ChannelMessage { spec, channel, .. } = message;
        let Channel {
            carrier, counts, ..
        } = &mut self.0[channel];
        let mut arrival_count = 0_u64;
        let mut arrived = |at, envelope, payload: &[u8]| {
            arrival_count += 1;
            let payload = payload.to_vec();
            deliver(
                at,
                ChannelMessage {
                    spec,
                    envelope,
                    payload,
                    channel,
                },
            );
        };
        carrier.offer(now, &message.envelope, &message.payload, &mut arrived);
        counts.lost_count += u64::from(arrival_count == 0);
    }
}

impl Model for CaseModel {
    type Message = ChannelMessage;
    type Record = ChannelMessage;
    type Network = Channels;
    type Rank = CaseRank;

    fn rank(_message: &ChannelMessage) -> CaseRank {
        CaseRank::Arrival
    }

    fn start<O: Observe<Self>>(&mut self, medium: &mut Medium<'_, Self, O>) {
        for index in 0..self.endpoints.len() {
            match self.endpoints[index].start(medium.now) {
                Ok(_) => {}
                Err(never) => match never {},
            }
            self.give(index, medium);
        }
    }

    fn next(&self) -> Option<Due<CaseRank>> {
        let due = self.due.iter().flatten().min();
        let at = *due.filter(|_| self.loops_at.is_none())?;
        let rank = CaseRank::Poll;
        Some(Due { at, rank })
    }

    /// Polls the next endpoint of the round.
    fn advance<O: Observe<Self>>(&mut self, _rank: CaseRank, medium: &mut Medium<'_, Self, O>) {
        let now = medium.now;
        if now > self.instant {
            (self.instant, self.turn, self.round_count) = (now, 0, 0);
        }
        let mut due = self.due.iter().enumerate();
        let is_due = |(_, due): &(usize, &Option<Instant>)| due.is_some_and(|due| due <= now);
        let next = due.clone().skip(self.turn).find(is_due).or_else(|| {
            self.round_count += 1;
            due.find(is_due)
        });
        let Some((index, _)) = next else {
            return;
        };
        if self.round_count > ROUNDS_PER_INSTANT_MAX {
            self.loops_at = Some(now);
            return;
        }
        self.turn = index + 1;
        let endpoint = &mut self.endpoints[index];
        match endpoint.poll(now) {
            Ok(_) => {}
            Err(never) => match never {},
        }
        self.give(index, medium);
    }

    fn receive<O: Observe<Self>>(
        &mut self,
        message: ChannelMessage,
        medium: &mut Medium<'_, Self, O>,
    ) {
        let channel = &mut medium.network.0[message.channel];
        let Some(to) = channel.to else {
            return;
        };
        channel.counts.taken_count += 1;
        self.endpoints[to.endpoint].inputs_mut()[to.port]
            .0
            .push_back(message);
        let due = &mut self.due[to.endpoint];
        *due = Some(due.map_or(medium.now, |due| due.min(medium.now)));
    }
}

impl CaseModel {
    /// Notes when an endpoint has something to do, and gives what it sent to the channels.
    fn give<O: Observe<Self>>(&mut self, index: usize, medium: &mut Medium<'_, Self, O>) {
        let now = medium.now;
        let endpoint = &mut self.endpoints[index];
        self.due[index] = endpoint.next_wakeup();
        let ports = endpoint.outputs_mut().iter_mut();
        for (port, &channel) in ports.zip(&self.outputs[index]) {
            for payload in port.0.drain(..) {
                let Channel { spec, counts, .. } = &mut medium.network.0[channel];
                let envelope = Envelope {
                    sequence: counts.published_count,
                    published_ns: now.as_ns(),
                    ..Envelope::default()
                };
                counts.published_count += 1;
                let message = ChannelMessage {
                    spec,
                    envelope,
                    payload,
                    channel,
                };
                if message.spec.is_recorded_only() {
                    medium.record(&message);
                } else {
                    medium.send(&message);
                }
            }
        }
    }
}

impl Simulation {
    /// Wires the roles of `case`; channels without an entry in `carriers` are perfect.
    ///
    /// # Errors
    /// When `carriers` names an unknown channel or the case's wiring contradicts itself.
    pub fn new<C: CaseStudy>(
        case: &C,
        carriers: BTreeMap<String, Box<dyn Carrier>>,
    ) -> Result<Self, SimulationError> {
        let make = |role: &'static str| {
            case.role(role).ok_or(SimulationError::MissingRole {
                case: C::NAME,
                role,
            })
        };
        let roles = C::ROLES
            .iter()
            .map(|&role| Ok((role, make(role)?)))
            .collect::<Result<_, _>>()?;
        Self::of_roles(C::NAME, C::CHANNELS, roles, carriers)
    }

    /// As [`Simulation::new`], for roles whose case type is no longer known.
    ///
    /// # Errors
    /// As [`Simulation::new`].
    pub fn of_roles(
        case: &'static str,
        specs: &'static [ChannelSpec],
        roles: Vec<(&'static str, Box<dyn Role>)>,
        mut carriers: BTreeMap<String, Box<dyn Carrier>>,
    ) -> Result<Self, SimulationError> {
        let mut channels = Vec::with_capacity(specs.len());
        for spec in specs {
            let carrier = carriers.remove(spec.name);
            if spec.is_recorded_only() && carrier.is_some() {
                let channel = spec.name;
                return Err(SimulationError::RecordedChannel { case, channel });
            }
            channels.push(Channel {
                spec,
                carrier: carrier.unwrap_or_else(|| Box::new(PerfectLink)),
                to: None,
                counts: ChannelCounts::default(),
            });
        }
        if let Some(channel) = carriers.into_keys().next() {
            return Err(SimulationError::UnknownChannel { case, channel });
        }
        let (mut endpoints, mut outputs) = (Vec::new(), Vec::new());
        for (role, component) in roles {
            let stated = channels_of(case, specs, role);
            // Joined before: every port has a channel of its name.
            let place = |port: &Port| specs.iter().position(|spec| spec.name == port.name);
            stated
                .check(component.as_ref())
                .map_err(SimulationError::Ports)?;
            for (port, channel) in component.inputs().iter().filter_map(place).enumerate() {
                let endpoint = endpoints.len();
                channels[channel].to = Some(PortPlace { endpoint, port });
            }
            let written: Vec<usize> = component.outputs().iter().filter_map(place).collect();
            let open_input = |_: &Port| Ok(Inbox::default());
            let open_output = |_: &Port| Ok(Outbox::default());
            let endpoint = Endpoint::join(component, &stated, open_input, open_output)
                .map_err(SimulationError::Ports)?;
            endpoints.push(endpoint);
            outputs.push(written);
        }
        let model = CaseModel {
            due: vec![None; endpoints.len()],
            endpoints,
            outputs,
            instant: Instant::ZERO,
            turn: 0,
            round_count: 0,
            loops_at: None,
        };
        Ok(Self::of(model, Channels(channels)))
    }

    /// Runs from [`Instant::ZERO`] for `duration`.
    ///
    /// # Errors
    /// [`SimulationError::ZeroDelayLoop`].
    pub fn run(self, duration: Duration) -> Result<SimulationResult, SimulationError> {
        self.run_observed(duration, &mut ())
    }

    /// As [`Self::run`], with an observer beside the log.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn run_observed(
        mut self,
        duration: Duration,
        observer: &mut impl Observe<CaseModel>,
    ) -> Result<SimulationResult, SimulationError> {
        let mut log = RunLog::default();
        // What is due at the very end belongs to the run.
        let end = Instant::ZERO + duration + Duration::from_nanos(1);
        self.run_until(end, &mut (&mut log, observer));
        if let Some(at) = self.model.loops_at {
            return Err(SimulationError::ZeroDelayLoop { at });
        }
        for message in self.queue.iter() {
            self.network.0[message.channel].counts.in_flight_count += 1;
        }
        let (recorded, carried): (Vec<_>, Vec<_>) = self
            .network
            .0
            .iter()
            .partition(|channel| channel.spec.is_recorded_only());
        let carried = carried.into_iter().map(|channel| {
            let losses = channel.carrier.losses();
            let counts = ChannelCounts {
                losses,
                ..channel.counts
            };
            (channel.spec.name, counts)
        });
        let recorded = recorded.into_iter();
        Ok(SimulationResult {
            channels: carried.collect(),
            recorded_counts: recorded
                .map(|channel| (channel.spec.name, channel.counts.published_count))
                .collect(),
            log,
        })
    }
}

/// What has arrived at an input port.
#[derive(Debug, Default)]
struct Inbox(VecDeque<ChannelMessage>);

impl InputPort for Inbox {
    type Error = Infallible;

    fn receive(
        &mut self,
        _now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, Infallible> {
        let Some(message) = self.0.pop_front() else {
            return Ok(false);
        };
        take(&message.envelope, &message.payload);
        Ok(true)
    }

    fn next_arrival(&self) -> Option<Instant> {
        // Whatever is here has arrived.
        (!self.0.is_empty()).then_some(Instant::ZERO)
    }
}

/// What one poll gave to an output port.
#[derive(Debug, Default)]
struct Outbox(Vec<Vec<u8>>);

impl OutputPort for Outbox {
    type Error = Infallible;

    fn send(&mut self, _now: Instant, payload: &[u8]) -> Result<(), Infallible> {
        self.0.push(payload.to_vec());
        Ok(())
    }
}
