//! Any receiver behind link models, one for each channel of its flow: they lose and delay real datagrams,
//! so a run over an emulated link differs from one over the real link in one object. It reads no
//! clock, delays no replies (they go the other way) and wakes nobody; the caller waits until
//! [`DatagramReceiver::next_due`].

use core::cmp::Reverse;
use core::fmt;
use std::collections::BinaryHeap;
use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::link_model::{Fate, LinkModel, LossCauses, MessageNumber};
use hil_core::time::Instant;

use super::{
    DatagramReceiver, EmulatedDelay, EndReport, LinkCounts, Received, ReceiverCounters, SendRefusal,
};
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
}

impl Default for EmulatedSettings {
    /// One second of a 1 kHz channel, in datagrams of an Ethernet frame's content.
    fn default() -> Self {
        Self {
            capacity_count: 1024,
            datagram_bytes_max: 1472,
            clock: None,
        }
    }
}

/// What a datagram is to the link models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Offer {
    /// Which model it meets.
    pub channel: u16,
    /// Which message of its channel it belongs to; `None` where nobody can tell. Only a recorded
    /// trace asks: to it all pieces of a message are one.
    pub message: Option<MessageNumber>,
}

impl Offer {
    /// The fate that `link` gives it.
    pub fn meet(
        self,
        link: &mut (impl LinkModel + ?Sized),
        now: Instant,
        length_bytes: usize,
    ) -> Fate {
        match self.message {
            Some(message) => link.offer_numbered(now, length_bytes, message),
            None => link.offer(now, length_bytes),
        }
    }
}

/// Reads what a datagram is to the link models; `None` for one that meets none, such as a greeting: it
/// passes undelayed and changes the fate of no other.
pub type OfferOf = fn(&[u8]) -> Option<Offer>;

/// The link models of a flow.
pub trait FlowLinks: fmt::Debug + Send {
    /// Offers a datagram of `length_bytes` to the model of its channel and gives its fate; `None` where
    /// the channel has no model. Calls come in non-decreasing `now`.
    fn offer(&mut self, now: Instant, length_bytes: usize, offer: Offer) -> Option<Fate>;

    /// Tells what time it is while nothing is offered, for links that change by themselves.
    fn attend(&mut self, now: Instant);

    /// What the datagrams of `channel` were lost to so far; `None` where nobody tells.
    fn loss_causes(&self, channel: u16) -> Option<LossCauses>;
}

/// One link model for whatever is offered.
impl<L: LinkModel> FlowLinks for L {
    fn offer(&mut self, now: Instant, length_bytes: usize, offer: Offer) -> Option<Fate> {
        Some(offer.meet(self, now, length_bytes))
    }

    fn attend(&mut self, now: Instant) {
        LinkModel::attend(self, now);
    }

    fn loss_causes(&self, _channel: u16) -> Option<LossCauses> {
        LinkModel::loss_causes(self)
    }
}

/// Position in the order of delivery: due first, then arrival, and the buffer that holds it.
type Position = Reverse<(Instant, u64, usize)>;

/// A receiver whose arrivals pass a link model first.
pub struct EmulatedReceiver {
    inner: Box<dyn DatagramReceiver>,
    links: Box<dyn FlowLinks>,
    offer_of: OfferOf,
    settings: EmulatedSettings,
    /// One buffer per place and a last one for arrivals that find no place.
    storage: Box<[u8]>,
    /// The places that were ever used: memory for the others is never touched.
    held: Vec<Option<Received>>,
    /// Those of them that are free now.
    free: Vec<usize>,
    order: BinaryHeap<Position>,
    arrival_count: u64,
    newest_arrival: Instant,
    counters: ReceiverCounters,
    /// By channel number.
    lost: Vec<LinkCounts>,
    /// Datagrams of any channel that found all places taken; not the copies of those that found one.
    overflow_count: u64,
}

impl EmulatedReceiver {
    /// Puts `inner` behind `links`, which meet what `offer_of` says; no channel's number is above
    /// `channel_max`.
    ///
    /// # Panics
    /// When `settings` leaves no room for a datagram.
    pub fn new(
        inner: Box<dyn DatagramReceiver>,
        links: Box<dyn FlowLinks>,
        offer_of: OfferOf,
        channel_max: u16,
        settings: EmulatedSettings,
    ) -> Self {
        let capacity_count = settings.capacity_count;
        assert!(
            capacity_count > 0 && settings.datagram_bytes_max > 0,
            "an emulated link needs room for one datagram"
        );
        let storage = vec![0; (capacity_count + 1) * settings.datagram_bytes_max];
        Self {
            inner,
            links,
            offer_of,
            settings,
            storage: storage.into_boxed_slice(),
            held: Vec::with_capacity(capacity_count),
            free: Vec::with_capacity(capacity_count),
            order: BinaryHeap::with_capacity(capacity_count),
            arrival_count: 0,
            newest_arrival: Instant::from_ns(i64::MIN),
            counters: ReceiverCounters::default(),
            lost: vec![LinkCounts::default(); usize::from(channel_max) + 1],
            overflow_count: 0,
        }
    }

