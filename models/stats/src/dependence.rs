//! How many independent observations a dependent series is worth.
//!
//! Losses come in bursts, and delays of successive messages are correlated. The variance of a mean is then
//! the spectral density at frequency zero over the count (Heidelberger and Welch 1981), which no run shows: it is
//! extrapolated from its lowest frequencies. The periodogram of batch means is held against models by Whittle's
//! likelihood (1953): white noise; memory that fades exponentially, in white noise; and long memory (fractional noise, Beran
//! 1994), also fading at high frequencies and in white noise. Each says what the variance of the mean is; the interval is
//! that of all models, each with the weight of its likelihood (Bayesian model averaging; Hoeting, Madigan, Raftery and Volinsky
//! 1999), and never narrower than that of the eight lowest ordinates with equal weights and
//! Student's quantile (Lazarus, Lewis, Stock and Watson 2018), which assumes no model.
//!
//! What is worth too few observations for that has no interval. `tests/coverage.rs` measures what the intervals
//! cover; `docs/intervals.md` has the table.

use core::f64::consts::{PI, TAU};

use hil_core::interval::{Interval, IntervalMethod, Spread, TooSmall};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use statrs::function::gamma::gamma;

use crate::samples::Samples;
use crate::special::{
    ceil_count, incomplete_beta, invert, normal_distribution, normal_quantile, place_of,
    student_quantile,
};

/// Batches that a series is cut into, at most.
const BATCHES_MAX: u64 = 2_048;

/// Ordinates of the periodogram that bound the variance of a mean from below.
const LOW_COUNT: usize = 8;

/// Neighbouring ordinates from this place on are taken together.
const SINGLE_COUNT: usize = 16;

/// Values that a series must have: a quarter of them are ordinates.
pub const COUNT_MIN: u64 = 4 * SINGLE_COUNT as u64;

/// What long memory is given in advance, for a mean or share and for the outcomes beyond a quantile; of the rest white noise has
/// [`WHITE_PRIOR`], fading memory the other part.
const LONG_PRIOR: f64 = 0.5;
const LONG_PRIOR_RANKS: f64 = 0.35;
const WHITE_PRIOR: f64 = 0.46;

/// Effective observations that the rarer outcome of a share must have.
const RARE_MIN: f64 = 5.0;

/// Effective observations that must lie beyond a quantile.
const BEYOND_MIN: f64 = 1.4;

/// How much nearer to the middle the quantile is that a quantile far out is compared with, and effective observations that
/// must lie beyond that one for each rank beyond it. Few clusters far out do not show how long clusters are, those nearer by do.
const NEARER: f64 = 10.0;
const NEARER_MIN: f64 = 0.9;

/// Effective ranks that must lie beyond a quantile: a series that is slow against the run may have one cluster there, whose
/// length says nothing of others.
const RANKS_MIN: f64 = 0.2;

/// The same where the quantile with [`OUTERMOST`] beyond is [`SKEWED`] times as far from the median as its opposite: few busy
/// periods of a queue carry it, and a run that by luck has none of the longest looks like one of a less loaded queue.
const RANKS_MIN_SKEWED: f64 = 4.0;

/// The same where such a series also forgets more slowly the farther out it is: with [`OUTER`] of it beyond it is worth less than
/// [`SLOWER`] of what it is at the median. Luck in the few outcomes far out does not show there.
const RANKS_MIN_SLOWER: f64 = 6.0;
const OUTER: f64 = 0.1;
const OUTERMOST: f64 = 0.01;
const SLOWER: f64 = 0.8;
const SKEWED: f64 = 2.0;

