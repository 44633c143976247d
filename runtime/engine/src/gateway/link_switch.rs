//! Where the condition of an emulated link changes under a thread that carries messages: changes come
//! to it ready made through a bounded ring, and what they replace goes back to be dropped elsewhere.

use hil_core::link_model::{Fate, LinkModel, LossCauses, MessageNumber, ReplayTally};
use hil_core::time::Instant;
use hil_link::condition::LinkCondition;
use hil_link::spec::LinkPlace;

use hil_topology::emulation::{EmulationError, EmulationLaunch};
use hil_topology::emulation_room::EmulationRoom;

/// Changes that may wait at a time for the thread to see them.
const CHANGES_MAX: usize = 16;

/// The link in the place of the topology's; `None` for the topology's own. That was offered nothing
/// meanwhile, so its random draws are where they were; outages, which are a matter of time, went on.
pub(super) type Replacement = Option<Box<dyn LinkModel>>;

/// A link on which everything is lost.
#[derive(Debug, Default)]
struct CutLink {
    lost_count: u64,
}

impl LinkModel for CutLink {
    fn offer(&mut self, _now: Instant, _length_bytes: usize) -> Fate {
        self.lost_count += 1;
        Fate::Lost
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        Some(LossCauses {
            outage_count: self.lost_count,
            ..LossCauses::default()
        })
    }
}

/// A change and the instant from which it holds.
#[derive(Debug)]
struct Change {
    from: Instant,
    replacement: Replacement,
}

/// A link that changes when it is told to: what was offered before keeps its fate. Looking for a change
/// costs one atomic read.
#[derive(Debug)]
pub(super) struct LinkSwitch<L> {
    own: L,
    replacement: Replacement,
    /// Losses of former replacements.
    lost: LossCauses,
    changes: rtrb::Consumer<Change>,
    former: rtrb::Producer<Replacement>,
}

/// The other end: on one channel's link, in a thread of normal priority.
#[derive(Debug)]
pub(super) struct SwitchHandle {
    channel: String,
    emulation: EmulationLaunch,
    room: EmulationRoom,
    changes: rtrb::Producer<Change>,
    former: rtrb::Consumer<Replacement>,
}

/// Puts a switch around `link`, the model of `channel` on `emulation`'s link with `room`.
pub(super) fn switch<L: LinkModel>(
    link: L,
    channel: &str,
    emulation: &EmulationLaunch,
    room: EmulationRoom,
) -> (LinkSwitch<L>, SwitchHandle) {
    let (to_thread, changes) = rtrb::RingBuffer::new(CHANGES_MAX);
    // Whoever sends a change empties this ring first, so there is always a place.
    let (former, from_thread) = rtrb::RingBuffer::new(2 * CHANGES_MAX);
    let handle = SwitchHandle {
        channel: channel.to_owned(),
        emulation: emulation.clone(),
        room,
        changes: to_thread,
        former: from_thread,
    };
    let link = LinkSwitch {
        own: link,
        replacement: None,
        lost: LossCauses::default(),
        changes,
        former,
    };
    (link, handle)
}

impl<L: LinkModel> LinkSwitch<L> {
    /// Puts `replacement` in force, and gives back what was, so that it can be dropped where there is
    /// time.
    fn put(&mut self, replacement: Replacement) -> Replacement {
        self.lost = self.lost.plus(self.replacement_lost());
        core::mem::replace(&mut self.replacement, replacement)
    }

    fn replacement_lost(&self) -> LossCauses {
        let causes = self.replacement.as_ref().and_then(LinkModel::loss_causes);
        causes.unwrap_or_default()
    }
}

