//! A network card's clock against the real-time clock of its host: from paired reads taken during
//! a run to the host's instant of a card's stamp, with the largest error of that. It reads no
//! clock and sets none; another host's clock is not its business.
//!
//! Between two pairs the offset is taken to run straight. What it may stray is part of the bound:
//! the bounds of both pairs, [`WANDER_PPB`] of the time to the nearer one, and whatever their
//! difference departs from the run's usual rate beyond what their own bounds explain.

use core::time::Duration;

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use hil_core::time::duration_ns;

/// One paired read of a card's clock, the real-time and the monotonic clock of a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct NicClockRecord {
    /// When, on the host's real-time clock.
    pub realtime_ns: i64,
    /// Card minus real-time clock.
    pub nic_offset_ns: i64,
    /// Real-time minus monotonic clock, read next to it.
    pub realtime_offset_ns: i64,
    /// Largest error of `nic_offset_ns`: half the time between the two real-time reads around
    /// the read of the card.
    pub bound_ns: u64,
}

/// How much either clock's rate may change between two pairs without showing in them, parts per
/// billion: short-term wander of the crystals of PCs is well below.
pub const WANDER_PPB: u64 = 1_000;
/// Largest difference of the rates of a card's and a host's clock, for which a single pair gives no
/// figure: 100 ppm of the crystal, and the 500 ppm that the kernel may steer by, parts per billion.
const RATE_MAX_PPB: u64 = 600_000;
/// A change of the offset that departs from the usual rate by more is a step of a clock, parts
/// per billion: servos change a rate by less between two reads.
const STEP_PPB: u64 = 200_000;
/// Changes below this are none, whatever the rate.
const STEP_NS_MIN: u64 = 2_000;
/// Stamps this far outside the pairs are still converted: the first and the last messages of a
/// run may lie beside them.
const OUTSIDE_MAX: Duration = Duration::from_millis(250);

/// A value and its largest error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounded {
    /// The value, nanoseconds.
    pub value_ns: i64,
    /// Its largest error, nanoseconds.
    pub bound_ns: u64,
}

/// The paired reads of one card in order, cut where a clock was stepped.
#[derive(Debug, Clone, Default)]
pub struct NicTimeline {
    pieces: Vec<Vec<NicClockRecord>>,
    /// Usual change of the offset.
    rate_ppb: i64,
}

impl NicTimeline {
    /// The timeline of `records`, in the order in which they were taken.
    pub fn new(records: &[NicClockRecord]) -> Self {
        let rate_ppb = usual_rate_ppb(records);
        let mut pieces: Vec<Vec<NicClockRecord>> = Vec::new();
        for record in records {
            let goes_on = pieces
                .last()
                .and_then(|piece| piece.last())
                .is_some_and(|last| !is_step(last, record, rate_ppb));
            match pieces.last_mut() {
                Some(piece) if goes_on => piece.push(*record),
                _ => pieces.push(vec![*record]),
            }
        }
        Self { pieces, rate_ppb }
    }

    /// When the host's real-time clock showed what the card's clock did at `nic_ns`. `None` more
    /// than 250 ms away from all pairs, in the gap of a step, and where a clock set back makes the
    /// stamp ambiguous.
    pub fn to_realtime(&self, nic_ns: i64) -> Option<Bounded> {
        let outside_ns = duration_ns(OUTSIDE_MAX);
        let is_near = |piece: &&Vec<NicClockRecord>| match (piece.first(), piece.last()) {
            (Some(first), Some(last)) => {
                nic_ns >= nic_of(first).saturating_sub(outside_ns)
                    && nic_ns <= nic_of(last).saturating_add(outside_ns)
            }
            _ => false,
        };
        let mut near = self.pieces.iter().filter(is_near);
        let piece = near.next()?;
        if near.next().is_some() {
            return None;
        }
        let next = piece.partition_point(|record| nic_of(record) < nic_ns);
        match (next.checked_sub(1).map(|at| &piece[at]), piece.get(next)) {
            (Some(before), Some(after)) => Some(self.between(before, after, nic_ns)),
            (Some(only), None) | (None, Some(only)) => Some(beside(piece, only, nic_ns)),
            (None, None) => None,
        }
    }

