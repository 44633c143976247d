//! Whether one thing over time follows another, and by how much: cross-correlation over lags, with
//! a test that knows of memory, periods and trends. Correlation is not cause, and nothing here says so.
//!
//! Series of a run have structure of their own: an outage lasts for many bins, both sides have a period, both
//! drift. Tests that take bins for independent then find connections everywhere. Here the middle part of the cause
//! stays where it is and is laid against equally long parts of the effect, from well before to well after it
//! (truncated time shift; Harris 2020, Yuan and Shou 2024). Each part keeps its memory, its period and its trend,
//! and no seam is made; only the common time is lost. The p-value is the share of all shifts at which the series correlate
//! at *some* lag of the window as much as they do as they are, so that looking at many lags is paid for. There is
//! nothing random in it.
//!
//! `tests/connection.rs` measures the rate of false alarms and what is found; `docs/network-figures.md` has the table.

use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};
use serde::{Deserialize, Serialize};

/// Shifts for each lag of the window, when the run is long enough, and at least: the smallest p-value is one over
/// it, as all shifts within the window of the right one see the same connection.
const SHIFTS_PER_LAG: usize = 40;
const SHIFTS_PER_LAG_MIN: usize = 30;

/// Fewest bins that are worth a test.
pub const BIN_COUNT_MIN: usize = 80;

/// Spells off its usual value that a series must have, where it has one: fewer come together by chance, or do not, and no
/// share of shifts says more.
pub const SPELL_COUNT_MIN: usize = 8;

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
    /// At most these, and at most what a series of `bin_count` leaves room to test: one fortieth of
    /// it in all.
    #[must_use]
    pub fn fitted(self, bin_count: usize) -> Self {
        let room = (shifts_max(bin_count) / SHIFTS_PER_LAG_MIN).saturating_sub(1);
        let whole = self.lead_max + self.lag_max;
        if whole <= room {
            return self;
        }
        let lead_max = self.lead_max * room / whole.max(1);
        let lead_max = lead_max.max(self.lead_max.min(usize::from(room > 1)));
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

/// Shifts in a series of this length that leave a quarter of it to correlate.
const fn shifts_max(bin_count: usize) -> usize {
    2 * (3 * bin_count / 8) + 1
}

/// The highest correlation of one pair of series.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairCorrelation {
    /// Correlation coefficient at the lag where it is highest.
    pub coefficient: f64,
    /// That lag in bins; above zero when the effect comes later than the cause.
    pub lag_bins: i64,
    /// Share of shifts (none counted as one) whose highest coefficient in the window is at least as high.
    pub p_value: f64,
    /// The same against the highest of *all* pairs at each shift, in deviations of each pair over all shifts
    /// (Westfall and Young 1993, single step): what remains when many pairs are tried and the best is looked at.
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

/// Why a series is in no pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Untested {
    /// It has a value that is no number, and any in its place would be made up.
    NoNumber,
    /// It is the same all the time.
    Constant,
    /// It leaves its usual value too few times.
    TooFew {
        /// So many times.
        spell_count: usize,
    },
}

/// All pairs of a family, tested together.
#[derive(Debug, Clone, PartialEq)]
pub struct Family {
    /// By effect, then by cause; `None` where one of the two is untested.
    pub pairs: Vec<Vec<Option<PairCorrelation>>>,
    /// Of each cause, and of each effect, why it is in no pair.
    pub untested_causes: Vec<Option<Untested>>,
    /// See `untested_causes`.
    pub untested_effects: Vec<Option<Untested>>,
    /// The lags searched.
    pub window: LagWindow,
    /// Shifts that p-values rest on, none included.
    pub shift_count: usize,
}

impl Family {
    /// Pairs that could be tested.
    pub fn pair_count(&self) -> usize {
        self.pairs.iter().flatten().flatten().count()
    }
}

