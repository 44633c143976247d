//! Writes the records that messages of known fates would have left, for tests of the account.

use super::{AccountContext, ChannelPath, ChannelRecords, MessageFate, RunSpan};
use crate::measure::record::{
    EgressRecord, FollowUpRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE,
};
use crate::time::{Alignment, Instant};

pub(super) const PERIOD_NS: i64 = 1_000_000;

/// Real-time minus monotonic clock.
pub(super) const REALTIME_NS: i64 = 1_790_000_000_000_000_000;

/// Offsets of the stages after publication.
pub(super) const TAKEN_BY_GATEWAY_NS: i64 = 2_000;
pub(super) const HANDED_NS: i64 = 3_000;
pub(super) const TX_NS: i64 = 5_500;
pub(super) const RX_NS: i64 = 6_250;
pub(super) const RECEIVED_NS: i64 = 19_000;
pub(super) const FORWARDED_NS: i64 = 20_000;
pub(super) const TAKEN_NS: i64 = 36_000;

/// The files of one channel, as its processes would have written them.
#[derive(Debug, Clone, Default)]
pub(super) struct Files {
    pub(super) published: Vec<PublishedRecord>,
    pub(super) egress: Vec<EgressRecord>,
    pub(super) ingress: Vec<IngressRecord>,
    pub(super) follow_up: Vec<FollowUpRecord>,
    pub(super) taken: Vec<TakenRecord>,
}

/// One message to write.
#[derive(Debug, Clone, Copy)]
pub(super) struct Written {
    pub(super) epoch: u32,
    pub(super) sequence: u64,
    pub(super) published_ns: i64,
}

impl Files {
    /// `count` messages of one start of the producer that all arrive.
    pub(super) fn delivered(count: u64) -> Self {
        let mut files = Self::default();
        for sequence in 0..count {
            files.write(at(7, sequence), MessageFate::Taken);
        }
        files
    }

    /// What a message with this fate leaves behind. `Unexplained` is a gateway that took the
    /// message and did nothing with it.
    pub(super) fn write(&mut self, message: Written, fate: MessageFate) {
        use MessageFate as Fate;
        self.published.push(PublishedRecord {
            sequence: message.sequence,
            published_ns: message.published_ns,
            epoch: message.epoch,
            reserved: 0,
        });
        if matches!(fate, Fate::SupersededAtInput | Fate::LostInInterruption) {
            return;
        }
        let mut egress = sent(message);
        match fate {
            Fate::RefusedByKernel => {
                egress.flags = EgressRecord::REFUSED_BY_KERNEL;
                egress.tx_software_ns = UNAVAILABLE;
            }
            Fate::Unexplained => {
                egress.handed_ns = UNAVAILABLE;
                egress.tx_software_ns = UNAVAILABLE;
            }
            _ => {}
        }
        self.egress.push(egress);
        if matches!(
            fate,
            Fate::RefusedByKernel | Fate::Unexplained | Fate::LostOnWire | Fate::InFlight
        ) {
            return;
        }
        let mut ingress = arrived(message);
        ingress.flags = match fate {
            Fate::Late => IngressRecord::LATE,
            Fate::Duplicate => IngressRecord::DUPLICATE,
            _ => 0,
        };
        self.follow_up.push(FollowUpRecord {
            sequence: message.sequence,
            handed_to_tx_ns: TX_NS - HANDED_NS,
            session: ingress.session,
            reserved: 0,
        });
        if matches!(fate, Fate::Late | Fate::Duplicate | Fate::RefusedAtIngress) {
            ingress.forwarded_ns = UNAVAILABLE;
        }
        self.ingress.push(ingress);
        if fate == Fate::Taken {
            self.taken.push(TakenRecord {
                sequence: message.sequence,
                published_ns: message.published_ns,
                forwarded_ns: ingress.forwarded_ns,
                taken_ns: message.published_ns + TAKEN_NS,
                epoch: message.epoch,
                reserved: 0,
            });
        }
    }

    pub(super) fn records(&self) -> ChannelRecords<'_> {
        ChannelRecords {
            published: Some(&self.published),
            egress: Some(&self.egress),
            ingress: Some(&self.ingress),
            follow_up: Some(&self.follow_up),
            taken: Some(&self.taken),
        }
    }
}

/// The message `sequence` of a producer started at 0.
pub(super) fn at(epoch: u32, sequence: u64) -> Written {
    let published_ns = i64::try_from(sequence).unwrap() * PERIOD_NS;
    Written {
        epoch,
        sequence,
        published_ns,
    }
}

fn sent(message: Written) -> EgressRecord {
    EgressRecord {
        sequence: message.sequence,
        published_ns: message.published_ns,
        taken_ns: message.published_ns + TAKEN_BY_GATEWAY_NS,
        handed_ns: message.published_ns + HANDED_NS,
        tx_software_ns: message.published_ns + TX_NS + REALTIME_NS,
        tx_hardware_ns: UNAVAILABLE,
        realtime_offset_ns: REALTIME_NS,
        epoch: message.epoch,
        session: 41,
        flags: 0,
        fragment_count: 1,
    }
}

fn arrived(message: Written) -> IngressRecord {
    IngressRecord {
        sequence: message.sequence,
        published_ns: message.published_ns,
        handed_ns: message.published_ns + HANDED_NS,
        rx_hardware_ns: UNAVAILABLE,
        rx_software_ns: message.published_ns + RX_NS + REALTIME_NS,
        received_ns: message.published_ns + RECEIVED_NS,
        forwarded_ns: message.published_ns + FORWARDED_NS,
        realtime_offset_ns: REALTIME_NS,
        emulated_ns: UNAVAILABLE,
        due_ns: UNAVAILABLE,
        epoch: message.epoch,
        session: 41,
        flags: 0,
        fragment_count: 1,
    }
}

/// A gateway's channel on one clock, in a run from 0 to `end_ns`.
pub(super) fn same_clock(end_ns: i64) -> AccountContext<'static> {
    let run = RunSpan {
        start: Instant::ZERO,
        end: Instant::from_ns(end_ns),
    };
    AccountContext {
        producer_run: Some(run),
        consumer_run: Some(run),
        ..AccountContext::new(ChannelPath::Gateway {
            alignment: Some(Alignment::SAME_CLOCK),
        })
    }
}
