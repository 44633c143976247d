//! Where the other hosts come in: a listener that strangers can neither hold shut nor fill. Each
//! connection is greeted in a thread of its own, for a bounded time, and there is a bounded number of
//! them; what becomes of one that said who it is decides `meet.rs`.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use super::frame::{Frame, PeerHello, PeerMessage, read_frame, write_message};
use super::peer::{ControlHalves, ControlReader};
use super::strangers::{Cause, Strangers};
use crate::security::PreSharedKey;
use crate::security::greeting::{self, GreetingError, MAGIC, TimedStream};
use hil_rundir::pipe::FailureKind;

/// How long a greeting may take altogether.
pub(super) const GREETING_TIMEOUT: Duration = Duration::from_secs(3);
/// Connections taken in one turn; the others wait in the kernel's queue, or are turned away there.
const ADMITTED_MAX: usize = 64;
/// Connections of one address that have not said who they are; the oldest makes way. Not fewer than one
/// turn takes: each has at least the time between two turns, in which a host of ours says who it is.
const HALF_OPEN_MAX: usize = ADMITTED_MAX;
/// Longest frame before the other end is known.
const HELLO_BYTES_MAX: usize = 16_384;
/// What a plain end is told where a key is needed. A stranger may hear it: it is shorter than any hello.
pub(super) const KEY_NEEDED: &str = "this host speaks with holders of its key only";

/// A connection whose other end said who it is, with the key where one is needed.
#[derive(Debug)]
pub(super) struct Newcomer {
    pub(super) ends: ControlHalves,
    pub(super) hello: PeerHello,
}

/// Threads that greet, those of connections that had to make way and still notice it included; with more,
/// connections wait in the kernel's queue.
const THREADS_MAX: usize = 4 * ADMITTED_MAX;

/// Whom the listener lets in.
#[derive(Debug, Clone)]
pub(super) struct Admission {
    /// Name of this host.
    pub(super) own: String,
    /// Names and addresses of those that may come.
    pub(super) expected: Vec<(String, IpAddr)>,
    /// The key they must hold, if any.
    pub(super) key: Option<PreSharedKey>,
}

impl Admission {
    fn awaits(&self, name: &str, ip: IpAddr) -> bool {
        let mut expected = self.expected.iter();
        expected.any(|(known, from)| known == name && *from == ip)
    }
}

#[derive(Debug)]
struct HalfOpen {
    ip: IpAddr,
    stream: TcpStream,
    thread: thread::JoinHandle<()>,
    /// It said who it is: from then on the connection is somebody else's to end.
    is_known: Arc<AtomicBool>,
    /// It made way for a newer one.
    is_crowded_out: Arc<AtomicBool>,
}

impl HalfOpen {
    fn is_unknown(&self) -> bool {
        !self.thread.is_finished() && !self.is_known.load(Ordering::Acquire)
    }
}

/// The listener and the connections that have not said who they are.
#[derive(Debug)]
pub(super) struct ControlListener {
    listener: TcpListener,
    admission: Admission,
    half_open: Vec<HalfOpen>,
    sender: Sender<Word>,
    arrived: Receiver<Word>,
    /// Held by this and by every thread that greets.
    alive: Arc<()>,
}

/// What became of a connection.
#[derive(Debug)]
struct Word {
    ip: IpAddr,
    arrived: Result<Newcomer, Cause>,
}

