//! Figures, events and bins of passages whose answers are known.

use super::*;
use crate::BurstCount;
use hil_core::random::RandomStream;

const PERIOD_NS: i64 = 10_000_000;
const DELAY_NS: i64 = 2_000_000;

/// Message `sequence` of a channel that sends every 10 ms.
pub(super) fn arrived(sequence: u64, delay_ns: i64) -> Passage {
    let offered_ns = i64::try_from(sequence).unwrap() * PERIOD_NS;
    Passage {
        epoch_rank: 0,
        sequence,
        count: 1,
        offered_ns: Some(offered_ns),
        received_ns: Some(offered_ns + delay_ns),
        delay_ns: Some(delay_ns),
        delay_bound_ns: 0,
        crossing: Crossing::Arrived,
    }
}

fn lost(sequence: u64) -> Passage {
    Passage {
        received_ns: None,
        delay_ns: None,
        crossing: Crossing::LostByNetwork,
        ..arrived(sequence, 0)
    }
}

pub(super) fn passages(count: u64, is_lost: impl Fn(u64) -> bool) -> Vec<Passage> {
    let one = |sequence| {
        if is_lost(sequence) {
            lost(sequence)
        } else {
            arrived(sequence, DELAY_NS)
        }
    };
    (0..count).map(one).collect()
}

fn packed(passages: &[Passage]) -> Passages {
    passages.iter().copied().collect()
}

fn metrics(passages: &[Passage]) -> NetworkMetrics {
    figures_on(ChannelPath::SharedMemory, passages)
}

pub(super) fn figures_on(path: ChannelPath<'_>, passages: &[Passage]) -> NetworkMetrics {
    let context = NetworkContext {
        path,
        run_ns: Some((0, i64::try_from(passages.len()).unwrap() * PERIOD_NS)),
        payload_bytes: Some(64.0),
    };
    NetworkMetrics::of(&packed(passages), &context)
}

#[test]
fn delays_and_their_variation_are_those_that_were_put_in() {
    // 1 ms to 10 ms in steps of 1 µs, in an order that mixes them.
    let delay = |sequence: u64| 1_000_000 + 1_000 * i64::try_from(sequence * 7 % 9_001).unwrap();
    let all: Vec<_> = (0..9_001).map(|one| arrived(one, delay(one))).collect();
    let found = metrics(&all);
    let delays = found.delay.measured().unwrap();
    assert_eq!((delays.min_ns, delays.max_ns), (1_000_000, 10_000_000));
    assert_eq!(delays.p50.value_ns, 5_500_000);
    assert_eq!(delays.p95.value_ns, 9_550_000);
    assert_eq!(delays.p99.value_ns, 9_910_000);
    assert_eq!(delays.variation.p99_ns, 8_910_000);
    assert_eq!(delays.variation.max_ns, 9_000_000);
    assert!(delays.p50.interval.is_some());
    // Successive delays differ by 7 µs, or by the way back of 8994 µs.
    let successive = found.successive.measured().unwrap();
    assert_eq!((successive.count, successive.p50_ns), (9_000, 7_000));
    assert_eq!(successive.max_ns, 8_994_000);
    assert!((found.offered_per_s.unwrap() - 100.0).abs() < 1e-9);
    // All of them came: whether a little apart or close together is a matter of their delays.
    assert!((found.arrived_per_s.unwrap() - 100.0).abs() < 1e-9);
    assert!((found.arrived_bytes_per_s.unwrap() - 6_400.0).abs() < 1e-6);
}

#[test]
fn what_arrived_is_counted_over_the_time_in_which_messages_were_handed_over() {
    // 100 per second for 10 s; only the first 101 get through.
    let found = metrics(&passages(1_000, |one| one >= 101));
    assert!((found.offered_per_s.unwrap() - 100.0).abs() < 1e-9);
    assert!((found.arrived_per_s.unwrap() - 10.1).abs() < 1e-9);
    assert!((found.arrived_bytes_per_s.unwrap() - 64.0 * 10.1).abs() < 1e-9);
    // 1400 at 100 per second, of which the last 302 are lost: 78.43 per second.
    let cut = metrics(&passages(1_400, |one| one >= 1_098));
    assert!((cut.arrived_per_s.unwrap() - 78.428_571_428).abs() < 1e-6);
    let alone = metrics(&passages(1_000, |one| one > 0));
    assert!((alone.arrived_per_s.unwrap() - 0.1).abs() < 1e-9);
    let none = metrics(&passages(1_000, |_| true));
    assert_eq!(none.arrived_per_s, Some(0.0));
    let single = metrics(&passages(1, |_| false));
    assert_eq!((single.offered_per_s, single.arrived_per_s), (None, None));
}

