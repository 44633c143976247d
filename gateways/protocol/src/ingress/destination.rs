//! Where the messages of a flow go: memory in which those in pieces come together, and who takes them when they
//! are whole. The bridge itself keeps no message.

use std::collections::BTreeMap;

use super::delivery::Delivery;

/// A piece of a message, and where it belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Piece<'a> {
    /// Index of its channel in the flow.
    pub channel: usize,
    /// The slot of its message, below [`reassembly_slots`](super::reassembly_slots) of the channel.
    pub slot: usize,
    /// Its message begins: what the slot had before is over.
    pub is_first: bool,
    /// Where it begins in its message, bytes.
    pub offset_bytes: usize,
    /// Its bytes.
    pub payload: &'a [u8],
}

/// The bytes of a whole message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Payload<'a> {
    /// They came in one datagram.
    Datagram(&'a [u8]),
    /// They are where they were stored, every one.
    Stored {
        /// The slot of the message, free for another one afterwards.
        slot: usize,
        /// How many.
        length_bytes: usize,
    },
}

/// Takes what a bridge receives.
pub trait Destination {
    /// Puts a piece into the memory of its slot; false when there is none, and the piece is refused.
    fn store(&mut self, piece: &Piece<'_>) -> bool;

    /// Takes a message.
    fn deliver(&mut self, delivery: &Delivery, payload: Payload<'_>);
}

/// Messages in pieces come together in memory of this process: for simulations, benches and tests. It allocates.
#[derive(Debug, Default)]
pub struct InMemory {
    /// By channel and slot.
    messages: BTreeMap<(usize, usize), Vec<u8>>,
}

impl InMemory {
    /// A destination that hands whole messages to `take`.
    pub fn with<F: FnMut(&Delivery, &[u8])>(&mut self, take: F) -> Taking<'_, F> {
        Taking { memory: self, take }
    }

    /// Puts a piece into the memory of its slot.
    pub fn store(&mut self, piece: &Piece<'_>) {
        let message = self
            .messages
            .entry((piece.channel, piece.slot))
            .or_default();
        if piece.is_first {
            message.clear();
        }
        let end = piece.offset_bytes + piece.payload.len();
        if message.len() < end {
            message.resize(end, 0);
        }
        message[piece.offset_bytes..end].copy_from_slice(piece.payload);
    }

    /// What is stored in a slot; nothing where nothing was.
    pub fn message(&self, channel: usize, slot: usize) -> &[u8] {
        self.messages
            .get(&(channel, slot))
            .map_or(&[], Vec::as_slice)
    }
}

/// An [`InMemory`] with who takes its messages.
#[derive(Debug)]
pub struct Taking<'a, F> {
    memory: &'a mut InMemory,
    take: F,
}

impl<F: FnMut(&Delivery, &[u8])> Destination for Taking<'_, F> {
    fn store(&mut self, piece: &Piece<'_>) -> bool {
        self.memory.store(piece);
        true
    }

    fn deliver(&mut self, delivery: &Delivery, payload: Payload<'_>) {
        let bytes = match payload {
            Payload::Datagram(bytes) => bytes,
            Payload::Stored { slot, .. } => self.memory.message(delivery.message.channel, slot),
        };
        (self.take)(delivery, bytes);
    }
}
