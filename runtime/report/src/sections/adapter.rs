//! The arms that a foreign program drove, or that were driven in a foreign robot: state, answers,
//! and where time went in our adapter, held against the controller's cycle.

use hil_present::units::{duration, percent};
use hil_present::{Cell, Section, Table, Tone};

use super::channel::quantile_table;
use crate::adapter::AdapterSummary;
use crate::summary::Fact;
use hil_platform::text::grouped;

/// Share of the robot's messages that a sensor should answer in time.
const ANSWERED_RATIO_MIN: f64 = 0.95;

pub(super) fn adapters(adapters: &[AdapterSummary]) -> Section {
    let mut section = Section::new("adapters", "Adapters", "to a program that is not ours");
    section.children.extend(adapters.iter().map(adapter));
    section
}

fn adapter(adapter: &AdapterSummary) -> Section {
    let arm = adapter.arm.word();
    let title = format!("{} of {}, {arm} arm", adapter.kind, adapter.process);
    let mut section = Section::new("adapter", title, &adapter.address);
    section.fact("peer", Tone::Plain, &adapter.peer_state);
    answers(&mut section, adapter);
    section.table(segments(adapter));
    if !adapter.refusals.is_empty() {
        let words: Vec<_> = adapter
            .refusals
            .iter()
            .map(|one| format!("{} {}", one.cause.label(), grouped(one.count)))
            .collect();
        section.fact("refused", Tone::Caution, words.join(" · "));
    }
    let counted = adapter.counters.iter().filter(|one| one.count > 0);
    let words: Vec<_> = counted
        .map(|one| format!("{} {}", one.label(), grouped(one.count)))
        .collect();
    if !words.is_empty() {
        section.fact("counted", Tone::Faint, words.join(" · "));
    }
    let words: Vec<_> = adapter.facts.iter().map(Fact::to_string).collect();
    section.fact("found", Tone::Faint, words.join(" · "));
    section
}

fn answers(section: &mut Section, adapter: &AdapterSummary) {
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
    section.fact("answers", tone, text);
}

/// Where time went in our adapter, held against the controller's cycle.
fn segments(adapter: &AdapterSummary) -> Table {
    let cycle = adapter.cycle_ns.map_or_else(
        || "cycle unavailable".to_owned(),
        |cycle_ns| format!("cycle {}", duration(cycle_ns)),
    );
    let segments = adapter.segments.iter();
    let rows: Vec<_> = segments
        .map(|one| (one.name.as_str(), &one.distribution))
        .collect();
    let mut table = quantile_table(&rows)
        .ranked("min", 2)
        .ranked("max", 1)
        .with_column("p99/cycle");
    for (row, segment) in table.rows.iter_mut().zip(&adapter.segments) {
        if segment.distribution.measured().is_some() {
            let share = segment.p99_of_cycle(adapter.cycle_ns);
            row.cells.push(Cell::share(share));
        }
    }
    table.title = cycle;
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapter::{AdapterSegment, Answers};
    use hil_arm::egm::messages::Side;
    use hil_arm::egm::wire::Cause;
    use hil_present::terminal::{canvas::Style, render};
    use hil_rundir::pipe::{AdapterRefusal, RefusalCount};
    use hil_stats::histogram::Distribution;
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
            let text = render(&[adapters(&[summary()])], width, Style::Plain);
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
