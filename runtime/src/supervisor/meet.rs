//! Bringing the hosts of a run together: the first host of the topology listens, the others connect
//! to it, and both ends check that they fit. What they say to each other afterwards is not here.

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use socket2::{Domain, Socket, Type};

use super::frame::{Frame, PeerHello, PeerMessage, read_frame, write_message};
use super::peer::Peer;

/// How often a host that cannot connect yet tries again.
const RETRY_PERIOD: Duration = Duration::from_millis(200);
/// How often the caller is told whom the host waits for, and may end the waiting.
const TELL_PERIOD: Duration = Duration::from_millis(200);
const GREETING_TIMEOUT: Duration = Duration::from_secs(3);

/// Why the hosts of a run did not come together.
#[derive(Debug, thiserror::Error)]
pub enum PeerError {
    /// A peer did not appear in time.
    #[error(
        "{missing} did not appear within {waited_s} s; is the same topology started there, and is TCP {address} reachable?"
    )]
    Absent {
        /// Host names.
        missing: String,
        /// How long was waited.
        waited_s: u64,
        /// Where the hosts meet.
        address: SocketAddr,
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
    /// The connection broke.
    #[error("connection to {host}: {source}")]
    Connection {
        /// The other host.
        host: String,
        /// What the system said.
        source: io::Error,
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
}

/// Brings the hosts of a run together. `waiting` is told whom it waits for, a few times a second;
/// it returns false to give up.
///
/// # Errors
/// See [`PeerError`].
pub(crate) fn meet(
    meeting: &Meeting,
    hello: &PeerHello,
    waiting: &mut dyn FnMut(&str, Duration) -> bool,
) -> Result<Vec<Peer>, PeerError> {
    let mut patience = Patience {
        meeting,
        waiting,
        began: Instant::now(),
        told: None,
    };
    if meeting.is_here {
        host(meeting, hello, &mut patience)
    } else {
        join(meeting, hello, &mut patience)
    }
}

struct Patience<'a> {
    meeting: &'a Meeting,
    waiting: &'a mut dyn FnMut(&str, Duration) -> bool,
    began: Instant,
    told: Option<Instant>,
}

