//! The account recovers what synthetic records were written to say.

use core::time::Duration;

use super::synthetic::{
    FORWARDED_NS, Files, HANDED_NS, PERIOD_NS, REALTIME_NS, RX_NS, TAKEN_NS, TX_NS, Written, at,
    same_clock,
};
use super::*;
use hil_core::record::UNAVAILABLE;
use hil_stats::histogram::Distribution;

const MS: i64 = 1_000_000;

fn segment(account: &ChannelAccount, from: Stage, to: Stage) -> &Distribution {
    let mut segments = account.segments.iter();
    let found = segments.find(|segment| segment.from == from && segment.to == to);
    &found
        .unwrap_or_else(|| panic!("no segment {from} to {to}"))
        .distribution
}

fn median(distribution: &Distribution) -> i64 {
    distribution
        .measured()
        .expect("a measured distribution")
        .p50_ns
}

fn assert_near(actual: i64, expected: i64) {
    assert!(
        (actual - expected).abs() * 1000 <= expected.abs(),
        "{actual} is not {expected}"
    );
}

fn only(fate: MessageFate, count: u64) -> FateCounts {
    let mut fates = FateCounts::default();
    fates.add(fate, count);
    fates
}

#[test]
fn a_flawless_run_closes_completely() {
    let files = Files::delivered(1_000);
    let account = account(&files.records(), &same_clock(1_000 * PERIOD_NS));
    assert_eq!(account.fates, only(MessageFate::Taken, 1_000));
    let closing = account.closing.checked().unwrap();
    assert_eq!(
        (closing.checked_count, closing.closed_count),
        (1_000, 1_000)
    );
    assert_eq!(closing.closed_combined_count, 0);
    assert_eq!(closing.residual.measured().unwrap().max_ns, 0);
    assert!(closing.closed_ratio().unwrap() > 0.996);
    assert_eq!(account.segments.len(), 7);
    let wire = segment(&account, Stage::TxSoftware, Stage::RxSoftware);
    assert_near(median(wire), RX_NS - TX_NS);
    assert_near(median(&account.end_to_end.distribution), TAKEN_NS);
    assert_eq!(account.end_to_end.p50_interval, None, "no duration differs");
    let sum: f64 = account
        .segments
        .iter()
        .map(|segment| segment.distribution.measured().unwrap().mean_ns)
        .sum();
    assert!((sum - account.end_to_end.distribution.measured().unwrap().mean_ns).abs() < 1e-6);
    assert_eq!(account.coverage.tx_software.unwrap().ratio(), Some(1.0));
    assert_eq!(account.coverage.rx_hardware.unwrap().ratio(), Some(0.0));
    assert_eq!(account.published_unrecorded_count, Some(0));
    assert_eq!(account.gaps.longest.unwrap().length_ns, 0);
    assert!(account.loss_bursts.is_empty());
}

#[test]
fn a_shift_between_the_paired_offsets_breaks_the_closing() {
    for (shift_ns, closed_count) in [(0, 500), (900, 500), (-900, 500), (5_000, 0), (-5_000, 0)] {
        let mut files = Files::delivered(500);
        for record in &mut files.ingress {
            record.realtime_offset_ns += shift_ns;
        }
        let account = account(&files.records(), &same_clock(500 * PERIOD_NS));
        let closing = account.closing.checked().unwrap();
        assert_eq!(closing.closed_count, closed_count, "shift {shift_ns}");
        let residual = closing.residual.measured().unwrap();
        assert_eq!(residual.max_ns, shift_ns.abs());
        if closed_count == 0 {
            assert_eq!(closing.residual_count, 500);
        }
    }
}

#[test]
fn a_step_of_the_real_time_clock_between_the_stamps_breaks_the_closing() {
    let mut files = Files::delivered(100);
    // The clock steps by 3 ms while message 60 is on the wire.
    for record in &mut files.ingress[60..] {
        record.rx_software_ns += 3 * MS;
        record.realtime_offset_ns += 3 * MS;
    }
    for record in &mut files.egress[61..] {
        record.tx_software_ns += 3 * MS;
        record.realtime_offset_ns += 3 * MS;
    }
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    let closing = account.closing.checked().unwrap();
    assert_eq!((closing.closed_count, closing.residual_count), (99, 1));
    assert_eq!(closing.residual.measured().unwrap().max_ns, 3 * MS);
}

