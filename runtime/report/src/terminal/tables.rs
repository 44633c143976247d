//! The parts of a report that are not about one channel: score, processes, events, host.

use super::canvas::{Canvas, INDENT, Tone, left, right};
use super::units::{duration_s, figure, seconds};
use crate::alike::joined_labels;
use crate::summary::{
    ProcessSummary, RealtimeFacts, RunEvent, RunEventKind, ScoreMetric, host_words,
};
use hil_platform::host_facts::HostFacts;
use hil_platform::text::{columns, grouped};
use hil_platform::words::counted;
use hil_rundir::event::EventKind;

/// Shorter preparations concern nobody.
const PREPARATION_S_MIN: f64 = 0.01;

/// Columns of margins, value and interval beside a label of the score.
const FIGURES_WIDTH: usize = 46;

pub(super) fn score(canvas: &mut Canvas, metrics: &[ScoreMetric]) {
    canvas.heading("Score", "what the robot did");
    if metrics.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, "unavailable: the case gave no score");
        return;
    }
    let widest = metrics.iter().map(|metric| columns(&metric.label)).max();
    let label_width = widest
        .unwrap_or(0)
        .clamp(20, canvas.width() - FIGURES_WIDTH);
    let mut told: Vec<&str> = Vec::new();
    for metric in metrics {
        let alike = without_value(metrics, metric);
        if alike.len() > 1 {
            // A reason is said once, where the first of those stands that it is for.
            if !told.contains(&metric.method.as_str()) {
                told.push(&metric.method);
                let reason = format!("unavailable, {}: {}", alike.len(), metric.method);
                canvas.paragraph(INDENT, Tone::Faint, &reason);
                canvas.paragraph(INDENT + 2, Tone::Plain, &joined_labels(&alike));
            }
            continue;
        }
        let unit = if metric.unit == "1" {
            ""
        } else {
            metric.unit.as_str()
        };
        let (tone, value) = match metric.value {
            Some(value) => (Tone::Strong, format!("{} {unit}", figure(value))),
            None => (Tone::Faint, "unavailable".to_owned()),
        };
        let interval = metric.interval.map_or_else(String::new, |(low, high)| {
            format!("  [{}, {}]", figure(low), figure(high))
        });
        let line = format!(
            "{:INDENT$}{}  {}{}",
            "",
            left(&metric.label, label_width),
            canvas.paint(tone, &left(value.trim_end(), 16)),
            interval
        );
        canvas.line(&line);
        canvas.paragraph(INDENT + 2, Tone::Faint, &metric.method);
    }
}

/// Labels of the figures that there are none of for the reason of `one`; empty when it has a value.
fn without_value<'a>(metrics: &'a [ScoreMetric], one: &ScoreMetric) -> Vec<&'a str> {
    let alike = metrics.iter().filter(|other| {
        let is_none = one.value.is_none() && other.value.is_none();
        is_none && !one.method.is_empty() && other.method == one.method
    });
    alike.map(|other| other.label.as_str()).collect()
}

