//! From the records of a run to what the cards' stamps say: per card its clock against the host's,
//! per channel the segments that end or begin in a card, each with its bound. It opens no card.

use hil_account::nic_clock::{Bounded, NicClockMetrics, NicTimeline};
use hil_account::{AccountContext, ChannelPath, ChannelRecords, each_history};
use hil_core::record::{EgressRecord, IngressRecord, stamp};
use hil_core::time::RemoteInstant;
use hil_stats::histogram::{Distribution, LatencyHistogram};
use serde::{Deserialize, Serialize};

use hil_rundir::nic_history::NicHistory;

/// Everything the cards of a run say.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HardwareStamps {
    /// The cards, by host.
    pub cards: Vec<NicSummary>,
    /// The channels that passed them.
    pub channels: Vec<ChannelStamps>,
}

/// One card.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NicSummary {
    /// What became of it.
    pub story: NicHistory,
    /// Its clock against the host's; `None` when it was not read.
    pub clock: Option<NicClockMetrics>,
}

/// The hardware stamps of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelStamps {
    /// Its name.
    pub channel: String,
    /// Messages the kernel took.
    pub sent_count: u64,
    /// Of those, with a stamp of the sending card, matched to the message.
    pub tx_hardware_count: u64,
    /// Of those, with the kernel's own stamp beside it.
    pub tx_both_count: u64,
    /// Messages that arrived, each once however many copies of it came.
    pub received_count: u64,
    /// Of those, with a stamp of the receiving card.
    pub rx_hardware_count: u64,
    /// Why arrivals have no stamp of a card; empty when they do.
    pub rx_reason: String,
    /// The segments, in the order of the message's way.
    pub segments: Vec<NicSegment>,
}

/// Time between two stages of which one at least is a card's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NicSegment {
    /// Its two ends, in words.
    pub name: String,
    /// How long it took.
    pub distribution: Distribution,
    /// How wrong each of these times may be.
    pub bound: Distribution,
    /// Stamps whose place on the host's clock is unknown: taken far from every pair of clock
    /// reads, or beside a step.
    pub unplaced_count: u64,
}

/// What is needed to place the stamps of a channel.
#[derive(Debug)]
pub(crate) struct Places<'a> {
    /// Clock of the sending card; `None` when it was not read.
    pub(crate) sender: Option<&'a NicTimeline>,
    /// Clock of the receiving card.
    pub(crate) receiver: Option<&'a NicTimeline>,
    /// The receiving card, if there is one.
    pub(crate) receiving_nic: Option<&'a NicHistory>,
    /// Both cards take their stamps from one hardware clock.
    pub(crate) has_one_clock: bool,
}

#[derive(Default)]
struct SegmentTimes {
    times: LatencyHistogram,
    bounds: LatencyHistogram,
    unplaced_count: u64,
}

impl SegmentTimes {
    fn note(&mut self, time: Option<Bounded>) {
        match time {
            Some(time) => {
                self.times.record(time.value_ns);
                self.bounds
                    .record(i64::try_from(time.bound_ns).unwrap_or(i64::MAX));
            }
            None => self.unplaced_count += 1,
        }
    }

    fn segment(self, name: &str, reason: &str) -> NicSegment {
        NicSegment {
            name: name.to_owned(),
            distribution: self.times.distribution(reason),
            bound: self.bounds.distribution(reason),
            unplaced_count: self.unplaced_count,
        }
    }
}

/// `later` minus `earlier`, where both are on one clock.
fn between(later: Bounded, earlier: Bounded) -> Bounded {
    Bounded {
        value_ns: later.value_ns.saturating_sub(earlier.value_ns),
        bound_ns: later.bound_ns.saturating_add(earlier.bound_ns),
    }
}

const fn exact(value_ns: i64) -> Bounded {
    Bounded {
        value_ns,
        bound_ns: 0,
    }
}