impl ControlListener {
    pub(super) fn open(address: SocketAddr, admission: Admission) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let (sender, arrived) = channel();
        Ok(Self {
            listener,
            admission,
            half_open: Vec::new(),
            sender,
            arrived,
            alive: Arc::default(),
        })
    }

    /// Takes waiting connections, a bounded number of them; says what this host is short of where that
    /// leaves one waiting. A connection that waits is taken once there is enough again.
    ///
    /// # Errors
    /// When the listener itself is broken.
    pub(super) fn admit_waiting(
        &mut self,
        strangers: &mut Strangers,
    ) -> io::Result<Option<io::Error>> {
        let mut shortage = None;
        for _ in 0..ADMITTED_MAX {
            if Arc::strong_count(&self.alive) > THREADS_MAX {
                break;
            }
            match self.listener.accept() {
                Ok((stream, from)) => self.admit(stream, from.ip(), strangers),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if is_of_closed_listener(&error) => return Err(error),
                Err(error) if FailureKind::of(&error) == FailureKind::HostTooSmall => {
                    shortage = Some(error);
                    break;
                }
                // What the network or a filter did to a connection that was still to be taken.
                Err(_of_one_connection) => {}
            }
        }
        self.half_open.retain(HalfOpen::is_unknown);
        Ok(shortage)
    }

    /// The next connection whose other end said who it is; `None` when there is none now. No more come
    /// than were admitted, so looking until there is none comes to an end.
    pub(super) fn look(&mut self, strangers: &mut Strangers) -> Option<Newcomer> {
        loop {
            let Word { ip, arrived } = self.arrived.try_recv().ok()?;
            match arrived {
                Ok(newcomer) => return Some(newcomer),
                Err(cause) => strangers.note(ip, cause),
            }
        }
    }

    /// Strangers are turned away before a byte of theirs is read.
    fn admit(&mut self, stream: TcpStream, ip: IpAddr, strangers: &mut Strangers) {
        let is_expected = self
            .admission
            .expected
            .iter()
            .any(|(_, known)| *known == ip);
        if !is_expected {
            strangers.note(ip, Cause::ForeignAddress);
            return;
        }
        let Ok(handle) = stream.try_clone() else {
            strangers.note(ip, Cause::CrowdedOut);
            return;
        };
        self.half_open.retain(HalfOpen::is_unknown);
        let same = |one: &HalfOpen| one.ip == ip;
        if self.half_open.iter().filter(|one| same(one)).count() >= HALF_OPEN_MAX
            && let Some(oldest) = self.half_open.iter().position(same)
        {
            let oldest = self.half_open.remove(oldest);
            oldest.is_crowded_out.store(true, Ordering::Release);
            // Its thread notices at once and ends.
            let _gone = oldest.stream.shutdown(Shutdown::Both).is_err();
        }
        let (admission, sender) = (self.admission.clone(), self.sender.clone());
        let is_known = Arc::new(AtomicBool::new(false));
        let is_crowded_out = Arc::new(AtomicBool::new(false));
        let (known, crowded_out) = (Arc::clone(&is_known), Arc::clone(&is_crowded_out));
        let alive = Arc::clone(&self.alive);
        let greet = move || {
            let arrived = match greet(stream, ip, &admission) {
                Ok(arrived) => arrived,
                Err(_) if crowded_out.load(Ordering::Acquire) => Err(Cause::CrowdedOut),
                Err(_) => Err(Cause::NoGreeting),
            };
            known.store(arrived.is_ok(), Ordering::Release);
            // Nobody listens once all hosts are here.
            let _late = sender.send(Word { ip, arrived }).is_err();
            // Counted among the threads until here.
            drop(alive);
        };
        // Without a thread the connection is dropped, and its end tries again.
        match thread::Builder::new()
            .name("listener".to_owned())
            .spawn(greet)
        {
            Ok(thread) => self.half_open.push(HalfOpen {
                ip,
                stream: handle,
                thread,
                is_known,
                is_crowded_out,
            }),
            Err(_) => strangers.note(ip, Cause::CrowdedOut),
        }
    }
}

impl Drop for ControlListener {
    /// Ends the connections that nobody waits for any more, so that their threads end.
    fn drop(&mut self) {
        for one in &self.half_open {
            if one.is_unknown() {
                let _gone = one.stream.shutdown(Shutdown::Both).is_err();
            }
        }
    }
}

/// Makes a connection ready for a greeting.
pub(super) fn prepare(stream: TcpStream) -> io::Result<TimedStream> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(GREETING_TIMEOUT))?;
    Ok(TimedStream::new(stream, Instant::now() + GREETING_TIMEOUT))
}

/// An error of accept that no further call can mend; any other is one connection's, or passes.
fn is_of_closed_listener(error: &io::Error) -> bool {
    let closed = [libc::EBADF, libc::ENOTSOCK, libc::EINVAL, libc::EOPNOTSUPP];
    error
        .raw_os_error()
        .is_none_or(|errno| closed.contains(&errno))
}