pub(super) fn processes(canvas: &mut Canvas, processes: &[ProcessSummary]) {
    canvas.heading("Processes", "");
    if processes.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, "none were started");
        return;
    }
    // The two name columns share what the figures leave.
    let name_width = (canvas.width() - INDENT - 54) / 2;
    let header = format!(
        "{:INDENT$}{}{}{:>9}{:>9}{:>9}{:>10}{:>17}",
        "",
        left("name", name_width),
        left("role on host", name_width),
        "restarts",
        "ticks",
        "skipped",
        "CPU time",
        "sw. own/forced"
    );
    canvas.painted_line(Tone::Faint, &header);
    for process in processes {
        let count = |count: Option<u64>| count.map_or_else(|| "–".to_owned(), grouped);
        let restarts = right(&grouped(process.restart_count), 9);
        let skipped = right(&count(process.skipped_tick_count), 9);
        let caution = |is_raised: bool| {
            if is_raised {
                Tone::Caution
            } else {
                Tone::Plain
            }
        };
        let switches = format!(
            "{}/{}",
            count(process.voluntary_switch_count),
            count(process.involuntary_switch_count)
        );
        let cpu_time = process
            .cpu_time_s
            .map_or_else(|| "–".to_owned(), |s| format!("{s:.2} s"));
        let line = format!(
            "{:INDENT$}{}{}{}{}{}{}{}",
            "",
            column(&process.name, name_width),
            left(
                &format!("{} on {}", process.label(), process.host),
                name_width
            ),
            canvas.paint(caution(process.restart_count > 0), &restarts),
            right(&count(process.tick_count), 9),
            canvas.paint(
                caution(process.skipped_tick_count.unwrap_or(0) > 0),
                &skipped
            ),
            right(&cpu_time, 10),
            right(&switches, 17),
        );
        canvas.line(&line);
        let exit = match process.preparation_s {
            Some(s) if s >= PREPARATION_S_MIN => {
                let prepared = duration_s(s);
                format!("{}; case prepared in {prepared}", process.exit)
            }
            _ => process.exit.clone(),
        };
        canvas.paragraph(INDENT + 2, Tone::Faint, &exit);
    }
}

/// Text at the left of a column, with a blank before the next one.
fn column(text: &str, width: usize) -> String {
    format!("{} ", left(text, width.saturating_sub(1)))
}

/// Warnings of processes on the page, the first ones; all of them are in the summary.
const WARNINGS_SHOWN_COUNT: usize = 200;

pub(super) fn events(canvas: &mut Canvas, events: &[RunEvent]) {
    if events.is_empty() {
        return;
    }
    canvas.heading("Events", "");
    let mut warning_count = 0;
    for event in events {
        if let RunEventKind::Process(EventKind::Warning { .. }) = event.kind {
            warning_count += 1;
            if warning_count > WARNINGS_SHOWN_COUNT {
                continue;
            }
        }
        let what = event.what();
        let text = match event.cause() {
            Some(cause) => format!("{what} ({cause})"),
            None => what,
        };
        let at = event
            .at_s
            .map_or_else(|| "time unknown".to_owned(), seconds);
        canvas.field(&at, Tone::Plain, &text);
    }
    let hidden = warning_count.saturating_sub(WARNINGS_SHOWN_COUNT) as u64;
    if hidden > 0 {
        let more = counted(hidden, "more warning");
        canvas.field("", Tone::Plain, &format!("{more}, in summary.json"));
    }
}

pub(super) fn realtime(canvas: &mut Canvas, realtime: &RealtimeFacts) {
    if realtime.granted.is_empty() && realtime.refused.is_empty() {
        return;
    }
    canvas.heading("Real time", "");
    for fact in &realtime.refused {
        canvas.field("refused", Tone::Caution, &fact.to_string());
    }
    for fact in &realtime.granted {
        canvas.field("granted", Tone::Plain, &fact.to_string());
    }
}

pub(super) fn host(canvas: &mut Canvas, facts: &HostFacts) {
    if facts.facts.is_empty() {
        return;
    }
    canvas.heading("Host", "");
    for fact in host_words(facts) {
        canvas.field_of(22, &fact.label, Tone::Plain, &fact.value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terminal::{Style, render};
    use crate::tests::sample;

    #[test]
    fn of_many_warnings_the_first_are_shown_and_the_others_counted() {
        let mut summary = sample::full();
        let event = |index| RunEvent {
            at_s: Some(1.0),
            process: "robot".to_owned(),
            kind: RunEventKind::Process(EventKind::Warning {
                text: format!("said: {index}."),
            }),
            absence: None,
        };
        summary.events.splice(0..0, (0..100_000).map(event));
        let page = render(&summary, 100, Style::Plain);
        assert!(page.contains("said: 199.") && !page.contains("said: 200."));
        assert!(page.contains("99,800 more warnings, in summary.json"));
        assert!(
            page.contains("restart 1 of at most 3"),
            "what came after them"
        );
    }
}