impl<L: LinkModel> LinkModel for LinkSwitch<L> {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        self.attend(now);
        match &mut self.replacement {
            None => self.own.offer(now, length_bytes),
            Some(link) => link.offer(now, length_bytes),
        }
    }

    fn offer_numbered(
        &mut self,
        now: Instant,
        length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        self.attend(now);
        match &mut self.replacement {
            None => self.own.offer_numbered(now, length_bytes, message),
            Some(link) => link.offer_numbered(now, length_bytes, message),
        }
    }

    /// Puts in force what is due.
    fn attend(&mut self, now: Instant) {
        while self.changes.peek().is_ok_and(|change| change.from <= now) {
            let Ok(change) = self.changes.pop() else {
                return;
            };
            let former = self.put(change.replacement);
            let _no_place = self.former.push(former);
        }
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        self.own.replay_tally()
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        let own = self.own.loss_causes()?;
        Some(own.plus(self.lost).plus(self.replacement_lost()))
    }
}

impl SwitchHandle {
    /// What it is on.
    pub(super) const fn emulation(&self) -> &EmulationLaunch {
        &self.emulation
    }

    /// True when the gateway has room for what `condition` leaves under way.
    pub(super) fn can_hold(&self, condition: LinkCondition) -> bool {
        condition.delay() <= self.room.longest_delay()
    }

    /// True when a change finds a place. Drops what earlier changes replaced.
    pub(super) fn is_free(&mut self) -> bool {
        while self.former.pop().is_ok() {}
        !self.changes.is_full()
    }

    /// The link of `condition`, the `number`th that was asked for: each has random streams of its own.
    ///
    /// # Errors
    /// When a number is outside its range.
    pub(super) fn build(
        &self,
        condition: LinkCondition,
        number: u64,
    ) -> Result<Replacement, EmulationError> {
        if condition == LinkCondition::Cut {
            return Ok(Some(Box::new(CutLink::default())));
        }
        let Some(spec) = condition.spec() else {
            return Ok(None);
        };
        let link = spec.build(&LinkPlace {
            seed: self.emulation.seed,
            link: &self.emulation.link,
            channel: &format!("{}.by-hand.{number}", self.channel),
            way: self.emulation.way,
        })?;
        Ok(Some(link))
    }

