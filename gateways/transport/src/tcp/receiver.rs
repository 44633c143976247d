//! The end that listens: takes the peer's newest connection and turns everyone else away.

use core::time::Duration;
use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::time::Instant;
use nix::sys::epoll::EpollFlags;
use socket2::Socket;

use super::metrics::StreamMetrics;
use super::socket::{abort, listen, tune};
use super::stream::{Ending, Stream};
use crate::socket::{
    GrantedOptions, SocketError, SocketSettings, granted_options, local_address, refuse,
};
use crate::{DatagramReceiver, EndReport, Received, ReceiverCounters, SendRefusal};
use hil_net::KernelStamps;

/// Waiting connections looked at in one call: a crowd at the door must not keep the channel
/// waiting.
const ACCEPT_COUNT_MAX: u32 = 4;

/// To look at the door costs system calls, and a thread that spins would look all the time.
const ATTEND_PERIOD: Duration = Duration::from_micros(200);

/// The receiving end.
#[derive(Debug)]
pub struct TcpReceiver {
    settings: SocketSettings,
    listener: Socket,
    stream: Stream,
    counters: ReceiverCounters,
    granted: GrantedOptions,
    attended: Instant,
}

impl TcpReceiver {
    /// Listens.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: SocketSettings) -> Result<Self, SocketError> {
        let listener = listen(&settings)?;
        let mut stream = Stream::new()?;
        refuse("epoll", "add", stream.watch(&listener, EpollFlags::EPOLLIN))?;
        Ok(Self {
            granted: granted_options(&listener, &settings)?,
            stream,
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
            let _slower = self.stream.watch(&socket, EpollFlags::EPOLLIN).is_err();
            self.stream.adopt(socket, now);
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
