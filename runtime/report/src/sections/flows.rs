//! The frames of programs that speak IP, by flow: counted, lost by whom, delayed. Nothing is computed here.

use hil_account::flow::{DeadlineMetrics, FlowMetrics};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::duration_s;
use hil_present::{Cell, Row, Section, Table, Tone};

use crate::summary::{ChannelFlows, RunSummary};

/// The flows of the run, at most `shown_count` of them, those that lost the largest share first.
pub(crate) fn flows(summary: &RunSummary, shown_count: usize) -> Section {
    let aside = "one way each, from the program's interface to the other's";
    let mut section = Section::new("flows", "Flows", aside);
    let channels = summary.flows.iter();
    let mut flows: Vec<&FlowMetrics> = channels.flat_map(|one| &one.flows).collect();
    if flows.is_empty() {
        return section;
    }
    let lost_share = |flow: &FlowMetrics| {
        let lost_count =
            flow.lost_by_network_count + flow.lost_by_either_count + flow.lost_by_harness_count;
        lost_count as f64 / flow.frame_count.max(1) as f64
    };
    flows.sort_by(|one, other| {
        let by_loss = lost_share(other).total_cmp(&lost_share(one));
        by_loss.then(other.frame_count.cmp(&one.frame_count))
    });
    let columns = [
        "flow",
        "frames",
        "lost: network",
        "network or host",
        "host",
        "unknown",
        "reordered",
        "sent again",
        "p50",
        "p99",
        "max",
    ];
    let mut table = Table::new("", &columns)
        .ranked("sent again", 5)
        .ranked("reordered", 4)
        .ranked("unknown", 3)
        .ranked("p50", 2)
        .ranked("max", 1)
        .with_long_names();
    for flow in flows.iter().take(shown_count) {
        let delay = flow.delay.measured();
        let cells = [
            flow.name.clone().into(),
            Cell::Count(flow.frame_count),
            Cell::Count(flow.lost_by_network_count),
            Cell::Count(flow.lost_by_either_count),
            Cell::Count(flow.lost_by_harness_count),
            Cell::Count(flow.unknown_count),
            Cell::count(flow.reordered_count),
            Cell::count(flow.retransmitted_count),
            Cell::duration(delay.map(|one| one.p50_ns)),
            Cell::duration(delay.map(|one| one.p99_ns)),
            Cell::duration(delay.map(|one| one.max_ns)),
        ];
        let is_hurt = flow.lost_by_network_count > 0;
        table.rows.push(Row {
            cells: cells.into(),
            tone: if is_hurt { Tone::Caution } else { Tone::Plain },
            bar: None,
        });
    }
    section.table(table);
    let hidden = flows.len().saturating_sub(shown_count) as u64;
    if hidden > 0 {
        section.note(
            Tone::Faint,
            format!("and {} that lost no larger share", counted(hidden, "flow")),
        );
    }
    let inlets = summary.flows.iter().map(ChannelFlows::inlet_lost_count);
    let inlets: u64 = inlets.sum();
    let inlets = match inlets {
        0 => "none beside these was lost at an inlet".to_owned(),
        count => format!(
            "{} more were lost at inlets, which are this program's, too",
            grouped(count)
        ),
    };
    section.note(
        Tone::Faint,
        format!(
            "lost: network or host: on the link or for want of room on the receiving host; host: by this program or \
             its host, in a process, queue or socket; {inlets}; reordered: RFC 4737"
        ),
    );
    section
}

