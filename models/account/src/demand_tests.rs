//! Histories whose down times are counted by hand, and random ones against the definition said once more.

use super::*;
use crate::synthetic::{Files, at, same_clock};
use crate::{ChannelPath, ChannelRecords, Interruption, each_history};
use hil_core::random::RandomStream;
use hil_core::time::{Alignment, Instant};

const MS: i64 = 1_000_000;
/// From one message to the next, milliseconds; the limits are 20 ms and 24 ms.
const INTERVAL_MS: i64 = 16;
const IN_TIME: Transfer = received(5);

const fn received(delay_ms: i64) -> Transfer {
    Transfer::Received {
        delay_ns: delay_ms * MS,
        bound_ns: 0,
    }
}

fn demand() -> Demand {
    Demand {
        latency_max: Duration::from_millis(20),
        survival_time: Duration::from_millis(24),
        interval: Duration::from_millis(16),
        availability: 0.9999,
    }
}

fn run(end_ms: i64) -> RunSpan {
    RunSpan {
        start: Instant::ZERO,
        end: Instant::from_ns(end_ms * MS),
    }
}

/// Messages at these times in a run of so many milliseconds.
fn judged(end_ms: i64, messages: &[(i64, Transfer)]) -> DemandMetrics {
    let mut fold = DemandFold::new(&demand(), Some(run(end_ms)));
    for (at_ms, transfer) in messages {
        fold.offer(Some(at_ms * MS), 1, *transfer);
    }
    fold.finish()
}

/// Ten messages in a run of 160 ms, these of them other than in time.
fn ten(others: &[(i64, Transfer)]) -> ServiceMetrics {
    let messages: Vec<_> = (0..10)
        .map(|number| {
            let other = others.iter().find(|(index, _)| *index == number);
            (
                number * INTERVAL_MS,
                other.map_or(IN_TIME, |(_, transfer)| *transfer),
            )
        })
        .collect();
    measured(&judged(160, &messages)).clone()
}

fn measured(found: &DemandMetrics) -> &ServiceMetrics {
    found
        .service
        .measured()
        .unwrap_or_else(|| panic!("{found:?}"))
}

fn down(service: &ServiceMetrics) -> (u64, i64, Option<(i64, i64, bool)>) {
    let longest = service.longest;
    let longest = longest.map(|one| (one.start_ns / MS, one.length_ns / MS, one.is_open));
    (service.failure_count, service.down_ns / MS, longest)
}

fn is_near(found: f64, expected: f64) -> bool {
    (found - expected).abs() < 1e-9
}

#[test]
fn losses_within_the_survival_time_are_no_failure_and_one_more_is_one_with_its_down_time() {
    let lost = Transfer::Lost;
    // The message of 32 ms is due at 76 ms, survival time included; that of 64 ms comes at 69 ms.
    let found = ten(&[(2, lost), (3, lost)]);
    assert_eq!(down(&found), (0, 0, None));
    assert_eq!((found.in_time_count, found.lost_count), (8, 2));
    assert!(is_near(found.reliability, 0.8) && is_near(found.availability, 1.0));
    assert_eq!(found.time_between_failures_ns, None);
    // The next one comes at 85 ms.
    let found = ten(&[(2, lost), (3, Transfer::LostByHost), (4, lost)]);
    assert_eq!(down(&found), (1, 9, Some((76, 9, false))));
    assert_eq!((found.lost_count, found.lost_by_host_count), (3, 1));
    assert_eq!((found.asked_ns, found.idle_ns), (160 * MS, 0));
    assert!(is_near(found.availability, 1.0 - 9.0 / 160.0));
    assert_eq!(found.time_between_failures_ns, Some(151 * MS));
    assert_eq!(found.down_ns_max, 9 * MS);
}

#[test]
fn a_message_beyond_the_latency_is_not_in_time_and_ends_no_failure() {
    let found = ten(&[(2, received(21)), (3, received(25)), (4, received(21))]);
    assert_eq!((found.late_count, found.lost_count), (3, 0));
    assert_eq!(down(&found), (1, 9, Some((76, 9, false))));
    // At the limit it is in time.
    assert_eq!(
        down(&ten(&[(2, Transfer::Lost), (3, received(20))])),
        (0, 0, None)
    );
}

