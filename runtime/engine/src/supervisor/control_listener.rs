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

use super::frame::{Frame, PeerHello, PeerMessage, read_frame_within, write_message};
use super::peer::{ControlHalves, ControlReader};
use crate::security::PreSharedKey;
use crate::security::greeting::{self, GreetingError, MAGIC, TimedStream, Why};
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

/// What a connection turned out to be.
#[derive(Debug)]
pub(super) enum Arrived {
    /// It said who it is, with the key where one is needed.
    Peer {
        ip: IpAddr,
        ends: Box<ControlHalves>,
        hello: PeerHello,
    },
    /// It was turned away, and why.
    TurnedAway(IpAddr, &'static str),
    /// It came with a key where none is used.
    Keyed(IpAddr),
    /// It left, was too slow, or was no host of ours.
    Nobody,
}

/// Threads that greet, those of connections that had to make way and still notice it included; with more,
/// connections wait in the kernel's queue.
const THREADS_MAX: usize = 4 * ADMITTED_MAX;

/// Connections that came to nothing, by cause.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct ConnectionCounts {
    /// From an address that is not awaited.
    foreign: u64,
    /// They came with another key, or without one, or under another name.
    turned_away: u64,
    /// They said something else, or nothing in time, or left.
    nobody: u64,
    /// They made way for newer ones of their address before they said who they were.
    crowded_out: u64,
}

impl ConnectionCounts {
    /// In words; `None` when there were none.
    pub(super) fn words(self) -> Option<String> {
        let Self {
            foreign,
            turned_away,
            nobody,
            crowded_out,
        } = self;
        let causes = [
            (foreign, "from a foreign address"),
            (turned_away, "with another key or name"),
            (nobody, "without a greeting"),
            (crowded_out, "that made way for newer ones"),
        ];
        let causes = causes.into_iter().filter(|(count, _)| *count > 0);
        let causes: Vec<String> = causes
            .map(|(count, cause)| format!("{count} {cause}"))
            .collect();
        let total = foreign + turned_away + nobody + crowded_out;
        (total > 0).then(|| {
            let causes = causes.join(", ");
            format!("{total} connections came to nothing while the hosts met: {causes}")
        })
    }
}

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
    counts: ConnectionCounts,
    /// Held by this and by every thread that greets.
    alive: Arc<()>,
}

