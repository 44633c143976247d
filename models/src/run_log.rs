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
    stamp_bound_ns: u64,
    clock_bound_ns: u64,
    early: Option<EarlyStamps>,
}

/// A stamp brought to another clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BroughtStamp {
    /// The stamp there, nanoseconds.
    pub at_ns: i64,
    /// Its largest error, nanoseconds.
    pub bound_ns: u64,
    /// True when nothing relates the clocks about then: it lies before their first exchange, and takes it
    /// that no clock stepped up to that.
    pub is_early: bool,
}

/// Stamps from before the clocks were related.
#[derive(Debug, Clone, PartialEq, Eq)]
struct EarlyStamps {
    /// Channel of the one that may be off the most, and by how much.
    channel: String,
    bound_ns: u64,
    /// What [`RunLog::clock_bound_ns`] would be without them.
    clock_bound_without_ns: u64,
}

/// The sum of the two largest errors: stamps of two clocks err by what each of their conversions does.
fn sum_of_two(by_source: &BTreeMap<String, u64>) -> u64 {
    let mut largest_ns: Vec<u64> = by_source.values().copied().collect();
    largest_ns.sort_unstable_by(|a, b| b.cmp(a));
    largest_ns.into_iter().take(2).fold(0, u64::saturating_add)
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

    /// Brings the stamps of all channels to one clock. `source_of` names the clock that a channel's were
    /// read from, and `convert` gives the stamp of a channel's message on the one clock. The order of stamps within a channel stays.
    ///
    /// # Errors
    /// Names the first channel with a stamp that does not convert; nothing is changed then.
    pub fn bring_to_one_clock(
        &mut self,
        source_of: impl Fn(&str) -> Option<String>,
        convert: impl Fn(&str, i64) -> Option<BroughtStamp>,
    ) -> Result<(), String> {
        let mut stamps_ns: Vec<i64> = Vec::new();
        let mut by_source: BTreeMap<String, u64> = BTreeMap::new();
        let mut without_early: BTreeMap<String, u64> = BTreeMap::new();
        let mut widest_early: Option<(u64, String)> = None;
        for (channel, messages) in &self.channels {
            let Some(source) = source_of(channel) else {
                return Err(channel.clone());
            };
            let regular_ns = without_early.entry(source.clone()).or_default();
            let largest_ns = by_source.entry(source).or_default();
            let mut before: Option<(i64, i64)> = None;
            for message in messages {
                let from_ns = message.envelope.published_ns;
                let Some(brought) = convert(channel, from_ns) else {
                    return Err(channel.clone());
                };
                let mut at_ns = brought.at_ns;
                // An estimate of the offset may fall faster than messages follow each other.
                if let Some((before_ns, known_ns)) = before
                    && from_ns >= before_ns
                {
                    at_ns = at_ns.max(known_ns);
                }
                before = Some((from_ns, at_ns));
                stamps_ns.push(at_ns);
                *largest_ns = brought.bound_ns.max(*largest_ns);
                if !brought.is_early {
                    *regular_ns = brought.bound_ns.max(*regular_ns);
                } else if widest_early
                    .as_ref()
                    .is_none_or(|one| one.0 < brought.bound_ns)
                {
                    widest_early = Some((brought.bound_ns, channel.clone()));
                }
            }
        }
        let messages = self.channels.values_mut().flatten();
        for (message, at_ns) in messages.zip(stamps_ns) {
            message.envelope.published_ns = at_ns;
        }
        self.clocks_differ = false;
        self.stamp_bound_ns = by_source.values().copied().max().unwrap_or(0);
        self.clock_bound_ns = sum_of_two(&by_source);
        self.early = widest_early.map(|(bound_ns, channel)| EarlyStamps {
            channel,
            bound_ns,
            clock_bound_without_ns: sum_of_two(&without_early),
        });
        Ok(())
    }

    /// How far one stamp may be off because it was read from another clock than the one it was brought
    /// to, nanoseconds; 0 when all were read from one.
    pub fn stamp_bound_ns(&self) -> u64 {
        self.stamp_bound_ns
    }

    /// How far stamps of two channels may be off against each other because they were read from two
    /// clocks and brought to one, nanoseconds: the sum of what the conversions of any two clocks may err
    /// by; 0 when all were read from one.
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
        let early = self.early_words();
        format!("; stamps of two hosts, aligned within \u{b1}{us:.1} us{wide}{early}")
    }

    /// What figures rest on that use messages from before the clocks were related; empty without any.
    fn early_words(&self) -> String {
        let Some(early) = &self.early else {
            return String::new();
        };
        let [of_it_us, without_us] =
            [early.bound_ns, early.clock_bound_without_ns].map(|bound_ns| bound_ns as f64 * 1e-3);
        let without = if early.clock_bound_without_ns < self.clock_bound_ns {
            format!(", without them \u{b1}{without_us:.1} us")
        } else {
            String::new()
        };
        format!(
            "; messages before the first exchange of clocks take it that no clock stepped until then, \
             the widest, of {}, \u{b1}{of_it_us:.1} us{without}",
            early.channel
        )
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

    #[allow(clippy::unnecessary_wraps, reason = "as `bring_to_one_clock` takes it")]
    fn stamp(at_ns: i64, bound_ns: u64) -> Option<BroughtStamp> {
        Some(BroughtStamp {
            at_ns,
            bound_ns,
            is_early: false,
        })
    }

    /// Every channel has a producer on a host of its own.
    #[allow(clippy::unnecessary_wraps, reason = "as `bring_to_one_clock` takes it")]
    fn source_of(channel: &str) -> Option<String> {
        Some(channel.to_owned())
    }

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
            ("command", 20) => stamp(5_000 + 20 - 15, 40),
            ("command", ns) => stamp(5_000 + ns, 30),
            (_, ns) => stamp(ns, 0),
        };
        assert_eq!(log.bring_to_one_clock(source_of, convert), Ok(()));
        assert!(log.has_one_clock());
        assert_eq!((log.stamp_bound_ns(), log.clock_bound_ns()), (40, 40));
        let stamps = |channel| -> Vec<i64> {
            let all = log.raw(channel).iter();
            all.map(|one| one.envelope.published_ns).collect()
        };
        assert_eq!(stamps("command"), [5_000, 5_010, 5_010, 5_030]);
        assert_eq!(stamps("status"), [0, 10, 20, 30]);
    }

    #[test]
    fn channels_of_two_other_clocks_are_off_by_both_conversions() {
        let mut log = log();
        for channel in ["orders", "order_answers"] {
            log.push(channel, Envelope::default(), &[]);
        }
        // Robot and sensor are brought to the controller's clock; the answers are the sensor's too.
        let source_of = |channel: &str| {
            let source = match channel {
                "command" => "controller",
                "status" => "robot",
                _ => "sensor",
            };
            Some(source.to_owned())
        };
        let convert = |channel: &str, ns: i64| match channel {
            "command" => stamp(ns, 0),
            "status" => stamp(ns + 7, 30),
            "orders" => stamp(ns - 7, 25),
            _ => stamp(ns - 7, 20),
        };
        assert_eq!(log.bring_to_one_clock(source_of, convert), Ok(()));
        assert_eq!((log.stamp_bound_ns(), log.clock_bound_ns()), (30, 55));
    }

    #[test]
    fn a_channel_of_an_unknown_clock_leaves_all_as_they_were() {
        let mut changed = log();
        let source_of = |channel: &str| source_of(channel).filter(|_| channel != "status");
        let failed = changed.bring_to_one_clock(source_of, |_, ns| stamp(ns + 5, 1));
        assert_eq!(failed, Err("status".to_owned()));
        assert_eq!(changed, log());
    }

    #[test]
    fn one_stamp_that_does_not_convert_leaves_all_as_they_were() {
        let mut changed = log();
        let convert =
            |channel: &str, ns: i64| stamp(7, 1).filter(|_| channel != "status" || ns < 30);
        let failed = changed.bring_to_one_clock(source_of, convert);
        assert_eq!(failed, Err("status".to_owned()));
        assert_eq!(changed, log());
        assert!(!changed.has_one_clock());
    }

    #[test]
    fn a_figure_says_of_two_clocks_what_one_clock_need_not() {
        let mut log = log();
        assert_eq!(log.clock_words(None), "");
        let convert = |channel: &str, ns| stamp(ns, if channel == "status" { 15_700 } else { 0 });
        log.bring_to_one_clock(source_of, convert).unwrap();
        let words = "; stamps of two hosts, aligned within ±15.7 us";
        assert_eq!(log.clock_words(Some(20e-6)), words);
        let wide = [words, ", wider than the figure"].concat();
        assert_eq!(log.clock_words(Some(-15e-6)), wide);
    }

    #[test]
    fn a_message_before_the_first_exchange_is_named_with_what_it_widens() {
        let brought = |widest_ns: u64| {
            let mut log = log();
            let convert = |channel: &str, ns: i64| match (channel, ns) {
                ("status", 0) => Some(BroughtStamp {
                    at_ns: ns,
                    bound_ns: widest_ns,
                    is_early: true,
                }),
                ("status", ns) => stamp(ns, 15_700),
                _ => stamp(ns, 0),
            };
            log.bring_to_one_clock(source_of, convert).unwrap();
            log
        };
        let wide = brought(2_000_000);
        assert_eq!(wide.clock_bound_ns(), 2_000_000);
        let words = wide.clock_words(None);
        assert!(words.contains("no clock stepped until then"), "{words}");
        assert!(
            words.ends_with("the widest, of status, ±2000.0 us, without them ±15.7 us"),
            "{words}"
        );
        // One that widens nothing rests on the same assumption.
        let words = brought(9_000).clock_words(None);
        assert!(words.ends_with("the widest, of status, ±9.0 us"), "{words}");
    }
}