#[test]
fn jitter_approaches_the_difference_that_every_message_has() {
    let delay = |sequence: u64| {
        DELAY_NS
            + if sequence.is_multiple_of(2) {
                0
            } else {
                160_000
            }
    };
    let all: Vec<_> = (0..2_000).map(|one| arrived(one, delay(one))).collect();
    let jitter = metrics(&all).successive.measured().unwrap().jitter;
    assert!((jitter.max_ns - 160_000.0).abs() < 1.0, "{jitter:?}");
    assert!(jitter.mean_ns > 158_000.0 && jitter.mean_ns < 160_000.0);
}

#[test]
fn a_bound_wider_than_the_delay_is_called_so_and_unaligned_clocks_leave_differences() {
    let mut all = passages(200, |_| false);
    for one in &mut all {
        one.delay_bound_ns = 3_000_000;
    }
    let found = metrics(&all);
    let delays = found.delay.measured().unwrap();
    assert!(delays.is_bound_wider && delays.alignment_bound_ns == 3_000_000);
    for one in &mut all {
        one.delay_ns = None;
    }
    let found = metrics(&all);
    assert_eq!(found.delay, Metric::unavailable("clocks not aligned"));
    assert_eq!(found.successive.measured().unwrap().max_ns, 0);
}

#[test]
fn losses_runs_bursts_and_gaps_are_counted_as_rfc_3611_has_them() {
    // Lost: 100; 300 to 304 and 310 (one burst of 11); 600 to 619.
    let is_lost = |one: u64| {
        one == 100 || (300..305).contains(&one) || one == 310 || (600..620).contains(&one)
    };
    let mut all = passages(1_000, is_lost);
    // What the host lost is in none of the figures, and interrupts nothing.
    all[302].crossing = Crossing::LostByHost;
    let found = metrics(&all);
    assert_eq!((found.host_lost_count, found.offered_count), (1, 999));
    let loss = found.loss.measured().unwrap();
    assert_eq!((found.lost_count, found.offered_count), (26, 999));
    let runs: Vec<_> = loss
        .runs
        .iter()
        .map(|run| (run.length_messages, run.count))
        .collect();
    assert_eq!(runs, [(1, 2), (4, 1), (20, 1)]);
    let bursts = loss.bursts.unwrap();
    assert_eq!(bursts.count, 2);
    assert!((bursts.length_mean - 15.0).abs() < 1e-9);
    assert!((bursts.loss_ratio - 25.0 / 30.0).abs() < 1e-9);
    assert!((bursts.gap_loss_ratio - 1.0 / 969.0).abs() < 1e-9);
    let longest = loss.longest.unwrap();
    assert_eq!(
        (longest.start_ns, longest.length_ns),
        (600 * PERIOD_NS, 20 * PERIOD_NS)
    );
    assert_eq!((longest.lost_count, longest.is_open), (20, false));
    let kinds: Vec<_> = network_events(&packed(&all))
        .into_iter()
        .map(|one| one.kind)
        .collect();
    assert_eq!(
        kinds,
        [
            NetworkEventKind::LossBurst {
                lost_count: 5,
                of_count: 10
            },
            outage(20)
        ]
    );
}

#[test]
fn an_outage_that_lasts_to_the_end_is_open() {
    let all = passages(500, |one| one >= 450);
    let loss = metrics(&all).loss;
    let longest = loss.measured().unwrap().longest.unwrap();
    assert!(longest.is_open && longest.length_ns == 50 * PERIOD_NS);
    let events = network_events(&packed(&all));
    assert_eq!(events[0].until_ns, None);
    assert_eq!(events[0].kind, outage(50));
    assert_eq!(
        loss.measured().unwrap().runs,
        [BurstCount {
            length_messages: 50,
            count: 1
        }]
    );
}

