//! The account recovers random fates exactly, attributes losses to interruptions, and copes with
//! a million messages.

use core::time::Duration;

use super::synthetic::{Files, PERIOD_NS, Written, at, same_clock};
use super::*;
use hil_core::random::RandomStream;

const MS: i64 = 1_000_000;

/// The fates a message can be written with in the middle of a run.
const WRITABLE: [MessageFate; 10] = [
    MessageFate::Taken,
    MessageFate::SupersededAtInput,
    MessageFate::RefusedByKernel,
    MessageFate::LostOnWire,
    MessageFate::Incomplete,
    MessageFate::RefusedAtIngress,
    MessageFate::Late,
    MessageFate::Duplicate,
    MessageFate::SupersededAtConsumer,
    MessageFate::Unexplained,
];

fn kill(place: PathProcess, from_ns: i64, until_ns: i64) -> Interruption {
    Interruption {
        process: format!("{place:?}"),
        place,
        from: Instant::from_ns(from_ns),
        until: Instant::from_ns(until_ns),
        cause: "killed by signal 9".to_owned(),
    }
}

/// Writes several starts of a producer with random fates; the last messages are in flight.
fn random_run(seed: u64) -> (Files, FateCounts, Vec<BurstCount>, i64) {
    let mut stream = RandomStream::new(seed, "fates");
    let (mut files, mut fates) = (Files::default(), FateCounts::default());
    let (mut bursts, mut burst) = (std::collections::BTreeMap::new(), 0_u64);
    let mut now_ns = 0;
    let taken_ratio = stream.uniform();
    for epoch in [70, 4, 900] {
        let count = 1 + stream.next_u64() % 400;
        let mut end_burst = |burst: &mut u64| {
            if *burst > 0 {
                *bursts.entry(*burst).or_insert(0) += 1;
            }
            *burst = 0;
        };
        for sequence in 0..count {
            // The last message of each start arrives, so that "a later one was taken" holds.
            let fate = if sequence + 1 == count || stream.chance(taken_ratio) {
                MessageFate::Taken
            } else {
                WRITABLE[usize::try_from(stream.next_u64() % WRITABLE.len() as u64).unwrap()]
            };
            let published_ns = now_ns;
            files.write(
                Written {
                    epoch,
                    sequence,
                    published_ns,
                },
                fate,
            );
            fates.add(fate, 1);
            if fate.is_loss() {
                burst += 1;
            } else {
                end_burst(&mut burst);
            }
            now_ns += PERIOD_NS;
        }
        end_burst(&mut burst);
    }
    // The run goes on long enough that nothing above can still be travelling.
    now_ns += 100 * MS;
    for index in (0..stream.next_u64() % 4).rev() {
        let published_ns = now_ns - 1 - i64::try_from(index).unwrap() * 10;
        let sequence = files.published.last().unwrap().sequence + 1;
        files.write(
            Written {
                epoch: 900,
                sequence,
                published_ns,
            },
            MessageFate::InFlight,
        );
        fates.add(MessageFate::InFlight, 1);
    }
    let bursts = bursts
        .into_iter()
        .map(|(length_messages, count)| BurstCount {
            length_messages,
            count,
        })
        .collect();
    (files, fates, bursts, now_ns)
}

fn shuffle<T>(records: &mut [T], stream: &mut RandomStream) {
    for index in (1..records.len()).rev() {
        let other = stream.next_u64() % (index as u64 + 1);
        records.swap(index, usize::try_from(other).unwrap());
    }
}

#[test]
fn random_fates_are_recovered_exactly_whatever_the_order_of_the_records() {
    for seed in 0..300 {
        let (mut files, fates, bursts, end_ns) = random_run(seed);
        let context = same_clock(end_ns);
        let ordered = account(&files.records(), &context);
        assert_eq!(ordered.fates, fates, "seed {seed}");
        assert_eq!(ordered.loss_bursts, bursts, "seed {seed}");
        assert_eq!(ordered.producer_restart_count, 2, "seed {seed}");
        let closing = ordered.closing.checked().unwrap();
        assert_eq!(
            closing.closed_count,
            fates.of(MessageFate::Taken),
            "seed {seed}"
        );
        let mut stream = RandomStream::new(seed, "shuffle");
        shuffle(&mut files.egress, &mut stream);
        shuffle(&mut files.ingress, &mut stream);
        shuffle(&mut files.published, &mut stream);
        let shuffled = account(&files.records(), &context);
        assert_eq!(shuffled.fates, fates, "seed {seed}");
        assert_eq!(shuffled.segments, ordered.segments, "seed {seed}");
    }
}

