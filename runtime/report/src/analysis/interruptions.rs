//! The times in which a process on a channel's way was not there: noted by the supervisor that started
//! it again, and for a receiving gateway until messages reach it. Or the process was held up as the run
//! ended: stopped, or left without a processor. Nobody saw it die, and no later message shows that it
//! passed an earlier one over, so without this what waited for it would count as vanished; the last sign
//! of life in the records tells.

use std::time::Duration;

use hil_account::{Interruption, PathProcess, flight_time_max};
use hil_core::record::{IngressRecord, PublishedRecord, RoundTripRecord, TakenRecord, UNAVAILABLE};
use hil_core::time::{Instant, duration_ns};

use super::records::{ChannelFiles, RunRecords, all};
use hil_rundir::launch::WITNESS_LOOK_PERIOD;
use hil_rundir::run_result::RunResult;
use hil_topology::{Channel, Process, gateway_name};

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
    let consumer = channel.to.as_deref();
    let consumer = consumer.and_then(|name| topology.process(name));
    let is_witnessed = consumer.is_some_and(Process::is_witnessed);
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
                    let exchanges = records.exchanges_of(channel);
                    files.map_or(back, |files| {
                        reached(files, exchanges, event.at, back, latest)
                    })
                }
                // A witness beside it saw when it read again.
                Some(back) if *place == PathProcess::Consumer && is_witnessed => {
                    let files = records.channels.get(&channel.name);
                    let taken = files.into_iter().flat_map(|files| {
                        all::<TakenRecord>(files.taken.as_ref()).map(|one| one.taken_ns)
                    });
                    let seen = back + WITNESS_LOOK_PERIOD;
                    let again = taken.filter(|at_ns| *at_ns >= seen.as_ns()).min();
                    again.map_or(end_of(&event.host), Instant::from_ns)
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
fn reached<'a>(
    files: &ChannelFiles,
    exchanges: impl Iterator<Item = &'a RoundTripRecord>,
    dead: Instant,
    back: Instant,
    end: Instant,
) -> Instant {
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
    let exchanges_ns = exchanges.map(|one| one.t2_ns);
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

/// Those of processes on the way of `channel` that had something to take and left no record from before it came
/// until the end of the run.
pub(super) fn at_end(records: &RunRecords<'_>, channel: &Channel) -> Vec<Interruption> {
    let (topology, result) = (records.topology, records.result);
    let mut found = Vec::new();
    let Some(files) = records.channels.get(&channel.name) else {
        return found;
    };
    let published = || {
        let records = all::<PublishedRecord>(files.published.as_ref());
        records.map(|record| record.published_ns)
    };
    let host_of = |process: &str| Some(topology.process(process)?.host.as_str());
    let is_crossing = topology.crossing(channel).is_some();
    if let Some(link) = channel.link.as_deref().filter(|_| is_crossing)
        && let Some(host) = host_of(&channel.from)
        && files.egress.is_some()
    {
        let stall = Stall {
            process: gateway_name(link, host),
            place: PathProcess::SendingGateway,
            last_sign_ns: gateway_sign(records, link, host),
        };
        found.extend(stall.interruption(result, host, &mut published()));
    }
    // What a witness records tells nothing of the consumer beside it.
    let consumer = channel.to.as_deref();
    let consumer = consumer.and_then(|name| topology.process(name));
    if let Some(consumer) = consumer.filter(|one| !one.is_witnessed())
        && files.taken.is_some()
        && !clears_at_end(records, consumer)
    {
        let host = &consumer.host;
        let forwarded = || {
            let records = all::<IngressRecord>(files.ingress.as_ref());
            records.map(|record| record.forwarded_ns)
        };
        let stall = Stall {
            process: consumer.name.clone(),
            place: PathProcess::Consumer,
            last_sign_ns: component_sign(records, &consumer.name),
        };
        found.extend(if is_crossing {
            stall.interruption(result, host, &mut forwarded())
        } else {
            stall.interruption(result, host, &mut published())
        });
    }
    found
}

/// True of a cable that ended in order: what waited for its program was given to it then, and what came after
/// the end of the program was under way at the end of the run.
fn clears_at_end(records: &RunRecords<'_>, process: &Process) -> bool {
    let mut ended = records.result.processes.iter();
    process.inside().is_some() && ended.any(|one| one.name == process.name && one.report.is_some())
}

struct Stall {
    process: String,
    place: PathProcess,
    /// On the clock of its host; `None` when it left no record at all.
    last_sign_ns: Option<i64>,
}

impl Stall {
    /// `came_ns`: when what it should have taken was there for it.
    fn interruption(
        self,
        result: &RunResult,
        host: &str,
        came_ns: &mut dyn Iterator<Item = i64>,
    ) -> Option<Interruption> {
        let (start, end) = *result.spans.get(host)?;
        let from_ns = self.last_sign_ns.unwrap_or(start.as_ns());
        // What came last may be under way at the end of any run.
        let until_ns = end
            .as_ns()
            .saturating_sub(duration_ns(flight_time_max(Duration::ZERO)));
        let mut waited = came_ns.filter(|at_ns| *at_ns != UNAVAILABLE);
        waited.find(|at_ns| (from_ns..until_ns).contains(at_ns))?;
        let from = Instant::from_ns(from_ns);
        let silent_ms = end.ns_since(from) / 1_000_000;
        Some(Interruption {
            process: self.process,
            place: self.place,
            from,
            until: end,
            cause: format!("left no record in the last {silent_ms} ms of the run"),
        })
    }
}

/// When the gateway of this link on this host last took or received a message.
fn gateway_sign(records: &RunRecords<'_>, link: &str, host: &str) -> Option<i64> {
    let topology = records.topology;
    let process = |name: &str| topology.process(name);
    let is_there = |name: &str| process(name).is_some_and(|one| one.host == host);
    let of_link = topology.channels().iter();
    let of_link = of_link.filter(|channel| channel.link.as_deref() == Some(link));
    let signs = of_link.filter_map(|channel| {
        let signs = &records.channels.get(&channel.name)?.signs;
        if is_there(&channel.from) {
            signs.sent_ns
        } else if channel.to.as_deref().is_some_and(is_there) {
            signs.received_ns
        } else {
            None
        }
    });
    signs.max()
}

/// When a component last published or took a message of any channel.
fn component_sign(records: &RunRecords<'_>, process: &str) -> Option<i64> {
    let signs = records.topology.channels().iter().filter_map(|channel| {
        let signs = &records.channels.get(&channel.name)?.signs;
        let published_ns = signs.published_ns.filter(|_| channel.from == process);
        let is_taker = channel.to.as_deref() == Some(process);
        published_ns.max(signs.taken_ns.filter(|_| is_taker))
    });
    signs.max()
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
        assert_eq!(
            reached(
                &ChannelFiles::default(),
                core::iter::empty(),
                dead,
                back,
                end
            ),
            back
        );
    }
}