    fn between(&self, before: &NicClockRecord, after: &NicClockRecord, nic_ns: i64) -> Bounded {
        let span_ns = nic_of(after).saturating_sub(nic_of(before)).max(1);
        let since_ns = nic_ns.saturating_sub(nic_of(before));
        let change_ns = after.nic_offset_ns.saturating_sub(before.nic_offset_ns);
        let share = i128::from(change_ns) * i128::from(since_ns) / i128::from(span_ns);
        let offset_ns = before.nic_offset_ns.saturating_add(saturated(share));
        let nearer_ns = since_ns.min(span_ns.saturating_sub(since_ns));
        let departed_ns = departure_ns(before, after, self.rate_ppb);
        let unexplained_ns = departed_ns.saturating_sub(sum_of_bounds(before, after));
        Bounded {
            value_ns: nic_ns.saturating_sub(offset_ns),
            bound_ns: before
                .bound_ns
                .max(after.bound_ns)
                .saturating_add(unexplained_ns)
                .saturating_add(part_of(nearer_ns, WANDER_PPB))
                .saturating_add(1),
        }
    }

    /// The figures of the pairs; `None` without any.
    pub fn metrics(&self) -> Option<NicClockMetrics> {
        let all = || self.pieces.iter().flatten();
        let mut bounds: Vec<u64> = all().map(|record| record.bound_ns).collect();
        bounds.sort_unstable();
        let middle = self.pieces.iter().max_by_key(|piece| piece.len())?;
        let newest = all().last()?;
        Some(NicClockMetrics {
            pair_count: bounds.len() as u64,
            step_count: self.pieces.len().saturating_sub(1) as u64,
            offset_ns: newest.nic_offset_ns,
            offset_bound_ns: newest.bound_ns,
            bound_p50_ns: bounds[bounds.len() / 2],
            bound_max_ns: *bounds.last()?,
            frequency: frequency(middle),
        })
    }
}

/// What the pairs of one card say of its clock.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NicClockMetrics {
    /// Paired reads.
    pub pair_count: u64,
    /// Steps of either clock between them.
    pub step_count: u64,
    /// Card minus real-time clock at the last pair.
    pub offset_ns: i64,
    /// Largest error of `offset_ns`.
    pub offset_bound_ns: u64,
    /// Median of the bounds of all pairs.
    pub bound_p50_ns: u64,
    /// Largest of them.
    pub bound_max_ns: u64,
    /// How much faster the card's clock ran than the real-time clock, over the longest time
    /// without a step; `None` when that is too short to say anything.
    pub frequency: Option<Frequency>,
}

/// A difference of rates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Frequency {
    /// Mean over the time it was taken from, parts per billion.
    pub offset_ppb: f64,
    /// Its largest error, parts per billion.
    pub bound_ppb: f64,
}

/// Outside the pairs their mean rate is gone on with. It may be wrong by what the bounds of the two
/// pairs it is from allow, and by a hundred times the wander; of one pair alone no rate is known.
fn beside(piece: &[NicClockRecord], pair: &NicClockRecord, nic_ns: i64) -> Bounded {
    let away_ns = nic_ns.saturating_sub(nic_of(pair));
    let known = ends(piece).map(|(first, last)| {
        let span = i128::from(last.realtime_ns.saturating_sub(first.realtime_ns));
        let change = i128::from(last.nic_offset_ns) - i128::from(first.nic_offset_ns);
        let error = i128::from(sum_of_bounds(&first, &last));
        let away = i128::from(away_ns);
        let error_ns = saturated(away.abs().saturating_mul(error) / span + 1).unsigned_abs();
        let strayed_ns = part_of(away_ns, 100 * WANDER_PPB);
        let change_ns = saturated(away.saturating_mul(change) / span);
        (change_ns, error_ns.saturating_add(strayed_ns))
    });
    let (change_ns, strayed_ns) = known.unwrap_or((0, part_of(away_ns, RATE_MAX_PPB)));
    let offset_ns = pair.nic_offset_ns.saturating_add(change_ns);
    Bounded {
        value_ns: nic_ns.saturating_sub(offset_ns),
        bound_ns: pair.bound_ns.saturating_add(strayed_ns).saturating_add(2),
    }
}

