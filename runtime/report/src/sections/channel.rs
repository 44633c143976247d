//! The channels of a run: metrics, facts and tables of each, from its account and the network's metrics. Nothing is
//! computed anew but shares of counts.

use core::fmt::Write;

use hil_account::network::{
    DelayMetrics, DelayQuantile, LossMetrics, Metric as Measured, NetworkMetrics,
    SuccessiveVariation,
};
use hil_account::{
    BurstCount, ChannelAccount, Closing, ClosingMetrics, Coverage, Gap, LongestOutage, MessageFate,
    OutageClass, OutageMetrics, ProducerSilence, SegmentMetrics,
};
use hil_core::interval::Spread;
use hil_rundir::event::ProcessKind;
use hil_stats::histogram::Distribution;

use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{duration, duration_s, figure, ns_s, percent, seconds, unsigned_duration};
use hil_present::{Bar, Cell, Metric, Row, Section, Table, Tone, UNAVAILABLE};
use hil_rundir::pipe::StallMetrics;

use super::{clocks, radio};
use crate::emulation::EmulationMetrics;
use crate::own_programs::silence_words;
use crate::summary::{ChannelSummary, LinkKind, RunSummary};
use crate::trace_counts::replay_words;

/// What there is of one channel.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sources<'a> {
    /// True for a channel that goes over a network or the model of one.
    pub(crate) crosses: bool,
    pub(crate) account: Option<&'a ChannelAccount>,
    /// How a live run carried it.
    pub(crate) link: Option<LinkKind>,
    pub(crate) network: Option<&'a NetworkMetrics>,
    pub(crate) outages: Option<&'a OutageMetrics>,
}

const NO_ACCOUNT: &str = "no records of this channel";
const PRODUCER_UNKNOWN: &str = "known here only: the producer's records are not at hand";
const NO_NETWORK: &str = "no figures of a network under this channel";

/// Lengths of runs of losses that are listed.
const RUNS_SHOWN_COUNT: usize = 8;

impl<'a> Sources<'a> {
    /// Of a channel of `summary`.
    pub(crate) fn of(channel: &'a ChannelSummary, summary: &'a RunSummary) -> Self {
        let report = summary.network.as_ref();
        let mut channels = report.into_iter().flat_map(|report| &report.channels);
        let network = channels.find(|one| one.channel == channel.name);
        let is_local = matches!(channel.link, LinkKind::SharedMemory | LinkKind::RecordOnly);
        Self {
            crosses: network.is_some() || !is_local,
            account: channel.account.as_ref(),
            link: Some(channel.link),
            network: network.map(|network| &network.figures),
            outages: channel.outages.as_ref(),
        }
    }
}

/// Every channel of the run, in the order of the case study.
pub(super) fn channels(summary: &RunSummary) -> Section {
    let mut section = Section::new("channels", "Channels", "");
    let channels = summary.channels.iter();
    section.children = channels.map(|one| channel(one, summary)).collect();
    section
}

