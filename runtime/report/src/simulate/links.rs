//! What links do in virtual time: each message is offered at the length of its datagram, its passage
//! is noted, and so are losses in a row.

use core::time::Duration;
use std::collections::BTreeMap;

use hil_account::network::{Crossing, Passage, Passages};
use hil_account::{DemandFold, OutageFinder, Transfer};
use hil_core::link_model::{LinkModel, LossCauses};
use hil_core::message::Envelope;
use hil_core::simulation::{Carrier, CaseModel, ChannelMessage, Observe};
use hil_core::time::Instant;
use hil_protocol::wire;

/// A link model offered what a gateway would offer it: datagrams, not messages.
#[derive(Debug)]
pub(super) struct DatagramLink(pub(super) Box<dyn LinkModel>);

impl Carrier for DatagramLink {
    fn offer(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
        deliver: &mut dyn FnMut(Instant, Envelope, &[u8]),
    ) {
        let length_bytes = payload.len() + wire::HEADER_BYTES;
        let fate = self.0.offer_numbered(now, length_bytes, envelope.into());
        for at in fate.arrivals() {
            deliver(at, *envelope, payload);
        }
    }

    fn losses(&self) -> Option<LossCauses> {
        self.0.loss_causes()
    }
}

/// The messages of one link: passages, copies, outages.
#[derive(Debug, Default)]
pub(super) struct LinkAccount {
    /// Every message in order.
    pub(super) passages: Passages,
    /// Sequence number of the newest.
    newest: Option<u64>,
    /// Copies that came on top.
    pub(super) duplicated_count: u64,
    /// What was lost in a row.
    pub(super) outages: OutageFinder,
    /// Whether the demand of its channel is met, if the topology states one.
    pub(super) demand: Option<DemandFold>,
}

impl LinkAccount {
    fn push(&mut self, now: Instant, envelope: &Envelope, arrival: Option<Instant>) {
        self.newest = Some(envelope.sequence);
        self.passages.push(&Passage {
            epoch_rank: envelope.epoch,
            sequence: envelope.sequence,
            count: 1,
            offered_ns: Some(now.as_ns()),
            received_ns: arrival.map(Instant::as_ns),
            delay_ns: arrival.map(|at| at.ns_since(now)),
            delay_bound_ns: 0,
            crossing: match arrival {
                Some(_) => Crossing::Arrived,
                None => Crossing::LostByNetwork,
            },
        });
        let published_ns = Some(now.as_ns());
        if let Some(demand) = &mut self.demand {
            let transfer = arrival.map_or(Transfer::Lost, |at| Transfer::Received {
                delay_ns: at.ns_since(now),
                bound_ns: 0,
            });
            demand.offer(published_ns, 1, transfer);
        }
        match arrival {
            Some(at) => self.outages.arrived(published_ns, Some(at.as_ns())),
            None => self.outages.lost(envelope.sequence, 1, published_ns, true),
        }
    }

    fn is_newest(&self, envelope: &Envelope) -> bool {
        self.newest == Some(envelope.sequence)
    }
}

/// The accounts of all links, by the name of their channel.
#[derive(Debug)]
pub(super) struct LinkAccounts(pub(super) BTreeMap<String, LinkAccount>);

impl Observe<CaseModel> for LinkAccounts {
    fn delivered(&mut self, now: Instant, message: &ChannelMessage, at: Instant) {
        if let Some(account) = self.0.get_mut(message.spec.name) {
            if account.is_newest(&message.envelope) {
                account.duplicated_count += 1;
            } else {
                account.push(now, &message.envelope, Some(at));
            }
        }
    }

    fn dropped(&mut self, now: Instant, message: &ChannelMessage) {
        if let Some(account) = self.0.get_mut(message.spec.name) {
            account.push(now, &message.envelope, None);
        }
    }
}

/// Tells which share of a run is over.
pub(super) struct Progress<'w> {
    /// The run's length.
    pub(super) duration: Duration,
    /// When to tell next.
    pub(super) next: Instant,
    /// Is told.
    pub(super) watch: &'w mut dyn FnMut(f64),
}

/// How often a run's progress is shown.
const LOOK_COUNT: u32 = 1000;

impl Observe<CaseModel> for Progress<'_> {
    fn next_tick(&self) -> Option<Instant> {
        Some(self.next)
    }

    fn ticked(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(Instant::ZERO);
        (self.watch)(passed.as_secs_f64() / self.duration.as_secs_f64());
        let step = self.duration / LOOK_COUNT;
        self.next = now + step.max(Duration::from_nanos(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::link_model::Fate;
    use hil_core::simulation::Simulation;
    use hil_shuttle::Shuttle;

    /// Down from 100 to 190 ms, otherwise 3 ms late, at 300 ms twice.
    #[derive(Debug)]
    struct Down;

    impl LinkModel for Down {
        fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
            assert!(length_bytes > wire::HEADER_BYTES);
            let first = now + Duration::from_millis(3);
            match now.as_ns() / 1_000_000 {
                100..200 => Fate::Lost,
                300 => Fate::Duplicated {
                    first,
                    second: first,
                },
                _ => Fate::Delivered(first),
            }
        }
    }

    #[test]
    fn accounts_see_what_the_model_loses_and_repeats_and_progress_is_told() {
        let case = Shuttle::default();
        let name = "shuttle/command";
        let link: Box<dyn Carrier> = Box::new(DatagramLink(Box::new(Down)));
        let carriers = BTreeMap::from([(name.to_owned(), link)]);
        let mut accounts =
            LinkAccounts(BTreeMap::from([(name.to_owned(), LinkAccount::default())]));
        let mut shares = Vec::new();
        let mut watch = |share| shares.push(share);
        let duration = Duration::from_millis(500);
        let mut progress = Progress {
            duration,
            next: Instant::ZERO,
            watch: &mut watch,
        };
        let simulation = Simulation::new(&case, carriers).unwrap();
        let result = simulation
            .run_observed(duration, &mut (&mut accounts, &mut progress))
            .unwrap();
        let counts = result.channels[name];
        let account = accounts.0.remove(name).unwrap();
        let passages: Vec<Passage> = account.passages.each().collect();
        assert_eq!(passages.len() as u64, counts.published_count);
        let of_delivered = |passage: &&Passage| passage.delay_ns == Some(3_000_000);
        let delivered = passages.iter().filter(of_delivered).count() as u64;
        assert_eq!(delivered + counts.lost_count, counts.published_count);
        assert_eq!(account.duplicated_count, 1);
        let outages = account.outages.finish();
        assert_eq!(outages.len(), 1);
        let found = outages[0];
        assert_eq!(found.lost_count, counts.lost_count);
        assert!(counts.lost_count >= 9);
        let ms = |ns: Option<i64>| ns.unwrap() / 1_000_000;
        assert_eq!((ms(found.from_ns), ms(found.until_ns)), (100, 200));
        assert_eq!(
            (ms(found.silent_from_ns), ms(found.silent_until_ns)),
            (103, 203)
        );
        assert!(shares.len() > 990 && shares.is_sorted());
    }
}
