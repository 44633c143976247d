//! How the hosts' clocks relate, and what that means for figures that cross from one host to the
//! other. It computes no alignment.

use hil_account::ChannelAccount;
use hil_clock::{ClockMetrics, StampKind};
use hil_stats::bounds::BoundMetrics;
use hil_stats::histogram::Distribution;

use hil_present::units::{duration, duration_s, unsigned_duration};
use hil_present::{Section, Tone};

use crate::clock_summary::{ClockPathSummary, ClockRung, ClockSection, HostPairClock};
use hil_platform::text::grouped;

/// Every pair of hosts with a link, and who steers each host's system clock.
pub(super) fn clocks(section: &ClockSection) -> Section {
    let aside = "what one-way figures between hosts rest on";
    let mut clocks = Section::new("clocks", "Clocks", aside);
    if section.pairs.is_empty() {
        return clocks;
    }
    if section.has_one_clock {
        let text = "All hosts read one clock: stamps compare as they are, bound 0.";
        clocks.note(Tone::Good, text);
    }
    clocks.children.extend(section.pairs.iter().map(pair));
    if section.has_one_clock {
        return clocks;
    }
    for (host, discipline) in &section.hosts {
        let kernel = if discipline.is_kernel_synchronised {
            "the kernel calls it synchronised"
        } else {
            "the kernel calls it unsynchronised"
        };
        let bound = discipline.bound_ns.map_or_else(String::new, |bound_ns| {
            [", within ±", &unsigned_duration(bound_ns)].concat()
        });
        let text = format!("{}{bound}; {kernel}", discipline.basis);
        clocks.fact(format!("system clock, {host}"), Tone::Faint, text);
    }
    clocks
}

fn pair(pair: &HostPairClock) -> Section {
    let tone = match (pair.rung, &pair.contradiction) {
        (ClockRung::None, _) | (_, Some(_)) => Tone::Caution,
        _ => Tone::Good,
    };
    let mut section = Section::new("pair", format!("{} → {}", pair.from, pair.to), "");
    let mut line = |label: &str, tone: Tone, text: &str| section.fact(label, tone, text);
    let rung = format!("{}: {}", pair.rung_words(), pair.basis);
    line("aligned by", tone, &rung);
    if let Some(why) = &pair.contradiction {
        line("invalid", Tone::Bad, why);
    }
    if let Some(offset) = pair.disciplined {
        let text = format!(
            "offset {}, within ±{}",
            precise(offset.offset_ns),
            unsigned_duration(offset.bound_ns)
        );
        line("system clocks", Tone::Plain, &text);
    }
    if let Some(path) = &pair.clock_path {
        for (label, tone, text) in path_words(path) {
            line(label, tone, &text);
        }
    }
    if let Some(figures) = &pair.exchanges {
        for (label, text) in exchange_words(figures, pair.clock_path.as_ref()) {
            line(label, Tone::Plain, &text);
        }
    }
    section
}

/// The clock path, and what each of the two paths bounds by itself.
fn path_words(path: &ClockPathSummary) -> Vec<(&'static str, Tone, String)> {
    let alone = |figures: &Option<ClockMetrics>| {
        let bound = figures.as_ref().and_then(|figures| figures.bound);
        bound.map_or_else(|| "no bound".to_owned(), bound_words)
    };
    let tone = if path.has_exchanges() {
        Tone::Plain
    } else {
        Tone::Caution
    };
    let mut text = format!("{}; {}", path.describe(), path.state);
    if let Some(gap_ns) = path.longest_gap_ns {
        let gap = unsigned_duration(gap_ns);
        text.push_str(&["; longest time of the run without an exchange ", &gap].concat());
    }
    let bounds = format!(
        "clock path {}; data path {}",
        alone(&path.exchanges),
        alone(&path.data_path)
    );
    vec![
        ("path", tone, text),
        ("bound by each alone", Tone::Plain, bounds),
    ]
}

fn exchange_words(
    figures: &ClockMetrics,
    path: Option<&ClockPathSummary>,
) -> Vec<(&'static str, String)> {
    let mut lines = Vec::new();
    let of = |figures: &Option<ClockMetrics>| {
        let count = figures.as_ref().map_or(0, |figures| figures.exchange_count);
        grouped(count)
    };
    let mut text = path.map_or_else(
        || format!("{} over the data path", grouped(figures.exchange_count)),
        |path| {
            let (clock, data) = (of(&path.exchanges), of(&path.data_path));
            format!("{clock} over the clock path, {data} over the data path")
        },
    );
    if figures.unused_count > 0 {
        text.push_str(&[", ", &grouped(figures.unused_count), " not used"].concat());
    }
    let stamps = figures
        .stamp_counts
        .iter()
        .map(|(kind, count): (&StampKind, &u64)| format!("{} {}", grouped(*count), kind.label()));
    let stamps: Vec<String> = stamps.collect();
    text.push_str(&["; stamps: ", &stamps.join(", ")].concat());
    if let Some(rtt_ns) = figures.rtt_min_ns {
        text.push_str(&["; smallest round trip ", &duration(rtt_ns)].concat());
    }
    lines.push(("exchanges", text));
    if let Some(offset) = figures.offset {
        let below = duration(offset.lowest_ns.saturating_sub(offset.estimate_ns));
        let above = duration(offset.highest_ns.saturating_sub(offset.estimate_ns));
        let mut text = format!(
            "{} if the fastest exchanges took equally long both ways; guaranteed {below} to \
             +{above} about it, whatever the path",
            precise(offset.estimate_ns)
        );
        if let Some(spread_ns) = figures.spread_ns {
            let spread = duration_s(spread_ns * 1e-9);
            text.push_str(&["; spread of the estimate ", &spread].concat());
        }
        lines.push(("offset in mid-run", text));
    }
    if let Some((skew, error)) = figures.skew_ppm.zip(figures.skew_error_ppm) {
        let allowed = f64::from(figures.drift_ppb) * 1e-3;
        lines.push((
            "skew",
            format!("{skew:+.3} ± {error:.3} ppm (guaranteed bounds allow ±{allowed:.0} ppm)"),
        ));
    }
    if let Some(bound) = figures.bound {
        lines.push(("bound of an instant", bound_words(bound)));
    }
    for step in &figures.steps {
        let size = step.size_ns.map_or_else(
            || "of unknown size".to_owned(),
            |size_ns| format!("of about {}", duration(size_ns)),
        );
        let blind_ns = step.until_ns.saturating_sub(step.from_ns);
        let text = format!(
            "a step {size}; instants within {} about it have no alignment",
            duration(blind_ns)
        );
        lines.push(("noticed", text));
    }
    lines
}

