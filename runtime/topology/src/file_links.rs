//! What a `[links.<name>]` table says by itself; see `file`.

use std::collections::BTreeMap;

use hil_protocol::transport::Description;
use hil_transport::registry::{self, Transport};

use super::errors::{Fault, Place};
use super::file::{read_execution, read_on_exit};
use super::file_impairments::{EMULATION_KEYS, read_emulation};
use super::limits;
use super::model::{Execution, OnExit, Scheduling, Wait};
use super::model_links::{Gateway, Hop, Timestamps, Via};
use super::reader::{At, Reader};
use super::units::format_duration;

#[derive(Debug)]
pub(super) struct LinkEntry {
    pub name: String,
    /// `None` when `via` is missing or faulty.
    pub via: Option<Via>,
    pub between: Option<[At<String>; 2]>,
    pub path: String,
    pub place: Place,
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    SharedMemory,
    Network(&'static Description),
    Emulated,
}

/// Every transport.
fn transports() -> impl Iterator<Item = &'static Description> {
    registry::ALL.into_iter().map(Transport::description)
}

/// The words of `via`.
fn kinds() -> Vec<(&'static str, Kind)> {
    let network = transports().map(|one| (one.name, Kind::Network(one)));
    core::iter::once(("shared-memory", Kind::SharedMemory))
        .chain(network)
        .chain([("emulated", Kind::Emulated)])
        .collect()
}

/// The words of `via` that join two hosts, of the transports that `is_meant`, in a sentence.
pub(super) fn crossing_words(is_meant: impl Fn(&Description) -> bool) -> String {
    let words = transports().filter(|one| is_meant(one));
    let words: Vec<_> = words.map(|one| format!("\"{}\"", one.name)).collect();
    format!("{} or \"emulated\"", words.join(", "))
}

/// Keys that only a link with gateways has.
const HOP_KEYS: &[&str] = &[
    "port",
    "dscp",
    "socket_priority",
    "send_buffer_bytes",
    "receive_buffer_bytes",
    "timestamps",
    "path_mtu_bytes",
    "gateway",
];

impl LinkEntry {
    pub(super) fn read(name: String, mut reader: Reader<'_>) -> Self {
        let kinds = kinds();
        let kind = reader.word("via", &kinds);
        if !reader.has("via") {
            let words: Vec<_> = kinds
                .iter()
                .map(|(word, _)| format!("\"{word}\""))
                .collect();
            let hint = format!("write one of {}", words.join(", "));
            reader.refuse("via", Fault::Missing(hint));
        }
        let hop = read_hop(
            &mut reader,
            match kind {
                Some(Kind::Network(transport)) => transport,
                _ => registry::PLAIN.description(),
            },
        );
        if matches!(kind, Some(Kind::Emulated)) {
            refuse_slack(&reader, &hop.gateway.execution);
        }
        let emulation = read_emulation(&mut reader);
        let via = kind.map(|kind| match kind {
            Kind::SharedMemory => {
                let why = "does not apply to via = \"shared-memory\", which has no gateway";
                reader.refuse_present(HOP_KEYS, why);
                Via::SharedMemory
            }
            Kind::Network(_) => Via::Network(hop),
            Kind::Emulated => Via::Emulated(hop, Box::new(emulation)),
        });
        if matches!(via, Some(Via::SharedMemory | Via::Network(_))) {
            let why = "needs via = \"emulated\": no real link can be told what to do";
            reader.refuse_present(EMULATION_KEYS, why);
        }
        let entry = Self {
            name,
            via,
            between: read_between(&mut reader),
            path: reader.path.clone(),
            place: reader.place,
        };
        reader.finish();
        entry
    }
}

/// An emulated delay ends with a timer, which the kernel may fire later by the slack; real-time
/// threads have none (prctl(2), `PR_SET_TIMERSLACK`).
fn refuse_slack(reader: &Reader<'_>, execution: &Execution) {
    let (slack, most) = (execution.timer_slack, limits::EMULATED_TIMER_SLACK_MAX);
    if slack > most && execution.scheduling == Scheduling::Other {
        let problem = format!(
            "has a timer_slack of \"{}\", by which every delay of the emulated link could be late; \
             at most \"{}\", or scheduling = \"fifo\"",
            format_duration(slack),
            format_duration(most)
        );
        reader.refuse("gateway", Fault::Inconsistent(problem));
    }
}

