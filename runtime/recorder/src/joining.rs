//! The stamps of each message of one channel, joined while the run goes. Processes write their stamps
//! at times of their own, and a network changes the order of messages, so stamps are held back: a
//! message is given out when every process here has written its stamps of messages published well
//! after it, or when nothing more is to be read and it has been held for long enough. So messages
//! come in the order of their publication; one whose first stamp comes after a message published
//! later was given out is counted.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use hil_rundir::live_run::Stage;
use hil_watch::{Record, Seen};

use crate::net::{MessageId, MessageLatency, Noted};
use crate::newest::Newest;

/// How much later a message must have been published, at every stage here, for those before it to be
/// given out: longer than processes keep stamps in their rings, and than most links put messages out
/// of order. Short, because so much is missing from the file of a killed recorder.
const HOLD: Duration = Duration::from_millis(300);
const HOLD_NS: i64 = 300_000_000;
/// How long the rest of a message's stamps is waited for when a stage has nothing newer: longer than
/// links delay.
const WAIT: Duration = Duration::from_secs(5);
/// Messages waited for at a time; the oldest is given out when there are more.
const WAITING_MAX: usize = 1 << 16;

/// Joins the stamps of one channel.
#[derive(Debug, Default)]
pub(crate) struct Joining {
    told: Vec<Told>,
    waiting: BTreeMap<MessageId, MessageLatency>,
    /// The same by instant of publication, nanoseconds.
    order: BTreeMap<(i64, MessageId), First>,
    given: Seen,
    /// The newest publication that was given out.
    newest_given: Newest,
    /// Stamps of processes here that came for a message that had been given out.
    pub(crate) late_count: u64,
    /// Messages heard of here that were given out after one published later.
    pub(crate) unordered_count: u64,
}

/// The first stamp of a message.
#[derive(Debug, Clone, Copy)]
struct First {
    came: Instant,
    /// A process of this host noted it; else it came at the end, from another one.
    is_of_this_host: bool,
}

/// A stage that is noted here.
#[derive(Debug)]
struct Told {
    stage: Stage,
    /// The newest publication of which it has told.
    newest: Newest,
}

impl Joining {
    /// For a channel of whose messages `noted` is noted here.
    pub(crate) fn new(noted: &[Stage]) -> Self {
        let told = noted.iter().map(|stage| Told {
            stage: *stage,
            newest: Newest::default(),
        });
        Self {
            told: told.collect(),
            ..Self::default()
        }
    }

    /// Takes a stamp that came `now`, of a process of this host or of another one.
    pub(crate) fn take(&mut self, record: &Record, is_of_this_host: bool, now: Instant) {
        let Some(noted) = Noted::of(record) else {
            return;
        };
        let (stage, key, published_ns) = (noted.stage, noted.message, noted.published_ns);
        if is_of_this_host {
            let mut told = self.told.iter_mut();
            if let Some(told) = told.find(|told| told.stage == stage) {
                told.newest.take(published_ns);
            }
        }
        if self.given.contains(key.epoch, key.sequence) {
            // The others bring the publication stamp along.
            let is_late = is_of_this_host && stage != Stage::Published;
            self.late_count += u64::from(is_late);
            return;
        }
        let waiting = self.waiting.entry(key).or_insert_with(|| {
            let first = First {
                came: now,
                is_of_this_host,
            };
            self.order.insert((published_ns, key), first);
            MessageLatency::new(key)
        });
        waiting.note(record);
    }

    /// The message with this number, of whichever start, among those that wait: of a folder, whose messages
    /// come one by one, the only one.
    pub(crate) fn waiting_with(&mut self, sequence: u64) -> Option<&mut MessageLatency> {
        let mut waiting = self.waiting.values_mut();
        waiting.find(|one| one.sequence == sequence)
    }

    /// The earliest message, if stamps of messages published well after it are there from every stage.
    pub(crate) fn next(&mut self) -> Option<MessageLatency> {
        let (&(published_ns, _), _) = self.order.first_key_value()?;
        // The publication up to which every stage here has told of all that it will tell, but for what
        // comes out of order.
        let newest = self.told.iter().map(|told| told.newest.get());
        let reached_ns = newest.min().flatten();
        let is_reached = reached_ns.is_some_and(|ns| ns.saturating_sub(published_ns) >= HOLD_NS);
        let is_due = is_reached || self.waiting.len() > WAITING_MAX;
        if is_due { self.earliest() } else { None }
    }

    /// As [`Self::next`] when nothing more is to be read by `now`: also one that was held for long
    /// enough.
    pub(crate) fn next_held(&mut self, now: Instant) -> Option<MessageLatency> {
        if let Some(one) = self.next() {
            return Some(one);
        }
        let (&(_, key), first) = self.order.first_key_value()?;
        let message = self.waiting.get(&key).filter(|_| !self.told.is_empty());
        let is_whole = message.is_some_and(|one| self.told.iter().all(|told| has(one, told.stage)));
        let wait = if is_whole { HOLD } else { WAIT };
        if now.saturating_duration_since(first.came) < wait {
            return None;
        }
        self.earliest()
    }

    /// The earliest message; nothing more will come.
    pub(crate) fn earliest(&mut self) -> Option<MessageLatency> {
        let ((published_ns, key), first) = self.order.pop_first()?;
        let newest_ns = self.newest_given.get();
        let is_behind = newest_ns.is_some_and(|newest_ns| published_ns < newest_ns);
        self.unordered_count += u64::from(is_behind && first.is_of_this_host);
        self.newest_given.take(published_ns);
        self.given.insert(key.epoch, key.sequence);
        self.waiting.remove(&key)
    }
}

/// True when a message has the stamp of this stage.
const fn has(one: &MessageLatency, stage: Stage) -> bool {
    match stage {
        // It travels with the message, so the others bring it too.
        Stage::Published => one.published_ns.is_some(),
        Stage::Sent => one.gateway_taken_ns.is_some(),
        Stage::Received => one.received_ns.is_some(),
        Stage::Taken => one.taken_ns.is_some(),
    }
}

#[cfg(test)]
#[path = "joining/tests.rs"]
mod tests;
