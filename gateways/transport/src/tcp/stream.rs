//! One framed connection, either end: whole datagrams out of and into a non-blocking socket, with
//! what it costs in waiting. Who connects to whom is the business of its owners; everything it
//! works with but the socket survives a connection.

use core::time::Duration;
use std::io::{self, IoSlice, Read};
use std::net::SocketAddr;
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;

use hil_core::time::Instant;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use socket2::Socket;

use super::frame::{Backlog, FRAME_BYTES_MAX, FrameReader, prefix};
use super::metrics::StreamMetrics;
use super::now;
use super::socket::abort;
use super::stall::StallWatch;
use crate::socket::{SocketError, refuse};
use crate::{ConnectionTally, Received, SendRefusal};
use hil_net::tcp_info::{ConnectionInfo, unacknowledged_bytes, unsent_bytes};

/// What the kernel has not taken waits here: two of the longest frames, so that one always fits
/// behind the rest of another.
const BACKLOG_BYTES: usize = 2 * FRAME_BYTES_MAX;
/// How often `TCP_INFO` is read.
const INFO_PERIOD: Duration = Duration::from_millis(100);

/// Why a connection ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ending {
    /// The peer closed it.
    Closed,
    /// The kernel says so.
    Failed { errno: i32 },
    /// It stated a length no frame has.
    BadFrame,
    /// A newer connection of the peer took its place.
    Replaced,
}

/// The connection, if there is one, and what outlives it.
#[derive(Debug)]
pub(super) struct Stream {
    socket: Option<Socket>,
    pub(super) connected: Instant,
    reader: FrameReader,
    backlog: Backlog,
    backlogged: Option<Instant>,
    watch: StallWatch,
    looked: Instant,
    informed: Instant,
    info: Option<ConnectionInfo>,
    /// Of connections that have ended, and counts of this side.
    figures: StreamMetrics,
    pub(super) tally: Arc<ConnectionTally>,
    epoll: Epoll,
    /// What the newest socket is watched for.
    interest: EpollFlags,
}

