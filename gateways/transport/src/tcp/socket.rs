//! Setting up TCP sockets: what every connection gets, the listener, and a connection under way.
//! It moves no datagram.

use core::time::Duration;
use std::io;
use std::net::SocketAddr;

use hil_core::time::Instant;
use socket2::{Protocol, SockAddr, Socket, TcpKeepalive, Type};

use super::DESCRIPTION;
use crate::socket::{self, SocketError, SocketSettings, bind, mark, refuse};

/// Silence after which the kernel asks whether the peer is still there.
pub(super) const KEEP_ALIVE_IDLE: Duration = Duration::from_secs(5);
/// Between such questions.
pub(super) const KEEP_ALIVE_INTERVAL: Duration = Duration::from_secs(1);
/// Questions without an answer after which the peer is gone.
pub(super) const KEEP_ALIVE_COUNT: u32 = 5;
/// How long sent data may wait for an acknowledgement before the peer is gone.
pub(super) const USER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a connection may take to come about, one repetition of its first packet included.
pub(super) const CONNECT_PATIENCE: Duration = Duration::from_secs(3);
/// Longest segment the kernel can be told of (`MAX_TCP_WINDOW`).
const SEGMENT_BYTES_MAX: u32 = 32_767;
/// Connections that may wait to be accepted: the peer's among those of others that are to be turned away.
const LISTEN_BACKLOG: i32 = 128;

/// A socket with everything set that has to be before it connects or listens.
fn open(settings: &SocketSettings) -> Result<Socket, SocketError> {
    let socket = socket::open(settings, Type::STREAM, Protocol::TCP, DESCRIPTION.label)?;
    if let Some(segment_bytes) = segment_bytes(settings) {
        let set = socket.set_tcp_mss(segment_bytes);
        refuse("TCP_MAXSEG", segment_bytes, set)?;
    }
    Ok(socket)
}

/// What a packet of the path has room for; `None` when it is more than the kernel can be told,
/// which then finds out by itself.
fn segment_bytes(settings: &SocketSettings) -> Option<u32> {
    let headers = DESCRIPTION.capabilities.header_bytes(settings.local.ip());
    let segment_bytes = settings.path_mtu_bytes?.checked_sub(headers)?;
    let segment_bytes = u32::try_from(segment_bytes).ok()?;
    (segment_bytes <= SEGMENT_BYTES_MAX).then_some(segment_bytes)
}

/// A socket that listens where the settings say.
pub(super) fn listen(settings: &SocketSettings) -> Result<Socket, SocketError> {
    let socket = open(settings)?;
    // Connections of an earlier gateway linger; the port is ours all the same.
    refuse("SO_REUSEADDR", true, socket.set_reuse_address(true))?;
    bind(&socket, settings.local)?;
    refuse("listen", settings.local, socket.listen(LISTEN_BACKLOG))?;
    Ok(socket)
}

/// A socket that may connect, from a port of the kernel's choice: a port of our own would be
/// blocked for a minute after each connection that we ended.
pub(super) fn prepare(settings: &SocketSettings) -> Result<Socket, SocketError> {
    let socket = open(settings)?;
    tune(&socket, settings)?;
    bind(&socket, SocketAddr::new(settings.local.ip(), 0))?;
    Ok(socket)
}

/// Sends it on its way to the peer.
pub(super) fn start_connecting(socket: &Socket, settings: &SocketSettings) -> io::Result<()> {
    match socket.connect(&SockAddr::from(settings.peer)) {
        Err(error) if error.raw_os_error() != Some(libc::EINPROGRESS) => Err(error),
        _ => Ok(()),
    }
}

/// How an attempt to connect stands.
#[derive(Debug)]
pub(super) enum Progress {
    Connecting,
    Connected,
    Failed { errno: Option<i32> },
}

pub(super) fn progress(socket: &Socket) -> Progress {
    match socket.take_error() {
        Ok(Some(error)) | Err(error) => {
            let errno = error.raw_os_error();
            return Progress::Failed { errno };
        }
        Ok(None) => {}
    }
    let Ok(peer) = socket.peer_addr() else {
        return Progress::Connecting;
    };
    // Without a listener a port of the kernel's own range can end up connected to itself.
    let is_own_echo = socket
        .local_addr()
        .is_ok_and(|local| local.as_socket() == peer.as_socket());
    if is_own_echo {
        let errno = Some(libc::ECONNREFUSED);
        return Progress::Failed { errno };
    }
    Progress::Connected
}

/// What every connection gets: each message leaves at once, and a peer that vanished is noticed.
pub(super) fn tune(socket: &Socket, settings: &SocketSettings) -> Result<(), SocketError> {
    refuse("O_NONBLOCK", true, socket.set_nonblocking(true))?;
    refuse("TCP_NODELAY", true, socket.set_tcp_nodelay(true))?;
    let keep_alive = TcpKeepalive::new()
        .with_time(KEEP_ALIVE_IDLE)
        .with_interval(KEEP_ALIVE_INTERVAL)
        .with_retries(KEEP_ALIVE_COUNT);
    refuse("SO_KEEPALIVE", true, socket.set_tcp_keepalive(&keep_alive))?;
    let timeout = socket.set_tcp_user_timeout(Some(USER_TIMEOUT));
    let timeout_ms = USER_TIMEOUT.as_millis();
    refuse("TCP_USER_TIMEOUT", timeout_ms, timeout)?;
    // An accepted connection inherits buffers and code point, but not in every case the priority.
    mark(socket, settings)
}

/// Ends a connection at once, and leaves no trace of it that could get in a later one's way.
pub(super) fn abort(socket: Socket) {
    // A socket that cannot be reset is closed in the usual way by what follows.
    let _usual = socket.set_linger(Some(Duration::ZERO)).is_err();
    drop(socket);
}

/// Waiting times between attempts to connect: doubled after each, up to a bound.
#[derive(Debug, Clone, Copy)]
pub(super) struct BackOff {
    next: Duration,
}

/// First waiting time.
const BACK_OFF_MIN: Duration = Duration::from_millis(20);
/// Longest waiting time: what a restarted peer may have to wait for us.
pub(super) const BACK_OFF_MAX: Duration = Duration::from_millis(250);
/// A connection that lasted as long was a good one, and the next may be tried for at once.
pub(super) const GOOD_CONNECTION: Duration = Duration::from_secs(1);

impl BackOff {
    pub(super) const fn new() -> Self {
        Self { next: BACK_OFF_MIN }
    }

    /// When to try again.
    pub(super) fn after(&mut self, now: Instant) -> Instant {
        let due = now + self.next;
        self.next = (2 * self.next).min(BACK_OFF_MAX);
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_become_rarer_up_to_a_bound() {
        let mut back_off = BackOff::new();
        let waits: Vec<i64> = (0..8)
            .map(|_| back_off.after(Instant::ZERO).as_ns() / 1_000_000)
            .collect();
        assert_eq!(waits, [20, 40, 80, 160, 250, 250, 250, 250]);
    }
}