fn greet(
    stream: TcpStream,
    ip: IpAddr,
    admission: &Admission,
) -> io::Result<Result<Newcomer, Cause>> {
    let mut stream = prepare(stream)?;
    let mut start = [0; 4];
    stream.read_exact(&mut start)?;
    match (&admission.key, start == MAGIC) {
        (Some(key), true) => {
            let is_awaited =
                |theirs: &str, ours: &str| ours == admission.own && admission.awaits(theirs, ip);
            match greeting::answer(stream, key, is_awaited) {
                Ok((secured, is_awaited)) => say_who(secured.into(), ip, admission, is_awaited),
                Err(GreetingError::Refused(_)) => Ok(Err(Cause::AnotherKey)),
                Err(GreetingError::Connection(error)) => Err(error),
            }
        }
        (Some(_), false) => refuse_plain(stream, start),
        (None, true) => {
            greeting::turn_away(&stream)?;
            Ok(Err(Cause::WithKey))
        }
        (None, false) => say_who(plain_ends(stream, start)?, ip, admission, true),
    }
}

/// A plain end that shows that it is one of ours hears why it gets no further.
fn refuse_plain(stream: TimedStream, start: [u8; 4]) -> io::Result<Result<Newcomer, Cause>> {
    let mut ends = plain_ends(stream, start)?;
    let (hello, _length) = read_frame(&mut ends.reader, HELLO_BYTES_MAX)?;
    if matches!(hello, Frame::Message(PeerMessage::Hello(_))) {
        say(&mut ends, &PeerMessage::Refused(KEY_NEEDED.to_owned()))?;
        return Ok(Err(Cause::WithoutKey));
    }
    Ok(Err(Cause::NoGreeting))
}

/// Both halves of a plain connection of which `start` has been read.
fn plain_ends(stream: TimedStream, start: [u8; 4]) -> io::Result<ControlHalves> {
    let mut ends = ControlHalves::plain(stream)?;
    if let ControlReader::Plain(reader) = &mut ends.reader {
        reader.get_mut().put_back(start);
    }
    Ok(ends)
}

/// Hears who came. One that this host does not await at its address is told so, under the key where
/// there is one.
fn say_who(
    mut ends: ControlHalves,
    ip: IpAddr,
    admission: &Admission,
    is_named: bool,
) -> io::Result<Result<Newcomer, Cause>> {
    let PeerMessage::Hello(hello) = read_hello(&mut ends)? else {
        return Ok(Err(Cause::NoGreeting));
    };
    if is_named && admission.awaits(&hello.host, ip) {
        return Ok(Ok(Newcomer { ends, hello }));
    }
    let (host, own) = (&hello.host, &admission.own);
    let text = format!("{own} does not await host {host} at {ip}; use the same topology on both");
    say(&mut ends, &PeerMessage::Refused(text))?;
    Ok(Err(Cause::AnotherName))
}

/// The first word of the other end.
pub(super) fn read_hello(ends: &mut ControlHalves) -> io::Result<PeerMessage> {
    match read_frame(&mut ends.reader, HELLO_BYTES_MAX)?.0 {
        Frame::Message(message) => Ok(message),
        Frame::Chunk(_) => Err(io::Error::new(
            io::ErrorKind::InvalidData,
            "a chunk, not a hello",
        )),
    }
}

/// Opens a connection that this host made to `other`.
pub(super) fn knock(
    stream: TcpStream,
    own: &str,
    other: &str,
    key: Option<&PreSharedKey>,
) -> Result<ControlHalves, GreetingError> {
    let stream = prepare(stream)?;
    match key {
        Some(key) => Ok(greeting::ask(stream, key, own, other)?.into()),
        None => Ok(ControlHalves::plain(stream)?),
    }
}

/// Says `message`, whatever becomes of it.
pub(super) fn say(ends: &mut ControlHalves, message: &PeerMessage) -> io::Result<()> {
    write_message(&mut ends.writer, message)?;
    ends.writer.flush()
}
