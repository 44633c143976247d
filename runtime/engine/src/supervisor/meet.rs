//! Bringing the hosts of a run together: the first host of the topology listens, the others connect
//! to it, and both ends check that they fit. What they say to each other afterwards is not here.

use std::net::{IpAddr, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use std::{io, thread};

use socket2::{Domain, Socket, Type};

use super::control_listener::{
    Admission, ControlListener, KEY_NEEDED, Newcomer, knock, read_hello, say,
};
use super::frame::{PeerHello, PeerMessage};
use super::peer::{ControlHalves, Peer};
use super::reconnect::{Readmission, Reconnect, lock};
use super::strangers::{Cause, Strangers};
use crate::security::PreSharedKey;
use crate::security::greeting::{GreetingError, Why};
use hil_rundir::pipe::FailureKind;

/// How often a host that cannot connect yet tries again.
const RETRY_PERIOD: Duration = Duration::from_millis(200);
/// How often the caller is told whom the host waits for, and may end the waiting.
const TELL_PERIOD: Duration = Duration::from_millis(200);

/// Why the hosts of a run did not come together.
#[derive(Debug, thiserror::Error)]
pub enum PeerError {
    /// A peer did not appear in time.
    #[error(
        "{missing} did not appear within {waited_s} s; is the same topology started there, and is TCP {address} reachable?{}",
        strangers.as_ref().map_or_else(String::new, |words| format!(" {words}"))
    )]
    Absent {
        /// Host names.
        missing: String,
        /// How long was waited.
        waited_s: u64,
        /// Where the hosts meet.
        address: SocketAddr,
        /// Who else came, or answered in their place, in words.
        strangers: Option<String>,
    },
    /// The meeting address cannot be used.
    #[error(
        "cannot listen on {address}: {source}; is it this host's address, and is no other run using control_port?"
    )]
    Listen {
        /// Where the hosts meet.
        address: SocketAddr,
        /// What the system said.
        source: io::Error,
    },
    /// This host's address cannot be used.
    #[error("cannot connect from {own}: {source}; is it this host's address?")]
    Own {
        /// The address that the topology gives this host.
        own: IpAddr,
        /// What the system said.
        source: io::Error,
    },
    /// The ends do not fit.
    #[error("{host} does not fit this run: {reason}")]
    Mismatch {
        /// The other host.
        host: String,
        /// Which property differs.
        reason: String,
    },
    /// The user ended the run while waiting.
    #[error("interrupted while waiting for {missing}")]
    Interrupted {
        /// Host names.
        missing: String,
    },
}

/// Where the hosts of a run meet.
#[derive(Debug, Clone)]
pub(crate) struct Meeting {
    /// Address of the first host of the topology.
    pub(crate) address: SocketAddr,
    /// True on that first host.
    pub(crate) is_here: bool,
    /// This host's own address, by which the first host knows it.
    pub(crate) own: IpAddr,
    /// Names and addresses of the other hosts this one connects with.
    pub(crate) expected: Vec<(String, IpAddr)>,
    /// How long to wait for all of them.
    pub(crate) timeout: Duration,
    /// How long a host that was met may be away.
    pub(crate) peer_timeout: Duration,
    /// The key they all hold; `None` when the topology says that hops are plain.
    pub(crate) key: Option<PreSharedKey>,
}

impl Meeting {
    /// Whom the first host lets in.
    pub(super) fn admission(&self, own: &str) -> Admission {
        Admission {
            own: own.to_owned(),
            expected: self.expected.clone(),
            key: self.key.clone(),
        }
    }

    /// Who is at `ip` by the topology.
    fn name_of(&self, ip: IpAddr) -> String {
        let mut expected = self.expected.iter();
        let known = expected.find(|(_, address)| *address == ip);
        known.map_or_else(|| ip.to_string(), |(name, _)| format!("{name} ({ip})"))
    }

    /// Who is not among `peers`.
    fn missing(&self, peers: &[Peer]) -> String {
        let names = self.expected.iter().map(|(name, _)| name.as_str());
        let missing = names.filter(|name| peers.iter().all(|peer| peer.hello.host != *name));
        missing.collect::<Vec<_>>().join(", ")
    }
}

/// The hosts of a run that met.
#[derive(Debug)]
pub(crate) struct Met {
    /// All that were awaited.
    pub(crate) peers: Vec<Peer>,
    /// Connections that were refused, in words.
    pub(crate) strangers: Option<String>,
}

/// What a host that waits for the others has to say.
#[derive(Debug)]
pub(crate) enum Waiting<'a> {
    /// Whom it waits for, and for how long already: a few times a second.
    For {
        missing: &'a str,
        waited: Duration,
        /// Connections that came to nothing so far, in words.
        strangers: Option<String>,
    },
    /// That it cannot take or make a connection for want of descriptors, threads or memory, and goes on
    /// trying: once.
    ShortOf(&'a io::Error),
}

