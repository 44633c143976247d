//! The arms that a foreign program drove, or that were driven in a foreign robot: state, answers,
//! and where time went in our adapter, held against the controller's cycle.

use hil_stats::histogram::Distribution;

use super::canvas::{Canvas, INDENT, Tone, left, right};
use super::units::{duration, percent};
use crate::adapter::{AdapterSegment, AdapterSummary};
use crate::summary::Fact;
use hil_platform::text::grouped;

/// Share of the robot's messages that a sensor should answer in time.
const ANSWERED_RATIO_MIN: f64 = 0.95;
/// Columns of each figure.
const FIGURE_WIDTH: usize = 10;

pub(super) fn adapter(canvas: &mut Canvas, adapter: &AdapterSummary) {
    let arm = adapter.arm.word();
    let title = format!("{} of {}, {arm} arm", adapter.kind, adapter.process);
    canvas.heading(&title, &adapter.address);
    canvas.field("peer", Tone::Plain, &adapter.peer_state);
    answers(canvas, adapter);
    segments(canvas, adapter);
    if !adapter.refusals.is_empty() {
        let words: Vec<_> = adapter
            .refusals
            .iter()
            .map(|one| format!("{} {}", one.cause.label(), grouped(one.count)))
            .collect();
        canvas.field("refused", Tone::Caution, &words.join(" · "));
    }
    let counted = adapter.counters.iter().filter(|one| one.count > 0);
    let words: Vec<_> = counted
        .map(|one| format!("{} {}", one.label(), grouped(one.count)))
        .collect();
    if !words.is_empty() {
        canvas.field("counted", Tone::Faint, &words.join(" · "));
    }
    let words: Vec<_> = adapter.facts.iter().map(Fact::to_string).collect();
    canvas.field("found", Tone::Faint, &words.join(" · "));
}

fn answers(canvas: &mut Canvas, adapter: &AdapterSummary) {
    let answers = &adapter.answers;
    let total = grouped(answers.robot_message_count);
    let (tone, text) = match answers.ratio() {
        None => (
            Tone::Caution,
            format!("none of the robot's {total} messages was answered"),
        ),
        Some(ratio) => {
            let tone = if ratio < ANSWERED_RATIO_MIN {
                Tone::Caution
            } else {
                Tone::Plain
            };
            let text = format!(
                "after {} of the {} messages between first and last answer one came before the \
                 robot's next ({total} in the whole run); which message it answers EGM does not say",
                percent(ratio),
                grouped(answers.attended_count)
            );
            (tone, text)
        }
    };
    canvas.field("answers", tone, &text);
}

fn segments(canvas: &mut Canvas, adapter: &AdapterSummary) {
    let cycle = adapter.cycle_ns.map_or_else(
        || "cycle unavailable".to_owned(),
        |cycle_ns| format!("cycle {}", duration(cycle_ns)),
    );
    let name_width = canvas.width() - INDENT - 4 * FIGURE_WIDTH;
    let header = format!(
        "{:INDENT$}{}{}{}{}{}",
        "",
        left(&cycle, name_width),
        right("p50", FIGURE_WIDTH),
        right("p99", FIGURE_WIDTH),
        right("p99.9", FIGURE_WIDTH),
        right("p99/cycle", FIGURE_WIDTH),
    );
    canvas.painted_line(Tone::Faint, &header);
    for segment in &adapter.segments {
        segment_line(canvas, segment, name_width, adapter.cycle_ns);
    }
}

fn segment_line(
    canvas: &mut Canvas,
    segment: &AdapterSegment,
    name_width: usize,
    cycle_ns: Option<i64>,
) {
    let name = left(&segment.name, name_width);
    let line = match &segment.distribution {
        Distribution::Unavailable { reason } => {
            let text = canvas.paint(Tone::Faint, &format!("unavailable: {reason}"));
            format!("{:INDENT$}{name}  {text}", "")
        }
        Distribution::Measured(figures) => {
            let share = segment.p99_of_cycle(cycle_ns);
            format!(
                "{:INDENT$}{name}{}{}{}{}",
                "",
                right(&duration(figures.p50_ns), FIGURE_WIDTH),
                right(&duration(figures.p99_ns), FIGURE_WIDTH),
                right(&duration(figures.p999_ns), FIGURE_WIDTH),
                right(&share.map_or_else(|| "–".to_owned(), percent), FIGURE_WIDTH),
            )
        }
    };
    canvas.line(&line);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapter::Answers;
    use crate::terminal::Style;
    use hil_arm::egm::messages::Side;
    use hil_arm::egm::wire::Cause;
    use hil_rundir::pipe::{AdapterRefusal, RefusalCount};
    use hil_stats::histogram::LatencyHistogram;
    use hil_topology::AdapterKind;

    fn summary() -> AdapterSummary {
        let mut histogram = LatencyHistogram::default();
        (0..100).for_each(|index| histogram.record(20_000 + index));
        AdapterSummary {
            process: "client".to_owned(),
            host: "local".to_owned(),
            kind: AdapterKind::Robot,
            arm: Side::Right,
            address: "127.0.0.1:6510".to_owned(),
            peer_state: "never answered".to_owned(),
            cycle_ns: Some(4_000_000),
            answers: Answers {
                robot_message_count: 1234,
                ..Answers::default()
            },
            segments: vec![
                AdapterSegment {
                    name: "feedback in all: published → TX stamp".to_owned(),
                    distribution: histogram.distribution("nothing passed"),
                },
                AdapterSegment {
                    name: "command in all: RX stamp → published".to_owned(),
                    distribution: Distribution::unavailable("nothing passed"),
                },
            ],
            refusals: vec![RefusalCount {
                cause: AdapterRefusal::Protocol(Cause::NotProtobuf),
                count: 3,
            }],
            counters: Vec::new(),
            facts: vec![Fact::new("socket", "from port 1 to 127.0.0.1:6510")],
        }
    }

    #[test]
    fn an_arm_shows_its_answers_its_segments_and_what_is_unavailable() {
        for width in [80, 120] {
            let mut canvas = Canvas::new(width, Style::Plain);
            adapter(&mut canvas, &summary());
            let text = canvas.finish();
            assert!(
                text.lines().all(|line| line.chars().count() <= width),
                "{text}"
            );
            for words in [
                "EGM robot adapter of client, right arm",
                "none of the robot's 1,234 messages was answered",
                "0.50",
                "unavailable: nothing passed",
                "not protobuf 3",
            ] {
                assert!(text.contains(words), "{words} is not in\n{text}");
            }
        }
    }
}