fn bound_words(bound: BoundMetrics) -> String {
    format!(
        "median ±{}, largest ±{}",
        unsigned_duration(bound.median_ns),
        unsigned_duration(bound.largest_ns)
    )
}

/// The bounds of a channel's one-way figures; where one is wider than its figure, that the delay is not
/// resolved.
pub(super) fn one_way(section: &mut Section, account: &ChannelAccount) {
    let segments = account
        .segments
        .iter()
        .map(|segment| (segment.name(), &segment.distribution, segment.bound));
    let end_to_end = &account.end_to_end;
    let whole = (
        "published → taken".to_owned(),
        &end_to_end.distribution,
        end_to_end.bound,
    );
    let mut is_wider = false;
    for (name, distribution, bound) in segments.chain([whole]) {
        let Some(bound) = bound.filter(|bound| bound.largest_ns > 0) else {
            continue;
        };
        let text = format!("{name}: {}", bound_words(bound));
        section.fact("one-way bound", Tone::Faint, text);
        is_wider |= distribution
            .measured()
            .is_some_and(|summary| bound.median_ns > summary.p50_ns.unsigned_abs());
    }
    if !is_wider {
        return;
    }
    let text = match &account.round_trip {
        Distribution::Measured(round_trip) => format!(
            "one-way delay not resolved: a bound is wider than its figure. The round trip, which is \
             both ways together, is p50 {}, p99 {}",
            duration(round_trip.p50_ns),
            duration(round_trip.p99_ns)
        ),
        Distribution::Unavailable { reason } => {
            format!(
                "one-way delay not resolved: a bound is wider than its figure, and the round trip is \
                 unavailable: {reason}"
            )
        }
    };
    section.fact("", Tone::Caution, text);
}

/// An offset to the nanosecond: seconds of another boot, and still more than its bound shows.
fn precise(offset_ns: i64) -> String {
    format!("{:+.9} s", offset_ns as f64 * 1e-9)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock_summary::ClockPathEnd;
    use hil_clock::{ClockMap, ClockSettings, Exchange, Requester};
    use hil_core::record::RoundTripRecord;
    use hil_present::terminal::canvas::Style;
    use hil_present::terminal::render;

    fn metrics() -> ClockMetrics {
        let exchange = |index: i64| {
            let sent_ns = index * 100_000_000;
            let record = RoundTripRecord {
                sequence: index.unsigned_abs(),
                t1_ns: sent_ns,
                t2_ns: sent_ns + 12_000 - 4_000_000_000,
                t3_ns: sent_ns + 14_000 - 4_000_000_000,
                t4_ns: sent_ns + 26_000,
                session: 1,
                sources: [1; 4],
            };
            Exchange::of(&record, Requester::Local)
        };
        let exchanges: Vec<Exchange> = (0..100).filter_map(exchange).collect();
        ClockMap::new(&exchanges, ClockSettings::default())
            .metrics()
            .clone()
    }

    #[test]
    fn the_section_names_rung_estimate_interval_and_stamps() {
        let section = ClockSection {
            has_one_clock: false,
            hosts: std::collections::BTreeMap::new(),
            pairs: vec![HostPairClock {
                from: "control-pc".to_owned(),
                to: "robot-pc".to_owned(),
                rung: ClockRung::Exchanges,
                basis: "system clocks give no bound: nobody steers them".to_owned(),
                exchanges: Some(metrics()),
                disciplined: None,
                contradiction: Some("the rungs disagree".to_owned()),
                clock_path: Some(ClockPathSummary {
                    name: "clock/control-pc-robot-pc".to_owned(),
                    ends: [("control-pc", "10.78.0.1"), ("robot-pc", "10.78.0.2")].map(
                        |(host, address)| ClockPathEnd {
                            host: host.to_owned(),
                            address: address.to_owned(),
                            interface: Some("eth1".to_owned()),
                        },
                    ),
                    state: "established".to_owned(),
                    exchanges: Some(metrics()),
                    data_path: None,
                    longest_gap_ns: Some(31_000_000),
                }),
            }],
        };
        let text = render(&[clocks(&section)], 120, Style::Plain);
        for words in [
            "control-pc → robot-pc",
            "+4.000000000 s",
            "guaranteed",
            "400 kernel",
            "skew",
            "the rungs disagree",
            "exchanges over the clock path, and beside the data:",
            "clock path 10.78.0.1 (eth1) <-> 10.78.0.2 (eth1); established; longest time of the",
            "100 over the clock path, 0 over the data path",
            "data path no bound",
        ] {
            assert!(text.contains(words), "{words:?} is missing:\n{text}");
        }
    }
}
