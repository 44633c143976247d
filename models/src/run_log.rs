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
    clock_bound_ns: u64,
}

impl RunLog {
    /// Notes that the producers read clocks of different hosts that are not aligned: stamps of
    /// one channel compare with each other, stamps of two channels do not.
    pub fn set_clocks_differ(&mut self) {
        self.clocks_differ = true;
    }

    /// True when all stamps are of one clock, or were brought to one.
    pub fn has_one_clock(&self) -> bool {
        !self.clocks_differ
    }

    /// Brings the stamps of all channels to one clock. `convert` gives the stamp of a channel's
    /// message on it with its largest error, nanoseconds. The order of stamps within a channel stays.
    ///
    /// # Errors
    /// Names the first channel with a stamp that does not convert; nothing is changed then.
    pub fn bring_to_one_clock(
        &mut self,
        convert: impl Fn(&str, i64) -> Option<(i64, u64)>,
    ) -> Result<(), String> {
        let mut stamps_ns: Vec<i64> = Vec::new();
        let mut largest_ns = 0;
        for (channel, messages) in &self.channels {
            let mut before: Option<(i64, i64)> = None;
            for message in messages {
                let from_ns = message.envelope.published_ns;
                let Some((mut at_ns, bound_ns)) = convert(channel, from_ns) else {
                    return Err(channel.clone());
                };
                // An estimate of the offset may fall faster than messages follow each other.
                if let Some((before_ns, known_ns)) = before
                    && from_ns >= before_ns
                {
                    at_ns = at_ns.max(known_ns);
                }
                before = Some((from_ns, at_ns));
                stamps_ns.push(at_ns);
                largest_ns = bound_ns.max(largest_ns);
            }
        }
        let messages = self.channels.values_mut().flatten();
        for (message, at_ns) in messages.zip(stamps_ns) {
            message.envelope.published_ns = at_ns;
        }
        self.clocks_differ = false;
        self.clock_bound_ns = largest_ns;
        Ok(())
    }

    /// How far stamps of two channels may be off against each other because they were read from two
    /// clocks and brought to one, nanoseconds; 0 when they were read from one.
    pub fn clock_bound_ns(&self) -> u64 {
        self.clock_bound_ns
    }

    /// What a figure that compares stamps of two channels has to say of their clocks; nothing when
    /// they were read from one. `time_s` is the figure, where it is a time.
    pub fn clock_words(&self, time_s: Option<f64>) -> String {
        if self.clock_bound_ns == 0 {
            return String::new();
        }
        let bound_s = self.clock_bound_ns as f64 * 1e-9;
        let wide = if time_s.is_some_and(|time_s| time_s.abs() < bound_s) {
            ", wider than the figure"
        } else {
            ""
        };
        let us = bound_s * 1e6;
        format!("; stamps of two hosts, aligned within \u{b1}{us:.1} us{wide}")
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages of two channels, 10 ns apart.
    fn log() -> RunLog {
        let mut log = RunLog::default();
        for channel in ["command", "status"] {
            for sequence in 0..4 {
                let envelope = Envelope {
                    sequence,
                    published_ns: i64::try_from(sequence).unwrap() * 10,
                    ..Envelope::default()
                };
                log.push(channel, envelope, &[]);
            }
        }
        log.set_clocks_differ();
        log
    }

    #[test]
    fn stamps_are_brought_to_one_clock_with_their_largest_error_and_keep_their_order() {
        let mut log = log();
        // The third command's offset is 15 ns less than its neighbours'.
        let convert = |channel: &str, ns: i64| match (channel, ns) {
            ("command", 20) => Some((5_000 + 20 - 15, 40)),
            ("command", ns) => Some((5_000 + ns, 30)),
            (_, ns) => Some((ns, 0)),
        };
        assert_eq!(log.bring_to_one_clock(convert), Ok(()));
        assert!(log.has_one_clock());
        assert_eq!(log.clock_bound_ns(), 40);
        let stamps = |channel| -> Vec<i64> {
            let all = log.raw(channel).iter();
            all.map(|one| one.envelope.published_ns).collect()
        };
        assert_eq!(stamps("command"), [5_000, 5_010, 5_010, 5_030]);
        assert_eq!(stamps("status"), [0, 10, 20, 30]);
    }

    #[test]
    fn one_stamp_that_does_not_convert_leaves_all_as_they_were() {
        let mut changed = log();
        let convert = |channel: &str, ns: i64| (channel != "status" || ns < 30).then_some((7, 1));
        let failed = changed.bring_to_one_clock(convert);
        assert_eq!(failed, Err("status".to_owned()));
        assert_eq!(changed, log());
        assert!(!changed.has_one_clock());
    }

    #[test]
    fn a_figure_says_of_two_clocks_what_one_clock_need_not() {
        let mut log = log();
        assert_eq!(log.clock_words(None), "");
        log.bring_to_one_clock(|_, ns| Some((ns, 15_700))).unwrap();
        let words = "; stamps of two hosts, aligned within ±15.7 us";
        assert_eq!(log.clock_words(Some(20e-6)), words);
        let wide = [words, ", wider than the figure"].concat();
        assert_eq!(log.clock_words(Some(-15e-6)), wide);
    }
}
