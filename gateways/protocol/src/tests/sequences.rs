//! The sequence window against a model that remembers everything.

use std::collections::{BTreeMap, BTreeSet};

use hil_core::random::RandomStream;

use crate::sequence::{
    BURST_LENGTH_MAX, Order, SequenceCounts, SequenceWindow, Stream, WINDOW_LENGTH,
};

const STREAM: Stream = Stream {
    session: 1,
    epoch: 1,
};

/// Remembers every number of one stream.
#[derive(Default)]
struct Model {
    seen: BTreeSet<u64>,
    counts: SequenceCounts,
}

impl Model {
    fn record(&mut self, sequence: u64) -> Order {
        let Some(&highest) = self.seen.last() else {
            self.seen.insert(sequence);
            self.counts.received_count += 1;
            return Order::InOrder { gap: 0 };
        };
        if sequence + WINDOW_LENGTH <= highest {
            self.counts.late_count += 1;
            return Order::Late;
        }
        if !self.seen.insert(sequence) {
            self.counts.duplicate_count += 1;
            return Order::Duplicate;
        }
        self.counts.received_count += 1;
        if sequence < highest {
            self.counts.reordered_count += 1;
            return Order::Reordered;
        }
        Order::InOrder {
            gap: sequence - highest - 1,
        }
    }

    fn finish(mut self) -> SequenceCounts {
        let mut bursts = BTreeMap::new();
        let mut previous = None;
        for &sequence in &self.seen {
            let missing = previous.map_or(0, |previous| sequence - previous - 1);
            *bursts.entry(missing).or_insert(0) += 1;
            previous = Some(sequence);
        }
        bursts.remove(&0);
        for (length, count) in bursts {
            self.counts.lost_count += length * count;
            let index = usize::try_from(length).unwrap().min(BURST_LENGTH_MAX) - 1;
            self.counts.loss_bursts[index] += count;
            self.counts.loss_burst_length_max = self.counts.loss_burst_length_max.max(length);
        }
        self.counts
    }
}

/// Numbers 0..`sent` as a bad network hands them out: the loss comes in bursts.
fn arrivals(random: &mut RandomStream, sent: u64) -> Vec<u64> {
    let loss = random.uniform() * 0.5;
    let duplicate = random.uniform() * 0.2;
    // Some streams reorder within the window, some far beyond it.
    let spread = if random.chance(0.5) { 40.0 } else { 3000.0 };
    let mut arrivals = Vec::new();
    let mut is_lossy = false;
    for sequence in 0..sent {
        if random.chance(0.1) {
            is_lossy = !is_lossy;
        }
        let copies = 1 + u64::from(random.chance(duplicate));
        for _ in 0..copies {
            let is_first = sequence == 0;
            if !is_first && random.chance(if is_lossy { loss } else { 0.01 }) {
                continue;
            }
            let delay = if !is_first && random.chance(0.1) {
                random.uniform() * spread
            } else {
                0.0
            };
            arrivals.push((sequence as f64 + delay, sequence));
        }
    }
    arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
    arrivals.into_iter().map(|(_, sequence)| sequence).collect()
}

#[test]
fn every_number_is_received_or_lost_and_the_counts_match_a_model_that_forgets_nothing() {
    for seed in 0..200 {
        let mut random = RandomStream::new(seed, "sequence property");
        let (mut window, mut model) = (SequenceWindow::new(), Model::default());
        let arrivals = arrivals(&mut random, 5000);
        let highest = *arrivals.iter().max().unwrap();
        for (at, sequence) in (0..).zip(arrivals) {
            let order = window.record(STREAM, sequence, at);
            assert_eq!(order, model.record(sequence), "seed {seed} arrival {at}");
        }
        let outstanding = window.outstanding_count();
        let lost_before = window.counts().lost_count;
        window.finish();
        let counts = *window.counts();
        assert_eq!(counts, model.finish(), "seed {seed}");
        assert_eq!(counts.received_count + counts.lost_count, highest + 1);
        assert_eq!(counts.lost_count, lost_before + outstanding);
        let in_bursts: u64 = counts.loss_bursts.iter().sum();
        assert!(in_bursts <= counts.lost_count);
    }
}

