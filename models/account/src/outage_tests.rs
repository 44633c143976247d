//! Outages of synthetic records, and which of them belongs to an event.

use super::*;
use crate::synthetic::{Files, PERIOD_NS, TAKEN_NS, at, same_clock};
use crate::{
    AccountContext, ChannelPath, ChannelRecords, Interruption, PathProcess, account, each_history,
};
use MessageFate as Fate;

fn outages(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> Vec<Outage> {
    let mut finder = OutageFinder::default();
    each_history(records, context, |message| finder.add(message));
    finder.finish()
}

/// One message per millisecond; `fate` says what becomes of each.
fn files(count: u64, fate: impl Fn(u64) -> Fate) -> Files {
    let mut files = Files::default();
    for sequence in 0..count {
        files.write(at(7, sequence), fate(sequence));
    }
    files
}

fn burst(outage: &Outage) -> (u64, u64, Option<i64>, Option<i64>) {
    let ms = |ns: i64| ns / PERIOD_NS;
    let Outage {
        first_sequence,
        lost_count,
        ..
    } = *outage;
    let ends = (outage.from_ns.map(ms), outage.until_ns.map(ms));
    (first_sequence, lost_count, ends.0, ends.1)
}

#[test]
fn an_outage_lasts_from_the_first_lost_to_the_next_delivered_publication() {
    let files = files(1_000, |sequence| match sequence {
        100..=149 | 300 | 500 | 502 => Fate::LostOnWire,
        // Replaced before it was sent: no word on the way, so the outage goes on.
        501 => Fate::SupersededAtInput,
        // Not taken, but it got through.
        700 | 702 => Fate::Late,
        701 => Fate::SupersededAtConsumer,
        _ => Fate::Taken,
    });
    let context = same_clock(1_000 * PERIOD_NS);
    let found = outages(&files.records(), &context);
    let bursts: Vec<_> = found.iter().map(burst).collect();
    assert_eq!(
        bursts,
        [
            (100, 50, Some(100), Some(150)),
            (300, 1, Some(300), Some(301)),
            (500, 2, Some(500), Some(503)),
            (700, 1, Some(700), Some(701)),
            (702, 1, Some(702), Some(703)),
        ]
    );
    assert_eq!(found[0].silent_from_ns, Some(100 * PERIOD_NS + TAKEN_NS));
    assert_eq!(found[0].silent_until_ns, Some(150 * PERIOD_NS + TAKEN_NS));
    // What got through but was not taken leaves the consumer in silence.
    for (outage, from) in found[3..].iter().zip([700, 702]) {
        assert_eq!(outage.silent_from_ns, Some(from * PERIOD_NS + TAKEN_NS));
        assert_eq!(outage.silent_until_ns, Some(703 * PERIOD_NS + TAKEN_NS));
    }
    let total = found.iter().map(|outage| outage.lost_count).sum::<u64>();
    let fates = account(&files.records(), &context).fates;
    assert_eq!(total, fates.lost_count());
}

#[test]
fn what_a_host_lost_in_an_outage_is_not_the_networks() {
    let fates = [
        Fate::LostOnWire,
        Fate::Incomplete,
        Fate::RefusedByKernel,
        Fate::Late,
        Fate::RefusedAtIngress,
    ];
    let files = files(5_000, |sequence| match sequence {
        5..10 => fates[usize::try_from(sequence).unwrap() - 5],
        _ => Fate::Taken,
    });
    let outage = |interruptions: &[Interruption]| {
        let context = same_clock(5_000 * PERIOD_NS).with_interruptions(interruptions);
        let found = outages(&files.records(), &context);
        (found[0].lost_count, found[0].lost_by_network_count)
    };
    assert_eq!(outage(&[]), (5, 2));
    let killed = Interruption {
        process: "gateway".to_owned(),
        place: PathProcess::ReceivingGateway,
        from: Instant::from_ns(5 * PERIOD_NS),
        until: Instant::from_ns(12 * PERIOD_NS),
        cause: "killed".to_owned(),
    };
    assert_eq!(outage(&[killed]), (5, 0));
}

#[test]
fn an_outage_at_the_end_lasts_as_long_as_the_run() {
    let files = files(400, |sequence| match sequence {
        100.. => Fate::LostOnWire,
        _ => Fate::Taken,
    });
    let context = same_clock(500 * PERIOD_NS);
    let end = context.producer_run.map(|run| run.end);
    let found = outages(&files.records(), &context);
    assert_eq!(burst(&found[0]), (100, 300, Some(100), None));
    assert_eq!(found[0].silent_until_ns, None);
    assert_eq!(found[0].length_ns(end), Some(400 * PERIOD_NS));
    assert_eq!(found[0].length_ns(None), None);
    let figures = OutageMetrics::of(&found, end);
    assert!(figures.longest.unwrap().is_open);
    assert_eq!(OutageMetrics::of(&found, None).unknown_length_count, 1);
}

#[test]
fn outages_are_sorted_by_length_and_their_borders_belong_to_the_longer_class() {
    let outage = |from_ms: i64, length_ms: i64| Outage {
        lost_count: 2,
        lost_by_network_count: 2,
        first_sequence: 0,
        from_ns: Some(from_ms * PERIOD_NS),
        until_ns: Some((from_ms + length_ms) * PERIOD_NS),
        silent_from_ns: None,
        silent_until_ns: None,
        interruption_index: None,
    };
    let lengths_ms = [
        8, 19, 20, 99, 100, 499, 500, 999, 1_000, 1_999, 2_000, 5_000,
    ];
    let found: Vec<_> = lengths_ms.map(|ms| outage(10_000, ms)).to_vec();
    let figures = OutageMetrics::of(&found, None);
    let counts: Vec<_> = figures.classes.iter().map(|one| one.outage_count).collect();
    assert_eq!(counts, [2, 2, 2, 2, 2, 1, 1]);
    assert_eq!((figures.outage_count, figures.lost_count), (12, 24));
    assert_eq!(figures.total_ns, lengths_ms.iter().sum::<i64>() * PERIOD_NS);
    assert_eq!(figures.classes[6].until_ns, None);
    for pair in figures.classes.windows(2) {
        assert_eq!(pair[0].until_ns, Some(pair[1].from_ns));
    }
    let longest = figures.longest.unwrap();
    assert_eq!(longest.start_ns, 10_000 * PERIOD_NS);
    assert_eq!(longest.length_ns, 5_000 * PERIOD_NS);
    assert_eq!(OutageMetrics::of(&[], None).longest, None);
}

fn event(at_ms: i64, side: Side) -> EventTime<'static> {
    EventTime {
        at: Some((Instant::from_ns(at_ms * PERIOD_NS), side)),
        lost_published_ns: &[],
    }
}

