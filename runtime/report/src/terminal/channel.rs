//! One channel of a report: fates, the way of a message as a waterfall, closing, stamps and
//! silences.

use core::ops::Range;

use hil_account::{
    BurstCount, ChannelAccount, Closing, ClosingMetrics, Coverage, Gap, MessageFate, SegmentMetrics,
};
use hil_stats::histogram::{Distribution, LatencySummary};
use hil_stats::statistics::IntervalNs;

use super::canvas::{Canvas, INDENT, Tone, bar, left, right};
use super::clocks;
use super::units::{duration, percent, unsigned_duration};
use crate::summary::{ChannelSummary, LinkKind, RecordedMetrics};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_rundir::pipe::StallMetrics;

/// Columns of a stage's name, of each of the four figures, and between figures and bar.
const NAME_WIDTH: usize = 22;
const FIGURE_WIDTH: usize = 9;
const BAR_GAP: usize = 2;

pub(super) fn channel(canvas: &mut Canvas, channel: &ChannelSummary) {
    let link = channel.link.label();
    let title = format!("Channel {}", channel.name);
    let Some(to) = &channel.to else {
        canvas.heading(&title, &format!("{} · {link}", channel.from));
        recorded(canvas, channel.recorded);
        return;
    };
    canvas.heading(&title, &format!("{} → {to} · {link}", channel.from));
    let Some(account) = &channel.account else {
        canvas.paragraph(
            INDENT,
            Tone::Faint,
            "unavailable: no records of this channel",
        );
        return;
    };
    fates(canvas, account, channel.link);
    if account.published_count > 0 {
        waterfall(canvas, account);
        closing(canvas, &account.closing);
        stamps(canvas, account);
        round_trip(canvas, &account.round_trip);
        losses(canvas, account);
    }
    if let Some(figures) = &channel.emulation {
        super::emulation::emulation(canvas, figures);
    }
    if let Some(counts) = &channel.trace_replay {
        super::emulation::replay(canvas, counts);
    }
    if let Some(figures) = &channel.outages {
        super::outages::outages(canvas, figures);
    }
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

fn recorded(canvas: &mut Canvas, figures: Option<RecordedMetrics>) {
    let Some(figures) = figures else {
        canvas.paragraph(
            INDENT,
            Tone::Faint,
            "unavailable: no record of this channel",
        );
        return;
    };
    let mut text = format!("{} recorded", counted(figures.message_count, "message"));
    let mut tone = Tone::Plain;
    if figures.missing_count > 0 {
        let count = grouped(figures.missing_count);
        text.push_str(&[", ", &count, " missing in the record"].concat());
        tone = Tone::Caution;
    }
    canvas.paragraph(INDENT, tone, &text);
}

fn fates(canvas: &mut Canvas, account: &ChannelAccount, kind: LinkKind) {
    let total = account.published_count;
    if total == 0 {
        canvas.paragraph(INDENT, Tone::Caution, "no message was published");
        return;
    }
    // Without the producer's records, messages after the last one seen are not counted.
    let is_total_known = account.published_unrecorded_count.is_some();
    let title = if is_total_known {
        format!(
            "{} published, and what became of {}",
            counted(total, "message"),
            if total == 1 { "it" } else { "them" }
        )
    } else {
        format!(
            "{} messages known here; how many were published is not: the producer's records are \
             not at hand",
            grouped(total)
        )
    };
    canvas.paragraph(INDENT, Tone::Faint, &title);
    let bar_width = canvas.width() - INDENT - 38 - 12 - 10 - BAR_GAP;
    for (fate, count) in account.fates.iter() {
        let ratio = count as f64 / total as f64;
        let tone = match fate {
            MessageFate::Taken => Tone::Good,
            MessageFate::Unexplained => Tone::Bad,
            fate if fate.is_loss() => Tone::Caution,
            _ => Tone::Plain,
        };
        let line = format!(
            "{:INDENT$}{}{}{}{:BAR_GAP$}{}",
            "",
            canvas.paint(tone, &left(kind.fate_label(fate), 38)),
            right(&grouped(count), 12),
            right(
                &if is_total_known {
                    percent(ratio)
                } else {
                    String::new()
                },
                10
            ),
            "",
            canvas.paint(Tone::Bar, &bar(0.0, ratio, bar_width))
        );
        canvas.line(&line);
    }
}

fn waterfall(canvas: &mut Canvas, account: &ChannelAccount) {
    canvas.blank();
    let header = format!(
        "{:INDENT$}{}{:>9}{:>9}{:>9}{:>9}",
        "",
        left("from published", NAME_WIDTH),
        "p50",
        "p99",
        "p99.9",
        "max"
    );
    canvas.painted_line(Tone::Faint, &header);
    let (chain, combined): (Vec<_>, Vec<_>) = account
        .segments
        .iter()
        .partition(|segment| !segment.is_combined);
    let median = |segment: &&SegmentMetrics| {
        let summary = segment.distribution.measured();
        summary.map_or(0.0, |summary| summary.p50_ns.max(0) as f64)
    };
    let scale: f64 = chain.iter().map(median).sum();
    let mut start = 0.0;
    for segment in &chain {
        let end = start + median(segment);
        let name = format!("→ {}", segment.to);
        let bar = start / scale..end / scale;
        row(canvas, Tone::Plain, &name, &segment.distribution, bar);
        start = end;
    }
    if let Some(hardware) = &account.hardware_wire
        && hardware.measured().is_some()
    {
        row(canvas, Tone::Plain, "card to card", hardware, 0.0..0.0);
    }
    let whole = &account.end_to_end.distribution;
    row(canvas, Tone::Strong, "published → taken", whole, 0.0..0.0);
    intervals(canvas, account);
    clocks::one_way(canvas, account);
    for segment in combined {
        let count = segment
            .distribution
            .measured()
            .map_or(0, |summary| summary.count);
        let name = format!(
            "{} ({} messages without a stamp between)",
            segment.name(),
            grouped(count)
        );
        canvas.paragraph(INDENT, Tone::Faint, &name);
        row(
            canvas,
            Tone::Plain,
            "  combined",
            &segment.distribution,
            0.0..0.0,
        );
    }
}

/// One line of the waterfall; `shares` are where its bar begins and ends.
fn row(canvas: &mut Canvas, tone: Tone, name: &str, figures: &Distribution, shares: Range<f64>) {
    let name = canvas.paint(tone, &left(name, NAME_WIDTH));
    let line = match figures {
        Distribution::Measured(summary) => {
            let bar_width = canvas.width() - INDENT - NAME_WIDTH - 4 * FIGURE_WIDTH - BAR_GAP;
            let figures = canvas.paint(tone, &quantiles(summary));
            let bar = canvas.paint(Tone::Bar, &bar(shares.start, shares.end, bar_width));
            format!("{:INDENT$}{name}{figures}{:BAR_GAP$}{bar}", "", "")
        }
        Distribution::Unavailable { reason } => {
            let room = canvas.width() - INDENT - NAME_WIDTH - 1;
            let text = left(&format!("unavailable: {reason}"), room);
            format!("{:INDENT$}{name} {}", "", canvas.paint(Tone::Faint, &text))
        }
    };
    canvas.line(&line);
}

fn quantiles(summary: &LatencySummary) -> String {
    [
        summary.p50_ns,
        summary.p99_ns,
        summary.p999_ns,
        summary.max_ns,
    ]
    .map(|ns| right(&duration(ns), FIGURE_WIDTH))
    .concat()
}

fn intervals(canvas: &mut Canvas, account: &ChannelAccount) {
    let end_to_end = &account.end_to_end;
    let interval = |name: &str, interval: Option<IntervalNs>| {
        let interval = interval?;
        let (low, high) = (duration(interval.low_ns), duration(interval.high_ns));
        Some(format!("{name} {low} to {high}"))
    };
    let mut words: Vec<String> = [
        interval("p50", end_to_end.p50_interval),
        interval("p99", end_to_end.p99_interval),
    ]
    .into_iter()
    .flatten()
    .collect();
    if let Some(bound_ns) = end_to_end
        .alignment_bound_ns
        .filter(|bound_ns| *bound_ns > 0)
    {
        let bound = unsigned_duration(bound_ns);
        words.push(format!("clock alignment within ±{bound}"));
    }
    if !words.is_empty() {
        canvas.field("95 %", Tone::Faint, &words.join(" · "));
    }
}

fn closing(canvas: &mut Canvas, closing: &Closing) {
    match closing {
        Closing::Checked(figures) => {
            if let Some((tone, text)) = closing_words(figures) {
                canvas.field("account", tone, &text);
            }
        }
        Closing::Unavailable { reason } => {
            canvas.field(
                "account",
                Tone::Faint,
                &format!("closing unavailable: {reason}"),
            );
        }
    }
}

/// Whether the account closes, in words; nothing when no message was checked.
pub(crate) fn closing_text(closing: &Closing) -> Option<String> {
    match closing {
        Closing::Checked(figures) => {
            closing_words(figures).map(|(_, text)| format!("account {text}"))
        }
        Closing::Unavailable { reason } => Some(format!("closing unavailable: {reason}")),
    }
}

fn closing_words(figures: &ClosingMetrics) -> Option<(Tone, String)> {
    let (ratio, interval) = figures.closed_ratio()?;
    let mut text = format!(
        "closes for {} of {} messages: {} [{}, {}]",
        grouped(figures.closed_count),
        grouped(figures.checked_count),
        percent(ratio),
        percent(interval.low),
        percent(interval.high),
    );
    if let Some(residual) = figures.residual.measured() {
        let words = format!(
            "; residual p50 {}, p99.9 {}, max {} (limit {})",
            duration(residual.p50_ns),
            duration(residual.p999_ns),
            duration(residual.max_ns),
            duration(figures.residual_limit_ns),
        );
        text.push_str(&words);
    }
    for (count, words) in [
        (
            figures.missing_stage_count,
            "not closed for a missing stage",
        ),
        (
            figures.negative_segment_count,
            "for a stage before its predecessor",
        ),
        (figures.residual_count, "for the residual"),
        (
            figures.closed_combined_count,
            "closed with a combined segment",
        ),
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

fn stamps(canvas: &mut Canvas, account: &ChannelAccount) {
    let coverage = &account.coverage;
    let kinds = [
        ("TX", coverage.tx_software),
        ("RX", coverage.rx_software),
        ("hardware TX", coverage.tx_hardware),
        ("hardware RX", coverage.rx_hardware),
    ];
    if kinds.iter().all(|(_, coverage)| coverage.is_none()) {
        return;
    }
    let words = kinds.map(|(kind, coverage)| {
        let ratio = coverage.as_ref().and_then(Coverage::ratio);
        let share = match ratio {
            Some(ratio) if ratio > 0.0 => percent(ratio),
            Some(_) => "none".to_owned(),
            None => "unavailable".to_owned(),
        };
        format!("{kind} {share}")
    });
    canvas.field("kernel stamps", Tone::Plain, &words.join(" · "));
    if let Some(Distribution::Unavailable { reason }) = &account.hardware_wire {
        canvas.field(
            "card to card",
            Tone::Faint,
            &format!("unavailable: {reason}"),
        );
    }
}

fn round_trip(canvas: &mut Canvas, round_trip: &Distribution) {
    if let Some(summary) = round_trip.measured() {
        let text = format!(
            "p50 {}, p99 {}, p99.9 {}, max {} over {} clock exchanges",
            duration(summary.p50_ns),
            duration(summary.p99_ns),
            duration(summary.p999_ns),
            duration(summary.max_ns),
            grouped(summary.count)
        );
        canvas.field("round trip", Tone::Plain, &text);
    }
}

fn losses(canvas: &mut Canvas, account: &ChannelAccount) {
    let counts = [
        ("reordered", account.reordered_count),
        ("duplicated", account.duplicated_count),
        ("late", account.late_count),
        ("producer restarts", Some(account.producer_restart_count)),
        (
            "unrecorded by the producer",
            account.published_unrecorded_count.filter(|c| *c > 0),
        ),
    ];
    let words: Vec<String> = counts
        .into_iter()
        .filter_map(|(name, count)| Some(format!("{name} {}", grouped(count?))))
        .collect();
    canvas.field("counted", Tone::Plain, &words.join(" · "));
    if let Some(text) = burst_words(account) {
        canvas.field("lost in a row", Tone::Plain, &text);
    }
    let gaps = &account.gaps;
    if let Some(longest) = gaps.longest {
        canvas.field("silence", Tone::Plain, &gap_words(account, longest));
    }
    if let Some(other) = gaps.longest_unattributed
        && Some(other) != gaps.longest
    {
        let text = format!("otherwise {}", gap_words(account, other));
        canvas.field("", Tone::Plain, &text);
    }
    for interruption in &account.interruptions {
        let text = format!(
            "{} down for {} ({}): {} lost",
            interruption.process,
            duration(interruption.length_ns),
            interruption.cause,
            counted(interruption.lost_count, "message")
        );
        canvas.field("interruption", Tone::Caution, &text);
    }
}

/// Lengths of loss runs with how often each occurred; of many, the shortest and the longest.
fn burst_words(account: &ChannelAccount) -> Option<String> {
    const SHOWN_COUNT: usize = 8;
    let bursts = &account.loss_bursts;
    let longest = bursts.last()?;
    let word = |burst: &BurstCount| {
        let times = match burst.count {
            1 => "once".to_owned(),
            count => format!("{} times", grouped(count)),
        };
        format!("{} {times}", grouped(burst.length_messages))
    };
    let shown = bursts.iter().take(SHOWN_COUNT).map(word);
    let mut text = shown.collect::<Vec<_>>().join(", ");
    if bursts.len() > SHOWN_COUNT {
        text.push_str(" … ");
        text.push_str(&word(longest));
    }
    Some(text)
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
