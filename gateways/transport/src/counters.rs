//! What the two ends of a transport count and report. It counts nothing by itself.

use core::sync::atomic::{AtomicU64, Ordering};
use core::time::Duration;

use hil_core::link_model::LossCauses;
use hil_net::TxToken;
use hil_protocol::counts;

use super::{Received, SendRefusal};

/// What only one transport counts and has to tell of one of its ends, as a report shows it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EndReport {
    /// Its counts by key. The key ends with the unit: `_count`, `_bytes`, `_us`.
    pub counters: Vec<(&'static str, u64)>,
    /// What a reader has to know besides: a label and words.
    pub facts: Vec<(&'static str, String)>,
    /// How often a sender stood still; `None` where nothing can.
    pub stalls: Option<Stalls>,
}

/// Spans in which the oldest byte that was sent waited longer for its acknowledgement than a
/// transport in good health needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stalls {
    /// How many.
    pub count: u64,
    /// Their length together, each from when its first byte was sent.
    pub total: Duration,
    /// The longest.
    pub longest: Duration,
    /// What waits longer is stalled.
    pub threshold: Duration,
}

impl Stalls {
    pub(crate) fn add(&mut self, length: Duration) {
        self.count += 1;
        self.total += length;
        self.longest = self.longest.max(length);
    }
}

/// How often connections came and went, for a thread that tells of it while another carries
/// messages.
#[derive(Debug, Default)]
pub struct ConnectionTally {
    begun: AtomicU64,
    ended: AtomicU64,
}

impl ConnectionTally {
    pub(crate) fn begin(&self) {
        self.begun.fetch_add(1, Ordering::Release);
    }

    pub(crate) fn end(&self) {
        self.ended.fetch_add(1, Ordering::Release);
    }

    /// Connections that came about.
    pub fn begun_count(&self) -> u64 {
        self.begun.load(Ordering::Acquire)
    }

    /// Connections that ended.
    pub fn ended_count(&self) -> u64 {
        self.ended.load(Ordering::Acquire)
    }
}

counts! {
    /// Everything a sender counts since it was opened.
    pub struct SenderCounters {
        /// Datagrams the transport took.
        sent_count,
        /// Sends refused with [`SendRefusal::PeerRefused`].
        peer_refused_count,
        /// Sends refused with [`SendRefusal::Unreachable`].
        unreachable_count,
        /// Sends refused with [`SendRefusal::QueueFull`].
        queue_full_count,
        /// Sends refused with [`SendRefusal::TooLong`].
        too_long_count,
        /// Sends refused with [`SendRefusal::NotConnected`].
        not_connected_count,
        /// Sends refused with [`SendRefusal::Other`].
        other_refusal_count,
        /// Transmit stamps handed out.
        stamp_count,
        /// Transmit stamps that named no datagram of this sender, dropped.
        unmatched_stamp_count,
        /// Transmit stamps dropped because they were not fetched in time; known for a queue only, the
        /// kernel does not tell.
        stamp_overflow_count,
        /// Reports of the network (ICMP) about earlier datagrams, swallowed.
        network_report_count,
        /// Reports of the network that are not believed, as anybody can send them: they cost no datagram and
        /// decide nothing. On sealed hops and towards foreign programs.
        ignored_report_count,
        /// Reports of this host's stack about earlier datagrams (for instance their length),
        /// swallowed.
        local_report_count,
        /// Entries of the error queue that could not be read or understood, dropped.
        undecodable_report_count,
        /// Replies received from the peer.
        reply_count,
        /// Replies the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`). Known as
        /// of the newest reply received.
        kernel_drop_count,
        /// Datagrams the peer radio acknowledged; asked for on wireless interfaces only.
        radio_acknowledged_count,
        /// Datagrams the peer radio did not acknowledge.
        radio_unacknowledged_count,
        /// Reports of the radio that name no send of ours or came too late to be matched, dropped.
        radio_unmatched_count,
        /// Reports of the radio dropped because they were not taken in time.
        radio_overflow_count,
    }
    beside {
        /// What the newest network or local report said.
        newest_report: Option<SendRefusal>,
    }
}

impl SenderCounters {
    /// Number of the next send as the kernel counts it, modulo 2^32.
    pub(crate) fn next_token(&self) -> TxToken {
        let low_bits = self.sent_count & u64::from(u32::MAX);
        TxToken(u32::try_from(low_bits).expect("masked to 32 bits"))
    }

