//! Delay laws fitted to a trace. Each draws delays by itself, so none keeps their order.

use core::time::Duration;

use super::{Fit, NEARLY_FIXED, REFUSED_BELOW, Ranking, duration_text};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_link::delay::{
    DELAY_MAX, DelayLaw, Exponential, Histogram, LogNormal, Normal, Pareto, Uniform,
};
use hil_stats::goodness::ks_distance;
use hil_stats::special::{ceil_count, normal_distribution};

/// Most delays the test of distribution looks at, evenly spread.
const TESTED_MAX: usize = 1_000;
/// Resamples of the parametric bootstrap.
const RESAMPLE_COUNT: usize = 199;
/// Fewest delays worth a law.
const DELAYS_MIN: usize = 20;
/// Bins of the empirical law.
const BINS_MAX: usize = 64;

/// At most [`TESTED_MAX`] delays, evenly spread, ascending.
pub(super) fn thinned(delays_s: &[f64]) -> Vec<f64> {
    let step = delays_s.len().div_ceil(TESTED_MAX).max(1);
    let mut chosen: Vec<f64> = delays_s.iter().copied().step_by(step).collect();
    chosen.sort_by(f64::total_cmp);
    chosen
}

/// A law with a density; times in seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Law {
    Uniform { min: f64, max: f64 },
    Normal { mean: f64, deviation: f64 },
    LogNormal { min: f64, mu: f64, sigma: f64 },
    Exponential { min: f64, mean_excess: f64 },
    Pareto { min: f64, scale: f64, shape: f64 },
}

type Estimator = fn(&[f64]) -> Law;

/// Every law with its name, estimator, its method and the count of its numbers.
const LAWS: [(&str, Estimator, &str, u32); 5] = [
    ("uniform", uniform, "smallest and largest", 2),
    ("normal", normal, "mean and standard deviation", 2),
    (
        "log-normal",
        log_normal,
        "floor below the smallest by 1/n of the range; moments of the logarithm",
        3,
    ),
    (
        "exponential",
        exponential,
        "smallest and mean, free of bias",
        2,
    ),
    (
        "pareto",
        pareto,
        "floor at the smallest; largest likelihood in scale and shape",
        3,
    ),
];

/// All laws of delay for `delays_s`; `tested` are those the test looks at.
pub(super) fn rank(delays_s: &[f64], tested: &[f64], seed: u64) -> Ranking {
    if delays_s.len() < DELAYS_MIN {
        let why = format!(
            "{} delays are known, at least {DELAYS_MIN} are needed",
            delays_s.len()
        );
        return Ranking::none(&why);
    }
    let mut ascending = delays_s.to_vec();
    ascending.sort_by(f64::total_cmp);
    let is_equal = ascending[ascending.len() - 1] <= ascending[0];
    let (mut fits, mut left_out) = (Vec::new(), Vec::new());
    for (name, estimate, method, numbers) in LAWS.into_iter().filter(|_| !is_equal) {
        let law = estimate(&ascending);
        if let Err(why) = law.spec() {
            left_out.push(format!("{name}, {why}"));
            continue;
        }
        let mut fit = Fit::new(name, method, numbers, Some(law.log_likelihood(&ascending)));
        fit.parameters = law.words();
        fit.toml = law.toml();
        // The test is of the law as fitted to the very delays it looks at.
        let mut random = RandomStream::new(seed, &format!("trace.fit.{name}"));
        let (distance, probability) = bootstrap(tested, estimate, &mut random);
        fit.ks_distance = Some(distance);
        fit.ks_probability = Some(probability);
        fits.push(fit);
    }
    Ranking::sort(&mut fits);
    let taken = fits.iter().position(Fit::is_accepted);
    let others = [
        ("fixed", Some(fixed(&ascending))),
        ("histogram", (!is_equal).then(|| histogram(&ascending))),
    ];
    for (name, fit) in others {
        match fit {
            Some(Ok(fit)) => fits.push(fit),
            Some(Err(why)) => left_out.push(format!("{name}, {why}")),
            None => {}
        }
    }
    let rest = if is_equal { "fixed" } else { "histogram" };
    let best = taken.or_else(|| fits.iter().position(|fit| fit.law == rest));
    let mut why = match (taken, best) {
        (Some(_), _) => format!(
            "smallest AIC among those whose distance has a probability of {REFUSED_BELOW} or more"
        ),
        (None, Some(_)) if is_equal => "all delays are equal".to_owned(),
        (None, Some(_)) => format!(
            "every law with a formula is refused (probability below {REFUSED_BELOW}); the measured \
             distribution itself remains"
        ),
        (None, None) => "no law of a link has such delays".to_owned(),
    };
    for reason in left_out {
        why.push_str("; left out: ");
        why.push_str(&reason);
    }
    Ranking { fits, best, why }
}

