//! `events.log`: what happened to the robot, one line per event, to be searched with the tools of
//! a log. It holds no event that the score has not.

use core::fmt::Write;

use super::link_change::LinkChange;
use super::score_event::{ExplainedEvent, ScoreEvents};
use super::summary::RunSummary;
use hil_present::units::JOINT;

/// The text of the file of a run.
pub(crate) fn of(summary: &RunSummary) -> String {
    let missing = summary.no_score_words();
    let (all, changes) = (&summary.score_events, &summary.link_changes);
    text(&summary.run.name, all, changes, missing.as_deref())
}

/// The same for the run called `name`; without a score it says why there is none.
fn text(name: &str, all: &ScoreEvents, changes: &[LinkChange], missing: Option<&str>) -> String {
    let mut text = format!("# {}\n", one_line(name));
    text.push_str(
        "# seconds since the start of the run, severity, what happened | outages beside it, then \
         events of the network before it, nearest first\n",
    );
    if all.clocks_differ {
        text.push_str("# clocks are not aligned: times of different hosts do not compare\n");
    }
    // Both are in order of time; what has none stays where it is.
    let mut changes = changes.iter().peekable();
    for event in &all.events {
        let is_before = |change: &&LinkChange| {
            let times = change.at_s.zip(event.at_s);
            times.is_some_and(|(change_s, event_s)| change_s <= event_s)
        };
        while let Some(change) = changes.next_if(is_before) {
            let _infallible = writeln!(text, "{}", change_line(change));
        }
        let line = line(event, all.clocks_differ);
        let _infallible = writeln!(text, "{line}");
    }
    let had_changes = changes.peek().is_some();
    for change in changes {
        let _infallible = writeln!(text, "{}", change_line(change));
    }
    if all.dropped_count > 0 {
        let count = all.dropped_count;
        let _infallible = writeln!(text, "# {count} more events found no room in the score");
    }
    if let Some(why) = missing {
        let _infallible = writeln!(text, "# what happened to the robot is {}", one_line(why));
    } else if all.total_count() == 0 && !had_changes {
        text.push_str("# nothing happened\n");
    }
    text
}

fn line(event: &ExplainedEvent, clocks_differ: bool) -> String {
    let (time, severity) = (time_s(event.at_s), event.severity_word());
    let mut line = format!("{time:>14} {severity:<8} {}", event.what.replace('|', "/"));
    if clocks_differ {
        line.push_str(&[" (clock of ", &event.clock, ")"].concat());
    }
    for outage in &event.outages {
        line.push_str(" | ");
        line.push_str(&outage.words);
    }
    if let Some(network) = event.network.as_ref().filter(|one| one.events.is_empty()) {
        line.push_str(&[" | ", &network.nothing_words()].concat());
    }
    for one in event.network_beside() {
        line.push_str(&[" | ", &one.words].concat());
    }
    one_line(&line)
}

fn time_s(at_s: Option<f64>) -> String {
    at_s.map_or_else(|| "-".to_owned(), |at_s| format!("{at_s:.6}"))
}

/// A change of an emulated link. It is no event of the score, and nothing the network did.
fn change_line(change: &LinkChange) -> String {
    let time = time_s(change.at_s);
    one_line(&format!("{time:>14} notice   {}", change.what()))
}

/// A name or a cause must not begin a line of its own.
fn one_line(text: &str) -> String {
    let plain = |c: char| if c == JOINT || c.is_control() { ' ' } else { c };
    text.chars().map(plain).collect()
}

#[cfg(test)]
mod tests {
    use hil_core::case_study::Severity;

    use super::*;
    use crate::link_change::ChangedTo;
    use crate::network::PrecedingNetwork;
    use crate::score_event::EventOutage;
    use hil_account::Standing;
    use hil_link::spec::Way;

    fn event(at_s: Option<f64>, severity: Severity, what: &str) -> ExplainedEvent {
        ExplainedEvent {
            at_s,
            clock: "robot-pc".to_owned(),
            severity,
            what: what.to_owned(),
            outages: Vec::new(),
            network: None,
            messages: Vec::new(),
            messages_dropped_count: 0,
        }
    }

    #[test]
    fn every_event_has_one_line_with_time_severity_and_cause() {
        let mut dropped = event(
            Some(42.204),
            Severity::Incident,
            "session 3 ended\nby itself",
        );
        dropped.outages.push(EventOutage {
            channel: "egm/right/command".to_owned(),
            from_s: Some(41.2),
            until_s: None,
            length_s: None,
            lost_count: 230,
            lost_by_network_count: 230,
            standing: Standing::UnderWay,
            clock_bound_s: 0.0,
            other_count: 0,
            words: format!("outage of 1.84{JOINT}s on egm/right/command"),
        });
        let mut all = ScoreEvents {
            events: vec![event(None, Severity::Notice, "hold began"), dropped],
            dropped_count: 7,
            ..ScoreEvents::default()
        };
        let lines =
            "# seconds since the start of the run, severity, what happened | outages beside it, then \
             events of the network before it, nearest first
             - notice   hold began
     42.204000 incident session 3 ended by itself | outage of 1.84 s on egm/right/command
# 7 more events found no room in the score
";
        let text = |name: &str, all: &ScoreEvents| text(name, all, &[], None);
        assert_eq!(text("run", &all), format!("# run\n{lines}"));
        all.clocks_differ = true;
        assert!(text("run", &all).contains("hold began (clock of robot-pc)\n"));
        all.events[0].network = Some(PrecedingNetwork {
            foregoing_s: 5.0,
            events: Vec::new(),
            more_count: 0,
            lost_count: 3,
            losses: Vec::new(),
        });
        let words = "hold began (clock of robot-pc) | nothing of note on any channel in the 5.00 s \
                     before (only single losses, 3 messages)\n";
        assert!(text("run", &all).contains(words), "{}", text("run", &all));
        let nothing = text("run", &ScoreEvents::default());
        assert!(nothing.ends_with("# nothing happened\n"));
        let unknown = of(&crate::tests::sample::empty());
        let words = "# what happened to the robot is unavailable: the case gave no score\n";
        assert!(unknown.ends_with(words), "{unknown}");
    }
    #[test]
    fn a_changed_link_stands_among_the_events_by_its_time() {
        let change = |at_s, to| LinkChange {
            link: "hop".to_owned(),
            way: Way::Forward,
            number: 1,
            at_s,
            unsure_s: 0.0,
            to,
            refused: None,
        };
        let changes = [
            change(Some(2.5), ChangedTo::Cut),
            change(Some(9.0), ChangedTo::Topology),
        ];
        let all = ScoreEvents {
            events: vec![
                event(Some(1.0), Severity::Notice, "first"),
                event(Some(3.0), Severity::Notice, "second"),
            ],
            ..ScoreEvents::default()
        };
        let text = text("run", &all, &changes, None);
        let lines: Vec<&str> = text.lines().skip(2).map(str::trim).collect();
        let expected = [
            "1.000000 notice   first",
            "2.500000 notice   link hop.forward changed by hand: cut",
            "3.000000 notice   second",
            "9.000000 notice   link hop.forward changed by hand: as the topology says again",
        ];
        assert_eq!(lines, expected);
        let alone = super::text("run", &ScoreEvents::default(), &changes[..1], None);
        assert!(!alone.contains("nothing happened"), "{alone}");
    }
}
