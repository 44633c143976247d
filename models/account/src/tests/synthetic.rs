//! Writes the records that messages of known fates would have left, for tests of what reads them.

use super::{AccountContext, ChannelPath, ChannelRecords, Interruption, MessageFate, RunSpan};
use hil_core::record::{
    EgressRecord, FollowUp, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE,
};
use hil_core::time::{Alignment, Instant};

/// From one publication to the next.
pub const PERIOD_NS: i64 = 1_000_000;

/// Real-time minus monotonic clock.
pub const REALTIME_NS: i64 = 1_790_000_000_000_000_000;

/// Taken by the sending gateway, after publication as those below.
pub const TAKEN_BY_GATEWAY_NS: i64 = 2_000;
/// Handed to the kernel.
pub const HANDED_NS: i64 = 3_000;
/// Transmit stamp.
pub const TX_NS: i64 = 5_500;
/// Receive stamp.
pub const RX_NS: i64 = 6_250;
/// Received by the gateway.
pub const RECEIVED_NS: i64 = 19_000;
/// Forwarded to the consumer.
pub const FORWARDED_NS: i64 = 20_000;
/// Taken by the consumer.
pub const TAKEN_NS: i64 = 36_000;

/// The files of one channel, as its processes would have written them.
#[derive(Debug, Clone, Default)]
pub struct Files {
    /// The producer's.
    pub published: Vec<PublishedRecord>,
    /// The sending gateway's.
    pub egress: Vec<EgressRecord>,
    /// The receiving gateway's.
    pub ingress: Vec<IngressRecord>,
    /// The consumer's.
    pub taken: Vec<TakenRecord>,
}

/// One message to write.
#[derive(Debug, Clone, Copy)]
pub struct Written {
    /// Start of the producer.
    pub epoch: u32,
    /// Sequence number.
    pub sequence: u64,
    /// When it was published.
    pub published_ns: i64,
}

impl Files {
    /// `count` messages of one start of the producer that all arrive.
    pub fn delivered(count: u64) -> Self {
        let mut files = Self::default();
        for sequence in 0..count {
            files.write(at(7, sequence), MessageFate::Taken);
        }
        files
    }

    /// What a message with this fate leaves behind. `Unexplained` is a gateway that took the
    /// message and did nothing with it.
    pub fn write(&mut self, message: Written, fate: MessageFate) {
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
            Fate::Incomplete => IngressRecord::INCOMPLETE,
            Fate::Late => IngressRecord::LATE,
            Fate::Duplicate => IngressRecord::DUPLICATE,
            _ => 0,
        };
        if matches!(
            fate,
            Fate::Incomplete | Fate::Late | Fate::Duplicate | Fate::RefusedAtIngress
        ) {
            ingress.forwarded_ns = UNAVAILABLE;
        } else {
            let before = self.ingress.last();
            let before = before.filter(|one| one.epoch == ingress.epoch);
            ingress = ingress.with_follow_up(before.map(|one| FollowUp {
                sequence: one.sequence,
                handed_to_tx_ns: TX_NS - HANDED_NS,
            }));
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

    /// The sender reports no transmit stamp.
    pub fn forget_follow_ups(&mut self) {
        for record in &mut self.ingress {
            *record = record.with_follow_up(None);
        }
    }

    /// As the account reads them.
    pub fn records(&self) -> ChannelRecords<'_> {
        ChannelRecords {
            published: Some(&self.published),
            egress: Some(&self.egress),
            ingress: Some(&self.ingress),
            taken: Some(&self.taken),
        }
    }
}

/// The message `sequence` of a producer started at 0.
///
/// # Panics
/// When it would be published after 292 years.
pub fn at(epoch: u32, sequence: u64) -> Written {
    let published_ns = i64::try_from(sequence).expect("a test has few messages") * PERIOD_NS;
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
        follow_up_sequence: 0,
        follow_up_ns: UNAVAILABLE,
        epoch: message.epoch,
        session: 41,
        flags: 0,
        fragment_count: 1,
    }
}

impl<'a> AccountContext<'a> {
    /// The same with these interruptions.
    #[must_use]
    pub const fn with_interruptions(mut self, interruptions: &'a [Interruption]) -> Self {
        self.interruptions = interruptions;
        self
    }
}

/// A gateway's channel on one clock, in a run from 0 to `end_ns`.
pub fn same_clock(end_ns: i64) -> AccountContext<'static> {
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
