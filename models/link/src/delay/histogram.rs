//! Law of an empirical delay: a histogram, as `trace fit` makes one from a recorded link. Within a
//! bin every time is equally likely. It keeps the measured distribution and none of the measured
//! order: successive delays are independent.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Law, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// Most bins.
const BIN_COUNT_MAX: usize = 4096;

/// Bins between `edges` with `weights`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Histogram {
    /// Edges of the bins in ascending order, 0..=10 s: one more than weights.
    pub edges: Vec<Duration>,
    /// How often a delay falls into each bin, in any unit, 0..=1e12; not all of them zero. At most
    /// 4096 bins.
    pub weights: Vec<f64>,
}

impl Histogram {
    fn total(&self) -> f64 {
        self.weights.iter().sum()
    }

    fn check_edges(&self) -> Result<(), ParameterError> {
        let (edges, bins) = (self.edges.len(), self.weights.len());
        if !(1..=BIN_COUNT_MAX).contains(&bins) {
            let problem = format!("{bins} bins are outside 1 to {BIN_COUNT_MAX}");
            return Err(ParameterError::new("weights", problem));
        }
        if edges != bins + 1 {
            let problem = format!("{edges} edges do not enclose {bins} bins: one more is needed");
            return Err(ParameterError::new("edges", problem));
        }
        for edge in &self.edges {
            check_time("edges", *edge, Duration::ZERO)?;
        }
        let falling = self.edges.windows(2).position(|two| two[0] >= two[1]);
        if let Some(index) = falling {
            let problem = format!(
                "edge {} of {:?} is not above the one before it, {:?}",
                index + 1,
                self.edges[index + 1],
                self.edges[index]
            );
            return Err(ParameterError::new("edges", problem));
        }
        Ok(())
    }

    /// The law as it is drawn from: with the sums that find a bin.
    pub(super) fn cumulative(&self) -> Vec<f64> {
        let mut sum = 0.0;
        let add = |weight: &f64| {
            sum += weight;
            sum
        };
        self.weights.iter().map(add).collect()
    }

    /// Draws from the bins, with the sums of [`Histogram::cumulative`]: one uniform number finds
    /// both the bin and the place in it.
    pub(super) fn draw_from_s(&self, cumulative: &[f64], random: &mut RandomStream) -> f64 {
        let Some(total) = cumulative.last() else {
            return 0.0;
        };
        let target = random.uniform() * total;
        let found = cumulative.partition_point(|sum| *sum <= target);
        let bin = found.min(cumulative.len() - 1);
        let before = if bin == 0 { 0.0 } else { cumulative[bin - 1] };
        let share = ((target - before) / self.weights[bin]).clamp(0.0, 1.0);
        let (low_s, high_s) = (
            self.edges[bin].as_secs_f64(),
            self.edges[bin + 1].as_secs_f64(),
        );
        low_s + share * (high_s - low_s)
    }
}

impl Law for Histogram {
    fn check(&self) -> Result<(), ParameterError> {
        self.check_edges()?;
        for weight in &self.weights {
            ParameterError::check("weights", *weight, 0.0..=1e12, "0 to 1e12")?;
        }
        if self.total() > 0.0 {
            return Ok(());
        }
        let problem = "are all zero, so there is no delay to draw".to_owned();
        Err(ParameterError::new("weights", problem))
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        self.draw_from_s(&self.cumulative(), random)
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        let bins = self.edges.windows(2).zip(&self.weights);
        let below = bins.map(|(edges, weight)| {
            let (low_s, high_s) = (edges[0].as_secs_f64(), edges[1].as_secs_f64());
            weight * ((delay_s - low_s) / (high_s - low_s)).clamp(0.0, 1.0)
        });
        below.sum::<f64>() / self.total()
    }

    fn mean_s(&self) -> f64 {
        let bins = self.edges.windows(2).zip(&self.weights);
        let means = bins.map(|(edges, weight)| {
            weight * 0.5 * (edges[0].as_secs_f64() + edges[1].as_secs_f64())
        });
        means.sum::<f64>() / self.total()
    }

    fn longest(&self) -> Duration {
        self.edges.last().copied().unwrap_or_default()
    }
}
