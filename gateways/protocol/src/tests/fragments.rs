//! Splitting and putting together, with every order, loss and lie.

use core::time::Duration;

use hil_core::random::RandomStream;
use hil_core::time::Instant;

use crate::fragment::{FRAGMENT_COUNT_MAX, FragmentPlan, Reassembler};
use crate::ingress::Piece;
use crate::lab::InMemory;
use crate::refusal::Refusal;
use crate::wire::{HEADER_BYTES, Header, Kind, TAG_BYTES};

const TIMEOUT: Duration = Duration::from_millis(10);

#[derive(Clone, Copy)]
struct Fragment<'a> {
    header: Header,
    payload: &'a [u8],
}

fn pieces(sequence: u64, message: &[u8], budget: usize) -> Vec<Fragment<'_>> {
    let plan = FragmentPlan::new(message.len(), budget).unwrap();
    (0..plan.count())
        .map(|index| Fragment {
            header: Header {
                sequence,
                total_len: u32::try_from(message.len()).unwrap(),
                fragment_index: index,
                fragment_count: plan.count(),
                handed_ns: 100 + i64::from(index),
                epoch: 1,
                ..Header::new(Kind::Data, 1, 0)
            },
            payload: &message[plan.range(index).unwrap()],
        })
        .collect()
}

fn message(length: usize, seed: u64) -> Vec<u8> {
    let mut random = RandomStream::new(seed, "message");
    (0..length)
        .map(|_| random.next_u64().to_le_bytes()[0])
        .collect()
}

/// A reassembler with the memory of its messages.
struct Assembly {
    reassembler: Reassembler,
    memory: InMemory,
}

impl Assembly {
    fn new(slot_count: usize, size_max_bytes: usize) -> Self {
        Self {
            reassembler: Reassembler::new(0, slot_count, size_max_bytes, TIMEOUT),
            memory: InMemory::default(),
        }
    }

    /// Takes one piece; gives the message once it is whole, and when it was handed over.
    fn insert(
        &mut self,
        now: Instant,
        fragment: &Fragment<'_>,
    ) -> Result<Option<(Vec<u8>, i64)>, Refusal> {
        let (header, payload) = (&fragment.header, fragment.payload);
        let place = self.reassembler.place(now, header, payload.len())?;
        let slot = place.slot;
        self.memory.store(&Piece {
            channel: 0,
            slot,
            is_first: place.is_first,
            offset_bytes: place.offset_bytes,
            payload,
        });
        Ok(self.reassembler.stored(place).map(|whole| {
            let bytes = self.memory.message(0, slot);
            assert_eq!(bytes.len(), whole.length_bytes);
            (bytes.to_vec(), whole.message.handed.as_ns())
        }))
    }
}

fn shuffle<T>(random: &mut RandomStream, items: &mut [T]) {
    for last in (1..items.len()).rev() {
        let other = usize::try_from(random.next_u64() % (last as u64 + 1)).unwrap();
        items.swap(last, other);
    }
}

#[test]
fn the_longest_message_passes_the_narrowest_path() {
    let ipv6_and_udp = 48;
    let budget = 576 - ipv6_and_udp - HEADER_BYTES - TAG_BYTES;
    assert!(FragmentPlan::new(16 << 20, budget).is_some());
}

#[test]
fn a_cut_covers_every_byte_once_and_the_receiver_finds_the_same_cut() {
    for total in (0..3000).chain([65_535, 65_536, 100_000]) {
        for budget in [1, 2, 3, 7, 64, 512, 1400, 70_000] {
            let Some(plan) = FragmentPlan::new(total, budget) else {
                assert!(total > budget * FRAGMENT_COUNT_MAX);
                continue;
            };
            let mut end = 0;
            for index in 0..plan.count() {
                let range = plan.range(index).unwrap();
                assert_eq!(range.start, end, "{total} by {budget}");
                assert!(range.len() <= budget);
                assert!(!range.is_empty() || total == 0);
                end = range.end;
            }
            assert_eq!(end, total);
            assert_eq!(plan.range(plan.count()), None);
            let total_len = u32::try_from(total).unwrap();
            assert_eq!(FragmentPlan::from_wire(total_len, plan.count()), Some(plan));
        }
    }
    assert_eq!(FragmentPlan::new(10, 0), None);
    assert_eq!(FragmentPlan::from_wire(5, 0), None);
    assert_eq!(FragmentPlan::from_wire(5, 4), None);
    assert_eq!(FragmentPlan::from_wire(u32::MAX, 40_001), None);
}

