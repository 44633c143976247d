//! An in-process transport: two bounded queues of preallocated buffers, for tests that need
//! neither sockets nor rights. It reads no clock; its stamps are what the caller makes up.

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::os::fd::BorrowedFd;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};

use hil_core::time::Instant;

use super::{
    DatagramReceiver, DatagramSender, Received, ReceiverCounters, SendRefusal, SenderCounters,
};
use hil_net::{KernelStamps, TransmitStage, TransmitStamp, TxToken};

/// Bounds, addresses and stamps of a pair.
#[derive(Debug, Clone)]
pub struct QueueSettings {
    /// Datagrams held per direction; more are refused.
    pub capacity_count: usize,
    /// Longest datagram; longer ones are refused.
    pub datagram_bytes_max: usize,
    /// What the receiver sees as the source.
    pub sender_address: SocketAddr,
    /// What the sender sees as the source of replies.
    pub receiver_address: SocketAddr,
    /// Makes the transmit stamps of a datagram; without it there are none.
    pub transmit_stamps: Option<fn(TxToken) -> KernelStamps>,
    /// Makes the receive stamps of a datagram; without it there are none.
    pub receive_stamps: Option<fn(TxToken) -> KernelStamps>,
}

impl Default for QueueSettings {
    /// 64 datagrams of an Ethernet frame's content, no stamps.
    fn default() -> Self {
        let loopback = |port| SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port));
        Self {
            capacity_count: 64,
            datagram_bytes_max: 1472,
            sender_address: loopback(1),
            receiver_address: loopback(2),
            transmit_stamps: None,
            receive_stamps: None,
        }
    }
}

/// A sender and the receiver of what it sends.
///
/// # Panics
/// When `capacity_count` is zero.
pub fn queue_pair(settings: &QueueSettings) -> (QueueSender, QueueReceiver) {
    assert!(
        settings.capacity_count > 0,
        "a queue needs room for one datagram"
    );
    let (forward, arrivals) = lane(settings);
    let (backward, replies) = lane(settings);
    let sender = QueueSender {
        lane: forward,
        replies,
        peer: settings.receiver_address,
        make_stamps: settings.transmit_stamps,
        pending_stamps: VecDeque::with_capacity(settings.capacity_count),
        counters: SenderCounters::default(),
    };
    let receiver = QueueReceiver {
        arrivals,
        lane: backward,
        peer: settings.sender_address,
        make_stamps: settings.receive_stamps,
        counters: ReceiverCounters::default(),
    };
    (sender, receiver)
}

/// A buffer that travels full one way and empty back.
#[derive(Debug)]
struct Slot {
    bytes: Box<[u8]>,
    length_bytes: usize,
    token: TxToken,
}

#[derive(Debug)]
struct LaneIn {
    datagram_bytes_max: usize,
    filled: SyncSender<Slot>,
    free: Receiver<Slot>,
}

#[derive(Debug)]
struct LaneOut {
    filled: Receiver<Slot>,
    free: SyncSender<Slot>,
}

fn lane(settings: &QueueSettings) -> (LaneIn, LaneOut) {
    let (filled_in, filled_out) = sync_channel(settings.capacity_count);
    let (free_in, free_out) = sync_channel(settings.capacity_count);
    for _ in 0..settings.capacity_count {
        let slot = Slot {
            bytes: vec![0; settings.datagram_bytes_max].into_boxed_slice(),
            length_bytes: 0,
            token: TxToken(0),
        };
        free_in.try_send(slot).expect("there is room for each slot");
    }
    let lane_in = LaneIn {
        datagram_bytes_max: settings.datagram_bytes_max,
        filled: filled_in,
        free: free_out,
    };
    let lane_out = LaneOut {
        filled: filled_out,
        free: free_in,
    };
    (lane_in, lane_out)
}

impl LaneIn {
    fn push(&mut self, head: &[u8], tail: &[u8], token: TxToken) -> Result<(), SendRefusal> {
        let length_bytes = head.len() + tail.len();
        if length_bytes > self.datagram_bytes_max {
            return Err(SendRefusal::TooLong { length_bytes });
        }
        let mut slot = self.free.try_recv().map_err(|error| match error {
            TryRecvError::Empty => SendRefusal::QueueFull {
                errno: libc::ENOBUFS,
            },
            TryRecvError::Disconnected => SendRefusal::PeerRefused,
        })?;
        slot.bytes[..head.len()].copy_from_slice(head);
        slot.bytes[head.len()..length_bytes].copy_from_slice(tail);
        slot.length_bytes = length_bytes;
        slot.token = token;
        self.filled.try_send(slot).map_err(|error| match error {
            TrySendError::Full(_) => SendRefusal::QueueFull {
                errno: libc::ENOBUFS,
            },
            TrySendError::Disconnected(_) => SendRefusal::PeerRefused,
        })
    }
}