/// The hardware stamps of `channel`. Of copies of a message the one that was forwarded counts, and a message
/// of which only pieces came did not arrive.
pub(crate) fn channel_stamps(
    channel: &str,
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    places: &Places<'_>,
) -> ChannelStamps {
    let mut found = StampFold::default();
    each_history(records, context, |message| {
        let left = message
            .egress
            .and_then(|record| found.departure(&record, places));
        if let Some(record) = message.arrived() {
            found.arrival(&record, left, context.path, places);
        }
    });
    let no_tx = match places.sender {
        Some(_) => "no message has a stamp of the sending card",
        None => "the sending card's clock was not read",
    };
    let no_rx = "no message has a stamp of the receiving card";
    ChannelStamps {
        channel: channel.to_owned(),
        sent_count: found.sent_count,
        tx_hardware_count: found.tx_hardware_count,
        tx_both_count: found.tx_both_count,
        received_count: found.received_count,
        rx_hardware_count: found.rx_hardware_count,
        rx_reason: if found.rx_hardware_count == 0 {
            rx_reason(places.receiving_nic)
        } else {
            String::new()
        },
        segments: vec![
            found
                .handed
                .segment("handed to the kernel → card sends", no_tx),
            found
                .software
                .segment("TX stamp (software) → card sends", no_tx),
            found.wire.segment("card sends → card receives", no_rx),
            found
                .stack
                .segment("card receives → RX stamp (software)", no_rx),
        ],
    }
}

/// Collects the stamps of a channel's messages.
#[derive(Default)]
struct StampFold {
    sent_count: u64,
    tx_hardware_count: u64,
    tx_both_count: u64,
    received_count: u64,
    rx_hardware_count: u64,
    handed: SegmentTimes,
    software: SegmentTimes,
    wire: SegmentTimes,
    stack: SegmentTimes,
}

/// A stamp of the sending card.
#[derive(Clone, Copy)]
struct Departure {
    nic_ns: i64,
    /// On the host's monotonic clock; `None` where the clock of the card does not say.
    monotonic: Option<Bounded>,
}

impl StampFold {
    /// Counts what left; gives its stamp.
    fn departure(&mut self, record: &EgressRecord, places: &Places<'_>) -> Option<Departure> {
        if record.is_refused() {
            return None;
        }
        self.sent_count += 1;
        let nic_ns = stamp(record.tx_hardware_ns)?;
        self.tx_hardware_count += 1;
        let left = places.sender.and_then(|clock| clock.to_realtime(nic_ns));
        let monotonic = left.map(|left| Bounded {
            value_ns: left.value_ns.saturating_sub(record.realtime_offset_ns),
            ..left
        });
        let handed = exact(record.handed_ns);
        self.handed
            .note(monotonic.map(|left| between(left, handed)));
        if let Some(software_ns) = stamp(record.tx_software_ns) {
            self.tx_both_count += 1;
            let software = exact(software_ns);
            self.software.note(left.map(|left| between(left, software)));
        }
        Some(Departure { nic_ns, monotonic })
    }

    fn arrival(
        &mut self,
        record: &IngressRecord,
        left: Option<Departure>,
        path: ChannelPath<'_>,
        places: &Places<'_>,
    ) {
        self.received_count += 1;
        let Some(nic_ns) = stamp(record.rx_hardware_ns) else {
            return;
        };
        self.rx_hardware_count += 1;
        let came = places.receiver.and_then(|clock| clock.to_realtime(nic_ns));
        if let Some(software_ns) = stamp(record.rx_software_ns) {
            let software = exact(software_ns);
            self.stack.note(came.map(|came| between(software, came)));
        }
        if let Some(left) = left {
            self.wire.note(if places.has_one_clock {
                Some(exact(nic_ns.saturating_sub(left.nic_ns)))
            } else {
                crossing(left.monotonic, came, record, path)
            });
        }
    }
}

fn rx_reason(card: Option<&NicHistory>) -> String {
    match card {
        None => "the receiving host has no card for this run".to_owned(),
        Some(card) if !card.is_armed => "the receiving card is not armed".to_owned(),
        Some(card) if !card.stamps_all_arrivals => {
            "not offered: the receiving card does not stamp all arrivals".to_owned()
        }
        Some(_) => "granted by the receiving card, but none came".to_owned(),
    }
}