#[test]
fn a_single_loss_of_a_slow_channel_is_no_event_and_two_in_a_row_are() {
    let slowed = |mut all: Vec<Passage>| {
        for one in &mut all {
            // Every 500 ms.
            one.offered_ns = one.offered_ns.map(|ns| ns * 50);
        }
        all
    };
    let single = slowed(passages(200, |one| one % 50 == 20));
    assert_eq!(network_events(&packed(&single)), []);
    let pair = network_events(&packed(&slowed(passages(200, |one| {
        one == 20 || one == 21
    }))));
    assert_eq!(pair.len(), 1);
    assert_eq!(pair[0].kind, outage(2));
    let length_ns = pair[0].until_ns.unwrap() - pair[0].from.ns;
    assert_eq!(length_ns, 1_000_000_000);
}

/// Gilbert's chain: lost while bad, with 20 messages a bad spell.
fn chain(count: u64, random: &mut RandomStream) -> Vec<Passage> {
    let mut is_bad = false;
    (0..count)
        .map(|sequence| {
            is_bad = random.chance(if is_bad { 0.95 } else { 0.002_375 });
            if is_bad {
                lost(sequence)
            } else {
                arrived(sequence, DELAY_NS)
            }
        })
        .collect()
}

#[test]
fn bursts_widen_the_interval_of_the_loss_and_too_few_have_none() {
    // Into bad 0.002375, out of it 0.05: bad for 4.5346 % of the time.
    let all = chain(60_000, &mut RandomStream::new(1, "chain"));
    let loss = metrics(&all).loss;
    let interval = loss.measured().unwrap().interval.known().unwrap();
    assert!(interval.holds(0.002_375 / (0.002_375 + 0.05)));
    // Independent losses would have it 0.0034 wide.
    assert!(interval.high - interval.low > 0.01, "{interval:?}");
    for is_lost in [|_| false, |one| one == 100, |one| (400..500).contains(&one)] {
        let loss = metrics(&passages(6_000, is_lost)).loss;
        assert_eq!(loss.measured().unwrap().interval.known(), None);
    }
}

#[test]
fn reordering_has_the_ratio_and_extent_of_rfc_4737() {
    // RFC 4737's example of section 4.2.3: 1, 2, 3, 7, 8, 9, 10, 4, 5, 6, 11.
    let order = [1_u64, 2, 3, 7, 8, 9, 10, 4, 5, 6, 11];
    let mut all: Vec<Passage> = (0_i64..)
        .zip(order)
        .map(|(place, sequence)| Passage {
            received_ns: Some(1_000_000_000 + place * PERIOD_NS),
            ..arrived(sequence, DELAY_NS)
        })
        .collect();
    all.sort_by_key(|one| one.sequence);
    let found = metrics(&all).order;
    let found = found.measured().unwrap();
    assert_eq!((found.count, found.reordered_count), (11, 3));
    // 4 came four places after 7, 5 five, 6 six.
    assert_eq!((found.extent_p50, found.extent_max), (Some(5), Some(6)));
    assert!(found.n_max <= found.extent_max && found.n_max > Some(0));
    let event = network_events(&packed(&all))
        .into_iter()
        .find(|one| matches!(one.kind, NetworkEventKind::Reordering { .. }));
    let expected = NetworkEventKind::Reordering {
        reordered_count: 3,
        extent_max: 6,
    };
    assert_eq!(event.unwrap().kind, expected);
    let straight = metrics(&passages(50, |_| false)).order;
    let straight = straight.measured().unwrap();
    assert_eq!((straight.reordered_count, straight.extent_p50), (0, None));
}

