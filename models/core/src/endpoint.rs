//! An endpoint: a role joined to its ports. It is the unit that both virtual and real time drive
//! with `poll(now)` and `next_wakeup()`; which kind of port it has, it does not know.

use core::fmt::Debug;

use crate::component::Role;
use crate::message::Envelope;
use crate::time::Instant;

/// Takes messages from a channel.
pub trait InputPort: Debug {
    /// Why a receive can fail.
    type Error;

    /// Hands the oldest waiting message to `take`; false when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel itself is broken; an empty channel is not an error.
    fn receive(
        &mut self,
        now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, Self::Error>;

    /// When the next message will be there, where that is known (virtual time).
    fn next_arrival(&self) -> Option<Instant>;
}

/// Gives messages to a channel.
pub trait OutputPort: Debug {
    /// Why a send can fail.
    type Error;

    /// Publishes `payload` with the next sequence number. Never blocks.
    ///
    /// # Errors
    /// When the channel itself is broken; having no subscriber is not an error.
    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), Self::Error>;
}

/// Messages taken from one port before the role is ticked; the rest waits for the next poll.
const MESSAGES_PER_POLL_MAX: usize = 1024;

/// What one [`Endpoint::poll`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Activity {
    /// Messages taken.
    pub received_count: u64,
    /// Messages given.
    pub sent_count: u64,
    /// Payloads that were not a message of their port.
    pub malformed_count: u64,
    /// Times the role was ticked.
    pub tick_count: u64,
}

/// A role and its ports.
#[derive(Debug)]
pub struct Endpoint<I, O> {
    role: Box<dyn Role>,
    inputs: Vec<I>,
    outputs: Vec<O>,
}

/// The ports do not fit the role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("role has {expected} {side} ports, {given} were given")]
pub struct PortCountError {
    /// `input` or `output`.
    pub side: &'static str,
    /// Ports of the role.
    pub expected: usize,
    /// Ports given.
    pub given: usize,
}

impl<E, I: InputPort<Error = E>, O: OutputPort<Error = E>> Endpoint<I, O> {
    /// Joins `role` to one port per message type, in port order.
    ///
    /// # Errors
    /// When the number of ports differs from what the role declares.
    pub fn new(
        role: Box<dyn Role>,
        inputs: Vec<I>,
        outputs: Vec<O>,
    ) -> Result<Self, PortCountError> {
        let check = |side, expected: usize, given: usize| {
            if expected == given {
                Ok(())
            } else {
                Err(PortCountError {
                    side,
                    expected,
                    given,
                })
            }
        };
        check("input", role.inputs().len(), inputs.len())?;
        check("output", role.outputs().len(), outputs.len())?;
        Ok(Self {
            role,
            inputs,
            outputs,
        })
    }

    /// Starts the role; call once before the first poll.
    pub fn start(&mut self, now: Instant) {
        self.role.start(now);
    }

    /// Takes the waiting messages, port by port, then ticks the role when due.
    ///
    /// # Errors
    /// The first port that fails.
    pub fn poll(&mut self, now: Instant) -> Result<Activity, E> {
        let mut activity = Activity::default();
        let Self {
            role,
            inputs,
            outputs,
        } = self;
        let mut failed = None;
        for (port, input) in inputs.iter_mut().enumerate() {
            let mut take = |_: &Envelope, payload: &[u8]| {
                activity.received_count += 1;
                let mut emit = emitter(outputs, now, &mut activity.sent_count, &mut failed);
                if !role.message(now, port, payload, &mut emit) {
                    activity.malformed_count += 1;
                }
            };
            // Bounded, so that a flood on one port cannot keep the role from its tick.
            for _ in 0..MESSAGES_PER_POLL_MAX {
                if !input.receive(now, &mut take)? {
                    break;
                }
            }
        }
        if role.next_tick().is_some_and(|due| due <= now) {
            let mut emit = emitter(outputs, now, &mut activity.sent_count, &mut failed);
            role.tick(now, &mut emit);
            activity.tick_count += 1;
        }
        failed.map_or(Ok(activity), Err)
    }

    /// When `poll` next has something to do, as far as this endpoint can know.
    pub fn next_wakeup(&self) -> Option<Instant> {
        let arrivals = self.inputs.iter().filter_map(InputPort::next_arrival);
        arrivals.chain(self.role.next_tick()).min()
    }

    /// The role, for its counters.
    pub fn role(&self) -> &dyn Role {
        self.role.as_ref()
    }

    /// The input ports, in port order.
    pub fn inputs_mut(&mut self) -> &mut [I] {
        &mut self.inputs
    }

    /// The output ports, in port order.
    pub fn outputs_mut(&mut self) -> &mut [O] {
        &mut self.outputs
    }
}

fn emitter<'a, E, O: OutputPort<Error = E>>(
    outputs: &'a mut [O],
    now: Instant,
    sent_count: &'a mut u64,
    failed: &'a mut Option<E>,
) -> impl FnMut(usize, &[u8]) + 'a {
    move |port, payload| match outputs[port].send(now, payload) {
        Ok(()) => *sent_count += 1,
        Err(error) => {
            failed.get_or_insert(error);
        }
    }
}
