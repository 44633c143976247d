//! Sampled signals: peaks by prominence, lag by cross-correlation, and the intervals of the
//! figures made from them. It knows nothing of robots.

use super::dependence::Batches;
use hil_core::interval::Spread;

/// One sample: time in nanoseconds and value.
pub type Sample = (i64, f64);

/// Times of the peaks of `samples`: a maximum counts once the signal has fallen by `prominence`
/// after it; between two peaks it must have risen by `prominence`.
///
/// A strict local-maximum test counts every wiggle of a noisy signal; this one does not. The first
/// peak needs only half the rise, because the signal may begin halfway up.
pub fn peaks(samples: &[Sample], prominence: f64) -> Vec<i64> {
    let mut found = Vec::new();
    let Some(&(first_at, first)) = samples.first() else {
        return found;
    };
    let (mut high, mut high_at, mut low, mut low_before) = (first, first_at, first, first);
    let mut is_rising = true;
    for &(at, value) in samples {
        if is_rising {
            if value > high {
                (high, high_at, low_before) = (value, at, low);
            }
            low = low.min(value);
            if high - value >= prominence {
                if high - low_before >= 0.5 * prominence {
                    found.push(high_at);
                }
                (is_rising, low) = (false, value);
            }
        } else {
            low = low.min(value);
            if value - low >= prominence {
                (is_rising, high, high_at, low_before) = (true, value, at, low);
            }
        }
    }
    found
}

/// Mean difference between highest and lowest value within each full period, with its interval;
/// `None` without a full period.
pub fn peak_to_peak(samples: &[Sample], period_ns: i64) -> Option<Estimate> {
    let start = samples.first()?.0;
    let end = samples.last()?.0;
    let blocks = samples.chunk_by(|a, b| (a.0 - start) / period_ns == (b.0 - start) / period_ns);
    let spans: Vec<f64> = blocks
        .filter(|block| ((block[0].0 - start) / period_ns + 1) * period_ns <= end - start)
        .map(|block| {
            let values = block.iter().map(|sample| sample.1);
            let max = values.clone().fold(f64::NEG_INFINITY, f64::max);
            max - values.fold(f64::INFINITY, f64::min)
        })
        .collect();
    Estimate::of_mean(&spans)
}

/// A figure with its interval of 95 %, or why it has none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The figure.
    pub value: f64,
    /// Its interval.
    pub interval: Spread,
}

impl Estimate {
    /// The mean of successive `blocks` of a run; `None` without any.
    pub fn of_mean(blocks: &[f64]) -> Option<Self> {
        let batches = Batches::of(blocks.iter().copied());
        (!blocks.is_empty()).then(|| Self {
            value: batches.mean(),
            interval: batches.mean_interval(),
        })
    }
}

/// Blocks that a lag's interval comes from, at most.
const BLOCKS_MAX: usize = 200;

/// Time from sample to sample when two signals are compared.
pub const GRID_NS: i64 = 4_000_000;

/// How far `delayed` runs behind `leading`, in seconds, searched from -0.25 s to
/// `lag_max_s`; `None` when they overlap for less than four times that or one does not move.
///
/// Both are put on a 4 ms grid by straight lines; the lag with the highest correlation
/// coefficient is found in steps of 32 ms, then of 4 ms, then refined by a parabola. The interval
/// comes from the blocks of the run, each long enough for a lag of its own.
pub fn lag_s(leading: &[Sample], delayed: &[Sample], lag_max_s: f64) -> Option<Estimate> {
    let start = leading.first()?.0.max(delayed.first()?.0);
    let end = leading.last()?.0.min(delayed.last()?.0);
    let count = usize::try_from((end - start) / GRID_NS).ok()?;
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a lag of seconds on a grid of milliseconds"
    )]
    let lag_max = (lag_max_s * 1e9 / GRID_NS as f64) as usize;
    let block_min = 4 * (lag_max + LEAD_MAX);
    if count < block_min {
        return None;
    }
    let leading = resampled(leading, start, GRID_NS, count);
    let delayed = resampled(delayed, start, GRID_NS, count);
    let step_s = GRID_NS as f64 * 1e-9;
    let value = best_lag(&leading, &delayed, lag_max)? * step_s;
    let block_length = block_min.max(count.div_ceil(BLOCKS_MAX));
    let blocks: Vec<f64> = leading
        .chunks_exact(block_length)
        .zip(delayed.chunks_exact(block_length))
        .filter_map(|(leading, delayed)| best_lag(leading, delayed, lag_max))
        .map(|lag| lag * step_s)
        .collect();
    let of_blocks = Batches::of(blocks.into_iter());
    // As wide as that of the blocks' mean, about the lag of the whole.
    let shift = value - of_blocks.mean();
    Some(Estimate {
        value,
        interval: of_blocks.mean_interval().map(|end| end + shift),
    })
}

