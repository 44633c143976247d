//! Law of a shifted exponential delay: `min`, plus a time without memory. What waiting behind
//! Poisson traffic in a single queue looks like; real queues remember, this law does not.
//!
//! `P(delay > min + x) = exp(-x / mean_excess)`; a draw above `max` is drawn anew.

use super::{DELAY_MAX, Density, Fitted, Law, LawFit, SCALES, TIMES, mean_of, ms, ms_fitted};
use core::time::Duration;
use hil_core::options;
use hil_core::random::RandomStream;

options! {
    /// `min` plus an exponential time.
    #[derive(Copy, Eq)]
    pub struct Exponential {
        /// What every message takes at least.
        min: Duration = Duration::ZERO, in TIMES;
        /// Mean of what comes on top, before it is cut at `max`.
        mean_excess: Duration, in SCALES;
        /// Longest delay; at least half of all draws are below it.
        max: Duration = DELAY_MAX, in TIMES;
    }
    check Law::check_cut;
}

impl Law for Exponential {
    fn density(&self) -> Box<dyn Density> {
        Box::new(Uncut {
            min: self.min.as_secs_f64(),
            mean_excess: self.mean_excess.as_secs_f64(),
        })
    }

    fn longest(&self) -> Duration {
        self.max
    }

    fn mean_s(&self) -> f64 {
        let (scale_s, max_s) = (self.mean_excess.as_secs_f64(), self.max.as_secs_f64());
        let span_s = max_s - self.min.as_secs_f64();
        let missing_s = span_s * (-span_s / scale_s).exp() / self.density().distribution(max_s);
        self.min.as_secs_f64() + scale_s - missing_s
    }

    fn text(&self) -> String {
        let [min, mean, max] = [self.min, self.mean_excess, self.max].map(ms);
        format!("delay {min} ms and exponential on top, mean {mean} ms, cut at {max} ms")
    }

    fn fit(&self) -> Option<LawFit> {
        Some(LawFit {
            method: "smallest and mean, free of bias",
            estimate: |ascending| {
                let n = ascending.len() as f64;
                let (mean, _) = mean_of(ascending.iter().copied());
                let mean_excess = ((mean - ascending[0]) * n / (n - 1.0)).max(1e-9);
                let min = (ascending[0] - mean_excess / n).max(0.0);
                Box::new(Uncut { min, mean_excess })
            },
        })
    }
}

/// The law before it is cut, in seconds.
#[derive(Debug)]
struct Uncut {
    min: f64,
    mean_excess: f64,
}

impl Density for Uncut {
    fn distribution(&self, x: f64) -> f64 {
        -(-(x - self.min).max(0.0) / self.mean_excess).exp_m1()
    }

    fn draw(&self, random: &mut RandomStream) -> f64 {
        self.min - self.mean_excess * (1.0 - random.uniform()).ln()
    }
}

impl Fitted for Uncut {
    fn log_density(&self, x: f64) -> f64 {
        -(x - self.min) / self.mean_excess - self.mean_excess.ln()
    }

    fn numbers(&self) -> Vec<f64> {
        vec![self.min, self.mean_excess]
    }

    fn text(&self) -> String {
        let [min, mean] = [self.min, self.mean_excess].map(ms_fitted);
        format!("min {min}, mean {mean} on top")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::delay::DelayLaw;
    use crate::delay::tests::{check_law, ms};

    #[test]
    fn draws_have_the_distribution_mean_and_quantiles_that_it_states() {
        check_law(
            &DelayLaw::Exponential(Exponential {
                min: ms(1),
                mean_excess: ms(3),
                ..Exponential::TEMPLATE
            }),
            6,
        );
        check_law(
            &DelayLaw::Exponential(Exponential {
                min: ms(1),
                mean_excess: ms(3),
                max: ms(5),
            }),
            7,
        );
    }
}
