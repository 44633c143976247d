//! The virtual-time driver: the same endpoints that run as processes, joined by link models
//! instead of channels. It waits for nothing and reads no clock.

use core::cell::{Cell, RefCell};
use core::cmp::Reverse;
use core::convert::Infallible;
use core::time::Duration;
use std::collections::{BTreeMap, BinaryHeap};
use std::rc::Rc;

use crate::case_study::{CaseStudy, ChannelSpec, channels_of};
use crate::component::{Port, Role};
use crate::endpoint::{Endpoint, InputPort, OutputPort, PortError};
use crate::link_model::{LinkModel, PerfectLink};
use crate::message::Envelope;
use crate::run_log::RunLog;
use crate::time::Instant;

/// Endpoints may answer each other without delay this often at one instant before the driver
/// calls it an endless loop.
const ROUNDS_PER_INSTANT_MAX: u32 = 10_000;
/// Turns from one word on the time that has come to the next.
const TURNS_PER_WORD: u64 = 16_384;

/// What carries messages in virtual time: a link model, or in tests the real wire codec.
pub trait Carrier: core::fmt::Debug {
    /// Offers a message; every arrival it causes goes to `deliver` with its time.
    fn offer(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
        deliver: &mut dyn FnMut(Instant, Envelope, &[u8]),
    );
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
        for at in [fate.arrival(), fate.second_arrival()]
            .into_iter()
            .flatten()
        {
            deliver(at, *envelope, payload);
        }
    }
}

/// Why a simulation stopped early.
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
    /// Messages that arrived and were taken; duplicates count again.
    pub taken_count: u64,
    /// Arrivals still under way when the run ended.
    pub in_flight_count: u64,
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

/// A case in virtual time.
#[derive(Debug)]
pub struct Simulation {
    endpoints: Vec<Endpoint<SimInput, SimOutput>>,
    channels: BTreeMap<&'static str, Rc<RefCell<SimChannel>>>,
    recorded: BTreeMap<&'static str, Rc<Cell<u64>>>,
    log: Rc<RefCell<RunLog>>,
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
        let log = Rc::new(RefCell::new(RunLog::default()));
        let mut channels = BTreeMap::new();
        let mut recorded: BTreeMap<&'static str, Rc<Cell<u64>>> = BTreeMap::new();
        for spec in specs {
            let carrier = carriers.remove(spec.name);
            if spec.is_recorded_only() {
                if carrier.is_some() {
                    let channel = spec.name;
                    return Err(SimulationError::RecordedChannel { case, channel });
                }
                recorded.insert(spec.name, Rc::default());
                continue;
            }
            let carrier = carrier.unwrap_or_else(|| Box::new(PerfectLink));
            channels.insert(spec.name, Rc::new(RefCell::new(SimChannel::new(carrier))));
        }
        if let Some(channel) = carriers.into_keys().next() {
            return Err(SimulationError::UnknownChannel { case, channel });
        }
        let mut endpoints = Vec::new();
        for (role, component) in roles {
            let open_input = |port: &Port| {
                Ok(SimInput {
                    channel: Rc::clone(&channels[port.name]),
                })
            };
            let open_output = |port: &Port| {
                Ok(SimOutput {
                    name: port.name,
                    destination: match recorded.get(port.name) {
                        Some(count) => SimDestination::Record(Rc::clone(count)),
                        None => SimDestination::Channel(Rc::clone(&channels[port.name])),
                    },
                    log: Rc::clone(&log),
                })
            };
            let stated = channels_of(case, specs, role);
            let endpoint = Endpoint::join(component, &stated, open_input, open_output)
                .map_err(SimulationError::Ports)?;
            endpoints.push(endpoint);
        }
        Ok(Self {
            endpoints,
            channels,
            recorded,
            log,
        })
    }

    /// Runs from [`Instant::ZERO`] for `duration`.
    ///
    /// # Errors
    /// [`SimulationError::ZeroDelayLoop`].
    pub fn run(self, duration: Duration) -> Result<SimulationResult, SimulationError> {
        self.run_watched(duration, &mut |_| {})
    }

    /// As [`Self::run`]; tells `watch` now and then which instant has come.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn run_watched(
        mut self,
        duration: Duration,
        watch: &mut dyn FnMut(Instant),
    ) -> Result<SimulationResult, SimulationError> {
        let end = Instant::ZERO + duration;
        for endpoint in &mut self.endpoints {
            endpoint.start(Instant::ZERO);
        }
        let (mut now, mut rounds) = (Instant::ZERO, 0);
        let mut turn_count = 0_u64;
        while let Some(next) = self
            .endpoints
            .iter()
            .filter_map(Endpoint::next_wakeup)
            .min()
        {
            if next > end {
                break;
            }
            rounds = if next > now { 0 } else { rounds + 1 };
            if rounds > ROUNDS_PER_INSTANT_MAX {
                return Err(SimulationError::ZeroDelayLoop { at: now });
            }
            now = now.max(next);
            turn_count += 1;
            if turn_count.is_multiple_of(TURNS_PER_WORD) {
                watch(now);
            }
            for endpoint in &mut self.endpoints {
                if endpoint.next_wakeup().is_some_and(|due| due <= now) {
                    match endpoint.poll(now) {
                        Ok(_) => {}
                        Err(never) => match never {},
                    }
                }
            }
        }
        Ok(self.finish())
    }

    fn finish(self) -> SimulationResult {
        let counts = |channel: &Rc<RefCell<SimChannel>>| {
            let channel = channel.borrow();
            let in_flight_count = channel.queue.len() as u64;
            ChannelCounts {
                in_flight_count,
                ..channel.counts
            }
        };
        let channels = self
            .channels
            .iter()
            .map(|(name, channel)| (*name, counts(channel)));
        let recorded = self.recorded.iter();
        SimulationResult {
            channels: channels.collect(),
            recorded_counts: recorded.map(|(name, count)| (*name, count.get())).collect(),
            log: self.log.take(),
        }
    }
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Arrival {
    at: Instant,
    order: u64,
    sequence: u64,
    published_ns: i64,
    epoch: u32,
    payload: Vec<u8>,
}