fn some_outages() -> Vec<Outage> {
    let lost = |sequence: u64| matches!(sequence, 1_000..=1_009 | 2_000..=2_999 | 3_500..=3_599 | 9_000..=9_999);
    let files = files(20_000, |sequence| {
        if lost(sequence) {
            Fate::LostOnWire
        } else {
            Fate::Taken
        }
    });
    outages(&files.records(), &same_clock(20_000 * PERIOD_NS))
}

#[test]
fn an_event_finds_the_outage_that_had_lasted_longest_by_then() {
    let found = some_outages();
    let before = |ms: i64, side| {
        let found = preceding(&found, &event(ms, side))?;
        let Outage { first_sequence, .. } = found.outage;
        let is_under_way = found.standing == Standing::UnderWay;
        Some((first_sequence, found.other_count, is_under_way))
    };
    for side in [Side::Producer, Side::Consumer] {
        assert_eq!(before(900, side), None);
        assert_eq!(before(1_005, side), Some((1_000, 0, true)));
        // It has only just begun: what came before weighs more.
        assert_eq!(before(2_003, side), Some((1_000, 1, false)));
        assert_eq!(before(2_500, side), Some((2_000, 1, true)));
        assert_eq!(before(5_000, side), Some((2_000, 2, false)));
        assert_eq!(before(8_500, side), Some((3_500, 0, false)));
        assert_eq!(before(8_900, side), None);
        assert_eq!(before(15_100, side), None);
    }
    let ended = preceding(&found, &event(10_400, Side::Producer)).unwrap();
    assert_eq!(ended.standing, Standing::OverFor(400 * PERIOD_NS));
}