#[test]
fn a_failure_that_is_open_at_the_end_lasts_to_the_end_of_the_run() {
    let lost: Vec<_> = (5..10).map(|index| (index, Transfer::Lost)).collect();
    assert_eq!(down(&ten(&lost)), (1, 36, Some((124, 36, true))));
    // What is under way at the end does not end it, and is late where its time was over.
    let mut under_way = lost;
    under_way[3].1 = Transfer::InFlight;
    under_way[4].1 = received(17);
    let found = ten(&under_way);
    assert_eq!(down(&found), (1, 36, Some((124, 36, true))));
    let counts = (found.lost_count, found.late_count, found.unknown_count);
    assert_eq!(counts, (3, 1, 1));
    // A link that holds everything back to the end.
    let held: Vec<_> = (5..10).map(|index| (index, Transfer::InFlight)).collect();
    let found = ten(&held);
    assert_eq!(down(&found), (1, 36, Some((124, 36, true))));
    assert_eq!((found.late_count, found.unknown_count), (4, 1));
    // Messages whose time was not over by then make no failure.
    let found = ten(&[(8, Transfer::Lost), (9, Transfer::Lost)]);
    assert_eq!(down(&found), (0, 0, None));
}

#[test]
fn a_pause_of_the_producer_is_no_time_of_the_service() {
    let messages = [
        (100, IN_TIME),
        (116, IN_TIME),
        (132, Transfer::Lost),
        (432, IN_TIME),
        (448, IN_TIME),
    ];
    let found = judged(1_000, &messages);
    let found = measured(&found);
    assert_eq!(down(found), (0, 0, None));
    // 100 to 148 ms and 432 to 464 ms.
    assert_eq!((found.asked_ns, found.idle_ns), (80 * MS, 920 * MS));
    // Down before the pause, in time only after it: 44 ms from the loss at 16 ms, of which a pause takes 300 - 16.
    let mut messages: Vec<_> = (0..6).map(|one| (one * 16, Transfer::Lost)).collect();
    messages[0].1 = IN_TIME;
    messages.push((380, IN_TIME));
    let found = judged(396, &messages);
    // Due at 60 ms; asked for to 96 ms, and up again 5 ms after the pause.
    assert_eq!(down(measured(&found)), (1, 41, Some((60, 41, false))));
}

#[test]
fn a_channel_that_is_slower_than_its_interval_is_not_judged() {
    let messages: Vec<_> = (0..20).map(|one| (one * 40, IN_TIME)).collect();
    let found = judged(800, &messages);
    assert_eq!(found.verdict, DemandVerdict::NotJudged);
    let Metric::Unavailable { reason } = &found.service else {
        panic!("{found:?}");
    };
    assert!(reason.ends_with("interval is another"), "{reason}");
}

#[test]
fn unknown_fates_are_no_losses_but_may_decide() {
    let unknown = Transfer::Unknown;
    let found = ten(&[(2, Transfer::Lost), (3, unknown), (4, unknown)]);
    assert_eq!((found.in_time_count, found.unknown_count), (7, 2));
    assert_eq!(
        (found.failure_count, found.down_ns, found.down_ns_max),
        (0, 0, 9 * MS)
    );
    assert!(is_near(found.reliability, 7.0 / 8.0));
    let found = judged(160, &[(0, unknown), (16, unknown)]);
    assert_eq!(found.verdict, DemandVerdict::NotJudged);
    assert_eq!(judged(160, &[]).verdict, DemandVerdict::NotJudged);
    // A run that is long enough, but for a second of unknown fates.
    let mut fold = DemandFold::new(&demand(), Some(run(1_600_000)));
    for number in 0..100_000_i64 {
        let is_known = !(50_000..50_063).contains(&number);
        let transfer = if is_known { IN_TIME } else { unknown };
        fold.offer(Some(number * INTERVAL_MS * MS), 1, transfer);
    }
    let found = fold.finish();
    assert_eq!(found.verdict, DemandVerdict::UnknownMessages);
    let service = measured(&found);
    assert!(service.availability_low < 0.9995 && service.availability > 0.999_999);
}

#[test]
fn a_latency_within_the_clocks_bound_of_the_limit_is_not_judged() {
    let within = |delay_ms: i64, bound_ms: u64| Transfer::Received {
        delay_ns: delay_ms * MS,
        bound_ns: bound_ms * MS.unsigned_abs(),
    };
    let found = ten(&[
        (1, within(10, 3)),
        (2, within(18, 3)),
        (3, within(22, 3)),
        (4, within(25, 3)),
    ]);
    assert_eq!(
        (found.in_time_count, found.late_count, found.unknown_count),
        (7, 1, 2)
    );
    assert_eq!((found.down_ns, found.down_ns_max), (0, 9 * MS));
}

