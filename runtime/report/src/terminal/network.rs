//! The network of a run: a table of all channels, then the figures of each with their intervals;
//! and what preceded what. Figures are not computed here.

use core::cmp::Ordering;
use core::fmt::Write;

use hil_account::network::{
    DelayMetrics, DelayQuantile, InterarrivalJitter, LossMetrics, Metric, NetworkMetrics,
    SuccessiveVariation,
};

use super::canvas::{Canvas, INDENT, Tone, left, right};
use super::units::{JOINT, duration, duration_s, figure, percent, seconds, unsigned_duration};
use crate::network::{ChannelNetwork, Correlation, CorrelationTests, NetworkReport, TestedPair};
use crate::score_event::ScoreEvents;
use hil_platform::text::grouped;

/// Columns of the table behind the channel's name.
const HEADS: [&str; 8] = [
    "p50", "p99", "p99.9", "max", "bound", "loss", "longest", "reord.",
];
const COLUMN_WIDTH: usize = 9;
/// The column a narrow page does without; it is in the channel's own lines.
const SPARE: usize = 2;
/// From here on a page has room for all of them.
const WIDE: usize = 100;

/// Margin and label of a channel's lines.
const LINE_MARGIN: usize = INDENT + 2;
const LABEL_WIDTH: usize = 12;

/// Pairs that the page shows.
const PAIRS_SHOWN_COUNT: usize = 6;
/// Lengths of runs of losses that the page shows.
const RUNS_SHOWN_COUNT: usize = 6;

pub(super) fn network(canvas: &mut Canvas, report: &NetworkReport) {
    canvas.heading(
        "Network",
        "from the hand-over to the kernel to the receiving gateway",
    );
    let is_wide = canvas.width() >= WIDE;
    let columns = HEADS.len() - usize::from(!is_wide);
    let name_width = canvas.width() - INDENT - columns * COLUMN_WIDTH;
    let cells = |all: &[String; 8]| -> String {
        let shown = all.iter().enumerate();
        let shown = shown.filter(|(index, _)| is_wide || *index != SPARE);
        shown.map(|(_, cell)| right(cell, COLUMN_WIDTH)).collect()
    };
    let head = cells(&HEADS.map(str::to_owned));
    let line = format!("{:INDENT$}{}{head}", "", left("", name_width));
    canvas.painted_line(Tone::Faint, &line);
    for one in &report.channels {
        let cells = cells(&row(&one.figures));
        let name = left(&one.channel, name_width);
        canvas.line(&format!("{:INDENT$}{name}{cells}", ""));
    }
    for one in &report.channels {
        channel(canvas, one);
    }
}

fn row(figures: &NetworkMetrics) -> [String; 8] {
    const NONE: &str = "–";
    let delay = figures.delay.measured();
    let of_delay = |ns: fn(&DelayMetrics) -> i64| {
        delay.map_or_else(|| NONE.to_owned(), |delay| duration(ns(delay)))
    };
    let loss = figures.loss.measured();
    let longest = loss.map(|loss| loss.longest.map_or(0, |longest| longest.length_ns));
    let order = figures.order.measured();
    [
        of_delay(|delay| delay.p50.value_ns),
        of_delay(|delay| delay.p99.value_ns),
        of_delay(|delay| delay.p999.value_ns),
        of_delay(|delay| delay.max_ns),
        delay.map_or_else(
            || NONE.to_owned(),
            |delay| format!("±{}", unsigned_duration(delay.alignment_bound_ns)),
        ),
        loss.map_or_else(|| NONE.to_owned(), |loss| percent(loss.ratio)),
        longest.map_or_else(|| NONE.to_owned(), duration),
        order.map_or_else(|| NONE.to_owned(), |order| grouped(order.reordered_count)),
    ]
}

fn channel(canvas: &mut Canvas, one: &ChannelNetwork) {
    let figures = &one.figures;
    let way = format!("{} from {} to {}", one.channel, one.from_host, one.to_host);
    canvas.paragraph(INDENT, Tone::Strong, &way);
    let mut line = |label: &str, text: &str| {
        canvas.field_at(LINE_MARGIN, LABEL_WIDTH, label, Tone::Plain, text);
    };
    match &figures.delay {
        Metric::Measured(delay) => {
            line("delay", &delay_words(delay));
            line("", &bound_words(delay, figures));
            line("variation", &variation_words(delay));
        }
        Metric::Unavailable { reason } => {
            let text = format!("unavailable: {reason}; {}", round_trip_words(figures));
            line("delay", &text);
        }
    }
    match &figures.successive {
        Metric::Measured(successive) => line("successive", &successive_words(successive)),
        Metric::Unavailable { reason } => line("successive", &format!("unavailable: {reason}")),
    }
    match &figures.loss {
        Metric::Measured(loss) => {
            line("loss", &loss_words(loss));
            if loss.lost_count > 0 {
                line("in a row", &runs_words(loss));
            }
        }
        Metric::Unavailable { reason } => line("loss", &format!("unavailable: {reason}")),
    }
    line("order", &order_words(figures));
    line("rate", &rate_words(figures));
    let aside = [
        (figures.host_lost_count, "lost by the hosts"),
        (figures.unknown_count, "under way at the end or unknown"),
    ];
    let aside: Vec<String> = aside
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, what)| format!("{} {what}", grouped(*count)))
        .collect();
    if !aside.is_empty() {
        let text = format!("{}; in no figure above", aside.join(", "));
        line("besides", &text);
    }
}

