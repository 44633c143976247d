//! A component: one role of a robot's loop as a state machine. It neither waits nor sends; it is
//! handed messages and the time, and fills an outbox.

use core::fmt::Debug;

use crate::message::{MessageSet, MessageType};
use crate::time::Instant;

/// What a user writes: a controller, a robot model, a source of motion.
pub trait Component {
    /// What arrives, one port per message type.
    type Input: MessageSet;
    /// What leaves, one port per message type.
    type Output: MessageSet;

    /// Called once, before anything else; anchors timers at `now`.
    fn on_start(&mut self, now: Instant);

    /// Called for each message, in order of arrival per port.
    fn on_message(&mut self, now: Instant, input: &Self::Input, out: &mut Outbox<Self::Output>);

    /// Called when [`Component::next_tick`] is due; may be called early and then does nothing.
    fn on_tick(&mut self, now: Instant, out: &mut Outbox<Self::Output>);

    /// When this component next wants [`Component::on_tick`]; `None` if only messages drive it.
    fn next_tick(&self) -> Option<Instant>;

    /// Grid points of the component's own timer that went by without a tick.
    fn skipped_ticks(&self) -> u64;

    /// Messages one call may give at most; asked once, when the component becomes a role.
    /// Beyond it messages are dropped and counted.
    fn outbox_capacity(&self) -> usize {
        OUTBOX_CAPACITY
    }
}

/// The messages a component gives in one call; bounded, and every refusal is counted.
#[derive(Debug)]
pub struct Outbox<T> {
    messages: Vec<T>,
    capacity: usize,
    dropped_count: u64,
}

impl<T> Outbox<T> {
    /// An empty outbox that takes at most `capacity` messages per call.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            messages: Vec::with_capacity(capacity),
            capacity,
            dropped_count: 0,
        }
    }

    /// Gives a message; a full outbox drops and counts it.
    pub fn send(&mut self, message: T) {
        if self.messages.len() < self.capacity {
            self.messages.push(message);
        } else {
            self.dropped_count += 1;
        }
    }

    /// Takes the messages out, oldest first.
    pub fn drain(&mut self) -> impl Iterator<Item = T> + '_ {
        self.messages.drain(..)
    }

    /// Messages refused because the outbox was full.
    pub fn dropped_count(&self) -> u64 {
        self.dropped_count
    }
}

/// Receives one outgoing payload: output port and bytes.
pub type Emit<'a> = &'a mut dyn FnMut(usize, &[u8]);

/// A component whose message types are known only at run time: what a process runs and what the
/// simulation drives. Made from any [`Component`] by [`into_role`].
pub trait Role: Debug {
    /// Message type of each input port.
    fn inputs(&self) -> &'static [MessageType];

    /// Message type of each output port.
    fn outputs(&self) -> &'static [MessageType];

    /// See [`Component::on_start`].
    fn start(&mut self, now: Instant);

    /// See [`Component::on_message`]. False when `payload` is not a message of `port`; the
    /// component does not see it then.
    fn message(&mut self, now: Instant, port: usize, payload: &[u8], emit: Emit<'_>) -> bool;

    /// See [`Component::on_tick`].
    fn tick(&mut self, now: Instant, emit: Emit<'_>);

    /// See [`Component::next_tick`].
    fn next_tick(&self) -> Option<Instant>;

    /// See [`Component::skipped_ticks`].
    fn skipped_ticks(&self) -> u64;

    /// Messages refused by the component's full outbox.
    fn outbox_dropped(&self) -> u64;
}

/// Messages one call of a component may give unless it says otherwise: a few for each of dozens
/// of robots.
pub const OUTBOX_CAPACITY: usize = 256;

/// Hides the message types of `component` behind [`Role`].
pub fn into_role<C: Component + Debug + 'static>(component: C) -> Box<dyn Role> {
    let outbox = Outbox::with_capacity(component.outbox_capacity());
    Box::new(ErasedComponent { component, outbox })
}

#[derive(Debug)]
struct ErasedComponent<C: Component> {
    component: C,
    outbox: Outbox<C::Output>,
}

impl<C: Component> ErasedComponent<C> {
    fn flush(&mut self, emit: Emit<'_>) {
        for message in self.outbox.drain() {
            emit(message.port(), message.as_bytes());
        }
    }
}

impl<C: Component + Debug> Role for ErasedComponent<C> {
    fn inputs(&self) -> &'static [MessageType] {
        C::Input::PORTS
    }

    fn outputs(&self) -> &'static [MessageType] {
        C::Output::PORTS
    }

    fn start(&mut self, now: Instant) {
        self.component.on_start(now);
    }

    fn message(&mut self, now: Instant, port: usize, payload: &[u8], emit: Emit<'_>) -> bool {
        let Some(input) = C::Input::from_bytes(port, payload) else {
            return false;
        };
        self.component.on_message(now, &input, &mut self.outbox);
        self.flush(emit);
        true
    }

    fn tick(&mut self, now: Instant, emit: Emit<'_>) {
        self.component.on_tick(now, &mut self.outbox);
        self.flush(emit);
    }

    fn next_tick(&self) -> Option<Instant> {
        self.component.next_tick()
    }

    fn skipped_ticks(&self) -> u64 {
        self.component.skipped_ticks()
    }

    fn outbox_dropped(&self) -> u64 {
        self.outbox.dropped_count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_outbox_drops_and_counts() {
        let mut outbox = Outbox::with_capacity(2);
        for value in 0..5 {
            outbox.send(value);
        }
        assert_eq!(outbox.drain().collect::<Vec<_>>(), [0, 1]);
        assert_eq!(outbox.dropped_count(), 3);
    }
}
