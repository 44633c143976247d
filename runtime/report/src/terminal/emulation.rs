//! How an emulated link was kept, as lines of a report. What follows from it is decided in
//! `assessment`.

use hil_core::link_model::ReplayCounts;
use hil_stats::histogram::LatencySummary;

use super::canvas::{Canvas, Tone};
use super::units::duration;
use crate::emulation::EmulationMetrics;
use crate::trace_counts::replay_words;
use hil_platform::text::grouped;

/// Columns of a label.
const LABEL_WIDTH: usize = 18;

/// The section of one channel.
pub(super) fn emulation(canvas: &mut Canvas, figures: &EmulationMetrics) {
    let line = |summary: &LatencySummary| {
        format!(
            "p50 {} · p99 {} · p99.9 {} · max {}",
            duration(summary.p50_ns),
            duration(summary.p99_ns),
            duration(summary.p999_ns),
            duration(summary.max_ns)
        )
    };
    canvas.field_of(
        LABEL_WIDTH,
        "requested delay",
        Tone::Plain,
        &format!(
            "{} of {} datagrams, as the link model asked for",
            line(&figures.requested),
            grouped(figures.requested.count)
        ),
    );
    canvas.field_of(
        LABEL_WIDTH,
        "achieved delay",
        Tone::Plain,
        &line(&figures.achieved),
    );
    let (tone, judgement) = if figures.is_kept() {
        (Tone::Good, "kept")
    } else {
        (Tone::Bad, "NOT kept")
    };
    let overflow = match figures.overflow_count {
        Some(count) => format!("{} dropped for want of room", grouped(count)),
        None => "drops for want of room unavailable: the gateway left no counters".to_owned(),
    };
    let text = format!(
        "{}; {overflow}; {judgement}: p99 may be {}",
        line(&figures.scheduling_error),
        duration(figures.error_max_ns)
    );
    canvas.field_of(LABEL_WIDTH, "scheduling error", tone, &text);
}

/// What a channel met of the trace that its link replays.
pub(super) fn replay(canvas: &mut Canvas, counts: &ReplayCounts) {
    let text = replay_words(counts);
    canvas.field_of(LABEL_WIDTH, "trace replay", Tone::Plain, &text);
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;
    use hil_core::record::IngressRecord;

    use super::*;
    use crate::terminal::Style;

    #[test]
    fn the_section_separates_what_was_asked_from_what_was_given() {
        let record = IngressRecord {
            emulated_ns: 1_000_000,
            due_ns: 51_000_000,
            received_ns: 51_020_000,
            ..IngressRecord::zeroed()
        };
        let page = |overflow_count| {
            let figures = EmulationMetrics::of([record; 10], overflow_count).unwrap();
            let mut canvas = Canvas::new(120, Style::Plain);
            emulation(&mut canvas, &figures);
            let text = canvas.finish().replace('\u{a0}', " ");
            text.split_whitespace().collect::<Vec<_>>().join(" ")
        };
        let kept = page(Some(0));
        for part in [
            "requested delay",
            "p50 50.0 ms",
            "of 10 datagrams",
            "achieved delay",
            "scheduling error",
            "p99 20.0 µs",
            "0 dropped for want of room; kept: p99 may be 1.00 ms",
        ] {
            assert!(kept.contains(part), "{part} is not in\n{kept}");
        }
        assert!(page(Some(2)).contains("NOT kept"));
        assert!(page(None).contains("unavailable"));
    }
}