/// Steps by which the "delayed" signal may run ahead: clocks and straight lines are not exact.
const LEAD_MAX: usize = 62;
/// Coarse search step, in grid steps.
const STRIDE: usize = 8;

/// Straight lines between samples, at `start + index * step_ns`.
pub fn resampled(samples: &[Sample], start: i64, step_ns: i64, count: usize) -> Vec<f64> {
    let mut next = 0;
    let mut at = start;
    let mut values = Vec::with_capacity(count);
    for _ in 0..count {
        while next + 1 < samples.len() && samples[next].0 < at {
            next += 1;
        }
        let (to_at, to) = samples[next];
        let (from_at, from) = samples[next.saturating_sub(1)];
        let share = if to_at > from_at {
            ((at - from_at) as f64 / (to_at - from_at) as f64).clamp(0.0, 1.0)
        } else {
            1.0
        };
        values.push(from + share * (to - from));
        at += step_ns;
    }
    values
}

/// The lag in grid steps with the highest correlation; `None` when a signal is constant.
fn best_lag(leading: &[f64], delayed: &[f64], lag_max: usize) -> Option<f64> {
    // Shift 0 is the largest lead, LEAD_MAX no lag.
    let shift_max = lag_max + LEAD_MAX;
    let correlate =
        |shift: usize, stride: usize| correlation(leading, delayed, shift, shift_max, stride);
    let best_of = |shifts: &mut dyn Iterator<Item = usize>, stride| {
        shifts
            .filter_map(|shift| Some((shift, correlate(shift, stride)?)))
            .max_by(|a, b| a.1.total_cmp(&b.1))
    };
    let (coarse, _) = best_of(&mut (0..=shift_max).step_by(STRIDE), STRIDE)?;
    let fine = coarse.saturating_sub(STRIDE)..=(coarse + STRIDE).min(shift_max);
    let (shift, peak) = best_of(&mut fine.clone(), 1)?;
    let mut refined = shift as f64;
    if shift > 0 && shift < shift_max {
        let (before, after) = (correlate(shift - 1, 1)?, correlate(shift + 1, 1)?);
        let curvature = before - 2.0 * peak + after;
        if curvature < 0.0 {
            refined += (0.5 * (before - after) / curvature).clamp(-0.5, 0.5);
        }
    }
    Some(refined - LEAD_MAX as f64)
}

/// Correlation coefficient of `delayed` with `leading` moved by `shift`, over the same stretch of
/// `delayed` for every shift.
fn correlation(
    leading: &[f64],
    delayed: &[f64],
    shift: usize,
    shift_max: usize,
    stride: usize,
) -> Option<f64> {
    let stretch = delayed.len().checked_sub(shift_max)?;
    let delayed = delayed[shift_max - LEAD_MAX..][..stretch].iter();
    let leading = leading[shift_max - shift..][..stretch].iter();
    let (mut n, mut sum_a, mut sum_b) = (0.0, 0.0, 0.0);
    let (mut square_a, mut square_b, mut product) = (0.0, 0.0, 0.0);
    for (a, b) in leading.zip(delayed).step_by(stride) {
        n += 1.0;
        sum_a += a;
        sum_b += b;
        square_a += a * a;
        square_b += b * b;
        product += a * b;
    }
    #[cfg(test)]
    work::add(n);
    let variance = (n * square_a - sum_a * sum_a) * (n * square_b - sum_b * sum_b);
    let is_moving = variance > 0.0 && n > 1.0;
    is_moving.then(|| (n * product - sum_a * sum_b) / variance.sqrt())
}

/// How many products [`correlation`] has formed on this thread. Everything else here passes over
/// its samples once; only the search for the lag could come to grow faster than a log.
#[cfg(test)]
mod work {
    use core::cell::Cell;

    std::thread_local! {
        static PRODUCT_COUNT: Cell<f64> = const { Cell::new(0.0) };
    }

    pub(super) fn add(products: f64) {
        PRODUCT_COUNT.set(PRODUCT_COUNT.get() + products);
    }

