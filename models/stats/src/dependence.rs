//! How many independent observations a dependent series is worth, and whether that can be told.
//!
//! Losses come in bursts, and delays of successive messages are correlated. The variance of a mean is then
//! the spectral density at frequency zero over the count (Heidelberger and Welch 1981). It is taken from the
//! lowest [`LOW_COUNT`] ordinates of the periodogram of batch means, with equal weights, which gives Student
//! quantiles (Müller 2014; Lazarus, Lewis, Stock and Watson 2018). That holds when memory fades well within the
//! run, which is tested on the series: by Whittle's likelihood (1953) a memory that fades within a hundredth of
//! the run is held against a slower one, and against long memory (fractional noise, Beran 1994). Long memory
//! that is not ruled out enters the variance with the weight of its likelihood (Buckland, Burnham and Augustin
//! 1997), as the estimate for long memory has it (Robinson 2005; Abadir, Distaso and Giraitis 2009).
//!
//! `tests/coverage.rs` measures what the intervals cover; `docs/intervals.md` has the table.

use core::f64::consts::{PI, TAU};

use hil_core::interval::{Interval, IntervalMethod, Spread, TooSmall};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use statrs::function::gamma::gamma;

use crate::samples::Samples;
use crate::special::{
    ceil_count, incomplete_beta, invert, normal_quantile, place_of, student_quantile,
};

/// Batches that a series is cut into, at most.
const BATCHES_MAX: u64 = 2_048;

/// Ordinates of the periodogram that the variance of a mean is taken from.
const LOW_COUNT: usize = 16;

/// Values that a series must have: a quarter of them are ordinates.
const COUNT_MIN: u64 = 4 * LOW_COUNT as u64;

/// Cycles in the run of the frequency below which a memory that fades in time has a flat spectrum: the run is
/// `TAU` times as many correlation times long.
const CORNER_MIN: f64 = LOW_COUNT as f64;

/// By how much the logarithm of the likelihood of a slower memory may exceed that of one that fades in time.
const SLOW_GAIN_MAX: f64 = 1.0;

/// The same of long memory.
const LONG_GAIN_MAX: f64 = 4.0;

/// What long memory is given in advance, as a logarithm of its odds.
const LONG_PRIOR: f64 = 1.0;

/// Added to the estimate of the memory parameter, for its error.
const MEMORY_ALLOWANCE: f64 = 0.05;

/// Largest memory parameter that is worked with; 0.5 has no finite variance.
const MEMORY_MAX: f64 = 0.47;

/// The same of a slower memory.
const SLOW_PRIOR: f64 = -1.0;

/// Effective observations that the rarer outcome of a share must have.
const RARE_MIN: f64 = 5.0;

/// Effective observations that must lie beyond a quantile, and how many of the series itself there must be for each
/// rank beyond it: outcomes far out seem to forget sooner than the series does.
const BEYOND_MIN: f64 = 2.5;
const BEYOND_SERIES_MIN: f64 = 1.2;

/// Probability outside an interval on either side.
const TAIL: f64 = 0.025;

/// Batch means of a series of known length, filled in order.
#[derive(Debug, Clone)]
pub struct Batches {
    count: u64,
    per_batch: u64,
    sums: Vec<f64>,
    filled: u64,
    sum: f64,
    square: f64,
}

impl Batches {
    /// Empty ones for a series of `count` values.
    pub fn of_count(count: u64) -> Self {
        let per_batch = count.div_ceil(BATCHES_MAX).max(1);
        let batch_count = usize::try_from(count / per_batch).unwrap_or(0);
        Self {
            count,
            per_batch,
            sums: vec![0.0; batch_count],
            filled: 0,
            sum: 0.0,
            square: 0.0,
        }
    }

    /// Those of `values`.
    pub fn of(values: impl ExactSizeIterator<Item = f64>) -> Self {
        let mut batches = Self::of_count(values.len() as u64);
        values.for_each(|value| batches.push(value, 1));
        batches
    }

