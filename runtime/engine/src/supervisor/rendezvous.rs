//! Gathers the hosts of a run: who waits for whom and where, what each says of itself, and the secret
//! that they then share. How connections come about is in `meet.rs`.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use super::domains::Domains;
use super::frame::{Frame, PeerHello, PeerMessage};
use super::meet::{Meeting, Met, PeerError, Waiting, meet};
use super::outcome::RunError;
use super::peer::{Peer, PeerEvent};
use super::session::is_here;
use crate::security::PreSharedKey;
use hil_platform::console::Console;
use hil_platform::signals::Signals;
use hil_rundir::protection::{HopProtection, RunSecurity};
use hil_rundir::run_seal::{RunSeal, has_fast_aes, suite_for};
use hil_shm::clock_id;
use hil_topology::{Host, Topology};

/// How often a host that waits for the secret looks at signals.
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// The other hosts of a run, and what they share.
#[derive(Debug)]
pub(super) struct Gathered {
    pub(super) peers: Vec<Peer>,
    /// `None` when no datagram leaves the host, or hops are plain.
    pub(super) seal: Option<RunSeal>,
    /// How the hops are protected; `None` when all hosts are here.
    pub(super) security: Option<RunSecurity>,
}

/// The key of the topology's hops, if hosts of it are elsewhere and its hops are sealed.
///
/// # Errors
/// When the topology does not say whether its hops are sealed, or the key file cannot be used.
pub(super) fn read_key(
    topology: &Topology,
    hosts: &[&Host],
) -> Result<Option<PreSharedKey>, RunError> {
    if !topology.has_hosts_beside(hosts.len()) {
        return Ok(None);
    }
    if let Some(text) = topology.unsaid_security() {
        return Err(RunError::SecurityUnsaid(text));
    }
    let file = topology.security().key_file();
    let key = file.map(|path| PreSharedKey::read(&path)).transpose();
    key.map_err(RunError::Key)
}

/// Waits for the other hosts.
///
/// # Errors
/// When they do not come, do not fit, or hold another key.
pub(super) fn gather(
    topology: &Topology,
    key: Option<&PreSharedKey>,
    hosts: &[&Host],
    domains: &Domains,
    signals: &Signals,
    console: &mut Console,
) -> Result<Gathered, RunError> {
    let nobody = Gathered {
        peers: Vec::new(),
        seal: None,
        security: None,
    };
    let first = &topology.hosts()[0];
    let Some(address) = first.control_address() else {
        return Ok(nobody);
    };
    if hosts.len() == topology.hosts().len() {
        return Ok(nobody);
    }
    let is_first = is_here(first, hosts);
    let meeting = meeting(topology, key, hosts, address);
    let hello = PeerHello {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        topology_hash: topology.hash(),
        host: hosts[0].name.clone(),
        clock_id: clock_id()?,
        domain: domains.fingerprint()?,
        has_fast_aes: has_fast_aes(),
        resumed: None,
    };
    let Met {
        mut peers,
        strangers,
    } = meet(&meeting, &hello, &mut |waiting| {
        let (missing, waited, strangers) = match waiting {
            Waiting::For {
                missing,
                waited,
                strangers,
            } => (missing, waited, strangers),
            Waiting::ShortOf(error) => {
                console.warn(&format!(
                    "cannot take a connection of another host for now: {error}; going on as soon as there \
                     is room"
                ));
                return true;
            }
        };
        let waited_s = waited.as_secs();
        let role = if is_first {
            "to connect to"
        } else {
            "to answer at"
        };
        let strangers = strangers
            .as_ref()
            .map_or_else(String::new, |words| format!("; {words}"));
        console.progress(&format!(
            "waiting for {missing} {role} {address} ({waited_s} s){strangers}"
        ));
        console.announce_up();
        signals.received().is_none()
    })?;
    let seal = match key {
        None => None,
        Some(_) if is_first => Some(hand_out(&mut peers)?),
        Some(_) => Some(be_handed(&mut peers, meeting.timeout, signals)?),
    };
    let names: Vec<&str> = peers.iter().map(|peer| peer.hello.host.as_str()).collect();
    let hops = protection(key, seal.as_ref());
    console.say(&format!("connected with {}; hops {hops}", names.join(", ")));
    if let Some(strangers) = &strangers {
        console.warn(strangers);
    }
    Ok(Gathered {
        peers,
        seal,
        security: Some(RunSecurity { hops, strangers }),
    })
}

fn protection(key: Option<&PreSharedKey>, seal: Option<&RunSeal>) -> HopProtection {
    match (key, seal) {
        (Some(key), Some(seal)) => HopProtection::Sealed {
            suite: seal.suite().label().to_owned(),
            key_fingerprint: key.fingerprint(),
        },
        _ => HopProtection::Plain,
    }
}

fn meeting(
    topology: &Topology,
    key: Option<&PreSharedKey>,
    hosts: &[&Host],
    address: SocketAddr,
) -> Meeting {
    let first = &topology.hosts()[0];
    let is_first = is_here(first, hosts);
    let others = topology.hosts().iter().filter(|host| !is_here(host, hosts));
    let expected = others
        .filter(|host| is_first || host.name == first.name)
        .map(|host| (host.name.clone(), host.gateway_address()))
        .collect();
    Meeting {
        address,
        is_here: is_first,
        own: hosts[0].gateway_address(),
        expected,
        timeout: topology.run().start_timeout,
        peer_timeout: topology.run().peer_timeout,
        key: key.cloned(),
    }
}

/// Draws the run's secret and gives it to every host.
fn hand_out(peers: &mut [Peer]) -> Result<RunSeal, RunError> {
    let all_are_fast = has_fast_aes() && peers.iter().all(|peer| peer.hello.has_fast_aes);
    let seal = RunSeal::fresh(suite_for(all_are_fast)).map_err(RunError::Random)?;
    for peer in peers {
        // One that has left by now is noticed by the session.
        peer.say(&PeerMessage::Seal(seal.clone()));
    }
    Ok(seal)
}

/// Waits for the run's secret, which the first host gives once all hosts are there.
fn be_handed(
    peers: &mut [Peer],
    timeout: Duration,
    signals: &Signals,
) -> Result<RunSeal, RunError> {
    let deadline = Instant::now() + timeout;
    let Some(first) = peers.first_mut() else {
        return Err(RunError::SecretMissing("no first host".to_owned()));
    };
    let host = first.hello.host.clone();
    loop {
        match first.receive(LOOK_PERIOD) {
            Some(PeerEvent::Frame(Frame::Message(PeerMessage::Seal(seal)))) => return Ok(seal),
            Some(PeerEvent::Closed(reason)) => {
                return Err(RunError::SecretMissing(format!("{host}: {reason}")));
            }
            // That others are still awaited.
            Some(PeerEvent::Frame(_)) | None => {}
        }
        if signals.received().is_some() {
            return Err(PeerError::Interrupted { missing: host }.into());
        }
        if Instant::now() > deadline {
            let waited_s = timeout.as_secs();
            let text = format!("{host} has not met all hosts within {waited_s} s");
            return Err(RunError::SecretMissing(text));
        }
    }
}