    /// Has `replacement` hold from `from` on. Call it when [`Self::is_free`].
    pub(super) fn send(&mut self, from: Instant, replacement: Replacement) {
        let change = Change { from, replacement };
        let sent = self.changes.push(change);
        debug_assert!(sent.is_ok(), "the caller looked for a place");
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use hil_link::spec::{LinkSpec, Way};

    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn fixed(delay_ms: u32, loss_ratio: f64) -> LinkCondition {
        LinkCondition::Fixed {
            delay: MS * delay_ms,
            loss_ratio,
        }
    }

    fn switched() -> (LinkSwitch<Box<dyn LinkModel>>, SwitchHandle) {
        let emulation = EmulationLaunch {
            spec: LinkSpec::fixed(5 * MS, 0.0),
            link: "hop".to_owned(),
            way: Way::Forward,
            seed: 3,
            trace: None,
        };
        let room = emulation.room(64).unwrap();
        switch(emulation.model("a/b").unwrap(), "a/b", &emulation, room)
    }

    fn send(handle: &mut SwitchHandle, at: u32, condition: LinkCondition, number: u64) {
        assert!(handle.is_free());
        let replacement = handle.build(condition, number).unwrap();
        handle.send(Instant::ZERO + MS * at, replacement);
    }

    #[test]
    fn a_change_holds_from_its_instant_whether_messages_come_or_not() {
        let (mut link, mut handle) = switched();
        send(&mut handle, 100, fixed(50, 0.0), 1);
        send(&mut handle, 200, LinkCondition::Cut, 2);
        send(&mut handle, 300, LinkCondition::Topology, 3);
        for at in 0..400 {
            let now = Instant::ZERO + MS * at;
            let expected = match at {
                0..100 | 300.. => Fate::Delivered(now + 5 * MS),
                100..200 => Fate::Delivered(now + 50 * MS),
                200..300 => Fate::Lost,
            };
            assert_eq!(link.offer(now, 64), expected, "{at} ms");
        }
        assert_eq!(link.loss_causes().unwrap().outage_count, 100);
        // An idle link takes changes as well, so that they do not pile up.
        for number in 4..100 {
            let at = u32::try_from(number).unwrap() * 100;
            send(&mut handle, at, fixed(1, 0.0), number);
            link.attend(Instant::ZERO + MS * at);
        }
    }

    #[test]
    fn a_gateway_refuses_what_it_cannot_hold_and_what_it_has_no_place_for() {
        let (_link, mut handle) = switched();
        // 1044 datagrams of 100 messages per second.
        assert!(handle.can_hold(fixed(10_000, 0.0)));
        assert!(!handle.can_hold(fixed(11_000, 0.0)));
        for number in 0..CHANGES_MAX {
            send(&mut handle, 0, fixed(1, 0.5), number as u64);
        }
        assert!(!handle.is_free());
        assert!(handle.build(fixed(1, 1.5), 1).is_err());
    }

    fn link(spec: &LinkSpec, channel: &str) -> Box<dyn LinkModel> {
        spec.build(&LinkPlace::alone(3, channel)).unwrap()
    }

    fn switched_from(spec: &LinkSpec) -> LinkSwitch<Box<dyn LinkModel>> {
        let (mut switched, _handle) = switched();
        switched.own = link(spec, "a");
        switched
    }

    /// Offers `count` messages a millisecond apart from `first` on, and gives their fates.
    fn offer(link: &mut dyn LinkModel, first: u32, count: u32) -> Vec<Fate> {
        let of = |index: u32| link.offer(Instant::ZERO + MS * index, 64);
        (first..first + count).map(of).collect()
    }

    #[test]
    fn what_is_offered_after_a_change_meets_it_and_nothing_before_does() {
        let mut untouched = link(&LinkSpec::fixed(5 * MS, 0.25), "a");
        let mut switched = switched_from(&LinkSpec::fixed(5 * MS, 0.25));
        assert_eq!(offer(&mut switched, 0, 500), offer(&mut untouched, 0, 500));
        let by_hand = link(&LinkSpec::fixed(50 * MS, 0.0), "a.by-hand.1");
        assert!(switched.put(Some(by_hand)).is_none());
        for (index, fate) in (500..).zip(offer(&mut switched, 500, 500)) {
            let due = Instant::ZERO + MS * (index + 50);
            assert_eq!(fate, Fate::Delivered(due));
        }
        assert!(switched.put(Some(Box::new(CutLink::default()))).is_some());
        assert_eq!(offer(&mut switched, 1_000, 100), [Fate::Lost; 100]);
        // The draws of the topology's link go on where they were.
        drop(switched.put(None));
        let fates = offer(&mut switched, 1_100, 500);
        assert_eq!(fates, offer(&mut untouched, 1_100, 500));
        let lost = untouched.loss_causes().unwrap().total();
        let causes = switched.loss_causes().unwrap();
        assert_eq!(causes.total(), lost + 100);
        assert_eq!(causes.outage_count, 100, "a cut is an outage");
    }

    #[test]
    fn losses_of_a_replacement_stay_counted_after_it_went() {
        let mut switched = switched_from(&LinkSpec::default());
        drop(switched.put(Some(link(&LinkSpec::fixed(MS, 0.5), "a.by-hand.1"))));
        let is_lost = |fate: &Fate| *fate == Fate::Lost;
        let fates = offer(&mut switched, 0, 2_000);
        let lost = fates.iter().filter(|fate| is_lost(fate)).count() as u64;
        assert!((850..1_150).contains(&lost), "{lost}");
        assert_eq!(switched.loss_causes().unwrap().chance_count, lost);
        drop(switched.put(None));
        assert_eq!(switched.loss_causes().unwrap().chance_count, lost);
    }

    #[test]
    fn equal_seeds_give_equal_changed_links() {
        let run = || {
            let mut switched = switched_from(&LinkSpec::fixed(MS, 0.1));
            let mut fates = offer(&mut switched, 0, 300);
            drop(switched.put(Some(link(&LinkSpec::fixed(9 * MS, 0.3), "a.by-hand.1"))));
            fates.extend(offer(&mut switched, 300, 300));
            fates
        };
        assert_eq!(run(), run());
    }
}