    /// Those of outcomes of which runs of ones are given by place and length, in order.
    pub fn of_runs(count: u64, runs: impl IntoIterator<Item = (u64, u64)>) -> Self {
        let mut batches = Self::of_count(count);
        for (place, length) in runs {
            batches.push(0.0, place.saturating_sub(batches.filled));
            batches.push(1.0, length);
        }
        batches.push(0.0, count.saturating_sub(batches.filled));
        batches
    }

    /// The next value, `times` in a row.
    pub fn push(&mut self, value: f64, times: u64) {
        let mut left = times.min(self.count - self.filled);
        self.sum += value * left as f64;
        self.square += value * value * left as f64;
        while left > 0 {
            let batch = self.filled / self.per_batch;
            let here = left.min((batch + 1) * self.per_batch - self.filled);
            let sum = usize::try_from(batch).ok();
            // What does not fill a batch is in the mean alone.
            if let Some(sum) = sum.and_then(|batch| self.sums.get_mut(batch)) {
                *sum += value * here as f64;
            }
            self.filled += here;
            left -= here;
        }
    }

    /// Mean of all values; not a number without any.
    pub fn mean(&self) -> f64 {
        self.sum / self.count as f64
    }

    /// Variance of a single value.
    fn variance(&self) -> f64 {
        let mean = self.mean();
        (self.square / self.count as f64 - mean * mean).max(0.0)
    }

    /// The series' memory, or that it is too short for any to be found.
    fn memory(&self) -> Result<Memory, TooSmall> {
        if self.count < COUNT_MIN {
            return Err(TooSmall::Few {
                effective: self.count,
                needed: COUNT_MIN,
            });
        }
        Ok(Memory::of(self))
    }

    /// How many independent values would have a mean of the same variance, at most all; or why that
    /// cannot be told.
    ///
    /// # Errors
    /// When the series is too short, or its memory does not fade in time.
    pub fn effective_count(&self) -> Result<f64, TooSmall> {
        let memory = self.memory()?;
        memory.fades()?;
        Ok(self.effective_by(&memory, &memory))
    }

    /// By the long memory of `other` where that is the stronger one.
    fn effective_by(&self, own: &Memory, other: &Memory) -> f64 {
        let variance = self.variance();
        let of_mean = own
            .variance_of_mean(other)
            .max(variance / self.count as f64);
        if of_mean > 0.0 {
            variance / of_mean
        } else {
            self.count as f64
        }
    }

    /// The interval of the mean.
    pub fn mean_interval(&self) -> Spread {
        let effective = match self.effective_count() {
            Err(why) => return Spread::Unknown(why),
            Ok(effective) if effective < 2.0 * RARE_MIN => {
                return Spread::Unknown(too_few(effective, 2.0 * RARE_MIN));
            }
            Ok(effective) => effective,
        };
        let reach = student() * (self.variance() / effective).sqrt();
        let mean = self.mean();
        Spread::Known(Interval::new(
            mean - reach,
            mean + reach,
            IntervalMethod::EffectiveMean,
        ))
    }

    /// The interval of the share of ones, in a series of zeros and ones.
    ///
    /// Its end towards the nearer one of none and all is that of a sample of which it is known that it had
    /// [`RARE_MIN`] of the rarer outcome (Cohen and Sackrowitz 1989): others have no interval.
    pub fn share_interval(&self) -> Spread {
        let share = self.mean();
        if self.count == 0 || !(share > 0.0 && share < 1.0) {
            return Spread::Unknown(too_few(0.0, RARE_MIN));
        }
        let effective = match self.effective_count() {
            Err(why) => return Spread::Unknown(why),
            Ok(effective) => effective,
        };
        let worth = effective * student_loss();
        let rare = share.min(1.0 - share);
        if rare * worth < RARE_MIN {
            return Spread::Unknown(too_few(worth, RARE_MIN / rare));
        }
        let (near, far) = (selected_end(rare, worth, RARE_MIN), far_end(rare, worth));
        let (low, high) = if share <= 0.5 {
            (near, far)
        } else {
            (1.0 - far, 1.0 - near)
        };
        Spread::Known(Interval::new(low, high, IntervalMethod::EffectiveShare))
    }
}

