//! Any receiver behind a link model: it loses and delays real datagrams as the model says, so a
//! run over an emulated link differs from one over the real link in one object. It reads no
//! clock, delays no replies (they go the other way) and wakes nobody; the caller waits until
//! [`DatagramReceiver::next_due`].

use core::cmp::Reverse;
use core::fmt;
use std::collections::BinaryHeap;
use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::link_model::{LinkModel, MessageNumber};
use hil_core::time::Instant;

use super::{DatagramReceiver, EmulatedDelay, EndReport, Received, ReceiverCounters, SendRefusal};
use hil_protocol::seal::SealCounts;

/// How much an emulated link may hold.
#[derive(Debug, Clone, Copy)]
pub struct EmulatedSettings {
    /// Datagrams held at a time; further arrivals are dropped and counted.
    pub capacity_count: usize,
    /// Longest datagram; longer ones are cut and say so.
    pub datagram_bytes_max: usize,
    /// Read after each datagram was taken from below: the caller's `now` is older than that, by
    /// milliseconds if the thread was held up in between, and a datagram would be early by as
    /// much. `None` trusts `now`, as virtual time does.
    pub clock: Option<fn() -> Instant>,
    /// Which message of its channel a datagram belongs to; `None` where nobody can tell. Only a
    /// recorded trace asks: to it all pieces of a message are one.
    pub number_of: Option<NumberOf>,
}

impl Default for EmulatedSettings {
    /// One second of a 1 kHz channel, in datagrams of an Ethernet frame's content.
    fn default() -> Self {
        Self {
            capacity_count: 1024,
            datagram_bytes_max: 1472,
            clock: None,
            number_of: None,
        }
    }
}

/// Reads which message of its channel a datagram belongs to.
pub type NumberOf = fn(&[u8]) -> Option<MessageNumber>;

/// Position in the order of delivery: due first, then arrival, and the buffer that holds it.
type Position = Reverse<(Instant, u64, usize)>;

/// A receiver whose arrivals pass a link model first.
pub struct EmulatedReceiver {
    inner: Box<dyn DatagramReceiver>,
    link: Box<dyn LinkModel>,
    is_exempt: fn(&[u8]) -> bool,
    datagram_bytes_max: usize,
    clock: Option<fn() -> Instant>,
    number_of: Option<NumberOf>,
    /// One buffer per place and a last one for arrivals that find no place.
    storage: Box<[u8]>,
    held: Box<[Option<Received>]>,
    free: Vec<usize>,
    order: BinaryHeap<Position>,
    arrival_count: u64,
    newest_arrival: Instant,
    counters: ReceiverCounters,
}

impl EmulatedReceiver {
    /// Puts `inner` behind `link`. Datagrams that `is_exempt` accepts, such as handshakes, pass
    /// undelayed and without being offered, so that they do not change the fate of the others.
    ///
    /// # Panics
    /// When `settings` leaves no room for a datagram.
    pub fn new(
        inner: Box<dyn DatagramReceiver>,
        link: Box<dyn LinkModel>,
        is_exempt: fn(&[u8]) -> bool,
        settings: EmulatedSettings,
    ) -> Self {
        let EmulatedSettings {
            capacity_count,
            datagram_bytes_max,
            clock,
            number_of,
        } = settings;
        assert!(
            capacity_count > 0 && datagram_bytes_max > 0,
            "an emulated link needs room for one datagram"
        );
        let storage = vec![0; (capacity_count + 1) * datagram_bytes_max];
        Self {
            inner,
            link,
            is_exempt,
            datagram_bytes_max,
            clock,
            number_of,
            storage: storage.into_boxed_slice(),
            held: vec![None; capacity_count].into_boxed_slice(),
            free: (0..capacity_count).rev().collect(),
            order: BinaryHeap::with_capacity(capacity_count),
            arrival_count: 0,
            newest_arrival: Instant::from_ns(i64::MIN),
            counters: ReceiverCounters::default(),
        }
    }

    /// Datagrams held now.
    pub fn held_count(&self) -> usize {
        self.order.len()
    }

    /// Takes everything that has arrived below, at most as many as may be held.
    fn pull(&mut self, now: Instant) -> io::Result<()> {
        self.newest_arrival = self.newest_arrival.max(now);
        for _ in 0..self.held.len() {
            let overflow = self.held.len();
            let place = self.free.last().copied().unwrap_or(overflow);
            let start = place * self.datagram_bytes_max;
            let buffer = &mut self.storage[start..start + self.datagram_bytes_max];
            let Some(received) = self.inner.receive(now, buffer)? else {
                break;
            };
            let arrived = self.clock.map_or(now, |clock| clock());
            self.newest_arrival = self.newest_arrival.max(arrived);
            self.admit(received, place);
        }
        Ok(())
    }

