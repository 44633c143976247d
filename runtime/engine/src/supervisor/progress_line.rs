//! The channels of a run in one line while it lasts: how many messages entered each and how many
//! came out, as far as this host knows. The console cuts it, so what matters most comes first.

use std::collections::BTreeMap;
use std::time::Duration;

use hil_rundir::pipe::ChannelProgress;
use hil_topology::{Channel, Topology};

/// Where messages are counted, in the order of their way.
const STAGES: [&str; 5] = ["published", "sent", "received", "taken", "recorded"];

/// How long it has run, and of how long where that is planned.
pub(super) fn of_time(elapsed: Duration, planned: Option<Duration>) -> String {
    let planned = planned.map_or_else(String::new, |planned| {
        format!(" / {:.0}", planned.as_secs_f64())
    });
    format!("{:6.1}{planned} s", elapsed.as_secs_f64())
}

/// `egm/right/command 3071→3070 | …`: counted at the first and at the last stage that is told.
pub(super) fn of_channels<'a>(
    topology: &Topology,
    progress: impl Iterator<Item = &'a ChannelProgress>,
) -> String {
    let counts: BTreeMap<(&str, &str), u64> = progress
        .map(|one| ((one.channel.as_str(), one.what.as_str()), one.count))
        .collect();
    let mut channels: Vec<&Channel> = topology.channels().iter().collect();
    channels.sort_by_key(|channel| rank(channel));
    let told = channels.into_iter().filter_map(|channel| {
        let name = channel.name.as_str();
        let mut stages = STAGES
            .iter()
            .filter_map(|stage| counts.get(&(name, *stage)));
        let first = stages.next()?;
        let last = stages.next_back();
        // Each process tells its count at a moment of its own; what was taken was published.
        Some(last.map_or_else(
            || format!("{name} {first}"),
            |last| format!("{name} {}→{last}", first.max(last)),
        ))
    });
    told.collect::<Vec<_>>().join(" | ")
}

/// Commands first, then what comes back, then the rest, and last what is only recorded.
fn rank(channel: &Channel) -> u8 {
    match channel.name.rsplit('/').next() {
        _ if channel.is_recorded_only() => 3,
        Some("command" | "task") => 0,
        Some("feedback" | "status" | "state") => 1,
        _ => 2,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_teleoperation::Teleoperation;
    use hil_topology::registry::Registry;

    #[test]
    fn a_run_without_a_planned_end_shows_only_how_long_it_has_run() {
        let elapsed = Duration::from_millis(2_540);
        let planned = Some(Duration::from_secs(20));
        assert_eq!(of_time(elapsed, planned), "   2.5 / 20 s");
        assert_eq!(of_time(elapsed, None), "   2.5 s");
    }

    #[test]
    fn commands_come_first_with_their_first_and_last_count() {
        let mut registry = Registry::default();
        registry.add::<Teleoperation>();
        let text = "version = 1\nname = \"x\"\n[case]\nname = \"teleoperation\"\n[processes]\n\
                    human.role = \"human\"\ncontroller.role = \"controller\"\n\
                    robot.role = \"robot\"\n";
        let topology = hil_topology::parse("x.toml", text, &[], registry.known()).unwrap();
        let told = |channel: &str, what: &str, count| ChannelProgress {
            channel: channel.to_owned(),
            what: what.to_owned(),
            count,
        };
        let progress = [
            told("human/frame", "published", 9),
            told("egm/event", "recorded", 2),
            told("egm/right/feedback", "taken", 7),
            told("egm/right/feedback", "published", 6),
            told("egm/right/command", "sent", 8),
            told("egm/right/command", "taken", 5),
            told("egm/right/command", "published", 8),
        ];
        assert_eq!(
            of_channels(&topology, progress.iter()),
            "egm/right/command 8→5 | egm/right/feedback 7→7 | human/frame 9 | egm/event 2"
        );
    }
}
