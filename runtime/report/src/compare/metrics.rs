//! The figures of two sides with ratio, difference and intervals. Which interval a figure gets depends
//! on what the runs left: see `docs/compare.md`.

use std::collections::BTreeMap;

use hil_account::network::NetworkMetrics;
use hil_account::{ChannelAccount, FateCounts, MessageFate, ServiceMetrics};
use hil_core::interval::{Interval, Spread, TooSmall};
use hil_stats::comparison::{Estimate, Share, difference, mean_interval, none_of, ratio, welch};
use hil_stats::histogram::{Distribution, LatencySummary};
use hil_stats::statistics::CONFIDENCE;

use super::{ChartKind, ComparedMetric, ComparedRun, Part, Verdict};
use crate::summary::{ChannelSummary, ScoreMetric};

const RANKS: &str = "ranks of the effective sample of each run, ratio by MOVER of the logarithms";
const REPETITIONS: &str = "Welch's interval over the repetitions";
const MIXED: &str = "one run's own interval and Student's over the repetitions of the other side, by \
                     MOVER";
const NO_SPREAD: &str = "no interval: no repetition differs from another, or delays reach zero";
const PARTIAL: &str = "not every repetition has it";
const NO_INTERVAL: &str =
    "no interval: the sample of a run is too small, or of segments; repeat the runs";
const NO_MAXIMUM: &str = "no interval: one run's maximum has none; repeat the runs";
const EFFECTIVE: &str = "MOVER of each run's interval on its effective sample; of runs without losses by \
                         what the other side's sample is worth";
const NO_LOSS: &str =
    "no interval: no run lost any, so that nothing shows how losses come together";
const OWN: &str = "MOVER of the scores' own intervals";
const NO_OWN: &str = "no interval: the score has none of its own; repeat the runs";
const NO_NETWORK: &str = "no interval: of a single run this figure has none; repeat the runs";
const ABSENT: &str = "unavailable on one side";

/// What a delay is of.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct DelayKey {
    channel: String,
    part: Part,
    /// Place in [`METRICS`].
    metric: usize,
}

const METRICS: [&str; 4] = ["p50", "p99", "p99.9", "max"];

/// So many runs of the base, and so many new ones.
pub(super) type Counts = [usize; 2];

/// Some runs of a side have a figure and others do not. What those would have shown is unknown, so that
/// nothing may be told by the ones that are left.
pub(super) fn is_partial(have: Counts, of: Counts) -> bool {
    have.iter().zip(of).any(|(have, of)| (1..of).contains(have))
}

/// What only some of the repetitions have.
pub(super) fn cautions(figures: &[ComparedMetric], of: Counts) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for one in figures {
        let have = [one.base_count, one.new_count];
        if !is_partial(have, of) {
            continue;
        }
        let name = match (&one.channel, one.part) {
            (None, _) => one.metric.clone(),
            (Some(channel), None) => format!("{channel} {}", one.metric),
            // Its quantiles are there together or not at all.
            (Some(channel), Some(part)) => format!("{channel} {part}"),
        };
        let text = format!(
            "{name}: only {} of {} base and {} of {} new runs have it",
            have[0], of[0], have[1], of[1]
        );
        if !found.contains(&text) {
            found.push(text);
        }
    }
    found
}

/// A side's figure, without an interval if only some of its runs have it.
fn of_all(found: Option<Estimate>, have: usize, of: usize) -> Option<Estimate> {
    found.map(|one| Estimate {
        value: one.value,
        interval: one.interval.filter(|_| have == of),
    })
}

