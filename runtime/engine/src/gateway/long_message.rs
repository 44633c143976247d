//! A message that is too long to be sent in one go, while its pieces leave: a few at a time, between the
//! messages of other channels, and no more than so many that this host has not got rid of yet. Its bytes
//! stay where its producer put them.

use std::time::Duration;

use hil_core::record::{EgressRecord, UNAVAILABLE};
use hil_core::time::Instant;
use hil_protocol::{EgressBridge, PeerState};
use hil_transport::SendRefusal;

use super::line::{Line, failure};
use hil_platform::clock::MonotonicClock;
use hil_shm::HeldMessage;

/// Pieces that leave in one turn: a short message waits for so many.
const BURST_COUNT: usize = 8;
/// Bytes that may wait on this host, in the queue of its card above all: half a millisecond of gigabit
/// Ethernet, which is what a short message waits behind them.
const QUEUED_BYTES_MAX: usize = 65_536;
/// When to look again whether they are fewer.
const RETRY: Duration = Duration::from_micros(100);

/// The message and what is known of it.
#[derive(Debug)]
pub(super) struct LongMessage {
    channel: usize,
    held: HeldMessage,
    /// Until its last piece has left.
    record: Option<EgressRecord>,
    /// When its next pieces may leave.
    pub(super) due: Instant,
}

impl LongMessage {
    /// Of `channel`; none of it has left yet.
    pub(super) const fn new(channel: usize, held: HeldMessage, record: EgressRecord) -> Self {
        Self {
            channel,
            held,
            record: Some(record),
            due: Instant::ZERO,
        }
    }

    /// Its next pieces may leave earlier than was thought.
    pub(super) const fn on_piece_arrived(&mut self) {
        self.due = Instant::ZERO;
    }

    /// Sends its next pieces, if they may leave; false when none did.
    pub(super) fn push(&mut self, bridge: &mut EgressBridge, line: &mut Line) -> bool {
        let mut now = MonotonicClock::now();
        if now < self.due {
            return false;
        }
        let mut has_moved = false;
        for _ in 0..BURST_COUNT {
            if line.sender.queued_bytes() >= QUEUED_BYTES_MAX {
                self.due = now + RETRY;
                break;
            }
            if let Some(until) = bridge.piece_held_until(now) {
                self.due = until;
                break;
            }
            let Some(piece) = bridge.long_piece(now, self.held.payload()) else {
                break;
            };
            if let Some(record) = &mut self.record {
                record.fragment_count += 1;
                if record.handed_ns == UNAVAILABLE {
                    record.handed_ns = now.as_ns();
                }
            }
            let record = self.record.filter(|_| piece.is_last);
            match line.send_piece(&piece, now, record) {
                Ok(()) => {
                    if piece.is_last {
                        self.record = None;
                    }
                    bridge.on_long_sent();
                    has_moved = true;
                }
                Err(SendRefusal::QueueFull { .. }) => {
                    // It is tried again.
                    if let Some(record) = &mut self.record {
                        record.fragment_count -= 1;
                        if record.fragment_count == 0 {
                            record.handed_ns = UNAVAILABLE;
                        }
                    }
                    self.due = now + RETRY;
                    break;
                }
                Err(refusal) => {
                    let is_established = bridge.peer_state() == PeerState::Established;
                    bridge.on_long_failed(now, failure(refusal, is_established));
                    break;
                }
            }
            now = MonotonicClock::now();
        }
        // Every piece has a stamp, which takes room until it is read.
        line.take_stamps(bridge);
        has_moved
    }

    /// It is no longer under way; what is left of it will not leave. Its channel.
    pub(super) fn end(&mut self, line: &mut Line) -> usize {
        if let Some(record) = self.record.take() {
            line.finish_refused(self.channel, record);
        }
        self.channel
    }
}