#[test]
fn a_late_message_is_an_event_and_its_neighbours_belong_to_it() {
    let mut all = passages(3_000, |_| false);
    for (sequence, delay_ms) in [(1_000_usize, 40), (1_004, 60), (2_000, 30)] {
        all[sequence] = arrived(sequence as u64, delay_ms * 1_000_000);
    }
    all[7].delay_bound_ns = 15_000;
    let late: Vec<_> = network_events(&packed(&all))
        .into_iter()
        .filter_map(|one| match one.kind {
            NetworkEventKind::Delay {
                late_count,
                delay_max_ns,
                limit_ns,
                bound_ns,
            } => Some((one.from.ns, late_count, delay_max_ns, limit_ns, bound_ns)),
            _ => None,
        })
        .collect();
    // The mean period is that of 2999 intervals over 3000 messages.
    let limit_ns = DELAY_NS + PERIOD_NS * 2_999 / 3_000;
    assert_eq!(
        late,
        [
            (1_000 * PERIOD_NS, 2, 60_000_000, limit_ns, 15_000),
            (2_000 * PERIOD_NS, 1, 30_000_000, limit_ns, 15_000)
        ]
    );
}

#[test]
fn a_clock_that_was_set_is_an_event_and_one_that_is_slewed_is_not() {
    use crate::ChannelRecords;
    use hil_core::record::{EgressRecord, UNAVAILABLE};
    let record = |index: i64, offset_ns| EgressRecord {
        sequence: index.unsigned_abs(),
        published_ns: index * PERIOD_NS,
        taken_ns: index * PERIOD_NS,
        handed_ns: index * PERIOD_NS,
        tx_software_ns: UNAVAILABLE,
        tx_hardware_ns: UNAVAILABLE,
        realtime_offset_ns: offset_ns,
        epoch: 1,
        session: 1,
        flags: 0,
        fragment_count: 1,
    };
    // Slewed by 500 ppm throughout, set back by 30 ms once.
    let egress: Vec<_> = (0..200)
        .map(|index| {
            record(
                index,
                index / 10 * 50_000 - if index < 120 { 0 } else { 30_000_000 },
            )
        })
        .collect();
    let records = ChannelRecords {
        egress: Some(&egress),
        ..ChannelRecords::default()
    };
    let steps = clock_steps(&records);
    assert_eq!(steps.len(), 1);
    let expected = NetworkEventKind::ClockStep {
        step_ns: -30_000_000 + 50_000,
    };
    assert_eq!(
        (steps[0].kind.clone(), steps[0].from.ns),
        (expected, 119 * PERIOD_NS - CLOCK_READING_AGE_NS_MAX)
    );
}

#[test]
fn bins_hold_what_happened_in_their_time() {
    // 10 s at 100 Hz, nothing from 3.00 s to 3.55 s.
    let mut all = passages(1_000, |one| (300..355).contains(&one));
    all[105].delay_bound_ns = 25_000;
    let duration_ns = 1_000 * PERIOD_NS;
    let width_ns = bin_width_ns(duration_ns);
    let binned = NetworkBins::of(&packed(&all), duration_ns, width_ns, &|at: Moment| {
        Some(at.ns)
    });
    assert_eq!((binned.width_ns, binned.bins.len()), (100_000_000, 100));
    let lost: Vec<u64> = binned.bins[29..37]
        .iter()
        .map(|bin| bin.lost_count)
        .collect();
    assert_eq!(lost, [0, 10, 10, 10, 10, 10, 5, 0]);
    assert_eq!(
        binned.bins.iter().map(|bin| bin.sent_count).sum::<u64>(),
        1_000
    );
    assert_eq!(binned.bins[10].delay_p50_ns, Some(DELAY_NS));
    assert_eq!(binned.bins[31].delay_max_ns, None);
    let bounds = [9, 10, 31].map(|index| binned.bins[index].delay_bound_ns);
    assert_eq!(bounds, [Some(0), Some(25_000), None]);
    // The last reception was at 2.992 s, the next one at 3.552 s.
    let silence: Vec<i64> = binned.bins[29..36]
        .iter()
        .map(|bin| bin.silence_max_ns.unwrap() / 1_000_000)
        .collect();
    assert_eq!(silence, [10, 108, 208, 308, 408, 508, 560]);
    let series = binned.to_series("shuttle/command", Vec::new());
    assert_eq!(series.name, "network-shuttle-command");
    let row = series.rows().nth(30).unwrap();
    assert!((row[0] - 3.0).abs() < 1e-9 && (row[7] - 0.108).abs() < 1e-9);
    assert_eq!(
        (row[1].to_bits(), row[2].to_bits()),
        (10.0_f64.to_bits(), 10.0_f64.to_bits())
    );
    assert!(row[4].is_nan() && row[6].is_nan());
    assert_eq!(series.columns[6].name, "delay_s_bound");
    let row = series.rows().nth(10).unwrap();
    assert!((row[6] - 25e-6).abs() < 1e-12);
}