fn channel(one: &ChannelSummary, summary: &RunSummary) -> Section {
    let link = one.link.label();
    let Some(to) = &one.to else {
        let mut section = Section::new("channel", &one.name, format!("{} · {link}", one.from));
        section.subject.clone_from(&one.name);
        let (tone, text) = one.recorded.map_or_else(
            || {
                (
                    Tone::Faint,
                    format!("{UNAVAILABLE}: no record of this channel"),
                )
            },
            |recorded| {
                let all = counted(recorded.message_count, "message");
                match recorded.missing_count {
                    0 => (Tone::Plain, format!("{all} recorded")),
                    missing => {
                        let missing = grouped(missing);
                        let text = format!("{all} recorded, {missing} missing in the record");
                        (Tone::Caution, text)
                    }
                }
            },
        );
        section.note(tone, text);
        return section;
    };
    let aside = match summary.network.as_ref().and_then(|report| {
        let mut channels = report.channels.iter();
        channels.find(|each| each.channel == one.name)
    }) {
        Some(crossing) if crossing.from_host != crossing.to_host => format!(
            "{} → {to} · {link} · {} to {}",
            one.from, crossing.from_host, crossing.to_host
        ),
        _ => format!("{} → {to} · {link}", one.from),
    };
    let mut section = Section::new("channel", &one.name, aside);
    section.subject.clone_from(&one.name);
    let sources = Sources::of(one, summary);
    metrics(&mut section, &sources);
    if let Some(demand) = &one.demand {
        super::demand::demand(&mut section, demand);
    }
    if let Some(account) = &one.account {
        facts(&mut section, account);
    }
    if let Some(network) = sources.network {
        network_facts(&mut section, network);
    }
    let stamped = one.account.as_ref().map(|account| &account.coverage);
    radio::channel(&mut section, stamped, summary.radio.channel(&one.name));
    if let Some(emulation) = &one.emulation {
        self::emulation(&mut section, emulation);
    }
    if let Some(counts) = &one.trace_replay {
        section.fact("trace replay", Tone::Plain, replay_words(counts));
    }
    if let Some(account) = &one.account {
        section
            .blocks
            .extend(fate_table(account, sources.link).map(hil_present::Block::Table));
        if account.published_count > 0 {
            let mut table = segment_table(account);
            if is_taken_by_witness(summary, one) {
                table.note += " Taken: when the witness beside the program had the message; when the program \
                               read it is not recorded.";
            }
            section.table(table);
        }
        section
            .blocks
            .extend(stamp_table(account).map(hil_present::Block::Table));
    }
    let outages = one.outages.as_ref().and_then(outage_table);
    section
        .blocks
        .extend(outages.map(hil_present::Block::Table));
    section
}

/// Numbers with their intervals.
fn metrics(section: &mut Section, sources: &Sources<'_>) {
    let mut all = counts(sources);
    if sources.crosses {
        all.push(loss_ratio(sources.network));
        all.extend(order(sources));
    } else {
        let words = "the channel crossed no network: it has no loss, order or one-way delay of one";
        section.note(Tone::Faint, words);
    }
    all.extend(end_to_end(sources));
    if sources.crosses {
        all.extend(network(sources));
    }
    match sources.outages {
        Some(outages) => all.extend(outage_metrics(outages)),
        None if sources.crosses => {
            let reason = match sources.account {
                None => NO_ACCOUNT,
                Some(_) => "the fate of some messages is unknown",
            };
            all.push(Metric::unavailable("outage_count", "outages", "1", reason));
        }
        // What crosses no network has no outage of one.
        None => {}
    }
    for one in all {
        section.metric(one);
    }
}

/// What an account says that is no number.
fn facts(section: &mut Section, account: &ChannelAccount) {
    if account.published_count == 0 {
        section.note(Tone::Caution, "no message was published");
        return;
    }
    match &account.closing {
        Closing::Checked(closing) => {
            if let Some((tone, text)) = closing_words(closing) {
                section.fact("account", tone, text);
            }
        }
        Closing::Unavailable { reason } => {
            section.fact(
                "account",
                Tone::Faint,
                format!("whether the times add up is unavailable: {reason}"),
            );
        }
    }
    clocks::one_way(section, account);
    if !account.loss_bursts.is_empty() {
        let text = runs_words(account.loss_bursts.iter().copied());
        section.fact("lost in a row", Tone::Plain, text + " (RFC 3357)");
    }
    let gaps = &account.gaps;
    if let Some(longest) = gaps.longest {
        section.fact("silence", Tone::Plain, gap_words(account, longest));
    }
    if let Some(other) = gaps.longest_unattributed
        && Some(other) != gaps.longest
    {
        let text = format!("otherwise {}", gap_words(account, other));
        section.fact("", Tone::Plain, text);
    }
    if let Some(silence) = gaps.producer.filter(ProducerSilence::is_long) {
        section.fact("producer silent", Tone::Caution, silence_words(&silence));
    }
    for interruption in &account.interruptions {
        let text = format!(
            "{} down for {} ({}): {} lost",
            interruption.process,
            duration(interruption.length_ns),
            interruption.cause,
            counted(interruption.lost_count, "message")
        );
        section.fact("interruption", Tone::Caution, text);
    }
}

