//! What processes with an address inside say about each other: one channel each way to another one, and
//! addresses of one network.

use std::net::IpAddr;

use super::checks::Checks;
use super::model::{Channel, Process, Topology};
use super::tree::join;

/// Checks the processes of `topology` that have an address inside.
pub(super) fn check(topology: &Topology, checks: &Checks<'_>) {
    for process in &topology.processes {
        let Some(address) = process.inside() else {
            continue;
        };
        let key = join(&join("processes", &process.name), "inside");
        if let Err(fault) = check_process(topology, process, address) {
            checks.refuse_because(key, fault);
        }
    }
}

fn check_process(topology: &Topology, process: &Process, address: IpAddr) -> Result<(), String> {
    let channels = |is_its: &dyn Fn(&&Channel) -> bool| {
        let channels = topology.channels.iter();
        channels
            .filter(|channel| is_its(channel))
            .collect::<Vec<_>>()
    };
    let name = &process.name;
    let outward = channels(&|channel| channel.from == *name);
    let inward = channels(&|channel| channel.to.as_ref() == Some(name));
    let ([outward], [inward]) = (outward.as_slice(), inward.as_slice()) else {
        let (sent, received) = (outward.len(), inward.len());
        return Err(format!(
            "needs one channel from `{name}` and one to it, and there are {sent} and {received}"
        ));
    };
    let neighbour = |channel: &Channel, end: &str| {
        let process = topology.process(end)?;
        channel.carries_frames().then_some(())?;
        Some((&process.name, process.inside()?))
    };
    let there = neighbour(outward, outward.to.as_deref().unwrap_or_default());
    let back = neighbour(inward, &inward.from);
    let (Some((there, other)), Some((back, _))) = (there, back) else {
        return Err(
            "needs another process with `inside` at the other end of its channels".to_owned(),
        );
    };
    if there != back {
        return Err(format!(
            "has a channel to `{there}` and one from `{back}`: both join one process"
        ));
    }
    if other == address {
        return Err(format!("is {address}, as is that of process `{there}`"));
    }
    let are_neighbours = match (address, other) {
        (IpAddr::V4(one), IpAddr::V4(other)) => one.octets()[..3] == other.octets()[..3],
        (IpAddr::V6(one), IpAddr::V6(other)) => one.segments()[..4] == other.segments()[..4],
        _ => false,
    };
    if are_neighbours {
        Ok(())
    } else {
        Err(format!(
            "is {address} and that of process `{there}` {other}: both are of one network, with the first 24 \
             bits of IPv4 or 64 of IPv6 in common"
        ))
    }
}
