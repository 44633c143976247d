//! Tests of the replay of a trace.

use core::time::Duration;

use super::*;
use crate::replay::{ReplayError, TraceEnd, TraceLink, TraceReplay};
use hil_core::link_model::{Fate, LinkModel, MessageNumber, TraceMatch};
use hil_core::time::{Instant, RemoteInstant};

const MS: i64 = 1_000_000;

/// Every 10 ms: delivered after 2 ms, lost, delivered twice, unknown.
fn trace() -> Trace {
    let at = |index: i64| TraceRecord::published(index * 10 * MS, index.unsigned_abs(), 16);
    let mut records = vec![at(0).delivered(2 * MS, 0), at(1), at(2), at(3)];
    records[1].fate = TraceFate::LostInNetwork;
    records[2] = records[2].delivered(5 * MS, 0);
    records[2].second_delay_ns = 3 * MS;
    let header = TraceHeader::new("a/b");
    Trace { header, records }
}

fn link(matching: TraceMatch, end: TraceEnd) -> TraceLink {
    let replay = TraceReplay {
        matching,
        end,
        delay_otherwise: None,
    };
    TraceLink::new(trace(), replay).unwrap()
}

fn at(ms: i64) -> Instant {
    Instant::from_ns(ms * MS)
}

fn number(start: u32, sequence: u64) -> MessageNumber {
    MessageNumber {
        start,
        sequence,
        published: None,
    }
}

fn met(ms: i64) -> Vec<Fate> {
    vec![
        Fate::Delivered(at(ms + 2)),
        Fate::Lost,
        Fate::Duplicated {
            first: at(ms + 3),
            second: at(ms + 5),
        },
        Fate::Lost,
    ]
}

#[test]
fn the_nth_message_meets_the_nth_record_whenever_it_comes() {
    let mut link = link(TraceMatch::Index, TraceEnd::Wrap);
    let tally = link.tally();
    for round in 0..2 {
        let fates: Vec<_> = (0..4).map(|_| link.offer(at(700), 16)).collect();
        assert_eq!(fates, met(700), "round {round}");
    }
    let counts = tally.counts();
    assert_eq!((counts.offered_count, counts.met_count), (8, 4));
    assert_eq!((counts.delivered_count, counts.lost_count), (2, 1));
    assert_eq!((counts.unknown_count, counts.beyond_end_count), (1, 4));
    assert_eq!(counts.record_count, 4);
    assert_eq!(link.delay_max(), Duration::from_millis(5));
    // Told by number, it does not matter which were never offered.
    assert_eq!(link.offer_message(at(9), number(0, 10)), met(9)[2]);
    assert_eq!(link.offer(at(9), 1), Fate::Lost);
}

#[test]
fn by_time_a_message_meets_the_record_published_last() {
    let mut link = link(TraceMatch::Time, TraceEnd::Wrap);
    for (ms, index) in [(0, 0), (9, 0), (10, 1), (25, 2), (39, 3), (40, 0), (52, 1)] {
        assert_eq!(link.offer(at(ms), 1), met(ms)[index], "{ms} ms");
    }
    assert_eq!(link.tally().counts().beyond_end_count, 2);
}