#[test]
fn the_service_is_up_again_with_the_first_message_in_time_in_whatever_order() {
    let lost = Transfer::Lost;
    // Message 5 comes at 99 ms, message 6, which overtakes it, at 97 ms.
    let found = ten(&[
        (2, lost),
        (3, lost),
        (4, lost),
        (5, received(19)),
        (6, received(1)),
    ]);
    assert_eq!(down(&found), (1, 21, Some((76, 21, false))));
}

#[test]
fn messages_without_a_time_were_due_after_the_last_that_has_one() {
    let mut fold = DemandFold::new(&demand(), Some(run(160)));
    fold.offer(Some(0), 1, IN_TIME);
    fold.offer(Some(16 * MS), 1, IN_TIME);
    fold.offer(None, 3, Transfer::LostByHost);
    fold.offer(Some(80 * MS), 1, IN_TIME);
    let found = fold.finish();
    let found = measured(&found);
    // They were offered, so the time without them is no pause.
    assert_eq!(down(found), (1, 9, Some((76, 9, false))));
    assert_eq!(
        (found.lost_count, found.asked_ns, found.idle_ns),
        (3, 96 * MS, 64 * MS)
    );
}

#[test]
fn a_wild_number_of_messages_breaks_nothing() {
    let mut fold = DemandFold::new(&demand(), Some(run(160)));
    fold.offer(Some(0), 1, IN_TIME);
    for transfer in [Transfer::LostByHost, Transfer::Unknown, Transfer::Lost] {
        fold.offer(None, u64::MAX - 3, transfer);
    }
    fold.offer(Some(150 * MS), 1, IN_TIME);
    let found = fold.finish();
    assert_eq!(measured(&found).lost_count, u64::MAX);
}

#[test]
fn what_a_run_shows_of_an_availability_depends_on_its_length() {
    let of = |count: i64, lost: core::ops::Range<i64>| {
        let mut fold = DemandFold::new(&demand(), Some(run(count * INTERVAL_MS)));
        for number in 0..count {
            let is_lost = lost.contains(&number);
            let transfer = if is_lost { Transfer::Lost } else { IN_TIME };
            fold.offer(Some(number * INTERVAL_MS * MS), 1, transfer);
        }
        fold.finish()
    };
    // A minute without a failure can miss 3.6889 of one interval each (Garwood 1936).
    let found = of(3_750, 0..0);
    assert_eq!(found.verdict, DemandVerdict::SampleTooSmall);
    let shown = measured(&found).availability_shown_max;
    assert!(
        (shown - (1.0 - 3.6889 * 0.016 / 60.0)).abs() < 1e-7,
        "{shown}"
    );
    // 0.9999 takes 3.6889 intervals / 0.0001.
    assert_eq!(of(36_880, 0..0).verdict, DemandVerdict::SampleTooSmall);
    assert_eq!(of(36_900, 0..0).verdict, DemandVerdict::Met);
    // One short failure in a minute is no proof of the opposite, one of a second is.
    assert_eq!(of(3_750, 100..104).verdict, DemandVerdict::SampleTooSmall);
    let found = of(3_750, 100..170);
    assert_eq!(found.verdict, DemandVerdict::Missed);
    let service = measured(&found);
    assert!(service.availability_low < service.availability);
    assert!(service.availability < service.availability_high && service.availability_high < 0.9999);
    // A day with the same failure.
    assert_eq!(of(5_400_000, 100..170).verdict, DemandVerdict::Met);
}

