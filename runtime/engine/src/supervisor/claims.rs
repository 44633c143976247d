//! What a run has for itself alone on a host: ports, the settings of a network card, and its place among
//! the hosts that meet. Claimed before anything else is done, so that a second run that needs one of them
//! is refused before it disturbs the first.
//!
//! A claim is a listening socket of the abstract Unix namespace: of one network namespace, as ports and
//! cards are, and freed by the kernel with its process however that ends. Its name says what is claimed
//! behind a number drawn at random, so that nobody can take it beforehand. Whoever connects learns from the
//! kernel whose it is, and reads the run's folder. Shared memory has the lock on its folder instead
//! (`hil_shm::Domain`), which is of one mount namespace as that is.

use core::fmt;
use core::str::FromStr;
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr};
use std::os::fd::{AsFd, AsRawFd};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{self, UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use hil_core::message::{FNV_OFFSET, fnv1a};
use hil_nic::nic_clock::card_of;
use hil_platform::random::random_bytes;
use hil_platform::text::visible;
use hil_protocol::transport::IpProtocol;
use hil_topology::{Topology, collide, control_key};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{
    AddressFamily, SockFlag, SockType, UnixAddr, UnixCredentials, connect, getsockopt, socket,
    sockopt,
};
use nix::unistd::Uid;

/// What the names of all claims begin with.
const PREFIX: &str = "hil-claim";
/// The kernel's list of Unix sockets of this network namespace.
const SOCKETS: &str = "/proc/net/unix";
/// Two runs that begin in one moment see each other: both take their claims back and try again.
const ATTEMPTS: u32 = 3;
/// Bound of the time in between, drawn at random.
const PAUSE_MS_MAX: u64 = 64;
/// How long holders together may take to say which folder is theirs.
const TOLD_WITHIN: Duration = Duration::from_secs(3);
/// Longest path.
const FOLDER_BYTES_MAX: usize = 4096;
/// After an error of accept, such as having no descriptor left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// What one run at a time has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Resource<'a> {
    Port(IpProtocol, SocketAddr),
    /// The card of an interface.
    Card(&'a str),
    /// The place of a host, by a number made of its name, among those that meet at an address.
    Place(SocketAddr, u64),
}

impl Resource<'_> {
    fn collides(self, other: Resource<'_>) -> bool {
        match (self, other) {
            (Self::Port(one, address), Resource::Port(two, taken)) => {
                one == two && collide(address, taken)
            }
            _ => self == other,
        }
    }

    /// Any user can take a port, and so keep a run from starting: who says that it is his is believed. A card
    /// only a process with the right to can set up.
    fn is_believed_of(self, holder: &UnixCredentials) -> bool {
        match self {
            Self::Port(..) | Self::Place(..) => true,
            Self::Card(_) => is_trusted(holder.uid()) || may_set_up_cards(holder.pid()),
        }
    }
}

impl fmt::Display for Resource<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Port(protocol, address) => write!(f, "{} {address}", protocol.word()),
            Self::Card(interface) => write!(f, "card {interface}"),
            Self::Place(address, host) => write!(f, "place {address} {host:x}"),
        }
    }
}

/// A name that is none of ours.
struct Foreign;

impl<'a> TryFrom<&'a str> for Resource<'a> {
    type Error = Foreign;

    fn try_from(text: &'a str) -> Result<Self, Foreign> {
        fn parsed<T: FromStr>(text: &str) -> Result<T, Foreign> {
            text.parse().map_err(|_other| Foreign)
        }
        let (kind, rest) = text.split_once(' ').ok_or(Foreign)?;
        let mut protocols = [IpProtocol::Udp, IpProtocol::Tcp].into_iter();
        if let Some(protocol) = protocols.find(|one| one.word() == kind) {
            return Ok(Self::Port(protocol, parsed(rest)?));
        }
        match kind {
            "card" => Ok(Self::Card(rest)),
            "place" => {
                let (address, host) = rest.split_once(' ').ok_or(Foreign)?;
                let host = u64::from_str_radix(host, 16).map_err(|_other| Foreign)?;
                Ok(Self::Place(parsed(address)?, host))
            }
            _ => Err(Foreign),
        }
    }
}