#[test]
fn a_stage_before_its_predecessor_does_not_close() {
    let mut files = Files::delivered(10);
    files.ingress[4].received_ns = files.ingress[4].rx_software_ns - REALTIME_NS - 1_500;
    files.ingress[5].received_ns = files.ingress[5].rx_software_ns - REALTIME_NS - 500;
    let account = account(&files.records(), &same_clock(10 * PERIOD_NS));
    let closing = account.closing.checked().unwrap();
    assert_eq!(
        (closing.closed_count, closing.negative_segment_count),
        (9, 1)
    );
    let segment = segment(&account, Stage::RxSoftware, Stage::Received);
    assert_eq!(segment.measured().unwrap().negative_count, 2);
}

#[test]
fn a_missing_stamp_combines_its_neighbours_for_that_message_only() {
    let mut files = Files::delivered(100);
    for record in &mut files.egress[..30] {
        record.tx_software_ns = UNAVAILABLE;
    }
    files.forget_follow_ups();
    for record in &mut files.ingress[20..40] {
        record.rx_software_ns = UNAVAILABLE;
    }
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    let count = |from, to| segment(&account, from, to).measured().unwrap().count;
    assert_eq!(count(Stage::HandedToKernel, Stage::RxSoftware), 20);
    assert_eq!(count(Stage::HandedToKernel, Stage::Received), 10);
    assert_eq!(count(Stage::TxSoftware, Stage::Received), 10);
    assert_eq!(count(Stage::TxSoftware, Stage::RxSoftware), 60);
    let combined = segment(&account, Stage::HandedToKernel, Stage::RxSoftware);
    assert_near(median(combined), RX_NS - HANDED_NS);
    let closing = account.closing.checked().unwrap();
    assert_eq!(
        (closing.closed_count, closing.closed_combined_count),
        (100, 40)
    );
    assert_eq!(account.coverage.tx_software.unwrap().ratio(), Some(0.7));
    assert_eq!(account.coverage.rx_software.unwrap().ratio(), Some(0.8));
    assert!(
        account.segments[7..]
            .iter()
            .all(|segment| segment.is_combined)
    );
    assert_eq!(account.segments[7].name(), "handed to kernel → RX stamp");
}

#[test]
fn stamps_that_never_came_are_unavailable_with_a_reason() {
    let mut files = Files::delivered(100);
    for record in &mut files.egress {
        record.tx_software_ns = UNAVAILABLE;
    }
    files.forget_follow_ups();
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    let Distribution::Unavailable { reason } =
        segment(&account, Stage::TxSoftware, Stage::RxSoftware)
    else {
        panic!("a wire segment without transmit stamps");
    };
    assert_eq!(reason, "no message has \"TX stamp\"");
}

#[test]
fn a_lost_record_is_a_missing_stage_not_a_lost_message() {
    let mut files = Files::delivered(100);
    files.egress.remove(50);
    files.published.remove(20);
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    assert_eq!(account.fates, only(MessageFate::Taken, 100));
    assert_eq!(account.published_unrecorded_count, Some(1));
    let closing = account.closing.checked().unwrap();
    assert_eq!((closing.closed_count, closing.missing_stage_count), (98, 2));
}

#[test]
fn a_restart_of_the_producer_is_not_a_loss() {
    let mut files = Files::default();
    // The second start has the smaller epoch number: order comes from time.
    for (epoch, start_ns, count) in [(900, 0, 40), (3, 60 * MS, 25), (5, 90 * MS, 10)] {
        for sequence in 0..count {
            let message = at(epoch, sequence);
            let published_ns = start_ns + message.published_ns;
            files.write(
                Written {
                    published_ns,
                    ..message
                },
                MessageFate::Taken,
            );
        }
    }
    let account = account(&files.records(), &same_clock(100 * MS));
    assert_eq!(account.fates, only(MessageFate::Taken, 75));
    assert_eq!(account.producer_restart_count, 2);
    assert_eq!(account.gaps.longest.unwrap().length_ns, 21 * MS);
    assert_eq!(account.closing.checked().unwrap().closed_count, 75);
}

