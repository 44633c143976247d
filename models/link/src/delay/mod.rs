//! Delay laws: how long a message takes on its way, drawn independently for each. They know no
//! queue and no order; whether a message may overtake is the link's business
//! ([`LinkSpec::reorders`](super::spec::LinkSpec::reorders)).
//!
//! Each law is a file of its own, with one line in [`DelayLaw`]; see docs/adding-a-delay-law.md.

mod exponential;
mod fixed;
mod histogram;
mod log_normal;
mod normal;
mod pareto;
mod uniform;

#[cfg(test)]
mod tests;

use core::fmt::{self, Debug};
use core::ops::RangeInclusive;
use core::time::Duration;

use crate::laws::laws;
use hil_core::case_study::ParameterError;
use hil_core::options::{Options, Setting, Shape, Slot};
use hil_core::random::RandomStream;
use hil_core::time::duration_ns;

pub use exponential::Exponential;
pub use fixed::Fixed;
pub use histogram::Histogram;
pub use log_normal::LogNormal;
pub use normal::Normal;
pub use pareto::Pareto;
pub use uniform::Uniform;

laws! {
    /// Law of a link's delay.
    pub enum DelayLaw: Law {
        /// The same for all.
        Fixed = "fixed",
        /// Uniform in a range.
        Uniform = "uniform",
        /// Normal, cut off at zero.
        Normal = "normal",
        /// A floor and a log-normal time on top.
        LogNormal = "log-normal",
        /// A floor and an exponential time on top.
        Exponential = "exponential",
        /// A floor and a power-law tail.
        Pareto = "pareto",
        /// An empirical distribution.
        Histogram = "histogram",
    }
}

/// Longest delay of any law.
pub const DELAY_MAX: Duration = Duration::from_secs(10);
/// Range of a delay.
pub(super) const TIMES: RangeInclusive<Duration> = Duration::ZERO..=DELAY_MAX;
/// Range of a time that the draws are a multiple of.
const SCALES: RangeInclusive<Duration> = Duration::from_nanos(1)..=DELAY_MAX;

/// A delay law as it is configured.
trait Law: Options {
    /// The law before it is cut.
    fn density(&self) -> Box<dyn Density>;

    /// The limit at which it is cut: no delay is longer.
    fn longest(&self) -> Duration;

    /// The mean that comes out, after it is cut.
    fn mean_s(&self) -> f64;

    /// The law in words.
    fn text(&self) -> String;

    /// Whether the mean that comes out can be read off the words.
    fn has_mean_in_text(&self) -> bool {
        false
    }

    /// Smallest share of all draws that must be left when it is cut.
    fn kept_min(&self) -> f64 {
        0.5
    }

    /// Its fit to measured delays; `None` for a law that has no formula.
    fn fit(&self) -> Option<LawFit> {
        None
    }

    /// Checks that the limit keeps enough of all draws.
    fn check_cut(&self) -> Result<(), ParameterError> {
        let (max, least) = (self.longest(), self.kept_min());
        let density = self.density();
        let kept = density.distribution(max.as_secs_f64()) - density.below_zero();
        if kept >= least {
            return Ok(());
        }
        let problem = format!(
            "{max:?} keeps a share of {kept:.3} of all draws, which is less than {least}: the law \
             would be another one"
        );
        Err(ParameterError::new("max", problem))
    }
}

/// A delay law before it is cut; times in seconds.
pub trait Density: Debug + Send + Sync {
    /// Probability of a delay up to `x`, for `x` from 0 on.
    fn distribution(&self, x: f64) -> f64;

    /// Probability of a delay below 0.
    fn below_zero(&self) -> f64 {
        0.0
    }

    /// The next delay.
    fn draw(&self, random: &mut RandomStream) -> f64;
}

/// A delay law with a formula, fitted to measured delays; times in seconds.
pub trait Fitted: Density {
    /// Natural logarithm of the density at `x`.
    fn log_density(&self, x: f64) -> f64;

    /// What was fitted: the first options of the law in their order. The others keep their defaults.
    fn numbers(&self) -> Vec<f64>;

    /// The same in words.
    fn text(&self) -> String;

    /// Natural logarithm of the likelihood of `values`.
    fn log_likelihood(&self, values: &[f64]) -> f64 {
        values.iter().map(|x| self.log_density(*x)).sum()
    }
}

/// The fit of a law to measured delays.
#[derive(Debug, Clone, Copy)]
pub struct LawFit {
    /// How the numbers are found, in words.
    pub method: &'static str,
    /// Finds them from delays in seconds, ascending, at least two of them different.
    pub estimate: fn(&[f64]) -> Box<dyn Fitted>,
}

impl DelayLaw {
    /// The same `delay` for all.
    pub const fn fixed(delay: Duration) -> Self {
        Self::Fixed(Fixed { delay })
    }

    /// The law before it is cut.
    pub fn density(&self) -> Box<dyn Density> {
        self.law().density()
    }