#[test]
fn a_round_by_time_is_the_run_or_else_from_the_first_record_on() {
    let replay = TraceReplay {
        matching: TraceMatch::Time,
        ..TraceReplay::default()
    };
    // Met is told by the delay, which is the record's index in nanoseconds.
    let met = |trace: Trace, offers: &[i64]| {
        let mut link = TraceLink::new(trace.clone(), replay).unwrap();
        let mut index = |ms: &i64| {
            let arrival = link.offer(at(*ms), 1).arrival().unwrap();
            arrival.as_ns() - ms * MS
        };
        offers.iter().map(&mut index).collect::<Vec<_>>()
    };
    let with = |published_ms: &[i64], duration_ms: Option<i64>| {
        let mut made = trace();
        made.header.duration_ns = duration_ms.map_or(UNAVAILABLE_NS, |ms| ms * MS);
        let records = published_ms.iter().zip(0_i64..).map(|(ms, index)| {
            TraceRecord::published(ms * MS, index.unsigned_abs(), 16).delivered(index, 0)
        });
        made.records = records.collect();
        made
    };
    // A run of 50 ms that began to publish after 10: its second round waits as long.
    let run = with(&[10, 20, 30], Some(50));
    assert_eq!(
        met(run, &[0, 10, 25, 49, 50, 59, 60, 81]),
        [0, 0, 1, 2, 2, 2, 0, 2]
    );
    // Instants since 1970, from elsewhere: they count from the first.
    let epoch_ms = 1_700_000_000_000;
    let foreign = with(&[epoch_ms, epoch_ms + 10, epoch_ms + 20], None);
    assert_eq!(met(foreign, &[0, 9, 10, 29, 30, 41]), [0, 0, 1, 2, 0, 1]);
    // So they do when the length of a run beside them cannot be of the same origin.
    let odd = with(&[epoch_ms, epoch_ms + 10], Some(15));
    assert_eq!(met(odd, &[0, 10, 20]), [0, 1, 0]);
    // Mahimahi's form wraps at its last line: there the next round's first opportunity is.
    let (opportunities, fault) = opportunities::decode(&"3\n5\n10\n".into());
    assert_eq!(fault, None);
    let mut opportunities = opportunities;
    for (record, index) in opportunities.records.iter_mut().zip(0..) {
        record.delay_ns = index;
    }
    assert_eq!(
        met(opportunities, &[0, 4, 9, 10, 12, 13, 15, 25]),
        [0, 0, 1, 2, 2, 0, 1, 1]
    );
}

#[test]
fn by_tick_a_message_meets_the_record_of_its_tick_and_what_nobody_published_is_lost() {
    let mut ticking = trace();
    ticking.records = (0..100)
        .filter(|tick| tick % 10 != 7)
        .map(|tick| TraceRecord::published(3 * MS + tick * 10 * MS, 0, 1).delivered(tick, 0))
        .collect();
    let replay = TraceReplay {
        matching: TraceMatch::Tick,
        end: TraceEnd::Perfect,
        delay_otherwise: None,
    };
    let mut link = TraceLink::new(ticking.clone(), replay).unwrap();
    for tick in 0..100 {
        let now = at(500 + tick * 10);
        let expected = match tick % 10 {
            7 => Fate::Lost,
            _ => Fate::Delivered(Instant::from_ns(now.as_ns() + tick)),
        };
        assert_eq!(link.offer(now, 1), expected, "tick {tick}");
    }
    assert_eq!(link.offer(at(500 + 991), 1), link.offer(at(500 + 991), 1));
    assert_eq!(link.offer(at(1_500), 1), Fate::Delivered(at(1_500)));
    let counts = link.tally().counts();
    assert_eq!((counts.met_count, counts.unpublished_count), (90, 10));
    assert_eq!((counts.repeated_count, counts.beyond_end_count), (2, 1));
    assert_eq!(counts.offered_count, 103);
    let without_period = TraceLink::new(trace(), replay).unwrap();
    assert_eq!(without_period.tally().counts().matching, TraceMatch::Index);
}

#[test]
fn by_tick_what_counts_is_when_a_message_was_published_not_when_it_arrived() {
    let mut ticking = trace();
    ticking.records = (0..100)
        .map(|tick| TraceRecord::published(tick * 10 * MS, 0, 1).delivered(tick, 0))
        .collect();
    let replay = TraceReplay {
        matching: TraceMatch::Tick,
        end: TraceEnd::Perfect,
        delay_otherwise: None,
    };
    let mut link = TraceLink::new(ticking.clone(), replay).unwrap();
    let mut now = at(0);
    for tick in 0..100 {
        // Held up on the way by up to three periods, so that several come at once; the producer's clock
        // is another.
        now = now.max(at(tick * 10 + tick * 37 % 30));
        let message = MessageNumber {
            published: Some(RemoteInstant::from_ns(-900_000 * MS + tick * 10 * MS)),
            ..number(1, tick.unsigned_abs())
        };
        let expected = Fate::Delivered(Instant::from_ns(now.as_ns() + tick));
        assert_eq!(
            link.offer_numbered(now, 1, message),
            expected,
            "tick {tick}"
        );
    }
    let counts = link.tally().counts();
    assert_eq!((counts.met_count, counts.repeated_count), (100, 0));
}