/// What became of a connection.
#[derive(Debug)]
struct Word {
    arrived: Arrived,
    /// It had to make way.
    is_crowded_out: bool,
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
            counts: ConnectionCounts::default(),
            alive: Arc::default(),
        })
    }

    /// What came to nothing so far.
    pub(super) fn counts(&self) -> ConnectionCounts {
        self.counts
    }

    /// Takes waiting connections, a bounded number of them; says what this host is short of where that
    /// leaves one waiting. A connection that waits is taken once there is enough again.
    ///
    /// # Errors
    /// When the listener itself is broken.
    pub(super) fn admit_waiting(&mut self) -> io::Result<Option<io::Error>> {
        let mut shortage = None;
        for _ in 0..ADMITTED_MAX {
            if Arc::strong_count(&self.alive) > THREADS_MAX {
                break;
            }
            match self.listener.accept() {
                Ok((stream, from)) => self.admit(stream, from.ip()),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                // Connections that ended before they were taken.
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Err(error) if FailureKind::of(&error) == FailureKind::HostTooSmall => {
                    shortage = Some(error);
                    break;
                }
                Err(error) => return Err(error),
            }
        }
        self.half_open.retain(HalfOpen::is_unknown);
        Ok(shortage)
    }

    /// The next connection that turned out to be something; `None` when there is none now. No more come
    /// than were admitted, so looking until there is none comes to an end.
    pub(super) fn look(&mut self) -> Option<Arrived> {
        loop {
            let Word {
                arrived,
                is_crowded_out,
            } = self.arrived.try_recv().ok()?;
            match arrived {
                Arrived::Nobody if is_crowded_out => self.counts.crowded_out += 1,
                Arrived::Nobody => self.counts.nobody += 1,
                Arrived::TurnedAway(..) => {
                    self.counts.turned_away += 1;
                    return Some(arrived);
                }
                Arrived::Peer { .. } | Arrived::Keyed(_) => return Some(arrived),
            }
        }
    }

    /// Strangers are turned away before a byte of theirs is read.
    fn admit(&mut self, stream: TcpStream, ip: IpAddr) {
        let is_expected = self
            .admission
            .expected
            .iter()
            .any(|(_, known)| *known == ip);
        if !is_expected {
            self.counts.foreign += 1;
            return;
        }
        let Ok(handle) = stream.try_clone() else {
            self.counts.crowded_out += 1;
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
            let arrived = greet(stream, ip, &admission).unwrap_or(Arrived::Nobody);
            known.store(matches!(arrived, Arrived::Peer { .. }), Ordering::Release);
            // Nobody listens once all hosts are here.
            let is_crowded_out = crowded_out.load(Ordering::Acquire);
            let word = Word {
                arrived,
                is_crowded_out,
            };
            let _late = sender.send(word).is_err();
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
            Err(_) => self.counts.crowded_out += 1,
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

fn greet(stream: TcpStream, ip: IpAddr, admission: &Admission) -> io::Result<Arrived> {
    let mut stream = prepare(stream)?;
    let mut start = [0; 4];
    stream.read_exact(&mut start)?;
    match (&admission.key, start == MAGIC) {
        (Some(key), true) => {
            let is_awaited =
                |theirs: &str, ours: &str| ours == admission.own && admission.awaits(theirs, ip);
            match greeting::answer(stream, key, is_awaited) {
                Ok(secured) => say_who(secured.into(), ip),
                Err(GreetingError::Refused(why)) => Ok(Arrived::TurnedAway(ip, turned_away(why))),
                Err(GreetingError::Connection(error)) => Err(error),
            }
        }
        (Some(_), false) => refuse_plain(stream, start, ip),
        (None, true) => {
            greeting::turn_away(&stream)?;
            Ok(Arrived::Keyed(ip))
        }
        (None, false) => say_who(plain_ends(stream, start)?, ip),
    }
}

/// As the end that turned somebody away says it.
const fn turned_away(why: Why) -> &'static str {
    match why {
        Why::AnotherKey | Why::PlainHere => {
            "came with another key; compare `hil-runtime key check FILE` on both hosts"
        }
        Why::AnotherName => "came with the key under a name that is not awaited at its address",
    }
}

/// A plain end that shows that it is one of ours hears why it gets no further.
fn refuse_plain(stream: TimedStream, start: [u8; 4], ip: IpAddr) -> io::Result<Arrived> {
    let mut ends = plain_ends(stream, start)?;
    let hello = read_frame_within(&mut ends.reader, HELLO_BYTES_MAX)?;
    if matches!(hello, Frame::Message(PeerMessage::Hello(_))) {
        let refused = PeerMessage::Refused(KEY_NEEDED.to_owned());
        write_message(&mut ends.writer, &refused)?;
        return Ok(Arrived::TurnedAway(
            ip,
            "came without a key, which this run needs",
        ));
    }
    Ok(Arrived::Nobody)
}

/// Both halves of a plain connection of which `start` has been read.
fn plain_ends(stream: TimedStream, start: [u8; 4]) -> io::Result<ControlHalves> {
    let mut ends = ControlHalves::plain(stream)?;
    if let ControlReader::Plain(reader) = &mut ends.reader {
        reader.get_mut().put_back(start);
    }
    Ok(ends)
}

fn say_who(mut ends: ControlHalves, ip: IpAddr) -> io::Result<Arrived> {
    Ok(match read_hello(&mut ends)? {
        PeerMessage::Hello(hello) => Arrived::Peer {
            ip,
            ends: Box::new(ends),
            hello,
        },
        _ => Arrived::Nobody,
    })
}

/// The first word of the other end.
pub(super) fn read_hello(ends: &mut ControlHalves) -> io::Result<PeerMessage> {
    match read_frame_within(&mut ends.reader, HELLO_BYTES_MAX)? {
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
