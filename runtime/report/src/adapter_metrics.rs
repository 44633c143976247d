//! From the records of an adapter to its figures: where time went, how many of the robot's messages
//! were answered and how fast. It reads no file.

use hil_core::record::UNAVAILABLE;
use hil_stats::histogram::LatencyHistogram;

use crate::adapter::{AdapterSegment, Answers};
use hil_rundir::adapter_record::{AdapterReceivedRecord, AdapterSentRecord};
use hil_topology::AdapterKind;

/// What the records of one arm come to.
#[derive(Debug, Clone, PartialEq)]
pub struct AdapterMetrics {
    /// Median interval of the robot's messages; `None` for fewer than two.
    pub cycle_ns: Option<i64>,
    /// How the robot's messages were answered.
    pub answers: Answers,
    /// Where time went.
    pub segments: Vec<AdapterSegment>,
}

/// The figures of one arm; records in the order they were written.
pub fn metrics(
    kind: AdapterKind,
    sent: &[AdapterSentRecord],
    received: &[AdapterReceivedRecord],
) -> AdapterMetrics {
    let left = sorted(
        sent.iter()
            .filter(|one| has_left(one))
            .map(AdapterSentRecord::left_ns),
    );
    let came = sorted(received.iter().map(AdapterReceivedRecord::came_ns));
    let (robot, sensor) = match kind {
        AdapterKind::Robot => (&left, &came),
        AdapterKind::Sensor => (&came, &left),
    };
    let (answers, replies) = answered(robot, sensor);
    let (out, back) = match kind {
        AdapterKind::Robot => ("feedback", "command"),
        AdapterKind::Sensor => ("command", "feedback"),
    };
    let reply = match kind {
        AdapterKind::Robot => "robot's newest message, TX stamp → next answer, RX stamp",
        AdapterKind::Sensor => "our answer to the robot: RX stamp → TX stamp",
    };
    let mut segments = sent_segments(out, sent);
    segments.extend(received_segments(back, received));
    segments.push(AdapterSegment {
        name: reply.to_owned(),
        distribution: replies.distribution("no message of the robot was answered"),
    });
    AdapterMetrics {
        cycle_ns: median_interval(robot),
        answers,
        segments,
    }
}

fn has_left(record: &AdapterSentRecord) -> bool {
    record.flags & AdapterSentRecord::REFUSED_BY_KERNEL == 0
}

/// Records are written when their stamps have come, so they may be slightly out of order.
fn sorted(times: impl Iterator<Item = i64>) -> Vec<i64> {
    let mut times: Vec<i64> = times.collect();
    times.sort_unstable();
    times
}

/// Which prompts an answer followed before the next one, and how long the first answer to each
/// took. Both lists sorted.
fn answered(prompts: &[i64], answers: &[i64]) -> (Answers, LatencyHistogram) {
    let mut counts = Answers {
        robot_message_count: prompts.len() as u64,
        ..Answers::default()
    };
    let mut times = LatencyHistogram::default();
    let (Some(first), Some(last)) = (answers.first(), answers.last()) else {
        return (counts, times);
    };
    for (index, prompt) in prompts.iter().enumerate() {
        let until = prompts.get(index + 1).copied().unwrap_or(i64::MAX);
        // The first answer belongs to the message before it.
        if until <= *first || *prompt > *last {
            continue;
        }
        counts.attended_count += 1;
        let next = answers.partition_point(|answer| *answer < *prompt);
        if let Some(answer) = answers.get(next).filter(|answer| **answer < until) {
            counts.answered_count += 1;
            times.record(answer - prompt);
        }
    }
    (counts, times)
}

fn median_interval(times: &[i64]) -> Option<i64> {
    let mut intervals: Vec<i64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    intervals.sort_unstable();
    intervals.get(intervals.len() / 2).copied()
}

