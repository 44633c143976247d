//! One channel of a page: its figures, tables and drawings, from the account and the network's figures
//! of a summary. Nothing is computed anew but shares of counts.

use hil_account::network::{DelayQuantile, Metric as Measured, NetworkMetrics};
use hil_account::{ChannelAccount, Coverage, MessageFate, OutageMetrics, SegmentMetrics};
use hil_stats::histogram::Distribution;
use hil_stats::statistics::{CONFIDENCE, IntervalNs, wilson};

use super::charts::waterfall::Bar;
use super::data::{Channel, Metric, Table};
use super::words::{UNAVAILABLE, count, ns_s, number};
use crate::summary::LinkKind;
use crate::terminal::{JOINT, duration, percent, unsigned_duration};
use hil_platform::text::grouped;
use hil_platform::words::counted;

/// What there is of one channel.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sources<'a> {
    /// True for a channel that goes over a network or the model of one.
    pub(super) crosses: bool,
    pub(super) account: Option<&'a ChannelAccount>,
    /// How a live run carried it.
    pub(super) link: Option<LinkKind>,
    pub(super) network: Option<&'a NetworkMetrics>,
    pub(super) outages: Option<&'a OutageMetrics>,
}

const BOOTSTRAP: &str = "95 % by block bootstrap, as successive delays are correlated";
const NO_ACCOUNT: &str = "no records of this channel";
const NO_NETWORK: &str = "no figures of a network under this channel";

/// Figures and tables of a channel.
pub(super) fn fill(channel: &mut Channel, sources: &Sources<'_>) {
    channel.figures.extend(counts(sources));
    if sources.crosses {
        channel.figures.push(loss_ratio(sources.network));
        channel.figures.extend(order(sources));
    } else {
        let words = "the channel crossed no network: it has no loss, order or one-way delay of one";
        channel.notes.push(words.to_owned());
    }
    channel.figures.extend(end_to_end(sources));
    if sources.crosses {
        channel.figures.extend(network(sources));
    }
    if let Some(outages) = sources.outages {
        channel.figures.extend(outage_metrics(outages));
        channel.tables.extend(outage_table(outages));
    } else {
        let unknown = Metric::unavailable("outage_count", "outages", "1", "unknown: no records");
        channel.figures.push(unknown);
    }
    if let Some(account) = sources.account {
        channel.tables.push(segment_table(account));
        channel.tables.extend(fate_table(account, sources.link));
        channel.tables.extend(stamp_table(account));
    }
}

fn counts(sources: &Sources<'_>) -> Vec<Metric> {
    let figure = |name, label, count: Option<u64>, reason: &str| {
        Metric::maybe(name, label, "1", count.map(|count| count as f64), reason)
    };
    let account = sources.account;
    let live = |of: fn(&ChannelAccount) -> u64| account.map(of);
    let taken = |account: &ChannelAccount| account.fates.of(MessageFate::Taken);
    let published = live(|one| one.published_count);
    let delivered = live(taken);
    let lost = live(|one| one.fates.lost_count());
    let is_total_known = account.is_none_or(|one| one.published_unrecorded_count.is_some());
    let published_method = if is_total_known {
        "every sequence number up to the highest seen"
    } else {
        "known here only: the producer's records are not at hand"
    };
    vec![
        figure("published", "published", published, NO_ACCOUNT).by(published_method),
        figure("delivered", "delivered", delivered, NO_ACCOUNT).by("taken by the consumer"),
        figure("lost", "lost, by host or network", lost, NO_ACCOUNT)
            .by("vanished; messages that a newer one replaced and those under way are not lost"),
    ]
}

fn loss_ratio(network: Option<&NetworkMetrics>) -> Metric {
    let unavailable =
        |reason: &str| Metric::unavailable("loss_ratio", "lost by the network", "share", reason);
    let Some(network) = network else {
        return unavailable(NO_NETWORK);
    };
    match &network.loss {
        Measured::Measured(loss) => {
            let interval = (loss.interval.low, loss.interval.high);
            let independent = loss.independent_interval;
            Metric::new("loss_ratio", "lost by the network", "share", loss.ratio)
                .within(Some(interval))
                .by(&format!(
                    "95 %, Wilson on {} independent messages' worth of {}, as losses come in \
                     bursts; as if independent {} to {}",
                    number(loss.effective_count.max(0.0).round()),
                    grouped(loss.of_count),
                    percent(independent.low),
                    percent(independent.high)
                ))
        }
        Measured::Unavailable { reason } => unavailable(reason),
    }
}

