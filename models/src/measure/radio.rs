//! What the radio knew of the messages of one channel: whether the peer radio acknowledged them,
//! set against whether they arrived. It asks no radio; the sending gateway's records say it.
//!
//! A frame is acknowledged by the peer *radio* (IEEE 802.11, clause 10.3.2.11). So a message that
//! was acknowledged and never received was lost above the radio, one that was not acknowledged and
//! received lost its acknowledgement, and one that was neither was lost in the air: these three are
//! different faults with different cures.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::account::ChannelRecords;
use super::record::{EgressRecord, UNAVAILABLE};
use super::statistics::{Interval, wilson};

/// Confidence of every interval here.
const CONFIDENCE: f64 = 0.95;

/// What became of the messages a gateway sent, by the radio's report of their last datagram. Every
/// message handed to the kernel is in exactly one count.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RadioFigures {
    /// Messages handed to the kernel.
    pub handed_count: u64,
    /// Acknowledged, and received by the gateway at the other end.
    pub acknowledged_arrived_count: u64,
    /// Acknowledged, and never received: lost above the peer radio.
    pub acknowledged_lost_count: u64,
    /// Not acknowledged, and received: the acknowledgement was lost.
    pub unacknowledged_arrived_count: u64,
    /// Not acknowledged, and never received: lost in the air, or dropped before.
    pub unacknowledged_lost_count: u64,
    /// Without a report of the radio, and received.
    pub unreported_arrived_count: u64,
    /// Without a report of the radio, and never received.
    pub unreported_lost_count: u64,
    /// Whether a message arrived is not known, as the receiving gateway's records are not at hand:
    /// the `arrived` and `lost` counts are zero and these two tell what the radio said.
    pub is_arrival_unknown: bool,
    /// Acknowledged, of those whose arrival is not known.
    pub acknowledged_unknown_count: u64,
    /// Not acknowledged, of those whose arrival is not known.
    pub unacknowledged_unknown_count: u64,
    /// Without a report, of those whose arrival is not known.
    pub unreported_unknown_count: u64,
    /// Share of reported messages that were not acknowledged, 0..=1; `None` without reports.
    pub unacknowledged_ratio: Option<Share>,
    /// Share of lost messages whose loss the radio knew of (not acknowledged), 0..=1; `None` when
    /// none was lost.
    pub known_loss_ratio: Option<Share>,
    /// Share of messages that never arrived, 0..=1; `None` when arrivals are not known.
    pub lost_ratio: Option<Share>,
}

/// A share with its interval (Wilson 1927, 95 %).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Of how many.
    pub trial_count: u64,
    /// How many were.
    pub success_count: u64,
    /// The share, 0..=1.
    pub ratio: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

impl Share {
    /// `success_count` of `trial_count`; `None` without trials.
    pub fn of(success_count: u64, trial_count: u64) -> Option<Self> {
        let Interval { low, high } = wilson(success_count, trial_count, CONFIDENCE)?;
        Some(Self {
            trial_count,
            success_count,
            ratio: success_count as f64 / trial_count as f64,
            low,
            high,
        })
    }
}

/// Where the transmit stamps of a channel were taken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TransmitStampFigures {
    /// Messages handed to the kernel.
    pub handed_count: u64,
    /// Stamped by the driver when they left.
    pub departure_count: u64,
    /// Stamped before the queueing discipline: the driver stamps no departures.
    pub before_queue_count: u64,
    /// Without a kernel stamp: the gateway's own, before the send call, is the last known.
    pub application_count: u64,
}

/// Where the transmit stamps of `egress` were taken.
pub fn transmit_stamps(egress: &[EgressRecord]) -> TransmitStampFigures {
    let mut figures = TransmitStampFigures::default();
    for record in handed(egress) {
        figures.handed_count += 1;
        let is_before_queue = record.flags & EgressRecord::STAMPED_BEFORE_QUEUE != 0;
        let counter = match (record.tx_software_ns == UNAVAILABLE, is_before_queue) {
            (true, _) => &mut figures.application_count,
            (false, true) => &mut figures.before_queue_count,
            (false, false) => &mut figures.departure_count,
        };
        *counter += 1;
    }
    figures
}

/// Sets what the radio reported against what arrived; `None` when no radio reported anything or
/// the sending gateway's records are not at hand.
pub fn radio_figures(records: &ChannelRecords<'_>) -> Option<RadioFigures> {
    let egress = records.egress?;
    let reports = EgressRecord::RADIO_ACKNOWLEDGED | EgressRecord::RADIO_UNACKNOWLEDGED;
    if !egress.iter().any(|record| record.flags & reports != 0) {
        return None;
    }
    let arrived: Option<BTreeSet<(u32, u64)>> = records
        .ingress
        .map(|all| all.iter().map(|one| (one.epoch, one.sequence)).collect());
    // Rows: acknowledged, not acknowledged, not reported. Columns: arrived, lost, unknown.
    let mut counts = [[0_u64; 3]; 3];
    for record in handed(egress) {
        let row = if record.flags & EgressRecord::RADIO_ACKNOWLEDGED != 0 {
            0
        } else if record.flags & EgressRecord::RADIO_UNACKNOWLEDGED != 0 {
            1
        } else {
            2
        };
        let column = match &arrived {
            None => 2,
            Some(arrived) => usize::from(!arrived.contains(&(record.epoch, record.sequence))),
        };
        counts[row][column] += 1;
    }
    Some(figures(counts, arrived.is_none()))
}