#[test]
fn a_gap_begins_when_a_message_was_due_and_not_while_its_producer_was_idle() {
    let mut files = Files::default();
    for (sequence, at_ms, fate) in [
        (0, 0, MessageFate::Taken),
        (1, 10, MessageFate::Taken),
        (2, 5_000, MessageFate::Taken),
        (3, 9_000, MessageFate::LostOnWire),
        (4, 9_030, MessageFate::Taken),
    ] {
        let written = Written {
            epoch: 1,
            sequence,
            published_ns: at_ms * MS,
        };
        files.write(written, fate);
    }
    let gaps = account(&files.records(), &same_clock(10_000 * MS)).gaps;
    let longest = gaps.longest.unwrap();
    assert_eq!((longest.length_ns, longest.after_sequence), (30 * MS, 2));
    // The time between messages is that of all of them.
    let between = gaps.between_taken.measured().unwrap();
    assert!(between.max_ns > 4_900 * MS, "{between:?}");
}

/// A message every 10 ms but for `pause_ms` after the hundredth, taken at once; the run ends after 6 s.
fn paused(pause_ms: i64, count: u64) -> Gaps {
    let mut files = Files::default();
    for sequence in 0..count {
        let pause_ms = if sequence < 100 { 0 } else { pause_ms };
        let written = Written {
            epoch: 1,
            sequence,
            published_ns: (sequence.cast_signed() * 10 + pause_ms) * MS,
        };
        files.write(written, MessageFate::Taken);
    }
    account(&files.records(), &same_clock(6_000 * MS)).gaps
}

#[test]
fn the_silence_of_a_producer_is_told_apart_from_that_of_the_way() {
    let gaps = paused(2_000, 300);
    assert_eq!(gaps.longest.unwrap().length_ns, 0, "nothing was due");
    let silence = gaps.producer.unwrap();
    assert_near(silence.period_p90_ns, 10 * MS);
    // Message 99 left at 990 ms, message 100 at 1000 ms and the pause.
    let expected = ProducerSilence {
        start_ns: 990 * MS,
        length_ns: 2_010 * MS,
        after_sequence: 99,
        is_open: false,
        period_p90_ns: silence.period_p90_ns,
        period_count: 299,
    };
    assert_eq!(silence, expected);
    assert!(silence.is_long());
}

#[test]
fn a_producer_that_stops_is_silent_until_the_end_of_the_run() {
    let silence = paused(0, 100).producer.unwrap();
    assert_eq!(
        (silence.start_ns, silence.length_ns),
        (990 * MS, 5_010 * MS)
    );
    assert_eq!((silence.after_sequence, silence.is_open), (99, true));
    assert!(silence.is_long());
    let to_the_end = paused(0, 600).producer.unwrap();
    assert_eq!(to_the_end.length_ns, 10 * MS);
    assert!(!to_the_end.is_long());
}

#[test]
fn of_a_producer_whose_records_are_missing_no_silence_is_told() {
    let mut files = Files::delivered(100);
    files.published.drain(50..60);
    let gaps = account(&files.records(), &same_clock(100 * PERIOD_NS)).gaps;
    let silence = gaps.producer.unwrap();
    assert_eq!((silence.length_ns, silence.period_count), (PERIOD_NS, 88));
    let records = ChannelRecords {
        published: None,
        ..files.records()
    };
    let gaps = account(&records, &same_clock(100 * PERIOD_NS)).gaps;
    assert_eq!(gaps.producer, None);
}

#[test]
fn duplicates_and_reordering_are_counted_beside_the_fates() {
    let mut files = Files::delivered(100);
    let mut copy = files.ingress[30];
    copy.flags = IngressRecord::DUPLICATE;
    copy.forwarded_ns = UNAVAILABLE;
    // One copy is written before its original, one long after.
    files.ingress.insert(30, copy);
    files.ingress.push(copy);
    files.ingress.swap(70, 71);
    files.ingress[71].flags = IngressRecord::REORDERED;
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    assert_eq!(account.fates, only(MessageFate::Taken, 100));
    assert_eq!(account.duplicated_count, Some(2));
    assert_eq!(account.reordered_count, Some(1));
    assert_eq!(account.late_count, Some(0));
    assert_eq!(account.closing.checked().unwrap().closed_count, 100);
}