/// The distance of `ascending` from the law fitted to it, and its probability when samples of that
/// law, each with a fit of its own, are as far (Stute, Manteiga and Quindimil 1993).
fn bootstrap(ascending: &[f64], estimate: Estimator, random: &mut RandomStream) -> (f64, f64) {
    let law = estimate(ascending);
    let distance = ks_distance(ascending, |x| law.distribution(x));
    let mut as_far = 0;
    for _ in 0..RESAMPLE_COUNT {
        let mut sample: Vec<f64> = (0..ascending.len()).map(|_| law.draw(random)).collect();
        sample.sort_by(f64::total_cmp);
        let own = estimate(&sample);
        as_far += usize::from(ks_distance(&sample, |x| own.distribution(x)) >= distance);
    }
    let probability = (as_far + 1) as f64 / (RESAMPLE_COUNT + 1) as f64;
    (distance, probability)
}

fn mean_of(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    let squares: f64 = values.map(|value| (value - mean).powi(2)).sum();
    // Keeps a deviation above zero for values that are all but equal.
    (mean, (squares / n).sqrt().max(1e-12))
}

fn uniform(ascending: &[f64]) -> Law {
    let (min, max) = ends(ascending);
    Law::Uniform { min, max }
}

fn ends(ascending: &[f64]) -> (f64, f64) {
    let (min, max) = (ascending[0], ascending[ascending.len() - 1]);
    (min, max.max(min + 1e-9))
}

fn normal(ascending: &[f64]) -> Law {
    let (mean, deviation) = mean_of(ascending.iter().copied());
    Law::Normal { mean, deviation }
}

fn log_normal(ascending: &[f64]) -> Law {
    let (smallest, largest) = ends(ascending);
    let min = (smallest - (largest - smallest) / ascending.len() as f64).max(0.0);
    let logarithms = ascending.iter().map(|value| (value - min).ln());
    let (mu, sigma) = mean_of(logarithms);
    Law::LogNormal { min, mu, sigma }
}

fn exponential(ascending: &[f64]) -> Law {
    let n = ascending.len() as f64;
    let (mean, _) = mean_of(ascending.iter().copied());
    let mean_excess = ((mean - ascending[0]) * n / (n - 1.0)).max(1e-9);
    let min = (ascending[0] - mean_excess / n).max(0.0);
    Law::Exponential { min, mean_excess }
}

/// The likelihood of a scale, with the best shape for it, has one peak; golden section finds it.
fn pareto(ascending: &[f64]) -> Law {
    let n = ascending.len() as f64;
    let min = ascending[0];
    let (mean, _) = mean_of(ascending.iter().map(|value| value - min));
    let mean = mean.max(1e-9);
    let shape_of = |scale: f64| {
        let sum: f64 = ascending.iter().map(|x| ((x - min) / scale).ln_1p()).sum();
        (n / sum.max(1e-300)).clamp(1.05, 100.0)
    };
    let likelihood = |ln_scale: f64| {
        let (scale, shape) = (ln_scale.exp(), shape_of(ln_scale.exp()));
        let law = Law::Pareto { min, scale, shape };
        law.log_likelihood(ascending)
    };
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let (mut low, mut high) = ((mean * 1e-3).ln(), (mean * 99.0).ln());
    for _ in 0..40 {
        let step = golden * (high - low);
        let (left, right) = (high - step, low + step);
        if likelihood(left) < likelihood(right) {
            low = left;
        } else {
            high = right;
        }
    }
    let scale = f64::midpoint(low, high).exp();
    let shape = shape_of(scale);
    Law::Pareto { min, scale, shape }
}

impl Law {
    pub(super) fn distribution(&self, x: f64) -> f64 {
        match *self {
            Self::Uniform { min, max } => ((x - min) / (max - min)).clamp(0.0, 1.0),
            Self::Normal { mean, deviation } => normal_distribution((x - mean) / deviation),
            Self::LogNormal { min, .. } if x <= min => 0.0,
            Self::LogNormal { min, mu, sigma } => {
                normal_distribution(((x - min).ln() - mu) / sigma)
            }
            Self::Exponential { min, mean_excess } => -(-(x - min).max(0.0) / mean_excess).exp_m1(),
            Self::Pareto { min, scale, shape } => {
                -(-shape * ((x - min).max(0.0) / scale).ln_1p()).exp_m1()
            }
        }
    }

