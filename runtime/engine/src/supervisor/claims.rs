//! What a run has for itself alone on a host: ports, the settings of a network card, and its place among
//! the hosts that meet. Claimed before anything else is done, so that a second run that needs one of them
//! is refused before it disturbs the first.
//!
//! A claim is a listening socket of the abstract Unix namespace: of one network namespace, as ports and
//! cards are, and freed by the kernel with its process however that ends. It has one of a few names that follow from
//! what is claimed: a run binds one of them and then asks at all the others. So of two that begin in one moment the
//! one that binds later finds the other. Whoever connects learns from the kernel whose it is, and reads the address,
//! if it is a port, and the run's folder. Shared memory has the lock on its folder instead (`hil_shm::Domain`), which
//! is of one mount namespace as that is.

use core::fmt;
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
use hil_platform::console::Console;
use hil_platform::random::random_bytes;
use hil_platform::text::visible;
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
/// Names of one resource: a port can be held at different addresses, and others may hold a card's names.
const NAMES: u8 = 32;
/// Two runs that begin in one moment see each other: both take their claims back and try again.
const ATTEMPTS: u32 = 3;
/// Bound of the time in between, drawn at random.
const PAUSE_MS_MAX: u64 = 64;
/// How long holders together may take to say which folder is theirs.
const TOLD_WITHIN: Duration = Duration::from_secs(3);
/// Longest answer: an address and a path.
const ANSWER_BYTES_MAX: usize = 4096 + 128;
/// After an error of accept, such as having no descriptor left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// What a run of a topology needs for itself, which one run at a time has.
#[derive(Debug, Clone)]
struct Wanted {
    /// What all that may collide with it are called: a port without its address, a card, a place among hosts that meet.
    resource: String,
    /// Of a port.
    address: Option<SocketAddr>,
    /// What for.
    of: String,
    /// The key of the topology to change.
    key: String,
}

impl Wanted {
    /// Whether a claim of the same resource is one of this; `address` is that of a port, `None` where it is not told.
    fn collides(&self, address: Option<SocketAddr>) -> bool {
        let both = self.address.zip(address);
        both.is_none_or(|(own, other)| collide(own, other))
    }

    /// Any user can take a port, and so keep a run from starting: who says that it is his is believed. A card
    /// only a process with the right to can set up.
    fn is_believed_of(&self, holder: &Holder) -> bool {
        let may_have_cards =
            |one: &UnixCredentials| is_trusted(one.uid()) || may_set_up_cards(one.pid());
        !self.resource.starts_with(CARD) || holder.credentials.as_ref().is_some_and(may_have_cards)
    }
}

/// What the name of a card as a resource begins with.
const CARD: &str = "card ";

