//! A link trace on a page: its figures, the laws fitted to it, and its plots. The figures are
//! computed elsewhere.

use core::fmt::Write as _;
use hil_account::network::{Metric as NetworkMetric, OrderMetrics};
use hil_core::interval::Spread;

use hil_account::BurstCount;
use hil_stats::histogram::Distribution;
use hil_trace::fit::{Fit, Ranking, TraceFit};
use hil_trace::metrics::{Memory, TraceMetrics};
use hil_trace::{Trace, TraceHeader};

use crate::burst_classes::burst_classes;
use hil_platform::text::grouped;
use hil_present::terminal::canvas::Style;
use hil_present::terminal::render;
use hil_present::units::{duration, percent, seconds};
use hil_present::{Bar, Cell, Row, Section, Table, Tone};

/// Rows of a distribution.
const PLOT_ROWS: usize = 20;

/// The figures of a trace.
pub(crate) fn render_trace(
    trace: &Trace,
    figures: &TraceMetrics,
    width_columns: usize,
    style: Style,
) -> String {
    let mut section = section_of(&trace.header);
    let mut field = |label: &str, text: &str| section.fact(label, Tone::Plain, text);
    let counts = &figures.counts;
    let span_s = trace.records.last().map_or(0, |record| record.published_ns) as f64 * 1e-9;
    field(
        "messages",
        &format!(
            "{} published within {}, {}",
            grouped(counts.message_count),
            seconds(span_s),
            rate_words(figures)
        ),
    );
    field("lost", &loss_words(figures));
    field(
        "loss periods",
        &runs_words(&figures.loss_bursts, "losses (RFC 3357)"),
    );
    field(
        "between them",
        &runs_words(&figures.delivery_runs, "deliveries"),
    );
    field(
        "memory of loss",
        &memory_words(figures.loss_memory.as_ref()),
    );
    field("longest outage", &outage_words(figures));
    field("delay", &delay_words(figures));
    for quantile in &figures.quantiles {
        #[expect(clippy::cast_possible_truncation, reason = "two of the delays")]
        let interval = match quantile.interval {
            None => String::new(),
            Some(Spread::Known(one)) => {
                let [low, high] = [one.low, one.high].map(|ns| duration(ns as i64));
                format!("  [{low}, {high}]")
            }
            Some(Spread::Unknown(why)) => format!("  [{why}]"),
        };
        let name = format!("p{}", quantile.quantile * 100.0);
        field(&name, &format!("{}{interval}", duration(quantile.value_ns)));
    }
    if figures.late_delay.measured().is_some() {
        field("came too late", &late_words(figures));
    }
    field(
        "memory of delay",
        &memory_words(figures.delay_memory.as_ref()),
    );
    for (name, standard, found) in [
        ("PDV", "above the smallest delay", &figures.delay_variation),
        (
            "IPDV",
            "of successive messages",
            &figures.successive_variation,
        ),
    ] {
        field(name, &variation_words(standard, found));
    }
    field("order", &order_words(&figures.order));
    let duplicated = grouped(counts.duplicated_count);
    field("copies", &format!("{duplicated} duplicated (RFC 5560)"));
    section.note(
        Tone::Faint,
        "Intervals are 95 %, on the effective sample (docs/intervals.md) of the messages of known fate; memory is the autocorrelation \
         over messages.",
    );
    render(&[section], width_columns, style)
}

fn section_of(header: &TraceHeader) -> Section {
    let of = |name: &str, otherwise: &str| {
        if name.is_empty() {
            otherwise.to_owned()
        } else {
            name.to_owned()
        }
    };
    let changed = match header.link_change_count {
        0 => String::new(),
        1 => " (changed by hand once)".to_owned(),
        count => format!(" (changed by hand {count} times)"),
    };
    let aside = format!(
        "link {}{changed}, {}, run {}; {}",
        of(&header.link, "unknown"),
        header.direction.word(),
        of(&header.run, "unknown"),
        of(&header.clock, "clocks unknown")
    );
    Section::new("trace", of(&header.channel, "a trace"), aside)
}