/// Late, duplicated, reordered: counts, each with its share of what arrived.
fn order(sources: &Sources<'_>) -> Vec<Metric> {
    let account = sources.account;
    let reason = match (account, sources.network) {
        (None, None) => NO_ACCOUNT,
        _ => "the receiving gateway's records are not at hand",
    };
    let arrived = sources.network.map(|one| one.arrived_count);
    let late = account.and_then(|one| one.late_count);
    let duplicated = account
        .and_then(|one| one.duplicated_count)
        .or_else(|| sources.network.and_then(|one| one.duplicated_count));
    let by_network = || Some(sources.network?.order.measured()?.reordered_count);
    let reordered = account
        .and_then(|one| one.reordered_count)
        .or_else(by_network);
    let mut figures = Vec::new();
    for (name, label, found) in [
        ("late", "too late for the gateway", late),
        ("duplicated", "duplicated", duplicated),
        ("reordered", "reordered", reordered),
    ] {
        let figure = Metric::maybe(name, label, "1", found.map(|found| found as f64), reason);
        let shares = found.zip(arrived).and_then(|(found, arrived)| {
            let interval = wilson(found.min(arrived), arrived, CONFIDENCE)?;
            let share = percent(found as f64 / arrived as f64);
            let (low, high) = (percent(interval.low), percent(interval.high));
            Some(format!(
                "{share} of {} that arrived; 95 % {low} to {high}, Wilson, as if independent",
                grouped(arrived)
            ))
        });
        figures.push(figure.by(&shares.unwrap_or_default()));
    }
    figures
}

/// The delay of which a channel has quantiles: what the names and the labels of its figures begin with.
#[derive(Clone, Copy)]
struct DelayKind {
    prefix: &'static str,
    label: &'static str,
}

const END_TO_END: DelayKind = DelayKind {
    prefix: "",
    label: "published → taken",
};
const ONE_WAY: DelayKind = DelayKind {
    prefix: "network_",
    label: "network, one way",
};

impl DelayKind {
    fn figure(self, name: &str, label: &str, ns: i64, interval: Option<IntervalNs>) -> Metric {
        let (name, label) = self.names(name, label);
        let method = if interval.is_some() { BOOTSTRAP } else { "" };
        let interval = interval.map(|one| (ns_s(one.low_ns), ns_s(one.high_ns)));
        Metric::new(&name, &label, "s", ns_s(ns))
            .within(interval)
            .by(method)
    }

    fn names(self, name: &str, label: &str) -> (String, String) {
        (
            [self.prefix, name].concat(),
            [self.label, ", ", label].concat(),
        )
    }

    fn unavailable(self, reason: &str) -> Vec<Metric> {
        let names = [
            ("p50", "p50"),
            ("p99", "p99"),
            ("p999", "p99.9"),
            ("max", "largest"),
        ];
        let figure = |(name, label): (&str, &str)| {
            let (name, label) = self.names(name, label);
            Metric::unavailable(&name, &label, "s", reason)
        };
        names.map(figure).to_vec()
    }
}

fn end_to_end(sources: &Sources<'_>) -> Vec<Metric> {
    let Some(account) = sources.account else {
        return END_TO_END.unavailable(NO_ACCOUNT);
    };
    let whole = &account.end_to_end;
    match &whole.distribution {
        Distribution::Unavailable { reason } => END_TO_END.unavailable(reason),
        Distribution::Measured(summary) => {
            let figure = |name, label, ns, interval| END_TO_END.figure(name, label, ns, interval);
            let mut figures = vec![
                figure("min", "least", summary.min_ns, None),
                figure("p50", "p50", summary.p50_ns, whole.p50_interval),
                figure("p90", "p90", summary.p90_ns, None),
                figure("p99", "p99", summary.p99_ns, whole.p99_interval),
                figure("p999", "p99.9", summary.p999_ns, None),
                figure("max", "largest", summary.max_ns, None),
            ];
            if let Some(bound_ns) = whole.alignment_bound_ns.filter(|bound_ns| *bound_ns > 0) {
                let bound = Metric::new(
                    "clock_bound",
                    "off by the clocks, at most",
                    "s",
                    bound_ns as f64 * 1e-9,
                );
                figures
                    .push(bound.by("guaranteed by the clock exchanges; in none of the intervals"));
            }
            figures
        }
    }
}