#[test]
fn every_combination_of_missing_files_keeps_the_sum() {
    let (files, fates, _, end_ns) = random_run(1);
    for mask in 0..16_u32 {
        let whole = files.records();
        let records = ChannelRecords {
            published: whole.published.filter(|_| mask & 0b1 == 0),
            egress: whole.egress.filter(|_| mask & 0b10 == 0),
            ingress: whole.ingress.filter(|_| mask & 0b100 == 0),
            taken: whole.taken.filter(|_| mask & 0b1000 == 0),
        };
        let account = account(&records, &same_clock(end_ns));
        assert_eq!(
            account.fates.total(),
            account.published_count,
            "mask {mask}"
        );
        assert!(account.published_count <= fates.total(), "mask {mask}");
        let unknown = account.fates.of(MessageFate::UnknownPeerRecordsUnavailable);
        if mask & 0b1110 == 0 {
            assert_eq!(unknown, 0, "mask {mask}");
        }
        if mask & 0b1000 == 0 {
            let taken = account.fates.of(MessageFate::Taken);
            assert_eq!(taken, fates.of(MessageFate::Taken), "mask {mask}");
        } else {
            assert_eq!(account.fates.of(MessageFate::Taken), 0, "mask {mask}");
            assert!(account.closing.checked().is_none(), "mask {mask}");
        }
    }
}

/// A run of one second at 1 kHz in which one process is down from 400 ms to 650 ms.
fn run_with_kill(place: PathProcess, fate_while_down: MessageFate) -> ChannelAccount {
    let mut files = Files::default();
    for sequence in 0..1_000 {
        let fate = match sequence {
            400..650 => fate_while_down,
            // A loss far from the kill stays a loss on the wire.
            200 | 800..803 => MessageFate::LostOnWire,
            _ => MessageFate::Taken,
        };
        files.write(at(1, sequence), fate);
    }
    let interruptions = [kill(place, 400 * MS - 1, 650 * MS - 1)];
    let context = AccountContext {
        flight_time_max: Duration::from_millis(5),
        ..same_clock(1_000 * MS).with_interruptions(&interruptions)
    };
    account(&files.records(), &context)
}

#[test]
fn losses_and_silence_during_a_kill_are_attributed_to_it() {
    for (place, fate_while_down) in [
        (PathProcess::SendingGateway, MessageFate::SupersededAtInput),
        (PathProcess::ReceivingGateway, MessageFate::LostOnWire),
        (PathProcess::ReceivingGateway, MessageFate::RefusedByKernel),
        (PathProcess::Consumer, MessageFate::SupersededAtConsumer),
    ] {
        let account = run_with_kill(place, fate_while_down);
        assert_eq!(
            account.fates.of(MessageFate::LostInInterruption),
            250,
            "{place:?}"
        );
        assert_eq!(account.fates.of(MessageFate::LostOnWire), 4, "{place:?}");
        assert_eq!(account.fates.of(MessageFate::Taken), 746, "{place:?}");
        let cost = &account.interruptions[0];
        assert_eq!((cost.lost_count, cost.length_ns), (250, 250 * MS));
        assert_eq!(cost.cause, "killed by signal 9");
        let gap = cost.gap.unwrap();
        assert_eq!((gap.length_ns, gap.after_sequence), (250 * MS, 399));
        assert_eq!(account.gaps.longest, Some(gap));
        let other = account.gaps.longest_unattributed.unwrap();
        assert_eq!((other.length_ns, other.after_sequence), (3 * MS, 799));
    }
}

#[test]
fn a_process_beyond_the_loss_is_not_blamed() {
    // The consumer was down, but these messages never reached its host.
    let account = run_with_kill(PathProcess::Consumer, MessageFate::LostOnWire);
    assert_eq!(account.fates.of(MessageFate::LostInInterruption), 0);
    assert_eq!(account.fates.of(MessageFate::LostOnWire), 254);
    // The sending gateway was down, but these had left its host.
    let account = run_with_kill(
        PathProcess::SendingGateway,
        MessageFate::SupersededAtConsumer,
    );
    assert_eq!(account.fates.of(MessageFate::LostInInterruption), 0);
}