fn outage_words(figures: &TraceMetrics) -> String {
    let Some(outage) = figures.longest_outage else {
        return "none".to_owned();
    };
    let end = if outage.is_open { ", to the end" } else { "" };
    format!(
        "{} from {} on, {} messages{end}",
        duration(outage.length_ns),
        seconds(outage.from_ns as f64 * 1e-9),
        grouped(outage.lost_count)
    )
}

fn rate_words(figures: &TraceMetrics) -> String {
    match (figures.rate_hz, figures.rate_bytes_per_s) {
        (Some(rate), Some(bytes)) => format!("{rate:.2} per second, {bytes:.0} bytes per second"),
        _ => "rate unavailable: fewer than two instants".to_owned(),
    }
}

fn loss_words(figures: &TraceMetrics) -> String {
    let counts = &figures.counts;
    let Some((ratio, interval)) = figures.loss_ratio.zip(figures.loss_ratio_interval) else {
        return "unavailable: no message has a known fate".to_owned();
    };
    let interval = match interval {
        Spread::Known(one) => format!("{}, {}", percent(one.low), percent(one.high)),
        Spread::Unknown(why) => why.to_string(),
    };
    let mut text = format!(
        "{} of {}, {} [{interval}]: {} in the network, {} before the link, {} after it",
        grouped(counts.lost_count()),
        grouped(counts.message_count - counts.unknown_count),
        percent(ratio),
        grouped(counts.lost_in_network_count),
        grouped(counts.lost_before_link_count),
        grouped(counts.lost_after_link_count)
    );
    if counts.unknown_count > 0 {
        let unknown = grouped(counts.unknown_count);
        let _infallible = write!(text, "; the fate of {unknown} is unknown");
    }
    text
}

fn runs_words(runs: &[BurstCount], of: &str) -> String {
    let count: u64 = runs.iter().map(|run| run.count).sum();
    let messages: u64 = runs.iter().map(|run| run.count * run.length_messages).sum();
    let Some(longest) = runs.last() else {
        return "none".to_owned();
    };
    format!(
        "{} rows of {of}, {:.2} messages on average, {} in the longest",
        grouped(count),
        messages as f64 / count as f64,
        grouped(longest.length_messages)
    )
}

fn memory_words(memory: Option<&Memory>) -> String {
    let Some(memory) = memory else {
        return "unavailable: nothing varies, or too few messages".to_owned();
    };
    let shown = [1, 2, 5, 10, 20, 50, 100];
    let at = |lag: &usize| {
        let value = memory.coefficients.get(lag - 1)?;
        Some(format!("{value:.2} at {lag}"))
    };
    let shown: Vec<String> = shown.iter().filter_map(at).collect();
    format!(
        "{}; within {:.2} if independent",
        shown.join(", "),
        memory.independent_within
    )
}

fn delay_words(figures: &TraceMetrics) -> String {
    match &figures.delay {
        Distribution::Unavailable { reason } => format!("unavailable: {reason}"),
        Distribution::Measured(delay) => {
            let bound = match figures.bound_max_ns {
                None => "bound unknown".to_owned(),
                Some(0) => "on one clock".to_owned(),
                Some(bound) => {
                    let bound = i64::try_from(bound).unwrap_or(i64::MAX);
                    let wide = if bound > delay.p50_ns {
                        ", wider than the median itself"
                    } else {
                        ""
                    };
                    format!("each within {}{wide}", duration(bound))
                }
            };
            format!(
                "{} to {} over {} messages, {bound}",
                duration(delay.min_ns),
                duration(delay.max_ns),
                grouped(delay.count)
            )
        }
    }
}

fn variation_words(of: &str, found: &Distribution) -> String {
    match found {
        Distribution::Unavailable { reason } => format!("unavailable: {reason}"),
        Distribution::Measured(one) => format!(
            "p50 {}, p99 {}, at most {}; {of} (RFC 5481)",
            duration(one.p50_ns),
            duration(one.p99_ns),
            duration(one.max_ns)
        ),
    }
}

fn order_words(order: &NetworkMetric<OrderMetrics>) -> String {
    match order {
        NetworkMetric::Unavailable { reason } => format!("reordered unknown: {reason}"),
        NetworkMetric::Measured(order) => {
            let by = order.extent_max.zip(order.n_max);
            let by = by.map_or_else(String::new, |(extent, n)| {
                format!(", extent at most {extent}, {n}-reordered at most")
            });
            format!(
                "{} of {} reordered{by} (RFC 4737)",
                grouped(order.reordered_count),
                grouped(order.count)
            )
        }
    }
}