/// Every figure that either side has.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedMetric> {
    let mut figures = delays(base, new);
    figures.extend(losses(base, new));
    figures.extend(network(base, new));
    // A channel's losses stand before its delays, in the order of the channels.
    let order = channel_order(base, new);
    let place = |one: &ComparedMetric| {
        let channel = one.channel.as_ref();
        let index = channel.and_then(|name| order.iter().position(|known| known == name));
        (index, one.kind == ChartKind::Delay)
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

/// Every delay of a run, in nanoseconds.
fn delays_of(run: &ComparedRun) -> BTreeMap<DelayKey, Estimate> {
    let mut found = BTreeMap::new();
    for (channel, account) in accounts(run) {
        let mut add = |part, distribution: &Distribution, own| {
            let delays = distribution.measured().map(|one| run_delays(one, own));
            for (metric, delay) in delays.into_iter().flatten().enumerate() {
                let channel = channel.to_owned();
                let key = DelayKey {
                    channel,
                    part,
                    metric,
                };
                found.insert(key, delay);
            }
        };
        let whole = &account.end_to_end;
        let own = [whole.p50_interval, whole.p99_interval, None, None];
        add(Part::EndToEnd, &whole.distribution, own);
        for segment in &account.segments {
            let (from, to) = (segment.from, segment.to);
            let part = Part::Segment { from, to };
            add(part, &segment.distribution, [None; 4]);
        }
    }
    found
}

/// The delays of [`METRICS`], each with its `own` interval.
fn run_delays(figures: &LatencySummary, own: [Option<Spread>; 4]) -> [Estimate; 4] {
    let values = [
        figures.p50_ns,
        figures.p99_ns,
        figures.p999_ns,
        figures.max_ns,
    ];
    core::array::from_fn(|metric| Estimate {
        value: values[metric] as f64,
        interval: own[metric].and_then(Spread::known),
    })
}

fn delays(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedMetric> {
    let collect = |runs: &[ComparedRun]| {
        let mut all: BTreeMap<DelayKey, Vec<Estimate>> = BTreeMap::new();
        for (key, one) in runs.iter().flat_map(delays_of) {
            all.entry(key).or_default().push(one);
        }
        all
    };
    let (b, n) = (collect(base), collect(new));
    let mut keys: Vec<&DelayKey> = b.keys().chain(n.keys()).collect();
    keys.sort();
    keys.dedup();
    keys.into_iter()
        .map(|key| {
            let [b, n] = [&b, &n].map(|all| all.get(key).map_or(&[][..], Vec::as_slice));
            let figure = delay_figure(METRICS[key.metric], b, n, [base.len(), new.len()]);
            ComparedMetric {
                channel: Some(key.channel.clone()),
                part: Some(key.part),
                ..figure
            }
        })
        .collect()
}

fn delay_figure(metric: &str, base: &[Estimate], new: &[Estimate], of: Counts) -> ComparedMetric {
    let have = [base.len(), new.len()];
    let sides = [geometric(base), geometric(new)];
    let figure = figure(ChartKind::Delay, metric, sides, have, of);
    let both = figure.base.zip(figure.new);
    let both = both.filter(|_| have.contains(&1));
    let repeated = welch(&logarithms(base), &logarithms(new), CONFIDENCE);
    let method = if have == [1, 1] { RANKS } else { MIXED };
    let none = match metric {
        "max" => NO_MAXIMUM,
        "pdv_p99" | "ipdv_p99" => NO_NETWORK,
        _ => NO_INTERVAL,
    };
    let own = both.and_then(|(b, n)| ratio(b, n));
    let (interval, method) = figure.tested(of, repeated.and_then(exponential), own, [method, none]);
    ComparedMetric {
        unit: "ns".to_owned(),
        ratio_interval: interval,
        difference_interval: both.and_then(|(b, n)| difference(b, n)),
        verdict: verdict(interval, 1.0, [Verdict::Faster, Verdict::Slower]),
        method: method.to_owned(),
        ..figure
    }
}

/// What two sides come to in every figure, of which `have` of their runs have it.
fn figure(
    kind: ChartKind,
    metric: &str,
    sides: [Option<Estimate>; 2],
    have: Counts,
    of: Counts,
) -> ComparedMetric {
    let [base, new] = [0, 1].map(|side| of_all(sides[side], have[side], of[side]));
    let both = base.zip(new);
    ComparedMetric {
        channel: None,
        part: None,
        metric: metric.to_owned(),
        label: metric.to_owned(),
        kind,
        unit: "1".to_owned(),
        base,
        new,
        base_count: have[0],
        new_count: have[1],
        ratio: both.and_then(|(b, n)| (b.value > 0.0).then(|| n.value / b.value)),
        ratio_interval: None,
        difference: both.map(|(b, n)| n.value - b.value),
        difference_interval: None,
        verdict: Verdict::NotTested,
        method: String::new(),
    }
}

impl ComparedMetric {
    /// The interval that it gets and how that came about, or why there is none: the repetitions', else that
    /// of its `own` intervals, by the first method; the second text is for where there is neither.
    fn tested(
        &self,
        of: Counts,
        repeated: Option<Interval>,
        own: Option<Interval>,
        [method, none]: [&'static str; 2],
    ) -> (Option<Interval>, &'static str) {
        let have = [self.base_count, self.new_count];
        match (repeated, own) {
            _ if self.difference.is_none() => (None, ABSENT),
            _ if is_partial(have, of) => (None, PARTIAL),
            (Some(_), _) => (repeated, REPETITIONS),
            (None, Some(_)) => (own, method),
            (None, None) if have.iter().all(|count| *count > 1) => (None, NO_SPREAD),
            (None, None) => (None, none),
        }
    }
}

fn logarithms(side: &[Estimate]) -> Vec<f64> {
    side.iter().map(|one| one.value.ln()).collect()
}

/// Back from an interval of logarithms; `None` where that cannot be written as a number.
fn exponential(one: Interval) -> Option<Interval> {
    let (low, high) = (one.low.exp(), one.high.exp());
    let is_known = one.low.is_finite() && high.is_finite();
    is_known.then_some(Interval { low, high, ..one })
}

/// The mean with Student's interval; `None` of nothing.
fn mean(values: &[f64]) -> Option<Estimate> {
    (!values.is_empty()).then(|| Estimate {
        value: values.iter().sum::<f64>() / values.len() as f64,
        interval: mean_interval(values, CONFIDENCE),
    })
}

/// One run's figure as it is; of several the geometric mean, with Student's interval of the logarithms.
fn geometric(side: &[Estimate]) -> Option<Estimate> {
    if let [only] = side {
        return Some(*only);
    }
    let logarithm = mean(&logarithms(side))?;
    let value = logarithm.value.exp();
    value.is_finite().then(|| Estimate {
        value,
        interval: logarithm.interval.and_then(exponential),
    })
}

fn verdict(interval: Option<Interval>, none: f64, [below, above]: [Verdict; 2]) -> Verdict {
    match interval {
        None => Verdict::NotTested,
        Some(one) if one.high < none => below,
        Some(one) if one.low > none => above,
        Some(_) => Verdict::NoDifferenceShown,
    }
}

/// The share lost in a run.
#[derive(Debug, Clone, Copy)]
struct RunLoss {
    /// Lost among those whose fate is known and final.
    share: Share,
    /// On the effective sample. Without a loss nothing is known of how they would come together.
    interval: Option<Interval>,
}

impl RunLoss {
    /// `None` of no messages.
    fn of(run: &ComparedRun, channel: &str, fates: &FateCounts) -> Option<Self> {
        let open =
            fates.of(MessageFate::InFlight) + fates.of(MessageFate::UnknownPeerRecordsUnavailable);
        let share = Share {
            count: fates.lost_count(),
            of: fates.total().saturating_sub(open),
        };
        if share.of == 0 {
            return None;
        }
        // Of the same messages: the harness may lose some too.
        let same = network_of(run, channel).filter(|one| one.lost_count == share.count);
        let same = same.and_then(|one| one.loss.measured());
        Some(Self {
            share,
            interval: same.and_then(|loss| loss.interval.known()),
        })
    }

    fn value(self) -> f64 {
        self.share.count as f64 / self.share.of as f64
    }
}

fn losses(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedMetric> {
    let collect = |runs: &[ComparedRun]| {
        let mut all: BTreeMap<String, Vec<RunLoss>> = BTreeMap::new();
        for run in runs {
            for (channel, account) in accounts(run) {
                if let Some(one) = RunLoss::of(run, channel, &account.fates) {
                    all.entry(channel.to_owned()).or_default().push(one);
                }
            }
        }
        all
    };
    let (b, n) = (collect(base), collect(new));
    channel_order(base, new)
        .into_iter()
        .filter(|channel| b.contains_key(channel) || n.contains_key(channel))
        .map(|channel| {
            let [b, n] = [&b, &n].map(|all| all.get(&channel).map_or(&[][..], Vec::as_slice));
            loss_figure(&channel, b, n, [base.len(), new.len()])
        })
        .collect()
}

/// One run's share as it is; of several their mean with Student's interval, whose width tells what they are worth.
fn observed_share(side: &[RunLoss]) -> Option<Estimate> {
    let values = values_of(side);
    Some(Estimate {
        interval: match side {
            [only] => only.interval,
            _ => mean_interval(&values, CONFIDENCE),
        },
        ..mean(&values)?
    })
}

/// The same within the bounds of a share. Runs without any loss are one, whose losses would come together as those
/// of the `other` side.
fn mean_share(side: &[RunLoss], other: &[RunLoss]) -> Option<Estimate> {
    let observed = observed_share(side)?;
    let (pooled, pooled_other) = (pooled(side), pooled(other));
    let interval = match (pooled.count, pooled_other.count) {
        (0, 0) => None,
        (0, _) => {
            let like = observed_share(other);
            like.and_then(|like| none_of(pooled.of, like, pooled_other.of))
        }
        // A share has no less than none and no more than all.
        _ => {
            let own = observed.interval;
            own.map(|found| found.map(|end| end.clamp(0.0, 1.0)))
        }
    };
    Some(Estimate {
        interval,
        ..observed
    })
}

fn pooled(side: &[RunLoss]) -> Share {
    let sum = |part: fn(&Share) -> u64| side.iter().map(|one| part(&one.share)).sum();
    Share {
        count: sum(|one| one.count),
        of: sum(|one| one.of),
    }
}

fn values_of(side: &[RunLoss]) -> Vec<f64> {
    side.iter().map(|one| one.value()).collect()
}

fn loss_figure(channel: &str, base: &[RunLoss], new: &[RunLoss], of: Counts) -> ComparedMetric {
    let have = [base.len(), new.len()];
    let sides = [mean_share(base, new), mean_share(new, base)];
    let figure = figure(ChartKind::Loss, "loss", sides, have, of);
    let repeated = welch(&values_of(base), &values_of(new), CONFIDENCE);
    let is_lossless = base.iter().chain(new).all(|one| one.share.count == 0);
    let method = if have == [1, 1] { EFFECTIVE } else { MIXED };
    let both = figure.base.zip(figure.new);
    let own = both.and_then(|(b, n)| difference(b, n));
    let (interval, method) = figure.tested(of, repeated, own, [method, NO_INTERVAL]);
    let method = match method {
        NO_SPREAD | NO_INTERVAL if is_lossless => NO_LOSS,
        method => method,
    };
    ComparedMetric {
        channel: Some(channel.to_owned()),
        difference_interval: interval,
        verdict: verdict(interval, 0.0, [Verdict::LosesLess, Verdict::LosesMore]),
        method: method.to_owned(),
        ..figure
    }
}

/// A figure of the network that a run has once a channel.
struct NetworkFigure {
    metric: &'static str,
    kind: ChartKind,
    unit: &'static str,
    of: fn(Option<&NetworkMetrics>, &ChannelSummary) -> Option<f64>,
}

/// Beside loss and delay: order by RFC 4737, copies by RFC 5560, losses in a row by RFC 3357, both forms of delay variation
/// by RFC 5481, and, where a demand is stated, what it is judged by. The account defines them.
const NETWORK: [NetworkFigure; 7] = [
    NetworkFigure {
        metric: "reordered",
        kind: ChartKind::Loss,
        unit: "1",
        of: |figures, _| figures?.order.measured().map(|order| order.ratio),
    },
    NetworkFigure {
        metric: "duplicated",
        kind: ChartKind::Loss,
        unit: "1",
        of: |figures, channel| {
            let duplicated_count = channel.account.as_ref()?.duplicated_count?;
            let share = duplicated_count as f64 / figures?.arrived_count as f64;
            share.is_finite().then_some(share)
        },
    },
    NetworkFigure {
        metric: "not_in_time",
        kind: ChartKind::Loss,
        unit: "1",
        of: |_, channel| Some(1.0 - service(channel)?.reliability),
    },
    NetworkFigure {
        metric: "unavailability",
        kind: ChartKind::Loss,
        unit: "1",
        of: |_, channel| Some(1.0 - service(channel)?.availability),
    },
    NetworkFigure {
        metric: "loss_run_max",
        kind: ChartKind::Count,
        unit: "messages",
        of: |figures, _| {
            let runs = figures?.loss.measured()?.runs.iter();
            Some(runs.map(|one| one.length_messages).max().unwrap_or(0) as f64)
        },
    },
    NetworkFigure {
        metric: "pdv_p99",
        kind: ChartKind::Delay,
        unit: "ns",
        of: |figures, _| Some(figures?.delay.measured()?.variation.p99_ns as f64),
    },
    NetworkFigure {
        metric: "ipdv_p99",
        kind: ChartKind::Delay,
        unit: "ns",
        of: |figures, _| Some(figures?.successive.measured()?.p99_ns as f64),
    },
];

/// The service by the limits of the channel's demand; `None` without one, and where it was not judged.
fn service(channel: &ChannelSummary) -> Option<&ServiceMetrics> {
    channel.demand.as_ref()?.service.measured()
}

/// The figures of [`NETWORK`] of each channel.
fn network(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedMetric> {
    let of = [base.len(), new.len()];
    let mut figures = Vec::new();
    for channel in channel_order(base, new) {
        for NetworkFigure {
            metric,
            kind,
            unit,
            of: value,
        } in &NETWORK
        {
            let side = |runs: &[ComparedRun]| -> Vec<Estimate> {
                let found = runs.iter().filter_map(|run| {
                    let mut channels = run.summary.channels.iter();
                    let found = channels.find(|one| one.name == channel)?;
                    value(network_of(run, &channel), found)
                });
                found
                    .map(|value| Estimate {
                        value,
                        interval: None,
                    })
                    .collect()
            };
            let (b, n) = (side(base), side(new));
            if b.is_empty() && n.is_empty() {
                continue;
            }
            let figure = if *kind == ChartKind::Delay {
                delay_figure(metric, &b, &n, of)
            } else {
                counted_figure(*kind, metric, [&b, &n], of)
            };
            figures.push(ComparedMetric {
                channel: Some(channel.clone()),
                part: (*kind == ChartKind::Delay).then_some(Part::Network),
                unit: (*unit).to_owned(),
                ..figure
            });
        }
    }
    figures
}

/// A figure that is compared by its difference, which of single runs has no interval.
fn counted_figure(
    kind: ChartKind,
    metric: &str,
    [base, new]: [&[Estimate]; 2],
    of: Counts,
) -> ComparedMetric {
    let sides = [mean_score(base), mean_score(new)];
    let figure = figure(kind, metric, sides, [base.len(), new.len()], of);
    let repeated = welch(&plain(base), &plain(new), CONFIDENCE);
    let (interval, method) = figure.tested(of, repeated, None, [MIXED, NO_NETWORK]);
    ComparedMetric {
        difference_interval: interval,
        verdict: verdict(interval, 0.0, [Verdict::Lower, Verdict::Higher]),
        method: method.to_owned(),
        ..figure
    }
}

/// What the network did to a channel in a run.
fn network_of<'a>(run: &'a ComparedRun, channel: &str) -> Option<&'a NetworkMetrics> {
    let mut channels = run.summary.network.iter().flat_map(|one| &one.channels);
    let found = channels.find(|one| one.channel == channel)?;
    Some(&found.figures)
}

fn scores(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedMetric> {
    let mut names: Vec<&ScoreMetric> = Vec::new();
    for metric in base.iter().chain(new).flat_map(|run| &run.summary.score) {
        if names.iter().all(|known| known.name != metric.name) {
            names.push(metric);
        }
    }
    names
        .into_iter()
        .map(|metric| score_figure(metric, base, new))
        .collect()
}

fn score_figure(metric: &ScoreMetric, base: &[ComparedRun], new: &[ComparedRun]) -> ComparedMetric {
    let (bs, ns) = (scores_of(metric, base), scores_of(metric, new));
    let (have, of) = ([bs.len(), ns.len()], [base.len(), new.len()]);
    let sides = [mean_score(&bs), mean_score(&ns)];
    let figure = figure(ChartKind::Score, &metric.name, sides, have, of);
    let too_small = base
        .iter()
        .chain(new)
        .find_map(|run| too_small(metric, run));
    let repeated = welch(&plain(&bs), &plain(&ns), CONFIDENCE);
    let both = figure.base.zip(figure.new);
    let own = both.and_then(|(b, n)| difference(b, n));
    let method = if have == [1, 1] { OWN } else { MIXED };
    let (interval, method) = figure.tested(of, repeated, own, [method, NO_OWN]);
    let method = match too_small {
        Some(why) if method == NO_OWN => format!("no interval: {why}"),
        _ => method.to_owned(),
    };
    ComparedMetric {
        label: metric.label.clone(),
        unit: metric.unit.clone(),
        ratio_interval: both
            .filter(|_| repeated.is_none())
            .and_then(|(b, n)| ratio(b, n)),
        difference_interval: interval,
        verdict: verdict(interval, 0.0, [Verdict::Lower, Verdict::Higher]),
        method,
        ..figure
    }
}

/// Why a run's score of that name has no interval of its own, where its sample is too small for one.
fn too_small(metric: &ScoreMetric, run: &ComparedRun) -> Option<TooSmall> {
    let mut all = run.summary.score.iter();
    match all.find(|one| one.name == metric.name)?.interval? {
        Spread::Known(_) => None,
        Spread::Unknown(why) => Some(why),
    }
}

/// The score of that name of every run that has it.
fn scores_of(metric: &ScoreMetric, runs: &[ComparedRun]) -> Vec<Estimate> {
    let found = runs.iter().filter_map(|run| {
        let mut all = run.summary.score.iter();
        let one = all.find(|one| one.name == metric.name)?;
        Some(Estimate {
            value: one.value?,
            interval: one.interval.and_then(Spread::known),
        })
    });
    found.collect()
}

fn plain(side: &[Estimate]) -> Vec<f64> {
    side.iter().map(|one| one.value).collect()
}

/// One run's score as it is; of several the mean with Student's interval.
fn mean_score(side: &[Estimate]) -> Option<Estimate> {
    match side {
        [only] => Some(*only),
        several => mean(&plain(several)),
    }
}

#[cfg(test)]
mod tests;
