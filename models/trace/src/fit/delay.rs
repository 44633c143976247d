//! Delay laws fitted to a trace. Each draws delays by itself, so none keeps their order.

use core::time::Duration;

use super::{Fit, NEARLY_FIXED, REFUSED_BELOW, Ranking, duration_text};
use hil_core::options::{Options as _, Setting, Slot};
use hil_core::random::RandomStream;
use hil_link::delay::{DelayLaw, Fitted, Histogram, LawFit};
use hil_stats::goodness::ks_distance;
use hil_stats::special::ceil_count;

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
    let laws = DelayLaw::NAMES
        .iter()
        .filter_map(|name| DelayLaw::named(name));
    for template in laws.filter(|_| !is_equal) {
        let Some(LawFit { method, estimate }) = template.fit() else {
            continue;
        };
        let (name, fitted) = (template.name(), estimate(&ascending));
        let law = match template.with_numbers(&*fitted) {
            Ok(law) => law,
            Err(why) => {
                left_out.push(format!("{name}, {why}"));
                continue;
            }
        };
        let count = fitted.numbers().len();
        let log_likelihood = Some(fitted.log_likelihood(&ascending));
        let mut fit = Fit::new(name, method, count, log_likelihood);
        fit.parameters = fitted.text();
        fit.toml = toml(law, count);
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
    let why = match (taken, best) {
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
    Ranking::of(fits, best, why, &left_out)
}

/// The distance of `ascending` from the law fitted to it, and its probability when samples of that
/// law, each with a fit of its own, are as far (Stute, Manteiga and Quindimil 1993).
fn bootstrap(
    ascending: &[f64],
    estimate: fn(&[f64]) -> Box<dyn Fitted>,
    random: &mut RandomStream,
) -> (f64, f64) {
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

/// `[links.LINK.delay]` with the first `option_count` options of `law`.
fn toml(mut law: DelayLaw, option_count: usize) -> String {
    let mut lines = format!("\n[links.LINK.delay]\nlaw = \"{}\"\n", law.name());
    for field in law.fields().into_iter().take(option_count) {
        let Slot::Value(value, _) = field.slot else {
            unreachable!("a delay law has values only");
        };
        if let Some(setting) = value.get() {
            lines.extend([field.key, " = ", &text(&setting), "\n"]);
        }
    }
    lines
}

/// A value as a topology writes it.
fn text(setting: &Setting) -> String {
    match setting {
        Setting::Time(time) => duration_text(time.as_secs_f64()),
        Setting::Number(number) => format!("{number:?}"),
        Setting::List(items) => {
            let items: Vec<_> = items.iter().map(text).collect();
            format!("[{}]", items.join(", "))
        }
        other => unreachable!("no delay law has a {other:?}"),
    }
}

/// One delay for all, the middle one; how far the others are from it stands beside it.
fn fixed(ascending: &[f64]) -> Result<Fit, String> {
    let median = ascending[ascending.len() / 2];
    let law = DelayLaw::fixed(Duration::from_secs_f64(median)).accepted()?;
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
    fit.toml = toml(law, 1);
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
    let weights: Vec<f64> = counted.collect();
    let bin_count = weights.len();
    let edges = edges.iter().map(|ns| Duration::from_secs_f64(ns * 1e-9));
    let edges = edges.collect();
    let law = DelayLaw::Histogram(Histogram { edges, weights }).accepted()?;
    let mut fit = Fit::new("histogram", "shares of the delays, no formula", 0, None);
    fit.parameters = format!("{bin_count} bins of about equal weight");
    fit.toml = toml(law, 2);
    Ok(fit)
}