fn read_between(reader: &mut Reader<'_>) -> Option<[At<String>; 2]> {
    let hosts = reader.texts("between")?;
    match <[At<String>; 2]>::try_from(hosts.value) {
        Ok([first, second]) if first.value != second.value => Some([first, second]),
        _ => {
            let fault = "does not name two different hosts".to_owned();
            reader.refuse("between", Fault::Inconsistent(fault));
            None
        }
    }
}

/// An integer with a default; both fit `T` because `limit` lies within it.
fn integer<T>(reader: &mut Reader<'_>, key: &'static str, limit: &limits::Limit<i64>) -> T
where
    T: TryFrom<i64>,
{
    let default = || T::try_from(limit.default).ok();
    let read = reader.integer(key, limit).or_else(default);
    read.expect("the default of a limit fits the type of its key")
}

fn read_hop(reader: &mut Reader<'_>, transport: &'static Description) -> Hop {
    Hop {
        transport,
        options: read_options(reader, transport),
        port: integer(reader, "port", &limits::LINK_PORT),
        dscp: integer(reader, "dscp", &limits::LINK_DSCP),
        socket_priority: reader.integer("socket_priority", &limits::LINK_SOCKET_PRIORITY),
        send_buffer_bytes: integer(reader, "send_buffer_bytes", &limits::LINK_BUFFER_BYTES),
        receive_buffer_bytes: integer(reader, "receive_buffer_bytes", &limits::LINK_BUFFER_BYTES),
        timestamps: read_timestamps(reader, transport),
        path_mtu_bytes: integer(reader, "path_mtu_bytes", &limits::LINK_PATH_MTU_BYTES),
        gateway: read_gateway(reader.table("gateway")),
    }
}

fn read_timestamps(reader: &mut Reader<'_>, transport: &Description) -> Timestamps {
    let asked = reader.word("timestamps", Timestamps::WORDS);
    let Some(why) = transport.capabilities.unstamped_because else {
        return asked.unwrap_or(Timestamps::Software);
    };
    if asked.is_some_and(|asked| asked != Timestamps::Off) {
        let words = crossing_words(|one| one.capabilities.unstamped_because.is_none());
        let why = format!(
            "needs via = {words}: over {} {why}; leave it out, or write \"off\"",
            transport.label
        );
        reader.refuse_present(&["timestamps"], &why);
    }
    Timestamps::Off
}

/// The keys that only some transports have; a key of another one does not belong here.
fn read_options(reader: &mut Reader<'_>, own: &Description) -> BTreeMap<String, i64> {
    let mut options = BTreeMap::new();
    for transport in transports() {
        for option in transport.options {
            let key = option.key;
            let limit = limits::Limit {
                default: option.default,
                min: option.min,
                max: option.max,
            };
            let value = integer(reader, key, &limit);
            if transport.name == own.name {
                options.insert(key.to_owned(), value);
            } else if own.options.iter().all(|option| option.key != key) {
                let why = format!("needs via = \"{}\"", transport.name);
                reader.refuse_present(&[key], &why);
            }
        }
    }
    options
}

/// A gateway that ended is started again by default: it holds no state of the robot, its new
/// session number shows the gap, and the messages lost meanwhile are counted.
fn read_gateway(reader: Option<Reader<'_>>) -> Gateway {
    let Some(mut reader) = reader else {
        let limit = u32::try_from(limits::RESTART_LIMIT.default);
        return Gateway {
            execution: Execution {
                cpus: Vec::new(),
                scheduling: Scheduling::Other,
                locks_memory: false,
                timer_slack: limits::TIMER_SLACK.default,
                wait: Wait::Block,
            },
            on_exit: OnExit::Restart {
                limit: limit.expect("a default count is not negative"),
            },
        };
    };
    let gateway = Gateway {
        execution: read_execution(&mut reader),
        on_exit: read_on_exit(&mut reader, "restart"),
    };
    reader.finish();
    gateway
}