/// From one card to the other on the receiving host's clock.
fn crossing(
    left: Option<Bounded>,
    came: Option<Bounded>,
    record: &IngressRecord,
    path: ChannelPath<'_>,
) -> Option<Bounded> {
    let (left, came) = (left?, came?);
    let (local, alignment_bound_ns) = path.localise(RemoteInstant::from_ns(left.value_ns))?;
    let came = Bounded {
        value_ns: came.value_ns.saturating_sub(record.realtime_offset_ns),
        ..came
    };
    let left = Bounded {
        value_ns: local.as_ns(),
        bound_ns: left.bound_ns.saturating_add(alignment_bound_ns),
    };
    Some(between(came, left))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::RecordSource;
    use hil_account::nic_clock::NicClockRecord;
    use hil_core::record::UNAVAILABLE;
    use hil_core::time::Alignment;

    const EPOCH_NS: i64 = 1_700_000_000_000_000_000;
    const TAI_NS: i64 = 37_000_000_000;

    fn timeline(offset_ns: i64) -> NicTimeline {
        let records: Vec<NicClockRecord> = (0..20)
            .map(|index| NicClockRecord {
                realtime_ns: EPOCH_NS + index * 100_000_000,
                nic_offset_ns: offset_ns,
                realtime_offset_ns: EPOCH_NS,
                bound_ns: 400,
            })
            .collect();
        NicTimeline::new(&records)
    }

    fn sent(sequence: u64, handed_ns: i64) -> EgressRecord {
        EgressRecord {
            sequence,
            published_ns: handed_ns - 2_000,
            taken_ns: handed_ns - 1_000,
            handed_ns,
            tx_software_ns: EPOCH_NS + handed_ns + 3_000,
            tx_hardware_ns: EPOCH_NS + handed_ns + 5_000 + TAI_NS,
            realtime_offset_ns: EPOCH_NS,
            epoch: 1,
            session: 1,
            flags: 0,
            fragment_count: 1,
        }
    }

    /// As it came to a host whose monotonic clock is 7 s ahead and whose card is 1 s behind.
    fn came(sent: &EgressRecord) -> IngressRecord {
        let realtime_ns = EPOCH_NS + sent.handed_ns + 5_000 + 650;
        IngressRecord {
            sequence: sent.sequence,
            published_ns: sent.published_ns,
            handed_ns: sent.handed_ns,
            rx_hardware_ns: realtime_ns - 1_000_000_000,
            rx_software_ns: realtime_ns + 4_000,
            received_ns: 0,
            forwarded_ns: 0,
            realtime_offset_ns: EPOCH_NS - 7_000_000_000,
            emulated_ns: UNAVAILABLE,
            due_ns: UNAVAILABLE,
            follow_up_sequence: 0,
            follow_up_ns: UNAVAILABLE,
            epoch: 1,
            session: 1,
            flags: 0,
            fragment_count: 1,
        }
    }

    fn figures_of(rx: bool) -> ChannelStamps {
        figures_with(rx, &[])
    }

    /// With one more record for each of `copies`: its sequence number, and its flags.
    fn figures_with(rx: bool, copies: &[(u64, u32)]) -> ChannelStamps {
        let egress: Vec<EgressRecord> = (0..100)
            .map(|index| {
                sent(
                    index,
                    500_000_000 + i64::try_from(index).unwrap() * 10_000_000,
                )
            })
            .collect();
        let mut ingress: Vec<IngressRecord> = egress.iter().map(came).collect();
        for (sequence, flags) in copies {
            let original = egress.iter().find(|one| one.sequence == *sequence);
            let mut copy = came(original.unwrap());
            copy.rx_hardware_ns += 30_000_000;
            copy.rx_software_ns += 30_000_000;
            copy.flags = *flags;
            ingress.push(copy);
        }
        if !rx {
            for one in &mut ingress {
                one.rx_hardware_ns = UNAVAILABLE;
            }
        }
        let (ours, theirs) = (timeline(TAI_NS), timeline(-1_000_000_000));
        let alignment = Alignment {
            offset_ns: 7_000_000_000,
            bound_ns: 20_000,
        };
        let story = NicHistory {
            host: "robot-pc".to_owned(),
            interface: "eth0".to_owned(),
            phc_index: Some(0),
            claims: String::new(),
            arming: String::new(),
            is_armed: true,
            stamps_all_arrivals: rx,
            restoring: String::new(),
            clock: String::new(),
            failed_read_count: 0,
        };
        let places = Places {
            sender: Some(&ours),
            receiver: Some(&theirs),
            receiving_nic: Some(&story),
            has_one_clock: false,
        };
        stamps_of(&egress, &ingress, Some(alignment), &places)
    }

    fn stamps_of(
        egress: &dyn RecordSource<EgressRecord>,
        ingress: &dyn RecordSource<IngressRecord>,
        alignment: Option<Alignment>,
        places: &Places<'_>,
    ) -> ChannelStamps {
        let records = ChannelRecords {
            egress: Some(egress),
            ingress: Some(ingress),
            ..ChannelRecords::default()
        };
        let context = AccountContext::new(ChannelPath::Gateway { alignment });
        channel_stamps("arm/command", &records, &context, places)
    }

    fn median(segment: &NicSegment) -> (i64, i64) {
        let time = segment.distribution.measured().unwrap();
        let bound = segment.bound.measured().unwrap();
        (time.p50_ns, bound.p50_ns)
    }

    #[test]
    fn two_cards_with_clocks_of_their_own_give_all_four_segments_with_their_bounds() {
        let figures = figures_of(true);
        assert_eq!((figures.sent_count, figures.tx_hardware_count), (100, 100));
        assert_eq!(
            (figures.tx_both_count, figures.rx_hardware_count),
            (100, 100)
        );
        let expected = [(5_000, 400), (2_000, 400), (650, 20_800), (4_000, 400)];
        for (segment, (time_ns, bound_ns)) in figures.segments.iter().zip(expected) {
            let (time, bound) = median(segment);
            assert!((time - time_ns).abs() <= 10, "{segment:?}");
            // Up to 100 ns of wander come on top.
            assert!((bound_ns..bound_ns + 130).contains(&bound), "{segment:?}");
        }
    }

    #[test]
    fn cards_of_one_clock_need_no_other() {
        let egress = [sent(0, 500_000_000), sent(1, 510_000_000)];
        let mut ingress = egress.each_ref().map(came);
        for (sent, came) in egress.iter().zip(&mut ingress) {
            came.rx_hardware_ns = sent.tx_hardware_ns + 650;
        }
        let places = |has_one_clock| Places {
            sender: None,
            receiver: None,
            receiving_nic: None,
            has_one_clock,
        };
        let one = stamps_of(&egress, &ingress, None, &places(true));
        assert_eq!(median(&one.segments[2]), (650, 0));
        let two = stamps_of(&egress, &ingress, None, &places(false));
        assert_eq!(two.segments[2].unplaced_count, 2);
    }

    #[test]
    fn copies_of_a_message_are_neither_counted_nor_measured() {
        let copies = [
            (3, IngressRecord::DUPLICATE),
            (3, IngressRecord::DUPLICATE),
            (9, IngressRecord::LATE),
        ];
        let figures = figures_with(true, &copies);
        assert_eq!(
            (figures.received_count, figures.rx_hardware_count),
            (100, 100)
        );
        assert_eq!(figures, figures_of(true), "the first copy is the message");
    }

    #[test]
    fn pieces_of_a_message_are_not_counted_as_received() {
        let egress = [sent(0, 500_000_000), sent(1, 510_000_000)];
        let mut ingress = egress.each_ref().map(came);
        ingress[1].flags = IngressRecord::INCOMPLETE;
        ingress[1].rx_hardware_ns = UNAVAILABLE;
        let places = Places {
            sender: None,
            receiver: None,
            receiving_nic: None,
            has_one_clock: false,
        };
        let figures = stamps_of(&egress, &ingress, None, &places);
        assert_eq!((figures.received_count, figures.rx_hardware_count), (1, 1));
    }

    #[test]
    fn a_nic_that_stamps_no_arrivals_is_said_not_to_offer_it() {
        let figures = figures_of(false);
        assert_eq!(figures.rx_hardware_count, 0);
        assert!(
            figures.rx_reason.contains("not offered"),
            "{}",
            figures.rx_reason
        );
        assert_eq!(median(&figures.segments[1]).0, 2_000);
        for segment in &figures.segments[2..] {
            assert!(segment.distribution.measured().is_none(), "{segment:?}");
        }
    }

    #[test]
    fn stamps_of_a_clock_that_was_not_read_are_counted_and_not_placed() {
        let places = Places {
            sender: None,
            receiver: None,
            receiving_nic: None,
            has_one_clock: false,
        };
        let figures = stamps_of(&[sent(0, 5)], &Vec::new(), None, &places);
        assert_eq!(figures.tx_hardware_count, 1);
        assert_eq!(figures.segments[0].unplaced_count, 1);
        assert!(figures.segments[0].distribution.measured().is_none());
        assert!(
            figures.rx_reason.contains("no card"),
            "{}",
            figures.rx_reason
        );
    }
}
