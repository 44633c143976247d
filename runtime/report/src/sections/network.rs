//! The network of a run: a table of all channels, and what preceded what. The metrics of each channel stand with
//! the channel.

use core::cmp::Ordering;
use core::fmt::Write;

use hil_account::network::{DelayMetrics, NetworkMetrics};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{duration_s, percent};
use hil_present::{Cell, Section, Table, Tone};

use hil_stats::correlation::SPELL_COUNT_MIN;

use crate::network::{Correlation, CorrelationTests, NetworkReport, TestedPair};
use crate::score_event::ScoreEvents;

/// Pairs of series that are listed one by one.
const PAIRS_SHOWN_COUNT: usize = 6;

/// A line a channel.
pub(super) fn network(report: &NetworkReport) -> Section {
    let aside =
        "from the hand-over to the kernel to the receiving gateway; loss of what was handed over";
    let mut section = Section::new("network", "Network", aside);
    let columns = [
        "channel",
        "p50",
        "p99",
        "p99.9",
        "max",
        "bound ±",
        "loss",
        "longest outage",
        "reordered",
    ];
    // A narrow terminal does without; they stand with the channel as well.
    let mut table = Table::new("", &columns)
        .ranked("p99.9", 2)
        .ranked("reordered", 1);
    for one in &report.channels {
        let name = Cell::Text(one.channel.clone());
        let cells = core::iter::once(name).chain(row(&one.figures));
        table.push(cells);
    }
    section.table(table);
    section
}

fn row(figures: &NetworkMetrics) -> [Cell; 8] {
    let delay = figures.delay.measured();
    let of_delay = |ns: fn(&DelayMetrics) -> i64| Cell::duration(delay.map(ns));
    let bound = |one: &DelayMetrics| i64::try_from(one.alignment_bound_ns).unwrap_or(i64::MAX);
    let loss = figures.loss.measured();
    let longest = loss.map(|loss| loss.longest.map_or(0, |longest| longest.length_ns));
    let order = figures.order.measured();
    [
        of_delay(|delay| delay.p50.value_ns),
        of_delay(|delay| delay.p99.value_ns),
        of_delay(|delay| delay.p999.value_ns),
        of_delay(|delay| delay.max_ns),
        of_delay(bound),
        Cell::share(loss.map(|loss| loss.ratio)),
        Cell::duration(longest),
        Cell::count(order.map(|order| order.reordered_count)),
    ]
}

/// How the robot's events stand to the network's.
pub(super) fn preceding(report: &NetworkReport, events: &ScoreEvents) -> Section {
    let mut section = Section::new(
        "preceding",
        "What preceded what",
        "correlation is not cause",
    );
    section.note(Tone::Plain, preceding_words(report, events));
    if report.clocks_differ {
        let text = "Clocks are not aligned: each host's times count from its own start of the run, \
                    and hosts start within a message of their supervisors of each other; lags are \
                    no better than that.";
        section.note(Tone::Caution, text);
    }
    match &report.correlation {
        Correlation::Unavailable { reason } => {
            section.note(Tone::Plain, format!("No test of correlation: {reason}."));
        }
        Correlation::Tested(tests) => {
            let noted = report.events.len() as u64 + report.events_dropped_count;
            correlations(&mut section, tests, noted);
        }
    }
    section
}

fn preceding_words(report: &NetworkReport, events: &ScoreEvents) -> String {
    let bound_s = report.clock_bound_s.filter(|bound_s| *bound_s > 0.0);
    let slack = bound_s.map_or_else(String::new, |bound_s| {
        format!(" (±{} by the clocks)", duration_s(bound_s))
    });
    let window = duration_s(report.foregoing_s) + &slack;
    let chance = percent(report.foregoing_chance_ratio);
    let noted = report.events.len() as u64 + report.events_dropped_count;
    let known: Vec<_> = events
        .events
        .iter()
        .filter_map(|event| event.network.as_ref())
        .collect();
    let preceded = known.iter().filter(|one| !one.events.is_empty()).count();
    if known.is_empty() {
        return format!(
            "The score has no event whose time is known; {} events of note on the network.",
            grouped(noted)
        );
    }
    let listed = match events.dropped_count {
        0 => "",
        _ => "listed ",
    };
    format!(
        "{} of {} {listed}events of the score have an event of the network in the {window} before them; of \
         all moments of the run {chance} have one. {} events of note on the network.",
        grouped(preceded as u64),
        grouped(known.len() as u64),
        grouped(noted)
    )
}

/// Events of note on the network below which a test that finds nothing says nothing.
const EVENTS_TESTED_MIN: u64 = 10;

fn correlations(section: &mut Section, tests: &CorrelationTests, noted: u64) {
    let found = tests.significant();
    for pair in found.iter().take(PAIRS_SHOWN_COUNT) {
        let words = pair.words(tests.pairs.len(), tests.shift_count);
        section.note(Tone::Caution, words);
    }
    let others = tests.pairs.len() - found.len();
    let mut text = if tests.pairs.is_empty() {
        "No pair of series to test: of each, one or both are the same all the time or nearly so."
            .to_owned()
    } else if found.is_empty() && (1..EVENTS_TESTED_MIN).contains(&noted) {
        let events = counted(noted, "event");
        format!(
            "{events} of note on the network: too few to test whether the robot's series follow them."
        )
    } else if found.is_empty() {
        let pairs = tests.pairs.iter();
        let best = pairs.min_by(|a, b| {
            let key =
                |pair: &TestedPair| (pair.correlation.p_family, -pair.correlation.coefficient);
            key(a).partial_cmp(&key(b)).unwrap_or(Ordering::Equal)
        });
        let best = best.map(|best| best.words(tests.pairs.len(), tests.shift_count));
        let best = best.unwrap_or_default();
        format!(
            "Over the whole run none of {others} pairs of series correlates beyond chance, which says nothing of \
             single events. The nearest to it: {best}."
        )
    } else {
        match found.len().saturating_sub(PAIRS_SHOWN_COUNT) {
            0 => format!("The other {others} pairs of series do not correlate beyond chance."),
            hidden => format!("{hidden} more pairs correlate beyond chance, {others} do not."),
        }
    };
    if !tests.constant.is_empty() {
        let count = tests.constant.len();
        let first = tests.constant.iter().take(3).cloned().collect::<Vec<_>>();
        let more = if count > 3 { ", …" } else { "" };
        let _infallible = write!(
            text,
            " The same all the time, so not tested: {}{more}.",
            first.join(", ")
        );
    }
    if !tests.seldom.is_empty() {
        let named = tests.seldom.iter().take(3).map(|one| {
            let times = counted(one.spell_count, "spell");
            format!("{times} of {}", one.series)
        });
        let named = named.collect::<Vec<_>>().join(", ");
        let more = if tests.seldom.len() > 3 { ", …" } else { "" };
        let _infallible = write!(
            text,
            " Too few to test: {named}{more} ({SPELL_COUNT_MIN} needed)."
        );
    }
    let _infallible = write!(
        text,
        " Bins of {}, lags from -{} to {}; {} shifts.",
        duration_s(tests.bin_s),
        duration_s(tests.lead_max_s),
        duration_s(tests.lag_max_s),
        grouped(tests.shift_count)
    );
    section.note(Tone::Faint, text);
}
