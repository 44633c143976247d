//! The end that listens: keeps the present connection until a newer one has delivered a datagram of the
//! peer's, and turns everyone else away.

use core::time::Duration;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::fd::BorrowedFd;

use hil_core::time::Instant;
use nix::sys::epoll::EpollFlags;
use socket2::Socket;

use super::frame::{DATAGRAM_BYTES_MAX, FRAME_BYTES_MAX, PREFIX_BYTES, prefix};
use super::metrics::StreamMetrics;
use super::now;
use super::socket::{abort, listen, tune};
use super::stream::{Ending, Stream, Taken};
use crate::socket::{
    GrantedOptions, SocketError, SocketSettings, granted_options, local_address, refuse,
};
use crate::{DatagramReceiver, EndReport, Received, ReceiverCounters, SendRefusal};
use hil_net::KernelStamps;
use hil_net::timestamping::set_int_option;

/// Waiting connections looked at in one call: a crowd at the door must not keep the channel
/// waiting.
const ACCEPT_COUNT_MAX: u32 = 4;

/// To look at the door costs system calls, and a thread that spins would look all the time.
const ATTEND_PERIOD: Duration = Duration::from_micros(200);

/// Connections that wait for their first datagram of the peer's; then the oldest makes way.
const CANDIDATES_MAX: usize = 8;
/// How long one may take for it.
const CANDIDATE_PATIENCE: Duration = Duration::from_secs(10);

/// As much of a frame is there without asking for room.
const ROOM_BYTES_SURE: usize = 16_384;

/// A connection that may become the present one.
#[derive(Debug)]
struct Candidate {
    stream: TcpStream,
    since: Instant,
}

/// What a candidate has to read.
enum Look {
    Datagram(Taken),
    NothingYet,
    Ended,
}

/// The receiving end.
#[derive(Debug)]
pub struct TcpReceiver {
    settings: SocketSettings,
    listener: Socket,
    stream: Stream,
    /// Whether the owner tells of every authentic datagram ([`DatagramReceiver::prove`]); without a seal
    /// the first whole one counts as the peer's.
    is_sealed: bool,
    /// In the order in which they came.
    candidates: Vec<Candidate>,
    /// Where the next look at them begins, so that one that talks does not hide the others.
    look_first: usize,
    /// On which of them the newest datagram came; `None` when on the present connection.
    given: Option<usize>,
    /// Room for a frame of theirs.
    frame: Box<[u8]>,
    counters: ReceiverCounters,
    granted: GrantedOptions,
    attended: Instant,
}

impl TcpReceiver {
    /// Listens; `is_sealed` when its owner tells which datagrams are authentic.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: SocketSettings, is_sealed: bool) -> Result<Self, SocketError> {
        let listener = listen(&settings)?;
        let mut stream = Stream::new()?;
        refuse("epoll", "add", stream.watch(&listener, EpollFlags::EPOLLIN))?;
        Ok(Self {
            granted: granted_options(&listener, &settings)?,
            stream,
            is_sealed,
            candidates: Vec::with_capacity(CANDIDATES_MAX),
            look_first: 0,
            given: None,
            frame: vec![0; FRAME_BYTES_MAX].into_boxed_slice(),
            listener,
            counters: ReceiverCounters::default(),
            attended: Instant::from_ns(i64::MIN),
            settings,
        })
    }

    /// What the kernel granted.
    pub fn granted(&self) -> GrantedOptions {
        self.granted
    }

    /// Where it listens, with the port the kernel chose.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        local_address(&self.listener)
    }

    /// What it saw until `now`.
    pub(super) fn metrics(&self, now: Instant) -> StreamMetrics {
        self.stream.metrics(now)
    }

    /// True while there is a connection, one that has delivered nothing yet included.
    pub fn is_connected(&self) -> bool {
        self.stream.socket().is_some() || !self.candidates.is_empty()
    }

    /// Looks at the connections that wait.
    fn accept(&mut self, now: Instant) {
        let is_late =
            |one: &Candidate| now.saturating_duration_since(one.since) > CANDIDATE_PATIENCE;
        while self.candidates.first().is_some_and(is_late) {
            self.give_up(0);
        }
        for _ in 0..ACCEPT_COUNT_MAX {
            // What cannot be accepted now waits, or has gone again.
            let Ok((socket, from)) = self.listener.accept() else {
                return;
            };
            let from = from.as_socket().map(|from| from.ip());
            if from != Some(self.settings.peer.ip()) || tune(&socket, &self.settings).is_err() {
                self.stream.figures_mut().foreign_connection_count += 1;
                abort(socket);
                continue;
            }
            if self.candidates.len() == CANDIDATES_MAX {
                self.give_up(0);
            }
            // By edge: a part of a frame that stays a part must not keep the thread awake.
            let _slower = self.stream.watch_candidate(&socket).is_err();
            self.candidates.push(Candidate {
                stream: socket.into(),
                since: now,
            });
        }
    }

    /// Ends a connection that delivered nothing of the peer's.
    fn give_up(&mut self, index: usize) {
        self.given = None;
        abort(self.candidates.remove(index).stream.into());
        self.stream.figures_mut().unproven_connection_count += 1;
    }

    /// The next datagram of a connection that has delivered nothing of the peer's yet. What is looked at
    /// stays in the kernel until it is a whole frame, so nothing is kept here of any of them.
    fn look_at_candidates(&mut self, buffer: &mut [u8]) -> Option<Taken> {
        let mut left = self.candidates.len();
        while left > 0 {
            left -= 1;
            let index = self.look_first % self.candidates.len();
            match look(&mut self.candidates[index].stream, &mut self.frame, buffer) {
                Look::Datagram(taken) => {
                    self.look_first = index + 1;
                    self.given = Some(index);
                    return Some(taken);
                }
                Look::NothingYet => self.look_first = index + 1,
                Look::Ended => {
                    self.give_up(index);
                    self.look_first = index;
                }
            }
        }
        None
    }

    /// Makes the connection of the newest datagram the present one. The one before had nothing more to
    /// read when this one was looked at, so giving it up loses nothing that had come.
    fn promote(&mut self) {
        let Some(index) = self.given.take() else {
            return;
        };
        let now = now();
        let socket = Socket::from(self.candidates.remove(index).stream);
        self.stream.end(Ending::Replaced, now);
        let _as_it_was = set_int_option(&socket, libc::SOL_SOCKET, libc::SO_RCVLOWAT, 1).is_err();
        let _slower = self
            .stream
            .watch_adopted(&socket, EpollFlags::EPOLLIN)
            .is_err();
        self.stream.adopt(socket, now);
    }
}

