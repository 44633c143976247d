//! Whether one thing over time follows another, and by how much: cross-correlation over lags, with
//! a test that knows of memory. Correlation is not cause, and nothing here says so.
//!
//! Series of a run are autocorrelated: an outage lasts for many bins, and so does an error. Tests
//! that take bins for independent then find connections everywhere. Here the robot's series is laid
//! on a ring, turned by a random amount, cut into a few long blocks and put together in random order:
//! each block keeps its memory, and only the common time is lost. The p-value is the share of such
//! shuffles that correlate at *some* lag of the window as much as the series do as they are, so
//! that looking at many lags is paid for. Turning alone would be exact, but leaves no more independent
//! turns than windows fit into the run, too few for minutes of a run.

use serde::{Deserialize, Serialize};

use hil_core::random::RandomStream;

/// Shuffles that p-values rest on.
pub const SHUFFLE_COUNT: usize = 499;

/// Blocks of a shuffle. Fewer leave more memory intact; six allow 720 orders, each at any turn of
/// the ring. The test of this file's end gives the share of false alarms.
pub const BLOCK_COUNT: usize = 6;

/// Fewest bins that are worth a test.
pub const BIN_COUNT_MIN: usize = 80;

/// The lags searched, in bins: the effect may come up to `lead_max` bins before the cause, since
/// stamps and bins are not exact, and up to `lag_max` after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LagWindow {
    /// Bins by which the effect may come first.
    pub lead_max: usize,
    /// Bins by which it may come later.
    pub lag_max: usize,
}

impl LagWindow {
    /// At most these, and at most what a series of `bin_count` leaves room to test: one eighth of
    /// it in all.
    #[must_use]
    pub fn fitted(self, bin_count: usize) -> Self {
        let room = bin_count / 8;
        let whole = self.lead_max + self.lag_max;
        if whole <= room {
            return self;
        }
        let lead_max = self.lead_max * room / whole.max(1);
        Self {
            lead_max,
            lag_max: room - lead_max,
        }
    }

    /// Lags in it, lag 0 included.
    pub const fn lag_count(self) -> usize {
        self.lead_max + self.lag_max + 1
    }
}

/// The highest correlation of one pair of series.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairCorrelation {
    /// Correlation coefficient at the lag where it is highest.
    pub coefficient: f64,
    /// That lag in bins; above zero when the effect comes later than the cause.
    pub lag_bins: i64,
    /// Share of shuffles (the series as they are counted as one) whose highest coefficient in the
    /// window is at least as high.
    pub p_value: f64,
    /// The same against the highest coefficient of *all* pairs in each shuffle (Westfall and Young
    /// 1993, single step): what remains when many pairs are tried and the best is looked at.
    pub p_family: f64,
}

/// Why there is no test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CorrelationError {
    /// The series differ in length.
    #[error("series of {found} bins beside one of {expected}")]
    Lengths {
        /// Bins of the first.
        expected: usize,
        /// Bins of another.
        found: usize,
    },
    /// Too short to say anything.
    #[error("the run has {bin_count} bins, and a test needs {BIN_COUNT_MIN}")]
    TooShort {
        /// Bins.
        bin_count: usize,
    },
}

/// All pairs of a family, tested together.
#[derive(Debug, Clone, PartialEq)]
pub struct Family {
    /// By effect, then by cause; `None` where one of the two is constant or not finite throughout.
    pub pairs: Vec<Vec<Option<PairCorrelation>>>,
    /// The lags searched.
    pub window: LagWindow,
}

impl Family {
    /// Pairs that could be tested.
    pub fn pair_count(&self) -> usize {
        self.pairs.iter().flatten().flatten().count()
    }
}

