//! The seed paper's static network model: a fixed delay and independent losses (Lv et al.,
//! section II.B and Tables II and III). It models no queue, no burst and no reordering.

use core::time::Duration;

use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// Fixed delay, Bernoulli loss.
#[derive(Debug, Clone)]
pub struct BernoulliLink {
    delay: Duration,
    loss_ratio: f64,
    random: RandomStream,
}

impl BernoulliLink {
    /// A link that loses each message with probability `loss_ratio` and delays the others by
    /// `delay`.
    ///
    /// # Errors
    /// When `loss_ratio` is outside 0..=1.
    pub fn new(
        delay: Duration,
        loss_ratio: f64,
        random: RandomStream,
    ) -> Result<Self, ParameterError> {
        ParameterError::check("loss_ratio", loss_ratio, 0.0..=1.0, "0 to 1")?;
        Ok(Self {
            delay,
            loss_ratio,
            random,
        })
    }
}

impl LinkModel for BernoulliLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        // The stream advances for every message, so the fate of the n-th message depends on
        // the seed and on n alone.
        if self.random.chance(self.loss_ratio) {
            Fate::Lost
        } else {
            Fate::Delivered(now + self.delay)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_loses_what_it_promises_and_delays_the_rest() {
        let stream = RandomStream::new(3, "link");
        let mut link = BernoulliLink::new(Duration::from_millis(50), 0.1, stream).unwrap();
        let mut lost = 0;
        for index in 0..100_000 {
            match link.offer(Instant::from_ns(index), 64) {
                Fate::Lost => lost += 1,
                fate => assert_eq!(fate.arrival().unwrap().as_ns(), index + 50_000_000),
            }
        }
        // Five standard deviations of Binomial(100 000, 0.1).
        assert!((i32::abs(lost - 10_000)) < 475, "{lost} lost");
    }

    #[test]
    fn a_ratio_outside_its_range_is_refused_by_name() {
        for ratio in [-0.1, 1.5, f64::NAN] {
            let stream = RandomStream::new(0, "link");
            let error = BernoulliLink::new(Duration::ZERO, ratio, stream).unwrap_err();
            assert_eq!(error.key, "loss_ratio");
        }
    }
}