impl LaneOut {
    /// The next datagram, cut to the buffer; a partner that is gone just sends no more.
    fn pop(&mut self, buffer: &mut [u8], source: SocketAddr) -> Option<(Received, TxToken)> {
        let slot = self.filled.try_recv().ok()?;
        let length_bytes = slot.length_bytes.min(buffer.len());
        buffer[..length_bytes].copy_from_slice(&slot.bytes[..length_bytes]);
        let received = Received {
            length_bytes,
            is_truncated: slot.length_bytes > buffer.len(),
            source,
            stamps: KernelStamps::default(),
            emulated: None,
        };
        let token = slot.token;
        // Nobody needs the buffer any more when the partner is gone.
        self.free.try_send(slot).ok();
        Some((received, token))
    }
}

/// The sending end.
#[derive(Debug)]
pub struct QueueSender {
    lane: LaneIn,
    replies: LaneOut,
    peer: SocketAddr,
    make_stamps: Option<fn(TxToken) -> KernelStamps>,
    pending_stamps: VecDeque<TxToken>,
    counters: SenderCounters,
}

impl DatagramSender for QueueSender {
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        self.send_parts(datagram, &[])
    }

    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        let low_bits = self.counters.sent_count & u64::from(u32::MAX);
        let token = TxToken(u32::try_from(low_bits).expect("masked to 32 bits"));
        if let Err(refusal) = self.lane.push(head, tail, token) {
            self.counters.count_refusal(refusal);
            return Err(refusal);
        }
        self.counters.sent_count += 1;
        if self.make_stamps.is_some() {
            // As in the kernel, the oldest stamps are kept.
            if self.pending_stamps.len() < self.pending_stamps.capacity() {
                self.pending_stamps.push_back(token);
            } else {
                self.counters.stamp_overflow_count += 1;
            }
        }
        Ok(token)
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        let make_stamps = self.make_stamps?;
        let token = self.pending_stamps.pop_front()?;
        self.counters.stamp_count += 1;
        Some(TransmitStamp {
            token,
            stage: TransmitStage::Sent,
            stamps: make_stamps(token),
        })
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        let reply = self.replies.pop(buffer, self.peer);
        self.counters.reply_count += u64::from(reply.is_some());
        Ok(reply.map(|(received, _)| received))
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn counters(&self) -> SenderCounters {
        self.counters
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct QueueReceiver {
    arrivals: LaneOut,
    lane: LaneIn,
    peer: SocketAddr,
    make_stamps: Option<fn(TxToken) -> KernelStamps>,
    counters: ReceiverCounters,
}

impl DatagramReceiver for QueueReceiver {
    fn receive(&mut self, _now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        let Some((mut received, token)) = self.arrivals.pop(buffer, self.peer) else {
            return Ok(None);
        };
        if let Some(make_stamps) = self.make_stamps {
            received.stamps = make_stamps(token);
        }
        self.counters.count_received(&received);
        Ok(Some(received))
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        let refusal = if to == self.peer {
            self.lane.push(datagram, &[], TxToken(0)).err()
        } else {
            let errno = libc::ENETUNREACH;
            Some(SendRefusal::Unreachable { errno })
        };
        if let Some(refusal) = refusal {
            self.counters.reply_refused_count += 1;
            return Err(refusal);
        }
        self.counters.reply_count += 1;
        Ok(())
    }

    fn next_due(&self) -> Option<Instant> {
        None
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn counters(&self) -> ReceiverCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamps(token: TxToken) -> KernelStamps {
        KernelStamps {
            software_ns: Some(1_000 + i64::from(token.0)),
            hardware_ns: None,
        }
    }

    fn small() -> QueueSettings {
        QueueSettings {
            capacity_count: 3,
            datagram_bytes_max: 8,
            transmit_stamps: Some(stamps),
            receive_stamps: Some(stamps),
            ..QueueSettings::default()
        }
    }

    #[test]
    fn a_full_queue_refuses_and_takes_again_once_read() {
        let (mut sender, mut receiver) = queue_pair(&small());
        for index in 0..3 {
            assert_eq!(sender.send(&[index]), Ok(TxToken(u32::from(index))));
        }
        let errno = libc::ENOBUFS;
        assert_eq!(sender.send(&[3]), Err(SendRefusal::QueueFull { errno }));
        let arrival = receiver
            .receive(Instant::ZERO, &mut [0; 8])
            .unwrap()
            .unwrap();
        assert_eq!(arrival.stamps.software_ns, Some(1_000));
        assert_eq!(sender.send(&[3]), Ok(TxToken(3)));
        assert_eq!(sender.counters().queue_full_count, 1);
        // Four sends, room for three stamps.
        let tokens: Vec<u32> = core::iter::from_fn(|| sender.next_stamp())
            .map(|stamp| stamp.token.0)
            .collect();
        assert_eq!(tokens, [0, 1, 2]);
        assert_eq!(sender.counters().stamp_overflow_count, 1);
    }

    #[test]
    fn a_partner_that_is_gone_is_a_state() {
        let (mut sender, receiver) = queue_pair(&small());
        drop(receiver);
        assert_eq!(sender.send(b"x"), Err(SendRefusal::PeerRefused));
        assert_eq!(sender.receive(&mut [0; 8]).unwrap(), None);
    }
}