fn quantile(label: &str, one: &DelayQuantile) -> String {
    let value = format!("{label}{JOINT}{}", duration(one.value_ns));
    match one.interval {
        Some(interval) => {
            let [low, high] = [interval.low_ns, interval.high_ns].map(duration);
            format!("{value}{JOINT}[{low}, {high}]")
        }
        None => value,
    }
}

fn delay_words(delay: &DelayMetrics) -> String {
    let min = format!("min{JOINT}{}", duration(delay.min_ns));
    let max = format!("max{JOINT}{}", duration(delay.max_ns));
    [
        min,
        quantile("p50", &delay.p50),
        quantile("p95", &delay.p95),
        quantile("p99", &delay.p99),
        quantile("p99.9", &delay.p999),
        max,
    ]
    .join(" · ")
}

fn bound_words(delay: &DelayMetrics, figures: &NetworkMetrics) -> String {
    let bound = delay.alignment_bound_ns;
    match (bound, delay.is_bound_wider) {
        (0, _) => format!(
            "{} messages; one clock, no error of alignment",
            grouped(delay.count)
        ),
        (_, false) => format!(
            "{} messages, each within ±{} by the clocks' alignment",
            grouped(delay.count),
            unsigned_duration(bound)
        ),
        (_, true) => format!(
            "the clocks' alignment allows ±{}, wider than the median: these figures say little; {}",
            unsigned_duration(bound),
            round_trip_words(figures)
        ),
    }
}

fn round_trip_words(figures: &NetworkMetrics) -> String {
    figures.round_trip.measured().map_or_else(
        || "no round trip was measured".to_owned(),
        |round_trip| {
            format!(
                "round trip p50 {}, p99 {}, max {} over {} exchanges",
                duration(round_trip.p50_ns),
                duration(round_trip.p99_ns),
                duration(round_trip.max_ns),
                grouped(round_trip.count)
            )
        },
    )
}

fn variation_words(delay: &DelayMetrics) -> String {
    let variation = &delay.variation;
    let [p50, p95, p99, p999, max] = [
        variation.p50_ns,
        variation.p95_ns,
        variation.p99_ns,
        variation.p999_ns,
        variation.max_ns,
    ]
    .map(duration);
    let bound = error_words(variation.bound_ns, variation.is_bound_wider);
    format!(
        "above the smallest delay: p50 {p50} · p95 {p95} · p99 {p99} · p99.9 {p999} · max {max}{bound}"
    )
}

/// How far the clocks may lead a figure astray; nothing on one clock.
fn error_words(bound_ns: u64, is_wider: bool) -> String {
    let wide = if is_wider {
        ", wider than the median"
    } else {
        ""
    };
    match bound_ns {
        0 => String::new(),
        _ => format!(
            "; each within ±{} by the clocks{wide}",
            unsigned_duration(bound_ns)
        ),
    }
}

fn successive_words(successive: &SuccessiveVariation) -> String {
    format!(
        "messages differ by p50 {} · p99 {} · max {}{}; jitter mean {}, max {}{}",
        duration(successive.p50_ns),
        duration(successive.p99_ns),
        duration(successive.max_ns),
        error_words(successive.bound_ns, successive.is_bound_wider),
        duration_s(successive.jitter.mean_ns * 1e-9),
        duration_s(successive.jitter.max_ns * 1e-9),
        jitter_bound_words(successive.jitter),
    )
}

fn jitter_bound_words(jitter: InterarrivalJitter) -> String {
    if jitter.bound_ns <= 0.0 {
        return String::new();
    }
    let wide = if jitter.bound_ns > jitter.mean_ns {
        ", wider than the mean"
    } else {
        ""
    };
    format!(" ±{}{wide}", duration_s(jitter.bound_ns * 1e-9))
}

fn loss_words(loss: &LossMetrics) -> String {
    let bounds = |interval: hil_stats::statistics::Interval| {
        format!("[{}, {}]", percent(interval.low), percent(interval.high))
    };
    let (count, of) = (grouped(loss.lost_count), grouped(loss.of_count));
    if loss.lost_count == 0 {
        let high = percent(loss.interval.high);
        return format!("none of {of}; below {high} if losses were independent");
    }
    format!(
        "{count} of {of}: {} {}; bursts leave as much as {} independent messages would tell (if all \
         were: {})",
        percent(loss.ratio),
        bounds(loss.interval),
        figure(loss.effective_count.round()),
        bounds(loss.independent_interval),
    )
}