fn figures(counts: [[u64; 3]; 3], is_arrival_unknown: bool) -> RadioFigures {
    let row = |index: usize| counts[index].iter().sum::<u64>();
    let column = |index: usize| counts.iter().map(|row| row[index]).sum::<u64>();
    let handed_count = row(0) + row(1) + row(2);
    RadioFigures {
        handed_count,
        acknowledged_arrived_count: counts[0][0],
        acknowledged_lost_count: counts[0][1],
        unacknowledged_arrived_count: counts[1][0],
        unacknowledged_lost_count: counts[1][1],
        unreported_arrived_count: counts[2][0],
        unreported_lost_count: counts[2][1],
        is_arrival_unknown,
        acknowledged_unknown_count: counts[0][2],
        unacknowledged_unknown_count: counts[1][2],
        unreported_unknown_count: counts[2][2],
        unacknowledged_ratio: Share::of(row(1), row(0) + row(1)),
        known_loss_ratio: Share::of(counts[1][1], column(1)),
        lost_ratio: Share::of(column(1), column(0) + column(1)),
    }
}

/// The messages that were handed to the kernel.
fn handed(egress: &[EgressRecord]) -> impl Iterator<Item = &EgressRecord> {
    egress.iter().filter(|record| {
        record.handed_ns != UNAVAILABLE && record.flags & EgressRecord::REFUSED_BY_KERNEL == 0
    })
}

#[cfg(test)]
mod tests {
    use super::super::record::IngressRecord;
    use super::*;

    const ACK: u32 = EgressRecord::RADIO_ACKNOWLEDGED;
    const NO_ACK: u32 = EgressRecord::RADIO_UNACKNOWLEDGED;

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

    fn came(sequence: u64) -> IngressRecord {
        IngressRecord {
            sequence,
            epoch: 1,
            ..bytemuck::Zeroable::zeroed()
        }
    }

    /// One message of each kind, two of the kind asked about last.
    fn example() -> (Vec<EgressRecord>, Vec<IngressRecord>) {
        let flags = [ACK, ACK, NO_ACK, NO_ACK, 0, 0, NO_ACK];
        let egress = flags
            .into_iter()
            .zip(0..)
            .map(|(f, s)| sent(s, f))
            .collect();
        let ingress = [0, 2, 4].into_iter().map(came).collect();
        (egress, ingress)
    }

    #[test]
    fn every_handed_message_is_in_one_count() {
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
        let figures = radio_figures(&records).unwrap();
        assert_eq!(figures.handed_count, 7);
        assert_eq!(figures.acknowledged_arrived_count, 1);
        assert_eq!(figures.acknowledged_lost_count, 1);
        assert_eq!(figures.unacknowledged_arrived_count, 1);
        assert_eq!(figures.unacknowledged_lost_count, 2);
        assert_eq!(figures.unreported_arrived_count, 1);
        assert_eq!(figures.unreported_lost_count, 1);
        let known = figures.known_loss_ratio.unwrap();
        assert_eq!((known.success_count, known.trial_count), (2, 4));
        assert!(known.low < 0.5 && known.high > 0.5);
        let unheard = figures.unacknowledged_ratio.unwrap();
        assert_eq!((unheard.success_count, unheard.trial_count), (3, 5));
        assert_eq!(figures.lost_ratio.unwrap().success_count, 4);
    }

    #[test]
    fn without_the_receivers_records_no_message_is_called_lost() {
        let (egress, _) = example();
        let records = ChannelRecords {
            egress: Some(&egress),
            ..ChannelRecords::default()
        };
        let figures = radio_figures(&records).unwrap();
        assert!(figures.is_arrival_unknown);
        assert_eq!(figures.acknowledged_unknown_count, 2);
        assert_eq!(figures.unacknowledged_unknown_count, 3);
        assert_eq!(figures.unreported_unknown_count, 2);
        assert_eq!((figures.lost_ratio, figures.known_loss_ratio), (None, None));
    }

    #[test]
    fn a_wired_channel_has_no_radio_figures() {
        let egress = [sent(0, 0), sent(1, EgressRecord::STAMPED_BEFORE_QUEUE)];
        let records = ChannelRecords {
            egress: Some(&egress),
            ..ChannelRecords::default()
        };
        assert_eq!(radio_figures(&records), None);
        assert_eq!(radio_figures(&ChannelRecords::default()), None);
    }

    #[test]
    fn transmit_stamps_are_counted_by_where_they_were_taken() {
        let mut egress = vec![sent(0, 0), sent(1, EgressRecord::STAMPED_BEFORE_QUEUE)];
        let mut bare = sent(2, 0);
        bare.tx_software_ns = UNAVAILABLE;
        egress.push(bare);
        let expected = TransmitStampFigures {
            handed_count: 3,
            departure_count: 1,
            before_queue_count: 1,
            application_count: 1,
        };
        assert_eq!(transmit_stamps(&egress), expected);
    }
}