#[derive(Debug)]
struct SimChannel {
    carrier: Box<dyn Carrier>,
    queue: BinaryHeap<Reverse<Arrival>>,
    arrival_order: u64,
    counts: ChannelCounts,
}

impl SimChannel {
    fn new(carrier: Box<dyn Carrier>) -> Self {
        Self {
            carrier,
            queue: BinaryHeap::new(),
            arrival_order: 0,
            counts: ChannelCounts::default(),
        }
    }

    fn send(&mut self, now: Instant, payload: &[u8]) -> Envelope {
        let envelope = Envelope {
            sequence: self.counts.published_count,
            published_ns: now.as_ns(),
            ..Envelope::default()
        };
        self.counts.published_count += 1;
        let Self {
            carrier,
            queue,
            arrival_order,
            ..
        } = self;
        carrier.offer(now, &envelope, payload, &mut |at, envelope, payload| {
            queue.push(Reverse(Arrival {
                at: at.max(now),
                order: *arrival_order,
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                epoch: envelope.epoch,
                payload: payload.to_vec(),
            }));
            *arrival_order += 1;
        });
        envelope
    }

    fn take(&mut self, now: Instant) -> Option<Arrival> {
        if self.queue.peek()?.0.at > now {
            return None;
        }
        self.counts.taken_count += 1;
        self.queue.pop().map(|Reverse(arrival)| arrival)
    }
}

#[derive(Debug)]
struct SimInput {
    channel: Rc<RefCell<SimChannel>>,
}

impl InputPort for SimInput {
    type Error = Infallible;

    fn receive(
        &mut self,
        now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, Infallible> {
        // The borrow ends before `take`, which may send on this very channel.
        let arrival = self.channel.borrow_mut().take(now);
        let Some(arrival) = arrival else {
            return Ok(false);
        };
        let envelope = Envelope {
            sequence: arrival.sequence,
            published_ns: arrival.published_ns,
            epoch: arrival.epoch,
            ..Envelope::default()
        };
        take(&envelope, &arrival.payload);
        Ok(true)
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.channel
            .borrow()
            .queue
            .peek()
            .map(|Reverse(arrival)| arrival.at)
    }
}

#[derive(Debug)]
struct SimOutput {
    name: &'static str,
    destination: SimDestination,
    log: Rc<RefCell<RunLog>>,
}

#[derive(Debug)]
enum SimDestination {
    Channel(Rc<RefCell<SimChannel>>),
    /// Nobody takes it; what is counted are the messages so far.
    Record(Rc<Cell<u64>>),
}

impl OutputPort for SimOutput {
    type Error = Infallible;

    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), Infallible> {
        let envelope = match &self.destination {
            SimDestination::Channel(channel) => channel.borrow_mut().send(now, payload),
            SimDestination::Record(count) => Envelope {
                sequence: count.replace(count.get() + 1),
                published_ns: now.as_ns(),
                ..Envelope::default()
            },
        };
        self.log.borrow_mut().push(self.name, envelope, payload);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
