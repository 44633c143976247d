//! What the kernel tells of a TCP connection: `TCP_INFO` and the bytes not acknowledged yet. It
//! changes nothing.
//!
//! `unsafe` is allowed here because neither call has a safe form: crates wrap `TCP_INFO` without
//! the fields that matter, and `SIOCOUTQ` not at all.

use core::ffi::c_int;
use std::io;
use std::os::fd::{AsFd, AsRawFd};

use socket2::Socket;

/// Room for `struct tcp_info` of `linux/tcp.h`; kernels write as much of it as they know.
const INFO_BYTES: usize = 256;
/// The same, as the kernel takes it.
const INFO_LENGTH: libc::socklen_t = 256;
/// What the kernel writes for a smallest round trip it has not seen yet.
const UNSEEN: u32 = u32::MAX;

/// One reading of `TCP_INFO`. What the running kernel does not tell is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ConnectionInfo {
    /// Segments sent and not acknowledged.
    pub unacknowledged_segments: Option<u32>,
    /// Segments sent again, since the beginning.
    pub retransmitted_segments: Option<u64>,
    /// Segments that came before their turn, since the beginning.
    pub out_of_order_segments: Option<u64>,
    /// Smoothed round trip.
    pub rtt_us: Option<u32>,
    /// Its mean deviation.
    pub rtt_variation_us: Option<u32>,
    /// The smallest round trip seen.
    pub rtt_min_us: Option<u32>,
    /// Time with data under way or waiting, since the beginning.
    pub busy_us: Option<u64>,
    /// Of that, while the receiver's window was closed.
    pub window_limited_us: Option<u64>,
    /// Of that, while the send buffer was full.
    pub buffer_limited_us: Option<u64>,
    /// Bytes received in order.
    pub received_bytes: Option<u64>,
}

impl ConnectionInfo {
    /// Reads it from the kernel.
    ///
    /// # Errors
    /// What the kernel answered.
    #[allow(unsafe_code, reason = "no crate wraps the newer fields of TCP_INFO")]
    pub fn read(socket: &Socket) -> io::Result<Self> {
        let mut bytes = [0_u8; INFO_BYTES];
        let mut length = INFO_LENGTH;
        let descriptor = socket.as_fd().as_raw_fd();
        let pointer = bytes.as_mut_ptr().cast();
        let (level, name) = (libc::IPPROTO_TCP, libc::TCP_INFO);
        // SAFETY: the kernel writes at most `length` bytes at `pointer`, live memory of that size.
        let result = unsafe { libc::getsockopt(descriptor, level, name, pointer, &raw mut length) };
        if result != 0 {
            return Err(io::Error::last_os_error());
        }
        let length = usize::try_from(length).unwrap_or(0).min(INFO_BYTES);
        Ok(Self::parse(&bytes[..length]))
    }

    /// Of this connection and of `later` behind it: what counts since the beginning is of both together.
    #[must_use]
    pub fn followed_by(&self, later: &Self) -> Self {
        let sum = |of: fn(&Self) -> Option<u64>| match (of(self), of(later)) {
            (Some(one), Some(other)) => Some(one + other),
            (one, other) => one.or(other),
        };
        Self {
            retransmitted_segments: sum(|one| one.retransmitted_segments),
            out_of_order_segments: sum(|one| one.out_of_order_segments),
            busy_us: sum(|one| one.busy_us),
            window_limited_us: sum(|one| one.window_limited_us),
            buffer_limited_us: sum(|one| one.buffer_limited_us),
            received_bytes: sum(|one| one.received_bytes),
            ..*later
        }
    }

    /// Offsets as in `linux/tcp.h`; the structure only ever grows at its end.
    fn parse(bytes: &[u8]) -> Self {
        let word = |at: usize| {
            let field = bytes.get(at..)?.first_chunk::<4>()?;
            Some(u32::from_ne_bytes(*field))
        };
        let long = |at: usize| {
            let field = bytes.get(at..)?.first_chunk::<8>()?;
            Some(u64::from_ne_bytes(*field))
        };
        Self {
            unacknowledged_segments: word(24),
            rtt_us: word(68),
            rtt_variation_us: word(72),
            retransmitted_segments: word(100).map(u64::from),
            received_bytes: long(128),
            rtt_min_us: word(148).filter(|us| *us != UNSEEN),
            busy_us: long(168),
            window_limited_us: long(176),
            buffer_limited_us: long(184),
            out_of_order_segments: word(224).map(u64::from),
        }
    }
}

/// Bytes given to the kernel that the peer has not acknowledged, or of a UDP socket that have not left this
/// host (`SIOCOUTQ`).
///
/// # Errors
/// What the kernel answered.
pub fn unacknowledged_bytes(socket: &Socket) -> io::Result<u64> {
    queue_bytes(socket, libc::TIOCOUTQ)
}

/// Bytes given to the kernel that have not been sent for the first time (`SIOCOUTQNSD`); of TCP only.
///
/// # Errors
/// What the kernel answered.
pub fn unsent_bytes(socket: &Socket) -> io::Result<u64> {
    queue_bytes(socket, libc::SIOCOUTQNSD)
}

#[allow(unsafe_code, reason = "no crate wraps SIOCOUTQ and SIOCOUTQNSD")]
fn queue_bytes(socket: &Socket, request: libc::c_ulong) -> io::Result<u64> {
    let mut count: c_int = 0;
    let descriptor = socket.as_fd().as_raw_fd();
    // SAFETY: both requests (TIOCOUTQ is SIOCOUTQ on sockets) write one int at the pointer, a live int.
    let result = unsafe { libc::ioctl(descriptor, request, &raw mut count) };
    if result == 0 {
        Ok(u64::try_from(count).unwrap_or(0))
    } else {
        Err(io::Error::last_os_error())
    }
}
