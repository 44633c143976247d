//! One channel that is read from shared memory, and what is known of what did not come out of it.

use hil_core::record::{IngressRecord, UNAVAILABLE};

use super::passive::{PassiveCounters, PassiveReader};
use super::seen::Seen;
use hil_shm::{ChannelError, observer_depth};

/// A channel that is read from shared memory.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) host: String,
    pub(super) reader: Option<PassiveReader>,
    /// Of readers that were given up.
    past: PassiveCounters,
    pub(super) seen: Seen,
    is_forwarded: bool,
    /// When reading began, on this host's monotonic clock, nanoseconds.
    pub(super) joined_ns: i64,
    /// Messages that the gateway here published since then, by its records.
    forwarded_count: u64,
    /// The same when shared memory was last read.
    forwarded_before: u64,
    has_complained: bool,
    /// It comes again with the records of another host, at the end.
    pub(super) comes_again: bool,
    /// Messages that may wait here.
    depth: usize,
    /// The largest share of that which was found taken since somebody asked.
    fill_ratio: f64,
}

impl Shared {
    /// Not read yet. Its messages have `size_bytes`.
    #[expect(
        clippy::fn_params_excessive_bools,
        reason = "two facts of one channel, named here and there"
    )]
    pub(super) fn new(
        host: String,
        is_forwarded: bool,
        comes_again: bool,
        size_bytes: usize,
    ) -> Self {
        Self {
            host,
            reader: None,
            past: PassiveCounters::default(),
            seen: Seen::default(),
            is_forwarded,
            joined_ns: i64::MAX,
            forwarded_count: 0,
            forwarded_before: 0,
            has_complained: false,
            comes_again,
            depth: observer_depth(size_bytes),
            fill_ratio: 0.0,
        }
    }

    /// Notes what the gateway here says of a message.
    pub(super) fn note_forwarded(&mut self, record: &IngressRecord) {
        let is_published = record.forwarded_ns != UNAVAILABLE;
        self.forwarded_count += u64::from(is_published && record.forwarded_ns >= self.joined_ns);
    }

    /// What came of it.
    pub(super) fn counters(&self) -> PassiveCounters {
        let now = self
            .reader
            .as_ref()
            .map_or_else(PassiveCounters::default, PassiveReader::counters);
        PassiveCounters {
            received_count: self.past.received_count + now.received_count,
            earlier_count: self.past.earlier_count + now.earlier_count,
            gap_count: self.past.gap_count + now.gap_count,
        }
    }

    /// What was published while it was read and did not come out of it.
    pub(super) fn missed_count(&self) -> u64 {
        let counters = self.counters();
        if self.is_forwarded {
            // Gaps are the network's; the gateway's records say what it published here.
            self.forwarded_before
                .saturating_sub(counters.received_count)
        } else {
            counters.gap_count
        }
    }

    /// Reads no more.
    pub(super) fn give_up_reader(&mut self) {
        self.past = self.counters();
        self.reader = None;
    }

    /// Says why it cannot be read, once.
    pub(super) fn complain(&mut self, error: &ChannelError, problems: &mut Vec<String>) {
        if !core::mem::replace(&mut self.has_complained, true) {
            problems.push(error.to_string());
        }
    }

    /// What the gateway noted by now was there when memory was last read.
    pub(super) fn note_read(&mut self) {
        self.forwarded_before = self.forwarded_count;
    }

    /// Notes that so many messages were found waiting.
    pub(super) fn note_found(&mut self, count: usize) {
        self.fill_ratio = self.fill_ratio.max(count as f64 / self.depth as f64);
    }

    /// The largest share of its room that was found taken since the last call.
    pub(super) fn take_fill_ratio(&mut self) -> f64 {
        core::mem::take(&mut self.fill_ratio)
    }
}
