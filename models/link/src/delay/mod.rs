//! Delay laws: how long a message takes on its way, drawn independently for each. They know no
//! queue and no order; whether a message may overtake is the link's business
//! ([`LinkSpec::reorders`](super::spec::LinkSpec::reorders)).

pub mod exponential;
pub mod fixed;
pub mod histogram;
pub mod log_normal;
pub mod normal;
mod normal_distribution;
pub mod pareto;
pub mod uniform;

#[cfg(test)]
mod tests;

use core::fmt::{self, Debug};
use core::time::Duration;

use serde::{Deserialize, Serialize};

use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::time::duration_ns;

pub use exponential::Exponential;
pub use fixed::Fixed;
pub use histogram::Histogram;
pub use log_normal::LogNormal;
pub use normal::Normal;
pub use pareto::Pareto;
pub use uniform::Uniform;

/// Longest delay of any law.
pub const DELAY_MAX: Duration = Duration::from_secs(10);

const fn delay_max() -> Duration {
    DELAY_MAX
}

/// What a delay law can tell of itself.
pub trait Law: Debug {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    fn check(&self) -> Result<(), ParameterError>;

    /// A draw before it is cut: it may lie outside of what the law allows.
    fn draw_s(&self, random: &mut RandomStream) -> f64;

    /// Probability of a delay up to `delay_s`, after it is cut.
    fn distribution(&self, delay_s: f64) -> f64;

    /// The mean that comes out, after it is cut.
    fn mean_s(&self) -> f64;

    /// No delay is longer.
    fn longest(&self) -> Duration;
}

/// How a link's delay is drawn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "law", rename_all = "kebab-case")]
pub enum DelayLaw {
    /// The same for all.
    Fixed(Fixed),
    /// Uniform in a range.
    Uniform(Uniform),
    /// Normal, cut off at zero.
    Normal(Normal),
    /// A floor and a log-normal time on top.
    LogNormal(LogNormal),
    /// A floor and an exponential time on top.
    Exponential(Exponential),
    /// A floor and a power-law tail.
    Pareto(Pareto),
    /// An empirical distribution.
    Histogram(Histogram),
}

impl DelayLaw {
    /// The same `delay` for all.
    pub const fn fixed(delay: Duration) -> Self {
        Self::Fixed(Fixed { delay })
    }

    fn law(&self) -> &dyn Law {
        match self {
            Self::Fixed(law) => law,
            Self::Uniform(law) => law,
            Self::Normal(law) => law,
            Self::LogNormal(law) => law,
            Self::Exponential(law) => law,
            Self::Pareto(law) => law,
            Self::Histogram(law) => law,
        }
    }

    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        self.law().check()
    }

    /// Probability of a delay up to `delay_s`.
    pub fn distribution(&self, delay_s: f64) -> f64 {
        if delay_s < 0.0 {
            return 0.0;
        }
        self.law().distribution(delay_s)
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
        let (mut low_ns, mut high_ns) = (0_u64, duration_ns(DELAY_MAX).unsigned_abs());
        while low_ns < high_ns {
            let middle_ns = u64::midpoint(low_ns, high_ns);
            if self.distribution(middle_ns as f64 * 1e-9) >= quantile {
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
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        let mean_ms = self.mean_s() * 1e3;
        match self {
            Self::Fixed(law) => write!(formatter, "{} ms delay", ms(law.delay)),
            Self::Uniform(law) => {
                write!(
                    formatter,
                    "delay uniform from {} to {} ms",
                    ms(law.min),
                    ms(law.max)
                )
            }
            Self::Normal(law) => write!(
                formatter,
                "delay normal, {} ms with deviation {} ms, cut at 0 and {} ms (mean {mean_ms:.6} ms)",
                ms(law.mean),
                ms(law.deviation),
                ms(law.max)
            ),
            Self::LogNormal(law) => write!(
                formatter,
                "delay {} ms and log-normal on top, median {} ms, sigma {}, cut at {} ms (mean \
                 {mean_ms:.6} ms)",
                ms(law.min),
                ms(law.median),
                law.sigma,
                ms(law.max)
            ),
            Self::Exponential(law) => write!(
                formatter,
                "delay {} ms and exponential on top, mean {} ms, cut at {} ms (mean {mean_ms:.6} ms)",
                ms(law.min),
                ms(law.mean_excess),
                ms(law.max)
            ),
            Self::Pareto(law) => write!(
                formatter,
                "delay {} ms and Pareto on top, scale {} ms, shape {}, cut at {} ms (mean \
                 {mean_ms:.6} ms)",
                ms(law.min),
                ms(law.scale),
                law.shape,
                ms(law.max)
            ),
            Self::Histogram(law) => write!(
                formatter,
                "delay by a histogram of {} bins up to {} ms (mean {mean_ms:.6} ms)",
                law.weights.len(),
                ms(self.longest())
            ),
        }
    }
}

/// A checked law to draw from.
#[derive(Debug, Clone)]
pub(super) struct DelaySampler {
    law: DelayLaw,
    /// Sums of a histogram's weights; empty for every other law.
    cumulative: Vec<f64>,
    max_s: f64,
}

impl DelaySampler {
    pub(super) fn new(law: &DelayLaw) -> Result<Self, ParameterError> {
        law.check()?;
        let cumulative = match law {
            DelayLaw::Histogram(histogram) => histogram.cumulative(),
            _ => Vec::new(),
        };
        Ok(Self {
            law: law.clone(),
            cumulative,
            max_s: law.longest().as_secs_f64(),
        })
    }

    /// The next delay. A law is checked to keep a quarter of its draws at least.
    pub(super) fn draw(&self, random: &mut RandomStream) -> Duration {
        if let DelayLaw::Fixed(law) = &self.law {
            return law.delay;
        }
        loop {
            let drawn_s = match &self.law {
                DelayLaw::Histogram(histogram) => histogram.draw_from_s(&self.cumulative, random),
                law => law.law().draw_s(random),
            };
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

/// `time` must be within `least` and [`DELAY_MAX`].
fn check_time(key: &str, time: Duration, least: Duration) -> Result<(), ParameterError> {
    if (least..=DELAY_MAX).contains(&time) {
        return Ok(());
    }
    let problem = format!("{time:?} is outside {least:?} to {DELAY_MAX:?}");
    Err(ParameterError::new(key, problem))
}

/// A share of `kept` of all draws is below `max`; `least` must be.
fn check_max(max: Duration, kept: f64, least: f64) -> Result<(), ParameterError> {
    check_time("max", max, Duration::ZERO)?;
    if kept >= least {
        return Ok(());
    }
    let problem = format!(
        "{max:?} keeps a share of {kept:.3} of all draws, which is less than {least}: the law \
         would be another one"
    );
    Err(ParameterError::new("max", problem))
}