#[test]
fn a_lost_message_that_an_event_names_points_at_its_outage() {
    let found = some_outages();
    let named = |at, ms: i64| {
        let lost_published_ns = &[ms * PERIOD_NS];
        let event = EventTime {
            at,
            lost_published_ns,
        };
        let found = preceding(&found, &event)?;
        Some((
            found.outage.first_sequence,
            found.standing,
            found.other_count,
        ))
    };
    let at = |ms| event(ms, Side::Consumer).at;
    let short = named(at(3_100), 1_004).unwrap();
    assert_eq!((short.0, short.2), (1_000, 1), "a longer one is beside it");
    assert!(matches!(short.1, Standing::OverFor(_)));
    // Told of its beginning, or long after, or on a clock of its own.
    assert_eq!(
        named(at(900), 1_004),
        Some((1_000, Standing::BegunLater, 0))
    );
    let late = named(at(19_000), 9_500).unwrap();
    assert!(matches!(late, (9_000, Standing::OverFor(_), 0)), "{late:?}");
    assert_eq!(named(None, 9_500), Some((9_000, Standing::Unknown, 0)));
    assert_eq!(named(None, 8_000), None);
}

#[test]
fn before_an_outage_a_consumer_that_is_sent_nothing_misses_nothing() {
    let ns = |ms: i64| ms * PERIOD_NS;
    let happened = |outages: &[Outage], ms| {
        let found = preceding(outages, &event(ms, Side::Consumer));
        found.map(|found| found.standing)
    };
    // One message a minute, each taken after 50 ms.
    let mut finder = OutageFinder::default();
    finder.arrived(Some(0), Some(ns(50)));
    finder.lost(1, 1, Some(ns(60_000)), true);
    let open = finder.finish();
    assert_eq!(open[0].silent_from_ns, Some(ns(60_050)));
    assert_eq!(happened(&open, 60_049), None);
    assert_eq!(happened(&open, 60_050), Some(Standing::UnderWay));
    // Without a message before, the one after tells how long they take.
    let mut finder = OutageFinder::default();
    finder.lost(0, 1, Some(ns(1_000)), true);
    finder.arrived(Some(ns(2_000)), Some(ns(2_070)));
    let first = finder.finish();
    assert_eq!(first[0].silent_from_ns, Some(ns(1_070)));
    assert_eq!(first[0].silent_until_ns, Some(ns(2_070)));
    // With none at all, nobody knows.
    let mut finder = OutageFinder::default();
    finder.lost(0, 1, Some(ns(1_000)), true);
    let silent = finder.finish();
    assert_eq!(silent[0].silent_from_ns, None);
    assert_eq!(happened(&silent, 1_000), None);
}

#[test]
fn unaligned_clocks_leave_each_side_its_own_times() {
    let mut files = files(300, |sequence| match sequence {
        100..=199 => Fate::LostOnWire,
        _ => Fate::Taken,
    });
    let ahead_ns = 7_000_000_000_000;
    for record in &mut files.taken {
        record.taken_ns += ahead_ns;
    }
    let context = AccountContext::new(ChannelPath::Gateway { alignment: None });
    let found = outages(&files.records(), &context);
    assert_eq!(burst(&found[0]), (100, 100, Some(100), Some(200)));
    let here_ms = 150 + ahead_ns / PERIOD_NS;
    assert!(preceding(&found, &event(here_ms, Side::Consumer)).is_some());
    assert!(preceding(&found, &event(here_ms, Side::Producer)).is_none());
    let mut records = files.records();
    records.taken = None;
    let unseen = outages(&records, &context);
    assert!(unseen.iter().all(|outage| outage.silent_from_ns.is_none()));
}

#[test]
fn an_outage_that_an_interruption_caused_names_it() {
    let files = files(300, |sequence| match sequence {
        100..=199 => Fate::LostOnWire,
        _ => Fate::Taken,
    });
    let interruptions = [Interruption {
        process: "gateway".to_owned(),
        place: PathProcess::ReceivingGateway,
        from: Instant::from_ns(100 * PERIOD_NS),
        until: Instant::from_ns(200 * PERIOD_NS),
        cause: "killed by signal 9".to_owned(),
    }];
    let context = same_clock(300 * PERIOD_NS).with_interruptions(&interruptions);
    let found = outages(&files.records(), &context);
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].interruption_index, Some(0));
}