    /// Its fit to measured delays; `None` for a law that has no formula.
    pub fn fit(&self) -> Option<LawFit> {
        self.law().fit()
    }

    /// The same law with the numbers of `fitted`, when a link takes them.
    ///
    /// # Errors
    /// Why it does not.
    pub fn with_numbers(mut self, fitted: &dyn Fitted) -> Result<Self, String> {
        for (field, number) in self.fields().into_iter().zip(fitted.numbers()) {
            let Slot::Value(mut value, shape) = field.slot else {
                unreachable!("a fitted law has values only");
            };
            value.set(match shape {
                Shape::Time(_) => {
                    let rounded = Duration::try_from_secs_f64((number * 1e9).round() * 1e-9);
                    let name = field.key;
                    Setting::Time(
                        rounded
                            .map_err(|_no_time| format!("whose {name} of {number} s is no time"))?,
                    )
                }
                _ => Setting::Number(number),
            })?;
        }
        self.accepted()
    }

    /// The same law, when a link takes it.
    ///
    /// # Errors
    /// Why it does not.
    pub fn accepted(self) -> Result<Self, String> {
        let refused = |why: ParameterError| format!("as a link refuses it: {why}");
        self.check().map_err(refused).map(|()| self)
    }

    /// Probability of a delay up to `delay_s`.
    pub fn distribution(&self, delay_s: f64) -> f64 {
        self.distribution_of(&*self.density(), delay_s)
    }

    fn distribution_of(&self, density: &dyn Density, delay_s: f64) -> f64 {
        if delay_s < 0.0 {
            return 0.0;
        }
        let (max_s, low) = (self.longest().as_secs_f64(), density.below_zero());
        let kept = density.distribution(max_s) - low;
        ((density.distribution(delay_s.min(max_s)) - low) / kept).min(1.0)
    }

    /// The mean that comes out.
    pub fn mean_s(&self) -> f64 {
        self.law().mean_s()
    }

    /// No delay is longer.
    pub fn longest(&self) -> Duration {
        self.law().longest()
    }

    /// The delay that a share of `quantile` of all messages does not exceed, to 1 ns; `quantile`
    /// within 0..=1.
    pub fn quantile(&self, quantile: f64) -> Duration {
        let density = self.density();
        let (mut low_ns, mut high_ns) = (0_u64, duration_ns(DELAY_MAX).unsigned_abs());
        while low_ns < high_ns {
            let middle_ns = u64::midpoint(low_ns, high_ns);
            if self.distribution_of(&*density, middle_ns as f64 * 1e-9) >= quantile {
                high_ns = middle_ns;
            } else {
                low_ns = middle_ns + 1;
            }
        }
        Duration::from_nanos(low_ns)
    }

    /// True when all messages take the same time.
    pub const fn is_fixed(&self) -> bool {
        matches!(self, Self::Fixed(_))
    }
}

impl Default for DelayLaw {
    /// No delay.
    fn default() -> Self {
        Self::fixed(Duration::ZERO)
    }
}

/// The law in words, with the mean that comes out where it is not in the words.
impl fmt::Display for DelayLaw {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.law().text())?;
        if self.law().has_mean_in_text() {
            return Ok(());
        }
        write!(formatter, " (mean {:.6} ms)", self.mean_s() * 1e3)
    }
}

/// A checked law to draw from.
#[derive(Debug)]
pub(super) struct DelaySampler {
    density: Box<dyn Density>,
    max_s: f64,
}

impl DelaySampler {
    pub(super) fn new(law: &DelayLaw) -> Result<Self, ParameterError> {
        law.check()?;
        Ok(Self {
            density: law.density(),
            max_s: law.longest().as_secs_f64(),
        })
    }

    /// The next delay. A law is checked to keep a quarter of its draws at least.
    pub(super) fn draw(&self, random: &mut RandomStream) -> Duration {
        loop {
            let drawn_s = self.density.draw(random);
            if (0.0..=self.max_s).contains(&drawn_s) {
                return nanoseconds(drawn_s);
            }
        }
    }
}

/// To the nearest nanosecond: a draw is at most [`DELAY_MAX`].
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "within 0..=10 s"
)]
fn nanoseconds(time_s: f64) -> Duration {
    Duration::from_nanos((time_s * 1e9).round() as u64)
}

/// A configured time in milliseconds.
fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// A fitted time in words.
fn ms_fitted(time_s: f64) -> String {
    format!("{:.4} ms", time_s * 1e3)
}

/// Mean and standard deviation.
fn mean_of(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    let squares: f64 = values.map(|value| (value - mean).powi(2)).sum();
    // Keeps a deviation above zero for values that are all but equal.
    (mean, (squares / n).sqrt().max(1e-12))
}

/// The smallest and the largest value, 1 ns apart at least.
fn ends_of(ascending: &[f64]) -> [f64; 2] {
    let (min, max) = (ascending[0], ascending[ascending.len() - 1]);
    [min, max.max(min + 1e-9)]
}
