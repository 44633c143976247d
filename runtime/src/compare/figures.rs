//! The figures of two sides with ratio, difference and intervals. Which interval a figure gets depends
//! on what the runs left: see `docs/compare.md`.

use std::collections::BTreeMap;

use hil_models::measure::account::{ChannelAccount, FateCounts, MessageFate};
use hil_models::measure::comparison::{
    Estimate, Share, binned_quantile_interval, difference, newcombe, ratio, welch,
};
use hil_models::measure::histogram::{Distribution, DurationBin, LatencySummary};
use hil_models::measure::statistics::{CONFIDENCE, Interval, IntervalNs};

use super::{ComparedFigure, ComparedRun, FigureKind, Verdict};
use crate::report::summary::ScoreMetric;

/// The part of a channel's way that is the whole of it.
pub(super) const END_TO_END: &str = "end to end";
const BOOTSTRAP: &str = "block bootstrap of each run, ratio by MOVER of the logarithms";
const ORDER: &str = "order statistics of each run's histogram, which take messages as independent, ratio \
                     by MOVER of the logarithms";
const REPETITIONS: &str = "Welch's interval over the repetitions";
const NO_INTERVAL: &str = "no interval: too few messages, or delays that reach zero";
const NO_MAXIMUM: &str = "no interval: one run's maximum has none; repeat the runs";
const NEWCOMBE: &str = "Newcombe's interval (method 10), which takes messages as independent";
const ABSENT: &str = "unavailable on one side";

/// What a delay is: which part of which channel, and which quantile.
type DelayKey = (String, usize, String, usize);
const METRICS: [&str; 4] = ["p50", "p99", "p99.9", "max"];

/// Every figure that either side has.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedFigure> {
    let mut figures = delays(base, new);
    figures.extend(losses(base, new));
    // A channel's losses stand before its delays, in the order of the channels.
    let order = channel_order(base, new);
    let place = |one: &ComparedFigure| {
        let channel = one.channel.as_ref();
        let index = channel.and_then(|name| order.iter().position(|known| known == name));
        (index, one.kind != FigureKind::Loss)
    };
    figures.sort_by_key(place);
    figures.extend(scores(base, new));
    figures
}

fn channel_order(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<String> {
    let mut order: Vec<String> = Vec::new();
    for run in base.iter().chain(new) {
        for channel in &run.summary.channels {
            if !order.contains(&channel.name) {
                order.push(channel.name.clone());
            }
        }
    }
    order
}

fn accounts(run: &ComparedRun) -> impl Iterator<Item = (&str, &ChannelAccount)> {
    let channels = run.summary.channels.iter();
    channels.filter_map(|one| Some((one.name.as_str(), one.account.as_ref()?)))
}

/// Every delay of a run, in nanoseconds, and how its interval came about.
fn delays_of(run: &ComparedRun) -> BTreeMap<DelayKey, (Estimate, &'static str)> {
    let mut found = BTreeMap::new();
    for (channel, account) in accounts(run) {
        let whole = &account.end_to_end;
        let own = [whole.p50_interval, whole.p99_interval, None, None];
        let mut add = |place: usize, name: &str, parts: Parts<'_>| {
            for (index, metric) in METRICS.iter().enumerate() {
                if let Some(estimate) = delay(metric, index, &parts) {
                    let key = (channel.to_owned(), place, name.to_owned(), index);
                    found.insert(key, estimate);
                }
            }
        };
        add(0, END_TO_END, (&whole.distribution, &whole.bins, own));
        for (index, segment) in account.segments.iter().enumerate() {
            let parts = (&segment.distribution, segment.bins.as_slice(), [None; 4]);
            add(index + 1, &segment.name(), parts);
        }
    }
    found
}

type Parts<'a> = (&'a Distribution, &'a [DurationBin], [Option<IntervalNs>; 4]);

fn delay(
    metric: &str,
    index: usize,
    (distribution, bins, own): &Parts<'_>,
) -> Option<(Estimate, &'static str)> {
    let figures: &LatencySummary = distribution.measured()?;
    let (value_ns, quantile) = match metric {
        "p50" => (figures.p50_ns, 0.5),
        "p99" => (figures.p99_ns, 0.99),
        "p99.9" => (figures.p999_ns, 0.999),
        _ => (figures.max_ns, 1.0),
    };
    let binned = || {
        let is_quantile = quantile < 1.0;
        is_quantile
            .then(|| binned_quantile_interval(bins, quantile, CONFIDENCE))
            .flatten()
    };
    let (interval, method) = match own[index] {
        Some(interval) => (Some(interval), BOOTSTRAP),
        None => (binned(), ORDER),
    };
    let estimate = Estimate {
        value: value_ns as f64,
        interval: interval.map(|one| Interval {
            low: one.low_ns as f64,
            high: one.high_ns as f64,
        }),
    };
    Some((estimate, method))
}