    /// Decides the fate of the datagram in `place`.
    fn admit(&mut self, mut received: Received, place: usize) {
        let arrived = self.newest_arrival;
        let start = place * self.datagram_bytes_max;
        let datagram = &self.storage[start..start + received.length_bytes];
        if (self.is_exempt)(datagram) {
            self.hold(received, place, arrived);
            return;
        }
        // The model is asked even when there is no room, so that the fate of the n-th datagram
        // does not depend on how full we were.
        let number = self.number_of.and_then(|number_of| number_of(datagram));
        let fate = match number {
            Some(number) => self
                .link
                .offer_numbered(arrived, received.length_bytes, number),
            None => self.link.offer(arrived, received.length_bytes),
        };
        let Some(due) = fate.arrival() else {
            self.counters.link_lost_count += 1;
            return;
        };
        received.emulated = Some(EmulatedDelay { arrived, due });
        self.hold(received, place, due);
        if let Some(due) = fate.second_arrival() {
            let copy = self.free.last().copied().unwrap_or(self.held.len());
            self.storage.copy_within(
                start..start + received.length_bytes,
                copy * self.datagram_bytes_max,
            );
            received.emulated = Some(EmulatedDelay { arrived, due });
            self.hold(received, copy, due);
        }
    }

    /// Keeps the datagram in `place` until `due`, if that is a place.
    fn hold(&mut self, received: Received, place: usize, due: Instant) {
        let Some(slot) = self.held.get_mut(place) else {
            self.counters.link_overflow_count += 1;
            return;
        };
        *slot = Some(received);
        self.free.pop();
        self.order.push(Reverse((due, self.arrival_count, place)));
        self.arrival_count += 1;
    }
}

impl DatagramReceiver for EmulatedReceiver {
    fn receive(&mut self, now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        self.pull(now)?;
        let Some(&Reverse((due, _, place))) = self.order.peek() else {
            return Ok(None);
        };
        if due > now {
            return Ok(None);
        }
        self.order.pop();
        self.free.push(place);
        let held = self.held[place].take();
        let mut received = held.expect("a place in the order holds a datagram");
        let start = place * self.datagram_bytes_max;
        let length_bytes = received.length_bytes.min(buffer.len());
        buffer[..length_bytes].copy_from_slice(&self.storage[start..start + length_bytes]);
        received.is_truncated |= length_bytes < received.length_bytes;
        received.length_bytes = length_bytes;
        self.counters.count_received(&received);
        Ok(Some(received))
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        self.inner.reply(datagram, to)
    }

    fn reply_stamped(
        &mut self,
        now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> Result<(), SendRefusal> {
        self.inner.reply_stamped(now, datagram, to)
    }

    fn take_reply_stamp(&mut self, now: Instant) -> Option<i64> {
        self.inner.take_reply_stamp(now)
    }

    fn next_due(&self) -> Option<Instant> {
        let own = self.order.peek().map(|&Reverse((due, _, _))| due);
        match (own, self.inner.next_due()) {
            (Some(own), Some(inner)) => Some(own.min(inner)),
            (own, inner) => own.or(inner),
        }
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        self.inner.poll_fd()
    }

    fn attend(&mut self, now: Instant) {
        self.link.attend(now);
        self.inner.attend(now);
    }

    fn report(&self, now: Instant) -> EndReport {
        self.inner.report(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        self.inner.seal_counts()
    }

    /// Own counts of what was handed out, lost and dropped; the rest from below.
    fn counters(&self) -> ReceiverCounters {
        let inner = self.inner.counters();
        let own = &self.counters;
        ReceiverCounters {
            received_count: own.received_count,
            software_stamp_count: own.software_stamp_count,
            hardware_stamp_count: own.hardware_stamp_count,
            truncated_count: own.truncated_count,
            link_lost_count: inner.link_lost_count + own.link_lost_count,
            link_overflow_count: inner.link_overflow_count + own.link_overflow_count,
            link_loss_causes: self.link.loss_causes().or(inner.link_loss_causes),
            ..inner
        }
    }
}

impl fmt::Debug for EmulatedReceiver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Without the buffers, which are long and say nothing.
        f.debug_struct("EmulatedReceiver")
            .field("inner", &self.inner)
            .field("link", &self.link)
            .field("held_count", &self.order.len())
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
#[path = "emulated_tests.rs"]
mod tests;
