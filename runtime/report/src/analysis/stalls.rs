//! Processes that were held up as the run ended: stopped, or left without a processor. Nobody saw
//! them die, and no later message shows that they passed an earlier one over, so without this what
//! waited for them would count as vanished. It looks at the last sign of life in the records.

use hil_account::{FLIGHT_TIME_MAX, Interruption, PathProcess};
use hil_core::record::{IngressRecord, PublishedRecord, UNAVAILABLE};
use hil_core::time::{Instant, duration_ns};

use super::channel_files::all;
use super::records::RunRecords;
use hil_rundir::run_result::RunResult;
use hil_topology::{Channel, gateway_name};

/// Those on the way of `channel` that had something to take and left no record from before it came
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
    if let Some(consumer) = channel.to.as_deref()
        && let Some(host) = host_of(consumer)
        && files.taken.is_some()
    {
        let forwarded = || {
            let records = all::<IngressRecord>(files.ingress.as_ref());
            records.map(|record| record.forwarded_ns)
        };
        let stall = Stall {
            process: consumer.to_owned(),
            place: PathProcess::Consumer,
            last_sign_ns: component_sign(records, consumer),
        };
        found.extend(if is_crossing {
            stall.interruption(result, host, &mut forwarded())
        } else {
            stall.interruption(result, host, &mut published())
        });
    }
    found
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
        let until_ns = end.as_ns().saturating_sub(duration_ns(FLIGHT_TIME_MAX));
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
