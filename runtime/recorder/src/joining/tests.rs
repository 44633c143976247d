//! Stamps in the orders in which processes and networks bring them, and what is made of them.

use super::*;
use hil_core::record::{IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE};

const MS: u64 = 1_000_000;
const HOLD_MS: u64 = HOLD_NS.unsigned_abs() / MS;

/// Message `sequence` of a channel that publishes each millisecond.
fn published(sequence: u64) -> Record {
    published_at(sequence, (sequence * MS).cast_signed())
}

fn published_at(sequence: u64, published_ns: i64) -> Record {
    Record::Published(PublishedRecord {
        sequence,
        published_ns,
        epoch: 1,
        reserved: 0,
    })
}

fn taken(sequence: u64) -> Record {
    let published_ns = (sequence * MS).cast_signed();
    Record::Taken(TakenRecord {
        sequence,
        published_ns,
        forwarded_ns: UNAVAILABLE,
        taken_ns: published_ns + 30,
        epoch: 1,
        reserved: 0,
    })
}

fn received(sequence: u64) -> Record {
    let published_ns = (sequence * MS).cast_signed();
    Record::Ingress(IngressRecord {
        sequence,
        published_ns,
        received_ns: published_ns + 20,
        epoch: 1,
        ..bytemuck::Zeroable::zeroed()
    })
}

fn local() -> Joining {
    Joining::new(&[Stage::Published, Stage::Taken])
}

fn take_all(joining: &mut Joining, records: impl IntoIterator<Item = Record>) {
    let now = Instant::now();
    for record in records {
        joining.take(&record, true, now);
    }
}

/// Numbers of what is given out, and whether it was taken.
fn given(joining: &mut Joining) -> Vec<(u64, bool)> {
    let given = core::iter::from_fn(|| joining.next());
    given
        .map(|one| (one.sequence, one.taken_ns.is_some()))
        .collect()
}

fn counted(joining: &Joining) -> (u64, u64) {
    (joining.late_count, joining.unordered_count)
}

#[test]
fn a_message_taken_before_one_that_was_replaced_is_heard_of_comes_after_it() {
    let mut joining = local();
    // The consumer's stamps come first: 1 replaced 0, of which only its producer tells.
    take_all(&mut joining, [taken(1), taken(2)]);
    take_all(&mut joining, (0..3).map(published));
    assert!(given(&mut joining).is_empty(), "more may come");
    let later = HOLD_MS + 1;
    take_all(&mut joining, [taken(later), published(later)]);
    assert_eq!(given(&mut joining), [(0, false), (1, true)]);
    take_all(&mut joining, [taken(later + 1), published(later + 1)]);
    assert_eq!(given(&mut joining), [(2, true)]);
    assert_eq!(counted(&joining), (0, 0));
}

#[test]
fn what_a_network_put_out_of_order_comes_in_order() {
    let mut joining = Joining::new(&[Stage::Received, Stage::Taken]);
    for sequence in [0, 2, 3, 1, 4] {
        take_all(&mut joining, [received(sequence), taken(sequence)]);
        assert!(given(&mut joining).is_empty());
    }
    take_all(&mut joining, [received(HOLD_MS + 4), taken(HOLD_MS + 4)]);
    let expected: Vec<(u64, bool)> = (0..5).map(|sequence| (sequence, true)).collect();
    assert_eq!(given(&mut joining), expected);
    // Later than it is held back: out of order, and counted.
    take_all(&mut joining, [received(2 * HOLD_MS), taken(2 * HOLD_MS)]);
    assert_eq!(
        given(&mut joining).len(),
        0,
        "published just {HOLD_MS} ms before"
    );
    take_all(&mut joining, [received(3 * HOLD_MS), taken(3 * HOLD_MS)]);
    assert_eq!(given(&mut joining).len(), 2);
    take_all(&mut joining, [received(HOLD_MS + 3), taken(HOLD_MS + 3)]);
    assert_eq!(given(&mut joining), [(HOLD_MS + 3, true)]);
    assert_eq!(counted(&joining), (0, 1));
}

