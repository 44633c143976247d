//! Law of a fixed delay: every message takes the same time, as in the static model of the seed
//! paper (Lv et al., section II.B). It models no variation at all.

use super::{Density, Law, TIMES, ms};
use core::time::Duration;
use hil_core::options;
use hil_core::random::RandomStream;

options! {
    /// Every message takes `delay`.
    #[derive(Copy, Eq)]
    pub struct Fixed {
        /// One-way delay.
        delay: Duration, in TIMES;
    }
}

impl Law for Fixed {
    fn density(&self) -> Box<dyn Density> {
        Box::new(*self)
    }

    fn longest(&self) -> Duration {
        self.delay
    }

    fn mean_s(&self) -> f64 {
        self.delay.as_secs_f64()
    }

    fn text(&self) -> String {
        format!("{} ms delay", ms(self.delay))
    }

    fn has_mean_in_text(&self) -> bool {
        true
    }
}

impl Density for Fixed {
    fn distribution(&self, x: f64) -> f64 {
        f64::from(x >= self.delay.as_secs_f64())
    }

    fn draw(&self, _random: &mut RandomStream) -> f64 {
        self.delay.as_secs_f64()
    }
}
