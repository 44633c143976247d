//! Reordering as in RFC 4737: which messages came after a later one, and how far they were
//! displaced. Copies of a message do not count.

use serde::{Deserialize, Serialize};

use super::{Metric, Passages, is_arrived};
use hil_stats::in_order::in_order;
use hil_stats::reordering::reordered;
use hil_stats::special::place_of;

/// Reordering of the messages that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OrderMetrics {
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
    /// Largest n for which a message is n-reordered: the n right before it should all have come after it
    /// (RFC 4737, section 5); `None` without reordering.
    #[serde(default)]
    pub n_max: Option<u64>,
}

impl OrderMetrics {
    /// Of messages by their numbers in the order in which they were sent, as they arrived; `None` without any.
    pub fn of(numbers: impl Iterator<Item = u64>) -> Option<Self> {
        let (found, count) = reordered(numbers);
        let n_max = found.iter().map(|one| one.n).max();
        let mut extents: Vec<u64> = found.into_iter().map(|one| one.extent).collect();
        extents.sort_unstable();
        let largest = extents.last().copied();
        let median = largest.map(|_| extents[place_of(0.5, extents.len())]);
        (count > 0).then(|| Self {
            count,
            reordered_count: extents.len() as u64,
            ratio: extents.len() as f64 / count as f64,
            extent_p50: median,
            extent_max: largest,
            n_max,
        })
    }
}

pub(super) fn order(passages: &Passages) -> Metric<OrderMetrics> {
    OrderMetrics::of(arrivals(passages).map(|(_, number)| number)).map_or_else(
        || Metric::unavailable("no message is known to have arrived"),
        Metric::Measured,
    )
}

/// When each message that arrived did, in the order of arrival, and its number among them in the order
/// in which they were sent. Equal times keep that order.
pub(super) fn arrivals(passages: &Passages) -> impl Iterator<Item = (i64, u64)> + use<'_> {
    in_order(move || {
        let arrived = passages.each().filter(is_arrived);
        arrived.filter_map(|one| one.received_ns).zip(0..)
    })
}
