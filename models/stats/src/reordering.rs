//! Reordering as in RFC 4737: which of a series came after a later one, and how far they were displaced.
//! Copies are for the caller to leave out; RFC 5560 counts them.

/// One that came after a later one (RFC 4737, section 3.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reordered {
    /// Place of arrival.
    pub place: u64,
    /// Places to the earliest that should have come after it (section 4.2.2).
    pub extent: u64,
    /// How many right before it should all have come after it: it is n-reordered up to this n
    /// (section 5), so a sender that takes n duplicate acknowledgements for a loss would send it again.
    pub n: u64,
}

/// Some in a row that came in the order of their numbers.
struct Row {
    number: u64,
    place: u64,
    length: u64,
}

impl Row {
    const fn of(number: u64, place: u64) -> Self {
        Self {
            number,
            place,
            length: 1,
        }
    }

    /// `number` at `place` goes on from this row.
    fn takes(&mut self, number: u64, place: u64) -> bool {
        let goes_on = number == self.number + self.length && place == self.place + self.length;
        self.length += u64::from(goes_on);
        goes_on
    }
}

/// Every reordered one of `numbers`, which are distinct and come in the order of arrival; and how many
/// they all are.
pub fn reordered(numbers: impl Iterator<Item = u64>) -> (Vec<Reordered>, u64) {
    // The places at which a higher number than any before came; numbers ascend among them.
    let mut tops: Vec<Row> = Vec::new();
    // Those so far that no later arrival was below; numbers ascend among them too.
    let mut bottoms: Vec<Row> = Vec::new();
    let (mut found, mut count) = (Vec::new(), 0);
    for (number, place) in numbers.zip(0..) {
        count = place + 1;
        while bottoms.last().is_some_and(|row| row.number > number) {
            bottoms.pop();
        }
        if let Some(row) = bottoms.last_mut() {
            row.length = row.length.min(number - row.number);
        }
        let below = bottoms.last().map_or(0, |row| row.place + row.length);
        if !bottoms
            .last_mut()
            .is_some_and(|row| row.takes(number, place))
        {
            bottoms.push(Row::of(number, place));
        }
        let is_late = tops
            .last()
            .is_some_and(|row| number < row.number + row.length);
        if is_late {
            found.push(Reordered {
                place,
                extent: place - earliest_above(&tops, number),
                n: place - below,
            });
        } else if !tops.last_mut().is_some_and(|row| row.takes(number, place)) {
            tops.push(Row::of(number, place));
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

    /// By the definitions, place by place.
    fn plain(numbers: &[u64]) -> Vec<Reordered> {
        let each = (0..).zip(numbers).filter_map(|(place, number)| {
            let before = &numbers[..place];
            let earliest = before.iter().position(|other| other > number)?;
            let n = before.iter().rev().take_while(|other| *other > number);
            Some(Reordered {
                place: place as u64,
                extent: (place - earliest) as u64,
                n: n.count() as u64,
            })
        });
        each.collect()
    }

    #[test]
    fn one_and_two_late_ones_have_their_extents() {
        // 4 came late, over 5, 6, 7, 8.
        let (found, count) = reordered([1, 2, 3, 5, 6, 7, 8, 4, 9, 10].into_iter());
        let four = Reordered {
            place: 7,
            extent: 4,
            n: 4,
        };
        assert_eq!((found, count), (vec![four], 10));
        // The second of two late ones has an earlier one right before it.
        let (found, _) = reordered([1, 4, 5, 2, 3, 6].into_iter());
        assert_eq!(found.iter().map(|one| one.n).collect::<Vec<_>>(), [2, 0]);
        assert_eq!(
            found.iter().map(|one| one.extent).collect::<Vec<_>>(),
            [2, 3]
        );
    }

    #[test]
    fn any_order_is_counted_as_the_definitions_say() {
        let mut state = 9_u64;
        let mut draw = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 33) as f64 / f64::from(1_u32 << 31)
        };
        for reach in [1.0, 3.0, 60.0] {
            let mut arrivals: Vec<(f64, u64)> = (0..2_000_u32)
                .map(|number| (f64::from(number) + reach * draw(), number.into()))
                .collect();
            arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
            let numbers: Vec<u64> = arrivals.into_iter().map(|one| one.1).collect();
            let expected = plain(&numbers);
            assert!(reach < 2.0 || expected.len() > 100);
            assert_eq!(reordered(numbers.into_iter()), (expected, 2_000));
        }
    }
}