/// Tests every effect against every cause. All series are on the same bins, without holes: a series
/// with a value that is not finite is in no pair, as any number in its place would be made up. Equal series and streams give equal results; time grows with the
/// square of the number of bins.
///
/// # Errors
/// When the series are of different lengths, or too short.
pub fn family(
    causes: &[Vec<f64>],
    effects: &[Vec<f64>],
    window: LagWindow,
    random: &mut RandomStream,
) -> Result<Family, CorrelationError> {
    let all = || causes.iter().chain(effects);
    let bin_count = all().next().map_or(0, Vec::len);
    if let Some(odd) = all().find(|series| series.len() != bin_count) {
        return Err(CorrelationError::Lengths {
            expected: bin_count,
            found: odd.len(),
        });
    }
    if bin_count < BIN_COUNT_MIN {
        return Err(CorrelationError::TooShort { bin_count });
    }
    let window = window.fitted(bin_count);
    let all_standardised = |series: &[Vec<f64>]| -> Vec<Option<Vec<f64>>> {
        series.iter().map(|one| standardised(one)).collect()
    };
    let (causes, effects) = (all_standardised(causes), all_standardised(effects));
    let mut tested: Vec<Vec<Option<Tested>>> = effects
        .iter()
        .map(|effect| {
            let test = |cause: &Option<Vec<f64>>| {
                Some(Tested::of(cause.as_ref()?, effect.as_ref()?, window))
            };
            causes.iter().map(test).collect()
        })
        .collect();
    for _ in 0..SHUFFLE_COUNT {
        // One order for all series of the robot: what they have in common stays.
        let order = Shuffle::drawn(bin_count, random);
        let mut all_best = f64::NEG_INFINITY;
        for (row, effect) in tested.iter_mut().zip(&effects) {
            let Some(effect) = effect else { continue };
            let shuffled = order.applied(effect);
            for (one, cause) in row.iter_mut().zip(&causes) {
                if let Some((one, cause)) = one.as_mut().zip(cause.as_ref()) {
                    let best = best_lag(cause, &shuffled, window).1;
                    one.reached_count += usize::from(best >= one.reached());
                    all_best = all_best.max(best);
                }
            }
        }
        for one in tested.iter_mut().flatten().flatten() {
            one.family_reached_count += usize::from(all_best >= one.reached());
        }
    }
    let pairs = tested.iter().map(|row| {
        let pair = |one: &Option<Tested>| one.as_ref().map(Tested::pair);
        row.iter().map(pair).collect()
    });
    Ok(Family {
        pairs: pairs.collect(),
        window,
    })
}

/// One random order of blocks on a turned ring.
#[derive(Debug)]
struct Shuffle {
    turn: usize,
    order: [usize; BLOCK_COUNT],
}

impl Shuffle {
    fn drawn(bin_count: usize, random: &mut RandomStream) -> Self {
        let mut below = |limit: usize| {
            let product = u128::from(random.next_u64()) * limit as u128;
            usize::try_from(product >> 64).expect("the high half lies below the limit")
        };
        let turn = below(bin_count);
        let mut order = core::array::from_fn(|block| block);
        for last in (1..BLOCK_COUNT).rev() {
            order.swap(last, below(last + 1));
        }
        Self { turn, order }
    }

    /// The series twice in a row, so that a lag on the ring is a slice.
    fn applied(&self, series: &[f64]) -> Vec<f64> {
        let count = series.len();
        let mut shuffled = Vec::with_capacity(2 * count);
        for block in self.order {
            let bins = block * count / BLOCK_COUNT..(block + 1) * count / BLOCK_COUNT;
            shuffled.extend(bins.map(|bin| series[(bin + self.turn) % count]));
        }
        shuffled.extend_from_within(..);
        shuffled
    }
}

/// Mean 0 and sum of squares 1; `None` for a constant series and one with a value that is not finite.
fn standardised(series: &[f64]) -> Option<Vec<f64>> {
    if !series.iter().all(|value| value.is_finite()) {
        return None;
    }
    let mean = series.iter().sum::<f64>() / series.len() as f64;
    let centred: Vec<f64> = series.iter().map(|value| value - mean).collect();
    let square: f64 = centred.iter().map(|value| value * value).sum();
    let largest = series.iter().map(|value| value.abs()).fold(0.0, f64::max);
    // Rounding of the mean leaves a constant series a scatter of its own.
    let is_moving = square.sqrt() > 1e-9 * largest * (series.len() as f64).sqrt();
    is_moving.then(|| {
        centred
            .into_iter()
            .map(|value| value / square.sqrt())
            .collect()
    })
}

