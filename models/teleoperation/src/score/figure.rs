//! Shorthand for the figures of a score: a value with how it was obtained, or the reason why there
//! is none.

use hil_core::score::Metric;
use hil_stats::series::Estimate;

/// A figure called `name`, labelled `label`, in `unit`; without a value, for the reason `missing`.
pub(crate) fn figure(
    (name, label, unit): (&'static str, &'static str, &'static str),
    value: Option<f64>,
    method: impl Into<String>,
    missing: &str,
) -> Metric {
    let value = value.filter(|value| value.is_finite());
    Metric {
        name,
        label,
        value,
        interval: None,
        unit,
        method: match value {
            Some(_) => method.into(),
            None => missing.to_owned(),
        },
    }
}

/// A figure with the interval that blocks of the run give it.
pub(crate) fn estimated(
    names: (&'static str, &'static str, &'static str),
    estimate: Option<Estimate>,
    method: impl Into<String>,
    missing: &str,
) -> Metric {
    let metric = figure(names, estimate.map(|known| known.value), method, missing);
    Metric {
        interval: estimate.and_then(|known| known.interval),
        ..metric
    }
}

/// A number of things; without one nothing was recorded that could be counted.
pub(crate) fn count(
    (name, label): (&'static str, &'static str),
    value: Option<u64>,
    method: impl Into<String>,
) -> Metric {
    let value = value.map(|value| value as f64);
    figure((name, label, "1"), value, method, "nothing was recorded")
}
