//! The end that listens: takes the peer's newest connection and turns everyone else away.

use core::time::Duration;
use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, BorrowedFd};

use hil_core::time::Instant;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use socket2::Socket;

use super::TcpSettings;
use super::figures::StreamFigures;
use super::socket::{abort, listen, tune};
use super::stream::{Ending, Stream};
use crate::udp_socket::{GrantedOptions, UdpError, granted_options, local_address, refuse};
use crate::{DatagramReceiver, Received, ReceiverCounters, SendRefusal};
use hil_net::KernelStamps;

/// Waiting connections looked at in one call: a crowd at the door must not keep the channel
/// waiting.
const ACCEPT_COUNT_MAX: u32 = 4;

/// To look at the door costs system calls, and a thread that spins would look all the time.
const ATTEND_PERIOD: Duration = Duration::from_micros(200);

/// The receiving end.
#[derive(Debug)]
pub struct TcpReceiver {
    settings: TcpSettings,
    listener: Socket,
    stream: Stream,
    epoll: Epoll,
    /// What the connection is watched for.
    interest: EpollFlags,
    counters: ReceiverCounters,
    granted: GrantedOptions,
    attended: Instant,
}

impl TcpReceiver {
    /// Listens.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: TcpSettings) -> Result<Self, UdpError> {
        let listener = listen(&settings)?;
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC);
        let epoll = refuse("epoll", "create", epoll.map_err(io::Error::from))?;
        let added = epoll.add(&listener, EpollEvent::new(EpollFlags::EPOLLIN, 0));
        refuse("epoll", "add", added.map_err(io::Error::from))?;
        Ok(Self {
            granted: granted_options(&listener, &settings.common())?,
            stream: Stream::new(settings.clock),
            listener,
            epoll,
            interest: EpollFlags::empty(),
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

    /// True while there is a connection.
    pub fn is_connected(&self) -> bool {
        self.stream.socket().is_some()
    }

    /// Looks at the connections that wait. The present one has nothing to read when this is
    /// called, so that giving it up for a newer one loses nothing that had come.
    fn accept(&mut self, now: Instant) {
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
            self.stream.end(Ending::Replaced, now);
            self.interest = EpollFlags::EPOLLIN;
            // Without it the wait ends by time alone.
            let _slower = self
                .epoll
                .add(&socket, EpollEvent::new(self.interest, 0))
                .is_err();
            self.stream.adopt(socket, now);
        }
    }

    /// Waits for room in the kernel's buffer only while a reply needs it.
    fn update_interest(&mut self) {
        let mut interest = EpollFlags::EPOLLIN;
        if self.stream.has_backlog() {
            interest |= EpollFlags::EPOLLOUT;
        }
        if interest == self.interest {
            return;
        }
        if let Some(socket) = self.stream.socket() {
            self.interest = interest;
            let mut event = EpollEvent::new(interest, 0);
            let _slower = self.epoll.modify(socket, &mut event).is_err();
        }
    }
}

impl DatagramReceiver for TcpReceiver {
    fn receive(&mut self, _now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        // However a connection ended, the next one may come.
        let Ok(Some(taken)) = self.stream.receive(buffer) else {
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

    /// There is one way back, so `to` is not looked at.
    fn reply(&mut self, datagram: &[u8], _to: SocketAddr) -> Result<(), SendRefusal> {
        let sent = self.stream.send(datagram);
        match sent {
            Ok(()) => self.counters.reply_count += 1,
            Err(_) => self.counters.reply_refused_count += 1,
        }
        if self.stream.has_backlog() {
            self.update_interest();
        }
        sent
    }

    fn next_due(&self) -> Option<Instant> {
        None
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.epoll.0.as_fd())
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
        self.update_interest();
    }

    fn stream_figures(&self, now: Instant) -> Option<StreamFigures> {
        Some(self.stream.figures(now))
    }
}