/// Tail index of clusters' sizes above which few clusters do not show the variance of one, how many must be there for an index,
/// and what part of the sample is then left.
const HEAVY: f64 = 0.1;
const CLUSTERS_MIN: usize = 10;
const HEAVY_LOSS: f64 = 0.5;

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
            let here = left.min((batch + 1).saturating_mul(self.per_batch) - self.filled);
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

    /// What the spectrum says of the mean, or that the series is too short to have one.
    fn at_zero(&self, long_prior: f64) -> Result<AtZero, TooSmall> {
        if self.count < COUNT_MIN {
            return Err(TooSmall {
                effective: self.count,
                needed: COUNT_MIN,
            });
        }
        Ok(AtZero::of(self, long_prior))
    }

    /// How many independent values would have a mean of the same variance, at most all.
    ///
    /// # Errors
    /// When the series is too short.
    pub fn effective_count(&self) -> Result<f64, TooSmall> {
        let own = self.at_zero(LONG_PRIOR)?;
        Ok(self.effective_by(own, own.ratio))
    }

    /// With the ratio of another series where that is larger.
    fn effective_by(&self, own: AtZero, other_ratio: f64) -> f64 {
        let variance = self.variance();
        let of_mean = own.low * own.ratio.max(other_ratio);
        let of_mean = of_mean.max(variance / self.count as f64);
        if of_mean > 0.0 {
            variance / of_mean
        } else {
            self.count as f64
        }
    }

    /// How many ones, or zeros, each row of batches with some has.
    fn clusters(&self, is_one: bool) -> Vec<f64> {
        let mut clusters = Vec::new();
        let mut is_within = false;
        for sum in &self.sums {
            let size = if is_one {
                *sum
            } else {
                self.per_batch as f64 - sum
            };
            match clusters.last_mut() {
                Some(cluster) if is_within && size > 0.0 => *cluster += size,
                _ if size > 0.0 => clusters.push(size),
                _ => {}
            }
            is_within = size > 0.0;
        }
        clusters
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
    /// five of the rarer outcome (Cohen and Sackrowitz 1989): others have no interval. Where the clusters of that outcome have a
    /// heavy tail, the longest of a run is shorter than the longest there are, and the other end is that of half the sample.
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
        let heavy = tail_index(&self.clusters(share <= 0.5)).is_some_and(|index| index > HEAVY);
        let of_far = worth * if heavy { HEAVY_LOSS } else { 1.0 };
        let (near, far) = (selected_end(rare, worth, RARE_MIN), far_end(rare, of_far));
        let (low, high) = if share <= 0.5 {
            (near, far)
        } else {
            (1.0 - far, 1.0 - near)
        };
        Spread::Known(Interval::new(low, high, IntervalMethod::EffectiveShare))
    }
}

/// The tail index of sizes by a generalized Pareto distribution (Zhang and Stephens 2009): 0 of an exponential tail, 0.5 where
/// the variance ceases to be finite. `None` of too few.
fn tail_index(sizes: &[f64]) -> Option<f64> {
    let count = sizes.len();
    if count < CLUSTERS_MIN {
        return None;
    }
    let mut excess = sizes.to_vec();
    excess.sort_by(f64::total_cmp);
    // Sizes are whole numbers: each stands for those nearer to it than to the next.
    let least = excess[0] - 0.5;
    for size in &mut excess {
        *size -= least;
    }
    let (n, quarter, largest) = (count as f64, excess[(count + 2) / 4 - 1], excess[count - 1]);
    let index = |theta: f64| excess.iter().map(|one| (-theta * one).ln_1p()).sum::<f64>() / n;
    let thetas = 30 + ceil_count(n.sqrt().floor());
    let of_theta = (1..=thetas).map(|place| {
        let spread = 1.0 - (thetas as f64 / (place as f64 - 0.5)).sqrt();
        let theta = 1.0 / largest + spread / (3.0 * quarter);
        let index = index(theta);
        (theta, n * ((-theta / index).ln() - index - 1.0))
    });
    let of_theta: Vec<_> = of_theta.collect();
    let best = of_theta
        .iter()
        .map(|one| one.1)
        .fold(f64::NEG_INFINITY, f64::max);
    let (mut weights, mut sum) = (0.0, 0.0);
    for (theta, likelihood) in of_theta {
        let weight = (likelihood - best).exp();
        weights += weight;
        sum += weight * theta;
    }
    Some(index(sum / weights))
}

