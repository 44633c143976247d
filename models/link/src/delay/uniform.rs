//! Law of a uniform delay: every time from `min` to `max` is equally likely. A range without a
//! theory behind it; no real link has these edges.

use super::{DELAY_MAX, Density, Fitted, Law, LawFit, TIMES, ends_of, ms, ms_fitted};
use core::time::Duration;
use hil_core::case_study::ParameterError;
use hil_core::options;
use hil_core::random::RandomStream;

options! {
    /// Uniform from `min` to `max`; the mean is (min + max) / 2, the variance (max - min)^2 / 12.
    #[derive(Copy, Eq)]
    pub struct Uniform {
        /// Shortest delay.
        min: Duration, in TIMES;
        /// Longest delay, not below `min`.
        max: Duration, in TIMES;
    }
    check Uniform::check_order;
}

impl Uniform {
    fn check_order(&self) -> Result<(), ParameterError> {
        if self.min <= self.max {
            return Ok(());
        }
        let problem = format!("{:?} is outside {:?} to {DELAY_MAX:?}", self.max, self.min);
        Err(ParameterError::new("max", problem))
    }
}

impl Law for Uniform {
    fn density(&self) -> Box<dyn Density> {
        Box::new(Range {
            min: self.min.as_secs_f64(),
            max: self.max.as_secs_f64(),
        })
    }

    fn longest(&self) -> Duration {
        self.max
    }

    fn mean_s(&self) -> f64 {
        0.5 * (self.min.as_secs_f64() + self.max.as_secs_f64())
    }

    fn text(&self) -> String {
        format!("delay uniform from {} to {} ms", ms(self.min), ms(self.max))
    }

    fn has_mean_in_text(&self) -> bool {
        true
    }

    fn fit(&self) -> Option<LawFit> {
        Some(LawFit {
            method: "smallest and largest",
            estimate: |ascending| {
                let [min, max] = ends_of(ascending);
                Box::new(Range { min, max })
            },
        })
    }
}

/// The law in seconds.
#[derive(Debug)]
struct Range {
    min: f64,
    max: f64,
}

impl Density for Range {
    fn distribution(&self, x: f64) -> f64 {
        if x >= self.max {
            return 1.0;
        }
        ((x - self.min) / (self.max - self.min)).max(0.0)
    }

    fn draw(&self, random: &mut RandomStream) -> f64 {
        self.min + random.uniform() * (self.max - self.min)
    }
}

impl Fitted for Range {
    fn log_density(&self, _x: f64) -> f64 {
        -(self.max - self.min).ln()
    }

    fn numbers(&self) -> Vec<f64> {
        vec![self.min, self.max]
    }

    fn text(&self) -> String {
        format!("{} to {}", ms_fitted(self.min), ms_fitted(self.max))
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
            &DelayLaw::Uniform(Uniform {
                min: ms(10),
                max: ms(60),
            }),
            0,
        );
    }
}
