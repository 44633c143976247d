//! Brings the messages of a run to the clock that its score is kept on, where the clocks of the hosts
//! are aligned. The score then compares what two hosts did, within the bound of the alignment.

use hil_core::run_log::{ConvertedStamp, RunLog};
use hil_core::time::RemoteInstant;

use super::clocks::HostClocks;
use super::records::RunRecords;
use hil_topology::Topology;
use hil_topology::registry::MadeCase;

/// The host of the clock that `case` keeps its score on; `None` when it names none that the topology has.
pub(super) fn host<'a>(topology: &'a Topology, case: Option<&MadeCase<'_>>) -> Option<&'a str> {
    host_of(topology, case?.0.score_clock?)
}

/// The host of a channel's producer.
fn host_of<'a>(topology: &'a Topology, channel: &str) -> Option<&'a str> {
    let producer = &topology.channel(channel)?.from;
    Some(topology.process(producer)?.host.as_str())
}

/// Brings every message of the log to the clock that `case` keeps its score on; gives why not, when the
/// clocks are aligned and it cannot be done. The log of hosts with unrelated clocks stays as it was
/// read, which the score then knows.
pub(super) fn apply(records: &mut RunRecords<'_>, case: Option<&MadeCase<'_>>) -> Option<String> {
    if records.result.has_one_clock {
        return None;
    }
    records.log.set_clocks_differ();
    let score_clock = case?.0.score_clock?;
    let topology = records.topology;
    let host_of = |channel: &str| host_of(topology, channel).map(str::to_owned);
    let why = bring(&mut records.log, &records.clocks, score_clock, &host_of);
    why.map(|why| format!("the score takes the hosts' clocks as not aligned: {why}"))
}

/// Brings `log` to the clock of the producer of `score_clock`; `host_of` gives the host of a channel's
/// producer, and `None` of a channel that the topology lacks.
fn bring(
    log: &mut RunLog,
    clocks: &HostClocks,
    score_clock: &str,
    host_of: &dyn Fn(&str) -> Option<String>,
) -> Option<String> {
    let Some(here) = host_of(score_clock) else {
        return Some(format!(
            "its clock is that of {score_clock}, and the topology has no such channel"
        ));
    };
    let convert = |channel: &str, ns: i64| {
        // A message that was published long before the gateways met is one of the score all the same.
        let path = clocks.path(&host_of(channel)?, &here);
        let (at, bound_ns, is_early) = path.localise_early(RemoteInstant::from_ns(ns))?;
        Some(ConvertedStamp {
            at_ns: at.as_ns(),
            bound_ns,
            is_early,
        })
    };
    let channel = log.bring_to_one_clock(host_of, convert).err()?;
    let Some(from) = host_of(&channel) else {
        return Some(format!(
            "the records have messages of {channel}, and the topology has no such channel"
        ));
    };
    // Otherwise a warning of the clocks says so.
    clocks.path(&from, &here).is_aligned().then(|| {
        format!(
            "a message of {channel} was published beside a step of a clock, or more than 1 s after the \
             last exchange of clocks"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_clock::{ClockMap, ClockSettings, Exchange, Requester};
    use hil_core::message::Envelope;
    use hil_core::record::RoundTripRecord;

    const SECOND: i64 = 1_000_000_000;

    /// The robot's clock is 100 s ahead of the controller's; exchanges from 10 s to 14 s there.
    fn clocks() -> HostClocks {
        let exchange = |index: i64| {
            let sent_ns = 10 * SECOND + index * 10_000_000;
            let record = RoundTripRecord {
                sequence: 1,
                t1_ns: sent_ns,
                t2_ns: sent_ns + 100 * SECOND + 100_000,
                t3_ns: sent_ns + 100 * SECOND + 105_000,
                t4_ns: sent_ns + 205_000,
                session: 1,
                sources: [0; 4],
            };
            Exchange::of(&record, Requester::Local).unwrap()
        };
        let exchanges: Vec<Exchange> = (0..400).map(exchange).collect();
        let map = ClockMap::new(&exchanges, ClockSettings::default());
        let hosts = ("robot".to_owned(), "controller".to_owned());
        HostClocks::mapped(vec![(hosts, map)])
    }

    fn host_of(channel: &str) -> Option<String> {
        let host = match channel {
            "command" => "controller",
            "status" => "robot",
            _ => return None,
        };
        Some(host.to_owned())
    }

    /// Messages by channel and second of the controller's clock.
    fn log(messages: &[(&str, i64)]) -> RunLog {
        let mut log = RunLog::default();
        for (channel, at_s) in messages {
            let ahead_s = if *channel == "status" { 100 } else { 0 };
            let envelope = Envelope {
                published_ns: (at_s + ahead_s) * SECOND,
                ..Envelope::default()
            };
            log.push(channel, envelope, &[]);
        }
        log.set_clocks_differ();
        log
    }

    #[test]
    fn messages_before_the_exchanges_count_and_say_what_they_take_for_granted() {
        let mut log = log(&[("command", 2), ("status", 2), ("status", 12)]);
        assert_eq!(bring(&mut log, &clocks(), "command", &host_of), None);
        assert!(log.has_one_clock());
        let at_ns = log.raw("status").first().unwrap().envelope.published_ns;
        assert!(at_ns.abs_diff(2 * SECOND) <= log.clock_bound_ns());
        // Eight seconds of 200 ppm.
        assert!(log.clock_bound_ns() >= 1_600_000);
        let words = log.clock_words(None);
        assert!(words.contains("the widest, of status, "), "{words}");
        assert!(words.contains("without them"), "{words}");
    }

    #[test]
    fn every_score_that_stays_on_two_clocks_says_why() {
        for (messages, score_clock, expected) in [
            (
                vec![("status", 60)],
                "command",
                "more than 1 s after the last",
            ),
            (vec![("status", 12)], "cart", "its clock is that of cart"),
            (
                vec![("cart", 12)],
                "command",
                "the records have messages of cart",
            ),
        ] {
            let mut log = log(&messages);
            let why = bring(&mut log, &clocks(), score_clock, &host_of).unwrap();
            assert!(why.contains(expected), "{why}");
            assert!(!log.has_one_clock());
        }
    }
}
