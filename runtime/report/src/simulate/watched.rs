//! A link model in virtual time under watch: what it does is counted, what becomes of each message is
//! noted, and what it loses as outages. It changes nothing of what the model does.

use std::cell::RefCell;
use std::rc::Rc;

use hil_account::network::{Crossing, Passage, Passages};
use hil_account::{Outage, OutageFinder};
use hil_core::link_model::{LinkModel, LossCauses};
use hil_core::message::Envelope;
use hil_core::simulation::Carrier;
use hil_core::time::Instant;
use hil_protocol::wire;

/// What a link model did, to be asked for when it is done.
#[derive(Debug, Clone)]
pub(super) struct Watch(Rc<RefCell<Seen>>);

#[derive(Debug, Default)]
struct Seen {
    outages: OutageFinder,
    lost_count: u64,
    causes: Option<LossCauses>,
    passages: Passages,
    duplicated_count: u64,
}

impl Watch {
    /// A carrier of what `link` lets through, and the watch over it.
    pub(super) fn over(link: Box<dyn LinkModel>) -> (Box<dyn Carrier>, Self) {
        let watch = Self(Rc::default());
        let watched = Watched {
            link,
            watch: watch.clone(),
        };
        (Box::new(watched), watch)
    }

    /// What was lost in a row so far.
    pub(super) fn outages(&self) -> Vec<Outage> {
        core::mem::take(&mut self.0.borrow_mut().outages).finish()
    }

    /// Messages that were lost so far.
    pub(super) fn lost_count(&self) -> u64 {
        self.0.borrow().lost_count
    }

    /// What they were lost to; `None` when the model does not tell.
    pub(super) fn loss_causes(&self) -> Option<LossCauses> {
        self.0.borrow().causes
    }

    /// The way of every message so far, and how many copies came on top.
    pub(super) fn passages(&self) -> (Passages, u64) {
        let mut seen = self.0.borrow_mut();
        (core::mem::take(&mut seen.passages), seen.duplicated_count)
    }
}

#[derive(Debug)]
struct Watched {
    link: Box<dyn LinkModel>,
    watch: Watch,
}

impl Carrier for Watched {
    fn offer(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
        deliver: &mut dyn FnMut(Instant, Envelope, &[u8]),
    ) {
        // The length that a gateway's model would be offered: a datagram, not a message.
        let length_bytes = payload.len() + wire::HEADER_BYTES;
        let fate = self.link.offer_numbered(now, length_bytes, envelope.into());
        let arrivals = [fate.arrival(), fate.second_arrival()];
        for at in arrivals.into_iter().flatten() {
            deliver(at, *envelope, payload);
        }
        let mut seen = self.watch.0.borrow_mut();
        seen.lost_count += u64::from(fate.arrival().is_none());
        seen.causes = self.link.loss_causes();
        seen.duplicated_count += u64::from(fate.second_arrival().is_some());
        seen.passages.push(&passage(now, envelope, fate.arrival()));
        let published_ns = Some(now.as_ns());
        match fate.arrival() {
            Some(at) => seen.outages.arrived(published_ns, Some(at.as_ns())),
            None => seen.outages.lost(envelope.sequence, 1, published_ns),
        }
    }
}

fn passage(now: Instant, envelope: &Envelope, arrival: Option<Instant>) -> Passage {
    Passage {
        epoch_rank: envelope.epoch,
        sequence: envelope.sequence,
        count: 1,
        offered_ns: Some(now.as_ns()),
        received_ns: arrival.map(Instant::as_ns),
        delay_ns: arrival.map(|at| at.ns_since(now)),
        delay_bound_ns: 0,
        crossing: if arrival.is_some() {
            Crossing::Arrived
        } else {
            Crossing::LostByNetwork
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::link_model::Fate;

    /// Down from 10 to 19 ms, otherwise 3 ms late.
    #[derive(Debug)]
    struct Down;

    impl LinkModel for Down {
        fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
            let ms = now.as_ns() / 1_000_000;
            if (10..20).contains(&ms) {
                Fate::Lost
            } else {
                Fate::Delivered(Instant::from_ns(now.as_ns() + 3_000_000))
            }
        }
    }

    #[test]
    fn a_watch_sees_what_the_model_loses_and_changes_nothing() {
        let (mut carrier, watch) = Watch::over(Box::new(Down));
        let mut delivered_count = 0;
        for sequence in 0..30_u64 {
            let ms = i64::try_from(sequence).unwrap();
            let envelope = Envelope {
                sequence,
                ..Envelope::default()
            };
            let now = Instant::from_ns(ms * 1_000_000);
            carrier.offer(now, &envelope, &[7], &mut |at, delivered, payload| {
                assert_eq!(at.as_ns(), (ms + 3) * 1_000_000);
                assert_eq!((delivered.sequence, payload), (sequence, &[7][..]));
                delivered_count += 1;
            });
        }
        assert_eq!(delivered_count, 20);
        let (passages, duplicated_count) = watch.passages();
        let passages: Vec<_> = passages.each().collect();
        assert_eq!((passages.len(), duplicated_count), (30, 0));
        assert_eq!(passages[9].delay_ns, Some(3_000_000));
        assert_eq!(passages[10].crossing, Crossing::LostByNetwork);
        assert_eq!(watch.lost_count(), 10);
        let outages = watch.outages();
        assert_eq!(outages.len(), 1);
        let found = outages[0];
        assert_eq!((found.lost_count, found.first_sequence), (10, 10));
        assert_eq!(found.from_ns, Some(10_000_000));
        assert_eq!(found.until_ns, Some(20_000_000));
        assert_eq!(found.silent_from_ns, Some(13_000_000));
        assert_eq!(found.silent_until_ns, Some(23_000_000));
    }
}