fn too_few(effective: f64, needed: f64) -> TooSmall {
    TooSmall::Few {
        effective: ceil_count(effective.floor()) as u64,
        needed: ceil_count(needed) as u64,
    }
}

/// Student's quantile of the low ordinates.
fn student() -> f64 {
    student_quantile(1.0 - TAIL, 2.0 * LOW_COUNT as f64)
}

/// What is left of a sample whose variance is estimated: the square of the normal quantile over Student's.
fn student_loss() -> f64 {
    (normal_quantile(1.0 - TAIL) / student()).powi(2)
}

/// Upper end for a share of `worth` trials, mid-p.
fn far_end(share: f64, worth: f64) -> f64 {
    let (k, rest) = (share * worth, (1.0 - share) * worth);
    invert(1.0 - TAIL, 0.0, 1.0, |x| {
        incomplete_beta(k + 0.5, rest + 0.5, x)
    })
}

/// Lower end, given that at least `least` were seen.
fn selected_end(share: f64, worth: f64, least: f64) -> f64 {
    let (k, rest) = (share * worth, (1.0 - share) * worth);
    invert(0.0, 0.0, share, |x| {
        let seen = incomplete_beta(k + 0.5, rest + 0.5, x);
        let selected = incomplete_beta(least + 0.5, worth - least + 0.5, x);
        if seen < TAIL * selected || selected <= 0.0 {
            -1.0
        } else {
            1.0
        }
    })
}

/// What the spectrum of a series says of its memory.
#[derive(Debug)]
struct Memory {
    batch_count: f64,
    /// The lowest ordinates: variance of a batch mean at this frequency.
    low: Vec<f64>,
    /// Variance of the mean by the short memory that fits best.
    short: f64,
    /// Cycles in the run where the best of all short memories has its corner, and the gain of that one over those
    /// that fade in time.
    corner: f64,
    slow_gain: f64,
    /// Gain of long memory over short, and its parameter.
    long_gain: f64,
    parameter: f64,
}

/// Neighbouring ordinates taken together: mean frequency, mean ordinate, how many.
struct Band {
    frequency: f64,
    ordinate: f64,
    weight: f64,
}

/// A spectrum that fits.
#[derive(Clone, Copy)]
struct Fit {
    /// Minus the logarithm of its likelihood.
    misfit: f64,
    /// Its value at frequency zero.
    at_zero: f64,
    /// Corner in cycles, or the memory parameter.
    parameter: f64,
}

impl Fit {
    const NONE: Self = Self {
        misfit: f64::INFINITY,
        at_zero: 0.0,
        parameter: 0.0,
    };

    /// Whittle's likelihood of the shape `values` over the bands, its scale fitted.
    fn of(bands: &[Band], values: &[f64], at_zero: f64, parameter: f64) -> Self {
        let (mut total, mut scale, mut logarithm) = (0.0, 0.0, 0.0);
        for (band, value) in bands.iter().zip(values) {
            total += band.weight;
            scale += band.weight * band.ordinate / value;
            logarithm += band.weight * value.ln();
        }
        let scale = (scale / total).max(f64::MIN_POSITIVE);
        Self {
            misfit: total * scale.ln() + logarithm,
            at_zero: scale * at_zero,
            parameter,
        }
    }

    fn better(self, other: Self) -> Self {
        if other.misfit < self.misfit {
            other
        } else {
            self
        }
    }
}

/// Spectrum of batch means of a process whose correlation fades as `exp(-t / tau)`, with `theta` batches' length over
/// `tau`; without aliasing left out, as the autocovariances of averages have it.
fn fading(frequency: f64, theta: f64) -> f64 {
    let phi = (-theta).exp();
    let at_lag = ((1.0 - phi) / theta).powi(2);
    let variance = 2.0 / (theta * theta) * (theta - 1.0 + phi);
    let cos = frequency.cos();
    variance + 2.0 * at_lag * (cos - phi) / (1.0 - 2.0 * phi * cos + phi * phi)
}

/// `count` values from `from` to `to`, in equal ratios.
fn ratios(from: f64, to: f64, count: i32) -> impl Iterator<Item = f64> {
    let step = (to / from).powf(1.0 / f64::from(count - 1));
    (0..count).map(move |index| from * step.powi(index))
}

