//! What the radio knew of the messages of one channel: whether the peer radio acknowledged them,
//! set against whether they arrived. It asks no radio; the sending gateway's records say it.
//!
//! A frame is acknowledged by the peer *radio* (IEEE 802.11, clause 10.3.2.11). So a message that
//! was acknowledged and never received was lost above the radio, one that was not acknowledged and
//! received lost its acknowledgement, and one that was neither was lost in the air: these three are
//! different faults with different cures. What was lost while a process was down, or was still under way at
//! the end, is none of them.

use serde::{Deserialize, Serialize};

use crate::network::Crossing;
use crate::stage::MessageFate;
use crate::{MessageHistory, RecordsAtHand};
use hil_core::record::EgressRecord;

/// What became of the messages a gateway sent, by the radio's report of their last datagram. Every
/// message handed to the kernel is in exactly one row, and there in exactly one class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RadioMetrics {
    /// Messages handed to the kernel.
    pub handed_count: u64,
    /// Acknowledged by the peer radio. What was lost was lost above it.
    pub acknowledged: RadioRow,
    /// Not acknowledged. Of what arrived, the acknowledgement was lost; what was lost, was lost in the
    /// air, or dropped before.
    pub unacknowledged: RadioRow,
    /// Without a report of the radio.
    pub unreported: RadioRow,
    /// Share of reported messages that were not acknowledged, 0..=1; `None` without reports.
    pub unacknowledged_ratio: Option<Share>,
    /// Share of lost messages whose loss the radio knew of (not acknowledged), 0..=1; `None` when
    /// none was lost, and when arrivals are not known.
    pub known_loss_ratio: Option<Share>,
    /// Share of messages that were lost, of those that arrived or were lost, 0..=1; `None` when
    /// arrivals are not known.
    pub lost_ratio: Option<Share>,
}

/// Messages of which a radio said the same.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RadioRow {
    /// Messages.
    pub count: u64,
    /// What became of them; `None` when the receiving gateway's records are not at hand.
    pub fates: Option<RadioFates>,
}

/// What became of some messages, each in one of these.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RadioFates {
    /// Received by the gateway at the other end.
    pub arrived_count: u64,
    /// Never received, while every process on the way worked.
    pub lost_count: u64,
    /// Lost while a process on the way was down: no fault of the air or of what lies above it.
    pub interrupted_count: u64,
    /// Still under way when the run ended, so that nobody knows.
    pub in_flight_count: u64,
}

impl RadioRow {
    fn add(&mut self, message: &MessageHistory) {
        self.count += 1;
        let Some(fates) = &mut self.fates else { return };
        match (message.crossing(), message.fate) {
            (Crossing::Arrived, _) => fates.arrived_count += 1,
            (_, MessageFate::LostInInterruption) => fates.interrupted_count += 1,
            (_, MessageFate::InFlight) => fates.in_flight_count += 1,
            // Without any receiver's records all of them are unknown, and with them none is.
            (Crossing::Unknown, _) => self.fates = None,
            _ => fates.lost_count += 1,
        }
    }
}

/// A share of all messages of a kind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Of how many.
    pub trial_count: u64,
    /// How many were.
    pub success_count: u64,
    /// The share, 0..=1.
    pub ratio: f64,
}

impl Share {
    /// `success_count` of `trial_count`; `None` without trials.
    pub fn of(success_count: u64, trial_count: u64) -> Option<Self> {
        (trial_count > 0).then(|| Self {
            trial_count,
            success_count,
            ratio: success_count as f64 / trial_count as f64,
        })
    }
}

/// Sets what the radio reported against what arrived, message by message. Fates are those of the account, so
/// that what was under way at the end, or met a gateway that was down, counts as neither lost in the air
/// nor above it.
#[derive(Debug)]
pub struct RadioFold {
    /// Acknowledged, not acknowledged, without a report.
    rows: [RadioRow; 3],
}

impl RadioFold {
    /// Of no message.
    pub fn new(at_hand: RecordsAtHand) -> Self {
        let fates = at_hand.ingress.then(RadioFates::default);
        Self {
            rows: [RadioRow { count: 0, fates }; 3],
        }
    }