/// Brings the hosts of a run together. What `waiting` returns after [`Waiting::For`] says whether to go on.
///
/// # Errors
/// See [`PeerError`].
pub(crate) fn meet(
    meeting: &Meeting,
    hello: &PeerHello,
    waiting: &mut dyn FnMut(&Waiting<'_>) -> bool,
) -> Result<Met, PeerError> {
    let mut patience = Patience {
        meeting,
        waiting,
        began: Instant::now(),
        told: None,
        strangers: Strangers::default(),
        is_short: false,
    };
    let peers = if meeting.is_here {
        host(meeting, hello, &mut patience)
    } else {
        join(meeting, hello, &mut patience)
    }?;
    let strangers = patience.strangers();
    Ok(Met { peers, strangers })
}

struct Patience<'a> {
    meeting: &'a Meeting,
    waiting: &'a mut dyn FnMut(&Waiting<'_>) -> bool,
    began: Instant,
    told: Option<Instant>,
    /// Those who did not prove the key. They end no waiting: whoever takes a host's address could end a
    /// run so, and the right one may still come.
    strangers: Strangers,
    /// It was said that this host is short of something.
    is_short: bool,
}

impl Patience<'_> {
    fn strangers(&self) -> Option<String> {
        self.strangers.words(|ip| self.meeting.name_of(ip))
    }

    /// Says once what this host is short of. It ends no waiting: others may give it back.
    fn note_shortage(&mut self, error: &io::Error) {
        if !self.is_short {
            self.is_short = true;
            let _goes_on = (self.waiting)(&Waiting::ShortOf(error));
        }
    }

    /// Waits a moment for `missing`, or says why not. True a few times a second.
    fn wait(&mut self, missing: &str) -> Result<bool, PeerError> {
        let waited = self.began.elapsed();
        if waited > self.meeting.timeout {
            return Err(PeerError::Absent {
                strangers: self.strangers(),
                missing: missing.to_owned(),
                waited_s: waited.as_secs(),
                address: self.meeting.address,
            });
        }
        let is_time = self.told.is_none_or(|told| told.elapsed() >= TELL_PERIOD);
        if is_time {
            self.told = Some(Instant::now());
            let missing_now = Waiting::For {
                missing,
                waited,
                strangers: self.strangers(),
            };
            if !(self.waiting)(&missing_now) {
                return Err(PeerError::Interrupted {
                    missing: missing.to_owned(),
                });
            }
        }
        thread::sleep(Duration::from_millis(20));
        Ok(is_time)
    }
}

fn host(
    meeting: &Meeting,
    hello: &PeerHello,
    patience: &mut Patience<'_>,
) -> Result<Vec<Peer>, PeerError> {
    let address = meeting.address;
    let listen = |source| PeerError::Listen { address, source };
    let admission = meeting.admission(&hello.host);
    let mut control_listener = ControlListener::open(address, admission).map_err(listen)?;
    let readmission = Arc::new(Mutex::new(Readmission::default()));
    let mut peers: Vec<Peer> = Vec::new();
    loop {
        let admitted = control_listener.admit_waiting(&mut patience.strangers);
        if let Some(shortage) = admitted.map_err(listen)? {
            patience.note_shortage(&shortage);
        }
        while let Some(newcomer) = control_listener.look(&mut patience.strangers) {
            if newcomer.hello.resumed.is_some() {
                lock(&readmission).take(newcomer, hello);
            } else if let Some(peer) = welcome(newcomer, hello, &readmission, patience)? {
                // One that gave up and came again: nobody waits for its first connection.
                peers.retain_mut(|known| {
                    let is_other = known.hello.host != peer.hello.host;
                    if !is_other {
                        known.hang_up();
                    }
                    is_other
                });
                peers.push(peer);
            }
        }
        if peers.len() == meeting.expected.len() {
            return Ok(peers);
        }
        // Whatever came: strangers must not keep this host from its deadline and its signals.
        let missing = meeting.missing(&peers);
        if patience.wait(&missing)? {
            // Those that are here must not take the waiting for an absence.
            for peer in &mut peers {
                peer.say(&PeerMessage::Alive);
            }
        }
    }
}

/// Greets one that said who it is; `None` when it has to come again.
fn welcome(
    newcomer: Newcomer,
    hello: &PeerHello,
    readmission: &Arc<Mutex<Readmission>>,
    patience: &mut Patience<'_>,
) -> Result<Option<Peer>, PeerError> {
    let Newcomer {
        mut ends,
        hello: theirs,
    } = newcomer;
    if let Some(reason) = misfit(hello, &theirs) {
        let _left = say(&mut ends, &PeerMessage::Refused(reason.clone())).is_err();
        return Err(PeerError::Mismatch {
            host: theirs.host,
            reason,
        });
    }
    let reconnect = Reconnect {
        meeting: patience.meeting.clone(),
        own: hello.clone(),
        theirs,
        readmission: Arc::clone(readmission),
    };
    let mut peer = match Peer::new(ends, reconnect) {
        Ok(peer) => peer,
        // It was not answered, so it comes again.
        Err(error) => {
            patience.note_shortage(&error);
            return Ok(None);
        }
    };
    // One that is gone again by now comes back.
    peer.say(&PeerMessage::Hello(hello.clone()));
    Ok(Some(peer))
}