/// Where one message was when, in the order of the way.
type Stage<R> = (&'static str, fn(&R) -> Option<i64>);

fn sent_segments(what: &str, sent: &[AdapterSentRecord]) -> Vec<AdapterSegment> {
    let stages: [Stage<AdapterSentRecord>; 4] = [
        ("published", |one| Some(one.published_ns)),
        ("taken by adapter", |one| Some(one.taken_ns)),
        ("handed to kernel", |one| Some(one.handed_ns)),
        ("TX stamp", |one| {
            monotonic(one.tx_software_ns, one.realtime_offset_ns)
        }),
    ];
    // A message that went out before says nothing about the way of a new one.
    let is_new = |one: &&AdapterSentRecord| one.flags & AdapterSentRecord::REPEATED == 0;
    let new: Vec<&AdapterSentRecord> = sent
        .iter()
        .filter(|one| has_left(one))
        .filter(is_new)
        .collect();
    segments(what, &stages, &new)
}

fn received_segments(what: &str, received: &[AdapterReceivedRecord]) -> Vec<AdapterSegment> {
    let stages: [Stage<AdapterReceivedRecord>; 3] = [
        ("RX stamp", |one| {
            monotonic(one.rx_software_ns, one.realtime_offset_ns)
        }),
        ("received by adapter", |one| Some(one.received_ns)),
        ("published", |one| Some(one.published_ns)),
    ];
    segments(what, &stages, &received.iter().collect::<Vec<_>>())
}

/// A kernel stamp on the clock of the run.
fn monotonic(realtime_ns: i64, offset_ns: i64) -> Option<i64> {
    (realtime_ns != UNAVAILABLE).then(|| realtime_ns.saturating_sub(offset_ns))
}

/// From each stage to the next, and from the first to the last.
fn segments<R>(what: &str, stages: &[Stage<R>], records: &[&R]) -> Vec<AdapterSegment> {
    let segment = |from: &Stage<R>, to: &Stage<R>, prefix: &str| {
        let mut histogram = LatencyHistogram::default();
        for record in records {
            if let (Some(from), Some(to)) = ((from.1)(record), (to.1)(record)) {
                histogram.record(to - from);
            }
        }
        let reason = if records.is_empty() {
            "nothing passed"
        } else {
            "no kernel stamps"
        };
        AdapterSegment {
            name: format!("{what}{prefix}: {} → {}", from.0, to.0),
            distribution: histogram.distribution(reason),
        }
    };
    let mut all: Vec<AdapterSegment> = stages
        .windows(2)
        .map(|pair| segment(&pair[0], &pair[1], ""))
        .collect();
    if let [first, .., last] = stages {
        all.push(segment(first, last, " in all"));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const OFFSET: i64 = 1_700_000_000_000_000_000;
    const CYCLE: i64 = 4_000_000;

    fn sent(cycle: i64) -> AdapterSentRecord {
        let published_ns = cycle * CYCLE;
        AdapterSentRecord {
            published_ns,
            taken_ns: published_ns + 20_000,
            handed_ns: published_ns + 25_000,
            tx_software_ns: OFFSET + published_ns + 30_000,
            realtime_offset_ns: OFFSET,
            flags: 0,
        }
    }

    fn received(at_ns: i64) -> AdapterReceivedRecord {
        AdapterReceivedRecord {
            rx_software_ns: OFFSET + at_ns,
            received_ns: at_ns + 12_000,
            published_ns: at_ns + 17_000,
            realtime_offset_ns: OFFSET,
        }
    }

    fn p50_ns(figures: &AdapterMetrics, name: &str) -> i64 {
        let mut segments = figures.segments.iter();
        let segment = segments.find(|one| one.name == name).unwrap();
        segment.distribution.measured().unwrap().p50_ns
    }

    #[test]
    fn segments_add_up_and_answers_belong_to_the_message_before_them() {
        let robot: Vec<_> = (0..100).map(sent).collect();
        // From cycle 10 to 89, every tenth cycle without an answer.
        let answers: Vec<_> = (10..90)
            .filter(|cycle| cycle % 10 != 5)
            .map(|cycle| received(cycle * CYCLE + 30_000 + 500_000))
            .collect();
        let figures = metrics(AdapterKind::Robot, &robot, &answers);
        assert_eq!(figures.cycle_ns, Some(CYCLE));
        let expected = Answers {
            robot_message_count: 100,
            attended_count: 80,
            answered_count: 72,
        };
        assert_eq!(figures.answers, expected);
        assert_eq!(figures.answers.ratio(), Some(0.9));
        let near = |name: &str, ns: i64| {
            let found = p50_ns(&figures, name);
            assert!((found - ns).abs() <= ns / 1000 + 1, "{name}: {found}");
        };
        near("feedback: published → taken by adapter", 20_000);
        near("feedback in all: published → TX stamp", 30_000);
        near("command: RX stamp → received by adapter", 12_000);
        near("command in all: RX stamp → published", 17_000);
        near(
            "robot's newest message, TX stamp → next answer, RX stamp",
            500_000,
        );
    }

    #[test]
    fn without_stamps_their_segments_are_unavailable_and_the_rest_is_not() {
        let robot: Vec<_> = (0..10)
            .map(|cycle| AdapterSentRecord {
                tx_software_ns: UNAVAILABLE,
                ..sent(cycle)
            })
            .collect();
        let figures = metrics(AdapterKind::Robot, &robot, &[]);
        let unavailable = figures
            .segments
            .iter()
            .filter(|one| one.distribution.measured().is_none());
        let names: Vec<_> = unavailable.map(|one| one.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "feedback: handed to kernel → TX stamp",
                "feedback in all: published → TX stamp",
                "command: RX stamp → received by adapter",
                "command: received by adapter → published",
                "command in all: RX stamp → published",
                "robot's newest message, TX stamp → next answer, RX stamp",
            ]
        );
        assert_eq!(figures.cycle_ns, Some(CYCLE));
        assert_eq!(figures.answers.ratio(), None);
    }

    #[test]
    fn a_repeated_message_counts_as_an_answer_and_not_as_a_way() {
        let robot: Vec<_> = (0..10).map(|cycle| received(cycle * CYCLE)).collect();
        let ours: Vec<_> = (0..10)
            .map(|cycle| AdapterSentRecord {
                flags: if cycle % 2 == 1 {
                    AdapterSentRecord::REPEATED
                } else {
                    0
                },
                ..sent(cycle)
            })
            .collect();
        let figures = metrics(AdapterKind::Sensor, &ours, &robot);
        assert_eq!(figures.answers.answered_count, 10);
        let way = &figures.segments[0];
        assert_eq!(way.name, "command: published → taken by adapter");
        assert_eq!(way.distribution.measured().unwrap().count, 5);
    }
}
