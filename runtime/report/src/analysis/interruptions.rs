//! The times in which a process on a channel's way was not there: noted by the supervisor that started
//! it again, and for a receiving gateway until messages reach it.

use std::time::Duration;

use hil_account::{Interruption, PathProcess};
use hil_core::record::{IngressRecord, UNAVAILABLE};
use hil_core::time::{Instant, duration_ns};

use super::channel_files::{ChannelFiles, all};
use super::records::RunRecords;
use hil_topology::{Channel, gateway_name};

/// Longest time after a receiving gateway is back in which a loss is still put down to its start. Its
/// sender learns of that by an answer of its kernel (ICMP), or where none comes by clock exchanges that
/// stay unanswered, four at one in 100 ms, and then agrees on new keys: half a second, and some room for hosts
/// that are late. What is lost after it, the network lost.
const RECOVERY_MAX: Duration = Duration::from_secs(2);

/// Those of processes on the way of `channel`.
pub(super) fn noted(records: &RunRecords<'_>, channel: &Channel) -> Vec<Interruption> {
    let (topology, result) = (records.topology, records.result);
    let gateway = |process: &str| {
        let host = &topology.process(process)?.host;
        Some(gateway_name(channel.link.as_deref()?, host))
    };
    let places = [
        (Some(channel.from.clone()), PathProcess::Producer),
        (gateway(&channel.from), PathProcess::SendingGateway),
        (
            channel.to.as_deref().and_then(gateway),
            PathProcess::ReceivingGateway,
        ),
        (channel.to.clone(), PathProcess::Consumer),
    ];
    let end_of = |host: &str| {
        result
            .spans
            .get(host)
            .map_or(Instant::from_ns(i64::MAX), |span| span.1)
    };
    let mut found = Vec::new();
    for event in &result.events {
        let Some(gap) = event.interruption else {
            continue;
        };
        for (_, place) in places
            .iter()
            .filter(|(name, _)| name.as_ref() == Some(&event.process))
        {
            let until = match gap.until {
                Some(back) if *place == PathProcess::ReceivingGateway => {
                    // It cannot be reached while it is away once more.
                    let others = result
                        .events
                        .iter()
                        .filter(|one| one.process == event.process);
                    let later = others.filter_map(|one| Some(one.interruption?.from));
                    let next = later.filter(|from| *from > gap.from).min();
                    let end = end_of(&event.host);
                    let latest = next.map_or(end, |next| next.min(end));
                    let files = records.channels.get(&channel.name);
                    files.map_or(back, |files| reached(files, event.at, back, latest))
                }
                Some(back) => back,
                None => end_of(&event.host),
            };
            found.push(Interruption {
                process: event.process.clone(),
                place: *place,
                from: gap.from,
                until,
                cause: event.kind.to_string(),
            });
        }
    }
    found
}

/// See [`works_again`]; without the gateway's records, nobody knows what reached it.
fn reached(files: &ChannelFiles, dead: Instant, back: Instant, end: Instant) -> Instant {
    if files.ingress.is_none() {
        return back;
    }
    let messages = all::<IngressRecord>(files.ingress.as_ref());
    // An emulated link holds a message back after it has reached the gateway.
    let messages_ns = messages.map(|one| match one.emulated_ns {
        UNAVAILABLE => one.received_ns,
        taken_ns => taken_ns,
    });
    // So does a clock exchange that it answered reach it, on a channel that speaks seldom.
    let exchanges_ns = files.round_trips.values().map(|one| one.t2_ns);
    works_again(dead, back, end, messages_ns.chain(exchanges_ns))
}

/// When messages reached a gateway that was found dead at `dead` and is `back` since then: at once if some did in
/// between, no later than [`RECOVERY_MAX`] after, and not after `end`.
fn works_again(
    dead: Instant,
    back: Instant,
    end: Instant,
    reached_ns: impl Iterator<Item = i64>,
) -> Instant {
    let of_successor = reached_ns.filter(|at| *at != UNAVAILABLE && *at >= dead.as_ns());
    let latest_ns = back.as_ns().saturating_add(duration_ns(RECOVERY_MAX));
    let latest_ns = latest_ns.min(end.as_ns()).max(back.as_ns());
    let first_ns = of_successor.min().unwrap_or(latest_ns);
    Instant::from_ns(first_ns.clamp(back.as_ns(), latest_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_gateway_works_again_when_messages_reach_it() {
        let at = |ms: i64| Instant::from_ns(ms * MS);
        for (received_ms, end_ms, expected_ms, what) in [
            (
                vec![90, 95, 510, 520],
                9_000,
                510,
                "the first after it died",
            ),
            (
                vec![90, 150, 400],
                9_000,
                160,
                "before it said that it was back",
            ),
            (
                vec![90, 3_000],
                9_000,
                2_160,
                "an outage that is not its own",
            ),
            (vec![90], 9_000, 2_160, "nothing came any more"),
            (vec![], 600, 600, "the run ended before"),
            (vec![], 150, 160, "the run ended while it came back"),
        ] {
            let received = received_ms.iter().map(|ms| ms * MS);
            let received = received.chain([UNAVAILABLE]);
            let until = works_again(at(100), at(160), at(end_ms), received);
            assert_eq!(until, at(expected_ms), "{what}");
        }
    }

    #[test]
    fn without_the_gateways_records_it_is_back_when_its_supervisor_says_so() {
        let times = [100, 160, 9_000].map(|ms| Instant::from_ns(ms * MS));
        let [dead, back, end] = times;
        assert_eq!(reached(&ChannelFiles::default(), dead, back, end), back);
    }
}