/// Tests every effect against every cause. All series are on the same bins, without holes.
///
/// # Errors
/// When the series are of different lengths, or too short.
pub fn family(
    causes: &[Vec<f64>],
    effects: &[Vec<f64>],
    window: LagWindow,
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
    let shifts = Shifts::new(window.fitted(bin_count), bin_count);
    let causes: Vec<_> = causes.iter().map(|one| shifts.cause(one)).collect();
    let effects: Vec<_> = effects.iter().map(|one| shifts.effect(one)).collect();
    let tested: Vec<Vec<Option<Tested>>> = effects
        .iter()
        .map(|effect| {
            let test = |cause: &Result<Vec<Complex<f64>>, _>| {
                Some(shifts.tested(cause.as_ref().ok()?, effect.as_ref().ok()?))
            };
            causes.iter().map(test).collect()
        })
        .collect();
    let mut of_all = vec![f64::NEG_INFINITY; shifts.count()];
    for one in tested.iter().flatten().flatten() {
        for (of_all, best) in of_all.iter_mut().zip(&one.best) {
            *of_all = of_all.max(one.in_deviations(*best));
        }
    }
    let pairs = tested.iter().map(|row| {
        let pair = |one: &Option<Tested>| one.as_ref().map(|one| one.pair(&shifts, &of_all));
        row.iter().map(pair).collect()
    });
    Ok(Family {
        pairs: pairs.collect(),
        untested_causes: causes
            .iter()
            .map(|one| one.as_ref().err().copied())
            .collect(),
        untested_effects: effects
            .iter()
            .map(|one| one.as_ref().err().copied())
            .collect(),
        window: shifts.window,
        shift_count: shifts.count(),
    })
}

/// How parts of series are laid against each other.
struct Shifts {
    window: LagWindow,
    bin_count: usize,
    /// Largest shift either way.
    reach: usize,
    forward: std::sync::Arc<dyn Fft<f64>>,
    back: std::sync::Arc<dyn Fft<f64>>,
}

/// An effect, ready for all shifts and lags.
struct Effect {
    spectrum: Vec<Complex<f64>>,
    /// Root of the sum of squares about the mean of the part at each place; `None` where it is constant.
    norms: Vec<Option<f64>>,
}

impl Shifts {
    fn new(window: LagWindow, bin_count: usize) -> Self {
        let wanted = SHIFTS_PER_LAG * window.lag_count();
        let mut planner = FftPlanner::new();
        Self {
            window,
            bin_count,
            reach: wanted.min(shifts_max(bin_count)) / 2,
            forward: planner.plan_fft_forward(bin_count),
            back: planner.plan_fft_inverse(bin_count),
        }
    }

    const fn count(&self) -> usize {
        2 * self.reach + 1
    }

    /// Places that a part of an effect can begin at.
    const fn place_count(&self) -> usize {
        2 * self.reach + self.window.lag_count()
    }

    /// Bins that are correlated.
    const fn length(&self) -> usize {
        self.bin_count + 1 - self.place_count()
    }

    fn spectrum(&self, values: impl Iterator<Item = f64>) -> Vec<Complex<f64>> {
        let mut buffer: Vec<_> = values.map(|value| Complex::new(value, 0.0)).collect();
        buffer.resize(self.bin_count, Complex::default());
        self.forward.process(&mut buffer);
        buffer
    }

    /// The middle part, of mean 0 and sum of squares 1.
    fn cause(&self, series: &[f64]) -> Result<Vec<Complex<f64>>, Untested> {
        check(series)?;
        let from = self.reach + self.window.lead_max;
        let middle = &series[from..from + self.length()];
        let mean = middle.iter().sum::<f64>() / middle.len() as f64;
        let square: f64 = middle.iter().map(|value| (value - mean).powi(2)).sum();
        if !is_moving(square, middle) {
            return Err(Untested::TooFew {
                spell_count: spell_count(series).unwrap_or(0),
            });
        }
        let scaled = middle.iter().map(|value| (value - mean) / square.sqrt());
        Ok(self.spectrum(scaled))
    }

