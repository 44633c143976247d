//! Two links one after the other, as a radio hop before a fixed delay. It adds nothing of its own.

use hil_core::link_model::{Fate, LinkModel};
use hil_core::time::Instant;

/// What the first delivers sets out on the second when it arrives.
#[derive(Debug, Clone)]
pub struct InSeries<A, B> {
    first: A,
    second: B,
}

impl<A: LinkModel, B: LinkModel> InSeries<A, B> {
    /// `first`, then `second`. The first must deliver in order, as the second is asked in order of
    /// time.
    pub const fn new(first: A, second: B) -> Self {
        Self { first, second }
    }
}

impl<A: LinkModel, B: LinkModel> LinkModel for InSeries<A, B> {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        match self.first.offer(now, length_bytes) {
            Fate::Delivered(at) => self.second.offer(at, length_bytes),
            // The copy meets what the original meets: the second link is asked in order of time.
            Fate::Duplicated { first, second } => {
                let lag = second.saturating_duration_since(first);
                match self.second.offer(first, length_bytes).arrival() {
                    Some(at) => Fate::Duplicated {
                        first: at,
                        second: at + lag,
                    },
                    None => Fate::Lost,
                }
            }
            Fate::Lost => {
                // Asked all the same: what it draws for the n-th message must not depend on which
                // ones the first lost.
                let _unused = self.second.offer(now, length_bytes);
                Fate::Lost
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;

    use super::*;
    use crate::bernoulli::BernoulliLink;
    use crate::outages::{OutageLink, OutageSchedule, Outages};
    use hil_core::random::RandomStream;

    fn outages(per_hour: f64, buffered: bool) -> Outages {
        Outages {
            mean_s: 0.5,
            per_hour,
            buffered,
        }
    }

    fn link(outages: Outages) -> InSeries<OutageLink, BernoulliLink> {
        let stream = |name| RandomStream::new(5, name);
        let losses = BernoulliLink::new(Duration::from_millis(50), 0.1, stream("channel"));
        InSeries::new(
            OutageLink::new(outages, stream("outages"), Instant::ZERO).unwrap(),
            losses.unwrap(),
        )
    }

    #[test]
    fn outages_lose_more_and_change_nothing_else() {
        let (mut without, mut with) = (link(outages(0.0, false)), link(outages(600.0, false)));
        let stream = RandomStream::new(5, "outages");
        let mut schedule =
            OutageSchedule::new(outages(600.0, false), stream, Instant::ZERO).unwrap();
        let mut outage = schedule.next().unwrap();
        let mut lost_count = 0;
        for step in 0..50_000 {
            let now = Instant::from_ns(step * 8_000_000);
            while outage.end <= now {
                outage = schedule.next().unwrap();
            }
            let (plain, fate) = (without.offer(now, 10), with.offer(now, 10));
            if outage.covers(now) {
                assert_eq!(fate, Fate::Lost);
                lost_count += 1;
            } else {
                assert_eq!(fate, plain);
            }
        }
        assert!(lost_count > 1_000, "{lost_count}");
    }

    #[test]
    fn what_an_outage_held_has_the_delay_before_it() {
        let mut held = link(outages(600.0, true));
        let stream = RandomStream::new(5, "outages");
        let outage = OutageSchedule::new(outages(600.0, true), stream, Instant::ZERO)
            .unwrap()
            .next()
            .unwrap();
        let delivered: Vec<Fate> = (0..20).map(|_| held.offer(outage.begin, 10)).collect();
        let due = Fate::Delivered(outage.end + Duration::from_millis(50));
        assert!(delivered.contains(&due), "{delivered:?}");
        assert!(
            delivered
                .iter()
                .all(|fate| *fate == due || *fate == Fate::Lost)
        );
    }
}
