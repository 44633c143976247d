//! What a channel carries, as two processes compare it at run time.

use core::fmt;

use hil_core::message::MessageType;

/// Name, size and alignment of a channel's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeInfo {
    /// [`Message::NAME`](hil_core::message::Message::NAME); at most 255 characters.
    pub name: String,
    /// Size of one message.
    pub size_bytes: usize,
    /// Alignment in shared memory.
    pub alignment_bytes: usize,
}

impl TypeInfo {
    /// The identity of a message type as this process was compiled.
    pub fn of(message: &MessageType) -> Self {
        Self {
            name: message.name.to_owned(),
            size_bytes: message.size_bytes,
            alignment_bytes: message.alignment_bytes,
        }
    }
}

impl fmt::Display for TypeInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            size_bytes,
            alignment_bytes,
        } = self;
        write!(
            f,
            "{name} ({size_bytes} bytes aligned to {alignment_bytes})"
        )
    }
}
