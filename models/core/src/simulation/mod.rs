//! The virtual-time driver: state machines, the messages between them, what carries these and
//! whoever observes. It waits for nothing and reads no clock.
//!
//! One loop serves every model. [`CaseModel`] joins the roles of any case by channels of bytes; a
//! case that needs speed brings a model of its own, with its messages as values.

mod case_model;
#[cfg(test)]
mod tests;

use core::cmp::Reverse;
use core::fmt::Debug;
use std::collections::BinaryHeap;

use crate::time::Instant;

pub use case_model::{
    Carrier, CaseModel, ChannelCounts, ChannelMessage, SimulationError, SimulationResult,
};

/// State machines with events of their own that send each other messages.
pub trait Model: Sized + Debug {
    /// What they send.
    type Message: Debug;
    /// What they tell the record, and nobody else.
    type Record;
    /// What carries the messages.
    type Network: Network<Self::Message> + Debug;
    /// Order of what is due at one instant.
    type Rank: Copy + Ord + Debug;

    /// When a message is received among others of its instant.
    fn rank(message: &Self::Message) -> Self::Rank;

    /// Begins; called once, before anything else.
    fn start<O: Observe<Self>>(&mut self, medium: &mut Medium<'_, Self, O>);

    /// The next event of its own; `None` when only a message can cause one.
    fn next(&self) -> Option<Due<Self::Rank>>;

    /// Does what [`Model::next`] named.
    fn advance<O: Observe<Self>>(&mut self, rank: Self::Rank, medium: &mut Medium<'_, Self, O>);

    /// Receives a message that has arrived.
    fn receive<O: Observe<Self>>(
        &mut self,
        message: Self::Message,
        medium: &mut Medium<'_, Self, O>,
    );
}

/// What lies between the state machines of a model.
pub trait Network<M> {
    /// Offers a message; every arrival it causes goes to `deliver` with its time, which is not
    /// before `now`. Calls come in non-decreasing `now`.
    fn offer(&mut self, now: Instant, message: &M, deliver: impl FnMut(Instant, M));
}

/// A network for models that only receive.
impl<M> Network<M> for () {
    fn offer(&mut self, _now: Instant, _message: &M, _deliver: impl FnMut(Instant, M)) {}
}

/// Takes note of a simulation and changes nothing of it.
pub trait Observe<M: Model> {
    /// A message is published into the network.
    fn offered(&mut self, _now: Instant, _message: &M::Message) {}

    /// The message published at `now` arrives at `at`; called when it is published, once per
    /// arrival, in order of time.
    fn delivered(&mut self, _now: Instant, _message: &M::Message, _at: Instant) {}

    /// The message published at `now` does not arrive.
    fn dropped(&mut self, _now: Instant, _message: &M::Message) {}

    /// Something is told the record.
    fn recorded(&mut self, _now: Instant, _record: &M::Record) {}

    /// When it next wants [`Observe::ticked`].
    fn next_tick(&self) -> Option<Instant> {
        None
    }

    /// The instant it asked for has come, and all that was due then is done.
    fn ticked(&mut self, _now: Instant) {}
}

impl<M: Model> Observe<M> for () {}

/// Both, the first one first.
impl<M: Model, A: Observe<M>, B: Observe<M>> Observe<M> for (&mut A, &mut B) {
    fn offered(&mut self, now: Instant, message: &M::Message) {
        self.0.offered(now, message);
        self.1.offered(now, message);
    }

    fn delivered(&mut self, now: Instant, message: &M::Message, at: Instant) {
        self.0.delivered(now, message, at);
        self.1.delivered(now, message, at);
    }

    fn dropped(&mut self, now: Instant, message: &M::Message) {
        self.0.dropped(now, message);
        self.1.dropped(now, message);
    }

    fn recorded(&mut self, now: Instant, record: &M::Record) {
        self.0.recorded(now, record);
        self.1.recorded(now, record);
    }

    fn next_tick(&self) -> Option<Instant> {
        let ticks = [self.0.next_tick(), self.1.next_tick()];
        ticks.into_iter().flatten().min()
    }

    fn ticked(&mut self, now: Instant) {
        if self.0.next_tick().is_some_and(|due| due <= now) {
            self.0.ticked(now);
        }
        if self.1.next_tick().is_some_and(|due| due <= now) {
            self.1.ticked(now);
        }
    }
}

/// Something that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Due<R> {
    /// When.
    pub at: Instant,
    /// Its place among what is due at that instant.
    pub rank: R,
}

/// What a model sends its messages into.
#[derive(Debug)]
pub struct Medium<'s, M: Model, O> {
    /// The present instant.
    pub now: Instant,
    /// What carries the messages.
    pub network: &'s mut M::Network,
    queue: &'s mut MessageQueue<M::Message, M::Rank>,
    observer: &'s mut O,
}