    /// Adds a message; one that was not handed to the kernel does not count.
    pub fn add(&mut self, message: &MessageHistory) {
        let Some(egress) = message.egress.filter(EgressRecord::was_handed) else {
            return;
        };
        let [acknowledged, unacknowledged, unreported] = &mut self.rows;
        let row = if egress.flags & EgressRecord::RADIO_ACKNOWLEDGED != 0 {
            acknowledged
        } else if egress.flags & EgressRecord::RADIO_UNACKNOWLEDGED != 0 {
            unacknowledged
        } else {
            unreported
        };
        row.add(message);
    }

    /// What came of it; `None` when no radio reported anything.
    pub fn finish(self) -> Option<RadioMetrics> {
        let [acknowledged, unacknowledged, _] = &self.rows;
        let reported_count = acknowledged.count + unacknowledged.count;
        (reported_count > 0).then(|| metrics(self.rows))
    }
}

fn metrics(rows: [RadioRow; 3]) -> RadioMetrics {
    let [acknowledged, unacknowledged, unreported] = rows;
    let sum = |of: fn(&RadioFates) -> u64| -> Option<u64> {
        rows.iter().map(|row| row.fates.as_ref().map(of)).sum()
    };
    let (arrived_count, lost_count) = (sum(|one| one.arrived_count), sum(|one| one.lost_count));
    let share = |part: Option<u64>, whole: Option<u64>| {
        let (part, whole) = part.zip(whole)?;
        Share::of(part, whole)
    };
    let judged_count = arrived_count.zip(lost_count).map(|(a, b)| a + b);
    RadioMetrics {
        handed_count: rows.iter().map(|row| row.count).sum(),
        acknowledged,
        unacknowledged,
        unreported,
        unacknowledged_ratio: Share::of(
            unacknowledged.count,
            acknowledged.count + unacknowledged.count,
        ),
        known_loss_ratio: share(unacknowledged.fates.map(|one| one.lost_count), lost_count),
        lost_ratio: share(lost_count, judged_count),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        AccountContext, ChannelPath, ChannelRecords, Interruption, PathProcess, RunSpan,
        each_history,
    };
    use hil_core::record::{IngressRecord, UNAVAILABLE};
    use hil_core::time::{Alignment, Instant};

    const ACK: u32 = EgressRecord::RADIO_ACKNOWLEDGED;
    const NO_ACK: u32 = EgressRecord::RADIO_UNACKNOWLEDGED;

    fn radio_metrics(
        records: &ChannelRecords<'_>,
        context: &AccountContext<'_>,
    ) -> Option<RadioMetrics> {
        let mut fold = RadioFold::new(RecordsAtHand::of(records, context));
        each_history(records, context, |message| fold.add(message));
        fold.finish()
    }

    fn sent(sequence: u64, flags: u32) -> EgressRecord {
        EgressRecord {
            sequence,
            published_ns: 0,
            taken_ns: 0,
            handed_ns: 10,
            tx_software_ns: 20,
            tx_hardware_ns: UNAVAILABLE,
            realtime_offset_ns: 0,
            epoch: 1,
            session: 1,
            flags,
            fragment_count: 1,
        }
    }

    fn came(sent: &EgressRecord) -> IngressRecord {
        IngressRecord {
            sequence: sent.sequence,
            published_ns: sent.published_ns,
            epoch: 1,
            ..bytemuck::Zeroable::zeroed()
        }
    }

    /// One message of each kind, two of the kind asked about last.
    fn example() -> (Vec<EgressRecord>, Vec<IngressRecord>) {
        let flags = [ACK, ACK, NO_ACK, NO_ACK, 0, 0, NO_ACK];
        let egress: Vec<_> = flags
            .into_iter()
            .zip(0..)
            .map(|(f, s)| sent(s, f))
            .collect();
        let ingress = [0, 2, 4].map(|index| came(&egress[index])).to_vec();
        (egress, ingress)
    }

    fn context<'a>() -> AccountContext<'a> {
        AccountContext::new(ChannelPath::Gateway { alignment: None })
    }

    fn counts(row: RadioRow) -> [u64; 4] {
        let fates = row.fates.unwrap();
        [
            fates.arrived_count,
            fates.lost_count,
            fates.interrupted_count,
            fates.in_flight_count,
        ]
    }

    #[test]
    fn every_handed_message_is_in_one_class() {
        let (mut egress, ingress) = example();
        egress.push(sent(7, EgressRecord::REFUSED_BY_KERNEL));
        let mut unhanded = sent(8, 0);
        unhanded.handed_ns = UNAVAILABLE;
        egress.push(unhanded);
        let records = ChannelRecords {
            egress: Some(&egress),
            ingress: Some(&ingress),
            ..ChannelRecords::default()
        };
        let figures = radio_metrics(&records, &context()).unwrap();
        assert_eq!(figures.handed_count, 7);
        assert_eq!(counts(figures.acknowledged), [1, 1, 0, 0]);
        assert_eq!(counts(figures.unacknowledged), [1, 2, 0, 0]);
        assert_eq!(counts(figures.unreported), [1, 1, 0, 0]);
        let known = figures.known_loss_ratio.unwrap();
        assert_eq!((known.success_count, known.trial_count), (2, 4));
        let unheard = figures.unacknowledged_ratio.unwrap();
        assert_eq!((unheard.success_count, unheard.trial_count), (3, 5));
        assert_eq!(figures.lost_ratio.unwrap().success_count, 4);
    }

    #[test]
    fn what_was_under_way_or_met_a_dead_gateway_was_not_lost_in_the_air() {
        let second = |sequence: u64, flags| {
            let at_ns = i64::try_from(sequence).unwrap() * 1_000_000_000;
            let mut record = sent(sequence, flags);
            (record.published_ns, record.handed_ns) = (at_ns, at_ns + 10);
            record
        };
        // One a second. 3 meets a gateway that is down, 9 is under way when the run ends, 5 is lost.
        let egress: Vec<_> = (0..10).map(|one| second(one, NO_ACK)).collect();
        let ingress = [0, 1, 2, 4, 6, 7, 8]
            .map(|index| came(&egress[index]))
            .to_vec();
        let records = ChannelRecords {
            egress: Some(&egress),
            ingress: Some(&ingress),
            ..ChannelRecords::default()
        };
        let at = Instant::from_ns;
        let down = [Interruption {
            process: "gateway".to_owned(),
            place: PathProcess::ReceivingGateway,
            from: at(2_900_000_000),
            until: at(3_100_000_000),
            cause: "killed by signal 9".to_owned(),
        }];
        let run = Some(RunSpan {
            start: at(0),
            end: at(9_010_000_000),
        });
        let context = AccountContext {
            producer_run: run,
            consumer_run: run,
            interruptions: &down,
            ..AccountContext::new(ChannelPath::Gateway {
                alignment: Some(Alignment::SAME_CLOCK),
            })
        };
        let figures = radio_metrics(&records, &context).unwrap();
        assert_eq!(counts(figures.unacknowledged), [7, 1, 1, 1]);
        let lost = figures.lost_ratio.unwrap();
        assert_eq!((lost.success_count, lost.trial_count), (1, 8));
        assert_eq!(figures.known_loss_ratio.unwrap().trial_count, 1);
    }

    #[test]
    fn without_the_receivers_records_no_message_is_called_lost() {
        let (egress, _) = example();
        let records = ChannelRecords {
            egress: Some(&egress),
            ..ChannelRecords::default()
        };
        let figures = radio_metrics(&records, &context()).unwrap();
        let rows = [
            figures.acknowledged,
            figures.unacknowledged,
            figures.unreported,
        ];
        assert_eq!(rows.map(|row| row.count), [2, 3, 2]);
        assert!(rows.iter().all(|row| row.fates.is_none()), "{rows:?}");
        assert_eq!((figures.lost_ratio, figures.known_loss_ratio), (None, None));
    }

    #[test]
    fn a_wired_channel_has_no_radio_metrics() {
        let egress = [sent(0, 0), sent(1, EgressRecord::STAMPED_BEFORE_QUEUE)];
        let records = ChannelRecords {
            egress: Some(&egress),
            ..ChannelRecords::default()
        };
        assert_eq!(radio_metrics(&records, &context()), None);
        let nothing = ChannelRecords::default();
        assert_eq!(radio_metrics(&nothing, &context()), None);
    }
}