fn delays(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedFigure> {
    let collect = |runs: &[ComparedRun]| {
        let mut all: BTreeMap<DelayKey, Vec<(Estimate, &'static str)>> = BTreeMap::new();
        for run in runs {
            for (key, one) in delays_of(run) {
                all.entry(key).or_default().push(one);
            }
        }
        all
    };
    let (b, n) = (collect(base), collect(new));
    let mut keys: Vec<&DelayKey> = b.keys().chain(n.keys()).collect();
    keys.sort();
    keys.dedup();
    keys.into_iter()
        .map(|key| {
            let of = |all: &BTreeMap<DelayKey, Vec<(Estimate, &'static str)>>| {
                all.get(key).cloned().unwrap_or_default()
            };
            let (base, new) = (of(&b), of(&n));
            delay_figure(key, (&base, &new))
        })
        .collect()
}

type Side<'a> = &'a [(Estimate, &'static str)];

fn delay_figure(
    (channel, _, part, metric): &DelayKey,
    (base, new): (Side<'_>, Side<'_>),
) -> ComparedFigure {
    let (b, n) = (geometric(base), geometric(new));
    let both = b.zip(n);
    let quotient = both.and_then(|(b, n)| (b.value > 0.0).then(|| n.value / b.value));
    let logs = |side: Side<'_>| -> Vec<f64> { side.iter().map(|one| one.0.value.ln()).collect() };
    let is_repeated = base.len() > 1 && new.len() > 1;
    let (interval, method) = if both.is_none() {
        (None, ABSENT)
    } else if is_repeated {
        let spread = welch(&logs(base), &logs(new), CONFIDENCE);
        let spread = spread.filter(|one| one.low.is_finite() && one.high.is_finite());
        let spread = spread.map(|one| Interval {
            low: one.low.exp(),
            high: one.high.exp(),
        });
        (spread, REPETITIONS)
    } else {
        let found = both.and_then(|(b, n)| ratio(b, n));
        // A histogram's bins are wider than what it was made of, so say which.
        let method = base.iter().chain(new).map(|one| one.1);
        (found, method.max().unwrap_or(ABSENT))
    };
    let method = match (interval, METRICS[*metric]) {
        (None, "max") if both.is_some() && !is_repeated => NO_MAXIMUM,
        (None, _) if both.is_some() => NO_INTERVAL,
        _ => method,
    };
    ComparedFigure {
        channel: Some(channel.clone()),
        part: part.clone(),
        metric: METRICS[*metric].to_owned(),
        kind: FigureKind::Delay,
        unit: "ns".to_owned(),
        base: b,
        new: n,
        ratio: quotient,
        ratio_interval: interval,
        difference: both.map(|(b, n)| n.value - b.value),
        difference_interval: both
            .filter(|_| !is_repeated)
            .and_then(|(b, n)| difference(b, n)),
        verdict: verdict(interval, 1.0, [Verdict::Faster, Verdict::Slower]),
        method: method.to_owned(),
    }
}

/// One run's figure as it is; of several the geometric mean, which has no interval of its own.
fn geometric(side: Side<'_>) -> Option<Estimate> {
    match side {
        [] => None,
        [only] => Some(only.0),
        several => {
            let logs = several.iter().map(|one| one.0.value.ln());
            let value = (logs.sum::<f64>() / several.len() as f64).exp();
            value.is_finite().then_some(Estimate {
                value,
                interval: None,
            })
        }
    }
}

fn verdict(interval: Option<Interval>, none: f64, [below, above]: [Verdict; 2]) -> Verdict {
    match interval {
        None => Verdict::NotTested,
        Some(one) if one.high < none => below,
        Some(one) if one.low > none => above,
        Some(_) => Verdict::NoDifferenceShown,
    }
}

/// Lost among those whose fate is known and final.
fn share(fates: &FateCounts) -> Share {
    let open =
        fates.of(MessageFate::InFlight) + fates.of(MessageFate::UnknownPeerRecordsUnavailable);
    Share {
        count: fates.lost_count(),
        of: fates.total().saturating_sub(open),
    }
}

fn losses(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedFigure> {
    let collect = |runs: &[ComparedRun]| {
        let mut all: BTreeMap<String, Vec<Share>> = BTreeMap::new();
        for run in runs {
            for (channel, account) in accounts(run) {
                let one = share(&account.fates);
                if one.of > 0 {
                    all.entry(channel.to_owned()).or_default().push(one);
                }
            }
        }
        all
    };
    let (b, n) = (collect(base), collect(new));
    let none = Vec::new();
    channel_order(base, new)
        .into_iter()
        .filter(|channel| b.contains_key(channel) || n.contains_key(channel))
        .map(|channel| {
            let of =
                |all: &BTreeMap<String, Vec<Share>>| all.get(&channel).unwrap_or(&none).clone();
            loss_figure(&channel, &of(&b), &of(&n))
        })
        .collect()
}

fn pooled(shares: &[Share]) -> Share {
    Share {
        count: shares.iter().map(|one| one.count).sum(),
        of: shares.iter().map(|one| one.of).sum(),
    }
}

fn loss_figure(channel: &str, base: &[Share], new: &[Share]) -> ComparedFigure {
    let (b, n) = (pooled(base), pooled(new));
    let (be, ne) = (b.estimate(CONFIDENCE), n.estimate(CONFIDENCE));
    let shares = |side: &[Share]| -> Vec<f64> {
        side.iter()
            .map(|one| one.count as f64 / one.of as f64)
            .collect()
    };
    let repeated = welch(&shares(base), &shares(new), CONFIDENCE);
    let (interval, method) = match repeated {
        Some(interval) => (Some(interval), REPETITIONS),
        None if b.of > 0 && n.of > 0 => (newcombe(b, n, CONFIDENCE), NEWCOMBE),
        None => (None, ABSENT),
    };
    let both = be.zip(ne);
    ComparedFigure {
        channel: Some(channel.to_owned()),
        part: String::new(),
        metric: "loss".to_owned(),
        kind: FigureKind::Loss,
        unit: "1".to_owned(),
        base: be,
        new: ne,
        ratio: both.and_then(|(b, n)| (b.value > 0.0).then(|| n.value / b.value)),
        ratio_interval: None,
        difference: both.map(|(b, n)| n.value - b.value),
        difference_interval: interval,
        verdict: verdict(interval, 0.0, [Verdict::LosesLess, Verdict::LosesMore]),
        method: method.to_owned(),
    }
}

fn scores(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedFigure> {
    let mut names: Vec<&ScoreMetric> = Vec::new();
    for metric in base.iter().chain(new).flat_map(|run| &run.summary.score) {
        if names.iter().all(|known| known.name != metric.name) {
            names.push(metric);
        }
    }
    names
        .into_iter()
        .map(|metric| score_figure(metric, (base, new)))
        .collect()
}

fn score_figure(
    metric: &ScoreMetric,
    (base, new): (&[ComparedRun], &[ComparedRun]),
) -> ComparedFigure {
    let of = |runs: &[ComparedRun]| -> Vec<Estimate> {
        let found = runs.iter().filter_map(|run| {
            let mut all = run.summary.score.iter();
            let one = all.find(|one| one.name == metric.name)?;
            Some(Estimate {
                value: one.value?,
                interval: one.interval.map(|(low, high)| Interval { low, high }),
            })
        });
        found.collect()
    };
    let (bs, ns) = (of(base), of(new));
    let mean = |side: &[Estimate]| match side {
        [] => None,
        [only] => Some(*only),
        several => Some(Estimate {
            value: several.iter().map(|one| one.value).sum::<f64>() / several.len() as f64,
            interval: None,
        }),
    };
    let values = |side: &[Estimate]| side.iter().map(|one| one.value).collect::<Vec<f64>>();
    let both = mean(&bs).zip(mean(&ns));
    let repeated = welch(&values(&bs), &values(&ns), CONFIDENCE);
    let own = both.and_then(|(b, n)| difference(b, n));
    let method = match (repeated, own, both) {
        (Some(_), ..) => REPETITIONS,
        (None, Some(_), _) => "MOVER of the scores' own intervals",
        (None, None, Some(_)) => "no interval: the score has none of its own; repeat the runs",
        (None, None, None) => ABSENT,
    };
    let interval = repeated.or(own);
    let quotient = both.and_then(|(b, n)| (b.value > 0.0).then(|| n.value / b.value));
    ComparedFigure {
        channel: None,
        part: String::new(),
        metric: metric.name.clone(),
        kind: FigureKind::Score,
        unit: metric.unit.clone(),
        base: mean(&bs),
        new: mean(&ns),
        ratio: quotient,
        ratio_interval: both
            .filter(|_| repeated.is_none())
            .and_then(|(b, n)| ratio(b, n)),
        difference: both.map(|(b, n)| n.value - b.value),
        difference_interval: interval,
        verdict: verdict(interval, 0.0, [Verdict::Lower, Verdict::Higher]),
        method: method.to_owned(),
    }
}
