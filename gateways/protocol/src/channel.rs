//! What both gateways of a channel must agree on, and why settings are refused. It carries no
//! message.

use hil_core::message::type_hash;

use super::body::NAME_BYTES_MAX;

/// A channel as both hosts must see it before bytes are trusted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelIdentity {
    /// Number of the channel between this pair of hosts.
    pub channel: u16,
    /// Name of the local shared-memory service.
    pub channel_name: String,
    /// Name and version of the message type.
    pub type_name: String,
    /// Hash over type name, size and alignment; see [`type_hash`].
    pub type_hash: u64,
    /// Size of the largest payload.
    pub size_max_bytes: u32,
    /// Alignment of the payload in shared memory.
    pub alignment_bytes: u32,
}

impl ChannelIdentity {
    /// A channel whose type hash follows from name, size and alignment.
    pub fn new(
        channel: u16,
        channel_name: &str,
        type_name: &str,
        size_max_bytes: u32,
        alignment_bytes: u32,
    ) -> Self {
        Self {
            channel,
            channel_name: channel_name.to_owned(),
            type_name: type_name.to_owned(),
            type_hash: type_hash(type_name, size_max_bytes as usize, alignment_bytes as usize),
            size_max_bytes,
            alignment_bytes,
        }
    }

    pub(crate) fn check(&self) -> Result<(), SettingsError> {
        for (key, name) in [
            ("channel_name", &self.channel_name),
            ("type_name", &self.type_name),
        ] {
            if name.is_empty() || name.len() > NAME_BYTES_MAX {
                return Err(SettingsError::NameLength {
                    key,
                    bytes: name.len(),
                });
            }
        }
        Ok(())
    }
}

/// Settings a bridge cannot work with.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// A name is empty or does not fit its length byte.
    #[error("{key} has {bytes} bytes, allowed are 1 to 255")]
    NameLength {
        /// `channel_name` or `type_name`.
        key: &'static str,
        /// Its length.
        bytes: usize,
    },
    /// The path carries too small a datagram for the protocol's own exchanges.
    #[error("datagram_max_bytes {value} is below {bound}, the longest greeting or exchange")]
    DatagramTooSmall {
        /// What was given.
        value: usize,
        /// The least that works for this channel.
        bound: usize,
    },
    /// The largest payload would need too many datagrams.
    #[error("size_max_bytes {size_bytes} needs {fragments} fragments, allowed are {bound}")]
    TooManyFragments {
        /// Largest payload.
        size_bytes: u32,
        /// Datagrams it would take.
        fragments: usize,
        /// Most that are allowed.
        bound: usize,
    },
    /// A period or count that must be above zero is zero.
    #[error("{key} 0 is outside 1..")]
    Zero {
        /// Which one.
        key: &'static str,
    },
}