fn network(sources: &Sources<'_>) -> Vec<Metric> {
    let Some(network) = sources.network else {
        return ONE_WAY.unavailable(NO_NETWORK);
    };
    let mut figures = match &network.delay {
        Measured::Unavailable { reason } => ONE_WAY.unavailable(reason),
        Measured::Measured(delay) => {
            let of = |name, label, one: DelayQuantile| {
                ONE_WAY.figure(name, label, one.value_ns, one.interval)
            };
            let variation = ns_s(delay.variation.p99_ns);
            vec![
                ONE_WAY.figure("min", "least", delay.min_ns, None),
                of("p50", "p50", delay.p50),
                of("p95", "p95", delay.p95),
                of("p99", "p99", delay.p99),
                of("p999", "p99.9", delay.p999),
                ONE_WAY.figure("max", "largest", delay.max_ns, None),
                Metric::new("variation_p99", "delay variation, p99", "s", variation)
                    .by("above the smallest delay of the run (RFC 5481, PDV)"),
            ]
        }
    };
    let (jitter_s, reason) = match &network.successive {
        Measured::Measured(successive) => (Some(successive.jitter.mean_ns * 1e-9), ""),
        Measured::Unavailable { reason } => (None, reason.as_str()),
    };
    let jitter = Metric::maybe("jitter_mean", "jitter, mean", "s", jitter_s, reason);
    figures.push(jitter.by("RFC 3550; needs no aligned clocks"));
    let (round_trip_s, reason) = match &network.round_trip {
        Distribution::Measured(one) => (Some(ns_s(one.p50_ns)), ""),
        Distribution::Unavailable { reason } => (None, reason.as_str()),
    };
    let label = "round trip of the gateways, p50";
    figures.push(Metric::maybe(
        "round_trip_p50",
        label,
        "s",
        round_trip_s,
        reason,
    ));
    figures
}

fn outage_metrics(outages: &OutageMetrics) -> Vec<Metric> {
    let longest = outages.longest.as_ref();
    let where_from = longest.map_or_else(String::new, |one| {
        let open = if one.is_open {
            ", to the end of the run"
        } else {
            ""
        };
        let lost = counted(one.lost_count, "message");
        format!("from {:.3}{JOINT}s, {lost} lost{open}", ns_s(one.start_ns))
    });
    let longest = longest.map(|one| ns_s(one.length_ns));
    vec![
        Metric::new("outage_count", "outages", "1", outages.outage_count as f64)
            .by("runs of lost messages"),
        Metric::maybe(
            "outage_longest",
            "longest outage",
            "s",
            longest,
            "there was none",
        )
        .by(&where_from),
    ]
}

fn outage_table(outages: &OutageMetrics) -> Option<Table> {
    if outages.outage_count == 0 {
        return None;
    }
    let mut table = Table::new("Outages by length", &["length", "outages", "messages lost"]);
    for class in &outages.classes {
        let from = duration(class.from_ns);
        let words = match class.until_ns {
            Some(until_ns) => format!("{from} to {}", duration(until_ns)),
            None => format!("{from} and longer"),
        };
        let counts = [class.outage_count, class.lost_count].map(grouped);
        table.rows.push([vec![words], counts.to_vec()].concat());
    }
    if outages.unknown_length_count > 0 {
        let unknown = grouped(outages.unknown_length_count);
        table.note = format!("{unknown} more in no class: no record tells when they began");
    }
    Some(table)
}

const SEGMENT_COLUMNS: [&str; 7] = [
    "segment",
    "p50",
    "p90",
    "p99",
    "p99.9",
    "largest",
    "off by at most",
];

