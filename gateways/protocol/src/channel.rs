//! What both gateways of a flow must agree on, and why settings are refused. It carries no message.

use hil_core::message::{FNV_OFFSET, fnv1a, type_hash};

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
        check_name("channel_name", &self.channel_name)?;
        check_name("type_name", &self.type_name)
    }
}

/// What one link carries one way, as both hosts must see it. A channel is known by its index in
/// [`FlowIdentity::channels`] to whoever owns a bridge, and by its number on the wire.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlowIdentity {
    /// Number in datagrams that are about no channel; no channel has it.
    pub flow: u16,
    /// Its name.
    pub name: String,
    /// Its channels; none on a clock path.
    pub channels: Vec<ChannelIdentity>,
}

impl FlowIdentity {
    /// Digest over everything of the channels that both hosts must agree on, in their order.
    pub fn digest(&self) -> u64 {
        let mut digest = FNV_OFFSET;
        for one in &self.channels {
            for bytes in [
                &one.channel.to_le_bytes()[..],
                one.channel_name.as_bytes(),
                &[0],
                one.type_name.as_bytes(),
                &[0],
                &one.type_hash.to_le_bytes(),
                &one.size_max_bytes.to_le_bytes(),
                &one.alignment_bytes.to_le_bytes(),
            ] {
                digest = fnv1a(digest, bytes);
            }
        }
        digest
    }

    /// Size of the largest payload of any channel.
    pub fn size_max_bytes(&self) -> u32 {
        let sizes = self.channels.iter().map(|one| one.size_max_bytes);
        sizes.max().unwrap_or(0)
    }

    pub(crate) fn check(&self) -> Result<(), SettingsError> {
        check_name("flow_name", &self.name)?;
        let mut numbers = vec![self.flow];
        for channel in &self.channels {
            channel.check()?;
            if numbers.contains(&channel.channel) {
                return Err(SettingsError::NumberTwice {
                    number: channel.channel,
                });
            }
            numbers.push(channel.channel);
        }
        Ok(())
    }
}

fn check_name(key: &'static str, name: &str) -> Result<(), SettingsError> {
    if name.is_empty() || name.len() > NAME_BYTES_MAX {
        return Err(SettingsError::NameLength {
            key,
            bytes: name.len(),
        });
    }
    Ok(())
}

/// The channels of a flow by their numbers on the wire.
#[derive(Debug)]
pub(crate) struct ChannelNumbers {
    /// Index of each number up to the highest; the largest integer where there is none.
    indices: Box<[u16]>,
}

impl ChannelNumbers {
    pub(crate) fn new(channels: &[ChannelIdentity]) -> Self {
        let length = channels.iter().map(|one| usize::from(one.channel) + 1);
        let mut indices = vec![u16::MAX; length.max().unwrap_or(0)].into_boxed_slice();
        for (index, one) in (0..u16::MAX).zip(channels) {
            indices[usize::from(one.channel)] = index;
        }
        Self { indices }
    }

    pub(crate) fn index_of(&self, number: u16) -> Option<usize> {
        let index = *self.indices.get(usize::from(number))?;
        (index != u16::MAX).then_some(usize::from(index))
    }
}

/// Settings a bridge cannot work with.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// A name is empty or does not fit its length byte.
    #[error("{key} has {bytes} bytes, allowed are 1 to 255")]
    NameLength {
        /// `flow_name`, `channel_name` or `type_name`.
        key: &'static str,
        /// Its length.
        bytes: usize,
    },
    /// The path carries too small a datagram for the protocol's own exchanges.
    #[error("datagram_max_bytes {value} is below {bound}, the longest greeting or exchange")]
    DatagramTooSmall {
        /// What was given.
        value: usize,
        /// The least that works for this flow.
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
    /// Two channels, or a channel and its flow, have one number.
    #[error("channel number {number} is given twice")]
    NumberTwice {
        /// Which one.
        number: u16,
    },
    /// A period or count that must be above zero is zero.
    #[error("{key} 0 is outside 1..")]
    Zero {
        /// Which one.
        key: &'static str,
    },
}