#[test]
fn bins_are_on_the_axis_that_moments_are_put_on() {
    // 10 s at 100 Hz. The consumer's clock is two minutes ahead; nothing converts in the ninth second.
    const AHEAD_NS: i64 = 120_000_000_000;
    let mut all = passages(1_000, |one| (300..355).contains(&one));
    for one in &mut all {
        one.received_ns = one.received_ns.map(|ns| ns + AHEAD_NS);
    }
    let place = |at: Moment| match at.side {
        Side::Producer => (at.ns < 900 * PERIOD_NS).then_some(at.ns),
        Side::Consumer => Some(at.ns - AHEAD_NS),
    };
    let binned = NetworkBins::of(&packed(&all), 1_000 * PERIOD_NS, 100_000_000, &place);
    assert_eq!(binned.unplaced_count, 100);
    let sent_count: u64 = binned.bins.iter().map(|bin| bin.sent_count).sum();
    assert_eq!(sent_count, 900);
    let silences: Vec<i64> = binned.bins[29..36]
        .iter()
        .map(|bin| bin.silence_max_ns.unwrap() / 1_000_000)
        .collect();
    assert_eq!(silences, [10, 108, 208, 308, 408, 508, 560]);
}

#[test]
fn bins_widen_with_the_run() {
    let second = 1_000_000_000;
    for (length_s, width_ms) in [
        (0, 100),
        (399, 100),
        (400, 200),
        (799, 200),
        (1_613, 500),
        (36_000, 10_000),
    ] {
        assert_eq!(
            bin_width_ns(length_s * second),
            width_ms * 1_000_000,
            "{length_s} s"
        );
    }
}

#[test]
fn nothing_is_concluded_from_nothing() {
    let found = metrics(&[]);
    assert!(found.delay.measured().is_none() && found.loss.measured().is_none());
    assert!(found.order.measured().is_none() && found.offered_per_s.is_none());
    assert!(network_events(&packed(&[])).is_empty());
}

/// None of its messages lacked a way to the peer.
const fn outage(lost_count: u64) -> NetworkEventKind {
    NetworkEventKind::Outage {
        lost_count,
        unreachable_count: 0,
    }
}

#[test]
fn a_network_that_cannot_be_reached_loses_messages_and_says_why() {
    let mut all = passages(100, |one| (40..60).contains(&one));
    for one in &mut all[40..60] {
        one.crossing = Crossing::Unreachable;
    }
    let found = metrics(&all);
    let loss = found.loss.measured().unwrap();
    assert_eq!(found.lost_count, 20);
    assert!(loss.longest.unwrap().length_ns > 0);
    let events = network_events(&packed(&all));
    let kind = NetworkEventKind::Outage {
        lost_count: 20,
        unreachable_count: 20,
    };
    assert_eq!(events[0].kind, kind);
}

#[test]
fn what_a_host_may_have_lost_makes_loss_unavailable_with_both_bounds() {
    let mut all = passages(1_000, |one| one == 3 || one == 7);
    all[7].crossing = Crossing::Doubtful;
    let figures = metrics(&all);
    assert_eq!((figures.doubtful_count, figures.unknown_count), (1, 1));
    assert!(figures.loss.measured().is_none());
    let bounds = figures.loss_bounds().unwrap();
    let expected = LossBounds {
        low: 0.001,
        high: 0.002,
        doubtful_count: 1,
    };
    assert_eq!(bounds, expected);
    assert_eq!(bounds.to_string(), "between 0.100 % and 0.200 %");
    let known = metrics(&passages(1_000, |one| one == 3));
    assert_eq!(known.loss_bounds(), None);
}