/// The lag of the highest correlation, as a place in the window, and the coefficient there, both on
/// a ring; `twice` is the effect twice in a row.
fn best_lag(cause: &[f64], twice: &[f64], window: LagWindow) -> (usize, f64) {
    let count = cause.len();
    let coefficients = (0..window.lag_count()).map(|step| {
        let lag = (count + step - window.lead_max) % count;
        (step, product(cause, &twice[lag..lag + count]))
    });
    let better = |a: (usize, f64), b: (usize, f64)| if b.1 > a.1 { b } else { a };
    coefficients.reduce(better).unwrap_or((0, 0.0))
}

/// Four sums side by side: one sum would have to wait for each addition.
fn product(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    let (a_fours, b_fours) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest = a_fours.remainder().iter().zip(b_fours.remainder());
    let rest: f64 = rest.map(|(a, b)| a * b).sum();
    for (a, b) in a_fours.zip(b_fours) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    sums.iter().sum::<f64>() + rest
}

/// One pair.
#[derive(Debug)]
struct Tested {
    coefficient: f64,
    lag_bins: i64,
    reached_count: usize,
    family_reached_count: usize,
}

impl Tested {
    fn of(cause: &[f64], effect: &[f64], window: LagWindow) -> Self {
        let (step, coefficient) = best_lag(cause, &[effect, effect].concat(), window);
        let signed = |bins: usize| i64::try_from(bins).unwrap_or(i64::MAX);
        Self {
            coefficient,
            lag_bins: signed(step) - signed(window.lead_max),
            reached_count: 0,
            family_reached_count: 0,
        }
    }

    /// Equal up to rounding counts as reached.
    fn reached(&self) -> f64 {
        self.coefficient - 1e-12
    }