fn look(stream: &mut TcpStream, frame: &mut [u8], buffer: &mut [u8]) -> Look {
    let count = match stream.peek(frame) {
        Ok(0) => return Look::Ended,
        Ok(count) => count,
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Look::NothingYet,
        Err(error) if error.kind() == io::ErrorKind::Interrupted => return Look::NothingYet,
        Err(_ended) => return Look::Ended,
    };
    let Some((stated, rest)) = frame[..count].split_first_chunk::<PREFIX_BYTES>() else {
        return Look::NothingYet;
    };
    let length = usize::try_from(u32::from_le_bytes(*stated)).unwrap_or(usize::MAX);
    if length > DATAGRAM_BYTES_MAX {
        return Look::Ended;
    }
    let whole = PREFIX_BYTES + length;
    if rest.len() < length {
        // So that the kernel makes room for a long one; where it does not, the peer comes again.
        if count >= ROOM_BYTES_SURE {
            let whole = i32::try_from(whole).expect("FRAME_BYTES_MAX fits 31 bits");
            let _room = set_int_option(stream, libc::SOL_SOCKET, libc::SO_RCVLOWAT, whole).is_err();
        }
        return Look::NothingYet;
    }
    if stream.read_exact(&mut frame[..whole]).is_err() {
        return Look::Ended;
    }
    let length_bytes = length.min(buffer.len());
    buffer[..length_bytes].copy_from_slice(&frame[PREFIX_BYTES..][..length_bytes]);
    Look::Datagram(Taken {
        length_bytes,
        is_truncated: length_bytes < length,
    })
}

impl DatagramReceiver for TcpReceiver {
    fn receive(&mut self, _now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        self.given = None;
        // However a connection ended, the next one may come.
        let mut taken = self.stream.receive(buffer).unwrap_or(None);
        if taken.is_none() && !self.candidates.is_empty() {
            taken = self.look_at_candidates(buffer);
            if !self.is_sealed {
                self.promote();
            }
        }
        let Some(taken) = taken else {
            return Ok(None);
        };
        let received = Received {
            length_bytes: taken.length_bytes,
            is_truncated: taken.is_truncated,
            source: self.settings.peer,
            stamps: KernelStamps::default(),
            emulated: None,
        };
        self.counters.count_received(&received);
        Ok(Some(received))
    }

    fn prove(&mut self) {
        self.promote();
    }

    fn answer(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        let Some(index) = self.given else {
            return self.reply(datagram, to);
        };
        let length_bytes = datagram.len();
        let prefix = prefix(length_bytes).ok_or(SendRefusal::TooLong { length_bytes })?;
        let whole = PREFIX_BYTES + length_bytes;
        self.frame[..PREFIX_BYTES].copy_from_slice(&prefix);
        self.frame[PREFIX_BYTES..whole].copy_from_slice(datagram);
        let written = self.candidates[index].stream.write(&self.frame[..whole]);
        if written.is_ok_and(|count| count == whole) {
            self.counters.reply_count += 1;
            return Ok(());
        }
        // A part of a frame would make every later one unreadable.
        self.give_up(index);
        self.counters.reply_refused_count += 1;
        Err(SendRefusal::NotConnected)
    }

    /// There is one way back, so `to` is not looked at.
    fn reply(&mut self, datagram: &[u8], _to: SocketAddr) -> Result<(), SendRefusal> {
        let sent = self.stream.send(datagram, &[]);
        match sent {
            Ok(()) => self.counters.reply_count += 1,
            Err(_) => self.counters.reply_refused_count += 1,
        }
        if self.stream.has_backlog() {
            self.stream.update_interest();
        }
        sent
    }

    fn next_due(&self) -> Option<Instant> {
        None
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.stream.poll_fd())
    }

    fn counters(&self) -> ReceiverCounters {
        self.counters
    }

    fn attend(&mut self, now: Instant) {
        let since_look = now.saturating_duration_since(self.attended);
        if since_look < ATTEND_PERIOD && !self.stream.has_backlog() {
            return;
        }
        self.attended = now;
        self.stream.look(now);
        self.accept(now);
        self.stream.update_interest();
    }

    fn report(&self, now: Instant) -> EndReport {
        self.metrics(now).of_receiver()
    }
}