#[test]
fn after_the_end_it_does_what_it_was_told_and_counts_it() {
    for matching in [TraceMatch::Index, TraceMatch::Time] {
        for (end, fate) in [
            (TraceEnd::Perfect, Fate::Delivered(at(40))),
            (TraceEnd::Lost, Fate::Lost),
        ] {
            let mut link = link(matching, end);
            for ms in [0, 10, 20, 30] {
                link.offer(at(ms), 1);
            }
            assert_eq!(link.offer(at(40), 1), fate);
            let counts = link.tally().counts();
            assert_eq!((counts.met_count, counts.beyond_end_count), (4, 1));
        }
    }
}

#[test]
fn unknown_delays_need_a_word_and_negative_ones_are_counted() {
    let mut unknown = trace();
    unknown.records[2].delay_ns = UNAVAILABLE_NS;
    unknown.header.clock = "clocks not aligned".to_owned();
    let error = TraceLink::new(unknown.clone(), TraceReplay::default()).unwrap_err();
    assert!(error.to_string().contains("record 2"), "{error}");
    let replay = TraceReplay {
        delay_otherwise: Some(Duration::from_millis(4)),
        ..TraceReplay::default()
    };
    let mut link = TraceLink::new(unknown.clone(), replay).unwrap();
    let fate = link.offer_message(at(0), number(0, 2));
    assert_eq!(fate.arrival(), Some(at(3)));
    let mut early = trace();
    early.records[0].delay_ns = -5;
    let mut link = TraceLink::new(early.clone(), TraceReplay::default()).unwrap();
    assert_eq!(link.offer(at(1), 1), Fate::Delivered(at(1)));
    assert_eq!(link.tally().counts().negative_delay_count, 1);
    let empty = Trace {
        records: Vec::new(),
        ..trace()
    };
    let refused = TraceLink::new(empty.clone(), TraceReplay::default());
    assert_eq!(refused.unwrap_err(), ReplayError::Empty);
}

#[test]
fn pieces_and_copies_of_a_message_meet_one_record_and_count_once() {
    for matching in [TraceMatch::Index, TraceMatch::Time, TraceMatch::Tick] {
        let mut ticking = trace();
        let of = |tick: i64| TraceRecord::published(tick * 10 * MS, 0, 1);
        let known = |tick: i64| of(tick).delivered(if tick % 8 == 0 { -1 } else { tick }, 0);
        let records = (0..100).map(|tick| if tick % 3 == 1 { of(tick) } else { known(tick) });
        ticking.records = records.collect();
        let replay = TraceReplay {
            matching,
            ..TraceReplay::default()
        };
        let mut link = TraceLink::new(ticking.clone(), replay).unwrap();
        for (tick, record) in (0..100).zip(&ticking.records) {
            // Three pieces; a copy of one when the next two messages are through already.
            for (ms, sequence) in [(0, tick), (1, tick), (4, tick), (5, tick - 2)] {
                let now = at(tick * 10 + ms);
                let Ok(sequence) = u64::try_from(sequence) else {
                    continue;
                };
                let record = if ms == 5 {
                    ticking.records[usize::try_from(sequence).unwrap()]
                } else {
                    *record
                };
                let delay = |ns: i64| Duration::from_nanos(ns.max(0).unsigned_abs());
                let expected = record
                    .delay()
                    .map_or(Fate::Lost, |ns| Fate::Delivered(now + delay(ns)));
                assert_eq!(
                    link.offer_message(now, number(0, sequence)),
                    expected,
                    "{matching:?} {tick}"
                );
            }
        }
        let counts = link.tally().counts();
        assert_eq!((counts.offered_count, counts.met_count), (100, 100));
        assert_eq!((counts.delivered_count, counts.unknown_count), (67, 33));
        assert_eq!(
            counts.negative_delay_count, 9,
            "of 13 eighths 4 are unknown"
        );
    }
}

#[test]
fn by_index_a_producer_started_anew_goes_on_where_it_was() {
    let mut link = link(TraceMatch::Index, TraceEnd::Lost);
    let mut offer = |start, sequence| link.offer_message(at(0), number(start, sequence));
    assert_eq!(offer(5, 0), met(0)[0]);
    assert_eq!(offer(5, 1), met(0)[1]);
    assert_eq!(offer(6, 0), met(0)[2]);
    assert_eq!(offer(6, 0), met(0)[2], "a copy");
    assert_eq!(offer(5, 1), met(0)[1], "a straggler");
    assert_eq!(offer(6, 1), met(0)[3]);
    assert_eq!(offer(6, 2), Fate::Lost);
    let counts = link.tally().counts();
    assert_eq!((counts.met_count, counts.beyond_end_count), (4, 1));
}