    fn pair(&self) -> PairCorrelation {
        let share = |count: usize| (count + 1) as f64 / (SHUFFLE_COUNT + 1) as f64;
        PairCorrelation {
            coefficient: self.coefficient,
            lag_bins: self.lag_bins,
            p_value: share(self.reached_count),
            p_family: share(self.family_reached_count),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: LagWindow = LagWindow {
        lead_max: 10,
        lag_max: 50,
    };

    /// A first-order autoregressive series.
    fn series(count: usize, memory: f64, random: &mut RandomStream) -> Vec<f64> {
        let mut state = random.normal();
        (0..count)
            .map(|_| {
                state = memory * state + (1.0 - memory * memory).sqrt() * random.normal();
                state
            })
            .collect()
    }

    /// Spikes of some bins each, as silences are.
    fn outages(count: usize, random: &mut RandomStream) -> Vec<f64> {
        let mut left = 0.0;
        (0..count)
            .map(|_| {
                if left <= 0.0 && random.chance(0.01) {
                    left = (10.0 * random.uniform()).ceil();
                }
                left -= 1.0;
                left.max(0.0)
            })
            .collect()
    }

    #[test]
    fn a_planted_lag_is_found_with_its_sign() {
        for (lag, seed) in [(11_i64, 1_u64), (0, 2), (-4, 3), (50, 4)] {
            let mut random = RandomStream::new(seed, "planted");
            let cause = outages(1_200, &mut random);
            let noise = series(1_200, 0.8, &mut random);
            let effect: Vec<f64> = (0..1_200_i64)
                .map(|bin| {
                    let from = usize::try_from(bin - lag).ok().and_then(|at| cause.get(at));
                    from.copied().unwrap_or(0.0) + noise[usize::try_from(bin).unwrap()]
                })
                .collect();
            let found = family(&[cause], &[effect], WINDOW, &mut random).unwrap();
            let pair = found.pairs[0][0].unwrap();
            assert_eq!(pair.lag_bins, lag, "{pair:?}");
            assert!(pair.p_value < 0.01 && pair.coefficient > 0.5, "{pair:?}");
        }
    }

    /// Of 120 pairs without any connection 6 should reach p <= 0.05; three standard deviations of
    /// the binomial are 7, and one more is admitted. Series whose memory is a quarter of the run have
    /// too few blocks to shuffle and are above it; sparse ones are below. `docs/network-figures.md` quotes
    /// what comes out.
    #[test]
    fn independent_series_are_called_correlated_in_five_of_a_hundred_cases() {
        for (name, memory, most) in [
            ("white", 0.0, 14),
            ("long memory", 0.9, 14),
            ("a quarter of the run", 0.99, 26),
            ("outages", -1.0, 14),
        ] {
            let (mut alone, mut in_family) = (0, 0);
            for seed in 0..120 {
                let mut random = RandomStream::new(seed, name);
                let mut one = |count| {
                    if memory < 0.0 {
                        outages(count, &mut random)
                    } else {
                        series(count, memory, &mut random)
                    }
                };
                let causes = [one(400), one(400)];
                let effect = [one(400)];
                let mut random = RandomStream::new(seed, "shuffles");
                let Ok(found) = family(&causes, &effect, WINDOW, &mut random) else {
                    panic!("400 bins are enough");
                };
                let row = &found.pairs[0];
                alone += i32::from(row[0].is_some_and(|pair| pair.p_value <= 0.05));
                let best = row.iter().flatten().map(|pair| pair.p_family);
                in_family += i32::from(best.fold(1.0, f64::min) <= 0.05);
            }
            // Sparse series have few coincidences, so the test is careful with them.
            let least = i32::from(memory >= 0.0);
            assert!((least..=most).contains(&alone), "{name}: {alone} of 120");
            assert!(
                (least..=most).contains(&in_family),
                "{name}: {in_family} of 120"
            );
        }
    }

    #[test]
    fn a_constant_series_has_no_correlation_and_a_short_one_no_test() {
        let mut random = RandomStream::new(7, "constant");
        let moving = series(300, 0.5, &mut random);
        let causes = [vec![0.1; 300], moving.clone()];
        let mut broken = series(300, 0.5, &mut random);
        broken[17] = f64::NAN;
        let effects = [moving, broken];
        let found = family(&causes, &effects, WINDOW, &mut random).unwrap();
        assert_eq!(found.pairs[0][0], None);
        assert_eq!(found.pairs[1], [None, None]);
        let itself = found.pairs[0][1].unwrap();
        assert_eq!(itself.lag_bins, 0);
        assert!((itself.coefficient - 1.0).abs() < 1e-9);
        assert_eq!(found.pair_count(), 1);
        assert_eq!(
            family(&[vec![0.0; 20]], &[vec![0.0; 20]], WINDOW, &mut random).unwrap_err(),
            CorrelationError::TooShort { bin_count: 20 }
        );
        let error = family(&[vec![0.0; 20]], &[vec![0.0; 21]], WINDOW, &mut random);
        assert_eq!(
            error.unwrap_err().to_string(),
            "series of 21 bins beside one of 20"
        );
    }

    #[test]
    fn the_window_shrinks_with_the_run_and_equal_seeds_shuffle_equally() {
        assert_eq!(WINDOW.fitted(480), WINDOW);
        let short = WINDOW.fitted(120);
        assert_eq!((short.lead_max, short.lag_max), (2, 13));
        let mut random = RandomStream::new(7, "equal");
        let (cause, effect) = (
            [series(1_000, 0.5, &mut random)],
            [series(1_000, 0.5, &mut random)],
        );
        let shuffle = || family(&cause, &effect, WINDOW, &mut RandomStream::new(1, "x")).unwrap();
        assert_eq!(shuffle(), shuffle());
    }
}