    /// Datagrams held now.
    pub fn held_count(&self) -> usize {
        self.order.len()
    }

    /// Where the next arrival is kept; the place beyond the last when there is none.
    fn next_place(&self) -> usize {
        let unused = self.held.len();
        self.free.last().copied().unwrap_or(unused)
    }

    /// Takes everything that has arrived below, at most as many as may be held.
    fn pull(&mut self, now: Instant) -> io::Result<()> {
        self.newest_arrival = self.newest_arrival.max(now);
        let longest = self.settings.datagram_bytes_max;
        for _ in 0..self.settings.capacity_count {
            let place = self.next_place();
            let buffer = &mut self.storage[place * longest..][..longest];
            let Some(received) = self.inner.receive(now, buffer)? else {
                break;
            };
            let arrived = self.settings.clock.map_or(now, |clock| clock());
            self.newest_arrival = self.newest_arrival.max(arrived);
            self.admit(received, place);
        }
        Ok(())
    }

    /// Decides the fate of the datagram in `place`.
    fn admit(&mut self, mut received: Received, place: usize) {
        let arrived = self.newest_arrival;
        received.no_room_count += self.overflow_count;
        let start = place * self.settings.datagram_bytes_max;
        let length_bytes = received.length_bytes;
        let offer = (self.offer_of)(&self.storage[start..start + length_bytes]);
        // The model is asked even when there is no room, so that the fate of the n-th datagram
        // does not depend on how full we were.
        let fate = offer.and_then(|offer| self.links.offer(arrived, length_bytes, offer));
        let Some((offer, fate)) = offer.zip(fate) else {
            let is_held = self.hold(received, place, arrived, None);
            self.overflow_count += u64::from(!is_held);
            return;
        };
        let channel = Some(offer.channel);
        let Some(due) = fate.arrival() else {
            if let Some(counts) = self.counts_of(channel) {
                counts.lost_count += 1;
            }
            return;
        };
        received.emulated = Some(EmulatedDelay { arrived, due });
        let is_held = self.hold(received, place, due, channel);
        self.overflow_count += u64::from(!is_held);
        if let Some(due) = fate.second_arrival() {
            let copy = self.next_place();
            self.storage.copy_within(
                start..start + length_bytes,
                copy * self.settings.datagram_bytes_max,
            );
            received.emulated = Some(EmulatedDelay { arrived, due });
            self.hold(received, copy, due, channel);
        }
    }

    /// Keeps the datagram in `place` until `due`, if that is a place; else counts it among the channel's, if it
    /// is of one, and gives false.
    fn hold(
        &mut self,
        received: Received,
        place: usize,
        due: Instant,
        channel: Option<u16>,
    ) -> bool {
        if place < self.held.len() {
            self.free.pop();
            self.held[place] = Some(received);
        } else if place < self.settings.capacity_count {
            self.held.push(Some(received));
        } else {
            if let Some(counts) = self.counts_of(channel) {
                counts.overflow_count += 1;
            }
            return false;
        }
        self.order.push(Reverse((due, self.arrival_count, place)));
        self.arrival_count += 1;
        true
    }

    fn counts_of(&mut self, channel: Option<u16>) -> Option<&mut LinkCounts> {
        self.lost.get_mut(usize::from(channel?))
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
        let start = place * self.settings.datagram_bytes_max;
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
        self.links.attend(now);
        self.inner.attend(now);
    }

    fn report(&self, now: Instant) -> EndReport {
        self.inner.report(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        self.inner.seal_counts()
    }

    fn link_counts(&self, channel: u16) -> Option<LinkCounts> {
        let counts = *self.lost.get(usize::from(channel))?;
        let causes = self.links.loss_causes(channel);
        Some(LinkCounts { causes, ..counts })
    }

    fn no_room_count(&self) -> u64 {
        self.inner.no_room_count() + self.overflow_count
    }

    /// Own counts of what was handed out; the rest from below.
    fn counters(&self) -> ReceiverCounters {
        let inner = self.inner.counters();
        let own = &self.counters;
        ReceiverCounters {
            received_count: own.received_count,
            software_stamp_count: own.software_stamp_count,
            hardware_stamp_count: own.hardware_stamp_count,
            truncated_count: own.truncated_count,
            ..inner
        }
    }
}

impl fmt::Debug for EmulatedReceiver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Without the buffers, which are long and say nothing.
        f.debug_struct("EmulatedReceiver")
            .field("inner", &self.inner)
            .field("links", &self.links)
            .field("held_count", &self.order.len())
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
#[path = "emulated_tests.rs"]
mod tests;
