//! Any transport behind the seal: what its owner sends is sealed, what it receives is authentic. The keys
//! and what is refused are the business of [`hil_protocol::seal`]. It allocates nothing once made.

use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::time::Instant;

use super::{
    DatagramReceiver, DatagramSender, EndReport, Received, ReceiverCounters, SendRefusal,
    SenderCounters,
};
use hil_net::radio::RadioReport;
use hil_net::{TransmitStamp, TxToken};
use hil_protocol::seal::{Heard, Initiator, Opened, Responder, SealCounts, SealRefusal};
use hil_protocol::wire::{Kind, TAG_BYTES};

/// The longest datagram there is, and its tag.
const BUFFER_BYTES: usize = u16::MAX as usize + TAG_BYTES;
/// Refused datagrams that one call passes over at most, so that a flood of them cannot keep the
/// thread from its other work.
pub const REFUSED_PER_LOOK_MAX: usize = 16;

/// A sender as a gateway owns it: behind the seal where the hop has one. Whatever the transport,
/// one call through a pointer leads to the socket.
pub fn sender(
    sender: impl DatagramSender + 'static,
    seal: Option<Initiator>,
) -> Box<dyn DatagramSender> {
    match seal {
        Some(seal) => Box::new(SealedSender::new(sender, seal)),
        None => Box::new(sender),
    }
}

/// The same for a receiver of `peer`.
pub fn receiver(
    receiver: impl DatagramReceiver + 'static,
    peer: SocketAddr,
    seal: Option<Responder>,
) -> Box<dyn DatagramReceiver> {
    match seal {
        Some(seal) => Box::new(SealedReceiver::new(receiver, seal, peer)),
        None => Box::new(receiver),
    }
}

/// The sending end.
#[derive(Debug)]
pub struct SealedSender<S> {
    inner: S,
    seal: Initiator,
    buffer: Box<[u8]>,
    /// The greeting that keys were asked for with, and its length.
    greeting: Box<[u8]>,
    greeting_bytes: usize,
}

impl<S: DatagramSender> SealedSender<S> {
    /// Puts `inner` behind the seal.
    pub fn new(inner: S, seal: Initiator) -> Self {
        Self {
            inner,
            seal,
            buffer: vec![0; BUFFER_BYTES].into_boxed_slice(),
            greeting: vec![0; BUFFER_BYTES].into_boxed_slice(),
            greeting_bytes: 0,
        }
    }

    /// Keeps a greeting until keys are answered for, within a round trip; false for anything else.
    fn keep_greeting(&mut self, datagram: &[u8]) -> bool {
        if datagram[5] != Kind::Hello as u8 {
            return false;
        }
        self.greeting[..datagram.len()].copy_from_slice(datagram);
        self.greeting_bytes = datagram.len();
        true
    }

    /// Says the greeting that waited. If it cannot leave, its bridge says it again.
    fn send_greeting(&mut self) {
        let greeting = &self.greeting[..core::mem::take(&mut self.greeting_bytes)];
        if greeting.is_empty() {
            return;
        }
        if let Some(length) = self.seal.seal(greeting, &mut self.buffer) {
            let _counted = self.inner.send(&self.buffer[..length]).is_err();
        }
    }
}

