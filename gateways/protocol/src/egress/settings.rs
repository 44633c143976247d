//! What an egress bridge is told at construction, checked once. It holds no state.

use core::time::Duration;

use crate::body::{HELLO_ACK_BODY_BYTES, Hello, SYNC_BODY_BYTES};
use crate::channel::{ChannelIdentity, SettingsError};
use crate::fragment::FRAGMENT_COUNT_MAX;
use crate::wire::{HEADER_BYTES, TAG_BYTES, payload_budget_bytes};

/// Settings of an [`EgressBridge`](super::EgressBridge).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EgressSettings {
    /// The channel, as both hosts must see it.
    pub channel: ChannelIdentity,
    /// This gateway's start; must differ from its earlier ones.
    pub session: u32,
    /// Fingerprint of this host's shared-memory domain.
    pub domain: [u8; 16],
    /// Names this host's monotonic clock; equal ids on both hosts mean one clock.
    pub clock_id: u64,
    /// Largest datagram the path carries unfragmented: path MTU minus IP and UDP headers.
    pub datagram_max_bytes: usize,
    /// Time between clock exchanges.
    pub sync_period: Duration,
}

impl EgressSettings {
    /// Payload bytes of one datagram, the room for a tag taken off.
    pub const fn payload_budget_bytes(&self) -> usize {
        payload_budget_bytes(self.datagram_max_bytes)
    }

    /// Datagrams that the channel's largest message takes.
    pub const fn fragment_count_max(&self) -> usize {
        let budget = self.payload_budget_bytes();
        if budget == 0 {
            return usize::MAX;
        }
        let count = (self.channel.size_max_bytes as usize).div_ceil(budget);
        if count == 0 { 1 } else { count }
    }

    /// Longest datagram that is not data.
    pub(super) fn control_bytes(&self) -> usize {
        let hello = Hello {
            domain: self.domain,
            clock_id: self.clock_id,
            size_max_bytes: self.channel.size_max_bytes,
            alignment_bytes: self.channel.alignment_bytes,
            channel_name: &self.channel.channel_name,
            type_name: &self.channel.type_name,
        };
        let body = hello.encoded_bytes().max(SYNC_BODY_BYTES);
        HEADER_BYTES + body.max(HELLO_ACK_BODY_BYTES)
    }

    pub(super) fn check(&self) -> Result<(), SettingsError> {
        self.channel.check()?;
        if self.sync_period.is_zero() {
            return Err(SettingsError::Zero { key: "sync_period" });
        }
        let bound = self.control_bytes() + TAG_BYTES;
        if self.datagram_max_bytes < bound {
            return Err(SettingsError::DatagramTooSmall {
                value: self.datagram_max_bytes,
                bound,
            });
        }
        let fragments = self.fragment_count_max();
        if fragments > FRAGMENT_COUNT_MAX {
            return Err(SettingsError::TooManyFragments {
                size_bytes: self.channel.size_max_bytes,
                fragments,
                bound: FRAGMENT_COUNT_MAX,
            });
        }
        Ok(())
    }
}