/// The narrowest pair of the first quarter and that of the last one; `None` when they are the same.
fn ends(piece: &[NicClockRecord]) -> Option<(NicClockRecord, NicClockRecord)> {
    let quarter = (piece.len() / 4).max(1);
    let narrowest = |part: &[NicClockRecord]| part.iter().min_by_key(|one| one.bound_ns).copied();
    let first = narrowest(&piece[..quarter.min(piece.len())])?;
    let last = narrowest(&piece[piece.len() - quarter.min(piece.len())..])?;
    (last.realtime_ns > first.realtime_ns).then_some((first, last))
}

fn frequency(piece: &[NicClockRecord]) -> Option<Frequency> {
    let (first, last) = ends(piece)?;
    let span_ns = last.realtime_ns.saturating_sub(first.realtime_ns);
    let change_ns = last.nic_offset_ns.saturating_sub(first.nic_offset_ns);
    Some(Frequency {
        offset_ppb: change_ns as f64 * 1e9 / span_ns as f64,
        bound_ppb: sum_of_bounds(&first, &last) as f64 * 1e9 / span_ns as f64,
    })
}

const fn sum_of_bounds(one: &NicClockRecord, other: &NicClockRecord) -> u64 {
    one.bound_ns.saturating_add(other.bound_ns)
}

const fn nic_of(record: &NicClockRecord) -> i64 {
    record.realtime_ns.saturating_add(record.nic_offset_ns)
}

fn saturated(wide: i128) -> i64 {
    i64::try_from(wide).unwrap_or(if wide < 0 { i64::MIN } else { i64::MAX })
}

/// `ppb` parts per billion of `span_ns`.
fn part_of(span_ns: i64, ppb: u64) -> u64 {
    let part = u128::from(span_ns.unsigned_abs()) * u128::from(ppb) / 1_000_000_000;
    u64::try_from(part).unwrap_or(u64::MAX)
}

/// The median change of the offset between neighbours.
fn usual_rate_ppb(records: &[NicClockRecord]) -> i64 {
    let mut rates: Vec<i64> = records
        .windows(2)
        .filter_map(|pair| {
            let span_ns = pair[1].realtime_ns.saturating_sub(pair[0].realtime_ns);
            let change = i128::from(pair[1].nic_offset_ns) - i128::from(pair[0].nic_offset_ns);
            (span_ns > 0).then(|| saturated(change * 1_000_000_000 / i128::from(span_ns)))
        })
        .collect();
    rates.sort_unstable();
    rates.get(rates.len() / 2).copied().unwrap_or(0)
}

/// By how much the offset changed other than at the usual rate.
fn departure_ns(before: &NicClockRecord, after: &NicClockRecord, rate_ppb: i64) -> u64 {
    let span_ns = after.realtime_ns.saturating_sub(before.realtime_ns);
    let usual = i128::from(span_ns) * i128::from(rate_ppb) / 1_000_000_000;
    let change = i128::from(after.nic_offset_ns) - i128::from(before.nic_offset_ns);
    saturated(change - usual).unsigned_abs()
}

