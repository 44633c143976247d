//! What a host starts for its clock paths: gateways without messages, one for each other host. How
//! clocks are exchanged is in the gateway, what comes of it in the analysis.

use std::collections::BTreeMap;
use std::time::Duration;

use hil_transport::registry;

use super::plan::{ProcessPlan, ProcessTask};
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{DirectionLaunch, GatewayWork, Side, SocketLaunch};
use hil_topology::{ClockPath, Host, OnExit, SocketOptions, Topology, clock_process_name};

/// What every host must accept (RFC 791) holds a greeting with names of any length there may be.
const PATH_MTU_BYTES: usize = 576;
/// How often one end is started again in a run.
const RESTART_LIMIT: u32 = 3;
/// How long a run waits for the first exchanges; it begins without them rather than not at all.
const READY_WITHIN_MAX: Duration = Duration::from_secs(2);

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
            name: clock_process_name(&path, &host.name),
            host: host.name.clone(),
            task: ProcessTask::ClockPath(GatewayWork {
                directions: vec![direction(&path, host, side)],
                ready_within: Some(READY_WITHIN_MAX.min(start_timeout / 2)),
            }),
            on_exit: OnExit::Restart {
                limit: RESTART_LIMIT,
            },
        })
    })
}

/// One end, as a flow without channels: what it has of a flow is the greeting, the clock exchanges and the
/// farewell.
fn direction(path: &ClockPath<'_>, host: &Host, side: Side) -> DirectionLaunch {
    let (local, peer) = match side {
        Side::Egress => (path.asking, path.answering),
        Side::Ingress => (path.answering, path.asking),
    };
    DirectionLaunch {
        flow: path.name(),
        flow_number: path.flow_number(),
        side,
        local,
        peer,
        socket: SocketLaunch {
            transport: registry::PLAIN.description().name.to_owned(),
            options: BTreeMap::new(),
            interface: host.clock_interface.clone(),
            common: SocketOptions {
                path_mtu_bytes: PATH_MTU_BYTES,
                ..SocketOptions::TEMPLATE
            },
        },
        wait: WaitMode::Block,
        realtime: RealtimeRequest::default(),
        channels: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use hil_rundir::event::ProcessKind;
    use hil_shuttle::Shuttle;
    use hil_topology::registry::Registry;

    fn topology(overrides: &[&str]) -> Topology {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../deploy/topologies/shuttle-split.toml");
        let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
        hil_topology::load(&path, &overrides, registry.known()).unwrap()
    }

    fn ends(topology: &Topology, host: &str) -> Vec<(String, DirectionLaunch, Duration)> {
        let host = topology.host(host).unwrap();
        let plans = on(topology, host).map(|plan| match plan.task {
            ProcessTask::ClockPath(mut work) => (
                plan.name,
                work.directions.remove(0),
                work.ready_within.unwrap(),
            ),
            other => panic!("{other:?}"),
        });
        plans.collect()
    }

    #[test]
    fn the_two_ends_meet_and_no_emulated_link_is_in_their_way() {
        let topology = topology(&[
            "links.hop.via=\"emulated\"",
            "links.hop.delay=\"5 ms\"",
            "hosts.control-pc.clock_address=\"10.78.0.1\"",
            "hosts.control-pc.clock_interface=\"eth1\"",
            "hosts.robot-pc.clock_address=\"10.78.0.2\"",
            "run.start_timeout=\"3 s\"",
        ]);
        let [(name, asking, patience)] = &ends(&topology, "control-pc")[..] else {
            panic!("one end");
        };
        let [(other_name, answering, _)] = &ends(&topology, "robot-pc")[..] else {
            panic!("one end");
        };
        assert_eq!(name, "clock-robot-pc-control-pc");
        assert_eq!(other_name, "clock-control-pc-robot-pc");
        assert_eq!((asking.side, answering.side), (Side::Egress, Side::Ingress));
        assert_eq!(
            (asking.local, asking.peer),
            (answering.peer, answering.local)
        );
        assert_eq!(asking.local.to_string(), "10.78.0.1:7390");
        assert_eq!(asking.socket.interface.as_deref(), Some("eth1"));
        assert_eq!(answering.socket.interface, None);
        assert_eq!(asking.flow, "clock/control-pc-robot-pc");
        assert_eq!(*patience, Duration::from_millis(1_500));
        for end in [asking, answering] {
            assert!(end.is_clock_path());
            assert_eq!(end.flow_number, u16::MAX);
            assert_eq!(
                end.socket.common.timestamps,
                hil_topology::Timestamps::Software
            );
            assert_eq!(end.wait, WaitMode::Block);
        }
    }

    #[test]
    fn it_is_started_first_and_neither_component_nor_carrier() {
        let topology = topology(&[
            "hosts.control-pc.clock_address=\"10.78.0.1\"",
            "hosts.robot-pc.clock_address=\"10.78.0.2\"",
        ]);
        let host = topology.host("robot-pc").unwrap();
        let plan = super::super::plan::plan(&topology, &[host]);
        let kinds: Vec<ProcessKind> = plan.processes.iter().map(ProcessPlan::kind).collect();
        let expected = [
            ProcessKind::ClockPath,
            ProcessKind::Gateway,
            ProcessKind::Component,
        ];
        assert_eq!(kinds, expected);
        let turns = plan.processes.iter().map(|process| {
            [
                process.is_clock_path(),
                process.is_carrier(),
                process.is_component(),
            ]
        });
        let expected = [
            [true, false, false],
            [false, true, false],
            [false, false, true],
        ];
        assert_eq!(turns.collect::<Vec<_>>(), expected);
    }

    #[test]
    fn without_clock_addresses_there_is_none() {
        assert!(ends(&topology(&[]), "control-pc").is_empty());
    }
}
