//! Transmit stamps of single replies on a socket that receives. The kernel charges a stamp that
//! nobody fetched to the receive buffer, where it takes the room of arrivals, so it is asked for by
//! the message (`SO_TIMESTAMPING` as a control message), at most one is awaited, and the error queue
//! is looked through before the next is asked for. It sends nothing else and waits for nothing.

use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::time::Duration;

use hil_core::time::Instant;
use nix::sys::socket::TimestampingFlag;
use socket2::{MsgHdr, SockAddr, Socket};

use super::TransmitStage;
use super::control::{ControlData, QueueEntry};
use super::timestamping::{MessageReader, Queue, TimestampMode, restart_reply_count};

/// A stamp that has not come by then is given up: a driver that stamps does so within a
/// millisecond or so.
const PATIENCE: Duration = Duration::from_millis(20);
/// The error queue is looked at this often without a stamp awaited, for one that came after it was
/// given up: until it is taken, it ends every wait for arrivals at once.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Entries read at one look at most; more are never asked for in a look's time.
const LOOK_COUNT_MAX: u32 = 16;
/// `CMSG_SPACE(sizeof(__u32))` on a 64-bit kernel.
const REQUEST_BYTES: usize = 24;
/// `CMSG_LEN(sizeof(__u32))` there.
const REQUEST_LENGTH: u64 = 20;

/// The control message that asks for the software stamp of one datagram's departure.
fn request() -> [u8; REQUEST_BYTES] {
    let mut bytes = [0; REQUEST_BYTES];
    let asked = TimestampingFlag::SOF_TIMESTAMPING_TX_SOFTWARE.bits();
    bytes[..8].copy_from_slice(&REQUEST_LENGTH.to_ne_bytes());
    bytes[8..12].copy_from_slice(&libc::SOL_SOCKET.to_ne_bytes());
    bytes[12..16].copy_from_slice(&libc::SO_TIMESTAMPING.to_ne_bytes());
    bytes[16..20].copy_from_slice(&asked.to_ne_bytes());
    bytes
}

#[derive(Debug, Clone, Copy)]
struct Awaited {
    id: u32,
    sent: Instant,
}

/// The stamps of one socket's replies.
#[derive(Debug)]
pub struct ReplyStamps {
    mode: TimestampMode,
    is_asking: bool,
    request: [u8; REQUEST_BYTES],
    /// The number the kernel gives the next reply it is to stamp.
    next_id: u32,
    awaited: Option<Awaited>,
    /// When the error queue was last looked through; `None` before the first request.
    looked: Option<Instant>,
    /// Stamps handed out.
    pub stamp_count: u64,
    /// Stamps that did not come in time.
    pub missing_count: u64,
}

impl ReplyStamps {
    /// For a socket armed with [`super::timestamping::arm_receive`] in `mode`.
    pub fn new(mode: TimestampMode) -> Self {
        Self {
            mode,
            is_asking: mode.stamps_departures(),
            request: request(),
            next_id: 0,
            awaited: None,
            looked: None,
            stamp_count: 0,
            missing_count: 0,
        }
    }

    /// Whether a reply may be asked a stamp of at all.
    pub const fn are_asked_for(&self) -> bool {
        self.is_asking
    }

    /// Sends one reply and asks for its stamp. The one of the reply before is given up.
    ///
    /// # Errors
    /// What the kernel answered.
    pub fn send(
        &mut self,
        socket: &Socket,
        now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> io::Result<usize> {
        self.give_up();
        let address = SockAddr::from(to);
        let buffers = [IoSlice::new(datagram)];
        let message = MsgHdr::new()
            .with_addr(&address)
            .with_buffers(&buffers)
            .with_control(&self.request);
        let sent = socket.sendmsg(&message, libc::MSG_DONTWAIT);
        if sent.is_ok() {
            self.awaited = Some(Awaited {
                id: self.next_id,
                sent: now,
            });
            self.next_id = self.next_id.wrapping_add(1);
            self.looked.get_or_insert(now);
        } else {
            // Whether the kernel counted it depends on what refused it. A restarted count can
            // match a stamp that is still under way; it was drained before and is the oldest.
            self.is_asking = restart_reply_count(&socket, self.mode).is_ok();
            self.next_id = 0;
        }
        sent
    }

    /// Whether a look at the error queue is worth its system call.
    pub fn is_look_due(&self, now: Instant) -> bool {
        self.awaited.is_some()
            || self
                .looked
                .is_some_and(|looked| now.saturating_duration_since(looked) >= LOOK_PERIOD)
    }

    /// Empties the error queue as far as is bounded; the awaited stamp, nanoseconds of
    /// `CLOCK_REALTIME`, when it was there.
    pub fn take(
        &mut self,
        socket: &Socket,
        reader: &mut MessageReader,
        now: Instant,
    ) -> Option<i64> {
        self.looked = Some(now);
        let mut found = None;
        for _ in 0..LOOK_COUNT_MAX {
            // An error of the queue is a state of the network, as everywhere else.
            let Ok(Some(_)) = reader.read(socket.as_fd(), &mut [], Queue::Errors) else {
                break;
            };
            let data = ControlData::decode(reader.control());
            let Some(QueueEntry::Stamp {
                id,
                stage: TransmitStage::Sent,
            }) = data.extended_error.map(|error| error.entry())
            else {
                continue;
            };
            if self.awaited.is_some_and(|one| one.id == id) && data.stamps.software_ns.is_some() {
                self.awaited = None;
                self.stamp_count += 1;
                found = data.stamps.software_ns;
            }
        }
        let is_overdue = |one: Awaited| now.saturating_duration_since(one.sent) > PATIENCE;
        if self.awaited.is_some_and(is_overdue) {
            self.give_up();
        }
        found
    }

    fn give_up(&mut self) {
        self.missing_count += u64::from(self.awaited.take().is_some());
    }
}