    fn log_likelihood(&self, values: &[f64]) -> f64 {
        let two_pi = (2.0 * core::f64::consts::PI).ln();
        let gauss = |z: f64, deviation: f64| -0.5 * (two_pi + z * z) - deviation.ln();
        let one = |x: f64| match *self {
            Self::Uniform { min, max } => -(max - min).ln(),
            Self::Normal { mean, deviation } => gauss((x - mean) / deviation, deviation),
            Self::LogNormal { min, mu, sigma } => {
                let logarithm = (x - min).max(f64::MIN_POSITIVE).ln();
                gauss((logarithm - mu) / sigma, sigma) - logarithm
            }
            Self::Exponential { min, mean_excess } => -(x - min) / mean_excess - mean_excess.ln(),
            Self::Pareto { min, scale, shape } => {
                (shape / scale).ln() - (shape + 1.0) * ((x - min).max(0.0) / scale).ln_1p()
            }
        };
        values.iter().map(|x| one(*x)).sum()
    }

    pub(super) fn draw(&self, random: &mut RandomStream) -> f64 {
        match *self {
            Self::Uniform { min, max } => min + (max - min) * random.uniform(),
            Self::Normal { mean, deviation } => mean + deviation * random.normal(),
            Self::LogNormal { min, mu, sigma } => min + (mu + sigma * random.normal()).exp(),
            Self::Exponential { min, mean_excess } => {
                min - mean_excess * (1.0 - random.uniform()).ln()
            }
            Self::Pareto { min, scale, shape } => {
                min + scale * ((1.0 - random.uniform()).powf(-1.0 / shape) - 1.0)
            }
        }
    }

    /// The law that a link is told, if there is such a one: what the topology's file would refuse
    /// is no fit.
    fn spec(&self) -> Result<DelayLaw, String> {
        let time = |name: &str, seconds: f64| {
            let rounded = Duration::try_from_secs_f64((seconds * 1e9).round() * 1e-9);
            rounded.map_err(|_no_time| format!("whose {name} of {seconds} s is no time"))
        };
        let max = DELAY_MAX;
        let law = match *self {
            Self::Uniform { min, max } => DelayLaw::Uniform(Uniform {
                min: time("min", min)?,
                max: time("max", max)?,
            }),
            Self::Normal { mean, deviation } => DelayLaw::Normal(Normal {
                mean: time("mean", mean)?,
                deviation: time("deviation", deviation)?,
                max,
            }),
            Self::LogNormal { min, mu, sigma } => DelayLaw::LogNormal(LogNormal {
                min: time("min", min)?,
                median: time("median", mu.exp())?,
                sigma,
                max,
            }),
            Self::Exponential { min, mean_excess } => DelayLaw::Exponential(Exponential {
                min: time("min", min)?,
                mean_excess: time("mean_excess", mean_excess)?,
                max,
            }),
            Self::Pareto { min, scale, shape } => DelayLaw::Pareto(Pareto {
                min: time("min", min)?,
                scale: time("scale", scale)?,
                shape,
                max,
            }),
        };
        checked(law)
    }

    fn words(&self) -> String {
        let ms = |seconds: f64| format!("{:.4} ms", seconds * 1e3);
        match *self {
            Self::Uniform { min, max } => format!("{} to {}", ms(min), ms(max)),
            Self::Normal { mean, deviation } => {
                format!("mean {}, deviation {}", ms(mean), ms(deviation))
            }
            Self::LogNormal { min, mu, sigma } => {
                format!(
                    "min {}, median {} on top, sigma {sigma:.4}",
                    ms(min),
                    ms(mu.exp())
                )
            }
            Self::Exponential { min, mean_excess } => {
                format!("min {}, mean {} on top", ms(min), ms(mean_excess))
            }
            Self::Pareto { min, scale, shape } => {
                format!("min {}, scale {}, shape {shape:.4}", ms(min), ms(scale))
            }
        }
    }