#[test]
fn a_killed_producer_leaves_an_attributed_gap_and_no_loss() {
    let mut files = Files::default();
    for sequence in 0..300 {
        files.write(at(1, sequence), MessageFate::Taken);
    }
    for sequence in 0..300 {
        let published_ns = 700 * MS + at(2, sequence).published_ns;
        files.write(
            Written {
                epoch: 2,
                sequence,
                published_ns,
            },
            MessageFate::Taken,
        );
    }
    // The records of the last instants died with the producer.
    files
        .published
        .retain(|record| record.epoch == 2 || record.sequence < 290);
    let interruptions = [kill(PathProcess::Producer, 300 * MS, 690 * MS)];
    // Publication times carry the attribution, so no alignment is needed.
    let path = ChannelPath::Gateway { alignment: None };
    let context = AccountContext::new(path).with_interruptions(&interruptions);
    let account = account(&files.records(), &context);
    assert_eq!(account.fates.of(MessageFate::Taken), 600);
    assert_eq!(account.published_unrecorded_count, Some(10));
    assert_eq!(account.producer_restart_count, 1);
    let gap = account.interruptions[0].gap.unwrap();
    assert_eq!((gap.length_ns, gap.after_sequence), (401 * MS, 299));
    assert_eq!(account.gaps.longest_unattributed.unwrap().length_ns, 0);
}

#[test]
fn an_unaligned_receiver_attributes_by_its_own_clock() {
    let mut files = Files::default();
    for sequence in 0..1_000 {
        let is_down = (400..650).contains(&sequence);
        let fate = if is_down {
            MessageFate::LostOnWire
        } else {
            MessageFate::Taken
        };
        files.write(at(1, sequence), fate);
    }
    let interruptions = [kill(
        PathProcess::ReceivingGateway,
        400 * MS - 1,
        650 * MS - 1,
    )];
    let path = ChannelPath::Gateway { alignment: None };
    let context = AccountContext::new(path).with_interruptions(&interruptions);
    let whole = account(&files.records(), &context);
    assert_eq!(whole.fates.of(MessageFate::LostInInterruption), 250);
    // Even without any record of the sender: nobody saw these messages, but their numbers.
    let alone = ChannelRecords {
        published: None,
        egress: None,
        ..files.records()
    };
    let alone = account(&alone, &context);
    assert_eq!(alone.fates.of(MessageFate::LostInInterruption), 250);
    assert_eq!(alone.fates.total(), 1_000);
}

#[test]
fn a_follow_up_belongs_to_the_start_of_the_producer_it_came_with() {
    let mut files = Files::default();
    for (epoch, start_ns, count) in [(1, 0, 20), (2, 100 * MS, 50)] {
        for sequence in 0..count {
            let published_ns = start_ns + at(epoch, sequence).published_ns;
            files.write(
                Written {
                    epoch,
                    sequence,
                    published_ns,
                },
                MessageFate::Taken,
            );
        }
    }
    let records = ChannelRecords {
        published: None,
        egress: None,
        ..files.records()
    };
    let account = account(&records, &same_clock(200 * MS));
    let coverage = account.coverage.tx_software.unwrap();
    // None comes after the last of each start.
    assert_eq!((coverage.stamped_count, coverage.eligible_count), (68, 70));
}

#[test]
fn a_wild_sequence_number_neither_hangs_nor_breaks_the_sum() {
    let mut files = Files::delivered(10);
    files.write(
        Written {
            epoch: 7,
            sequence: u64::MAX,
            published_ns: 10 * PERIOD_NS,
        },
        MessageFate::Taken,
    );
    let account = account(&files.records(), &same_clock(11 * PERIOD_NS));
    assert_eq!(account.fates.of(MessageFate::Taken), 11);
    assert_eq!(account.fates.total(), account.published_count);
}

#[test]
#[ignore = "a million messages: run it with --release"]
fn a_million_messages_are_accounted_for_in_linear_time() {
    let files = Files::delivered(1_000_000);
    let account = account(&files.records(), &same_clock(1_000_000 * PERIOD_NS));
    assert_eq!(account.closing.checked().unwrap().closed_count, 1_000_000);
}