fn is_step(before: &NicClockRecord, after: &NicClockRecord, rate_ppb: i64) -> bool {
    let span_ns = after.realtime_ns.saturating_sub(before.realtime_ns);
    let allowed_ns = part_of(span_ns, STEP_PPB).max(STEP_NS_MIN);
    let departed_ns = departure_ns(before, after, rate_ppb);
    span_ns <= 0 || departed_ns > allowed_ns.saturating_add(sum_of_bounds(before, after))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    const PERIOD_NS: i64 = 100_000_000;
    const EPOCH_NS: i64 = 1_700_000_000_000_000_000;

    /// Uniform over 0..=`max`.
    fn up_to(random: &mut RandomStream, max: u64) -> u64 {
        random.next_u64() % (max + 1)
    }

    /// A card that is `offset_ns` ahead at the start and gains `ppb`.
    fn nic_at(realtime_ns: i64, offset_ns: i64, ppb: i64) -> i64 {
        let gained = i128::from(realtime_ns - EPOCH_NS) * i128::from(ppb) / 1_000_000_000;
        realtime_ns + offset_ns + i64::try_from(gained).unwrap()
    }

    /// Pairs with a read anywhere in its window, as an interrupted reader gets them.
    fn pairs(random: &mut RandomStream, offset_ns: i64, ppb: i64) -> Vec<NicClockRecord> {
        (0..50)
            .map(|index| {
                let window_ns = 400 + i64::try_from(up_to(random, 20_000)).unwrap();
                let before_ns = EPOCH_NS + index * PERIOD_NS;
                let read_ns =
                    before_ns + i64::try_from(up_to(random, window_ns.unsigned_abs())).unwrap();
                let middle_ns = before_ns + window_ns / 2;
                NicClockRecord {
                    realtime_ns: middle_ns,
                    nic_offset_ns: nic_at(read_ns, offset_ns, ppb) - middle_ns,
                    realtime_offset_ns: 0,
                    bound_ns: (window_ns.unsigned_abs()).div_ceil(2) + 10,
                }
            })
            .collect()
    }

    #[test]
    fn the_true_instant_lies_within_the_bound_for_every_simulated_nic() {
        for seed in 0..1_000 {
            let mut random = RandomStream::new(seed, "card clocks");
            let offset_ns =
                i64::try_from(up_to(&mut random, 74_000_000_000)).unwrap() - 37_000_000_000;
            let ppb = i64::try_from(up_to(&mut random, 200_000)).unwrap() - 100_000;
            let timeline = NicTimeline::new(&pairs(&mut random, offset_ns, ppb));
            let figures = timeline.metrics().unwrap();
            assert_eq!(figures.step_count, 0, "seed {seed}");
            let frequency = figures.frequency.unwrap();
            let error_ppb = (frequency.offset_ppb - ppb as f64).abs();
            assert!(
                error_ppb <= frequency.bound_ppb + 1.0,
                "seed {seed}: {error_ppb}"
            );
            for _ in 0..100 {
                let true_ns = EPOCH_NS
                    + i64::try_from(up_to(&mut random, 49 * PERIOD_NS.unsigned_abs())).unwrap();
                let nic_ns = nic_at(true_ns, offset_ns, ppb);
                let found = timeline.to_realtime(nic_ns).unwrap();
                let error_ns = found.value_ns.abs_diff(true_ns);
                assert!(
                    error_ns <= found.bound_ns,
                    "seed {seed}: {error_ns} {found:?}"
                );
            }
        }
    }

    #[test]
    fn few_pairs_bound_the_stamps_beside_them_at_both_ends() {
        let mut answered_count = 0;
        for seed in 0..4_000 {
            let mut random = RandomStream::new(seed, "few card pairs");
            let ppb = i64::try_from(up_to(&mut random, 200_000)).unwrap() - 100_000;
            let all = pairs(&mut random, 5_000, ppb);
            let count = 1 + usize::try_from(seed % 4).unwrap();
            let timeline = NicTimeline::new(&all[..count]);
            let last_ns = i64::try_from(count - 1).unwrap() * PERIOD_NS;
            for end_ns in [0, last_ns] {
                for _ in 0..10 {
                    let away_ns = i64::try_from(up_to(&mut random, 480_000_000)).unwrap();
                    let true_ns = EPOCH_NS + end_ns + away_ns - 240_000_000;
                    let Some(found) = timeline.to_realtime(nic_at(true_ns, 5_000, ppb)) else {
                        continue;
                    };
                    answered_count += 1;
                    let error_ns = found.value_ns.abs_diff(true_ns);
                    assert!(error_ns <= found.bound_ns, "seed {seed}: {found:?}");
                }
            }
        }
        assert!(answered_count > 70_000, "{answered_count}");
    }

    #[test]
    fn a_damaged_bound_saturates() {
        let damaged = |index: i64| NicClockRecord {
            realtime_ns: EPOCH_NS + index * PERIOD_NS,
            nic_offset_ns: 0,
            realtime_offset_ns: 0,
            bound_ns: u64::MAX,
        };
        let timeline = NicTimeline::new(&[damaged(0), damaged(1)]);
        for true_ns in [
            EPOCH_NS + PERIOD_NS / 2,
            EPOCH_NS - 7,
            EPOCH_NS + 2 * PERIOD_NS,
        ] {
            let found = timeline.to_realtime(true_ns).unwrap();
            assert_eq!(found.bound_ns, u64::MAX);
        }
        assert!(timeline.metrics().unwrap().frequency.is_some());
    }

    #[test]
    fn a_step_cuts_the_timeline_and_stamps_beside_it_have_no_instant() {
        let mut random = RandomStream::new(1, "card clock step");
        let mut records = pairs(&mut random, 0, 20_000);
        for record in &mut records[25..] {
            record.nic_offset_ns += 5_000_000_000;
        }
        let timeline = NicTimeline::new(&records);
        assert_eq!(timeline.metrics().unwrap().step_count, 1);
        let early = nic_at(EPOCH_NS + 10 * PERIOD_NS, 0, 20_000);
        assert!(timeline.to_realtime(early).is_some());
        let late = nic_at(EPOCH_NS + 40 * PERIOD_NS, 5_000_000_000, 20_000);
        assert!(timeline.to_realtime(late).is_some());
        let in_the_gap = nic_at(EPOCH_NS + 50 * PERIOD_NS, 0, 0);
        assert_eq!(timeline.to_realtime(in_the_gap), None);
    }

    #[test]
    fn a_clock_set_back_makes_stamps_ambiguous_not_wrong() {
        let mut random = RandomStream::new(2, "card clock back");
        let mut records = pairs(&mut random, 0, 0);
        for record in &mut records[25..] {
            record.nic_offset_ns -= 1_000_000_000;
        }
        let timeline = NicTimeline::new(&records);
        let twice = EPOCH_NS + 20 * PERIOD_NS;
        assert_eq!(timeline.to_realtime(twice), None);
    }

    #[test]
    fn a_changed_rate_widens_the_bound_that_it_needs() {
        let record = |index: i64, nic_offset_ns| NicClockRecord {
            realtime_ns: EPOCH_NS + index * PERIOD_NS,
            nic_offset_ns,
            realtime_offset_ns: 0,
            bound_ns: 100,
        };
        let mut records: Vec<_> = (0..20).map(|index| record(index, 0)).collect();
        // 100 ppm faster in the second half of one period.
        records.push(record(20, 5_000));
        let timeline = NicTimeline::new(&records);
        let true_ns = EPOCH_NS + 19 * PERIOD_NS + PERIOD_NS / 2;
        let found = timeline.to_realtime(true_ns).unwrap();
        assert!(
            found.value_ns.abs_diff(true_ns) <= found.bound_ns,
            "{found:?}"
        );
        assert!(found.bound_ns < 6_000, "{found:?}");
    }

    #[test]
    fn no_pairs_convert_nothing_and_one_pair_converts_its_neighbourhood() {
        let nothing = NicTimeline::new(&[]);
        assert_eq!(nothing.to_realtime(5), None);
        assert!(nothing.metrics().is_none());
        let one = NicClockRecord {
            realtime_ns: EPOCH_NS,
            nic_offset_ns: 7,
            realtime_offset_ns: 0,
            bound_ns: 50,
        };
        let timeline = NicTimeline::new(&[one]);
        let found = timeline.to_realtime(EPOCH_NS + 7).unwrap();
        assert_eq!(found.value_ns, EPOCH_NS);
        assert_eq!(timeline.to_realtime(EPOCH_NS + 1_000_000_000), None);
        assert_eq!(timeline.metrics().unwrap().frequency, None);
    }
}
