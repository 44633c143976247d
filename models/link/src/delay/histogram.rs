//! Law of an empirical delay: a histogram, as `trace fit` makes one from a recorded link. Within a
//! bin every time is equally likely. It keeps the measured distribution and none of the measured
//! order: successive delays are independent.

use super::{Density, Law, TIMES, ms};
use core::time::Duration;
use hil_core::case_study::ParameterError;
use hil_core::options;
use hil_core::random::RandomStream;

/// Most bins.
const BIN_COUNT_MAX: usize = 4096;

options! {
    /// Bins between `edges` with `weights`.
    pub struct Histogram {
        /// Edges of the bins in ascending order: one more than weights.
        edges: Vec<Duration>, in TIMES, hint "an array of durations, one more than weights";
        /// How often a delay falls into each bin, in any unit; not all of them zero. At most 4096
        /// bins.
        weights: Vec<f64>, in 0.0..=1e12, hint "an array of numbers, one per bin";
    }
    check Histogram::check_bins;
}

impl Histogram {
    fn check_bins(&self) -> Result<(), ParameterError> {
        let refuse = |key: &str, problem: String| Err(ParameterError::new(key, problem));
        let (edges, bins) = (self.edges.len(), self.weights.len());
        if !(1..=BIN_COUNT_MAX).contains(&bins) {
            let problem = format!("{bins} bins are outside 1 to {BIN_COUNT_MAX}");
            return refuse("weights", problem);
        }
        if edges != bins + 1 {
            let problem = format!("{edges} edges do not enclose {bins} bins: one more is needed");
            return refuse("edges", problem);
        }
        let falling = self.edges.windows(2).position(|two| two[0] >= two[1]);
        if let Some(index) = falling {
            let problem = format!(
                "edge {} of {:?} is not above the one before it, {:?}",
                index + 1,
                self.edges[index + 1],
                self.edges[index]
            );
            return refuse("edges", problem);
        }
        if self.weights.iter().sum::<f64>() > 0.0 {
            return Ok(());
        }
        let problem = "are all zero, so there is no delay to draw";
        refuse("weights", problem.to_owned())
    }
}

impl Law for Histogram {
    fn density(&self) -> Box<dyn Density> {
        let mut sum = 0.0;
        let add = |weight: &f64| {
            sum += weight;
            sum
        };
        Box::new(Bins {
            edges: self.edges.iter().map(Duration::as_secs_f64).collect(),
            cumulative: self.weights.iter().map(add).collect(),
            weights: self.weights.clone(),
        })
    }

    fn longest(&self) -> Duration {
        self.edges.last().copied().unwrap_or_default()
    }

    fn mean_s(&self) -> f64 {
        let bins = self.edges.windows(2).zip(&self.weights);
        let means = bins.map(|(edges, weight)| {
            weight * 0.5 * (edges[0].as_secs_f64() + edges[1].as_secs_f64())
        });
        means.sum::<f64>() / self.weights.iter().sum::<f64>()
    }

    fn text(&self) -> String {
        let (bins, longest) = (self.weights.len(), ms(self.longest()));
        format!("delay by a histogram of {bins} bins up to {longest} ms")
    }
}

/// The law in seconds.
#[derive(Debug)]
struct Bins {
    edges: Vec<f64>,
    weights: Vec<f64>,
    /// Sums of the weights, which find a bin.
    cumulative: Vec<f64>,
}

impl Density for Bins {
    fn distribution(&self, x: f64) -> f64 {
        let bins = self.edges.windows(2).zip(&self.weights);
        let below = bins.map(|(edges, weight)| {
            weight * ((x - edges[0]) / (edges[1] - edges[0])).clamp(0.0, 1.0)
        });
        below.sum::<f64>() / self.weights.iter().sum::<f64>()
    }

    /// One uniform number finds both the bin and the place in it.
    fn draw(&self, random: &mut RandomStream) -> f64 {
        let Some(total) = self.cumulative.last() else {
            return 0.0;
        };
        let target = random.uniform() * total;
        let found = self.cumulative.partition_point(|sum| *sum <= target);
        let bin = found.min(self.cumulative.len() - 1);
        let before = if bin == 0 {
            0.0
        } else {
            self.cumulative[bin - 1]
        };
        let share = ((target - before) / self.weights[bin]).clamp(0.0, 1.0);
        self.edges[bin] + share * (self.edges[bin + 1] - self.edges[bin])
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
            &DelayLaw::Histogram(Histogram {
                edges: vec![ms(1), ms(2), ms(3), ms(10), ms(40)],
                weights: vec![70.0, 20.0, 0.0, 10.0],
            }),
            10,
        );
    }
}
