//! Reordering as in RFC 4737: which messages came after a later one, and how far they were
//! displaced. Copies of a message do not count.

use serde::{Deserialize, Serialize};

use super::delay::at_share;
use super::{Metric, Passages, is_arrived};
use hil_stats::in_order::in_order;

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
}

pub(super) fn order(passages: &Passages) -> Metric<OrderMetrics> {
    let (found, count) = extents(arrivals(passages).map(|(_, number)| number));
    if count == 0 {
        return Metric::unavailable("no message is known to have arrived");
    }
    let mut extents: Vec<i64> = found
        .into_iter()
        .map(|(_, extent)| i64::try_from(extent).unwrap_or(i64::MAX))
        .collect();
    extents.sort_unstable();
    let largest = extents.last().copied();
    let median = largest.map(|_| at_share(&extents, 0.5));
    Metric::Measured(OrderMetrics {
        count,
        reordered_count: extents.len() as u64,
        ratio: extents.len() as f64 / count as f64,
        extent_p50: median.map(i64::unsigned_abs),
        extent_max: largest.map(i64::unsigned_abs),
    })
}

/// When each message that arrived did, in the order of arrival, and its number among them in the order
/// in which they were sent. Equal times keep that order.
pub(super) fn arrivals(passages: &Passages) -> impl Iterator<Item = (i64, u64)> + use<'_> {
    in_order(move || {
        let arrived = passages.each().filter(is_arrived);
        arrived.filter_map(|one| one.received_ns).zip(0..)
    })
}

/// Some messages in a row that came in the order of their numbers, each higher than any before.
struct Row {
    number: u64,
    place: u64,
    length: u64,
}

/// Place of arrival and extent of every reordered one of `numbers`, which come in the order of
/// arrival; and how many they all are.
pub(super) fn extents(numbers: impl Iterator<Item = u64>) -> (Vec<(u64, u64)>, u64) {
    // The places at which a higher number than any before came; numbers ascend among them.
    let mut rows: Vec<Row> = Vec::new();
    let (mut found, mut count) = (Vec::new(), 0);
    for (number, place) in numbers.zip(0..) {
        count = place + 1;
        match rows.last_mut() {
            Some(last) if number < last.number + last.length => {
                found.push((place, place - earliest_above(&rows, number)));
            }
            Some(last)
                if number == last.number + last.length && place == last.place + last.length =>
            {
                last.length += 1;
            }
            _ => rows.push(Row {
                number,
                place,
                length: 1,
            }),
        }
    }
    (found, count)
}

/// The first place at which a number above `number` came; there is one.
fn earliest_above(rows: &[Row], number: u64) -> u64 {
    let row = &rows[rows.partition_point(|row| row.number + row.length <= number + 1)];
    row.place + (number + 1).saturating_sub(row.number)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn extents_are_counted_to_the_earliest_later_message() {
        let mut random = RandomStream::new(9, "measure.network.order");
        for reach in [1.0, 3.0, 60.0] {
            let mut arrivals: Vec<(f64, u64)> = (0..2_000_u32)
                .map(|number| (f64::from(number) + reach * random.uniform(), number.into()))
                .collect();
            arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
            let numbers: Vec<u64> = arrivals.into_iter().map(|one| one.1).collect();
            let plain: Vec<(u64, u64)> = (0..)
                .zip(&numbers)
                .filter_map(|(place, number)| {
                    let mut before = (0_u64..).zip(&numbers[..place]);
                    let (earliest, _) = before.find(|(_, other)| *other > number)?;
                    Some((place as u64, place as u64 - earliest))
                })
                .collect();
            assert_eq!(extents(numbers.into_iter()), (plain, 2_000));
        }
    }
}
