//! A link whose condition can be changed while messages are under way: what was offered before keeps
//! its fate. It decides neither when nor to what.

use hil_core::link_model::ReplayTally;
use hil_core::link_model::{Fate, LinkModel, LossCauses, MessageNumber};
use hil_core::time::Instant;

/// What takes the place of the topology's link.
#[derive(Debug)]
pub enum Replacement {
    /// Nothing: the topology's link goes on. It was offered nothing in between, so its random draws
    /// are where they were; outages, which are a matter of time, went on.
    None,
    /// Another link.
    Link(Box<dyn LinkModel>),
    /// Everything is lost.
    Cut,
}

/// The topology's link, or what takes its place.
#[derive(Debug)]
pub struct SwitchedLink<L> {
    own: L,
    replacement: Replacement,
    /// What former replacements lost.
    lost: LossCauses,
}

impl<L: LinkModel> SwitchedLink<L> {
    /// `own` as it is.
    pub const fn new(own: L) -> Self {
        Self {
            own,
            replacement: Replacement::None,
            lost: LossCauses {
                outage_count: 0,
                chance_count: 0,
                queue_count: 0,
            },
        }
    }

    /// Puts `replacement` in force for what is offered from now on, and gives back what was, so that the
    /// caller can drop it where there is time.
    #[must_use = "dropping it takes time"]
    pub fn switch(&mut self, replacement: Replacement) -> Replacement {
        let former = core::mem::replace(&mut self.replacement, replacement);
        self.lost = self.lost.plus(causes(&former));
        former
    }
}

fn causes(replacement: &Replacement) -> LossCauses {
    match replacement {
        Replacement::Link(link) => link.loss_causes().unwrap_or_default(),
        Replacement::None | Replacement::Cut => LossCauses::default(),
    }
}

impl<L: LinkModel> LinkModel for SwitchedLink<L> {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        match &mut self.replacement {
            Replacement::None => self.own.offer(now, length_bytes),
            Replacement::Link(link) => link.offer(now, length_bytes),
            Replacement::Cut => {
                self.lost.outage_count += 1;
                Fate::Lost
            }
        }
    }

    fn offer_numbered(
        &mut self,
        now: Instant,
        length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        match &mut self.replacement {
            Replacement::None => self.own.offer_numbered(now, length_bytes, message),
            _ => self.offer(now, length_bytes),
        }
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        self.own.replay_tally()
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        let own = self.own.loss_causes()?;
        Some(own.plus(self.lost).plus(causes(&self.replacement)))
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;

    use super::*;
    use crate::spec::{LinkPlace, LinkSpec, Way};

    const MS: Duration = Duration::from_millis(1);

    fn link(spec: &LinkSpec, channel: &str) -> Box<dyn LinkModel> {
        let place = LinkPlace {
            seed: 3,
            link: "hop",
            channel,
            way: Way::Forward,
        };
        spec.build(&place).unwrap()
    }

    /// Offers `count` messages a millisecond apart from `first` on, and gives their fates.
    fn offer(link: &mut dyn LinkModel, first: u32, count: u32) -> Vec<Fate> {
        let of = |index: u32| link.offer(Instant::ZERO + MS * index, 64);
        (first..first + count).map(of).collect()
    }

    #[test]
    fn what_is_offered_after_a_change_meets_it_and_nothing_before_does() {
        let own = link(&LinkSpec::fixed(5 * MS, 0.25), "a");
        let mut untouched = link(&LinkSpec::fixed(5 * MS, 0.25), "a");
        let mut switched = SwitchedLink::new(own);
        assert_eq!(offer(&mut switched, 0, 500), offer(&mut untouched, 0, 500));
        let by_hand = link(&LinkSpec::fixed(50 * MS, 0.0), "a.by-hand.1");
        assert!(matches!(
            switched.switch(Replacement::Link(by_hand)),
            Replacement::None
        ));
        for (index, fate) in (500..).zip(offer(&mut switched, 500, 500)) {
            let due = Instant::ZERO + MS * (index + 50);
            assert_eq!(fate, Fate::Delivered(due));
        }
        let former = switched.switch(Replacement::Cut);
        assert!(matches!(former, Replacement::Link(_)));
        assert_eq!(offer(&mut switched, 1_000, 100), [Fate::Lost; 100]);
        // The draws of the topology's link go on where they were.
        let _cut = switched.switch(Replacement::None);
        let fates = offer(&mut switched, 1_100, 500);
        assert_eq!(fates, offer(&mut untouched, 1_100, 500));
        let lost = untouched.loss_causes().unwrap().total();
        let causes = switched.loss_causes().unwrap();
        assert_eq!(causes.total(), lost + 100);
        assert_eq!(causes.outage_count, 100, "a cut is an outage");
    }

    #[test]
    fn losses_of_a_replacement_stay_counted_after_it_went() {
        let mut switched = SwitchedLink::new(link(&LinkSpec::default(), "a"));
        let lossy = link(&LinkSpec::fixed(MS, 0.5), "a.by-hand.1");
        drop(switched.switch(Replacement::Link(lossy)));
        let is_lost = |fate: &Fate| *fate == Fate::Lost;
        let fates = offer(&mut switched, 0, 2_000);
        let lost = fates.iter().filter(|fate| is_lost(fate)).count() as u64;
        assert!((850..1_150).contains(&lost), "{lost}");
        assert_eq!(switched.loss_causes().unwrap().chance_count, lost);
        drop(switched.switch(Replacement::None));
        assert_eq!(switched.loss_causes().unwrap().chance_count, lost);
    }

    #[test]
    fn equal_seeds_give_equal_changed_links() {
        let run = || {
            let mut switched = SwitchedLink::new(link(&LinkSpec::fixed(MS, 0.1), "a"));
            let mut fates = offer(&mut switched, 0, 300);
            let by_hand = link(&LinkSpec::fixed(9 * MS, 0.3), "a.by-hand.1");
            drop(switched.switch(Replacement::Link(by_hand)));
            fates.extend(offer(&mut switched, 300, 300));
            fates
        };
        assert_eq!(run(), run());
    }
}
