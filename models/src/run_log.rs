//! The messages of a finished run, as the producers recorded them. It does not read files: the
//! runtime and the simulation fill it.

use std::collections::BTreeMap;

use crate::message::{Envelope, Message};
use crate::time::Instant;

/// One recorded message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoggedMessage {
    /// Sequence, epoch and publication time.
    pub envelope: Envelope,
    /// The payload as published.
    pub payload: Vec<u8>,
}

/// Everything a run's producers published, by channel, in order of publication.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunLog {
    channels: BTreeMap<String, Vec<LoggedMessage>>,
    clocks_differ: bool,
}

impl RunLog {
    /// Notes that the producers read clocks of different hosts that are not aligned: stamps of
    /// one channel compare with each other, stamps of two channels do not.
    pub fn set_clocks_differ(&mut self) {
        self.clocks_differ = true;
    }

    /// True when all stamps are of one clock.
    pub fn has_one_clock(&self) -> bool {
        !self.clocks_differ
    }

    /// Appends a message to a channel.
    pub fn push(&mut self, channel: &str, envelope: Envelope, payload: &[u8]) {
        let message = LoggedMessage {
            envelope,
            payload: payload.to_vec(),
        };
        if let Some(messages) = self.channels.get_mut(channel) {
            messages.push(message);
        } else {
            self.channels.insert(channel.to_owned(), vec![message]);
        }
    }

    /// The recorded messages of `channel`; empty when nothing was recorded.
    pub fn raw(&self, channel: &str) -> &[LoggedMessage] {
        self.channels.get(channel).map_or(&[], Vec::as_slice)
    }

    /// The messages of `channel` as `M` with their publication time on the producer's clock.
    /// Entries of another size are passed over.
    pub fn messages<'a, M: Message>(
        &'a self,
        channel: &str,
    ) -> impl Iterator<Item = (Instant, M)> + 'a {
        self.raw(channel).iter().filter_map(|logged| {
            let message = bytemuck::try_pod_read_unaligned(&logged.payload).ok()?;
            Some((Instant::from_ns(logged.envelope.published_ns), message))
        })
    }

    /// Channel names with their message counts.
    pub fn counts(&self) -> impl Iterator<Item = (&str, usize)> {
        self.channels
            .iter()
            .map(|(name, messages)| (name.as_str(), messages.len()))
    }
}