    fn toml(&self) -> String {
        let d = duration_text;
        let lines = match *self {
            Self::Uniform { min, max } => {
                format!("law = \"uniform\"\nmin = {}\nmax = {}\n", d(min), d(max))
            }
            Self::Normal { mean, deviation } => {
                let (mean, deviation) = (d(mean), d(deviation));
                format!("law = \"normal\"\nmean = {mean}\ndeviation = {deviation}\n")
            }
            Self::LogNormal { min, mu, sigma } => {
                let (min, median) = (d(min), d(mu.exp()));
                format!("law = \"log-normal\"\nmin = {min}\nmedian = {median}\nsigma = {sigma:?}\n")
            }
            Self::Exponential { min, mean_excess } => {
                let (min, mean) = (d(min), d(mean_excess));
                format!("law = \"exponential\"\nmin = {min}\nmean_excess = {mean}\n")
            }
            Self::Pareto { min, scale, shape } => {
                let (min, scale) = (d(min), d(scale));
                format!("law = \"pareto\"\nmin = {min}\nscale = {scale}\nshape = {shape:?}\n")
            }
        };
        format!("\n[links.LINK.delay]\n{lines}")
    }
}

/// `law`, when a link takes it.
fn checked(law: DelayLaw) -> Result<DelayLaw, String> {
    let refused = |why: ParameterError| format!("as a link refuses it: {why}");
    law.check().map_err(refused)?;
    Ok(law)
}

/// One delay for all, the middle one; how far the others are from it stands beside it.
fn fixed(ascending: &[f64]) -> Result<Fit, String> {
    let median = ascending[ascending.len() / 2];
    checked(DelayLaw::fixed(Duration::from_secs_f64(median)))?;
    let (smallest, largest) = (ascending[0], ascending[ascending.len() - 1]);
    let mut fit = Fit::new("fixed", "middle delay", 1, None);
    fit.parameters = format!(
        "{:.4} ms; the others are from {:.4} ms earlier to {:.4} ms later",
        median * 1e3,
        (median - smallest) * 1e3,
        (largest - median) * 1e3
    );
    let hundredth = ascending.len() / 100;
    let (early, late) = (
        ascending[hundredth],
        ascending[ascending.len() - 1 - hundredth],
    );
    fit.is_nearly_fixed = (median - early).max(late - median) <= NEARLY_FIXED * median;
    fit.toml = format!(
        "\n[links.LINK.delay]\nlaw = \"fixed\"\ndelay = {}\n",
        duration_text(median)
    );
    Ok(fit)
}

/// Bins of equal weight, as far as the delays differ.
fn histogram(ascending: &[f64]) -> Result<Fit, String> {
    let n = ascending.len();
    let bins = BINS_MAX.min(n / 5).max(1);
    let nanoseconds = |seconds: f64| (seconds.max(0.0) * 1e9).round();
    let mut edges = vec![nanoseconds(ascending[0])];
    for bin in 1..=bins {
        let rank = ceil_count(bin as f64 * n as f64 / bins as f64).clamp(1, n);
        let edge = nanoseconds(ascending[rank - 1]);
        if edges.last().is_none_or(|last| edge > *last) {
            edges.push(edge);
        }
    }
    if edges.len() == 1 {
        edges.push(edges[0] + 1.0);
    }
    let last = edges.len() - 2;
    let counted = (0..=last).map(|bin| {
        let inside = ascending
            .iter()
            .map(|value| nanoseconds(*value))
            .filter(|ns| {
                let from = if bin == 0 {
                    f64::NEG_INFINITY
                } else {
                    edges[bin]
                };
                *ns > from && *ns <= edges[bin + 1]
            });
        inside.count() as f64
    });
    let counted: Vec<f64> = counted.collect();
    let spec = edges.iter().map(|ns| Duration::from_secs_f64(ns * 1e-9));
    checked(DelayLaw::Histogram(Histogram {
        edges: spec.collect(),
        weights: counted.clone(),
    }))?;
    let weights: Vec<String> = counted.iter().map(|count| format!("{count:?}")).collect();
    let edges: Vec<String> = edges.iter().map(|ns| duration_text(ns * 1e-9)).collect();
    let mut fit = Fit::new("histogram", "shares of the delays, no formula", 0, None);
    fit.parameters = format!("{} bins of about equal weight", weights.len());
    fit.toml = format!(
        "\n[links.LINK.delay]\nlaw = \"histogram\"\nedges = [{}]\nweights = [{}]\n",
        edges.join(", "),
        weights.join(", ")
    );
    Ok(fit)
}
