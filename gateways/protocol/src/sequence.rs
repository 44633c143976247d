//! What became of a channel's messages: received, lost, reordered, duplicate, late. It looks at
//! sequence numbers only; times are measured elsewhere.
//!
//! A message is *lost* once its number has slid out of the newest 1024 unseen, or is still unseen
//! when its stream is finished. Until then a gap is *outstanding*: a reordered message can fill it.
//! Numbers that never left the sending host count as well: what they cost is found by joining the
//! records of both hosts.
//!
//! A stream is one start of the producer within one session of the sending gateway; a new stream
//! is a restart, and never a loss. Which of two streams of a session is the newer one is told by
//! the sending gateway's own clock, so that neither a datagram that was long under way nor a single
//! corrupted one can make the window follow a stream that is over.

use crate::counts;

/// Sequence numbers the window remembers.
pub const WINDOW_LENGTH: u64 = 1024;
/// Entries of the burst-length histogram; the last counts everything longer.
pub const BURST_LENGTH_MAX: usize = 32;

const WORDS: usize = 16;
const _: () = assert!(WORDS as u64 * 64 == WINDOW_LENGTH);

/// One start of the producer within one session of the sending gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stream {
    /// The sending gateway's start.
    pub session: u32,
    /// The producer's start.
    pub epoch: u32,
}

/// Where a message stands among those already seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Newer than everything seen, with `gap` unseen numbers just before it.
    InOrder {
        /// Numbers skipped; 0 when it directly follows.
        gap: u64,
    },
    /// Older than the newest, not seen before.
    Reordered,
    /// Seen before.
    Duplicate,
    /// Older than the window, or of a stream that is over: whether it was seen is not known.
    Late,
}

counts! {
    /// What became of a channel's messages so far.
    pub struct SequenceCounts {
        /// Distinct messages received, reordered ones included.
        received_count,
        /// Messages that never came, definitely.
        lost_count,
        /// Messages received after a newer one.
        reordered_count,
        /// Copies of messages received before.
        duplicate_count,
        /// Messages too old to judge.
        late_count,
        /// Streams that replaced an earlier one.
        restart_count,
        /// Consecutive messages lost in the longest burst.
        loss_burst_length_max,
    }
    beside {
        /// Losses by the number of consecutive messages lost: entry i counts bursts of i + 1, the last
        /// entry all longer ones as well.
        loss_bursts: [u64; BURST_LENGTH_MAX],
    }
}

/// The window and its counts.
#[derive(Debug, Clone)]
pub struct SequenceWindow {
    stream: Option<Stream>,
    /// The stream that was finished last.
    ended: Option<Stream>,
    /// Latest hand-over seen, by the sending gateway's clock.
    handed_ns_max: i64,
    /// Lowest number that counts; messages before it were never expected here.
    base: u64,
    highest: u64,
    /// One past the last number the sender says it sent.
    announced_end: u64,
    /// Bit `sequence % 1024` of the ring: seen.
    seen: [u64; WORDS],
    burst_length: u64,
    counts: SequenceCounts,
}

impl Default for SequenceWindow {
    fn default() -> Self {
        Self::new()
    }
}

impl SequenceWindow {
    /// An empty window. The first message of the first stream is where counting starts.
    pub const fn new() -> Self {
        Self {
            stream: None,
            ended: None,
            handed_ns_max: i64::MIN,
            base: 0,
            highest: 0,
            announced_end: 0,
            seen: [0; WORDS],
            burst_length: 0,
            counts: SequenceCounts {
                received_count: 0,
                lost_count: 0,
                reordered_count: 0,
                duplicate_count: 0,
                late_count: 0,
                restart_count: 0,
                loss_bursts: [0; BURST_LENGTH_MAX],
                loss_burst_length_max: 0,
            },
        }
    }

    /// Where a message would stand, without counting it; `handed_ns` is when the sending gateway
    /// handed it over, by its own clock.
    pub fn peek(&self, stream: Stream, sequence: u64, handed_ns: i64) -> Order {
        if self.stream != Some(stream) {
            let base = self.base_of_new(stream, sequence);
            return if self.is_over(stream, handed_ns) {
                Order::Late
            } else {
                Order::InOrder {
                    gap: sequence - base,
                }
            };
        }
        if sequence > self.highest {
            Order::InOrder {
                gap: sequence - self.highest - 1,
            }
        } else if self.highest - sequence >= WINDOW_LENGTH {
            Order::Late
        } else if self.is_seen(sequence) {
            Order::Duplicate
        } else {
            Order::Reordered
        }
    }

    /// Counts a message and says where it stands; see [`SequenceWindow::peek`].
    pub fn record(&mut self, stream: Stream, sequence: u64, handed_ns: i64) -> Order {
        let order = self.peek(stream, sequence, handed_ns);
        match order {
            Order::InOrder { .. } => {
                if self.stream == Some(stream) {
                    self.advance(sequence);
                } else {
                    self.begin(stream, sequence);
                }
                self.mark(sequence);
                self.counts.received_count += 1;
            }
            Order::Reordered => {
                self.base = self.base.min(sequence);
                self.mark(sequence);
                self.counts.received_count += 1;
                self.counts.reordered_count += 1;
            }
            Order::Duplicate => self.counts.duplicate_count += 1,
            Order::Late => self.counts.late_count += 1,
        }
        if self.stream == Some(stream) {
            self.handed_ns_max = self.handed_ns_max.max(handed_ns);
        }
        order
    }