    fn effect(&self, series: &[f64]) -> Result<Effect, Untested> {
        check(series)?;
        let mean = series.iter().sum::<f64>() / series.len() as f64;
        let centred: Vec<f64> = series.iter().map(|value| value - mean).collect();
        let (mut sums, mut squares) = (vec![0.0], vec![0.0]);
        let (mut sum, mut square) = (0.0, 0.0);
        for value in &centred {
            sum += value;
            square += value * value;
            sums.push(sum);
            squares.push(square);
        }
        let length = self.length();
        let norms = (0..self.place_count()).map(|from| {
            let until = from + length;
            let sum = sums[until] - sums[from];
            let of_part = squares[until] - squares[from] - sum * sum / length as f64;
            // Rounding leaves a constant part a scatter of its own.
            (of_part > 1e-10 * square).then(|| of_part.sqrt())
        });
        Ok(Effect {
            norms: norms.collect(),
            spectrum: self.spectrum(centred.iter().copied()),
        })
    }

    fn tested(&self, cause: &[Complex<f64>], effect: &Effect) -> Tested {
        let products = cause.iter().zip(&effect.spectrum);
        let mut buffer: Vec<_> = products
            .map(|(cause, effect)| cause.conj() * effect)
            .collect();
        self.back.process(&mut buffer);
        // A part that does not change does not correlate.
        let coefficients: Vec<f64> = buffer
            .iter()
            .zip(&effect.norms)
            .map(|(product, norm)| {
                norm.map_or(0.0, |norm| product.re / self.bin_count as f64 / norm)
            })
            .collect();
        let best: Vec<f64> = coefficients
            .windows(self.window.lag_count())
            .map(|lags| lags.iter().copied().fold(f64::NEG_INFINITY, f64::max))
            .collect();
        let here = &coefficients[self.reach..self.reach + self.window.lag_count()];
        let step = here.iter().position(|one| *one >= best[self.reach]);
        let signed = |bins: usize| i64::try_from(bins).unwrap_or(i64::MAX);
        let count = best.len() as f64;
        let mean = best.iter().sum::<f64>() / count;
        let variance = best.iter().map(|one| (one - mean).powi(2)).sum::<f64>() / count;
        Tested {
            lag_bins: signed(step.unwrap_or(0)) - signed(self.window.lead_max),
            best,
            mean,
            deviation: variance.sqrt(),
        }
    }
}

fn check(series: &[f64]) -> Result<(), Untested> {
    if !series.iter().all(|value| value.is_finite()) {
        return Err(Untested::NoNumber);
    }
    let mean = series.iter().sum::<f64>() / series.len() as f64;
    let square: f64 = series.iter().map(|value| (value - mean).powi(2)).sum();
    if !is_moving(square, series) {
        return Err(Untested::Constant);
    }
    match spell_count(series) {
        Some(spell_count) if spell_count < SPELL_COUNT_MIN => Err(Untested::TooFew { spell_count }),
        _ => Ok(()),
    }
}

/// Rounding of the mean leaves a constant series a scatter of its own.
fn is_moving(square: f64, series: &[f64]) -> bool {
    let largest = series.iter().map(|value| value.abs()).fold(0.0, f64::max);
    square.sqrt() > 1e-9 * largest * (series.len() as f64).sqrt()
}

/// How many times a series leaves the value that it has in more than half of its bins; `None` without such a value.
fn spell_count(series: &[f64]) -> Option<usize> {
    let mut ascending = series.to_vec();
    let middle = ascending.len() / 2;
    let usual = *ascending.select_nth_unstable_by(middle, f64::total_cmp).1;
    let is_off = |value: &f64| value.total_cmp(&usual).is_ne();
    if 2 * series.iter().filter(|value| is_off(value)).count() >= series.len() {
        return None;
    }
    let begins = series
        .windows(2)
        .filter(|two| !is_off(&two[0]) && is_off(&two[1]));
    Some(begins.count() + usize::from(series.first().is_some_and(is_off)))
}

/// One pair.
#[derive(Debug)]
struct Tested {
    lag_bins: i64,
    /// Highest coefficient in the window, by shift.
    best: Vec<f64>,
    /// Their mean and deviation.
    mean: f64,
    deviation: f64,
}

