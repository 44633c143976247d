//! What an ingress bridge is told at construction, checked once. It holds no state.

use core::time::Duration;

use crate::channel::{ChannelIdentity, SettingsError};

/// Settings of an [`IngressBridge`](super::IngressBridge).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IngressSettings {
    /// The channel, as both hosts must see it.
    pub channel: ChannelIdentity,
    /// This gateway's start; must differ from its earlier ones.
    pub session: u32,
    /// Fingerprint of this host's shared-memory domain.
    pub domain: [u8; 16],
    /// Names this host's monotonic clock; equal ids on both hosts mean one clock.
    pub clock_id: u64,
    /// Incomplete messages held at a time; the oldest gives way.
    pub reassembly_slots: usize,
    /// An incomplete message older than this is given up; one period of the channel is a good
    /// value.
    pub reassembly_timeout: Duration,
    /// True to deliver a message that is new but older than one already delivered; false for
    /// newest-wins.
    pub deliver_reordered: bool,
}

impl IngressSettings {
    /// Four reassembly slots, 100 ms each, reordered messages delivered.
    pub fn new(channel: ChannelIdentity, session: u32, domain: [u8; 16], clock_id: u64) -> Self {
        Self {
            channel,
            session,
            domain,
            clock_id,
            reassembly_slots: 4,
            reassembly_timeout: Duration::from_millis(100),
            deliver_reordered: true,
        }
    }

    pub(super) fn check(&self) -> Result<(), SettingsError> {
        self.channel.check()?;
        if self.reassembly_slots == 0 {
            return Err(SettingsError::Zero {
                key: "reassembly_slots",
            });
        }
        if self.reassembly_timeout.is_zero() {
            return Err(SettingsError::Zero {
                key: "reassembly_timeout",
            });
        }
        Ok(())
    }
}
