//! A channel read from shared memory by somebody who has no part in the run: it learns the type from
//! the channel, polls, and never sleeps on the wake-up service, so that no writer has anybody more
//! to wake.

use std::time::Duration;

use hil_core::message::Envelope;

use hil_shm::{ChannelError, Domain, RawInput, SequenceTracker, observer_depth};

/// What came, and what did not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PassiveCounters {
    /// Messages given out.
    pub received_count: u64,
    /// Published before the reader was there: the number of the first message it got.
    pub earlier_count: u64,
    /// Numbers that never came. Behind a gateway the network's losses are among them.
    pub gap_count: u64,
}

/// Reads one channel.
#[derive(Debug)]
pub struct PassiveReader {
    input: RawInput,
    tracker: SequenceTracker,
    earlier_count: Option<u64>,
}

impl PassiveReader {
    /// Begins to read `channel`, from the next message on. Give it a domain that it only
    /// [observes](Domain::observe).
    ///
    /// # Errors
    /// When the channel is not there or has all its readers.
    pub fn open(domain: &Domain, channel: &str, size_bytes: usize) -> Result<Self, ChannelError> {
        Ok(Self {
            input: RawInput::open(domain, channel, observer_depth(size_bytes))?,
            tracker: SequenceTracker::default(),
            earlier_count: None,
        })
    }

    /// How long opening a channel may take: it is there, or it will not come.
    pub const OPEN_WITHIN: Duration = Duration::from_millis(200);

    /// Gives out what waits, `count_max` messages at most; true when more may be waiting.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn poll(
        &mut self,
        count_max: usize,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, ChannelError> {
        let Self {
            input,
            tracker,
            earlier_count,
        } = self;
        for _ in 0..count_max {
            let is_taken = input.receive(&mut |envelope, payload| {
                earlier_count.get_or_insert(envelope.sequence);
                // A late message of an earlier start is a message all the same.
                let _is_of_this_start = tracker.accept(envelope);
                take(envelope, payload);
            })?;
            if !is_taken {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// What came so far.
    pub fn counters(&self) -> PassiveCounters {
        let counters = self.tracker.counters();
        PassiveCounters {
            received_count: counters.received_count + counters.outdated_count,
            earlier_count: self.earlier_count.unwrap_or(0),
            gap_count: counters.missed_count,
        }
    }
}