/// Weight of a model against another, by the gain in the logarithm of its likelihood and what it is given in advance.
fn weight(gain: f64, prior: f64) -> f64 {
    1.0 / (1.0 + (-gain - prior).exp())
}

/// Share of white noise in the spectrum at zero of a fading part.
const WHITE: [f64; 8] = [0.0, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3];

impl Memory {
    fn of(batches: &Batches) -> Self {
        let ordinates = periodogram(batches);
        let batch_count = batches.sums.len() as f64;
        let all = ordinates.len() as f64;
        let bands = bands(&ordinates, batch_count);
        let mut values = vec![0.0; bands.len()];
        let shape = |values: &mut Vec<f64>, of: &dyn Fn(f64) -> f64| {
            for (value, band) in values.iter_mut().zip(&bands) {
                *value = of(band.frequency);
            }
        };
        shape(&mut values, &|_| 1.0);
        let (mut in_time, mut slow) = (Fit::of(&bands, &values, 1.0, batch_count), Fit::NONE);
        for corner in ratios(4.0, all, 16) {
            let theta = TAU * corner / batch_count;
            let at_zero = fading(0.0, theta);
            let mut faded = vec![0.0; bands.len()];
            shape(&mut faded, &|frequency| fading(frequency, theta));
            for white in WHITE {
                for (value, faded) in values.iter_mut().zip(&faded) {
                    *value = faded + white * at_zero;
                }
                let fit = Fit::of(&bands, &values, at_zero * (1.0 + white), corner);
                if corner >= CORNER_MIN {
                    in_time = in_time.better(fit);
                } else {
                    slow = slow.better(fit);
                }
            }
        }
        let mut long = Fit::NONE;
        for corner in ratios(8.0, 2.0 * all, 8).map(Some).chain([None]) {
            let mut faded = vec![1.0; bands.len()];
            if let Some(corner) = corner {
                let theta = TAU * corner / batch_count;
                shape(&mut faded, &|frequency| fading(frequency, theta));
            }
            for tenth in 1..10 {
                let memory = 0.05 * f64::from(tenth);
                shape(&mut values, &|frequency| {
                    (2.0 * (0.5 * frequency).sin()).powf(-2.0 * memory)
                });
                for (value, faded) in values.iter_mut().zip(&faded) {
                    *value *= faded;
                }
                long = long.better(Fit::of(&bands, &values, 1.0, memory));
            }
        }
        Self {
            batch_count,
            low: ordinates[..LOW_COUNT].to_vec(),
            short: in_time.at_zero.max(
                in_time.at_zero
                    + weight(in_time.misfit - slow.misfit, SLOW_PRIOR)
                        * (slow.at_zero - in_time.at_zero),
            ) / batch_count,
            corner: in_time.better(slow).parameter,
            slow_gain: in_time.misfit - slow.misfit,
            long_gain: in_time.misfit - long.misfit,
            parameter: long.parameter,
        }
    }

    /// An error when memory does not fade in time.
    fn fades(&self) -> Result<(), TooSmall> {
        if self.slow_gain > SLOW_GAIN_MAX {
            // Two correlation times are worth one observation.
            return Err(too_few(PI * self.corner, PI * CORNER_MIN));
        }
        if self.long_gain > LONG_GAIN_MAX {
            let by_long = self.by_long(self.parameter);
            let single = self.low.iter().sum::<f64>() / LOW_COUNT as f64;
            return Err(TooSmall::Memory {
                memory: self.parameter,
                effective: ceil_count((single / by_long).floor()).max(1) as u64,
            });
        }
        Ok(())
    }

    /// Variance of the mean, long memory weighed by its likelihood; by that of `other` where it is the stronger.
    fn variance_of_mean(&self, other: &Self) -> f64 {
        let low = self.low.iter().sum::<f64>() / LOW_COUNT as f64 / self.batch_count;
        let short = low.max(self.short);
        let gain = self.long_gain.max(other.long_gain);
        let parameter = if other.long_gain > self.long_gain {
            other.parameter
        } else {
            self.parameter.max(other.parameter)
        };
        let long = self.by_long(parameter + MEMORY_ALLOWANCE).max(short);
        short + weight(gain, LONG_PRIOR) * (long - short)
    }