/// Of messages that arrived and were not published.
fn late_words(figures: &TraceMetrics) -> String {
    match &figures.late_delay {
        Distribution::Unavailable { reason } => format!("unavailable: {reason}"),
        Distribution::Measured(late) => format!(
            "{} arrived and were not published: {} to {}, median {}; in no figure of delays above",
            grouped(late.count),
            duration(late.min_ns),
            duration(late.max_ns),
            duration(late.p50_ns)
        ),
    }
}

/// The laws fitted to a trace.
pub(crate) fn render_fit(
    header: &TraceHeader,
    fit: &TraceFit,
    width_columns: usize,
    style: Style,
) -> String {
    let mut section = section_of(header);
    let messages = grouped(fit.loss_message_count as u64);
    let tested = grouped(fit.tested_delay_count as u64);
    section.children = vec![
        ranking(&format!("Loss, {messages} messages"), &fit.loss),
        ranking(
            &format!("Delay, distance tested on {tested} messages"),
            &fit.delay,
        ),
    ];
    let mut method = Section::new("method", "Method", "");
    for remark in &fit.remarks {
        method.note(Tone::Caution, remark);
    }
    method.note(
        Tone::Faint,
        format!(
            "AIC = 2 k - 2 ln L, smaller is better. Bursts: chi-square of their lengths. KS: largest \
             difference of the distribution functions, its probability by a parametric bootstrap of \
             199 samples, seed {}. A probability below 0.05 speaks against the law.",
            fit.seed
        ),
    );
    render(&[section, method], width_columns, style) + "\n"
}

fn ranking(title: &str, ranking: &Ranking) -> Section {
    let mut section = Section::new("ranking", title, "");
    if !ranking.fits.is_empty() {
        let mut table = Table::new("", &["law", "k", "AIC", "bursts p", "KS (p)"]);
        for (index, fit) in ranking.fits.iter().enumerate() {
            let is_best = ranking.best == Some(index);
            table.rows.push(Row {
                cells: fit_cells(fit),
                tone: if is_best { Tone::Good } else { Tone::Plain },
                bar: None,
            });
        }
        section.table(table);
        for fit in &ranking.fits {
            let text = format!("{}; {}", fit.parameters, fit.method);
            section.fact(&fit.law, Tone::Faint, text);
        }
    }
    section.note(Tone::Plain, format!("Taken: {}.", ranking.why));
    section
}

fn fit_cells(fit: &Fit) -> Vec<Cell> {
    let or_none = |text: Option<String>| text.map_or(Cell::Missing, Cell::Text);
    let bursts = fit.bursts.as_ref();
    let distance = fit.ks_distance.zip(fit.ks_probability);
    vec![
        fit.law.clone().into(),
        Cell::Count(fit.parameter_count as u64),
        or_none(fit.aic.map(|aic| format!("{aic:.1}"))),
        or_none(bursts.map(|test| format!("{:.3}", test.probability))),
        or_none(distance.map(|(distance, p)| format!("{distance:.4} ({p:.3})"))),
    ]
}

