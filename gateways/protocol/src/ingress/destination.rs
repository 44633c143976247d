//! Where the messages of a flow go: memory in which those in pieces come together, and who takes them when they
//! are whole. The bridge itself keeps no message.

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