fn segment_row(name: &str, figures: &Distribution, bound: Option<u64>) -> Vec<String> {
    match figures {
        Distribution::Measured(one) => {
            let values = [one.p50_ns, one.p90_ns, one.p99_ns, one.p999_ns, one.max_ns];
            let bound = match bound {
                None | Some(0) => "–".to_owned(),
                Some(ns) => unsigned_duration(ns),
            };
            let values = values.map(duration).to_vec();
            [vec![name.to_owned()], values, vec![bound]].concat()
        }
        Distribution::Unavailable { reason } => {
            vec![name.to_owned(), format!("{UNAVAILABLE}: {reason}")]
        }
    }
}

fn segment_table(account: &ChannelAccount) -> Table {
    let mut table = Table::new("Where the time went", &SEGMENT_COLUMNS);
    for segment in &account.segments {
        let bound = segment.bound.map(|bound| bound.largest_ns);
        let name = segment_name(segment);
        let row = segment_row(&name, &segment.distribution, bound);
        // A reason is said once: rows of two cells have nothing but one.
        match table.rows.last_mut() {
            Some(last) if row.len() == 2 && last.len() == 2 && last[1] == row[1] => {
                last[0] = format!("{}; {name}", last[0]);
            }
            _ => table.rows.push(row),
        }
    }
    if let Some(hardware) = &account.hardware_wire {
        table.rows.push(segment_row("card to card", hardware, None));
    }
    let whole = &account.end_to_end;
    let bound = whole.alignment_bound_ns;
    table
        .rows
        .push(segment_row("published → taken", &whole.distribution, bound));
    "Quantiles are from histograms with three digits, of messages that have both ends. \
                  \"Off by at most\" is what the alignment of two hosts' clocks may add or take."
        .clone_into(&mut table.note);
    table
}

/// Both ends, and whether stages between were missing.
fn segment_name(segment: &SegmentMetrics) -> String {
    let combined = if segment.is_combined {
        " (combined: a stamp between is missing)"
    } else {
        ""
    };
    format!("{}{combined}", segment.name())
}

fn fate_table(account: &ChannelAccount, link: Option<LinkKind>) -> Option<Table> {
    let total = account.published_count;
    if total == 0 {
        return None;
    }
    let mut table = Table::new(
        "What became of the messages",
        &["fate", "messages", "share"],
    );
    let is_total_known = account.published_unrecorded_count.is_some();
    for (fate, count) in account.fates.iter() {
        let share = if is_total_known {
            percent(count as f64 / total as f64)
        } else {
            UNAVAILABLE.to_owned()
        };
        let label = link.map_or(fate.label(), |link| link.fate_label(fate));
        table
            .rows
            .push(vec![label.to_owned(), grouped(count), share]);
    }
    Some(table)
}

fn stamp_table(account: &ChannelAccount) -> Option<Table> {
    let coverage = &account.coverage;
    let stamps = [
        ("kernel, transmit", coverage.tx_software),
        ("kernel, receive", coverage.rx_software),
        ("network card, transmit", coverage.tx_hardware),
        ("network card, receive", coverage.rx_hardware),
    ];
    stamps.iter().find_map(|(_, found)| *found)?;
    let mut table = Table::new("Time stamps", &["stamp", "stamped", "of", "share"]);
    for (name, found) in stamps {
        let share = found.and_then(|one| one.ratio());
        let share = share.map_or_else(|| UNAVAILABLE.to_owned(), percent);
        let of = |part: fn(Coverage) -> u64| count(found.map(part));
        let row = [
            name.to_owned(),
            of(|one| one.stamped_count),
            of(|one| one.eligible_count),
            share,
        ];
        table.rows.push(row.to_vec());
    }
    Some(table)
}

/// The chain of a channel for the waterfall.
pub(super) fn bar(channel: &str, account: &ChannelAccount) -> Bar {
    let parts = account
        .segments
        .iter()
        .filter(|segment| !segment.is_combined);
    let parts = parts.filter_map(|segment| {
        let summary = segment.distribution.measured()?;
        Some((segment.name(), summary.p50_ns))
    });
    let whole = account.end_to_end.distribution.measured();
    Bar {
        channel: channel.to_owned(),
        parts: parts.collect(),
        whole_ns: whole.map(|one| one.p50_ns),
    }
}
