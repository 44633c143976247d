//! Loss law of independent losses: each message is lost by itself, as in the static model of the seed
//! paper (Lv et al., section II.B). It has no memory.

use super::{Law, Losses};
use hil_core::options;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

options! {
    /// Each message is lost by itself.
    #[derive(Copy)]
    pub struct Bernoulli {
        /// Probability of a loss.
        ratio: f64, in 0.0..=1.0;
    }
}

impl Law for Bernoulli {
    fn loss_ratio(&self) -> f64 {
        self.ratio
    }

    fn text(&self) -> String {
        format!("loss ratio {}", self.ratio)
    }

    fn start(&self, own: RandomStream, _shared: RandomStream) -> Box<dyn Losses> {
        Box::new(Independent {
            ratio: self.ratio,
            random: own,
        })
    }
}

/// The law at work.
#[derive(Debug)]
struct Independent {
    ratio: f64,
    random: RandomStream,
}

impl Losses for Independent {
    fn is_lost(&mut self, _now: Instant) -> bool {
        self.random.chance(self.ratio)
    }
}
