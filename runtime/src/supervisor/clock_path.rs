//! What a host starts for its clock paths: gateways without messages, one for each other host. How
//! clocks are exchanged is in the gateway, what comes of it in the analysis.

use std::time::Duration;

use super::plan::{ProcessKind, ProcessPlan};
use crate::process::launch::{DirectionLaunch, Side, SocketLaunch, Transport};
use crate::realtime::RealtimeRequest;
use crate::topology::{ClockPath, Host, OnExit, Timestamps, Topology};
use crate::wait::WaitMode;

/// Name of the message type that a clock path announces and never sends.
const MESSAGE: &str = "hil.ClockPath.v1";
/// Buffer asked of the kernel in each direction: a second of exchanges, with room.
const BUFFER_BYTES: usize = 212_992;
/// What every host must accept (RFC 791) holds a greeting with names of any length there may be.
const PATH_MTU_BYTES: usize = 576;
/// How often one end is started again in a run.
const RESTART_LIMIT: u32 = 3;
/// How long a run waits for the first exchanges; it begins without them rather than not at all.
const READY_WITHIN_MAX: Duration = Duration::from_secs(2);

/// Name of the process at the end of `path` on `host`.
pub(crate) fn process_name(path: &ClockPath<'_>, host: &str) -> String {
    let other = if path.from.name == host {
        &path.to.name
    } else {
        &path.from.name
    };
    format!("clock-{other}-{host}")
}

/// The ends of clock paths on `host`.
pub(super) fn on<'a>(
    topology: &'a Topology,
    host: &'a Host,
) -> impl Iterator<Item = ProcessPlan> + use<'a> {
    let start_timeout = topology.run().start_timeout;
    topology.clock_paths().filter_map(move |path| {
        let side = if path.from.name == host.name {
            Side::Egress
        } else if path.to.name == host.name {
            Side::Ingress
        } else {
            return None;
        };
        Some(ProcessPlan {
            name: process_name(&path, &host.name),
            host: host.name.clone(),
            kind: ProcessKind::ClockPath {
                directions: vec![direction(&path, host, side)],
                ready_within: READY_WITHIN_MAX.min(start_timeout / 2),
            },
            realtime: RealtimeRequest::default(),
            wait: WaitMode::Block,
            on_exit: OnExit::Restart {
                limit: RESTART_LIMIT,
            },
        })
    })
}

/// One end, as a channel of empty messages that nobody sends: what it takes from a channel is the
/// greeting, the clock exchanges and the farewell.
fn direction(path: &ClockPath<'_>, host: &Host, side: Side) -> DirectionLaunch {
    let (local, peer) = match side {
        Side::Egress => (path.asking, path.answering),
        Side::Ingress => (path.answering, path.asking),
    };
    DirectionLaunch {
        channel: path.name(),
        channel_id: path.channel_id(),
        message: MESSAGE.to_owned(),
        size_bytes: 0,
        alignment_bytes: 1,
        depth: 0,
        side,
        local,
        peer,
        socket: SocketLaunch {
            transport: Transport::Udp,
            interface: host.clock.as_ref().and_then(|end| end.interface.clone()),
            dscp: 0,
            priority: None,
            send_buffer_bytes: BUFFER_BYTES,
            receive_buffer_bytes: BUFFER_BYTES,
            path_mtu_bytes: PATH_MTU_BYTES,
            timestamps: Timestamps::Software,
        },
        wait: WaitMode::Block,
        realtime: RealtimeRequest::default(),
        // The path is not part of what is emulated.
        emulation: None,
        is_clock_path: true,
    }
}
