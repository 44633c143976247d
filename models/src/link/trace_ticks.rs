//! The period of a trace, found from its instants: which tick of its producer each record belongs to,
//! and which ticks have none because the process that should have published was held up.

use crate::trace::TraceRecord;

/// Fewest records with a period.
const RECORDS_MIN: usize = 16;
/// How far from the middle step the period is searched.
const SEARCH_RATIO: f64 = 0.02;
/// Most records the search looks at, evenly spread over the first of them.
const SEARCHED_MAX: usize = 4_000;
/// Mean resultant length (Mardia and Jupp 2000, section 2.3.1) below which there is no period.
const CONCENTRATION_MIN: f64 = 0.5;
/// Share of a period by which an instant may lie before the middle phase; the rest is lateness.
const EARLY_RATIO: f64 = 0.25;

/// A producer's ticks.
#[derive(Debug, Clone)]
pub(super) struct Ticks {
    pub(super) period_ns: f64,
    /// Place of the record of each tick, counted from the first record's.
    places: Vec<Option<usize>>,
}

/// Where the ticks of `instants` are: period and phase of largest concentration.
fn period_of(instants: &[f64], middle_ns: f64) -> Option<(f64, f64)> {
    let searched = &instants[..instants.len().min(SEARCHED_MAX)];
    let span = searched.last()? - searched.first()?;
    let resultant = |period: f64| {
        let turn = core::f64::consts::TAU / period;
        let sum = searched.iter().fold((0.0, 0.0), |(x, y), at| {
            let (sine, cosine) = (turn * at).sin_cos();
            (x + cosine, y + sine)
        });
        let n = searched.len() as f64;
        (sum.0.hypot(sum.1) / n, sum.1.atan2(sum.0))
    };
    // A peak is as wide as one turn over the whole span; eight steps cannot miss it.
    let mut step = (middle_ns * middle_ns / span / 8.0).max(middle_ns * 1e-6);
    let (mut best, mut from, mut upto) = (
        (0.0, middle_ns),
        middle_ns * (1.0 - SEARCH_RATIO),
        middle_ns * (1.0 + SEARCH_RATIO),
    );
    for _ in 0..6 {
        let mut period = from;
        while period <= upto {
            let (length, _) = resultant(period);
            if length > best.0 {
                best = (length, period);
            }
            period += step;
        }
        (from, upto) = (best.1 - step, best.1 + step);
        step /= 8.0;
    }
    if best.0 < CONCENTRATION_MIN {
        return None;
    }
    let (_, angle) = resultant(best.1);
    Some((best.1, angle / core::f64::consts::TAU * best.1))
}

/// The whole number at or below `x`.
#[allow(
    clippy::cast_possible_truncation,
    reason = "ticks of a run are far below 2^63, and the cast saturates"
)]
fn floor(x: f64) -> i64 {
    x.floor() as i64
}

impl Ticks {
    /// The ticks of `records`; `None` when their instants have no period, or the producer was
    /// started anew, which begins another grid.
    pub(super) fn of(records: &[TraceRecord], middle_ns: i64) -> Option<Self> {
        let is_restarted = records.iter().any(|record| record.start > 0);
        if records.len() < RECORDS_MIN || middle_ns <= 0 || is_restarted {
            return None;
        }
        let first_ns = records[0].published_ns;
        let since_first =
            |record: &TraceRecord| record.published_ns.saturating_sub(first_ns) as f64;
        let instants: Vec<f64> = records.iter().map(since_first).collect();
        let (period_ns, phase_ns) = period_of(&instants, middle_ns as f64)?;
        let tick_of = |at: f64| floor((at - phase_ns) / period_ns + EARLY_RATIO);
        let first = tick_of(instants[0]);
        let mut places: Vec<Option<usize>> = Vec::new();
        for (place, at) in instants.iter().enumerate() {
            let tick = usize::try_from(tick_of(*at) - first).ok()?;
            // Two of one tick: the producer was so late that the next came with it.
            let tick = tick.max(places.len());
            if tick > places.len() + 10_000_000 {
                return None;
            }
            places.resize(tick, None);
            places.push(Some(place));
        }
        Some(Self { period_ns, places })
    }

    /// Ticks from the first to the last record.
    pub(super) const fn count(&self) -> usize {
        self.places.len()
    }

    /// The tick at `since_first_ns` after the first.
    pub(super) fn at(&self, since_first_ns: i64) -> usize {
        let tick = floor(since_first_ns as f64 / self.period_ns + 0.5);
        usize::try_from(tick).unwrap_or(0)
    }

    /// The record of `tick`; `None` when nobody published at it.
    pub(super) fn record_of(&self, tick: usize) -> Option<usize> {
        self.places.get(tick).copied().flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::RandomStream;

    const PERIOD_NS: i64 = 8_000_000;

    /// A run of a process on a loaded host: late by up to 40 % of a period now and then, and some
    /// ticks missed; gives the ticks that it published at.
    fn loaded(seed: u64) -> (Vec<TraceRecord>, Vec<usize>) {
        let mut random = RandomStream::new(seed, "ticks");
        let (mut records, mut ticks) = (Vec::new(), Vec::new());
        for tick in 0..7_000_i64 {
            let lateness = if random.chance(0.1) { 0.4 } else { 0.02 } * random.uniform();
            if tick > 0 && random.chance(0.04) {
                continue;
            }
            #[allow(clippy::cast_possible_truncation, reason = "below a period")]
            let late_ns = (lateness * PERIOD_NS as f64) as i64;
            let published_ns = 170_000_123 + tick * PERIOD_NS + late_ns;
            records.push(TraceRecord::published(
                published_ns,
                records.len() as u64,
                1,
            ));
            ticks.push(usize::try_from(tick).unwrap());
        }
        (records, ticks)
    }

    #[test]
    fn each_record_finds_its_tick_however_many_were_missed() {
        for seed in 0..5 {
            let (records, expected) = loaded(seed);
            let ticks = Ticks::of(&records, PERIOD_NS + 3_100).unwrap();
            assert!(
                (ticks.period_ns / PERIOD_NS as f64 - 1.0).abs() < 1e-6,
                "{ticks:?}"
            );
            let found = (0..ticks.count()).filter(|tick| ticks.record_of(*tick).is_some());
            assert_eq!(found.collect::<Vec<_>>(), expected, "seed {seed}");
            assert_eq!(ticks.at(PERIOD_NS * 6_999), 6_999);
        }
    }

    #[test]
    fn what_has_no_period_has_no_ticks() {
        let mut random = RandomStream::new(1, "no period");
        let mut at_ns = 0;
        let mut next = |index: u64| {
            at_ns += i64::try_from(random.next_u64() % 30_000_000).unwrap();
            TraceRecord::published(at_ns, index, 1)
        };
        let records: Vec<_> = (0..500).map(&mut next).collect();
        assert!(Ticks::of(&records, 15_000_000).is_none());
        let (mut restarted, _) = loaded(1);
        restarted[4_000].start = 1;
        assert!(Ticks::of(&restarted, PERIOD_NS).is_none());
    }
}