impl Patience<'_> {
    /// Waits a moment for `missing`, or says why not. True a few times a second.
    fn wait(&mut self, missing: &str) -> Result<bool, PeerError> {
        let waited = self.began.elapsed();
        if waited > self.meeting.timeout {
            return Err(PeerError::Absent {
                missing: missing.to_owned(),
                waited_s: waited.as_secs(),
                address: self.meeting.address,
            });
        }
        let is_time = self.told.is_none_or(|told| told.elapsed() >= TELL_PERIOD);
        if is_time {
            self.told = Some(Instant::now());
            if !(self.waiting)(missing, waited) {
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
    let listener = TcpListener::bind(address).map_err(listen)?;
    listener.set_nonblocking(true).map_err(listen)?;
    let mut peers: Vec<Peer> = Vec::new();
    while peers.len() < meeting.expected.len() {
        let missing: Vec<&str> = meeting
            .expected
            .iter()
            .map(|(name, _)| name.as_str())
            .filter(|name| peers.iter().all(|peer| peer.hello.host != *name))
            .collect();
        let missing = missing.join(", ");
        match listener.accept() {
            // Strangers are turned away before a byte of theirs is read.
            Ok((stream, from)) if meeting.expected.iter().any(|(_, ip)| *ip == from.ip()) => {
                if let Some(peer) = welcome(stream, &meeting.expected, hello)? {
                    // One that gave up and came again: its first connection is a dead one.
                    peers.retain(|known| known.hello.host != peer.hello.host);
                    peers.push(peer);
                }
            }
            Ok(_stranger) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                if patience.wait(&missing)? {
                    // Those that are here must not take the waiting for an absence.
                    for peer in &mut peers {
                        peer.say(&PeerMessage::Alive);
                    }
                }
            }
            Err(source) => return Err(listen(source)),
        }
    }
    Ok(peers)
}

/// Greets one that connected; `None` when it left before it had said who it is, or is nobody of
/// this run.
fn welcome(
    stream: TcpStream,
    expected: &[(String, IpAddr)],
    hello: &PeerHello,
) -> Result<Option<Peer>, PeerError> {
    let Ok((mut stream, PeerMessage::Hello(theirs))) = read_hello(stream) else {
        return Ok(None);
    };
    if !expected.iter().any(|(name, _)| *name == theirs.host) {
        let text = format!("host {} is not awaited here", theirs.host);
        let _left = write_message(&mut stream, &PeerMessage::Refused(text)).is_err();
        return Ok(None);
    }
    let reason = misfit(hello, &theirs);
    let connection = |source| PeerError::Connection {
        host: theirs.host.clone(),
        source,
    };
    if let Some(reason) = reason {
        write_message(&mut stream, &PeerMessage::Refused(reason.clone())).map_err(connection)?;
        return Err(PeerError::Mismatch {
            host: theirs.host,
            reason,
        });
    }
    write_message(&mut stream, &PeerMessage::Hello(hello.clone())).map_err(connection)?;
    Peer::new(stream, theirs.clone())
        .map(Some)
        .map_err(connection)
}

fn join(
    meeting: &Meeting,
    hello: &PeerHello,
    patience: &mut Patience<'_>,
) -> Result<Vec<Peer>, PeerError> {
    let name = meeting
        .expected
        .first()
        .map_or("the first host", |(name, _)| name)
        .to_owned();
    let connection = |source| PeerError::Connection {
        host: name.clone(),
        source,
    };
    loop {
        let Ok(mut stream) = connect(meeting)? else {
            patience.wait(&name)?;
            continue;
        };
        let answer = write_message(&mut stream, &PeerMessage::Hello(hello.clone()))
            .and_then(|()| read_hello(stream));
        match answer {
            Ok((stream, PeerMessage::Hello(theirs))) => {
                if let Some(reason) = misfit(hello, &theirs) {
                    return Err(PeerError::Mismatch {
                        host: theirs.host,
                        reason,
                    });
                }
                return Ok(vec![Peer::new(stream, theirs).map_err(connection)?]);
            }
            Ok((_, PeerMessage::Refused(reason))) => {
                return Err(PeerError::Mismatch { host: name, reason });
            }
            // Somebody else's service, or a peer that is just going away.
            Ok(_) | Err(_) => {
                patience.wait(&name)?;
            }
        }
    }
}

/// One attempt to reach the first host, from this host's own address: the kernel would choose the
/// sender's address by the route, and the first host turns strangers away.
fn connect(meeting: &Meeting) -> Result<io::Result<TcpStream>, PeerError> {
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

fn read_hello(stream: TcpStream) -> io::Result<(TcpStream, PeerMessage)> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(GREETING_TIMEOUT))?;
    stream.set_write_timeout(Some(GREETING_TIMEOUT))?;
    let mut input = &stream;
    match read_frame(&mut input)? {
        Frame::Message(message) => Ok((stream, message)),
        Frame::Chunk(_) => Err(io::Error::new(
            io::ErrorKind::InvalidData,
            "a chunk, not a hello",
        )),
    }
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
mod tests {
    use super::*;
    use crate::supervisor::peer::PeerEvent;
    use std::net::Ipv4Addr;

    fn hello(host: &str, hash: u64, domain: u8) -> PeerHello {
        PeerHello {
            version: "1".to_owned(),
            topology_hash: hash,
            host: host.to_owned(),
            clock_id: 1,
            domain: [domain; 16],
        }
    }

    fn pair(left: &PeerHello, right: &PeerHello) -> [Result<Vec<Peer>, PeerError>; 2] {
        let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let address = probe.local_addr().unwrap();
        drop(probe);
        let meeting = |is_here, other: &PeerHello| Meeting {
            address,
            is_here,
            own: address.ip(),
            expected: vec![(other.host.clone(), address.ip())],
            timeout: Duration::from_secs(10),
        };
        let (there, here) = (meeting(false, left), meeting(true, right));
        let right = right.clone();
        let joining = thread::spawn(move || meet(&there, &right, &mut |_, _| true));
        let hosting = meet(&here, left, &mut |_, _| true);
        [hosting, joining.join().unwrap()]
    }

    #[test]
    fn two_hosts_meet_and_talk() {
        let [left, right] = pair(&hello("a", 1, 1), &hello("b", 1, 2));
        let (mut left, mut right) = (left.unwrap(), right.unwrap());
        assert_eq!(left[0].hello.host, "b");
        left[0].say(&PeerMessage::Ready);
        let event = right[0].receive(Duration::from_secs(5));
        assert!(matches!(
            event,
            Some(PeerEvent::Frame(Frame::Message(PeerMessage::Ready)))
        ));
        drop(left);
        let event = right[0].receive(Duration::from_secs(5));
        assert!(matches!(event, Some(PeerEvent::Closed(_))));
    }

    #[test]
    fn another_topology_is_refused_on_both_hosts() {
        let [left, right] = pair(&hello("a", 1, 1), &hello("b", 2, 2));
        for outcome in [left, right] {
            let error = outcome.map(|_| ()).unwrap_err().to_string();
            assert!(error.contains("topology"), "{error}");
        }
    }

    #[test]
    fn another_version_is_refused_on_both_hosts_with_both_versions() {
        let mut newer = hello("b", 1, 2);
        newer.version = "2".to_owned();
        for outcome in pair(&hello("a", 1, 1), &newer) {
            let error = outcome.map(|_| ()).unwrap_err().to_string();
            assert!(error.contains("version"), "{error}");
            assert!(
                error.contains("1 on a") && error.contains("2 on b"),
                "{error}"
            );
        }
    }

    #[test]
    fn one_domain_at_both_ends_is_refused() {
        let [left, _] = pair(&hello("a", 1, 7), &hello("b", 1, 7));
        assert!(
            left.map(|_| ())
                .unwrap_err()
                .to_string()
                .contains("bypass the network")
        );
    }

    #[test]
    fn nobody_there_is_said_with_the_name_and_the_address() {
        let meeting = Meeting {
            address: SocketAddr::from((Ipv4Addr::LOCALHOST, 1)),
            is_here: false,
            own: Ipv4Addr::LOCALHOST.into(),
            expected: vec![("robot-pc".to_owned(), Ipv4Addr::LOCALHOST.into())],
            timeout: Duration::from_millis(1),
        };
        let error = meet(&meeting, &hello("a", 1, 1), &mut |_, _| true)
            .map(|_| ())
            .unwrap_err();
        assert!(
            error.to_string().starts_with("robot-pc did not appear"),
            "{error}"
        );
    }
}
