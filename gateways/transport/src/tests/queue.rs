//! An in-process transport without stamps: two bounded queues, for tests that need neither sockets nor rights.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::BorrowedFd;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};

use hil_core::time::Instant;
use hil_net::{TransmitStamp, TxToken};

use super::{
    DatagramReceiver, DatagramSender, Received, ReceiverCounters, SendRefusal, SenderCounters,
};

/// Datagrams held one way; more are refused.
const CAPACITY_COUNT: usize = 64;
/// Longest datagram: an Ethernet frame's content.
const DATAGRAM_BYTES_MAX: usize = 1472;
/// What the receiver sees as the source.
pub const SENDER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 1);
/// What the sender sees as the source of replies.
pub const RECEIVER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 2);

/// A sender and the receiver of what it sends.
pub fn queue_pair() -> (QueueSender, QueueReceiver) {
    let (forward, arrivals) = sync_channel(CAPACITY_COUNT);
    let (backward, replies) = sync_channel(CAPACITY_COUNT);
    let sender = QueueSender {
        end: End {
            out: forward,
            into: replies,
            peer: RECEIVER,
        },
        counters: SenderCounters::default(),
    };
    let receiver = QueueReceiver {
        end: End {
            out: backward,
            into: arrivals,
            peer: SENDER,
        },
        counters: ReceiverCounters::default(),
    };
    (sender, receiver)
}

#[derive(Debug)]
struct End {
    out: SyncSender<Vec<u8>>,
    into: Receiver<Vec<u8>>,
    peer: SocketAddr,
}

impl End {
    fn push(&self, datagram: Vec<u8>) -> Result<(), SendRefusal> {
        let length_bytes = datagram.len();
        if length_bytes > DATAGRAM_BYTES_MAX {
            return Err(SendRefusal::TooLong { length_bytes });
        }
        self.out.try_send(datagram).map_err(|error| match error {
            TrySendError::Full(_) => SendRefusal::QueueFull {
                errno: libc::ENOBUFS,
            },
            TrySendError::Disconnected(_) => SendRefusal::PeerRefused,
        })
    }

    /// The next datagram, cut to the buffer; a partner that is gone just sends no more.
    fn pop(&self, buffer: &mut [u8]) -> Option<Received> {
        let datagram = self.into.try_recv().ok()?;
        Some(Received::copied(&datagram, buffer, self.peer))
    }
}

/// The sending end.
#[derive(Debug)]
pub struct QueueSender {
    end: End,
    counters: SenderCounters,
}

impl DatagramSender for QueueSender {
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        self.send_parts(datagram, &[])
    }

    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        let sent = self.end.push([head, tail].concat());
        sent.inspect_err(|refusal| self.counters.count_refusal(*refusal))?;
        Ok(self.counters.count_sent())
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        None
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        let reply = self.end.pop(buffer);
        self.counters.reply_count += u64::from(reply.is_some());
        Ok(reply)
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
    end: End,
    counters: ReceiverCounters,
}

impl DatagramReceiver for QueueReceiver {
    fn receive(&mut self, _now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        let received = self.end.pop(buffer);
        if let Some(received) = &received {
            self.counters.count_received(received);
        }
        Ok(received)
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        assert_eq!(to, self.end.peer, "a queue has one peer");
        let sent = self.end.push(datagram.to_vec());
        sent.inspect_err(|_| self.counters.reply_refused_count += 1)?;
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
