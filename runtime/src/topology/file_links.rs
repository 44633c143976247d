//! What a `[links.<name>]` table says by itself; see `file`.

use hil_models::link::outages::Outages;

use super::errors::{Fault, Place};
use super::file::{read_execution, read_on_exit};
use super::limits;
use super::model::{Execution, OnExit, Scheduling, Wait};
use super::model_links::{Emulation, Gateway, Hop, Impairment, Timestamps, Via};
use super::reader::{At, Reader};

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
    Udp,
    Tcp,
    Emulated,
}

const KINDS: &[(&str, Kind)] = &[
    ("shared-memory", Kind::SharedMemory),
    ("udp", Kind::Udp),
    ("tcp", Kind::Tcp),
    ("emulated", Kind::Emulated),
];

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

/// Keys that only an emulated link has.
const EMULATION_KEYS: &[&str] = &["delay", "loss_ratio", "forward", "backward", "outages"];

impl LinkEntry {
    pub(super) fn read(name: String, mut reader: Reader<'_>) -> Self {
        let kind = reader.word("via", KINDS);
        if !reader.has("via") {
            let words: Vec<_> = KINDS
                .iter()
                .map(|(word, _)| format!("\"{word}\""))
                .collect();
            let hint = format!("write one of {}", words.join(", "));
            reader.refuse("via", Fault::Missing(hint));
        }
        let default = match kind {
            Some(Kind::Tcp) => Timestamps::Off,
            _ => Timestamps::Software,
        };
        let hop = read_hop(&mut reader, default);
        if matches!(kind, Some(Kind::Tcp)) && hop.timestamps != Timestamps::Off {
            let why = "needs via = \"udp\" or \"emulated\": a TCP stream has no messages that \
                       the kernel could stamp; leave it out, or write \"off\"";
            reader.refuse_present(&["timestamps"], why);
        }
        let emulation = read_emulation(&mut reader);
        let via = kind.map(|kind| match kind {
            Kind::SharedMemory => {
                let why = "does not apply to via = \"shared-memory\", which has no gateway";
                reader.refuse_present(HOP_KEYS, why);
                Via::SharedMemory
            }
            Kind::Udp => Via::Udp(hop),
            Kind::Tcp => Via::Tcp(hop),
            Kind::Emulated => Via::Emulated(hop, emulation),
        });
        if matches!(via, Some(Via::SharedMemory | Via::Udp(_) | Via::Tcp(_))) {
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

fn read_hop(reader: &mut Reader<'_>, timestamps: Timestamps) -> Hop {
    Hop {
        port: integer(reader, "port", &limits::LINK_PORT),
        dscp: integer(reader, "dscp", &limits::LINK_DSCP),
        socket_priority: reader.integer("socket_priority", &limits::LINK_SOCKET_PRIORITY),
        send_buffer_bytes: integer(reader, "send_buffer_bytes", &limits::LINK_BUFFER_BYTES),
        receive_buffer_bytes: integer(reader, "receive_buffer_bytes", &limits::LINK_BUFFER_BYTES),
        timestamps: reader
            .word("timestamps", Timestamps::WORDS)
            .unwrap_or(timestamps),
        path_mtu_bytes: integer(reader, "path_mtu_bytes", &limits::LINK_PATH_MTU_BYTES),
        gateway: read_gateway(reader.table("gateway")),
    }
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

fn read_emulation(reader: &mut Reader<'_>) -> Emulation {
    let none = Impairment {
        delay: limits::LINK_DELAY.default,
        loss_ratio: limits::LINK_LOSS_RATIO.default,
    };
    let both = read_impairment(reader, none);
    let mut direction = |key| {
        reader.table(key).map_or(both, |mut reader| {
            let impairment = read_impairment(&mut reader, both);
            reader.finish();
            impairment
        })
    };
    Emulation {
        forward: direction("forward"),
        backward: direction("backward"),
        outages: read_outages(reader.table("outages")),
    }
}

fn read_outages(reader: Option<Reader<'_>>) -> Outages {
    let (mean, per_hour) = (&limits::LINK_OUTAGE_MEAN, &limits::LINK_OUTAGES_PER_HOUR);
    let none = Outages {
        mean_s: mean.default.as_secs_f64(),
        per_hour: per_hour.default,
        buffered: false,
    };
    let Some(mut reader) = reader else {
        return none;
    };
    let read_mean = reader.duration("mean", mean);
    let outages = Outages {
        mean_s: read_mean.map_or(none.mean_s, |mean| mean.as_secs_f64()),
        per_hour: reader.number("per_hour", per_hour).unwrap_or(none.per_hour),
        buffered: reader.boolean("buffered").unwrap_or(none.buffered),
    };
    // Each number is within its own limits by now; what is left is what they say together.
    if let Err(error) = outages.check() {
        reader.refuse("per_hour", Fault::Inconsistent(error.problem));
    }
    reader.finish();
    outages
}

fn read_impairment(reader: &mut Reader<'_>, default: Impairment) -> Impairment {
    Impairment {
        delay: reader
            .duration("delay", &limits::LINK_DELAY)
            .unwrap_or(default.delay),
        loss_ratio: reader
            .number("loss_ratio", &limits::LINK_LOSS_RATIO)
            .unwrap_or(default.loss_ratio),
    }
}
