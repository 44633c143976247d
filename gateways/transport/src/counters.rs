//! What the two ends of a transport count. It counts nothing by itself.

use hil_core::link_model::LossCauses;

use super::{Received, SendRefusal};

/// Everything a sender counts since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SenderCounters {
    /// Datagrams the transport took.
    pub sent_count: u64,
    /// Sends refused with [`SendRefusal::PeerRefused`].
    pub peer_refused_count: u64,
    /// Sends refused with [`SendRefusal::Unreachable`].
    pub unreachable_count: u64,
    /// Sends refused with [`SendRefusal::QueueFull`].
    pub queue_full_count: u64,
    /// Sends refused with [`SendRefusal::TooLong`].
    pub too_long_count: u64,
    /// Sends refused with [`SendRefusal::NotConnected`].
    pub not_connected_count: u64,
    /// Sends refused with [`SendRefusal::Other`].
    pub other_refusal_count: u64,
    /// Transmit stamps handed out.
    pub stamp_count: u64,
    /// Transmit stamps that named no datagram of this sender, dropped.
    pub unmatched_stamp_count: u64,
    /// Transmit stamps dropped because nobody fetched them in time; known for a queue only, the
    /// kernel does not tell.
    pub stamp_overflow_count: u64,
    /// Reports of the network (ICMP) about earlier datagrams, swallowed.
    pub network_report_count: u64,
    /// Reports of this host's stack about earlier datagrams (for instance their length),
    /// swallowed.
    pub local_report_count: u64,
    /// Entries of the error queue that could not be read or understood, dropped.
    pub undecodable_report_count: u64,
    /// Replies received from the peer.
    pub reply_count: u64,
    /// Replies the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`). Known as
    /// of the newest reply received.
    pub kernel_drop_count: u64,
    /// Datagrams the peer radio acknowledged; asked for on wireless interfaces only.
    pub radio_acknowledged_count: u64,
    /// Datagrams the peer radio did not acknowledge.
    pub radio_unacknowledged_count: u64,
    /// Reports of the radio that name no send of ours or came too late to be matched, dropped.
    pub radio_unmatched_count: u64,
    /// Reports of the radio dropped because nobody took them in time.
    pub radio_overflow_count: u64,
    /// What the newest network or local report said.
    pub newest_report: Option<SendRefusal>,
}

impl SenderCounters {
    /// Every counter with its name, in the order above.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        [
            ("sent_count", self.sent_count),
            ("peer_refused_count", self.peer_refused_count),
            ("unreachable_count", self.unreachable_count),
            ("queue_full_count", self.queue_full_count),
            ("too_long_count", self.too_long_count),
            ("not_connected_count", self.not_connected_count),
            ("other_refusal_count", self.other_refusal_count),
            ("stamp_count", self.stamp_count),
            ("unmatched_stamp_count", self.unmatched_stamp_count),
            ("stamp_overflow_count", self.stamp_overflow_count),
            ("network_report_count", self.network_report_count),
            ("local_report_count", self.local_report_count),
            ("undecodable_report_count", self.undecodable_report_count),
            ("reply_count", self.reply_count),
            ("kernel_drop_count", self.kernel_drop_count),
            ("radio_acknowledged_count", self.radio_acknowledged_count),
            (
                "radio_unacknowledged_count",
                self.radio_unacknowledged_count,
            ),
            ("radio_unmatched_count", self.radio_unmatched_count),
            ("radio_overflow_count", self.radio_overflow_count),
        ]
        .into_iter()
    }
}

impl SenderCounters {
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

/// Everything a receiver counts since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReceiverCounters {
    /// Datagrams handed to the caller.
    pub received_count: u64,
    /// Of those, with a software stamp. Divided by `received_count` it is the stamp coverage.
    pub software_stamp_count: u64,
    /// Of those, with a hardware stamp.
    pub hardware_stamp_count: u64,
    /// Of those, cut off because the buffer was too short.
    pub truncated_count: u64,
    /// Of those, with control data that was cut off or damaged, so stamps may be missing.
    pub damaged_control_count: u64,
    /// Datagrams without a readable source address, dropped.
    pub sourceless_count: u64,
    /// Datagrams the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`). Known
    /// as of the newest datagram received: drops after it show with the next one.
    pub kernel_drop_count: u64,
    /// Replies the transport took.
    pub reply_count: u64,
    /// Replies it refused.
    pub reply_refused_count: u64,
    /// Transmit stamps of replies handed out.
    pub reply_stamp_count: u64,
    /// Transmit stamps of replies that were asked for and did not come in time.
    pub reply_stamp_missing_count: u64,
    /// Datagrams the link model lost.
    pub link_lost_count: u64,
    /// Datagrams dropped because the emulation already held as many as it may.
    pub link_overflow_count: u64,
    /// What the lost ones were lost to; `None` without a link model, or for one that does not tell.
    pub link_loss_causes: Option<LossCauses>,
    /// Datagrams that arrived with the code point this end marks with; counted where it marks.
    pub mark_kept_count: u64,
    /// Datagrams that arrived with another code point: something on the way changed it, or the
    /// sender marks otherwise.
    pub mark_changed_count: u64,
    /// The code point of the newest of those.
    pub newest_other_dscp: Option<u8>,
}

impl ReceiverCounters {
    /// Every counter with its name, in the order above.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        [
            ("received_count", self.received_count),
            ("software_stamp_count", self.software_stamp_count),
            ("hardware_stamp_count", self.hardware_stamp_count),
            ("truncated_count", self.truncated_count),
            ("damaged_control_count", self.damaged_control_count),
            ("sourceless_count", self.sourceless_count),
            ("kernel_drop_count", self.kernel_drop_count),
            ("reply_count", self.reply_count),
            ("reply_refused_count", self.reply_refused_count),
            ("reply_stamp_count", self.reply_stamp_count),
            ("reply_stamp_missing_count", self.reply_stamp_missing_count),
            ("link_lost_count", self.link_lost_count),
            ("link_overflow_count", self.link_overflow_count),
            ("mark_kept_count", self.mark_kept_count),
            ("mark_changed_count", self.mark_changed_count),
        ]
        .into_iter()
        .chain(self.link_loss_causes.into_iter().flat_map(|causes| {
            [
                ("link_lost_to_outages_count", causes.outage_count),
                ("link_lost_by_chance_count", causes.chance_count),
                ("link_lost_to_full_queue_count", causes.queue_count),
            ]
        }))
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
