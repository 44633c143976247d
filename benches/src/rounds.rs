//! Rounds: every case once, between two floors, in an order that rotates. It times nothing
//! itself.

use crate::quantiles::{PairedRatio, Quantiles, median};

/// A round is rejected when a floor's median differs from the run's by more than this factor:
/// the hypervisor moved the processors, or a neighbour took one.
pub const FLOOR_JUMP_RATIO_MAX: f64 = 1.5;

/// One contestant.
pub struct Case<'a> {
    /// Name in the table.
    pub name: &'static str,
    /// Measures for one round; nanoseconds per sample.
    pub round: &'a mut dyn FnMut() -> Vec<u64>,
}

impl core::fmt::Debug for Case<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Case")
            .field("name", &self.name)
            .finish_non_exhaustive()
    }
}

/// What one case gave over the kept rounds.
#[derive(Debug, Clone)]
pub struct Row {
    /// Name of the case.
    pub name: &'static str,
    /// Quantiles of all samples of the kept rounds; `None` when no round was kept.
    pub quantiles: Option<Quantiles>,
    /// Median of each kept round.
    pub round_p50_ns: Vec<u64>,
    /// Ninety-ninth percentile of each kept round.
    pub round_p99_ns: Vec<u64>,
    /// Median of the floors of the kept rounds.
    pub floor_p50_ns: Option<u64>,
}

impl Row {
    /// Ratio of the rounds' medians to those of `reference`.
    pub fn p50_ratio_to(&self, reference: &Self) -> Option<PairedRatio> {
        let references = reference.round_p50_ns.iter().copied();
        PairedRatio::of(self.round_p50_ns.iter().copied().zip(references))
    }

    /// Ratio of the rounds' 99th percentiles to those of `reference`.
    pub fn p99_ratio_to(&self, reference: &Self) -> Option<PairedRatio> {
        let references = reference.round_p99_ns.iter().copied();
        PairedRatio::of(self.round_p99_ns.iter().copied().zip(references))
    }
}

/// The outcome of [`compare`].
#[derive(Debug, Clone)]
pub struct Comparison {
    /// One row per case, in the order given.
    pub rows: Vec<Row>,
    /// The floor as a row of its own.
    pub floor: Row,
    /// Rounds that count.
    pub kept_count: usize,
    /// Rounds whose floor jumped.
    pub rejected_count: usize,
}

/// Runs `round_count` rounds of all `cases`, each round between two floors.
pub fn compare(
    round_count: usize,
    floor: &mut dyn FnMut() -> Vec<u64>,
    cases: &mut [Case<'_>],
) -> Comparison {
    let mut rounds = Vec::with_capacity(round_count);
    for round in 0..round_count {
        let before = floor();
        let mut samples = vec![Vec::new(); cases.len()];
        for offset in 0..cases.len() {
            let index = (round + offset) % cases.len();
            samples[index] = (cases[index].round)();
        }
        rounds.push(Round {
            floors: [before, floor()],
            samples,
        });
    }
    let names: Vec<_> = cases.iter().map(|case| case.name).collect();
    summarise(rounds, &names)
}

struct Round {
    floors: [Vec<u64>; 2],
    samples: Vec<Vec<u64>>,
}

impl Round {
    /// Medians of both floors; `None` when a floor has no samples.
    fn floor_p50_ns(&mut self) -> Option<[u64; 2]> {
        let [before, after] = &mut self.floors;
        Some([Quantiles::of(before)?.p50_ns, Quantiles::of(after)?.p50_ns])
    }
}

fn summarise(mut rounds: Vec<Round>, names: &[&'static str]) -> Comparison {
    let round_count = rounds.len();
    let floors = rounds.iter_mut().filter_map(Round::floor_p50_ns).flatten();
    let typical = median(floors.collect()).unwrap_or(0) as f64;
    rounds.retain_mut(|round| {
        round.floor_p50_ns().is_some_and(|floors| {
            floors.iter().all(|floor| {
                let floor = *floor as f64;
                floor <= typical * FLOOR_JUMP_RATIO_MAX && typical <= floor * FLOOR_JUMP_RATIO_MAX
            })
        })
    });
    let floors = rounds.iter_mut().filter_map(Round::floor_p50_ns).flatten();
    let floor_p50_ns = median(floors.collect());
    let row = |name, samples: Vec<Vec<u64>>| row(name, samples, floor_p50_ns);
    let rows = names.iter().enumerate().map(|(index, name)| {
        let samples = rounds.iter().map(|round| round.samples[index].clone());
        row(*name, samples.collect())
    });
    Comparison {
        rows: rows.collect(),
        floor: row(
            "floor",
            rounds.iter().map(|round| round.floors.concat()).collect(),
        ),
        kept_count: rounds.len(),
        rejected_count: round_count - rounds.len(),
    }
}

fn row(name: &'static str, mut rounds: Vec<Vec<u64>>, floor_p50_ns: Option<u64>) -> Row {
    let each: Vec<_> = rounds
        .iter_mut()
        .filter_map(|round| Quantiles::of(round))
        .collect();
    Row {
        name,
        quantiles: Quantiles::of(&mut rounds.concat()),
        round_p50_ns: each.iter().map(|round| round.p50_ns).collect(),
        round_p99_ns: each.iter().map(|round| round.p99_ns).collect(),
        floor_p50_ns,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_with_a_jumping_floor_are_rejected_and_counted() {
        let mut floors = [100, 110, 100, 105, 300, 100, 95, 40, 100, 100].into_iter();
        let mut floor = || vec![floors.next().unwrap()];
        let (mut a, mut b) = (0, 0);
        let mut first = || {
            a += 10;
            vec![a; 3]
        };
        let mut second = || {
            b += 20;
            vec![b; 2]
        };
        let mut cases = [
            Case {
                name: "a",
                round: &mut first,
            },
            Case {
                name: "b",
                round: &mut second,
            },
        ];
        let outcome = compare(5, &mut floor, &mut cases);
        assert_eq!((outcome.kept_count, outcome.rejected_count), (3, 2));
        assert_eq!(outcome.rows[0].round_p50_ns, [10, 20, 50]);
        assert_eq!(outcome.rows[1].quantiles.unwrap().count, 6);
        let ratio = outcome.rows[1].p50_ratio_to(&outcome.rows[0]).unwrap();
        assert!((ratio.median - 2.0).abs() < 1e-9);
        assert_eq!(outcome.floor.quantiles.unwrap().count, 6);
        assert_eq!(outcome.rows[0].floor_p50_ns, Some(100));
    }

    #[test]
    fn the_order_rotates_so_that_no_case_always_comes_first() {
        let order = core::cell::RefCell::new(Vec::new());
        let mut a = || {
            order.borrow_mut().push('a');
            vec![1]
        };
        let mut b = || {
            order.borrow_mut().push('b');
            vec![1]
        };
        let mut cases = [
            Case {
                name: "a",
                round: &mut a,
            },
            Case {
                name: "b",
                round: &mut b,
            },
        ];
        compare(2, &mut || vec![1], &mut cases);
        assert_eq!(order.into_inner(), ['a', 'b', 'b', 'a']);
    }
}