/// What the network's metrics rest on, and what has a shape rather than a number.
fn network_facts(section: &mut Section, network: &NetworkMetrics) {
    if let Some(delay) = network.delay.measured() {
        let (tone, text) = bound_words(delay);
        section.fact("clocks", tone, text);
    }
    if let Some(loss) = network.loss.measured().filter(|_| network.lost_count > 0) {
        section.fact("losses", Tone::Plain, loss_runs_words(loss));
    }
    let aside = [
        (network.host_lost_count, "lost by the hosts"),
        (network.unknown_count, "under way at the end or unknown"),
    ];
    let aside = aside.iter().filter(|(count, _)| *count > 0);
    let aside: Vec<String> = aside
        .map(|(count, what)| format!("{} {what}", grouped(*count)))
        .collect();
    if !aside.is_empty() {
        let text = format!("{}; in no metric of the network", aside.join(", "));
        section.fact("besides", Tone::Plain, text);
    }
}

fn bound_words(delay: &DelayMetrics) -> (Tone, String) {
    let count = grouped(delay.count);
    match (delay.alignment_bound_ns, delay.is_bound_wider) {
        (0, _) => (
            Tone::Plain,
            format!("{count} messages; one clock, no error of alignment"),
        ),
        (bound, false) => {
            let bound = unsigned_duration(bound);
            (
                Tone::Plain,
                format!("{count} messages, each within ±{bound} by the clocks' alignment"),
            )
        }
        (bound, true) => {
            let bound = unsigned_duration(bound);
            let text = format!(
                "one-way delay not resolved: the clocks' alignment allows ±{bound}, wider than the median"
            );
            (Tone::Caution, text)
        }
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
    let replaced = live(|one| {
        one.fates.of(MessageFate::SupersededAtInput)
            + one.fates.of(MessageFate::SupersededAtConsumer)
    });
    // What became of some only the other host knows: a count of the others would read as one of all.
    let unknown = live(|one| one.fates.of(MessageFate::UnknownPeerRecordsUnavailable));
    let unknown = unknown.filter(|count| *count > 0);
    let reason = unknown.map_or_else(
        || NO_ACCOUNT.to_owned(),
        |count| {
            format!(
                "of {} the other host's records, which are not at hand, would tell; known: {} delivered, {} lost",
                counted(count, "message"),
                grouped(delivered.unwrap_or(0)),
                grouped(live(|one| one.fates.lost_count()).unwrap_or(0))
            )
        },
    );
    let delivered = delivered.filter(|_| unknown.is_none());
    let lost = account.and_then(ChannelAccount::lost_known);
    let is_total_known = account.is_none_or(|one| one.published_unrecorded_count.is_some());
    let lost_reason = if unknown.is_none() && !is_total_known {
        PRODUCER_UNKNOWN
    } else {
        &reason
    };
    let published_method = if is_total_known {
        "every sequence number up to the highest seen"
    } else {
        PRODUCER_UNKNOWN
    };
    [
        figure("published", "published", published, NO_ACCOUNT).by(published_method),
        figure("delivered", "delivered", delivered, &reason).by("taken by the consumer"),
        figure("lost", "lost, by host or network", lost, lost_reason)
            .by("vanished; messages that a newer one replaced and those under way are not lost"),
        figure("replaced", "replaced by newer ones", replaced, NO_ACCOUNT)
            .by("before the sending gateway or the consumer took them"),
    ]
    .into_iter()
    .chain(account.into_iter().flat_map(restarts))
    .collect()
}

fn restarts(account: &ChannelAccount) -> Vec<Metric> {
    let count = account.producer_restart_count as f64;
    let mut all = vec![Metric::new(
        "producer_restarts",
        "producer restarts",
        "1",
        count,
    )];
    if let Some(count) = account
        .published_unrecorded_count
        .filter(|count| *count > 0)
    {
        let label = "published but not recorded by the producer";
        all.push(Metric::new("unrecorded", label, "1", count as f64));
    }
    all
}

fn loss_ratio(network: Option<&NetworkMetrics>) -> Metric {
    let unavailable =
        |reason: &str| Metric::unavailable("loss_ratio", "lost by the network", "share", reason);
    let Some(network) = network else {
        return unavailable(NO_NETWORK);
    };
    match &network.loss {
        Measured::Measured(loss) => {
            let metric = Metric::new("loss_ratio", "lost by the network", "share", loss.ratio);
            let mut method = format!(
                "{} of {}",
                grouped(network.lost_count),
                grouped(network.offered_count)
            );
            // Why there is none stands beside the value.
            if loss.interval.known().is_some() {
                method = format!("{method}; {}", loss.interval);
            }
            with_spread(metric, Some(loss.interval)).by(&method)
        }
        Measured::Unavailable { reason } => match network.loss_bounds() {
            Some(bounds) => unavailable(&format!(
                "{bounds}: of {} lost it is unknown whether on the wire or for want of room on the receiving host",
                grouped(bounds.doubtful_count)
            )),
            None => unavailable(reason),
        },
    }
}

/// With its interval, or why there is none.
pub(crate) fn with_spread(metric: Metric, spread: Option<Spread>) -> Metric {
    match spread {
        None => metric,
        Some(Spread::Known(one)) => metric.within(Some((one.low, one.high))),
        Some(Spread::Unknown(why)) => metric.without_interval(&why.to_string()),
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
    let network = sources.network;
    let duplicated = account.and_then(|one| one.duplicated_count);
    let reordered = network.and_then(|one| Some(one.order.measured()?.reordered_count));
    let reordered = reordered.or_else(|| account?.reordered_count);
    let mut figures = Vec::new();
    for (name, label, standard, found) in [
        ("late", "too late for the gateway", "", late),
        ("duplicated", "duplicated", "RFC 5560; ", duplicated),
        ("reordered", "reordered", "RFC 4737; ", reordered),
    ] {
        let figure = Metric::maybe(name, label, "1", found.map(|found| found as f64), reason);
        let shares = found.zip(arrived).and_then(|(found, arrived)| {
            let share = (arrived > 0).then(|| percent(found as f64 / arrived as f64))?;
            let of = grouped(arrived);
            Some(format!("{standard}{share} of {of} that arrived"))
        });
        figures.push(figure.by(&shares.unwrap_or_default()));
    }
    let by = sources.network.and_then(|one| one.order.measured());
    if let Some((p50, max)) = by.and_then(|one| one.extent_p50.zip(one.extent_max)) {
        for (name, label, places) in [
            ("reordered_by_p50", "reordered by, places, p50", p50),
            ("reordered_by_max", "reordered by, places, largest", max),
        ] {
            figures.push(Metric::new(name, label, "1", places as f64).by("RFC 4737, extent"));
        }
    }
    if let Some(n) = by.and_then(|one| one.n_max) {
        let label = "overtaken by at least n messages, largest n";
        figures
            .push(Metric::new("n_reordered_max", label, "1", n as f64).by("RFC 4737, section 5"));
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
/// What a model makes a message wait is no delay of a network.
const EMULATED: DelayKind = DelayKind {
    label: "emulated link, one way",
    ..ONE_WAY
};

impl DelayKind {
    fn figure(self, name: &str, label: &str, ns: i64, interval: Option<Spread>) -> Metric {
        let (name, label) = self.names(name, label);
        let method = interval
            .and_then(Spread::known)
            .map(|one| one.method.name());
        let interval = interval.map(|spread| spread.map(|ns| ns * 1e-9));
        with_spread(Metric::new(&name, &label, "s", ns_s(ns)), interval)
            .by(method.unwrap_or_default())
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
            if let Some(bound_ns) = whole.alignment_bound_ns().filter(|bound_ns| *bound_ns > 0) {
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
        let mut all = ONE_WAY.unavailable(NO_NETWORK);
        all.extend(round_trips(sources.account));
        return all;
    };
    let kind = if sources.link == Some(LinkKind::Emulated) {
        EMULATED
    } else {
        ONE_WAY
    };
    let mut all = match &network.delay {
        Measured::Unavailable { reason } => kind.unavailable(reason),
        Measured::Measured(delay) => one_way(delay, kind),
    };
    all.extend(successive(&network.successive));
    all.extend(round_trips(sources.account));
    let too_few = "fewer than two messages";
    for (name, label, unit, value) in [
        (
            "offered_rate",
            "messages handed over",
            "1/s",
            network.offered_per_s,
        ),
        (
            "arrived_rate",
            "of these, received",
            "1/s",
            network.arrived_per_s,
        ),
        (
            "arrived_bytes_rate",
            "payload received",
            "B/s",
            network.arrived_bytes_per_s,
        ),
    ] {
        all.push(Metric::maybe(name, label, unit, value, too_few));
    }
    all
}

/// How far the clocks may lead a metric astray; empty on one clock.
fn error_words(bound_ns: u64, is_wider: bool) -> String {
    let wide = if is_wider {
        ", wider than the median"
    } else {
        ""
    };
    match bound_ns {
        0 => String::new(),
        _ => format!(
            "; within ±{} by the clocks{wide}",
            unsigned_duration(bound_ns)
        ),
    }
}

fn one_way(delay: &DelayMetrics, kind: DelayKind) -> Vec<Metric> {
    let of = |name, label, one: DelayQuantile| kind.figure(name, label, one.value_ns, one.interval);
    let mut all = vec![
        kind.figure("min", "least", delay.min_ns, None),
        of("p50", "p50", delay.p50),
        of("p95", "p95", delay.p95),
        of("p99", "p99", delay.p99),
        of("p999", "p99.9", delay.p999),
        kind.figure("max", "largest", delay.max_ns, None),
    ];
    let variation = &delay.variation;
    let error = error_words(variation.bound_ns, variation.is_bound_wider);
    let method = format!("above the smallest delay of the run (RFC 5481, PDV){error}");
    for (name, label, ns) in [
        ("variation_p50", "delay variation, p50", variation.p50_ns),
        ("variation_p95", "delay variation, p95", variation.p95_ns),
        ("variation_p99", "delay variation, p99", variation.p99_ns),
        (
            "variation_p999",
            "delay variation, p99.9",
            variation.p999_ns,
        ),
        (
            "variation_max",
            "delay variation, largest",
            variation.max_ns,
        ),
    ] {
        all.push(Metric::new(name, label, "s", ns_s(ns)).by(&method));
    }
    all
}

/// How much each delay differs from the one before.
fn successive(found: &Measured<SuccessiveVariation>) -> Vec<Metric> {
    const NAMES: [(&str, &str); 5] = [
        ("successive_p50", "successive messages differ by, p50"),
        ("successive_p99", "successive messages differ by, p99"),
        ("successive_max", "successive messages differ by, largest"),
        ("jitter_mean", "jitter, mean"),
        ("jitter_max", "jitter, largest"),
    ];
    let one = match found {
        Measured::Measured(one) => one,
        Measured::Unavailable { reason } => {
            return NAMES
                .map(|(name, label)| Metric::unavailable(name, label, "s", reason))
                .to_vec();
        }
    };
    let jitter = one.jitter;
    let values_s = [
        ns_s(one.p50_ns),
        ns_s(one.p99_ns),
        ns_s(one.max_ns),
        jitter.mean_ns * 1e-9,
        jitter.max_ns * 1e-9,
    ];
    let wide = if jitter.bound_ns > jitter.mean_ns {
        ", wider than the mean"
    } else {
        ""
    };
    let error = match jitter.bound_ns {
        bound_ns if bound_ns > 0.0 => {
            format!(
                "; within ±{} by the clocks{wide}",
                duration_s(bound_ns * 1e-9)
            )
        }
        _ => String::new(),
    };
    let successive = format!(
        "of one after the other (RFC 5481, IPDV){}",
        error_words(one.bound_ns, one.is_bound_wider)
    );
    let jitter = format!("RFC 3550; needs no aligned clocks{error}");
    let all = NAMES.into_iter().zip(values_s).enumerate();
    all.map(|(index, ((name, label), value_s))| {
        let method = if index < 3 { &successive } else { &jitter };
        Metric::new(name, label, "s", value_s).by(method)
    })
    .collect()
}

fn round_trips(account: Option<&ChannelAccount>) -> Vec<Metric> {
    const NAMES: [(&str, &str); 4] = [
        ("round_trip_p50", "round trip of the gateways, p50"),
        ("round_trip_p99", "round trip of the gateways, p99"),
        ("round_trip_p999", "round trip of the gateways, p99.9"),
        ("round_trip_max", "round trip of the gateways, largest"),
    ];
    let Some(account) = account else {
        return Vec::new();
    };
    match &account.round_trip {
        Distribution::Unavailable { reason } => NAMES
            .map(|(name, label)| Metric::unavailable(name, label, "s", reason))
            .to_vec(),
        Distribution::Measured(one) => {
            let method = format!("{} clock exchanges", grouped(one.count));
            let values = [one.p50_ns, one.p99_ns, one.p999_ns, one.max_ns].map(ns_s);
            let all = NAMES.into_iter().zip(values);
            all.map(|((name, label), value)| Metric::new(name, label, "s", value).by(&method))
                .collect()
        }
    }
}

fn outage_metrics(outages: &OutageMetrics) -> Vec<Metric> {
    let longest = outages.longest.as_ref();
    let where_from = longest.copied().map_or_else(String::new, longest_words);
    let longest = longest.map(|one| ns_s(one.length_ns));
    vec![
        Metric::new("outage_count", "outages", "1", outages.outage_count as f64)
            .by("from the first lost publication to the next one that arrived"),
        Metric::new(
            "outage_lost",
            "lost in outages",
            "1",
            outages.lost_count as f64,
        ),
        Metric::new(
            "outage_total",
            "outages together",
            "s",
            ns_s(outages.total_ns),
        ),
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
    // Lengths beyond the longest outage have nothing to show.
    let known = outages.outage_count - outages.unknown_length_count.min(outages.outage_count);
    let last = outages
        .classes
        .iter()
        .rposition(|class| class.outage_count > 0);
    for class in outages.classes.iter().take(last.map_or(0, |last| last + 1)) {
        let counts = [class.outage_count, class.lost_count].map(Cell::Count);
        table.push(core::iter::once(length_words(class).into()).chain(counts));
        if let Some(row) = table.rows.last_mut() {
            let end = class.outage_count as f64 / known.max(1) as f64;
            row.bar = Some(Bar { start: 0.0, end });
        }
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

fn segment_row(name: &str, distribution: &Distribution, bound: Option<u64>) -> Row {
    let cells = match distribution {
        Distribution::Measured(one) => {
            let values = [one.p50_ns, one.p90_ns, one.p99_ns, one.p999_ns, one.max_ns];
            let bound = bound.filter(|ns| *ns > 0);
            let bound = bound.map(|ns| i64::try_from(ns).unwrap_or(i64::MAX));
            let values = values.map(Cell::Duration).into_iter();
            let name = core::iter::once(Cell::from(name));
            name.chain(values).chain([Cell::duration(bound)]).collect()
        }
        Distribution::Unavailable { reason } => {
            vec![name.into(), format!("{UNAVAILABLE}: {reason}").into()]
        }
    };
    Row {
        cells,
        ..Row::default()
    }
}

/// A row for each distribution: its quantiles, or why there are none.
pub fn quantile_table(rows: &[(&str, &Distribution)]) -> Table {
    let mut table = Table::new("", &["", "min", "p50", "p99", "p99.9", "max"]);
    for (name, distribution) in rows {
        let mut cells = vec![Cell::from(*name)];
        match distribution {
            Distribution::Unavailable { reason } => {
                cells.push(format!("{UNAVAILABLE}: {reason}").into());
            }
            Distribution::Measured(one) => cells.extend(
                [one.min_ns, one.p50_ns, one.p99_ns, one.p999_ns, one.max_ns].map(Cell::Duration),
            ),
        }
        table.push(cells);
    }
    table
}

/// True where the consumer is a program of the user's that keeps no records.
fn is_taken_by_witness(summary: &RunSummary, channel: &ChannelSummary) -> bool {
    let named = |name| summary.processes.iter().find(|one| one.name == name);
    let consumer = channel.to.as_deref().and_then(named);
    let consumer = consumer.filter(|one| one.kind == ProcessKind::OwnProgram);
    consumer.is_some_and(|consumer| {
        let mut others = summary.processes.iter();
        others.any(|one| one.kind == ProcessKind::Witness && one.host == consumer.host)
    })
}

/// The segments one after the other with their medians as bars, then the whole, then what a missing stamp
/// made one of.
fn segment_table(account: &ChannelAccount) -> Table {
    let mut table = Table::new("Where the time went", &SEGMENT_COLUMNS)
        .ranked("p90", 2)
        .ranked("off by at most", 1);
    let median = |segment: &SegmentMetrics| {
        let summary = segment.distribution.measured();
        summary.map_or(0.0, |summary| summary.p50_ns.max(0) as f64)
    };
    let chain = || {
        account
            .segments
            .iter()
            .filter(|segment| !segment.is_combined)
    };
    let scale: f64 = chain().map(median).sum();
    let mut start = 0.0;
    let mut rows: Vec<Row> = Vec::new();
    for segment in chain() {
        let end = start + median(segment);
        let bound = segment.bound.map(|bound| bound.largest_ns);
        let mut row = segment_row(&segment.name(), &segment.distribution, bound);
        if scale > 0.0 && row.cells.len() > 2 {
            let [start, end] = [start, end].map(|at| at / scale);
            row.bar = Some(Bar { start, end });
        }
        rows.push(row);
        start = end;
    }
    let whole = &account.end_to_end;
    let bound = whole.alignment_bound_ns();
    let mut row = segment_row("published → taken", &whole.distribution, bound);
    row.tone = Tone::Strong;
    rows.push(row);
    for segment in account
        .segments
        .iter()
        .filter(|segment| segment.is_combined)
    {
        let count = segment.distribution.measured().map_or(0, |one| one.count);
        let name = format!("{} ({} combined)", segment.name(), grouped(count));
        let bound = segment.bound.map(|bound| bound.largest_ns);
        rows.push(segment_row(&name, &segment.distribution, bound));
    }
    table.rows = rows;
    "Quantiles are from histograms with three digits, of messages that have both ends; bars are medians; \
     combined: of messages without a stamp between. \
     \"Off by at most\" is what the alignment of two hosts' clocks may add or take."
        .clone_into(&mut table.note);
    table
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
        let ratio = count as f64 / total as f64;
        let label = link.map_or(fate.label(), |link| link.fate_label(fate));
        let share = Cell::share(is_total_known.then_some(ratio));
        let tone = match fate {
            MessageFate::Taken => Tone::Good,
            MessageFate::Unexplained => Tone::Bad,
            fate if fate.is_loss() => Tone::Caution,
            _ => Tone::Plain,
        };
        table.rows.push(Row {
            cells: vec![label.into(), Cell::Count(count), share],
            tone,
            bar: Some(Bar {
                start: 0.0,
                end: ratio,
            }),
        });
    }
    if !is_total_known {
        "How many were published is unknown: the producer's records are not at hand."
            .clone_into(&mut table.note);
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
        let of = |part: fn(Coverage) -> u64| Cell::count(found.map(part));
        table.push([
            name.into(),
            of(|one| one.stamped_count),
            of(|one| one.eligible_count),
            Cell::share(found.and_then(|one| one.ratio())),
        ]);
    }
    Some(table)
}

/// How the delay that a link model asked for was kept.
fn emulation(section: &mut Section, emulation: &EmulationMetrics) {
    let [requested, achieved, error] = [
        emulation.requested,
        emulation.achieved,
        emulation.scheduling_error,
    ]
    .map(Distribution::Measured);
    let mut table = quantile_table(&[
        ("requested", &requested),
        ("achieved", &achieved),
        ("scheduling error", &error),
    ]);
    "Emulated link, delay".clone_into(&mut table.title);
    let (tone, judgement) = if emulation.is_kept() {
        (Tone::Good, "kept")
    } else {
        (Tone::Bad, "NOT kept")
    };
    let overflow = match emulation.overflow_count {
        Some(count) => format!("{} dropped for want of room", grouped(count)),
        None => "drops for want of room unavailable: the gateway left no counters".to_owned(),
    };
    let text = format!(
        "{} datagrams; {overflow}; {judgement}: the scheduling error's p99 may be {}",
        grouped(emulation.requested.count),
        duration(emulation.error_max_ns)
    );
    section.fact("emulated link", tone, text);
    section.table(table);
}

fn closing_words(figures: &ClosingMetrics) -> Option<(Tone, String)> {
    let ratio = figures.closed_ratio()?;
    let mut text = format!(
        "times add up: {} of {} messages, {}",
        grouped(figures.closed_count),
        grouped(figures.checked_count),
        percent(ratio),
    );
    if let Some(residual) = figures.residual.measured() {
        let words = format!(
            "; off by p50 {}, p99.9 {}, max {} (limit {})",
            duration(residual.p50_ns),
            duration(residual.p999_ns),
            duration(residual.max_ns),
            duration(figures.residual_limit_ns),
        );
        text.push_str(&words);
    }
    for (count, words) in [
        (figures.missing_stage_count, "not, for a missing stage"),
        (
            figures.negative_segment_count,
            "not, for a stage before its predecessor",
        ),
        (figures.residual_count, "not, as they are off by more"),
        (figures.closed_combined_count, "with a combined segment"),
        (
            figures.unaligned_count,
            "not checked, published about a clock step",
        ),
    ] {
        if count > 0 {
            text.push_str(&["; ", &grouped(count), " ", words].concat());
        }
    }
    if figures.is_converted {
        text.push_str("; of converted stamps: proves records and order, not the alignment");
    }
    let is_whole = figures.closed_count == figures.checked_count;
    Some((if is_whole { Tone::Good } else { Tone::Plain }, text))
}

/// How often so many messages were lost in a row, the longest first.
fn runs_words(runs: impl DoubleEndedIterator<Item = BurstCount> + ExactSizeIterator) -> String {
    let hidden = runs.len().saturating_sub(RUNS_SHOWN_COUNT);
    let shown = runs.rev().take(RUNS_SHOWN_COUNT).map(|run| {
        let times = match run.count {
            1 => "once".to_owned(),
            2 => "twice".to_owned(),
            count => format!("{} times", grouped(count)),
        };
        format!("{} {times}", grouped(run.length_messages))
    });
    let mut text = shown.collect::<Vec<_>>().join(", ");
    if hidden > 0 {
        let _infallible = write!(text, ", {hidden} shorter lengths");
    }
    text
}

fn gap_words(account: &ChannelAccount, gap: Gap) -> String {
    let cause = gap
        .interruption_index
        .and_then(|index| account.interruptions.get(index))
        .map_or_else(String::new, |interruption| {
            format!(", while {} was down", interruption.process)
        });
    format!(
        "longest {} at {} into the run, after message {}{cause}",
        duration(gap.length_ns),
        duration(gap.start_ns),
        grouped(gap.after_sequence)
    )
}

fn longest_words(longest: LongestOutage) -> String {
    let seconds_of = |ns: i64| seconds(ns as f64 * 1e-9);
    let end = longest.start_ns.saturating_add(longest.length_ns);
    let until = if longest.is_open {
        "the end of the run".to_owned()
    } else {
        seconds_of(end)
    };
    format!(
        "{} to {until}, {} lost from {} on",
        seconds_of(longest.start_ns),
        counted(longest.lost_count, "message"),
        grouped(longest.first_sequence),
    )
}

/// The lengths of a class: `100 ms to 500 ms`, below the first and above the last border.
fn length_words(class: &OutageClass) -> String {
    match class.until_ns {
        None => format!("{} and more", border(class.from_ns)),
        Some(until_ns) if class.from_ns == 0 => format!("below {}", border(until_ns)),
        Some(until_ns) => format!("{} to {}", border(class.from_ns), border(until_ns)),
    }
}

fn border(ns: i64) -> String {
    if ns < 1_000_000_000 {
        format!("{} ms", ns as f64 * 1e-6)
    } else {
        format!("{} s", ns as f64 * 1e-9)
    }
}

fn loss_runs_words(loss: &LossMetrics) -> String {
    let runs = loss.runs.iter().map(|run| BurstCount {
        length_messages: run.length_messages,
        count: run.count,
    });
    let mut text = runs_words(runs);
    if let Some(longest) = loss.longest {
        let start = seconds(longest.start_ns as f64 * 1e-9);
        let open = if longest.is_open { ", to the end" } else { "" };
        let length = duration(longest.length_ns);
        let _infallible = write!(text, "; longest {length} from {start}{open}");
    }
    if let Some(bursts) = loss.bursts {
        let _infallible = write!(
            text,
            "; {} bursts (RFC 3611) of {} messages, {} of them lost, gaps of {} with {} lost",
            grouped(bursts.count),
            figure(bursts.length_mean),
            percent(bursts.loss_ratio),
            figure(bursts.gap_length_mean.round()),
            percent(bursts.gap_loss_ratio)
        );
    }
    text
}

/// How often a stream stood still, and what counts as that.
pub(crate) fn stall_words(stalls: &StallMetrics) -> String {
    let threshold = unsigned_duration(stalls.threshold_ns);
    let rule = format!(
        "a byte unacknowledged for over {threshold}: twice the smallest round trip and 50 ms"
    );
    if stalls.count == 0 {
        return format!("none ({rule})");
    }
    format!(
        "{}, {} together, longest {} ({rule})",
        grouped(stalls.count),
        unsigned_duration(stalls.total_ns),
        unsigned_duration(stalls.longest_ns)
    )
}