#[test]
fn a_message_in_pieces_is_judged_by_its_sender_and_the_end_of_the_run_first() {
    let mut files = Files::delivered(100);
    for sequence in [100, 101, 149, 150, 199] {
        files.write(at(7, sequence), MessageFate::Incomplete);
    }
    // The sender stopped in the middle of two of them, one of them near the end.
    for record in &mut files.egress {
        if [101, 199].contains(&record.sequence) {
            record.flags = EgressRecord::REFUSED_BY_KERNEL;
        }
    }
    // What was handed over at 150 ms or later may still travel.
    let account = account(&files.records(), &same_clock(200 * PERIOD_NS));
    assert_eq!(account.fates.of(MessageFate::RefusedByKernel), 2);
    assert_eq!(account.fates.of(MessageFate::InFlight), 1);
    assert_eq!(account.fates.of(MessageFate::Incomplete), 2);
    assert_eq!(account.fates.of(MessageFate::Taken), 100);
}

#[test]
fn a_message_in_pieces_without_the_senders_records_is_incomplete_or_in_flight() {
    let mut files = Files::delivered(10);
    files.write(at(7, 10), MessageFate::Incomplete);
    files.write(at(7, 99), MessageFate::Incomplete);
    let records = ChannelRecords {
        published: None,
        egress: None,
        ..files.records()
    };
    let account = account(&records, &same_clock(100 * PERIOD_NS));
    assert_eq!(account.fates.of(MessageFate::Incomplete), 1);
    assert_eq!(account.fates.of(MessageFate::InFlight), 1);
}

#[test]
fn without_the_peers_files_what_cannot_be_known_is_unknown() {
    let mut files = Files::default();
    for sequence in 0..100 {
        let fate = match sequence {
            10..13 => MessageFate::LostOnWire,
            20 => MessageFate::RefusedByKernel,
            30 => MessageFate::SupersededAtInput,
            40 => MessageFate::SupersededAtConsumer,
            _ => MessageFate::Taken,
        };
        files.write(at(1, sequence), fate);
    }
    let context = AccountContext {
        producer_run: None,
        ..AccountContext::new(ChannelPath::Gateway { alignment: None })
    };
    let consumer = ChannelRecords {
        published: None,
        egress: None,
        ..files.records()
    };
    let received = account(&consumer, &context);
    assert_eq!(received.published_count, 100);
    assert_eq!(received.fates.of(MessageFate::Taken), 94);
    assert_eq!(received.fates.of(MessageFate::SupersededAtConsumer), 1);
    assert_eq!(
        received
            .fates
            .of(MessageFate::UnknownPeerRecordsUnavailable),
        5
    );
    assert_eq!(received.published_unrecorded_count, None);
    // The sender's follow-ups still give its own segment.
    assert_near(
        median(segment(&received, Stage::HandedToKernel, Stage::TxSoftware)),
        TX_NS - HANDED_NS,
    );

    let producer = ChannelRecords {
        ingress: None,
        taken: None,
        ..files.records()
    };
    let sent = account(&producer, &context);
    assert_eq!(sent.fates.of(MessageFate::RefusedByKernel), 1);
    assert_eq!(sent.fates.of(MessageFate::SupersededAtInput), 1);
    assert_eq!(
        sent.fates.of(MessageFate::UnknownPeerRecordsUnavailable),
        98
    );
    assert_eq!(sent.reordered_count, None);
    assert!(
        segment(&sent, Stage::Published, Stage::TakenByGateway)
            .measured()
            .is_some()
    );
}