impl Tested {
    fn in_deviations(&self, best: f64) -> f64 {
        if self.deviation > 0.0 {
            (best - self.mean) / self.deviation
        } else {
            0.0
        }
    }

    fn pair(&self, shifts: &Shifts, of_all: &[f64]) -> PairCorrelation {
        let coefficient = self.best[shifts.reach];
        let count = |reached: usize| reached as f64 / shifts.count() as f64;
        // Equal up to rounding counts as reached.
        let reached = self.best.iter().filter(|one| **one >= coefficient - 1e-9);
        let own = self.in_deviations(coefficient) - 1e-9;
        PairCorrelation {
            coefficient,
            lag_bins: self.lag_bins,
            p_value: count(reached.count()),
            p_family: count(of_all.iter().filter(|one| **one >= own).count()),
        }
    }
}

#[cfg(test)]
mod tests {
    use hil_core::random::RandomStream;

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
                f64::max(left, 0.0)
            })
            .collect()
    }

    #[test]
    fn a_planted_lag_is_found_with_its_sign() {
        for (lag, seed) in [(11_i64, 1_u64), (0, 2), (-4, 3), (50, 4)] {
            let mut random = RandomStream::new(seed, "planted");
            let cause = outages(3_000, &mut random);
            let noise = series(3_000, 0.8, &mut random);
            let effect: Vec<f64> = (0..3_000_i64)
                .map(|bin| {
                    let from = usize::try_from(bin - lag).ok().and_then(|at| cause.get(at));
                    from.copied().unwrap_or(0.0) + noise[usize::try_from(bin).unwrap()]
                })
                .collect();
            let found = family(&[cause], &[effect], WINDOW).unwrap();
            let pair = found.pairs[0][0].unwrap();
            assert_eq!(pair.lag_bins, lag, "{pair:?}");
            assert!(pair.p_value <= 0.05 && pair.coefficient > 0.4, "{pair:?}");
        }
    }

    #[test]
    fn a_series_without_change_or_with_three_outages_is_in_no_pair_and_a_short_one_has_no_test() {
        let mut random = RandomStream::new(7, "constant");
        let moving = series(400, 0.5, &mut random);
        let mut seldom = vec![0.0; 400];
        for bin in [60, 61, 200, 320] {
            seldom[bin] = 1.0;
        }
        let causes = [vec![0.1; 400], moving.clone(), seldom];
        let mut broken = series(400, 0.5, &mut random);
        broken[17] = f64::NAN;
        let found = family(&causes, &[moving, broken], WINDOW).unwrap();
        assert_eq!(found.pairs[0][0], None);
        assert_eq!(found.pairs[0][2], None);
        assert_eq!(found.pairs[1], [None; 3]);
        let few = Some(Untested::TooFew { spell_count: 3 });
        assert_eq!(found.untested_causes, [Some(Untested::Constant), None, few]);
        assert_eq!(found.untested_effects, [None, Some(Untested::NoNumber)]);
        let itself = found.pairs[0][1].unwrap();
        assert_eq!(itself.lag_bins, 0);
        assert!((itself.coefficient - 1.0).abs() < 1e-9);
        assert_eq!(found.pair_count(), 1);
        assert_eq!(
            family(&[vec![0.0; 20]], &[vec![0.0; 20]], WINDOW).unwrap_err(),
            CorrelationError::TooShort { bin_count: 20 }
        );
        let error = family(&[vec![0.0; 20]], &[vec![0.0; 21]], WINDOW);
        assert_eq!(
            error.unwrap_err().to_string(),
            "series of 21 bins beside one of 20"
        );
    }

    #[test]
    fn the_window_shrinks_with_the_run() {
        assert_eq!(WINDOW.fitted(3_000), WINDOW);
        let short = WINDOW.fitted(600);
        assert_eq!((short.lead_max, short.lag_max), (2, 12));
        assert_eq!(WINDOW.fitted(BIN_COUNT_MIN).lag_count(), 2);
    }
}
