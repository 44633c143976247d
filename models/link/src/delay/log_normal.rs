//! Law of a shifted log-normal delay: `min`, plus a time whose logarithm is normal. The usual
//! description of delays across many hops and of Wi-Fi under load: a floor, most values near it, a
//! long tail. It models no dependence of successive delays.
//!
//! delay = min + median exp(sigma N), N standard normal; without a limit the mean is
//! min + median exp(sigma^2 / 2) and the deviation median sqrt((exp(sigma^2) - 1) exp(sigma^2)).
//! A draw above `max` is drawn anew.

use super::{
    DELAY_MAX, Density, Fitted, Law, LawFit, SCALES, TIMES, ends_of, mean_of, ms, ms_fitted,
};
use core::f64::consts::PI;
use core::time::Duration;
use hil_core::options;
use hil_core::random::RandomStream;
use hil_stats::special::normal_distribution;

options! {
    /// `min` plus a log-normal time.
    #[derive(Copy)]
    pub struct LogNormal {
        /// What every message takes at least.
        min: Duration = Duration::ZERO, in TIMES;
        /// Median of what comes on top.
        median: Duration, in SCALES;
        /// Standard deviation of the natural logarithm of what comes on top.
        sigma: f64, in 0.001..=3.0;
        /// Longest delay; at least half of all draws are below it.
        max: Duration = DELAY_MAX, in TIMES;
    }
    check Law::check_cut;
}

impl LogNormal {
    fn uncut(&self) -> Uncut {
        Uncut {
            min: self.min.as_secs_f64(),
            median: self.median.as_secs_f64(),
            sigma: self.sigma,
        }
    }
}

impl Law for LogNormal {
    fn density(&self) -> Box<dyn Density> {
        Box::new(self.uncut())
    }

    fn longest(&self) -> Duration {
        self.max
    }

    fn mean_s(&self) -> f64 {
        let uncut = self.uncut();
        let end = uncut.standard(self.max.as_secs_f64());
        let cut = normal_distribution(end - self.sigma) / normal_distribution(end);
        uncut.min + uncut.median * (0.5 * self.sigma * self.sigma).exp() * cut
    }

    fn text(&self) -> String {
        let [min, median, max] = [self.min, self.median, self.max].map(ms);
        format!(
            "delay {min} ms and log-normal on top, median {median} ms, sigma {}, cut at {max} ms",
            self.sigma
        )
    }

    fn fit(&self) -> Option<LawFit> {
        Some(LawFit {
            method: "floor below the smallest by 1/n of the range; moments of the logarithm",
            estimate: |ascending| {
                let [smallest, largest] = ends_of(ascending);
                let min = (smallest - (largest - smallest) / ascending.len() as f64).max(0.0);
                let (mu, sigma) = mean_of(ascending.iter().map(|value| (value - min).ln()));
                let median = mu.exp();
                Box::new(Uncut { min, median, sigma })
            },
        })
    }
}

/// The law before it is cut, in seconds.
#[derive(Debug)]
struct Uncut {
    min: f64,
    median: f64,
    sigma: f64,
}

impl Uncut {
    /// The standard normal value that makes a delay of `x`.
    fn standard(&self, x: f64) -> f64 {
        ((x - self.min).max(0.0) / self.median).ln() / self.sigma
    }
}

impl Density for Uncut {
    fn distribution(&self, x: f64) -> f64 {
        normal_distribution(self.standard(x))
    }

    fn draw(&self, random: &mut RandomStream) -> f64 {
        self.min + self.median * (self.sigma * random.normal()).exp()
    }
}

impl Fitted for Uncut {
    fn log_density(&self, x: f64) -> f64 {
        let logarithm = (x - self.min).max(f64::MIN_POSITIVE).ln();
        let z = (logarithm - self.median.ln()) / self.sigma;
        -0.5 * ((2.0 * PI).ln() + z * z) - self.sigma.ln() - logarithm
    }

    fn numbers(&self) -> Vec<f64> {
        vec![self.min, self.median, self.sigma]
    }

    fn text(&self) -> String {
        let [min, median] = [self.min, self.median].map(ms_fitted);
        format!("min {min}, median {median} on top, sigma {:.4}", self.sigma)
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
            &DelayLaw::LogNormal(LogNormal {
                min: ms(2),
                median: ms(4),
                sigma: 0.6,
                ..LogNormal::TEMPLATE
            }),
            4,
        );
        check_law(
            &DelayLaw::LogNormal(LogNormal {
                min: ms(2),
                median: ms(4),
                sigma: 1.5,
                max: ms(10),
            }),
            5,
        );
    }
}