/// What a run of a topology needs for itself.
#[derive(Debug, Clone)]
struct Wanted {
    /// A [`Resource`] as text.
    resource: String,
    /// What for.
    of: String,
    /// The key of the topology to change.
    key: String,
}

impl Wanted {
    fn resource(&self) -> Option<Resource<'_>> {
        Resource::try_from(self.resource.as_str()).ok()
    }
}

/// What a run of `topology` on `hosts`, which are this machine, needs for itself.
fn wanted(topology: &Topology, hosts: &[String]) -> Vec<Wanted> {
    let ports = topology.ports_on(hosts).into_iter().map(|port| {
        let resource = Resource::Port(port.protocol, port.address).to_string();
        let of = format!("{resource} of {}", port.of);
        let key = port.key;
        Wanted { resource, of, key }
    });
    let mut wanted: Vec<Wanted> = ports.collect();
    let here = topology.hosts().iter();
    let here = here.filter(|host| hosts.contains(&host.name));
    let meeting = topology
        .hosts()
        .first()
        .filter(|_| topology.has_hosts_beside(hosts.len()));
    let meeting = meeting.and_then(|first| Some((first, first.control_address()?)));
    for host in here {
        if let Some(interface) = card_of(topology, host) {
            let part = host.interface.as_ref().map_or("address", |_| "interface");
            wanted.push(Wanted {
                resource: Resource::Card(&interface).to_string(),
                of: format!("the hardware time stamps of card {interface}"),
                key: format!("hosts.{}.{part}", host.name),
            });
        }
        if let Some((first, address)) = meeting {
            let name = fnv1a(FNV_OFFSET, host.name.as_bytes());
            wanted.push(Wanted {
                resource: Resource::Place(address, name).to_string(),
                of: format!(
                    "the place of {} in the run that meets at {address}",
                    host.name
                ),
                key: control_key(first),
            });
        }
    }
    wanted
}

/// Why a run is refused what it needs.
#[derive(Debug, thiserror::Error)]
pub enum ClaimError {
    /// Another run has it: keys of the topology, each with who has what it asks for.
    #[error("another run on this host has what this one needs")]
    Taken(Vec<(String, String)>),
    /// The system gives no socket, or does not list them.
    #[error("cannot find out what other runs on this host need: {0}")]
    Io(#[from] io::Error),
}

/// What this process claims, until it is dropped.
#[derive(Debug, Default)]
pub struct Claims {
    _answering: Option<Answering>,
    folder: Arc<Mutex<PathBuf>>,
}

impl Claims {
    /// Claims what a run of `topology` on `hosts`, which are this machine, needs for itself.
    ///
    /// # Errors
    /// When another run has some of it.
    pub fn take(topology: &Topology, hosts: &[String]) -> Result<Self, ClaimError> {
        Self::take_all(&wanted(topology, hosts))
    }

    /// Whether [`Self::take`] would be refused; claims nothing.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub fn look(topology: &Topology, hosts: &[String]) -> Result<(), ClaimError> {
        untaken(&wanted(topology, hosts), "")
    }

    fn take_all(wanted: &[Wanted]) -> Result<Self, ClaimError> {
        if wanted.is_empty() {
            return Ok(Self::default());
        }
        let mut attempt = 1;
        loop {
            let own = format!("{:016x}", u64::from_ne_bytes(random_bytes()?));
            // Two hosts here may have one card.
            let resources: BTreeSet<&str> = wanted.iter().map(|one| &*one.resource).collect();
            let bound = resources.into_iter().map(|one| listen(&own, one));
            let bound: Vec<UnixListener> = bound.collect::<io::Result<_>>()?;
            let folder = Arc::default();
            let answering = Answering::start(bound, Arc::clone(&folder))?;
            // Only once its own are bound: of two that begin together at least one sees the other.
            match untaken(wanted, &own) {
                Err(ClaimError::Taken(_)) if attempt < ATTEMPTS => drop(answering),
                Err(error) => return Err(error),
                Ok(()) => {
                    return Ok(Self {
                        _answering: Some(answering),
                        folder,
                    });
                }
            }
            attempt += 1;
            let pause_ms = u64::from_ne_bytes(random_bytes()?) % PAUSE_MS_MAX;
            thread::sleep(Duration::from_millis(pause_ms));
        }
    }

