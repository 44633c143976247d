//! Whether a channel met the demand that the topology states, in the terms of 3GPP. Nothing is computed here.

use hil_account::network::Metric as Measured;
use hil_account::{DemandMetrics, DemandVerdict, DownTime, ServiceMetrics};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{availability, duration, ns_s};
use hil_present::{Field, Metric, Section, Tone};

use super::channel::with_spread;
use crate::summary::RunSummary;

/// The figures of the service of one channel, and whether they are what is asked for.
pub(super) fn demand(section: &mut Section, demand: &DemandMetrics) {
    let (tone, words) = verdict(demand);
    section.fact("demand", tone, words);
    let limits = format!(
        "in time within {}, survival time {}, a message every {}",
        duration(demand.latency_max_ns),
        duration(demand.survival_time_ns),
        duration(demand.interval_ns)
    );
    section.fact("", Tone::Plain, limits);
    let Measured::Measured(service) = &demand.service else {
        return;
    };
    for metric in metrics(service) {
        section.metric(metric);
    }
}

fn metrics(service: &ServiceMetrics) -> [Metric; 6] {
    let known_count = service.in_time_count + service.late_count + service.lost_count;
    let mut method = format!(
        "TS 22.261; {} of {}",
        grouped(service.in_time_count),
        grouped(known_count)
    );
    for (count, what) in [
        (service.late_count, "late"),
        (service.lost_count, "lost"),
        (service.lost_by_host_count, "of these by a host"),
        (service.unknown_count, "unknown"),
    ] {
        if count > 0 {
            method.push_str(&[", ", &grouped(count), " ", what].concat());
        }
    }
    let reliability = Metric::new("reliability", "in time", "share", service.reliability);
    let longest = service.longest.map(|one| ns_s(one.length_ns));
    let failures = Metric::new(
        "service_failures",
        "service failures",
        "1",
        service.failure_count as f64,
    );
    let down = Metric::new(
        "service_down",
        "service down, together",
        "s",
        ns_s(service.down_ns),
    );
    [
        with_spread(reliability, Some(service.reliability_interval)).by(&method),
        service_availability(service),
        failures.by("the survival time was exceeded"),
        down.by(&unknown_words(service)),
        Metric::maybe(
            "service_down_longest",
            "service down, longest",
            "s",
            longest,
            "there was no failure",
        )
        .by(&service.longest.map_or_else(String::new, where_words)),
        Metric::maybe(
            "service_between_failures",
            "mean time between failures",
            "s",
            service.time_between_failures_ns.map(ns_s),
            "there was no failure",
        )
        .by("up time over failures"),
    ]
}

/// Its digits are those that tell it from all the time.
fn service_availability(service: &ServiceMetrics) -> Metric {
    let ends = (service.availability_low, service.availability_high);
    let metric = Metric::new(
        "availability",
        "service availability",
        "share",
        service.availability,
    );
    let [low, high] = [ends.0, ends.1].map(availability);
    let method = format!(
        "TS 22.261; of {} asked for, {} without messages; independent failures, lengths as known (Fay and Feuer 1997)",
        duration(service.asked_ns),
        duration(service.idle_ns)
    );
    Metric {
        text: availability(service.availability),
        interval: format!("{low} to {high}"),
        ..metric.within(Some(ends)).by(&method)
    }
}

fn unknown_words(service: &ServiceMetrics) -> String {
    if service.down_ns_max == service.down_ns {
        return String::new();
    }
    let most = duration(service.down_ns_max);
    format!("{most} if all unknown messages were lost")
}

fn where_words(longest: DownTime) -> String {
    let open = if longest.is_open { ", to the end" } else { "" };
    format!("from {} into the run{open}", duration(longest.start_ns))
}

/// Whether a demand was met, with the figures that decide it.
fn verdict(demand: &DemandMetrics) -> (Tone, String) {
    let asked = format!("{} asked for", availability(demand.availability_min));
    let service = match &demand.service {
        Measured::Measured(service) => service,
        Measured::Unavailable { reason } => {
            return (Tone::Caution, format!("{}: {reason}", demand.verdict));
        }
    };
    let found = format!("available {}, {asked}", availability(service.availability));
    let failures = service.longest.map_or_else(String::new, |longest| {
        let count = counted(service.failure_count, "failure");
        format!("; {count}, longest {}", duration(longest.length_ns))
    });
    match demand.verdict {
        DemandVerdict::Met => (Tone::Good, format!("met: {found}{failures}")),
        DemandVerdict::Missed => (Tone::Bad, format!("MISSED: {found}{failures}")),
        DemandVerdict::SampleTooSmall if service.failure_count == 0 => {
            let shown = availability(service.availability_shown_max);
            let of = duration(service.asked_ns);
            let text =
                format!("not decided: no failure in {of}, which shows {shown} (95 %), {asked}");
            (Tone::Caution, text)
        }
        DemandVerdict::SampleTooSmall => {
            let [low, high] =
                [service.availability_low, service.availability_high].map(availability);
            let text = format!("not decided: {found}; 95 %: {low} to {high}{failures}");
            (Tone::Caution, text)
        }
        DemandVerdict::UnknownMessages | DemandVerdict::NotJudged => {
            let unknown = counted(service.unknown_count, "message");
            let text = format!("not decided: {found}; {unknown} of unknown fate decide{failures}");
            (Tone::Caution, text)
        }
    }
}

/// The demands that were missed or not decided, the first one in full; `None` where all were met, none is stated, or only
/// channels within a host have one.
pub(super) fn unmet(summary: &RunSummary) -> Option<Field> {
    let channels = summary.channels.iter().filter(|one| one.link.is_crossing());
    let stated = channels.filter_map(|one| Some((one.name.as_str(), one.demand.as_ref()?)));
    let mut unmet: Vec<_> = stated
        .filter(|(_, demand)| demand.verdict != DemandVerdict::Met)
        .collect();
    unmet.sort_by_key(|(_, demand)| demand.verdict != DemandVerdict::Missed);
    let (name, first) = unmet.first()?;
    let (tone, words) = verdict(first);
    let others = match unmet.len() as u64 - 1 {
        0 => String::new(),
        count => format!(" (and {} missed or not decided)", counted(count, "other")),
    };
    Some(Field::toned(
        "demand",
        tone,
        format!("{name} {words}{others}"),
    ))
}
