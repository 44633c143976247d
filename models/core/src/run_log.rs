//! The messages of a finished run, as the producers recorded them. It does not read files: the
//! simulation fills it, and the runtime says where messages lie and reads them when they are asked for.

#[cfg(test)]
mod tests;

use core::fmt::Debug;
use std::collections::BTreeMap;
use std::sync::Arc;

use crate::message::{Envelope, Message};
use crate::packed::{Unpacked, put};
use crate::time::Instant;

/// One recorded message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoggedMessage {
    /// Sequence, epoch and publication time.
    pub envelope: Envelope,
    /// The payload as published.
    pub payload: Vec<u8>,
}

/// Messages of one channel that lie elsewhere and are read whenever they are asked for.
pub trait StoredMessages: Debug + Send + Sync {
    /// How many.
    fn count(&self) -> usize;

    /// All of them from the first on, in order of publication; every call gives the same ones.
    fn reader(&self) -> Box<dyn MessageReader + '_>;
}

/// Messages one after the other.
pub trait MessageReader {
    /// The next one, its payload put in the place of what `payload` holds; `None` behind the last.
    fn next(&mut self, payload: &mut Vec<u8>) -> Option<Envelope>;
}

/// Everything a run's producers published, by channel, in order of publication.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunLog {
    channels: BTreeMap<String, Kept>,
    clocks_differ: bool,
    stamp_bound_ns: u64,
    clock_bound_ns: u64,
    early: Option<EarlyStamps>,
}

/// The messages of one channel.
#[derive(Debug, Clone, Default)]
struct Kept {
    held: Vec<LoggedMessage>,
    /// In place of the held ones.
    stored: Option<Arc<dyn StoredMessages>>,
    /// What was added to the stamps of the stored ones, each less what was added to the one before;
    /// packed. Empty when nothing was.
    shifts: Vec<u8>,
}

impl PartialEq for Kept {
    fn eq(&self, other: &Self) -> bool {
        Logged(Some(self)).iter().eq(Logged(Some(other)).iter())
    }
}

impl Eq for Kept {}

/// The messages of one channel, held or stored.
#[derive(Debug, Clone, Copy)]
pub struct Logged<'a>(Option<&'a Kept>);

impl<'a> Logged<'a> {
    /// How many.
    pub fn len(self) -> usize {
        let count = |kept: &Kept| match &kept.stored {
            Some(stored) => stored.count(),
            None => kept.held.len(),
        };
        self.0.map_or(0, count)
    }

    /// True without any.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// All of them at once; `None` when they lie elsewhere.
    pub fn held(self) -> Option<&'a [LoggedMessage]> {
        match self.0 {
            Some(kept) if kept.stored.is_some() => None,
            kept => Some(kept.map_or(&[], |kept| kept.held.as_slice())),
        }
    }

    /// The first.
    pub fn first(self) -> Option<LoggedMessage> {
        self.iter().next()
    }

    /// All of them, in order of publication.
    pub fn iter(self) -> LoggedMessages<'a> {
        let held = self.0.map_or(&[][..], |kept| kept.held.as_slice());
        let stored = self.0.and_then(|kept| {
            let reader = kept.stored.as_ref()?.reader();
            Some((reader, Unpacked(&kept.shifts), 0))
        });
        LoggedMessages {
            held: held.iter(),
            stored,
        }
    }
}

impl<'a> IntoIterator for Logged<'a> {
    type Item = LoggedMessage;
    type IntoIter = LoggedMessages<'a>;

    fn into_iter(self) -> LoggedMessages<'a> {
        self.iter()
    }
}

/// The messages of one channel, one after the other.
pub struct LoggedMessages<'a> {
    held: core::slice::Iter<'a, LoggedMessage>,
    /// With what is added to the stamps, and what was added to the last one.
    stored: Option<(Box<dyn MessageReader + 'a>, Unpacked<'a>, i64)>,
}

impl Debug for LoggedMessages<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let held_count = self.held.len();
        f.debug_struct("LoggedMessages")
            .field("held_count", &held_count)
            .finish_non_exhaustive()
    }
}

impl LoggedMessages<'_> {
    /// The next message; see [`MessageReader::next`].
    fn read(&mut self, payload: &mut Vec<u8>) -> Option<Envelope> {
        if let Some(message) = self.held.next() {
            payload.clear();
            payload.extend_from_slice(&message.payload);
            return Some(message.envelope);
        }
        let (reader, shifts, shift_ns) = self.stored.as_mut()?;
        let mut envelope = reader.next(payload)?;
        if let Some(more_ns) = shifts.next() {
            *shift_ns = shift_ns.wrapping_add(more_ns);
            envelope.published_ns = envelope.published_ns.wrapping_add(*shift_ns);
        }
        Some(envelope)
    }
}

impl Iterator for LoggedMessages<'_> {
    type Item = LoggedMessage;

    fn next(&mut self) -> Option<LoggedMessage> {
        let mut payload = Vec::new();
        let envelope = self.read(&mut payload)?;
        Some(LoggedMessage { envelope, payload })
    }
}