    /// From now on other runs are told that this one's folder is `folder`.
    pub(super) fn tell(&self, folder: &Path) {
        let mut told = self.folder.lock().unwrap_or_else(PoisonError::into_inner);
        folder.clone_into(&mut told);
    }
}

/// The sockets of claims, and the thread that answers at them.
#[derive(Debug)]
struct Answering {
    stop: UnixStream,
    thread: Option<JoinHandle<()>>,
    _listeners: Arc<Vec<UnixListener>>,
}

impl Answering {
    fn start(listeners: Vec<UnixListener>, folder: Arc<Mutex<PathBuf>>) -> io::Result<Self> {
        let (stop, stopped) = UnixStream::pair()?;
        let listeners = Arc::new(listeners);
        let answered = Arc::clone(&listeners);
        let builder = thread::Builder::new().name("claims".to_owned());
        // Without a thread nobody is told the folder, and the claims hold as well.
        let thread = builder.spawn(move || answer(&answered, &stopped, &folder));
        Ok(Self {
            stop,
            thread: thread.ok(),
            _listeners: listeners,
        })
    }
}

impl Drop for Answering {
    fn drop(&mut self) {
        let _is_told = self.stop.shutdown(Shutdown::Both).is_ok();
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join().is_ok();
        }
    }
}

