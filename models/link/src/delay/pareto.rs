//! Law of a Pareto delay of the second kind (Lomax): `min`, plus a time with a power-law tail, as
//! measured behind self-similar traffic. With `scale` = `min` it is the classical Pareto law. It
//! models no dependence of successive delays.
//!
//! P(delay > min + x) = (1 + x / scale)^-shape (Johnson, Kotz and Balakrishnan 1994, section
//! 20.3); without a limit the mean is min + scale / (shape - 1), and the variance is infinite up to
//! a shape of 2. A draw above `max` is drawn anew, so mean and variance that come out are finite.

use super::{DELAY_MAX, Density, Fitted, Law, LawFit, SCALES, TIMES, mean_of, ms, ms_fitted};
use core::time::Duration;
use hil_core::options;
use hil_core::random::RandomStream;

options! {
    /// `min` plus a time with a power-law tail.
    #[derive(Copy)]
    pub struct Pareto {
        /// What every message takes at least.
        min: Duration = Duration::ZERO, in TIMES;
        /// Scale of what comes on top.
        scale: Duration, in SCALES;
        /// Exponent of the tail.
        shape: f64, in SHAPE_MIN..=SHAPE_MAX;
        /// Longest delay; at least half of all draws are below it.
        max: Duration = DELAY_MAX, in TIMES;
    }
    check Law::check_cut;
}

const SHAPE_MIN: f64 = 1.05;
const SHAPE_MAX: f64 = 100.0;

impl Law for Pareto {
    fn density(&self) -> Box<dyn Density> {
        Box::new(Uncut {
            min: self.min.as_secs_f64(),
            scale: self.scale.as_secs_f64(),
            shape: self.shape,
        })
    }

    fn longest(&self) -> Duration {
        self.max
    }

    fn mean_s(&self) -> f64 {
        let (scale_s, max_s) = (self.scale.as_secs_f64(), self.max.as_secs_f64());
        let span_s = max_s - self.min.as_secs_f64();
        let kept = self.density().distribution(max_s);
        // The integral of what is still to come, less what is beyond the limit.
        let decay = -((1.0 - self.shape) * (span_s / scale_s).ln_1p()).exp_m1();
        let area_s = scale_s / (self.shape - 1.0) * decay;
        self.min.as_secs_f64() + (area_s - span_s * (1.0 - kept)) / kept
    }

    fn text(&self) -> String {
        let [min, scale, max] = [self.min, self.scale, self.max].map(ms);
        format!(
            "delay {min} ms and Pareto on top, scale {scale} ms, shape {}, cut at {max} ms",
            self.shape
        )
    }

    fn fit(&self) -> Option<LawFit> {
        Some(LawFit {
            method: "floor at the smallest; largest likelihood in scale and shape",
            estimate: |ascending| Box::new(Uncut::of(ascending)),
        })
    }
}

/// The law before it is cut, in seconds.
#[derive(Debug)]
struct Uncut {
    min: f64,
    scale: f64,
    shape: f64,
}

impl Uncut {
    /// The likelihood of a scale, with the best shape for it, has one peak; golden section finds it.
    fn of(ascending: &[f64]) -> Self {
        let n = ascending.len() as f64;
        let min = ascending[0];
        let (mean, _) = mean_of(ascending.iter().map(|value| value - min));
        let mean = mean.max(1e-9);
        let of_scale = |ln_scale: f64| {
            let scale = ln_scale.exp();
            let sum: f64 = ascending.iter().map(|x| ((x - min) / scale).ln_1p()).sum();
            let shape = (n / sum.max(1e-300)).clamp(SHAPE_MIN, SHAPE_MAX);
            Self { min, scale, shape }
        };
        let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
        let (mut low, mut high) = ((mean * 1e-3).ln(), (mean * 99.0).ln());
        for _ in 0..40 {
            let step = golden * (high - low);
            let (left, right) = (high - step, low + step);
            if of_scale(left).log_likelihood(ascending) < of_scale(right).log_likelihood(ascending)
            {
                low = left;
            } else {
                high = right;
            }
        }
        of_scale(f64::midpoint(low, high))
    }
}

impl Density for Uncut {
    fn distribution(&self, x: f64) -> f64 {
        -(-self.shape * ((x - self.min).max(0.0) / self.scale).ln_1p()).exp_m1()
    }

    fn draw(&self, random: &mut RandomStream) -> f64 {
        // The inverse of the distribution function; a uniform number below 1 is finite here.
        let rest = (1.0 - random.uniform()).powf(-1.0 / self.shape) - 1.0;
        self.min + self.scale * rest
    }
}

impl Fitted for Uncut {
    fn log_density(&self, x: f64) -> f64 {
        let tail = ((x - self.min).max(0.0) / self.scale).ln_1p();
        (self.shape / self.scale).ln() - (self.shape + 1.0) * tail
    }

    fn numbers(&self) -> Vec<f64> {
        vec![self.min, self.scale, self.shape]
    }

    fn text(&self) -> String {
        let [min, scale] = [self.min, self.scale].map(ms_fitted);
        format!("min {min}, scale {scale}, shape {:.4}", self.shape)
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
            &DelayLaw::Pareto(Pareto {
                min: ms(2),
                scale: ms(2),
                shape: 3.5,
                ..Pareto::TEMPLATE
            }),
            8,
        );
        check_law(
            &DelayLaw::Pareto(Pareto {
                min: ms(0),
                scale: Duration::from_micros(800),
                shape: 1.2,
                max: ms(500),
            }),
            9,
        );
    }
}