#[test]
fn unaligned_clocks_give_same_clock_segments_and_the_round_trip_only() {
    let mut files = Files::delivered(200);
    // The consumer's host booted 1000 s earlier.
    let shift_ns = 1_000_000 * MS;
    for record in &mut files.ingress {
        record.received_ns += shift_ns;
        record.forwarded_ns += shift_ns;
        record.realtime_offset_ns -= shift_ns;
    }
    for record in &mut files.taken {
        record.taken_ns += shift_ns;
        record.forwarded_ns += shift_ns;
    }
    let round_trips_ns = [21_000, 22_000, 23_000];
    let mut context = AccountContext {
        round_trips_ns: &round_trips_ns,
        ..AccountContext::new(ChannelPath::Gateway { alignment: None })
    };
    let unaligned = account(&files.records(), &context);
    assert_eq!(unaligned.fates, only(MessageFate::Taken, 200));
    let reason = Distribution::unavailable("clocks not aligned");
    assert_eq!(
        *segment(&unaligned, Stage::TxSoftware, Stage::RxSoftware),
        reason
    );
    assert_eq!(unaligned.end_to_end.distribution, reason);
    assert_eq!(unaligned.end_to_end.p50_interval, None);
    assert!(unaligned.closing.checked().is_none());
    assert_near(median(&unaligned.round_trip), 22_000);
    let last = segment(&unaligned, Stage::Forwarded, Stage::Taken);
    assert_near(median(last), TAKEN_NS - FORWARDED_NS);

    // With an alignment the whole chain is back, and says how far it may be off.
    let alignment = Alignment {
        offset_ns: shift_ns + 300,
        bound_ns: 2_000,
    };
    context.path = ChannelPath::Gateway {
        alignment: Some(alignment),
    };
    let aligned = account(&files.records(), &context);
    assert_near(
        median(segment(&aligned, Stage::TxSoftware, Stage::RxSoftware)),
        RX_NS - TX_NS - 300,
    );
    assert_eq!(aligned.end_to_end.alignment_bound_ns(), Some(2_000));
    assert_eq!(aligned.closing.checked().unwrap().closed_count, 200);
}

#[test]
fn stamps_are_counted_by_where_they_were_taken() {
    let mut files = Files::delivered(100);
    for (sent, arrived) in files.egress.iter_mut().zip(&mut files.ingress) {
        sent.tx_hardware_ns = sent.tx_software_ns + 37_000_000_400;
        arrived.rx_hardware_ns = sent.tx_hardware_ns + 650;
    }
    files.egress[1].flags |= EgressRecord::STAMPED_BEFORE_QUEUE;
    files.egress[2].tx_software_ns = UNAVAILABLE;
    files.egress[3].flags |= EgressRecord::STAMPED_BEFORE_QUEUE;
    files.egress[3].tx_software_ns = UNAVAILABLE;
    let account = account(&files.records(), &same_clock(100 * PERIOD_NS));
    let coverage = account.coverage;
    assert_eq!(coverage.tx_hardware.unwrap().ratio(), Some(1.0));
    assert_eq!(coverage.tx_software.unwrap().stamped_count, 98);
    assert_eq!(coverage.tx_before_queue_count, 1);
}

#[test]
fn a_direct_channel_has_one_segment() {
    let mut files = Files::delivered(100);
    // A stray gateway stamp on half of them must not cut the only segment.
    for record in &mut files.taken[..50] {
        record.forwarded_ns = UNAVAILABLE;
    }
    files.taken.retain(|record| record.sequence % 10 != 4);
    files.taken.retain(|record| record.sequence < 98);
    let records = ChannelRecords {
        egress: None,
        ingress: None,
        ..files.records()
    };
    let run = RunSpan {
        start: Instant::ZERO,
        end: Instant::from_ns(100 * PERIOD_NS),
    };
    let context = AccountContext {
        consumer_run: Some(run),
        flight_time_max: Duration::from_millis(5),
        ..AccountContext::new(ChannelPath::SharedMemory)
    };
    let account = account(&records, &context);
    assert_eq!(account.fates.of(MessageFate::SupersededAtConsumer), 10);
    assert_eq!(account.fates.of(MessageFate::InFlight), 2);
    assert_eq!(account.fates.of(MessageFate::Taken), 88);
    assert_eq!(account.segments.len(), 1);
    assert_near(
        median(segment(&account, Stage::Published, Stage::Taken)),
        TAKEN_NS,
    );
    assert_eq!(account.closing.checked().unwrap().closed_count, 88);
    assert_eq!(account.coverage, StampCoverage::default());
}

#[test]
fn nothing_at_all_is_nothing_not_zero() {
    for path in [
        ChannelPath::SharedMemory,
        ChannelPath::Gateway { alignment: None },
        ChannelPath::Gateway {
            alignment: Some(Alignment::SAME_CLOCK),
        },
    ] {
        let context = AccountContext::new(path);
        for records in [ChannelRecords::default(), Files::default().records()] {
            let account = account(&records, &context);
            assert_eq!(account.published_count, 0);
            assert!(account.end_to_end.distribution.measured().is_none());
            assert!(
                account
                    .segments
                    .iter()
                    .all(|s| s.distribution.measured().is_none())
            );
            assert_eq!(account.gaps.longest, None);
        }
    }
}
