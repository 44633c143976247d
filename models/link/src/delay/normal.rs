//! Law of a normal delay, cut off at zero: `mean` and `deviation` are those of the uncut normal;
//! a draw below zero or above `max` is drawn anew. It models a delay that many small independent
//! causes make up; real tails are heavier.
//!
//! With a = -mean / deviation, b = (max - mean) / deviation and Z = P(b) - P(a), P the standard
//! normal distribution and p its density, the mean that comes out is
//! mean + deviation (p(a) - p(b)) / Z (Johnson, Kotz and Balakrishnan 1994, section 13.10.1): 2.8 %
//! more than asked at mean = 2 deviations, 0.15 % at 3.

use super::{DELAY_MAX, Density, Fitted, Law, LawFit, SCALES, TIMES, mean_of, ms, ms_fitted};
use core::f64::consts::PI;
use core::time::Duration;
use hil_core::options;
use hil_core::random::RandomStream;
use hil_stats::special::normal_distribution;

options! {
    /// Normal, cut off at zero and at `max`.
    #[derive(Copy, Eq)]
    pub struct Normal {
        /// Mean before it is cut.
        mean: Duration, in TIMES;
        /// Standard deviation before it is cut.
        deviation: Duration, in SCALES;
        /// Longest delay; at least a quarter of all draws is below it.
        max: Duration = DELAY_MAX, in TIMES;
    }
    check Law::check_cut;
}

impl Law for Normal {
    fn density(&self) -> Box<dyn Density> {
        Box::new(Uncut {
            mean: self.mean.as_secs_f64(),
            deviation: self.deviation.as_secs_f64(),
        })
    }

    fn longest(&self) -> Duration {
        self.max
    }

    /// What is below zero is at most half already.
    fn kept_min(&self) -> f64 {
        0.25
    }

    fn mean_s(&self) -> f64 {
        let (mean_s, deviation_s) = (self.mean.as_secs_f64(), self.deviation.as_secs_f64());
        let [a, b] = [0.0, self.max.as_secs_f64()].map(|end_s| (end_s - mean_s) / deviation_s);
        let density = |z: f64| (-0.5 * z * z).exp() / (2.0 * PI).sqrt();
        let kept = normal_distribution(b) - normal_distribution(a);
        mean_s + deviation_s * (density(a) - density(b)) / kept
    }

    fn text(&self) -> String {
        let [mean, deviation, max] = [self.mean, self.deviation, self.max].map(ms);
        format!("delay normal, {mean} ms with deviation {deviation} ms, cut at 0 and {max} ms")
    }

    fn fit(&self) -> Option<LawFit> {
        Some(LawFit {
            method: "mean and standard deviation",
            estimate: |ascending| {
                let (mean, deviation) = mean_of(ascending.iter().copied());
                Box::new(Uncut { mean, deviation })
            },
        })
    }
}

/// The law before it is cut, in seconds.
#[derive(Debug)]
struct Uncut {
    mean: f64,
    deviation: f64,
}

impl Density for Uncut {
    fn distribution(&self, x: f64) -> f64 {
        normal_distribution((x - self.mean) / self.deviation)
    }

    fn below_zero(&self) -> f64 {
        self.distribution(0.0)
    }

    fn draw(&self, random: &mut RandomStream) -> f64 {
        self.mean + self.deviation * random.normal()
    }
}

impl Fitted for Uncut {
    fn log_density(&self, x: f64) -> f64 {
        let z = (x - self.mean) / self.deviation;
        -0.5 * ((2.0 * PI).ln() + z * z) - self.deviation.ln()
    }

    fn numbers(&self) -> Vec<f64> {
        vec![self.mean, self.deviation]
    }

    fn text(&self) -> String {
        let [mean, deviation] = [self.mean, self.deviation].map(ms_fitted);
        format!("mean {mean}, deviation {deviation}")
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
            &DelayLaw::Normal(Normal {
                mean: ms(50),
                deviation: ms(10),
                ..Normal::TEMPLATE
            }),
            1,
        );
        check_law(
            &DelayLaw::Normal(Normal {
                mean: ms(5),
                deviation: ms(10),
                ..Normal::TEMPLATE
            }),
            2,
        );
        check_law(
            &DelayLaw::Normal(Normal {
                mean: ms(20),
                deviation: ms(10),
                max: ms(25),
            }),
            3,
        );
    }
}