/// A stamp brought to another clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvertedStamp {
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

impl Kept {
    /// Adds to every stamp what is packed in `shifts`, each less the one before.
    fn shift(&mut self, shifts: Vec<u8>) {
        let mut shift_ns = 0_i64;
        for (message, more_ns) in self.held.iter_mut().zip(Unpacked(&shifts)) {
            shift_ns = shift_ns.wrapping_add(more_ns);
            let stamp_ns = &mut message.envelope.published_ns;
            *stamp_ns = stamp_ns.wrapping_add(shift_ns);
        }
        if self.stored.is_some() {
            self.shifts = shifts;
        }
    }
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
        convert: impl Fn(&str, i64) -> Option<ConvertedStamp>,
    ) -> Result<(), String> {
        let mut all_shifts: Vec<Vec<u8>> = Vec::new();
        let mut by_source: BTreeMap<String, u64> = BTreeMap::new();
        let mut without_early: BTreeMap<String, u64> = BTreeMap::new();
        let mut widest_early: Option<(u64, String)> = None;
        let mut payload = Vec::new();
        for (channel, kept) in &self.channels {
            let Some(source) = source_of(channel) else {
                return Err(channel.clone());
            };
            let regular_ns = without_early.entry(source.clone()).or_default();
            let largest_ns = by_source.entry(source).or_default();
            let mut before: Option<(i64, i64)> = None;
            let (mut shifts, mut last_ns) = (Vec::new(), 0_i64);
            let mut messages = Logged(Some(kept)).iter();
            while let Some(envelope) = messages.read(&mut payload) {
                let from_ns = envelope.published_ns;
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
                let shift_ns = at_ns.wrapping_sub(from_ns);
                put(&mut shifts, shift_ns.wrapping_sub(last_ns));
                last_ns = shift_ns;
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
            all_shifts.push(shifts);
        }
        for (kept, shifts) in self.channels.values_mut().zip(all_shifts) {
            kept.shift(shifts);
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

    /// Appends a message to a channel whose messages are held.
    pub fn push(&mut self, channel: &str, envelope: Envelope, payload: &[u8]) {
        let message = LoggedMessage {
            envelope,
            payload: payload.to_vec(),
        };
        if let Some(kept) = self.channels.get_mut(channel) {
            kept.held.push(message);
        } else {
            let kept = self.channels.entry(channel.to_owned()).or_default();
            kept.held.push(message);
        }
    }

    /// Says where the messages of a channel lie, of which none were there before.
    pub fn set_stored(&mut self, channel: &str, messages: Arc<dyn StoredMessages>) {
        let kept = Kept {
            stored: Some(messages),
            ..Kept::default()
        };
        self.channels.insert(channel.to_owned(), kept);
    }

    /// The recorded messages of `channel`; empty when nothing was recorded.
    pub fn raw(&self, channel: &str) -> Logged<'_> {
        Logged(self.channels.get(channel))
    }

    /// The messages of `channel` as `M` with their publication time on the producer's clock.
    /// Entries of another size are passed over.
    pub fn messages<'a, M: Message>(
        &'a self,
        channel: &str,
    ) -> impl Iterator<Item = (Instant, M)> + use<'a, M> {
        let mut messages = self.raw(channel).iter();
        let mut payload = Vec::new();
        core::iter::from_fn(move || {
            loop {
                let envelope = messages.read(&mut payload)?;
                if let Ok(message) = bytemuck::try_pod_read_unaligned(&payload) {
                    return Some((Instant::from_ns(envelope.published_ns), message));
                }
            }
        })
    }

    /// The messages of `channel`, each with the newest one of `other` whose stamp plus `shift_ns` is not later.
    /// Without a shift, stamps of clocks that are not aligned do not compare: there is no newest one then.
    pub fn with_newest<'a, A: Message, B: Message>(
        &'a self,
        channel: &str,
        other: &str,
        shift_ns: Option<i64>,
    ) -> impl Iterator<Item = (Instant, A, Option<B>)> + use<'a, A, B> {
        let shift_ns = shift_ns.or_else(|| self.has_one_clock().then_some(0));
        let mut others = self.messages::<B>(other).peekable();
        let mut newest = None;
        self.messages::<A>(channel).map(move |(at, message)| {
            let is_there = |sent: Instant| {
                shift_ns.is_some_and(|shift_ns| sent.as_ns().saturating_add(shift_ns) <= at.as_ns())
            };
            while let Some((_, other)) = others.next_if(|next| is_there(next.0)) {
                newest = Some(other);
            }
            (at, message, newest)
        })
    }

    /// Channel names with their message counts.
    pub fn counts(&self) -> impl Iterator<Item = (&str, usize)> {
        self.channels
            .iter()
            .map(|(name, kept)| (name.as_str(), Logged(Some(kept)).len()))
    }
}
