//! The end that connects: takes messages, hears replies, and comes back after every loss.

use std::io;
use std::os::fd::BorrowedFd;
use std::sync::Arc;

use hil_core::time::Instant;
use nix::sys::epoll::EpollFlags;
use socket2::Socket;

use super::metrics::StreamMetrics;
use super::now;
use super::socket::{
    BackOff, CONNECT_PATIENCE, GOOD_CONNECTION, Progress, prepare, progress, start_connecting,
};
use super::stream::Stream;
use crate::socket::{GrantedOptions, SocketError, SocketSettings, granted_options};
use crate::{ConnectionTally, DatagramSender, EndReport, Received, SendRefusal, SenderCounters};
use hil_net::{TransmitStamp, TxToken};

/// Where the connection stands.
#[derive(Debug)]
enum Way {
    /// None; the next attempt is due then.
    Waiting { due: Instant },
    /// Under way since `since`.
    Connecting { socket: Socket, since: Instant },
    /// Up; see the stream.
    Up,
}

/// The sending end.
#[derive(Debug)]
pub struct TcpSender {
    settings: SocketSettings,
    way: Way,
    stream: Stream,
    back_off: BackOff,
    counters: SenderCounters,
    granted: GrantedOptions,
}

impl TcpSender {
    /// Begins to connect; [`DatagramSender::attend`] does the rest.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step. A peer that is not
    /// there yet is no error.
    pub fn open(settings: SocketSettings) -> Result<Self, SocketError> {
        if settings.local.is_ipv4() != settings.peer.is_ipv4() {
            return Err(SocketError::Family {
                local: settings.local,
                peer: settings.peer,
            });
        }
        let now = now();
        let mut back_off = BackOff::new();
        let socket = prepare(&settings)?;
        let granted = granted_options(&socket, &settings)?;
        let way = match start_connecting(&socket, &settings) {
            Ok(()) => Way::Connecting { socket, since: now },
            // No way there yet: the link may come up.
            Err(_) => Way::Waiting {
                due: back_off.after(now),
            },
        };
        let mut sender = Self {
            stream: Stream::new()?,
            settings,
            way,
            back_off,
            counters: SenderCounters::default(),
            granted,
        };
        sender.watch_new_socket();
        Ok(sender)
    }

    /// What the kernel granted.
    pub fn granted(&self) -> GrantedOptions {
        self.granted
    }

    /// What it saw until `now`.
    pub(super) fn metrics(&self, now: Instant) -> StreamMetrics {
        self.stream.metrics(now)
    }

    /// How often connections come and go.
    pub fn tally(&self) -> Arc<ConnectionTally> {
        Arc::clone(&self.stream.tally)
    }

    /// True while there is a connection.
    pub fn is_connected(&self) -> bool {
        matches!(self.way, Way::Up)
    }

    /// Waits for a socket that has just set out.
    fn watch_new_socket(&mut self) {
        if let Way::Connecting { socket, .. } = &self.way {
            let _slower = self.stream.watch(socket, EpollFlags::EPOLLOUT).is_err();
        }
    }

    /// The stream may have lost its connection in the call before.
    fn notice_end(&mut self, now: Instant) {
        if !matches!(self.way, Way::Up) || self.stream.socket().is_some() {
            return;
        }
        if now.saturating_duration_since(self.stream.connected) >= GOOD_CONNECTION {
            self.back_off = BackOff::new();
        }
        let due = self.back_off.after(now);
        self.way = Way::Waiting { due };
        // As a report of the network would: whoever sends is to greet again.
        self.counters.network_report_count += 1;
        self.counters.newest_report = Some(SendRefusal::NotConnected);
    }

    fn connect(&mut self, now: Instant) {
        let Ok(socket) = prepare(&self.settings) else {
            return self.fail(now, None);
        };
        match start_connecting(&socket, &self.settings) {
            Ok(()) => {
                self.way = Way::Connecting { socket, since: now };
                self.watch_new_socket();
            }
            Err(error) => self.fail(now, error.raw_os_error()),
        }
    }

    fn fail(&mut self, now: Instant, errno: Option<i32>) {
        let figures = self.stream.figures_mut();
        figures.connect_failed_count += 1;
        figures.newest_errno = errno.or(figures.newest_errno);
        let due = self.back_off.after(now);
        self.way = Way::Waiting { due };
    }

    /// Looks how an attempt to connect stands.
    fn conclude(&mut self, now: Instant) {
        let Way::Connecting { socket, since } = &self.way else {
            return;
        };
        let is_over = now.saturating_duration_since(*since) > CONNECT_PATIENCE;
        match progress(socket) {
            Progress::Connecting if !is_over => {}
            Progress::Connecting => self.fail(now, Some(libc::ETIMEDOUT)),
            Progress::Failed { errno } => self.fail(now, errno),
            Progress::Connected => {
                if let Way::Connecting { socket, .. } = core::mem::replace(&mut self.way, Way::Up) {
                    self.stream.adopt(socket, now);
                    self.stream.update_interest();
                }
            }
        }
    }
}

impl DatagramSender for TcpSender {
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        self.send_parts(datagram, &[])
    }

    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        match self.stream.send(head, tail) {
            Ok(()) => {
                if self.stream.has_backlog() {
                    self.stream.update_interest();
                }
                Ok(self.counters.count_sent())
            }
            Err(refusal) => {
                self.counters.count_refusal(refusal);
                self.notice_end(now());
                Err(refusal)
            }
        }
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        None
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        match self.stream.receive(buffer, self.settings.peer) {
            Ok(received) => {
                self.counters.reply_count += u64::from(received.is_some());
                Ok(received)
            }
            Err(_ended) => {
                self.notice_end(now());
                Ok(None)
            }
        }
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.stream.poll_fd())
    }

    fn counters(&self) -> SenderCounters {
        self.counters
    }

    fn attend(&mut self, now: Instant) {
        match &self.way {
            Way::Waiting { due } if *due <= now => self.connect(now),
            Way::Waiting { .. } => {}
            Way::Connecting { .. } => self.conclude(now),
            Way::Up => {
                self.stream.look(now);
                self.stream.update_interest();
                self.notice_end(now);
            }
        }
    }

    fn next_due(&self) -> Option<Instant> {
        match &self.way {
            Way::Waiting { due } => Some(*due),
            Way::Connecting { since, .. } => Some(*since + CONNECT_PATIENCE),
            Way::Up => self.stream.next_look(),
        }
    }

    fn queued_bytes(&self) -> usize {
        self.stream.unsent_bytes()
    }

    fn has_unsent(&self) -> bool {
        self.stream.has_backlog()
    }

    fn report(&self, now: Instant) -> EndReport {
        self.metrics(now).of_sender()
    }
}