/// What a run of `topology` on `hosts`, which are this machine, needs for itself.
fn wanted(topology: &Topology, hosts: &[String]) -> Vec<Wanted> {
    let ports = topology.ports_on(hosts).into_iter().map(|port| {
        let (protocol, address) = (port.protocol.word(), port.address);
        Wanted {
            resource: format!("{protocol} {}", address.port()),
            address: Some(address),
            of: format!("{protocol} {address} of {}", port.of),
            key: port.key,
        }
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
                resource: format!("{CARD}{interface}"),
                address: None,
                of: format!("the hardware time stamps of card {interface}"),
                key: format!("hosts.{}.{part}", host.name),
            });
        }
        if let Some((first, address)) = meeting {
            let name = fnv1a(FNV_OFFSET, host.name.as_bytes());
            wanted.push(Wanted {
                resource: format!("place {address} {name:x}"),
                address: None,
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
    /// The system gives no socket.
    #[error("cannot find out what other runs on this host need: {0}")]
    Io(#[from] io::Error),
}

/// What this process claims, until it is dropped.
#[derive(Debug, Default)]
pub struct Claims {
    _answering: Option<Answering>,
    folder: Arc<Mutex<PathBuf>>,
    /// Cards all of whose names are held by processes that are not believed: later runs do not find this one.
    unnamed: Vec<String>,
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
        untaken(&wanted(topology, hosts), &BTreeSet::new())
    }

    fn take_all(wanted: &[Wanted]) -> Result<Self, ClaimError> {
        if wanted.is_empty() {
            return Ok(Self::default());
        }
        let mut attempt = 1;
        loop {
            // Two hosts here may have one card.
            let apart: BTreeSet<_> = wanted
                .iter()
                .map(|one| (&*one.resource, one.address))
                .collect();
            let (mut own, mut bound) = (BTreeSet::new(), Vec::new());
            let mut unnamed = Vec::new();
            for (resource, address) in apart {
                let Some((name, listener)) = bind(resource)? else {
                    unnamed.push(resource.to_owned());
                    continue;
                };
                own.insert(name);
                bound.push((listener, address));
            }
            let folder = Arc::default();
            let answering = Answering::start(bound, Arc::clone(&folder))?;
            // Only once its own are bound: of two that begin together at least one finds the other.
            match untaken(wanted, &own) {
                Err(ClaimError::Taken(_)) if attempt < ATTEMPTS => drop(answering),
                Err(error) => return Err(error),
                Ok(()) => {
                    return Ok(Self {
                        _answering: Some(answering),
                        folder,
                        unnamed,
                    });
                }
            }
            attempt += 1;
            let pause_ms = u64::from_ne_bytes(random_bytes()?) % PAUSE_MS_MAX;
            thread::sleep(Duration::from_millis(pause_ms));
        }
    }

    /// From now on other runs are told that this one's folder is `folder`. Warns of cards that no run is kept from.
    pub(super) fn tell(&self, folder: &Path, console: &mut Console) {
        for resource in &self.unnamed {
            console.warn(&format!(
                "{}, by processes that may not set up a card: a second run that needs this card is not refused",
                in_use(resource)
            ));
        }
        self.set_folder(folder);
    }

    fn set_folder(&self, folder: &Path) {
        let mut told = self.folder.lock().unwrap_or_else(PoisonError::into_inner);
        folder.clone_into(&mut told);
    }
}

/// The sockets of claims, and the thread that answers at them.
#[derive(Debug)]
struct Answering {
    stop: UnixStream,
    thread: Option<JoinHandle<()>>,
    _listeners: Arc<Vec<Bound>>,
}

/// A claim, and the address of a port.
type Bound = (UnixListener, Option<SocketAddr>);

impl Answering {
    fn start(listeners: Vec<Bound>, folder: Arc<Mutex<PathBuf>>) -> io::Result<Self> {
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

/// Tells, until `stopped` ends, the address of a port, and this user and root which folder the run has.
fn answer(listeners: &[Bound], stopped: &UnixStream, folder: &Mutex<PathBuf>) {
    loop {
        let ends = listeners.iter().map(|(listener, _)| listener.as_fd());
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
        for ((listener, address), _) in listeners
            .iter()
            .zip(&waits[1..])
            .filter(|(_, one)| is_ready(one))
        {
            match listener.accept() {
                Ok((mut asking, _)) => {
                    let peer = getsockopt(&asking, sockopt::PeerCredentials);
                    let address = address.map_or_else(String::new, |one| one.to_string());
                    let mut answer = format!("{address}\n").into_bytes();
                    if peer.is_ok_and(|peer| is_trusted(peer.uid())) {
                        let folder = folder.lock().unwrap_or_else(PoisonError::into_inner);
                        answer.extend(folder.as_os_str().as_encoded_bytes());
                    }
                    // A new connection has room for it; one that is gone needs no answer.
                    let _is_told = asking.write_all(&answer).is_ok();
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

/// Whether process `pid` has `CAP_NET_ADMIN` in this process's user namespace: any user has all rights in one of his
/// own (`user_namespaces(7)`).
fn may_set_up_cards(pid: i32) -> bool {
    has_net_admin(pid) && is_of_this_user_namespace(pid)
}

/// In its own user namespace.
fn has_net_admin(pid: i32) -> bool {
    const NET_ADMIN: u64 = 1 << 12;
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let rights = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let rights = rights.and_then(|rights| u64::from_str_radix(rights.trim(), 16).ok());
    rights.is_some_and(|rights| rights & NET_ADMIN != 0)
}

/// By the map of its users, which everybody may read; the link `ns/user` of another user's process only root may. To give
/// another namespace the map of this one takes the right to set any user (`CAP_SETUID`).
fn is_of_this_user_namespace(pid: i32) -> bool {
    let map = |pid: &str| fs::read(format!("/proc/{pid}/uid_map")).ok();
    let own = map("self");
    own.is_some() && map(&pid.to_string()) == own
}

fn names(resource: &str) -> impl Iterator<Item = String> {
    (0..NAMES).map(move |number| format!("{PREFIX}/{resource}/{number}"))
}

/// Binds the first name of `resource` that nobody has; `None` when a card has none left: any user can hold its names,
/// and only those who can set up a card keep a run from it ([`Wanted::is_believed_of`]).
fn bind(resource: &str) -> io::Result<Option<(String, UnixListener)>> {
    for name in names(resource) {
        let address = net::SocketAddr::from_abstract_name(&name)?;
        match UnixListener::bind_addr(&address) {
            Ok(listener) => {
                listener.set_nonblocking(true)?;
                return Ok(Some((name, listener)));
            }
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => {}
            Err(error) => return Err(error),
        }
    }
    if resource.starts_with(CARD) {
        return Ok(None);
    }
    Err(io::Error::new(io::ErrorKind::AddrInUse, in_use(resource)))
}

fn in_use(resource: &str) -> String {
    format!("all {NAMES} sockets @{PREFIX}/{resource}/* are in use (`ss -xlp`)")
}

/// Refuses when a run other than that with the claims `own` has something of `wanted`.
fn untaken(wanted: &[Wanted], own: &BTreeSet<String>) -> Result<(), ClaimError> {
    let deadline = Instant::now() + TOLD_WITHIN;
    // One line a key.
    let mut taken = BTreeMap::new();
    let resources: BTreeSet<&str> = wanted.iter().map(|one| &*one.resource).collect();
    for resource in resources {
        for name in names(resource).filter(|name| !own.contains(name)) {
            // One that is not there claims nothing.
            let Some(holder) = Holder::ask(&name, deadline)? else {
                continue;
            };
            let colliding = wanted.iter().filter(|one| {
                one.resource == resource
                    && one.collides(holder.address)
                    && one.is_believed_of(&holder)
            });
            for one in colliding {
                taken.entry(one.key.clone()).or_insert_with(|| {
                    format!(
                        "{} is held by {holder}; give this run another, or end that one",
                        one.of
                    )
                });
            }
        }
    }
    if taken.is_empty() {
        Ok(())
    } else {
        Err(ClaimError::Taken(taken.into_iter().collect()))
    }
}

/// Who has a claim.
#[derive(Default)]
struct Holder {
    /// `None` when it takes no connection.
    credentials: Option<UnixCredentials>,
    /// Of a port, where it is told.
    address: Option<SocketAddr>,
    /// Empty where it is not told.
    folder: String,
}

impl Holder {
    /// Of the claim `name`; `None` when nobody has it.
    fn ask(name: &str, deadline: Instant) -> io::Result<Option<Self>> {
        let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
        let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
        let address = UnixAddr::new_abstract(name.as_bytes())?;
        match connect(socket.as_raw_fd(), &address) {
            Ok(()) => {}
            Err(Errno::ECONNREFUSED) => return Ok(None),
            // Its queue is full.
            Err(Errno::EAGAIN) => return Ok(Some(Self::default())),
            Err(errno) => return Err(errno.into()),
        }
        let credentials = getsockopt(&socket, sockopt::PeerCredentials)?;
        let told = told(UnixStream::from(socket), deadline).unwrap_or_default();
        let (address, folder) = told.split_once('\n').unwrap_or_default();
        Ok(Some(Self {
            credentials: Some(credentials),
            address: address.parse().ok(),
            folder: folder.to_owned(),
        }))
    }
}

fn told(mut stream: UnixStream, deadline: Instant) -> io::Result<String> {
    stream.set_nonblocking(false)?;
    let left = deadline.saturating_duration_since(Instant::now());
    // Nothing at all would be no bound.
    stream.set_read_timeout(Some(left.max(Duration::from_millis(1))))?;
    let mut answer = vec![0; ANSWER_BYTES_MAX];
    let length = stream.read(&mut answer)?;
    Ok(String::from_utf8_lossy(&answer[..length]).into_owned())
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(credentials) = &self.credentials else {
            return f.write_str("a run that does not answer");
        };
        let (pid, uid) = (credentials.pid(), credentials.uid());
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
        if self.folder.is_empty() {
            return Ok(());
        }
        write!(f, ", the run in {}", one_line(&self.folder))
    }
}

/// What another process says, as part of a line.
fn one_line(text: &str) -> String {
    visible(text).replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader};
    use std::os::unix::process::CommandExt;
    use std::process::{Child, Command, Stdio};

    /// A card that no other test has.
    fn card(name: &str) -> Vec<Wanted> {
        vec![Wanted {
            resource: format!("{CARD}{name}{}", std::process::id()),
            address: None,
            of: "the card".to_owned(),
            key: "hosts.a.interface".to_owned(),
        }]
    }

    /// A port that no other test has, at `address`.
    fn port(address: &str) -> Vec<Wanted> {
        vec![Wanted {
            resource: format!("udp port{}", std::process::id()),
            address: Some(address.parse().unwrap()),
            ..card("p").remove(0)
        }]
    }

    fn refusal(taken: Result<Claims, ClaimError>) -> Vec<(String, String)> {
        match taken {
            Err(ClaimError::Taken(found)) => found,
            other => panic!("not refused: {other:?}"),
        }
    }

    #[test]
    fn a_port_collides_with_itself_and_with_that_of_all_addresses_and_not_with_another_address() {
        let first = Claims::take_all(&port("10.0.0.1:7400")).unwrap();
        let other = Claims::take_all(&port("10.0.0.2:7400")).unwrap();
        for again in ["10.0.0.1:7400", "0.0.0.0:7400"] {
            refusal(Claims::take_all(&port(again)));
        }
        drop(first);
        // The first name is free again, and the second claim is found all the same.
        refusal(Claims::take_all(&port("0.0.0.0:7400")));
        drop(Claims::take_all(&port("10.0.0.1:7400")).unwrap());
        drop(other);
        let any = Claims::take_all(&port("0.0.0.0:7400")).unwrap();
        refusal(Claims::take_all(&port("10.0.0.1:7400")));
        drop(any);
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
        first.set_folder(Path::new("/runs/first"));
        let refused = refusal(Claims::take_all(&wanted));
        let told = format!("{own}, the run in /runs/first; ");
        assert!(refused[0].1.contains(&told), "{refused:?}");
        assert!(matches!(
            untaken(&wanted, &BTreeSet::new()),
            Err(ClaimError::Taken(_))
        ));
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
        let mut granted_count = 0;
        for _ in 0..100 {
            let mut begun = [0, 1].map(|_| Some(thread::spawn(|| Claims::take_all(&card("b")))));
            let got = begun
                .each_mut()
                .map(|one| one.take().unwrap().join().unwrap());
            let granted = got.iter().filter(|one| one.is_ok()).count();
            assert!(granted <= 1, "{granted}");
            granted_count += granted;
        }
        println!("{granted_count} of 100 pairs had one granted");
        assert!(granted_count > 0);
    }

    /// All names of `wanted`.
    fn names_of(wanted: &[Wanted]) -> impl Iterator<Item = String> {
        names(&wanted[0].resource)
    }

    fn squat(name: String) -> UnixListener {
        let address = net::SocketAddr::from_abstract_name(name).unwrap();
        UnixListener::bind_addr(&address).unwrap()
    }

    #[test]
    fn a_holder_that_does_not_answer_holds_and_a_port_without_a_name_left_is_not_claimed() {
        let wanted = card("d");
        let taken: Vec<UnixListener> = names_of(&wanted).map(squat).collect();
        let refused = refusal(Claims::take_all(&wanted));
        let own = format!("(process {});", std::process::id());
        assert!(refused[0].1.contains(&own), "{refused:?}");
        drop(taken);

        let port = vec![Wanted {
            resource: format!("udp full{}", std::process::id()),
            ..port("10.0.0.1:7400").remove(0)
        }];
        let _taken: Vec<UnixListener> = names_of(&port).map(squat).collect();
        let error = Claims::take_all(&port).unwrap_err();
        assert!(error.to_string().contains("all 32 sockets"), "{error}");
    }

    /// A process that ends with its test.
    struct Other(Child);

    impl Drop for Other {
        fn drop(&mut self) {
            let _gone = self.0.kill().is_err();
            let _gone = self.0.wait().is_err();
        }
    }

    /// Runs `command`, as another user where this one is root.
    fn other(command: &mut Command) -> Other {
        if Uid::effective().is_root() {
            command.uid(ANOTHER_USER).gid(ANOTHER_USER);
        }
        Other(command.stdout(Stdio::piped()).spawn().unwrap())
    }

    const ANOTHER_USER: u32 = 65_534;

    #[test]
    fn another_user_with_all_names_of_a_card_keeps_no_run_from_it() {
        if !Uid::effective().is_root() {
            println!("skipped: only root can start a process of another user");
            return;
        }
        let wanted = card("f");
        let script = "import socket, sys, time\n\
            held = [socket.socket(socket.AF_UNIX) for _ in sys.argv[1:]]\n\
            for one, name in zip(held, sys.argv[1:]):\n one.bind(chr(0) + name)\n one.listen()\n\
            print('held', flush=True)\n\
            time.sleep(600)\n";
        let mut squatter = Command::new("python3");
        squatter.args(["-c", script]).args(names_of(&wanted));
        let mut squatter = other(&mut squatter);
        let mut said = [0; 4];
        let mut output = squatter.0.stdout.take().unwrap();
        output.read_exact(&mut said).unwrap();
        let claims = Claims::take_all(&wanted).unwrap();
        assert_eq!(claims.unnamed, [wanted[0].resource.clone()]);
    }

    #[test]
    fn all_rights_in_a_user_namespace_of_its_own_set_up_no_card() {
        assert!(!may_set_up_cards(i32::MAX));
        let own = i32::try_from(std::process::id()).unwrap();
        assert_eq!(may_set_up_cards(own), has_net_admin(own));
        let script = "echo in && exec sleep 600";
        let mut apart = Command::new("unshare");
        apart.args(["--user", "--map-root-user", "sh", "-c", script]);
        let mut apart = other(&mut apart);
        let mut said = String::new();
        let output = apart.0.stdout.take().unwrap();
        BufReader::new(output).read_line(&mut said).unwrap();
        if said.is_empty() {
            println!("skipped: this host gives no user namespace");
            return;
        }
        let pid = i32::try_from(apart.0.id()).unwrap();
        assert!(has_net_admin(pid));
        assert!(!may_set_up_cards(pid));
    }
}