/// Delay distribution, burst lengths and memory as bars.
pub(crate) fn render_trace_plots(
    trace: &Trace,
    figures: &TraceMetrics,
    width_columns: usize,
    style: Style,
) -> String {
    let mut section = section_of(&trace.header);
    let mut delays = trace.delays_ns();
    delays.sort_unstable();
    let mut within = Table::new("", &["delay", "share"]);
    let row_count = if delays.is_empty() { 0 } else { PLOT_ROWS };
    for row in 0..row_count {
        // From the smallest delay to the 99.9th percentile, in equal steps.
        let last = delays[((delays.len() - 1) * 999).div_ceil(1000)];
        let step = i64::try_from(row + 1).unwrap_or(1);
        let rows = i64::try_from(PLOT_ROWS).unwrap_or(1);
        let upto = delays[0] + (last - delays[0]) / rows * step + i64::from(step == rows) * rows;
        let share = delays.partition_point(|delay| *delay <= upto) as f64 / delays.len() as f64;
        push_bar(&mut within, Cell::Duration(upto), Cell::Share(share), share);
    }
    let title = "Share of the messages delivered within";
    section
        .children
        .push(plot(title, &delay_words(figures), within));
    let mut lost = Table::new("", &["in a row", "times"]);
    let total: u64 = figures.loss_bursts.iter().map(|run| run.count).sum();
    for (name, count) in burst_classes(&figures.loss_bursts) {
        let share = count as f64 / total.max(1) as f64;
        push_bar(&mut lost, name.into(), Cell::Count(count), share);
    }
    section
        .children
        .push(plot("Losses in a row", "nothing was lost", lost));
    for (title, memory) in [
        ("Autocorrelation of loss", &figures.loss_memory),
        ("Autocorrelation of delay", &figures.delay_memory),
    ] {
        let mut table = Table::new("", &["lag, messages", "coefficient"]);
        let coefficients = memory.iter().flat_map(|memory| &memory.coefficients);
        for (index, value) in coefficients.enumerate().take(PLOT_ROWS) {
            let lag = Cell::Count(index as u64 + 1);
            push_bar(&mut table, lag, format!("{value:.3}").into(), *value);
        }
        section
            .children
            .push(plot(title, &memory_words(None), table));
    }
    render(&[section], width_columns, style)
}

/// `table` below its title, or why there is none.
fn plot(title: &str, otherwise: &str, table: Table) -> Section {
    let mut section = Section::new("plot", title, "");
    if table.rows.is_empty() {
        section.note(Tone::Faint, otherwise);
    } else {
        section.table(table);
    }
    section
}

fn push_bar(table: &mut Table, name: Cell, value: Cell, end: f64) {
    table.rows.push(Row {
        cells: vec![name, value],
        tone: Tone::Plain,
        bar: Some(Bar { start: 0.0, end }),
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_trace::{TraceFate, TraceRecord};

    fn sample() -> Trace {
        let record = |index: u64| {
            let published_ns = i64::try_from(index).unwrap() * 10_000_000;
            let mut record = TraceRecord::published(published_ns, index, 16);
            if index % 10 < 2 {
                record.fate = TraceFate::LostInNetwork;
            } else {
                let delay_ns = 2_000_000 + i64::try_from(index % 7).unwrap() * 100_000;
                record = record.delivered(delay_ns, 40);
            }
            record
        };
        Trace {
            header: TraceHeader::new("shuttle/command"),
            records: (0..400).map(record).collect(),
        }
    }

    #[test]
    fn a_page_says_what_was_measured_and_never_grows_too_wide() {
        let trace = sample();
        let figures = TraceMetrics::of(&trace);
        let fit = TraceFit::of(&trace, 1);
        let pages = [
            render_trace(&trace, &figures, 90, Style::Plain),
            render_fit(&trace.header, &fit, 90, Style::Plain),
            render_trace_plots(&trace, &figures, 90, Style::Plain),
        ];
        for page in &pages {
            for line in page.lines() {
                assert!(line.chars().count() <= 90, "{line}");
            }
        }
        assert!(pages[0].contains("80 of 400, 20.00 %"), "{}", pages[0]);
        assert!(pages[0].contains("each within 40 ns"), "{}", pages[0]);
        for words in [
            "0 of 320 reordered (RFC 4737)",
            "(RFC 3357)",
            "at most 600 µs",
        ] {
            assert!(pages[0].contains(words), "{words}: {}", pages[0]);
        }
        assert!(pages[1].contains("gilbert-elliott"), "{}", pages[1]);
        // Two of ten are lost, one after the other.
        let is_pairs = |line: &str| line.split_whitespace().take(2).eq(["2", "40"]);
        assert!(pages[2].lines().any(is_pairs), "{}", pages[2]);
        let mut short = sample();
        short.records.truncate(6);
        let figures = TraceMetrics::of(&short);
        let page = render_trace_plots(&short, &figures, 90, Style::Plain);
        // The whole range, in as many rows, up to all of them.
        assert!(page.contains("100.00 %"), "{page}");
    }
}