#[test]
fn a_leap_of_any_length_is_counted_without_walking_it() {
    let mut window = SequenceWindow::new();
    window.record(STREAM, 0, 0);
    window.record(STREAM, 1, 1);
    let leap = u64::MAX;
    let order = window.record(STREAM, leap, 2);
    assert_eq!(order, Order::InOrder { gap: leap - 2 });
    assert_eq!(window.record(STREAM, leap, 3), Order::Duplicate);
    assert_eq!(window.record(STREAM, 1, 4), Order::Late);
    window.finish();
    assert_eq!(window.counts().received_count, 3);
    assert_eq!(window.counts().lost_count, leap - 2);
    assert_eq!(window.counts().loss_burst_length_max, leap - 2);
}

#[test]
fn each_step_length_around_the_window_loses_exactly_what_it_skips() {
    for step in [1, 2, 1022, 1023, 1024, 1025, 1026, 2048, 5000] {
        for start in [0, 1, 500, 1023, 1024, 1_000_000] {
            let mut window = SequenceWindow::new();
            window.record(STREAM, start, 0);
            window.record(STREAM, start + step, 1);
            window.finish();
            assert_eq!(window.counts().lost_count, step - 1, "{start} + {step}");
            assert_eq!(window.counts().received_count, 2);
        }
    }
}

#[test]
fn a_restart_of_the_producer_is_a_restart_and_not_a_loss() {
    let mut window = SequenceWindow::new();
    let again = Stream { epoch: 2, ..STREAM };
    for sequence in 0..100 {
        window.record(STREAM, 7000 + sequence, 0);
    }
    for sequence in 0..100 {
        window.record(again, sequence, 1);
    }
    window.finish();
    assert_eq!(window.counts().restart_count, 1);
    assert_eq!(window.counts().lost_count, 0);
    assert_eq!(window.counts().received_count, 200);
}

#[test]
fn the_first_messages_of_a_restarted_producer_count_when_they_are_lost() {
    let mut window = SequenceWindow::new();
    let again = Stream { epoch: 2, ..STREAM };
    window.record(STREAM, 7000, 0);
    assert_eq!(window.record(again, 3, 1), Order::InOrder { gap: 3 });
    assert_eq!(window.record(again, 1, 2), Order::Reordered);
    window.finish();
    assert_eq!(window.counts().lost_count, 2);
}

#[test]
fn a_message_of_the_stream_before_is_late_and_changes_nothing() {
    let mut window = SequenceWindow::new();
    let again = Stream { epoch: 2, ..STREAM };
    window.record(STREAM, 0, 10);
    window.record(again, 0, 20);
    assert_eq!(window.record(STREAM, 1, 11), Order::Late);
    assert_eq!(window.record(again, 1, 21), Order::InOrder { gap: 0 });
    assert_eq!(window.counts().restart_count, 1);
}

#[test]
fn one_corrupted_epoch_does_not_end_a_stream_for_good() {
    let mut window = SequenceWindow::new();
    let corrupted = Stream {
        epoch: 0x8000_0001,
        ..STREAM
    };
    window.record(STREAM, 0, 10);
    window.record(corrupted, 1, 11);
    assert_eq!(window.record(STREAM, 2, 12), Order::InOrder { gap: 2 });
    assert_eq!(window.record(STREAM, 3, 13), Order::InOrder { gap: 0 });
}

#[test]
fn what_the_sender_announced_and_never_came_is_lost_at_the_end() {
    let mut window = SequenceWindow::new();
    window.record(STREAM, 0, 0);
    window.announce_end(STREAM, 6);
    window.finish();
    assert_eq!(window.counts().lost_count, 5);
    assert_eq!(window.counts().loss_bursts[4], 1);
}