#[test]
fn records_say_what_came_of_a_message_between_the_interfaces_of_the_service() {
    use MessageFate as Fate;
    let mut files = Files::default();
    let fates = [
        Fate::Taken,
        Fate::SupersededAtConsumer,
        Fate::LostOnWire,
        Fate::SupersededAtInput,
        Fate::Late,
        Fate::Unexplained,
        Fate::LostOnWire,
        Fate::Taken,
    ];
    for (sequence, fate) in (0_u64..).zip(fates) {
        files.write(at(7, sequence), fate);
    }
    let down_at = |place, sequence| Interruption {
        process: "one".to_owned(),
        place,
        from: Instant::from_ns(at(7, sequence).published_ns),
        until: Instant::from_ns(at(7, sequence).published_ns + MS / 2),
        cause: "killed by signal 9".to_owned(),
    };
    let told = |records: &ChannelRecords<'_>, context: &AccountContext<'_>| {
        let mut fold = DemandFold::of_channel(&demand(), context);
        each_history(records, context, |message| fold.add(message, context));
        fold.finish()
    };
    let counts = |interruptions: &[Interruption]| {
        let context = same_clock(1_000 * MS).with_interruptions(interruptions);
        let found = told(&files.records(), &context);
        let found = measured(&found);
        (
            found.in_time_count,
            found.lost_count,
            found.lost_by_host_count,
            found.unknown_count,
        )
    };
    assert_eq!(counts(&[]), (3, 4, 2, 1));
    // A gateway is part of the service, the producer is not. All messages are within a flight of the interruption.
    assert_eq!(
        counts(&[down_at(PathProcess::ReceivingGateway, 6)]),
        (3, 5, 5, 0)
    );
    let with_killed_producer = counts(&[down_at(PathProcess::Producer, 3)]);
    assert_eq!(with_killed_producer, (3, 3, 1, 2));
    let alignment = |bound_ns| {
        let alignment = Some(Alignment {
            offset_ns: 0,
            bound_ns,
        });
        let path = ChannelPath::Gateway { alignment };
        AccountContext {
            path,
            ..same_clock(1_000 * MS)
        }
    };
    let unaligned = AccountContext {
        path: ChannelPath::Gateway { alignment: None },
        ..same_clock(1_000 * MS)
    };
    for (context, reason) in [
        (unaligned, UNALIGNED),
        (AccountContext::new(ChannelPath::SharedMemory), STAYS),
    ] {
        let found = told(&files.records(), &context);
        assert_eq!(found.service, Metric::unavailable(reason));
        assert_eq!(found.verdict, DemandVerdict::NotJudged);
    }
    let found = told(&files.records(), &alignment(30_000_000));
    let found = measured(&found);
    assert_eq!((found.in_time_count, found.unknown_count), (0, 4));
}

/// Down time on the service's clock by the definition, for messages of which each is known.
fn down_by_definition(messages: &[(i64, Option<i64>)], end_ns: i64) -> i64 {
    let allowed_ns = 44 * MS;
    let mut spans: Vec<[i64; 2]> = Vec::new();
    for (index, (at_ns, came_ns)) in messages.iter().enumerate() {
        if came_ns.is_none() {
            let later = messages[index + 1..]
                .iter()
                .filter_map(|(_, came_ns)| *came_ns);
            spans.push([
                at_ns + allowed_ns,
                later.min().unwrap_or(i64::MAX).min(end_ns),
            ]);
        }
    }
    spans.sort_unstable();
    let (mut total_ns, mut told_ns) = (0, 0);
    for [from_ns, until_ns] in spans {
        let from_ns = from_ns.max(told_ns);
        total_ns += (until_ns - from_ns).max(0);
        told_ns = told_ns.max(until_ns);
    }
    total_ns
}

#[test]
fn down_times_are_those_of_the_definition_for_random_histories() {
    let mut down_count = 0;
    for seed in 0..400 {
        let mut stream = RandomStream::new(seed, "account.demand");
        let (mut at_ns, mut is_bad) = (0, false);
        let mut fold_messages = Vec::new();
        let mut messages = Vec::new();
        let up_to = |stream: &mut RandomStream, max: i64| {
            i64::try_from(stream.next_u64() % max.unsigned_abs()).unwrap()
        };
        for _ in 0..300 {
            is_bad ^= stream.chance(if is_bad { 0.25 } else { 0.05 });
            let is_lost = stream.chance(if is_bad { 0.9 } else { 0.05 });
            let delay_ns = up_to(&mut stream, 22 * MS);
            let transfer = if is_lost {
                Transfer::Lost
            } else {
                Transfer::Received {
                    delay_ns,
                    bound_ns: 0,
                }
            };
            let is_in_time = !is_lost && delay_ns <= 20 * MS;
            messages.push((at_ns, is_in_time.then_some(at_ns + delay_ns)));
            fold_messages.push((at_ns, transfer));
            at_ns += up_to(&mut stream, 32 * MS);
        }
        let end_ns = at_ns + 22 * MS;
        let mut fold = DemandFold::new(
            &demand(),
            Some(RunSpan {
                start: Instant::ZERO,
                end: Instant::from_ns(end_ns),
            }),
        );
        for (at_ns, transfer) in fold_messages {
            fold.offer(Some(at_ns), 1, transfer);
        }
        let found = fold.finish();
        let found = measured(&found);
        assert_eq!(
            found.down_ns,
            down_by_definition(&messages, found.asked_ns),
            "seed {seed}"
        );
        assert_eq!(found.down_ns_max, found.down_ns);
        assert_eq!(found.asked_ns + found.idle_ns, end_ns);
        down_count += found.failure_count;
    }
    assert!(down_count > 1_000, "{down_count}");
}