fn join(
    meeting: &Meeting,
    hello: &PeerHello,
    patience: &mut Patience<'_>,
) -> Result<Vec<Peer>, PeerError> {
    let first = meeting.expected.first();
    let name = first.map_or("the first host", |(name, _)| name).to_owned();
    let there = meeting.address.ip();
    loop {
        let stream = match connect(meeting) {
            Ok(Ok(stream)) => stream,
            Ok(Err(_nobody_there)) => {
                patience.wait(&name)?;
                continue;
            }
            Err(PeerError::Own { source, .. })
                if FailureKind::of(&source) == FailureKind::HostTooSmall =>
            {
                patience.note_shortage(&source);
                patience.wait(&name)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        match greet(stream, hello, &name, meeting.key.as_ref()) {
            Ok((ends, PeerMessage::Hello(theirs))) => {
                if let Some(reason) = misfit(hello, &theirs) {
                    return Err(PeerError::Mismatch {
                        host: theirs.host,
                        reason,
                    });
                }
                let reconnect = Reconnect {
                    meeting: meeting.clone(),
                    own: hello.clone(),
                    theirs,
                    readmission: Arc::default(),
                };
                match Peer::new(ends, reconnect) {
                    Ok(peer) => return Ok(vec![peer]),
                    Err(error) => patience.note_shortage(&error),
                }
            }
            // Only a host without a key hears it, and from one that has proven nothing.
            Ok((_, PeerMessage::Refused(reason))) if reason == KEY_NEEDED => {
                patience.strangers.note(there, Cause::SaysKeyNeeded);
            }
            Ok((_, PeerMessage::Refused(reason))) => {
                return Err(PeerError::Mismatch { host: name, reason });
            }
            Err(GreetingError::Refused(why)) => {
                let cause = match why {
                    Why::AnotherKey => Cause::SaysAnotherKey,
                    Why::PlainHere => Cause::SaysPlain,
                };
                patience.strangers.note(there, cause);
            }
            // Somebody else's service, or a peer that is just going away.
            Ok(_) | Err(GreetingError::Connection(_)) => {
                patience.strangers.note(there, Cause::SaysNothing);
            }
        }
        patience.wait(&name)?;
    }
}

/// What the first host answers to this one's name.
pub(super) fn greet(
    stream: TcpStream,
    hello: &PeerHello,
    other: &str,
    key: Option<&PreSharedKey>,
) -> Result<(ControlHalves, PeerMessage), GreetingError> {
    let mut ends = knock(stream, &hello.host, other, key)?;
    say(&mut ends, &PeerMessage::Hello(hello.clone()))?;
    let answer = read_hello(&mut ends)?;
    Ok((ends, answer))
}

/// One attempt to reach the first host, from this host's own address: the kernel would choose the
/// sender's address by the route, and the first host turns strangers away.
pub(super) fn connect(meeting: &Meeting) -> Result<io::Result<TcpStream>, PeerError> {
    let own = meeting.own;
    let prepare = || {
        let domain = Domain::for_address(meeting.address);
        let socket = Socket::new(domain, Type::STREAM, None)?;
        socket.bind(&SocketAddr::new(own, 0).into())?;
        Ok(socket)
    };
    let socket = prepare().map_err(|source| PeerError::Own { own, source })?;
    let connected = socket.connect_timeout(&meeting.address.into(), RETRY_PERIOD);
    Ok(connected.map(|()| socket.into()))
}

/// Why two hosts cannot share a run.
fn misfit(ours: &PeerHello, theirs: &PeerHello) -> Option<String> {
    let (our_name, their_name) = (&ours.host, &theirs.host);
    if ours.version != theirs.version {
        return Some(format!(
            "version {} on {our_name}, {} on {their_name}; install the same on both",
            ours.version, theirs.version
        ));
    }
    if ours.topology_hash != theirs.topology_hash {
        return Some(format!(
            "topology {:016x} on {our_name}, {:016x} on {their_name}; use the same file and the \
             same --set on both (--check prints what a file comes to)",
            ours.topology_hash, theirs.topology_hash
        ));
    }
    (ours.domain == theirs.domain).then(|| {
        format!(
            "{} and {} share one shared-memory domain, so messages would bypass the network; \
             give each host its own /dev/shm and run folder",
            ours.host, theirs.host
        )
    })
}

#[cfg(test)]
#[path = "meet_tests.rs"]
mod tests;