fn too_few(effective: f64, needed: f64) -> TooSmall {
    TooSmall {
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

/// The spectrum at frequency zero.
#[derive(Debug, Clone, Copy)]
struct AtZero {
    /// Variance of the mean by the lowest ordinates.
    low: f64,
    /// Variance of the mean that all models give, over that; at least 1.
    ratio: f64,
}

/// Neighbouring ordinates taken together: mean frequency, mean ordinate, how many.
struct Band {
    frequency: f64,
    ordinate: f64,
    weight: f64,
}

/// Models of one kind: minus the logarithm of the likelihood, and variance of the mean, of each.
#[derive(Debug, Default)]
struct Models(Vec<[f64; 2]>);

impl Models {
    /// One more, of the shape `values` over the bands; its scale is fitted. `of_mean` is the variance of the mean where the
    /// scale is 1.
    fn push(&mut self, bands: &[Band], values: impl Iterator<Item = f64>, of_mean: f64) {
        let (mut total, mut scale, mut logarithm) = (0.0, 0.0, 0.0);
        for (band, value) in bands.iter().zip(values) {
            total += band.weight;
            scale += band.weight * band.ordinate / value;
            logarithm += band.weight * value.ln();
        }
        let scale = (scale / total).max(f64::MIN_POSITIVE);
        self.0
            .push([total * scale.ln() + logarithm, scale * of_mean]);
    }

    fn least(&self) -> f64 {
        self.0
            .iter()
            .map(|[misfit, _]| *misfit)
            .fold(f64::INFINITY, f64::min)
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

/// White noise beside memory: over the spectrum of fading memory at zero, and of long memory at its lowest ordinate.
const WHITE: [f64; 7] = [0.0, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0];

/// Variance of the mean of `count` values with a spectrum of `frequency.powf(-2 * memory)` (Beran 1994).
fn long_variance(memory: f64, count: f64) -> f64 {
    let factor = 2.0 * gamma(1.0 - 2.0 * memory) * (PI * memory).sin()
        / (memory * (1.0 + 2.0 * memory))
        / TAU;
    factor * count.powf(2.0 * memory - 1.0)
}

impl AtZero {
    fn of(batches: &Batches, long_prior: f64) -> Self {
        let ordinates = periodogram(batches);
        let count = batches.sums.len() as f64;
        let bands = bands(&ordinates, count);
        let low = ordinates[..LOW_COUNT].iter().sum::<f64>() / LOW_COUNT as f64 / count;
        let mut flat = Models::default();
        flat.push(&bands, bands.iter().map(|_| 1.0), 1.0 / count);
        let highest = ordinates.len() as f64;
        let rest = 1.0 - long_prior;
        let faded = fading_models(&bands, highest, count);
        let kinds = [
            (WHITE_PRIOR * rest, flat),
            ((1.0 - WHITE_PRIOR) * rest, faded),
            (long_prior, long_models(&bands, highest, count)),
        ];
        let of_mean = averaged(&kinds);
        Self {
            low,
            ratio: if low > 0.0 {
                (of_mean / low).max(1.0)
            } else {
                1.0
            },
        }
    }
}

/// Memory that fades with a corner at one and a half cycles in the run, or more.
fn fading_models(bands: &[Band], highest: f64, count: f64) -> Models {
    let mut models = Models::default();
    for corner in ratios(1.5, highest, 16) {
        let theta = TAU * corner / count;
        let at_zero = fading(0.0, theta);
        let faded: Vec<f64> = bands
            .iter()
            .map(|band| fading(band.frequency, theta))
            .collect();
        for white in WHITE {
            let values = faded.iter().map(|faded| faded + white * at_zero);
            models.push(bands, values, at_zero * (1.0 + white) / count);
        }
    }
    models
}

/// Long memory, Hurst's exponent from 0.55 to 0.95.
fn long_models(bands: &[Band], highest: f64, count: f64) -> Models {
    let mut models = Models::default();
    for corner in [None, Some(0.1 * highest), Some(0.5 * highest)] {
        let fades = |frequency| {
            corner.map_or(1.0, |corner| {
                let theta = TAU * corner / count;
                fading(frequency, theta) / fading(0.0, theta)
            })
        };
        for twentieth in 1..10 {
            let memory = 0.05 * f64::from(twentieth);
            let power = |band: &Band| {
                fades(band.frequency) * (2.0 * (0.5 * band.frequency).sin()).powf(-2.0 * memory)
            };
            let powers: Vec<f64> = bands.iter().map(power).collect();
            for white in WHITE {
                let white = white * powers[0];
                let values = powers.iter().map(|power| power + white);
                models.push(bands, values, long_variance(memory, count) + white / count);
            }
        }
    }
    models
}

/// The variance of a normal distribution as wide, between the ends of an interval, as the mixture of all models: each kind with
/// its prior weight, and within it each model with the same.
fn averaged(kinds: &[(f64, Models)]) -> f64 {
    let least = kinds
        .iter()
        .map(|(_, models)| models.least())
        .fold(f64::INFINITY, f64::min);
    let weighed = kinds.iter().flat_map(|(prior, models)| {
        let each = prior / models.0.len() as f64;
        models
            .0
            .iter()
            .map(move |[misfit, of_mean]| (each * (least - misfit).exp(), of_mean.sqrt()))
    });
    // Whatever weighs less does not move the ends.
    let weighed: Vec<(f64, f64)> = weighed.filter(|(weight, _)| *weight > 1e-7).collect();
    let total: f64 = weighed.iter().map(|(weight, _)| weight).sum();
    let widest = weighed
        .iter()
        .map(|(_, deviation)| *deviation)
        .fold(0.0, f64::max);
    let reach = invert(1.0 - TAIL, 0.0, 3.0 * widest, |reach| {
        let inside = weighed
            .iter()
            .map(|(weight, deviation)| weight * normal_distribution(reach / deviation));
        inside.sum::<f64>() / total
    });
    (reach / normal_quantile(1.0 - TAIL)).powi(2)
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

/// Single ordinates up to twice [`SINGLE_COUNT`], then bands of a sixteenth of their frequency.
fn bands(ordinates: &[f64], batch_count: f64) -> Vec<Band> {
    let mut bands = Vec::new();
    let mut from = 0;
    while from < ordinates.len() {
        let width = (from / SINGLE_COUNT).max(1);
        let until = (from + if from < 2 * SINGLE_COUNT { 1 } else { width }).min(ordinates.len());
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
    /// Ratio and effective count of the ranks: the memory of the series itself, which an outcome far out hides.
    ranks: Result<(f64, f64), TooSmall>,
}

impl<'a> Quantiles<'a> {
    /// Of a series in the order of time, and the same values in ascending order.
    pub fn of(series: &'a Samples, ascending: &'a Samples) -> Self {
        let mut ranks = Batches::of_count(series.len() as u64);
        for value in series.iter() {
            ranks.push(ascending.count_below(value) as f64, 1);
        }
        Self {
            series,
            ascending,
            ranks: ranks.at_zero(LONG_PRIOR_RANKS).map(|at_zero| {
                let ratio = at_zero.ratio;
                (ratio, ranks.effective_by(at_zero, ratio))
            }),
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
            self.places(share)
                .map_or_else(Spread::Unknown, |(low, high)| {
                    let [low, high] = [low, high].map(|place| self.ascending.at(place) as f64);
                    Spread::Known(Interval::new(low, high, IntervalMethod::EffectiveRanks))
                }),
        )
    }

    /// Effective observations, as far as the outcome is to lie beyond this quantile or not.
    fn worth(&self, share: f64) -> Result<f64, TooSmall> {
        let (ratio, _) = self.ranks?;
        let count = self.ascending.len();
        let value = self.ascending.at(place_of(share, count));
        // Of equal values some lie beyond the quantile: whichever outcome is nearer to it.
        let below = self.ascending.count_below(value) as f64 / count as f64;
        let upto = self.ascending.count_below(value.saturating_add(1)) as f64 / count as f64;
        let is_nearer = (below - share).abs() < (upto - share).abs();
        let is_below = below > 0.0 && (is_nearer || upto >= 1.0);
        let mut outcomes = Batches::of_count(count as u64);
        for one in self.series.iter() {
            let is_inside = one < value || (one == value && !is_below);
            outcomes.push(f64::from(u8::from(is_inside)), 1);
        }
        let at_zero = outcomes.at_zero(LONG_PRIOR_RANKS)?;
        Ok(outcomes.effective_by(at_zero, ratio) * student_loss())
    }

    /// Effective ranks that must lie beyond a quantile above the median or below it.
    fn ranks_min(&self, is_above: bool) -> Result<f64, TooSmall> {
        let count = self.ascending.len();
        let at = |share| self.ascending.at(place_of(share, count)) as f64;
        let side = |beyond: f64| if is_above { 1.0 - beyond } else { beyond };
        let outermost = side(OUTERMOST);
        let [out, opposite] = [outermost, 1.0 - outermost].map(|end| (at(end) - at(0.5)).abs());
        Ok(if out < SKEWED * opposite {
            RANKS_MIN
        } else if self.worth(side(OUTER))? < SLOWER * self.worth(0.5)? {
            RANKS_MIN_SLOWER
        } else {
            RANKS_MIN_SKEWED
        })
    }

    /// Places of both ends.
    fn places(&self, share: f64) -> Result<(usize, usize), TooSmall> {
        let rare = share.min(1.0 - share);
        let mut worth = self.worth(share)?;
        if NEARER * rare <= 0.5 {
            let (_, of_ranks) = self.ranks?;
            // None needs more than that; what it needs takes two passes.
            if rare * of_ranks < RANKS_MIN_SLOWER {
                let least = self.ranks_min(share > 0.5)?;
                if rare * of_ranks < least {
                    return Err(too_few(of_ranks, least / rare));
                }
            }
            let nearer = if share <= 0.5 {
                NEARER * share
            } else {
                1.0 - NEARER * rare
            };
            let of_nearer = self.worth(nearer)?;
            if rare * of_nearer < NEARER_MIN {
                return Err(too_few(of_nearer, NEARER_MIN / rare));
            }
            worth = worth.min((worth * of_nearer).sqrt());
        }
        if rare * worth < BEYOND_MIN {
            return Err(too_few(worth, BEYOND_MIN / rare));
        }
        let count = self.ascending.len();
        let (near, far) = (selected_end(rare, worth, BEYOND_MIN), far_end(rare, worth));
        let (low, high) = if share <= 0.5 {
            (near, far)
        } else {
            (1.0 - far, 1.0 - near)
        };
        let place = |end: f64| ceil_count(end * count as f64);
        Ok((place(low).max(1) - 1, place(high).min(count - 1)))
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
    fn independent_outcomes_keep_their_count_and_a_walk_is_worth_next_to_nothing() {
        let mut random = RandomStream::new(1, "dependence");
        let white = Batches::of(vec![0.0; 20_000].into_iter().map(|_| random.normal()));
        let effective = white.effective_count().unwrap();
        assert!(effective > 12_000.0, "{effective}");
        let mut at = 0.0;
        let walk = Batches::of(vec![0.0; 20_000].into_iter().map(|_| {
            at += random.normal();
            at
        }));
        let effective = walk.effective_count().unwrap();
        assert!(effective < 5.0, "{effective}");
        assert_eq!(walk.mean_interval().known(), None);
    }

    #[test]
    fn what_was_seen_too_seldom_has_no_interval() {
        let none = Batches::of_runs(60_000, []).share_interval();
        assert_eq!(
            none,
            Spread::Unknown(TooSmall {
                effective: 0,
                needed: 5
            })
        );
        let one_outage = Batches::of_runs(60_000, [(30_000, 500)]).share_interval();
        assert_eq!(one_outage.known(), None, "{one_outage}");
        let few = Batches::of_runs(40, [(3, 1), (9, 1)]).share_interval();
        assert_eq!(
            few.to_string(),
            "no interval: 40 independent values, 64 needed"
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
