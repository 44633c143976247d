//! Sequence numbers of a channel: given by its writer, judged by its readers. Pure.

use core::time::Duration;
use hil_platform::clock::MonotonicClock;

use hil_core::message::Envelope;
use hil_core::time::Instant;

/// Reads the clock at the moment of publication, e.g. [`MonotonicClock::now`](hil_platform::clock::MonotonicClock::now).
///
/// A port's `send` gets the `now` of the poll it happens in; a controller that computes for
/// 200 µs publishes 200 µs after that. Accounts want the later moment, so it is read last.
pub type Stamp = fn() -> Instant;

/// How a writer behaves.
#[derive(Debug, Clone, Copy)]
pub struct OutputSettings {
    /// Changes with every start of the writer, so that readers tell a restart from a loss.
    pub epoch: u32,
    /// Read right before the sample is handed over; `None` stamps with the `now` of the call.
    pub stamp: Option<Stamp>,
    /// Wake sleeping readers after each sample. Off saves about 3 µs per message with a sleeping
    /// reader; use it only when every reader spins.
    pub notifies_readers: bool,
}

impl Default for OutputSettings {
    fn default() -> Self {
        Self {
            epoch: 0,
            stamp: Some(MonotonicClock::now),
            notifies_readers: true,
        }
    }
}

/// Hands out the envelopes of one writer.
#[derive(Debug)]
pub struct Sequencer {
    settings: OutputSettings,
    next: u64,
}

impl Sequencer {
    /// A sequence that begins as `settings` say.
    pub const fn new(settings: OutputSettings) -> Self {
        Self { settings, next: 0 }
    }

    /// The envelope of the next sample, stamped as late as possible.
    pub fn envelope(&self, now: Instant) -> Envelope {
        Envelope {
            sequence: self.next,
            published_ns: self.settings.stamp.map_or(now, |stamp| stamp()).as_ns(),
            epoch: self.settings.epoch,
            ..Envelope::default()
        }
    }

    /// The sample went out.
    pub fn advance(&mut self) {
        self.next += 1;
    }
}

/// What one reader has seen of its channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct InputCounters {
    /// Messages handed to the caller.
    pub received_count: u64,
    /// Sequence numbers that never came: replaced by newer samples in a full buffer or, behind a
    /// gateway, lost on the network.
    pub missed_count: u64,
    /// Messages that came after one with a higher number; only a gateway can cause that.
    pub reordered_count: u64,
    /// Samples of an earlier start of the writer that came after its new start; discarded.
    pub outdated_count: u64,
    /// New starts of the writer.
    pub restart_count: u64,
    /// Attempts to connect to a writer that failed. While it grows, a writer is not heard: it
    /// runs as another Unix user, or died while starting.
    pub connection_failure_count: u64,
}

/// Follows one writer through its restarts.
#[derive(Debug, Default)]
pub struct SequenceTracker {
    counters: InputCounters,
    current: Option<(u32, u64)>,
    previous_epoch: Option<u32>,
}

impl SequenceTracker {
    /// Accounts for one sample; false when it must not reach the caller.
    ///
    /// The first sample ever only sets the count: what was sent before a late joiner came is not
    /// missed. After a restart counting begins at 0, as the reader was there all along.
    pub fn accept(&mut self, envelope: &Envelope) -> bool {
        let Envelope {
            sequence, epoch, ..
        } = *envelope;
        match self.current {
            None => self.current = Some((epoch, sequence)),
            Some((current, newest)) if current == epoch => {
                if sequence > newest {
                    self.counters.missed_count = self
                        .counters
                        .missed_count
                        .saturating_add(sequence - newest - 1);
                    self.current = Some((epoch, sequence));
                } else {
                    self.counters.reordered_count += 1;
                    self.counters.missed_count = self.counters.missed_count.saturating_sub(1);
                }
            }
            Some(_) if self.previous_epoch == Some(epoch) => {
                self.counters.outdated_count += 1;
                return false;
            }
            Some((ended, _)) => {
                self.counters.restart_count += 1;
                self.counters.missed_count = self.counters.missed_count.saturating_add(sequence);
                self.previous_epoch = Some(ended);
                self.current = Some((epoch, sequence));
            }
        }
        self.counters.received_count += 1;
        true
    }

    /// What came, and what did not.
    pub const fn counters(&self) -> InputCounters {
        self.counters
    }
}

/// How long opening a channel waits for the launcher unless told otherwise.
pub(crate) const OPEN_WITHIN: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;

    fn counters(samples: &[(u32, u64)]) -> InputCounters {
        let mut tracker = SequenceTracker::default();
        for (epoch, sequence) in samples {
            tracker.accept(&Envelope {
                sequence: *sequence,
                epoch: *epoch,
                ..Envelope::default()
            });
        }
        tracker.counters()
    }

    #[test]
    fn gaps_are_missed_but_a_late_join_is_not() {
        let seen = counters(&[(1, 40), (1, 41), (1, 45), (1, 46)]);
        assert_eq!((seen.received_count, seen.missed_count), (4, 3));
    }

    #[test]
    fn a_restart_is_counted_and_is_no_gap() {
        let seen = counters(&[(1, 7), (1, 8), (2, 0), (2, 1)]);
        assert_eq!((seen.missed_count, seen.restart_count), (0, 1));
        assert_eq!(counters(&[(1, 7), (2, 3)]).missed_count, 3);
    }

    #[test]
    fn a_reordered_message_fills_its_gap() {
        let seen = counters(&[(1, 0), (1, 2), (1, 1), (1, 3)]);
        assert_eq!((seen.missed_count, seen.reordered_count), (0, 1));
        assert_eq!(seen.received_count, 4);
    }

    #[test]
    fn leftovers_of_the_previous_start_are_discarded() {
        let seen = counters(&[(1, 7), (2, 0), (1, 8), (1, 9), (2, 1)]);
        assert_eq!((seen.received_count, seen.outdated_count), (3, 2));
        assert_eq!((seen.missed_count, seen.restart_count), (0, 1));
    }

    #[test]
    fn a_stamp_is_read_when_the_envelope_is_made() {
        let stamped = |stamp| {
            let settings = OutputSettings {
                epoch: 3,
                stamp,
                notifies_readers: false,
            };
            Sequencer::new(settings).envelope(Instant::from_ns(5))
        };
        assert_eq!(stamped(None).published_ns, 5);
        let late: Stamp = || Instant::from_ns(9);
        assert_eq!(stamped(Some(late)).published_ns, 9);
        assert_eq!(stamped(None).epoch, 3);
    }
}