    /// Notes that the sender says it sent everything below `next_sequence` and nothing more; what
    /// is missing of it counts as lost when the stream is finished.
    pub fn announce_end(&mut self, stream: Stream, next_sequence: u64) {
        if self.stream == Some(stream) {
            self.announced_end = self.announced_end.max(next_sequence);
        }
    }

    /// Ends the current stream: every outstanding gap becomes a loss. A message of it that was
    /// under way is late; one sent after those already seen opens the stream again.
    pub fn finish(&mut self) {
        let Some(stream) = self.stream.take() else {
            return;
        };
        let oldest = self.highest.saturating_sub(WINDOW_LENGTH - 1);
        for sequence in oldest.max(self.base)..=self.highest {
            self.settle(sequence);
        }
        self.lose(
            self.announced_end
                .saturating_sub(self.highest.saturating_add(1)),
        );
        self.close_burst();
        self.ended = Some(stream);
    }

    /// The counts so far; outstanding gaps are not in them.
    pub const fn counts(&self) -> &SequenceCounts {
        &self.counts
    }

    /// Gaps within the window that a reordered message could still fill.
    pub fn outstanding_count(&self) -> u64 {
        if self.stream.is_none() {
            return 0;
        }
        let oldest = self
            .highest
            .saturating_sub(WINDOW_LENGTH - 1)
            .max(self.base);
        (oldest..=self.highest)
            .filter(|&sequence| !self.is_seen(sequence))
            .count() as u64
    }

    /// Where counting starts in a stream that opens with `sequence`: at 0 when the producer
    /// restarted under a gateway that kept running (unless far more than a window is missing), else
    /// at the message itself, because a gateway may join a producer at any point.
    fn base_of_new(&self, stream: Stream, sequence: u64) -> u64 {
        let is_producer_restart = self
            .stream
            .is_some_and(|current| current.session == stream.session);
        if is_producer_restart && sequence < WINDOW_LENGTH {
            0
        } else {
            sequence
        }
    }

    /// Whether `stream`, which is not the current one, is an older one.
    fn is_over(&self, stream: Stream, handed_ns: i64) -> bool {
        match self.stream {
            Some(current) => current.session == stream.session && handed_ns <= self.handed_ns_max,
            None => self.ended == Some(stream) && handed_ns <= self.handed_ns_max,
        }
    }

    fn begin(&mut self, stream: Stream, sequence: u64) {
        let base = self.base_of_new(stream, sequence);
        self.finish();
        self.counts.restart_count += u64::from(self.ended.is_some());
        self.handed_ns_max = i64::MIN;
        self.stream = Some(stream);
        self.base = base;
        self.highest = sequence;
        self.announced_end = 0;
        self.seen = [0; WORDS];
    }

    /// Moves the window up to `sequence`, settling what slides out.
    fn advance(&mut self, sequence: u64) {
        let step = sequence - self.highest;
        let oldest = self.highest.saturating_sub(WINDOW_LENGTH - 1);
        // Numbers above the old highest enter unseen; those that leave again at once, when the
        // step is longer than the window, were never seen.
        let sliding_end = sequence
            .saturating_sub(WINDOW_LENGTH - 1)
            .min(self.highest + 1);
        for sliding in oldest.max(self.base)..sliding_end {
            self.settle(sliding);
        }
        if step > WINDOW_LENGTH {
            self.lose(step - WINDOW_LENGTH);
        }
        for entering in sequence.saturating_sub(step.min(WINDOW_LENGTH) - 1)..=sequence {
            let (word, bit) = position(entering);
            self.seen[word] &= !bit;
        }
        self.highest = sequence;
    }

    fn settle(&mut self, sequence: u64) {
        if self.is_seen(sequence) {
            self.close_burst();
        } else {
            self.lose(1);
        }
    }

    fn lose(&mut self, count: u64) {
        self.counts.lost_count = self.counts.lost_count.saturating_add(count);
        self.burst_length = self.burst_length.saturating_add(count);
    }

    fn close_burst(&mut self) {
        if self.burst_length == 0 {
            return;
        }
        let longest = BURST_LENGTH_MAX as u64;
        let index = usize::try_from(self.burst_length.min(longest) - 1)
            .expect("a burst length is at most 32 here");
        self.counts.loss_bursts[index] += 1;
        self.counts.loss_burst_length_max =
            self.counts.loss_burst_length_max.max(self.burst_length);
        self.burst_length = 0;
    }

    fn mark(&mut self, sequence: u64) {
        let (word, bit) = position(sequence);
        self.seen[word] |= bit;
    }

    fn is_seen(&self, sequence: u64) -> bool {
        let (word, bit) = position(sequence);
        self.seen[word] & bit != 0
    }
}

fn position(sequence: u64) -> (usize, u64) {
    let slot = sequence % WINDOW_LENGTH;
    let word = usize::try_from(slot / 64).expect("a slot is below 1024");
    (word, 1 << (slot % 64))
}