fn runs_words(loss: &LossMetrics) -> String {
    let times = |count: u64| match count {
        1 => "once".to_owned(),
        2 => "twice".to_owned(),
        count => format!("{} times", grouped(count)),
    };
    let shown: Vec<String> = loss
        .runs
        .iter()
        .rev()
        .take(RUNS_SHOWN_COUNT)
        .map(|run| format!("{} {}", grouped(run.length_messages), times(run.count)))
        .collect();
    let mut text = shown.join(", ");
    let hidden = loss.runs.len().saturating_sub(RUNS_SHOWN_COUNT);
    if hidden > 0 {
        let _infallible = write!(text, ", {hidden} shorter lengths");
    }
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

fn order_words(figures: &NetworkMetrics) -> String {
    let copies = figures.duplicated_count.map_or_else(
        || "copies unavailable".to_owned(),
        |count| format!("{} copies", grouped(count)),
    );
    match &figures.order {
        Metric::Unavailable { reason } => format!("unavailable: {reason}; {copies}"),
        Metric::Measured(order) => {
            let Some((p50, max)) = order.extent_p50.zip(order.extent_max) else {
                return format!("none of {} reordered; {copies}", grouped(order.count));
            };
            format!(
                "{} of {} reordered ({}), by {} places at the median, by up to {}; {copies}",
                grouped(order.reordered_count),
                grouped(order.count),
                percent(order.ratio),
                grouped(p50),
                grouped(max),
            )
        }
    }
}

fn rate_words(figures: &NetworkMetrics) -> String {
    let rate = |per_s: Option<f64>, unit: &str, what: &str| {
        per_s.map_or_else(
            || format!("{what} unavailable: fewer than two messages"),
            |per_s| format!("{}{unit} {what}", figure(per_s)),
        )
    };
    let bytes = figures.arrived_bytes_per_s.map_or_else(
        || "payload unavailable".to_owned(),
        |bytes| format!("{} B/s of payload", figure(bytes)),
    );
    format!(
        "{}, {}, {bytes}",
        rate(figures.offered_per_s, " messages/s", "handed over"),
        rate(figures.arrived_per_s, "", "received")
    )
}

/// How the robot's troubles stand to the network's.
pub(super) fn what_preceded_what(
    canvas: &mut Canvas,
    report: &NetworkReport,
    events: &ScoreEvents,
) {
    canvas.heading("What preceded what", "correlation is not cause");
    canvas.paragraph(INDENT, Tone::Plain, &preceding_words(report, events));
    if report.clocks_differ {
        let text = "Clocks are not aligned: each host's times count from its own start of the run, \
                    and hosts start within a message of their supervisors of each other; lags are \
                    no better than that.";
        canvas.paragraph(INDENT, Tone::Caution, text);
    }
    match &report.correlation {
        Correlation::Unavailable { reason } => {
            let text = format!("No test of correlation: {reason}.");
            canvas.paragraph(INDENT, Tone::Plain, &text);
        }
        Correlation::Tested(tests) => correlations(canvas, tests),
    }
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
    format!(
        "{} of {} events of the score have an event of the network in the {window} before them; of \
         all moments of the run {chance} have one. {} events of note on the network.",
        grouped(preceded as u64),
        grouped(known.len() as u64),
        grouped(noted)
    )
}

fn correlations(canvas: &mut Canvas, tests: &CorrelationTests) {
    let found = tests.significant();
    for pair in found.iter().take(PAIRS_SHOWN_COUNT) {
        let words = pair.words(tests.pairs.len(), tests.shuffle_count);
        canvas.paragraph(INDENT, Tone::Caution, &words);
    }
    let others = tests.pairs.len() - found.len();
    let mut text = if tests.pairs.is_empty() {
        "No pair of series to test: of each, one or both are the same all the time.".to_owned()
    } else if found.is_empty() {
        let pairs = tests.pairs.iter();
        let best = pairs.min_by(|a, b| {
            let key =
                |pair: &TestedPair| (pair.correlation.p_family, -pair.correlation.coefficient);
            key(a).partial_cmp(&key(b)).unwrap_or(Ordering::Equal)
        });
        let best = best.map(|best| best.words(tests.pairs.len(), tests.shuffle_count));
        let best = best.unwrap_or_default();
        format!(
            "None of {others} pairs of series correlates beyond chance. The nearest to it: {best}."
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
    let _infallible = write!(
        text,
        " Bins of {}, lags from -{} to {}; {} block shuffles, seed {}.",
        duration_s(tests.bin_s),
        duration_s(tests.lead_max_s),
        duration_s(tests.lag_max_s),
        grouped(tests.shuffle_count),
        tests.seed
    );
    canvas.paragraph(INDENT, Tone::Faint, &text);
}