#[test]
fn pieces_in_any_order_and_interleaved_come_together() {
    for seed in 0..50 {
        let mut random = RandomStream::new(seed, "reassembly");
        let mut assembly = Assembly::new(3, 4000);
        let messages: Vec<_> = (0..3).map(|m| message(3000 + m, seed)).collect();
        let mut all: Vec<_> = (0..)
            .zip(&messages)
            .flat_map(|(sequence, message)| pieces(sequence, message, 97))
            .collect();
        shuffle(&mut random, &mut all);
        let mut completed = 0;
        for piece in &all {
            let whole = assembly.insert(Instant::ZERO, piece).unwrap();
            if let Some((bytes, handed_ns)) = whole {
                let index = usize::try_from(piece.header.sequence).unwrap();
                assert_eq!(bytes, messages[index], "seed {seed}");
                assert_eq!(handed_ns, 100);
                completed += 1;
            }
        }
        assert_eq!(completed, 3);
        assert_eq!(assembly.reassembler.open_count(), 0);
    }
}

#[test]
fn a_second_copy_of_a_piece_is_refused_and_changes_nothing() {
    let whole = message(300, 1);
    let mut forged = whole.clone();
    forged[0] ^= 0xff;
    let mut assembly = Assembly::new(1, 300);
    let (good, bad) = (pieces(0, &whole, 100), pieces(0, &forged, 100));
    assert_eq!(assembly.insert(Instant::ZERO, &good[0]), Ok(None));
    let refused = Err(Refusal::DuplicateFragment);
    assert_eq!(assembly.insert(Instant::ZERO, &bad[0]), refused);
    assert_eq!(assembly.insert(Instant::ZERO, &good[1]), Ok(None));
    let assembled = assembly.insert(Instant::ZERO, &good[2]).unwrap();
    assert_eq!(assembled.unwrap().0, whole);
}

#[test]
fn pieces_that_contradict_the_first_one_or_the_bound_are_refused() {
    let whole = message(300, 1);
    let mut assembly = Assembly::new(1, 300);
    let good = pieces(0, &whole, 100);
    assert_eq!(assembly.insert(Instant::ZERO, &good[0]), Ok(None));
    let other_cut = pieces(0, &whole, 60);
    let other_length = pieces(0, &whole[..299], 100);
    let refused = Err(Refusal::FragmentInconsistent);
    assert_eq!(assembly.insert(Instant::ZERO, &other_cut[1]), refused);
    assert_eq!(assembly.insert(Instant::ZERO, &other_length[1]), refused);
    let long = message(301, 1);
    let refused = Err(Refusal::Oversize);
    assert_eq!(
        assembly.insert(Instant::ZERO, &pieces(1, &long, 100)[0]),
        refused
    );
    let mut short = good[1];
    short.payload = &short.payload[1..];
    assert_eq!(
        assembly.insert(Instant::ZERO, &short),
        Err(Refusal::LengthMismatch)
    );
    assert_eq!(assembly.reassembler.counts().started_count, 1);
}

#[test]
fn the_oldest_incomplete_message_gives_way_and_is_counted() {
    let whole = message(200, 1);
    let mut assembly = Assembly::new(2, 200);
    for sequence in 0..5 {
        let now = Instant::from_ns(i64::try_from(sequence).unwrap());
        let piece = pieces(sequence, &whole, 100)[0];
        assert_eq!(assembly.insert(now, &piece), Ok(None));
    }
    let counts = *assembly.reassembler.counts();
    assert_eq!((counts.started_count, counts.evicted_count), (5, 3));
    // The two newest are still there.
    for sequence in 3..5 {
        let piece = pieces(sequence, &whole, 100)[1];
        assert!(
            assembly
                .insert(Instant::from_ns(9), &piece)
                .unwrap()
                .is_some()
        );
    }
}

#[test]
fn an_incomplete_message_is_given_up_in_time() {
    let whole = message(200, 1);
    let mut assembly = Assembly::new(2, 200);
    let halves = pieces(0, &whole, 100);
    assert_eq!(assembly.insert(Instant::ZERO, &halves[0]), Ok(None));
    let due = assembly.reassembler.next_expiry().unwrap();
    assert_eq!(due, Instant::ZERO + TIMEOUT);
    assembly
        .reassembler
        .expire(Instant::from_ns(due.as_ns() - 1));
    assert_eq!(assembly.reassembler.open_count(), 1);
    assert_eq!(assembly.insert(due, &halves[1]), Ok(None));
    assert_eq!(assembly.reassembler.counts().timed_out_count, 1);
    assert_eq!(assembly.reassembler.counts().completed_count, 0);
}

#[test]
fn a_piece_that_was_not_stored_is_missing_until_it_comes_again() {
    let whole = message(200, 1);
    let mut assembly = Assembly::new(1, 200);
    let halves = pieces(0, &whole, 100);
    let (header, payload) = (&halves[0].header, halves[0].payload);
    let reassembler = &mut assembly.reassembler;
    let place = reassembler.place(Instant::ZERO, header, payload.len());
    assert!(place.unwrap().is_first);
    assert_eq!(assembly.insert(Instant::ZERO, &halves[1]), Ok(None));
    let again = assembly.insert(Instant::ZERO, &halves[0]).unwrap();
    assert_eq!(again, Some((whole, 100)));
}