impl<M: Model, O: Observe<M>> Medium<'_, M, O> {
    /// Publishes a message into the network.
    pub fn send(&mut self, message: &M::Message) {
        let Self {
            now,
            network,
            queue,
            observer,
        } = self;
        let now = *now;
        observer.offered(now, message);
        let mut is_dropped = true;
        network.offer(now, message, |at, arriving| {
            let at = at.max(now);
            is_dropped = false;
            observer.delivered(now, message, at);
            let rank = M::rank(&arriving);
            queue.push(Due { at, rank }, arriving);
        });
        if is_dropped {
            observer.dropped(now, message);
        }
    }

    /// Tells the record.
    pub fn record(&mut self, record: &M::Record) {
        self.observer.recorded(self.now, record);
    }
}

/// A model in virtual time.
#[derive(Debug)]
pub struct Simulation<M: Model = CaseModel> {
    now: Instant,
    is_started: bool,
    model: M,
    network: M::Network,
    queue: MessageQueue<M::Message, M::Rank>,
}

impl<M: Model> Simulation<M> {
    /// A model with its network, before its start.
    pub fn of(model: M, network: M::Network) -> Self {
        Self {
            now: Instant::ZERO,
            is_started: false,
            model,
            network,
            queue: MessageQueue::default(),
        }
    }

    /// How far it has come.
    pub const fn now(&self) -> Instant {
        self.now
    }

    /// The model.
    pub const fn model(&self) -> &M {
        &self.model
    }

    /// The model, when its run is over.
    pub fn into_model(self) -> M {
        self.model
    }

    /// The network.
    pub const fn network(&self) -> &M::Network {
        &self.network
    }

    /// Runs until just before `end`; the first call starts the model.
    pub fn run_until<O: Observe<M>>(&mut self, end: Instant, observer: &mut O) {
        if !self.is_started {
            self.is_started = true;
            let (model, mut medium) = self.parts(observer);
            model.start(&mut medium);
        }
        loop {
            // A model that has fallen behind goes on from the present instant.
            let own = self.model.next().map(|own| Due {
                at: own.at.max(self.now),
                ..own
            });
            let arrival = self.queue.next();
            let is_arrival = match (own, arrival) {
                (Some(own), Some(arrival)) => arrival <= own,
                (_, arrival) => arrival.is_some(),
            };
            let next = if is_arrival { arrival } else { own };
            let at = next.map_or(end, |due| due.at.min(end));
            if let Some(tick) = observer.next_tick().filter(|tick| *tick < at) {
                self.now = self.now.max(tick);
                observer.ticked(self.now);
                continue;
            }
            let Some(due) = next.filter(|due| due.at < end) else {
                break;
            };
            self.now = due.at;
            let message = if is_arrival { self.queue.pop() } else { None };
            let (model, mut medium) = self.parts(observer);
            match message {
                Some(message) => model.receive(message, &mut medium),
                None => model.advance(due.rank, &mut medium),
            }
        }
        self.now = self.now.max(end);
    }

    fn parts<'s, O>(&'s mut self, observer: &'s mut O) -> (&'s mut M, Medium<'s, M, O>) {
        let medium = Medium {
            now: self.now,
            network: &mut self.network,
            queue: &mut self.queue,
            observer,
        };
        (&mut self.model, medium)
    }
}

/// Messages under way, the earliest arrival first; of those at one instant and rank, the one sent
/// first.
#[derive(Debug)]
struct MessageQueue<M, R> {
    flights: BinaryHeap<Reverse<Flight<R>>>,
    messages: Vec<Option<M>>,
    free: Vec<usize>,
    sent_count: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Flight<R> {
    due: Due<R>,
    order: u64,
    slot: usize,
}

impl<M, R: Ord> Default for MessageQueue<M, R> {
    fn default() -> Self {
        Self {
            flights: BinaryHeap::new(),
            messages: Vec::new(),
            free: Vec::new(),
            sent_count: 0,
        }
    }
}

impl<M, R: Copy + Ord> MessageQueue<M, R> {
    fn push(&mut self, due: Due<R>, message: M) {
        let slot = if let Some(slot) = self.free.pop() {
            self.messages[slot] = Some(message);
            slot
        } else {
            self.messages.push(Some(message));
            self.messages.len() - 1
        };
        let order = self.sent_count;
        self.sent_count += 1;
        self.flights.push(Reverse(Flight { due, order, slot }));
    }

    /// When the next message arrives.
    fn next(&self) -> Option<Due<R>> {
        self.flights.peek().map(|Reverse(flight)| flight.due)
    }

    /// Takes the next message, whenever it arrives.
    fn pop(&mut self) -> Option<M> {
        let Reverse(flight) = self.flights.pop()?;
        self.free.push(flight.slot);
        self.messages[flight.slot].take()
    }

    /// Every message under way, in no particular order.
    fn iter(&self) -> impl Iterator<Item = &M> {
        self.messages.iter().flatten()
    }
}