    /// Variance of the mean with this memory parameter.
    fn by_long(&self, memory: f64) -> f64 {
        let memory = memory.min(MEMORY_MAX);
        let scale = self.low.iter().zip(1..).map(|(ordinate, cycle)| {
            let frequency = TAU * f64::from(cycle) / self.batch_count;
            ordinate * frequency.powf(2.0 * memory)
        });
        let scale = scale.sum::<f64>() / LOW_COUNT as f64;
        let factor = 2.0 * gamma(1.0 - 2.0 * memory) * (PI * memory).sin()
            / (memory * (1.0 + 2.0 * memory))
            / TAU;
        factor * scale * self.batch_count.powf(2.0 * memory - 1.0)
    }
}

/// The lower quarter of the frequencies, from one cycle in the run on; white noise has its variance there.
fn periodogram(batches: &Batches) -> Vec<f64> {
    let count = batches.sums.len();
    let scale = 1.0 / batches.per_batch as f64;
    let mean = batches.sums.iter().sum::<f64>() / count as f64;
    let centred = batches.sums.iter().map(|sum| (sum - mean) * scale);
    let mut buffer: Vec<_> = centred.map(|value| Complex::new(value, 0.0)).collect();
    FftPlanner::new()
        .plan_fft_forward(count)
        .process(&mut buffer);
    let ordinates = buffer[1..=count / 4].iter();
    ordinates.map(|one| one.norm_sqr() / count as f64).collect()
}

/// Single ordinates up to twice [`LOW_COUNT`], then bands of a sixteenth of their frequency.
fn bands(ordinates: &[f64], batch_count: f64) -> Vec<Band> {
    let mut bands = Vec::new();
    let mut from = 0;
    while from < ordinates.len() {
        let width = (from / LOW_COUNT).max(1);
        let until = (from + if from < 2 * LOW_COUNT { 1 } else { width }).min(ordinates.len());
        let weight = (until - from) as f64;
        bands.push(Band {
            frequency: TAU * 0.5 * (from + 1 + until) as f64 / batch_count,
            ordinate: ordinates[from..until].iter().sum::<f64>() / weight,
            weight,
        });
        from = until;
    }
    bands
}

/// Quantiles of a series with their intervals.
#[derive(Debug)]
pub struct Quantiles<'a> {
    series: &'a Samples,
    ascending: &'a Samples,
    /// Of the ranks: the memory of the series itself, which an outcome far out hides.
    ranks: Result<(Memory, f64), TooSmall>,
}

impl<'a> Quantiles<'a> {
    /// Of a series in the order of time, and the same values in ascending order.
    pub fn of(series: &'a Samples, ascending: &'a Samples) -> Self {
        let mut ranks = Batches::of_count(series.len() as u64);
        for value in series.iter() {
            ranks.push(ascending.count_below(value) as f64, 1);
        }
        let memory = ranks.memory().and_then(|memory| {
            memory.fades()?;
            let worth = ranks.effective_by(&memory, &memory) * student_loss();
            Ok((memory, worth))
        });
        Self {
            series,
            ascending,
            ranks: memory,
        }
    }

    /// The interval of the quantile `share`; `None` when no value differs from another.
    pub fn interval(&self, share: f64) -> Option<Spread> {
        let count = self.ascending.len();
        let last = count.checked_sub(1)?;
        if self.ascending.at(0) == self.ascending.at(last) {
            return None;
        }
        Some(
            self.ranks(share)
                .map_or_else(Spread::Unknown, |(low, high)| {
                    let [low, high] = [low, high].map(|place| self.ascending.at(place) as f64);
                    Spread::Known(Interval::new(low, high, IntervalMethod::EffectiveRanks))
                }),
        )
    }