    pub(crate) fn count_sent(&mut self) -> TxToken {
        let token = self.next_token();
        self.sent_count += 1;
        token
    }

    pub(crate) fn count_refusal(&mut self, refusal: SendRefusal) {
        let counter = match refusal {
            SendRefusal::PeerRefused => &mut self.peer_refused_count,
            SendRefusal::Unreachable { .. } => &mut self.unreachable_count,
            SendRefusal::QueueFull { .. } => &mut self.queue_full_count,
            SendRefusal::TooLong { .. } => &mut self.too_long_count,
            SendRefusal::NotConnected => &mut self.not_connected_count,
            SendRefusal::Other { .. } => &mut self.other_refusal_count,
        };
        *counter += 1;
    }

    /// Sends refused, whatever the reason.
    pub fn refused_count(&self) -> u64 {
        self.peer_refused_count
            + self.unreachable_count
            + self.queue_full_count
            + self.too_long_count
            + self.not_connected_count
            + self.other_refusal_count
    }
}

counts! {
    /// Everything a receiver counts since it was opened.
    pub struct ReceiverCounters {
        /// Datagrams handed to the caller.
        received_count,
        /// Of those, with a software stamp. Divided by `received_count` it is the stamp coverage.
        software_stamp_count,
        /// Of those, with a hardware stamp.
        hardware_stamp_count,
        /// Of those, cut off because the buffer was too short.
        truncated_count,
        /// Of those, with control data that was cut off or damaged, so stamps may be missing.
        damaged_control_count,
        /// Datagrams without a readable source address, dropped.
        sourceless_count,
        /// Datagrams the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`, `SO_MEMINFO`).
        kernel_drop_count,
        /// Replies the transport took.
        reply_count,
        /// Replies it refused.
        reply_refused_count,
        /// Transmit stamps of replies handed out.
        reply_stamp_count,
        /// Transmit stamps of replies that were asked for and did not come in time.
        reply_stamp_missing_count,
        /// Datagrams that arrived with the code point this end marks with; counted where it marks.
        mark_kept_count,
        /// Datagrams that arrived with another code point: something on the way changed it, or the
        /// sender marks otherwise.
        mark_changed_count,
    }
    beside {
        /// The code point of the newest datagram that arrived with another one.
        newest_other_dscp: Option<u8>,
    }
}

/// What a link model did to the datagrams of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkCounts {
    /// Datagrams it lost.
    pub lost_count: u64,
    /// Datagrams, and copies that it makes of them, dropped because the emulation already held as many as it may.
    pub overflow_count: u64,
    /// What the lost ones were lost to; `None` for a model that does not tell.
    pub causes: Option<LossCauses>,
}

impl LinkCounts {
    /// Every counter with its name, zeros included; causes where they are known.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        let causes = self.causes.into_iter().flat_map(|causes| {
            [
                ("link_lost_to_outages_count", causes.outage_count),
                ("link_lost_by_chance_count", causes.chance_count),
                ("link_lost_to_full_queue_count", causes.queue_count),
            ]
        });
        let own = [
            ("link_lost_count", self.lost_count),
            ("link_overflow_count", self.overflow_count),
        ];
        own.into_iter().chain(causes)
    }
}

impl ReceiverCounters {
    /// Compares the mark of an arrival with the one it should have; neither is known without
    /// marking.
    pub(crate) fn count_mark(&mut self, expected_dscp: Option<u8>, class: Option<u8>) {
        let Some((expected_dscp, class)) = expected_dscp.zip(class) else {
            return;
        };
        // The two low bits are for congestion (RFC 3168).
        let dscp = class >> 2;
        if dscp == expected_dscp {
            self.mark_kept_count += 1;
        } else {
            self.mark_changed_count += 1;
            self.newest_other_dscp = Some(dscp);
        }
    }

    pub(crate) fn count_received(&mut self, received: &Received) {
        self.received_count += 1;
        self.truncated_count += u64::from(received.is_truncated);
        self.software_stamp_count += u64::from(received.stamps.software_ns.is_some());
        self.hardware_stamp_count += u64::from(received.stamps.hardware_ns.is_some());
    }
}