    /// The count since the last call.
    pub(super) fn take() -> f64 {
        PRODUCT_COUNT.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    const PERIOD_S: f64 = 4.033;

    fn sine(count: i64, step_ns: i64, lag_s: f64, noise: f64) -> Vec<Sample> {
        let mut random = RandomStream::new(3, "series");
        (0..count)
            .map(|index| {
                let time_s = (index * step_ns) as f64 * 1e-9 - lag_s;
                let value = (core::f64::consts::TAU * time_s / PERIOD_S).sin();
                (index * step_ns, value + noise * random.normal())
            })
            .collect()
    }

    #[test]
    fn four_hundred_loops_are_counted_through_noise() {
        // 403 275 samples of 4 ms: 399.97 loops, the last one past its peak.
        for noise in [0.0, 0.0002, 0.02] {
            let found = peaks(&sine(403_275, 4_000_000, 0.0, noise), 1.0);
            assert_eq!(found.len(), 400, "noise {noise}");
        }
    }

    #[test]
    fn a_hold_of_one_period_costs_one_peak() {
        let mut samples = sine(20_000, 4_000_000, 0.0, 0.0);
        let whole = peaks(&samples, 1.0).len();
        let held = samples[3000].1;
        for sample in &mut samples[3000..4008] {
            sample.1 = held;
        }
        assert_eq!(peaks(&samples, 1.0).len(), whole - 1);
    }

    #[test]
    fn a_signal_that_starts_downwards_has_no_peak_at_its_start() {
        let downwards: Vec<_> = sine(2500, 4_000_000, 0.0, 0.0)
            .into_iter()
            .map(|(at, value)| (at, -1.01 * value))
            .collect();
        assert_eq!(peaks(&downwards, 1.0).len(), 2);
        assert!(peaks(&[], 1.0).is_empty());
    }

    #[test]
    fn the_lag_of_a_delayed_sine_is_found_to_a_millisecond() {
        let leading = sine(6000, 8_000_000, 0.0, 0.0);
        for lag in [-0.003, 0.0, 0.0501, 0.195, 1.2] {
            let delayed = sine(12_000, 4_000_000, lag, 0.01);
            let found = lag_s(&leading, &delayed, 0.5 * PERIOD_S).unwrap();
            assert!((found.value - lag).abs() < 1e-3, "{found:?} for {lag}");
        }
    }

    #[test]
    fn a_constant_or_short_signal_has_no_lag() {
        let moving = sine(12_000, 4_000_000, 0.0, 0.0);
        let constant: Vec<_> = moving.iter().map(|sample| (sample.0, 1.0)).collect();
        assert_eq!(lag_s(&moving, &constant, 2.0), None);
        assert_eq!(lag_s(&moving[..500], &moving[..500], 2.0), None);
        assert_eq!(lag_s(&[], &moving, 2.0), None);
    }

    #[test]
    fn peak_to_peak_counts_full_periods_only() {
        let estimate = peak_to_peak(&sine(12_000, 4_000_000, 0.0, 0.0), 4_033_000_000).unwrap();
        assert!((estimate.value - 2.0).abs() < 1e-4, "{estimate:?}");
        assert_eq!(
            estimate.interval.known(),
            None,
            "eleven periods are too few"
        );
        assert_eq!(
            peak_to_peak(&sine(500, 4_000_000, 0.0, 0.0), 4_033_000_000),
            None
        );
    }

    #[test]
    fn the_lag_of_twice_the_samples_takes_twice_the_work() {
        let [(small_s, small), (large_s, large)] = [60_000, 120_000].map(|count: i64| {
            let wave = |late_s: f64| -> Vec<Sample> {
                let at = |index: i64| index * GRID_NS;
                let value = move |ns: i64| (1.5 * (ns as f64 * 1e-9 - late_s)).sin();
                (0..count)
                    .map(|index| (at(index), value(at(index))))
                    .collect()
            };
            work::take();
            let lag = lag_s(&wave(0.0), &wave(0.2), 1.0).unwrap();
            (lag.value, work::take())
        });
        assert!((small_s - 0.2).abs() < 0.01 && (large_s - 0.2).abs() < 0.01);
        assert!(small > 1e6, "{small}");
        // A little more than twice: a smaller share lies in the margins of the search.
        let ratio = large / small;
        assert!((1.9..2.2).contains(&ratio), "{ratio}");
    }
}