impl<S: DatagramSender> DatagramSender for SealedSender<S> {
    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        let Some(length) = self.seal.seal_parts(head, tail, &mut self.buffer) else {
            return Err(SendRefusal::NotConnected);
        };
        self.inner.send(&self.buffer[..length])
    }

    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        if let Some(request) = self.seal.request_before(datagram) {
            let sent = self.inner.send(&request);
            // A greeting waits for the answer, so that it goes under keys that the peer has: one that
            // started anew would refuse it.
            if self.keep_greeting(datagram) {
                return sent;
            }
        }
        let Some(length) = self.seal.seal(datagram, &mut self.buffer) else {
            return Err(SendRefusal::NotConnected);
        };
        self.inner.send(&self.buffer[..length])
    }

    fn queued_bytes(&self) -> usize {
        self.inner.queued_bytes()
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        self.inner.next_stamp()
    }

    fn next_radio_report(&mut self) -> Option<RadioReport> {
        self.inner.next_radio_report()
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        for _ in 0..REFUSED_PER_LOOK_MAX {
            let Some(received) = self.inner.receive(buffer)? else {
                return Ok(None);
            };
            match self.seal.open(&mut buffer[..received.length_bytes]) {
                Ok(Heard::Reply(length_bytes)) => {
                    return Ok(Some(Received {
                        length_bytes,
                        ..received
                    }));
                }
                Ok(Heard::Keys | Heard::Nothing) => self.send_greeting(),
                Err(_counted) => {}
            }
        }
        Ok(None)
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        self.inner.poll_fd()
    }

    fn counters(&self) -> SenderCounters {
        self.inner.counters()
    }

    fn attend(&mut self, now: Instant) {
        self.inner.attend(now);
    }

    fn next_due(&self) -> Option<Instant> {
        self.inner.next_due()
    }

    fn has_unsent(&self) -> bool {
        self.inner.has_unsent()
    }

    fn report(&self, now: Instant) -> EndReport {
        self.inner.report(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        Some(self.seal.counts())
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct SealedReceiver<R> {
    inner: R,
    seal: Responder,
    /// The only address that is heard.
    peer: SocketAddr,
    buffer: Box<[u8]>,
}

impl<R: DatagramReceiver> SealedReceiver<R> {
    /// Puts `inner` behind the seal; what does not come from `peer` is refused unread.
    pub fn new(inner: R, seal: Responder, peer: SocketAddr) -> Self {
        Self {
            inner,
            seal,
            peer,
            buffer: vec![0; BUFFER_BYTES].into_boxed_slice(),
        }
    }
}

impl<R: DatagramReceiver> DatagramReceiver for SealedReceiver<R> {
    fn receive(&mut self, now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        for _ in 0..REFUSED_PER_LOOK_MAX {
            let Some(received) = self.inner.receive(now, buffer)? else {
                return Ok(None);
            };
            if received.source != self.peer {
                self.seal.refuse(SealRefusal::ForeignSource);
                continue;
            }
            match self.seal.open(&mut buffer[..received.length_bytes]) {
                Ok(Opened::Datagram(length_bytes)) => {
                    self.inner.prove();
                    return Ok(Some(Received {
                        length_bytes,
                        ..received
                    }));
                }
                Ok(Opened::Answer(answer)) => {
                    let _counted = self.inner.answer(&answer, received.source).is_err();
                }
                Err(_counted) => {}
            }
        }
        Ok(None)
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        let Some(length) = self.seal.seal(datagram, &mut self.buffer) else {
            return Err(SendRefusal::NotConnected);
        };
        self.inner.reply(&self.buffer[..length], to)
    }

    fn reply_stamped(
        &mut self,
        now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> Result<(), SendRefusal> {
        let Some(length) = self.seal.seal(datagram, &mut self.buffer) else {
            return Err(SendRefusal::NotConnected);
        };
        self.inner.reply_stamped(now, &self.buffer[..length], to)
    }

    fn take_reply_stamp(&mut self, now: Instant) -> Option<i64> {
        self.inner.take_reply_stamp(now)
    }

    fn next_due(&self) -> Option<Instant> {
        self.inner.next_due()
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        self.inner.poll_fd()
    }

    fn counters(&self) -> ReceiverCounters {
        self.inner.counters()
    }

    fn attend(&mut self, now: Instant) {
        self.inner.attend(now);
    }

    fn report(&self, now: Instant) -> EndReport {
        self.inner.report(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        Some(self.seal.counts())
    }
}

#[cfg(test)]
#[path = "sealed_tests.rs"]
mod tests;