/// How the requests of flows with a deadline were answered; of so many, those with most harm first if there are more.
pub(crate) fn deadlines(summary: &RunSummary, shown_count: usize) -> Section {
    let aside = "from sending a request until its answer was given";
    let mut section = Section::new("deadlines", "Deadlines", aside);
    if summary.deadlines.is_empty() {
        return section;
    }
    let columns = [
        "requests", "count", "in time", "late", "missing", "unknown", "p50", "p99", "max",
    ];
    let mut table = Table::new("", &columns)
        .ranked("p50", 1)
        .ranked("unknown", 2)
        .with_long_names();
    let mut deadlines: Vec<&DeadlineMetrics> = summary.deadlines.iter().collect();
    if deadlines.len() > shown_count {
        deadlines.sort_by_key(|one| core::cmp::Reverse(one.hurt_count));
        let hidden = counted((deadlines.len() - shown_count) as u64, "further deadline");
        table.note = format!("{hidden} with --full. ");
    }
    for one in deadlines.into_iter().take(shown_count) {
        let response = one.response.measured();
        let limit = duration_s(one.limit_ns as f64 * 1e-9);
        let late = [
            ("network", one.late_by_network_count),
            ("program", one.late_by_program_count),
            ("both", one.late_by_both_count),
            ("host", one.late_by_harness_count),
        ];
        let missing = [
            ("network", one.missing_by_network_count),
            ("program", one.missing_by_program_count),
            ("host", one.missing_by_harness_count),
        ];
        let cells = [
            format!("{} within {limit}", one.name).into(),
            Cell::Count(one.request_count),
            Cell::Count(one.in_time_count),
            by_cause(&late).into(),
            by_cause(&missing).into(),
            Cell::Count(one.unknown_count),
            Cell::duration(response.map(|one| one.p50_ns)),
            Cell::duration(response.map(|one| one.p99_ns)),
            Cell::duration(response.map(|one| one.max_ns)),
        ];
        let is_hurt = one.in_time_count + one.unknown_count < one.request_count;
        table.rows.push(Row {
            cells: cells.into(),
            tone: if is_hurt { Tone::Caution } else { Tone::Plain },
            bar: None,
        });
    }
    table.note += "host: by this program or its host";
    section.table(table);
    section
}

/// `3 network, 1 program`.
fn by_cause(counts: &[(&str, u64)]) -> String {
    let counts = counts.iter().filter(|(_, count)| *count > 0);
    let words: Vec<String> = counts
        .map(|(cause, count)| format!("{} {cause}", grouped(*count)))
        .collect();
    if words.is_empty() {
        "0".to_owned()
    } else {
        words.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use hil_present::terminal::{canvas::Style, render};
    use hil_rundir::pipe::{CountByName, CounterGroup};

    use super::*;
    use crate::tests::sample::{flow, full};

    #[test]
    fn flows_are_listed_with_what_was_lost_by_whom() {
        let mut summary = full();
        assert!(flows(&summary, 9).is_empty());
        let lost = CountByName::all(CounterGroup::Own, [("ring of the inlet full", 7)]);
        summary.flows = vec![ChannelFlows {
            channel: "a/b".to_owned(),
            inlet_lost: lost.collect(),
            flows: vec![flow("arp", 2, [0, 0]), flow("icmp a → b", 100, [3, 1])],
        }];
        let text = render(&[flows(&summary, 1)], 100, Style::Plain);
        for words in [
            "icmp a → b",
            "100",
            "1 flow that lost no larger share",
            "7 more were lost at inlets",
            "5.00",
        ] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
        assert!(!text.contains("arp"), "{text}");
        // A flow of which everything was lost is small just because of that.
        summary.flows[0].flows.push(flow("udp dead", 12, [12, 0]));
        let text = render(&[flows(&summary, 1)], 100, Style::Plain);
        assert!(text.contains("udp dead"), "{text}");
        summary.flows[0].flows.pop();
        let name = "udp 10.77.0.1:40001 → 10.77.0.2:6510";
        summary.flows[0]
            .flows
            .push(flow(name, 1_000_000, [30_000, 12]));
        for width in [80, 100] {
            let text = render(&[flows(&summary, 3)], width, Style::Plain);
            for words in [name, "unknown", "max"] {
                assert!(text.contains(words), "{words}:\n{text}");
            }
        }
    }
}