/// Tells this user and root, until `stopped` ends, which folder the run has.
fn answer(listeners: &[UnixListener], stopped: &UnixStream, folder: &Mutex<PathBuf>) {
    loop {
        let ends = listeners.iter().map(AsFd::as_fd);
        let mut waits: Vec<PollFd<'_>> = [stopped.as_fd()]
            .into_iter()
            .chain(ends)
            .map(|end| PollFd::new(end, PollFlags::POLLIN))
            .collect();
        match poll(&mut waits, PollTimeout::NONE) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(_) => return,
        }
        let is_ready = |wait: &PollFd<'_>| wait.any().unwrap_or(false);
        if is_ready(&waits[0]) {
            return;
        }
        for (listener, _) in listeners
            .iter()
            .zip(&waits[1..])
            .filter(|(_, one)| is_ready(one))
        {
            match listener.accept() {
                Ok((mut asking, _)) => {
                    let peer = getsockopt(&asking, sockopt::PeerCredentials);
                    if peer.is_ok_and(|peer| is_trusted(peer.uid())) {
                        let folder = folder
                            .lock()
                            .unwrap_or_else(PoisonError::into_inner)
                            .clone();
                        // A new connection has room for it; one that is gone needs no answer.
                        let _is_told = asking
                            .write_all(folder.as_os_str().as_encoded_bytes())
                            .is_ok();
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(_) => thread::sleep(ACCEPT_PAUSE),
            }
        }
    }
}

fn is_trusted(uid: u32) -> bool {
    uid == 0 || uid == Uid::effective().as_raw()
}

/// Whether process `pid` has `CAP_NET_ADMIN`.
fn may_set_up_cards(pid: i32) -> bool {
    const NET_ADMIN: u64 = 1 << 12;
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let rights = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let rights = rights.and_then(|rights| u64::from_str_radix(rights.trim(), 16).ok());
    rights.is_some_and(|rights| rights & NET_ADMIN != 0)
}

fn listen(own: &str, resource: &str) -> io::Result<UnixListener> {
    let name = format!("{PREFIX}/{own}/{resource}");
    let address = net::SocketAddr::from_abstract_name(name)?;
    let listener = UnixListener::bind_addr(&address)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// Refuses when a run other than `own` has something of `wanted`.
fn untaken(wanted: &[Wanted], own: &str) -> Result<(), ClaimError> {
    if wanted.is_empty() {
        return Ok(());
    }
    let named = |error: io::Error| io::Error::new(error.kind(), format!("{SOCKETS}: {error}"));
    let sockets = fs::read(SOCKETS).map_err(named)?;
    let sockets = String::from_utf8_lossy(&sockets);
    let deadline = Instant::now() + TOLD_WITHIN;
    // One line a key.
    let mut taken = BTreeMap::new();
    for (name, _, resource) in claimed(&sockets).filter(|(_, other, _)| *other != own) {
        let colliding = wanted.iter().filter(|one| {
            let wanted = one.resource();
            wanted.is_some_and(|wanted| wanted.collides(resource)) && !taken.contains_key(&one.key)
        });
        let colliding: Vec<&Wanted> = colliding.collect();
        if colliding.is_empty() {
            continue;
        }
        let holder = match Holder::ask(name, deadline) {
            Ok(holder) => Some(holder),
            // One that is not there any more claims nothing.
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => continue,
            Err(_unanswered) => None,
        };
        let is_believed = holder
            .as_ref()
            .map_or(!matches!(resource, Resource::Card(_)), |holder| {
                resource.is_believed_of(&holder.credentials)
            });
        if is_believed {
            let holder = holder.map_or_else(
                || "a run that does not answer".to_owned(),
                |holder| holder.to_string(),
            );
            for one in colliding {
                let words = format!(
                    "{} is held by {holder}; give this run another, or end that one",
                    one.of
                );
                taken.insert(one.key.clone(), words);
            }
        }
    }
    if taken.is_empty() {
        Ok(())
    } else {
        Err(ClaimError::Taken(taken.into_iter().collect()))
    }
}

/// The claims in the kernel's list of sockets: whole name, whose, and what.
fn claimed(sockets: &str) -> impl Iterator<Item = (&str, &str, Resource<'_>)> {
    sockets.lines().filter_map(|line| {
        let (_, name) = line.split_once(" @")?;
        let (own, resource) = name
            .strip_prefix(PREFIX)?
            .strip_prefix('/')?
            .split_once('/')?;
        Some((name, own, Resource::try_from(resource).ok()?))
    })
}

/// Who has a claim.
struct Holder {
    credentials: UnixCredentials,
    /// Empty where it is not told.
    folder: PathBuf,
}

impl Holder {
    fn ask(name: &str, deadline: Instant) -> io::Result<Self> {
        let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
        let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
        connect(
            socket.as_raw_fd(),
            &UnixAddr::new_abstract(name.as_bytes())?,
        )?;
        let credentials = getsockopt(&socket, sockopt::PeerCredentials)?;
        let is_own_or_root = is_trusted(credentials.uid()) || Uid::effective().is_root();
        let folder = if is_own_or_root {
            told(UnixStream::from(socket), deadline).unwrap_or_default()
        } else {
            String::new()
        };
        Ok(Self {
            credentials,
            folder: PathBuf::from(folder),
        })
    }
}

fn told(mut stream: UnixStream, deadline: Instant) -> io::Result<String> {
    stream.set_nonblocking(false)?;
    let left = deadline.saturating_duration_since(Instant::now());
    // Nothing at all would be no bound.
    stream.set_read_timeout(Some(left.max(Duration::from_millis(1))))?;
    let mut folder = vec![0; FOLDER_BYTES_MAX];
    let length = stream.read(&mut folder)?;
    Ok(String::from_utf8_lossy(&folder[..length]).into_owned())
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (pid, uid) = (self.credentials.pid(), self.credentials.uid());
        match pid {
            // The kernel gives processes that cannot be seen from here no number.
            0 => f.write_str("a process of another container")?,
            pid => {
                let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
                let name = one_line(name.trim_end());
                let name = if name.is_empty() { "a program" } else { &name };
                write!(f, "{name} (process {pid}")?;
                if uid != Uid::effective().as_raw() {
                    write!(f, " of user {uid}")?;
                }
                f.write_str(")")?;
            }
        }
        if self.folder.as_os_str().is_empty() {
            return Ok(());
        }
        let folder = one_line(&self.folder.to_string_lossy());
        write!(f, ", the run in {folder}")
    }
}

/// What another process says, as part of a line.
fn one_line(text: &str) -> String {
    visible(text).replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A card that no other test has.
    fn card(name: &str) -> Vec<Wanted> {
        vec![Wanted {
            resource: format!("card {name}{}", std::process::id()),
            of: "the card".to_owned(),
            key: "hosts.a.interface".to_owned(),
        }]
    }

    fn refusal(taken: Result<Claims, ClaimError>) -> Vec<(String, String)> {
        match taken {
            Err(ClaimError::Taken(found)) => found,
            other => panic!("not refused: {other:?}"),
        }
    }

    #[test]
    fn what_is_claimed_is_read_back_and_a_port_collides_with_that_of_all_addresses() {
        let address = |text: &str| text.parse::<SocketAddr>().unwrap();
        let port = |text| Resource::Port(IpProtocol::Udp, address(text));
        let (one, any) = (port("10.0.0.1:7400"), port("0.0.0.0:7400"));
        let place = Resource::Place(address("[fd00::1]:7399"), 0xfe);
        for resource in [one, place, Resource::Card("eth0")] {
            let text = resource.to_string();
            assert!(
                Resource::try_from(text.as_str()).is_ok_and(|read| read == resource),
                "{text}"
            );
        }
        assert!(one.collides(any) && any.collides(one) && one.collides(one));
        assert!(!one.collides(port("10.0.0.2:7400")) && !one.collides(port("10.0.0.1:7401")));
        assert!(!one.collides(Resource::Port(IpProtocol::Tcp, address("10.0.0.1:7400"))));
        for text in ["", "udp", "udp x", "card", "place 10.0.0.1:1", "disk 1"] {
            assert!(Resource::try_from(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_second_claim_is_refused_with_process_and_folder_of_the_first_and_granted_after_it() {
        let wanted = card("a");
        let first = Claims::take_all(&wanted).unwrap();
        let own = format!("(process {})", std::process::id());
        let refused = refusal(Claims::take_all(&wanted));
        let [(key, words)] = &refused[..] else {
            panic!("{refused:?}");
        };
        assert_eq!(key, "hosts.a.interface");
        assert!(words.starts_with("the card is held by "), "{words}");
        assert!(words.contains(&format!("{own}; ")), "{words}");
        first.tell(Path::new("/runs/first"));
        let refused = refusal(Claims::take_all(&wanted));
        let told = format!("{own}, the run in /runs/first; ");
        assert!(refused[0].1.contains(&told), "{refused:?}");
        assert!(matches!(untaken(&wanted, ""), Err(ClaimError::Taken(_))));
        drop(first);
        drop(Claims::take_all(&wanted).unwrap());
    }

    #[test]
    fn one_card_of_two_hosts_is_claimed_once() {
        let twice = [card("c"), card("c")].concat();
        drop(Claims::take_all(&twice).unwrap());
    }

    #[test]
    fn of_two_that_begin_together_not_both_are_granted() {
        for _ in 0..20 {
            let mut begun = [0, 1].map(|_| Some(thread::spawn(|| Claims::take_all(&card("b")))));
            let got = begun
                .each_mut()
                .map(|one| one.take().unwrap().join().unwrap());
            let granted = got.iter().filter(|one| one.is_ok()).count();
            assert!(granted <= 1, "{granted}");
        }
    }

    #[test]
    fn names_of_others_and_of_nobody_claim_nothing() {
        let listed = "Num RefCount Protocol Flags Type St Inode Path\n\
                      0: 2 0 10000 1 01  9 @hil-claim/1/card x\n\
                      0: 2 0 10000 1 01 19 @hil-claim/1/tape x\n\
                      0: 2 0 10000 1 01 29 /run/hil-claim/1/card x\n\
                      0: 2 0 10000 1 01 39\n";
        let found: Vec<&str> = claimed(listed).map(|(name, ..)| name).collect();
        assert_eq!(found, ["hil-claim/1/card x"]);
        assert!(Holder::ask("hil-claim/1/card x", Instant::now()).is_err());
        assert!(!may_set_up_cards(i32::MAX));
    }
}