impl Stream {
    pub(super) fn new() -> Result<Self, SocketError> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC);
        Ok(Self {
            epoll: refuse("epoll", "create", epoll.map_err(io::Error::from))?,
            interest: EpollFlags::empty(),
            socket: None,
            connected: Instant::ZERO,
            reader: FrameReader::default(),
            backlog: Backlog::new(BACKLOG_BYTES),
            backlogged: None,
            watch: StallWatch::new(),
            looked: Instant::ZERO,
            informed: Instant::ZERO,
            info: None,
            figures: StreamMetrics::default(),
            tally: Arc::default(),
        })
    }

    /// What to wait on for everything that is watched.
    pub(super) fn poll_fd(&self) -> BorrowedFd<'_> {
        self.epoll.0.as_fd()
    }

    /// Waits for `interest` of `socket` from now on. Where it fails, the wait ends by time alone.
    pub(super) fn watch(&mut self, socket: &Socket, interest: EpollFlags) -> io::Result<()> {
        self.interest = interest;
        Ok(self.epoll.add(socket, EpollEvent::new(interest, 0))?)
    }

    /// Waits, by edge, for what comes on a connection that is not the present one.
    pub(super) fn watch_candidate(&self, socket: &Socket) -> io::Result<()> {
        let interest = EpollFlags::EPOLLIN | EpollFlags::EPOLLET;
        Ok(self.epoll.add(socket, EpollEvent::new(interest, 0))?)
    }

    /// As [`Stream::watch`], of a socket that is watched as a candidate.
    pub(super) fn watch_adopted(
        &mut self,
        socket: &Socket,
        interest: EpollFlags,
    ) -> io::Result<()> {
        self.interest = interest;
        let mut event = EpollEvent::new(interest, 0);
        Ok(self.epoll.modify(socket, &mut event)?)
    }

    /// Waits for room in the kernel's buffer only while something needs it.
    pub(super) fn update_interest(&mut self) {
        let mut interest = EpollFlags::EPOLLIN;
        if self.has_backlog() {
            interest |= EpollFlags::EPOLLOUT;
        }
        if let Some(socket) = self.socket.as_ref().filter(|_| interest != self.interest) {
            self.interest = interest;
            let mut event = EpollEvent::new(interest, 0);
            let _slower = self.epoll.modify(socket, &mut event).is_err();
        }
    }

    pub(super) fn socket(&self) -> Option<&Socket> {
        self.socket.as_ref()
    }

    pub(super) fn figures_mut(&mut self) -> &mut StreamMetrics {
        &mut self.figures
    }

    /// Takes a connected socket.
    pub(super) fn adopt(&mut self, socket: Socket, now: Instant) {
        self.socket = Some(socket);
        self.connected = now;
        self.figures.connection_count += 1;
        self.tally.begin();
        self.inform(now);
    }

    /// Ends the connection, if there is one; what it still held is lost and counted.
    pub(super) fn end(&mut self, ending: Ending, now: Instant) {
        self.inform(now);
        let Some(socket) = self.socket.take() else {
            return;
        };
        let left = unacknowledged_bytes(&socket).unwrap_or(0) + self.backlog.len_bytes() as u64;
        abort(socket);
        self.tally.end();
        let figures = &mut self.figures;
        figures.connection_ended_count += 1;
        match ending {
            Ending::Failed { errno } => figures.newest_errno = Some(errno),
            Ending::Closed => figures.newest_errno = Some(0),
            Ending::BadFrame | Ending::Replaced => {}
        }
        figures.bad_frame_count += u64::from(ending == Ending::BadFrame);
        figures.cut_frame_count +=
            u64::from(self.reader.waiting_bytes() > 0 && ending != Ending::BadFrame);
        figures.abandoned_bytes += left;
        if let Some(info) = self.info.take() {
            figures.kernel = figures.kernel.followed_by(&info);
        }
        self.reader.clear();
        self.backlog.clear();
        self.note_backlog(now);
        self.watch.on_lost(now);
    }

    /// Gives one datagram, which lies in two places, to the kernel, or keeps what the kernel does not take.
    ///
    /// # Errors
    /// When it is too long, there is no connection or no room; it was not sent then, in no part.
    pub(super) fn send(&mut self, head: &[u8], tail: &[u8]) -> Result<(), SendRefusal> {
        let length_bytes = head.len() + tail.len();
        let prefix = prefix(length_bytes).ok_or(SendRefusal::TooLong { length_bytes })?;
        if !self.backlog.is_empty() {
            let now = now();
            self.flush(now);
        }
        let Some(socket) = &self.socket else {
            return Err(SendRefusal::NotConnected);
        };
        let whole = prefix.len() + length_bytes;
        let mut taken = 0;
        if self.backlog.is_empty() {
            let parts = [&prefix, head, tail].map(IoSlice::new);
            match socket.send_vectored_with_flags(&parts, libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL) {
                Ok(count) => taken = count,
                Err(error) if is_for_later(&error) => {}
                Err(error) => {
                    let now = now();
                    self.end(failed(&error), now);
                    return Err(SendRefusal::NotConnected);
                }
            }
        }
        let now = now();
        if taken < whole {
            let mut left = taken;
            let rest = [&prefix, head, tail].map(|part| {
                let skipped = left.min(part.len());
                left -= skipped;
                &part[skipped..]
            });
            if !self.backlog.push(rest) {
                // Nothing of it was taken: the rest of a frame always fits, as nothing else waits.
                let errno = libc::ENOBUFS;
                return Err(SendRefusal::QueueFull { errno });
            }
            self.note_backlog(now);
        }
        self.watch.on_accepted(whole, now);
        Ok(())
    }

    /// Gives the kernel what waits here.
    pub(super) fn flush(&mut self, now: Instant) {
        while let Some(socket) = self.socket.as_ref().filter(|_| !self.backlog.is_empty()) {
            let flags = libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL;
            match socket.send_with_flags(self.backlog.bytes(), flags) {
                Ok(count) => self.backlog.consume(count),
                Err(error) if is_for_later(&error) => break,
                Err(error) => self.end(failed(&error), now),
            }
        }
        self.note_backlog(now);
    }

    /// Takes the next datagram that is whole; says how the connection ended when it did.
    pub(super) fn receive(
        &mut self,
        buffer: &mut [u8],
        source: SocketAddr,
    ) -> Result<Option<Received>, Ending> {
        loop {
            match self.reader.next_datagram() {
                Ok(Some(datagram)) => {
                    return Ok(Some(Received::copied(datagram, buffer, source)));
                }
                Ok(None) => {}
                Err(_) => return self.broken(Ending::BadFrame),
            }
            let Some(mut socket) = self.socket.as_ref() else {
                return Ok(None);
            };
            match socket.read(self.reader.room()) {
                Ok(0) => return self.broken(Ending::Closed),
                Ok(count) => self.reader.filled(count),
                Err(error) if is_for_later(&error) => return Ok(None),
                Err(error) => return self.broken(failed(&error)),
            }
        }
    }

    fn broken<T>(&mut self, ending: Ending) -> Result<T, Ending> {
        let now = now();
        self.end(ending, now);
        Err(ending)
    }

    /// Gives the kernel what waits and looks how long the oldest byte has waited.
    pub(super) fn look(&mut self, now: Instant) {
        self.flush(now);
        let Some(socket) = &self.socket else { return };
        if self.watch.is_waiting() {
            self.looked = now;
            if let Ok(in_kernel) = unacknowledged_bytes(socket) {
                self.watch
                    .on_look(in_kernel + self.backlog.len_bytes() as u64, now);
            }
        }
        if now.saturating_duration_since(self.informed) >= INFO_PERIOD {
            self.inform(now);
        }
    }

    fn inform(&mut self, now: Instant) {
        let Some(socket) = &self.socket else { return };
        self.informed = now;
        if let Ok(info) = ConnectionInfo::read(socket) {
            if let Some(rtt_min_us) = info.rtt_min_us {
                self.watch
                    .set_rtt_min(Duration::from_micros(rtt_min_us.into()));
            }
            self.info = Some(info);
        }
    }

    /// Keeps count of how long anything waits here.
    fn note_backlog(&mut self, now: Instant) {
        let waiting = self.backlog.len_bytes() as u64;
        self.figures.backlog_bytes_max = self.figures.backlog_bytes_max.max(waiting);
        match (self.backlogged, waiting) {
            (Some(since), 0) => {
                self.figures.backlogged += now.saturating_duration_since(since);
                self.backlogged = None;
            }
            (None, 1..) => self.backlogged = Some(now),
            (None, 0) | (Some(_), 1..) => {}
        }
    }

    /// Bytes that have not left this host: those that wait here and those that the kernel has not sent.
    pub(super) fn unsent_bytes(&self) -> usize {
        let in_kernel = self.socket.as_ref().and_then(|one| unsent_bytes(one).ok());
        let in_kernel = usize::try_from(in_kernel.unwrap_or(0)).unwrap_or(usize::MAX);
        in_kernel.saturating_add(self.backlog.len_bytes())
    }

    /// True while bytes wait here for the kernel to take them.
    pub(super) fn has_backlog(&self) -> bool {
        !self.backlog.is_empty()
    }

    /// When to look again without another reason to.
    pub(super) fn next_look(&self) -> Option<Instant> {
        self.socket.as_ref()?;
        self.watch.next_look(self.looked)
    }

    /// Everything until `now`.
    pub(super) fn metrics(&self, now: Instant) -> StreamMetrics {
        let mut figures = self.figures;
        let info = self
            .socket
            .as_ref()
            .and_then(|socket| ConnectionInfo::read(socket).ok());
        if let Some(info) = info.or(self.info) {
            figures.kernel = figures.kernel.followed_by(&info);
        }
        figures.stalls = self.watch.metrics(now);
        figures.waiting_bytes_max = self.watch.waiting_bytes_max;
        if let Some(since) = self.backlogged {
            figures.backlogged += now.saturating_duration_since(since);
        }
        figures
    }
}

/// True for what passes by itself.
fn is_for_later(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
    ) || error.raw_os_error() == Some(libc::ENOBUFS)
}

fn failed(error: &io::Error) -> Ending {
    Ending::Failed {
        errno: error.raw_os_error().unwrap_or(0),
    }
}