#[test]
fn files_that_are_caught_up_with_one_after_the_other_lose_nothing() {
    let mut joining = local();
    let mut all = Vec::new();
    // Much later than either is held back, by the clock of the wall too.
    for piece in 0..8 {
        let numbers = piece * 1000..(piece + 1) * 1000;
        take_all(&mut joining, numbers.clone().map(published));
        all.extend(given(&mut joining));
        // Half of them were replaced.
        take_all(&mut joining, numbers.step_by(2).map(taken));
        all.extend(given(&mut joining));
    }
    all.extend(
        core::iter::from_fn(|| joining.earliest())
            .map(|one| (one.sequence, one.taken_ns.is_some())),
    );
    let expected: Vec<(u64, bool)> = (0..8000).map(|one| (one, one % 2 == 0)).collect();
    assert!(all == expected);
    assert_eq!(counted(&joining), (0, 0));
}

#[test]
fn when_nothing_more_is_read_a_whole_message_is_held_for_a_moment_and_another_for_longer() {
    let mut joining = local();
    let start = Instant::now();
    for record in [published(0), taken(0), published(1)] {
        joining.take(&record, true, start);
    }
    assert!(joining.next_held(start + HOLD / 2).is_none());
    assert_eq!(joining.next_held(start + HOLD).unwrap().sequence, 0);
    assert!(joining.next_held(start + WAIT / 2).is_none());
    let partial = joining.next_held(start + WAIT).unwrap();
    assert_eq!((partial.sequence, partial.taken_ns), (1, None));
    // Given out once, whatever comes; only stamps of this host are waited for.
    joining.take(&taken(1), true, start);
    joining.take(&taken(0), false, start);
    assert_eq!(counted(&joining), (1, 0));
    assert!(joining.earliest().is_none());
}

#[test]
fn what_another_host_sends_at_the_end_is_neither_late_nor_out_of_order_here() {
    let mut joining = Joining::new(&[Stage::Received, Stage::Taken]);
    for sequence in [1, HOLD_MS + 1, 2 * HOLD_MS + 1] {
        take_all(&mut joining, [received(sequence), taken(sequence)]);
    }
    assert_eq!(given(&mut joining).len(), 2);
    for sequence in 0..2 {
        joining.take(&published(sequence), false, Instant::now());
    }
    assert_eq!(given(&mut joining), [(0, false)]);
    assert_eq!(counted(&joining), (0, 0));
}

#[test]
fn a_damaged_time_does_not_make_the_others_late() {
    let mut joining = local();
    take_all(&mut joining, (0..10).map(published));
    take_all(&mut joining, [published_at(10, i64::MAX)]);
    take_all(&mut joining, (0..9).map(taken));
    let damaged = TakenRecord {
        sequence: 9,
        published_ns: i64::MAX,
        forwarded_ns: UNAVAILABLE,
        taken_ns: 9,
        epoch: 1,
        reserved: 0,
    };
    take_all(&mut joining, [Record::Taken(damaged)]);
    assert!(given(&mut joining).is_empty());
    take_all(&mut joining, (11..=HOLD_MS + 9).map(published));
    take_all(&mut joining, (11..=HOLD_MS + 9).map(taken));
    let expected: Vec<(u64, bool)> = (0..10).map(|sequence| (sequence, true)).collect();
    assert_eq!(given(&mut joining), expected);
    assert_eq!(counted(&joining), (0, 0));
}

#[test]
fn no_more_than_so_many_wait() {
    let mut joining = local();
    take_all(&mut joining, (0..WAITING_MAX as u64).map(published));
    assert!(joining.next().is_none());
    take_all(&mut joining, [published(WAITING_MAX as u64)]);
    assert_eq!(given(&mut joining), [(0, false)]);
}