    /// Places of both ends.
    fn ranks(&self, share: f64) -> Result<(usize, usize), TooSmall> {
        let (series, series_worth) = match &self.ranks {
            Ok((memory, worth)) => (memory, *worth),
            Err(why) => return Err(*why),
        };
        let rare = share.min(1.0 - share);
        if rare * series_worth < BEYOND_SERIES_MIN {
            return Err(too_few(series_worth, BEYOND_SERIES_MIN / rare));
        }
        let count = self.ascending.len();
        let value = self.ascending.at(place_of(share, count));
        // Of equal values some lie beyond the quantile: whichever outcome is nearer to it.
        let below = self.ascending.count_below(value) as f64 / count as f64;
        let upto = self.ascending.count_below(value.saturating_add(1)) as f64 / count as f64;
        let is_nearer = (below - share).abs() < (upto - share).abs();
        let is_below = below > 0.0 && (is_nearer || upto >= 1.0);
        let outcomes = self
            .series
            .iter()
            .map(|one| one < value || (one == value && !is_below));
        let mut batches = Batches::of_count(count as u64);
        for is_inside in outcomes {
            batches.push(f64::from(u8::from(is_inside)), 1);
        }
        let memory = batches.memory()?;
        memory.fades()?;
        let worth = batches.effective_by(&memory, series) * student_loss();
        if rare * worth < BEYOND_MIN {
            return Err(too_few(worth, BEYOND_MIN / rare));
        }
        let (near, far) = (selected_end(rare, worth, BEYOND_MIN), far_end(rare, worth));
        let (low, high) = if share <= 0.5 {
            (near, far)
        } else {
            (1.0 - far, 1.0 - near)
        };
        let place = |end: f64| ceil_count(end * count as f64);
        let (low, high) = (place(low).max(1) - 1, place(high).min(count - 1));
        Ok((low, high))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn runs_fill_the_same_batches_as_single_outcomes() {
        let runs = [(3, 2), (1_000, 4_000), (9_999, 1)];
        let is_one = |place: u64| {
            runs.iter()
                .any(|(from, length)| (*from..from + length).contains(&place))
        };
        let single = Batches::of(
            (0..10_000_u32)
                .map(|place| f64::from(u8::from(is_one(u64::from(place)))))
                .collect::<Vec<_>>()
                .into_iter(),
        );
        let by_run = Batches::of_runs(10_000, runs);
        assert_eq!(single.sums, by_run.sums);
        assert!((by_run.mean() - 0.4003).abs() < 1e-12);
    }

    #[test]
    fn independent_outcomes_keep_their_count_and_a_walk_has_none() {
        let mut random = RandomStream::new(1, "dependence");
        let white = Batches::of(vec![0.0; 20_000].into_iter().map(|_| random.normal()));
        let effective = white.effective_count().unwrap();
        assert!(effective > 12_000.0, "{effective}");
        let mut at = 0.0;
        let walk = Batches::of(vec![0.0; 20_000].into_iter().map(|_| {
            at += random.normal();
            at
        }));
        assert!(walk.effective_count().is_err());
    }

    #[test]
    fn what_was_seen_too_seldom_has_no_interval() {
        let none = Batches::of_runs(60_000, []).share_interval();
        assert_eq!(
            none,
            Spread::Unknown(TooSmall::Few {
                effective: 0,
                needed: 5
            })
        );
        let one_outage = Batches::of_runs(60_000, [(30_000, 500)]).share_interval();
        assert_eq!(one_outage.known(), None, "{one_outage}");
        let few = Batches::of_runs(40, [(3, 1), (9, 1)]).share_interval();
        assert_eq!(
            few.to_string(),
            "sample too small: 40 effective observations, 64 needed"
        );
    }

    #[test]
    fn values_that_do_not_vary_have_no_interval_and_ties_are_no_trouble() {
        let same: Samples = vec![7; 1_000].into_iter().collect();
        assert_eq!(Quantiles::of(&same, &same).interval(0.5), None);
        let mut random = RandomStream::new(2, "ties");
        let coarse: Samples = (0..20_000).map(|_| i64::from(random.chance(0.3))).collect();
        let ascending = coarse.ascending();
        let quantiles = Quantiles::of(&coarse, &ascending);
        let at = |share| quantiles.interval(share).unwrap().known().unwrap();
        assert!(at(0.5).holds(0.0) && at(0.9).holds(1.0));
    }
}
