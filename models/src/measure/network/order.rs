//! Reordering as in RFC 4737: which messages came after a later one, and how far they were
//! displaced. Copies of a message do not count.

use serde::{Deserialize, Serialize};

use super::delay::at_share;
use super::{Crossing, Figure, Passage};

/// Reordering of the messages that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OrderFigures {
    /// Messages that arrived, copies left out.
    pub count: u64,
    /// Of these, those that came after one with a higher number (RFC 4737, section 3.3).
    pub reordered_count: u64,
    /// Their share (RFC 4737, section 4.1).
    pub ratio: f64,
    /// Median extent: how many messages that came before it should have come after (RFC 4737,
    /// section 4.2), counted in places to the earliest of them; `None` without reordering.
    pub extent_p50: Option<u64>,
    /// Largest extent: the places a receiver's buffer needs to restore the order; `None` without
    /// reordering.
    pub extent_max: Option<u64>,
}

pub(super) fn order(passages: &[Passage]) -> Figure<OrderFigures> {
    let mut arrivals: Vec<((u32, u64), i64)> = passages
        .iter()
        .filter(|one| one.crossing == Crossing::Arrived)
        .filter_map(|one| Some(((one.epoch_rank, one.sequence), one.received_ns?)))
        .collect();
    if arrivals.is_empty() {
        return Figure::unavailable("no message is known to have arrived");
    }
    // Passages come in the order of their numbers, and equal times keep it.
    arrivals.sort_by_key(|arrival| arrival.1);
    let mut extents: Vec<i64> = extents(arrivals.iter().map(|arrival| arrival.0))
        .into_iter()
        .map(|(_, extent)| i64::try_from(extent).unwrap_or(i64::MAX))
        .collect();
    extents.sort_unstable();
    let largest = extents.last().copied();
    let median = largest.map(|_| at_share(&extents, 0.5));
    Figure::Measured(OrderFigures {
        count: arrivals.len() as u64,
        reordered_count: extents.len() as u64,
        ratio: extents.len() as f64 / arrivals.len() as f64,
        extent_p50: median.map(i64::unsigned_abs),
        extent_max: largest.map(i64::unsigned_abs),
    })
}

/// Place of arrival and extent of every reordered one of `keys`, which come in the order of
/// arrival.
pub(super) fn extents<K: Ord + Copy>(keys: impl Iterator<Item = K>) -> Vec<(usize, usize)> {
    // The places at which a higher number than any before came; numbers ascend among them.
    let mut records: Vec<(K, usize)> = Vec::new();
    let mut found = Vec::new();
    for (place, key) in keys.enumerate() {
        match records.last() {
            Some((highest, _)) if key < *highest => {
                let earliest = records.partition_point(|record| record.0 <= key);
                found.push((place, place - records[earliest].1));
            }
            _ => records.push((key, place)),
        }
    }
    found
}
