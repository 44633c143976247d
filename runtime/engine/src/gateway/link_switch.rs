//! Where the condition of an emulated link changes under a thread that carries messages: changes come
//! to it ready made through a bounded ring, and what they replace goes back to be dropped elsewhere. One
//! change is for all channels of the flow.

use hil_core::link_model::{Fate, LinkModel, LossCauses};
use hil_core::time::Instant;
use hil_link::condition::LinkCondition;
use hil_link::spec::LinkPlace;
use hil_transport::emulated::{FlowLinks, Offer};

use hil_topology::emulation::{EmulationError, EmulationLaunch};
use hil_topology::emulation_room::EmulationRoom;

/// Changes that may wait at a time for the thread to see them.
const CHANGES_MAX: usize = 16;

/// The link in the place of the topology's; `None` for the topology's own. That was offered nothing
/// meanwhile, so its random draws are where they were; outages, which are a matter of time, went on.
type Replacement = Option<Box<dyn LinkModel>>;

/// One for each channel, in their order.
pub(super) type Replacements = Box<[Replacement]>;

/// What the topology has one channel meet.
#[derive(Debug)]
pub(super) struct OwnLink {
    /// Number of the channel in datagrams.
    pub(super) number: u16,
    pub(super) channel: String,
    pub(super) emulation: EmulationLaunch,
    pub(super) room: EmulationRoom,
    pub(super) link: Box<dyn LinkModel>,
}

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
    replacements: Replacements,
}

/// The links of a flow's channels, which change when they are told to: what was offered before keeps its
/// fate. Looking for a change costs one atomic read.
#[derive(Debug)]
pub(super) struct LinkSwitch {
    /// By number.
    links: Box<[SwitchedLink]>,
    changes: rtrb::Consumer<Change>,
    former: rtrb::Producer<Replacements>,
}

/// The link of one channel.
#[derive(Debug)]
struct SwitchedLink {
    number: u16,
    own: Box<dyn LinkModel>,
    replacement: Replacement,
    /// Losses of former replacements.
    lost: LossCauses,
}

/// The other end: on all channels' links, in a thread of normal priority.
#[derive(Debug)]
pub(super) struct SwitchHandle {
    channels: Vec<SwitchedChannel>,
    changes: rtrb::Producer<Change>,
    former: rtrb::Consumer<Replacements>,
}

#[derive(Debug)]
struct SwitchedChannel {
    name: String,
    emulation: EmulationLaunch,
    room: EmulationRoom,
}

/// Puts a switch around the models of a flow; `None` for the other end when there is none.
pub(super) fn switch(mut links: Vec<OwnLink>) -> (LinkSwitch, Option<SwitchHandle>) {
    links.sort_by_key(|one| one.number);
    let (to_thread, changes) = rtrb::RingBuffer::new(CHANGES_MAX);
    // Whoever sends a change empties this ring first, so there is always a place.
    let (former, from_thread) = rtrb::RingBuffer::new(2 * CHANGES_MAX);
    let mut channels = Vec::new();
    let mut switched = Vec::new();
    for one in links {
        channels.push(SwitchedChannel {
            name: one.channel,
            emulation: one.emulation,
            room: one.room,
        });
        switched.push(SwitchedLink {
            number: one.number,
            own: one.link,
            replacement: None,
            lost: LossCauses::default(),
        });
    }
    let handle = (!channels.is_empty()).then_some(SwitchHandle {
        channels,
        changes: to_thread,
        former: from_thread,
    });
    let links = LinkSwitch {
        links: switched.into_boxed_slice(),
        changes,
        former,
    };
    (links, handle)
}

impl SwitchedLink {
    /// Puts `replacement` in force, and leaves what was in its place, so that it can be dropped where
    /// there is time.
    fn put(&mut self, replacement: &mut Replacement) {
        self.lost = self.lost.plus(self.replacement_lost());
        core::mem::swap(&mut self.replacement, replacement);
    }

    fn replacement_lost(&self) -> LossCauses {
        let causes = self.replacement.as_ref().and_then(LinkModel::loss_causes);
        causes.unwrap_or_default()
    }

    fn in_force(&mut self) -> &mut dyn LinkModel {
        match &mut self.replacement {
            None => &mut *self.own,
            Some(link) => &mut **link,
        }
    }
}

impl LinkSwitch {
    fn find(&self, number: u16) -> Option<usize> {
        let found = self.links.binary_search_by_key(&number, |one| one.number);
        found.ok()
    }
}

impl FlowLinks for LinkSwitch {
    fn offer(&mut self, now: Instant, length_bytes: usize, offer: Offer) -> Option<Fate> {
        self.attend(now);
        let index = self.find(offer.channel)?;
        let link = self.links[index].in_force();
        Some(offer.meet(link, now, length_bytes))
    }

    /// Puts in force what is due.
    fn attend(&mut self, now: Instant) {
        while self.changes.peek().is_ok_and(|change| change.from <= now) {
            let Ok(mut change) = self.changes.pop() else {
                return;
            };
            for (link, replacement) in self.links.iter_mut().zip(&mut change.replacements) {
                link.put(replacement);
            }
            let _no_place = self.former.push(change.replacements);
        }
    }

    fn loss_causes(&self, channel: u16) -> Option<LossCauses> {
        let link = &self.links[self.find(channel)?];
        let own = LinkModel::loss_causes(&link.own)?;
        Some(own.plus(link.lost).plus(link.replacement_lost()))
    }
}

impl SwitchHandle {
    /// What its channels are on, the first of them for all.
    pub(super) fn emulation(&self) -> &EmulationLaunch {
        &self.channels[0].emulation
    }

    /// True when the gateway has room for what `condition` leaves under way on every channel.
    pub(super) fn can_hold(&self, condition: LinkCondition) -> bool {
        let mut channels = self.channels.iter();
        channels.all(|one| condition.delay() <= one.room.longest_delay())
    }

    /// True when a change finds a place. Drops what earlier changes replaced.
    pub(super) fn is_free(&mut self) -> bool {
        while self.former.pop().is_ok() {}
        !self.changes.is_full()
    }

    /// The links of `condition`, the `number`th that was asked for: each has random streams of its own.
    ///
    /// # Errors
    /// When a number is outside its range.
    pub(super) fn build(
        &self,
        condition: LinkCondition,
        number: u64,
    ) -> Result<Replacements, EmulationError> {
        let channels = self.channels.iter();
        channels.map(|one| one.build(condition, number)).collect()
    }

    /// Has `replacements` hold from `from` on. Call it when [`Self::is_free`].
    pub(super) fn send(&mut self, from: Instant, replacements: Replacements) {
        let change = Change { from, replacements };
        let sent = self.changes.push(change);
        debug_assert!(sent.is_ok(), "the caller looked for a place");
    }
}

impl SwitchedChannel {
    fn build(&self, condition: LinkCondition, number: u64) -> Result<Replacement, EmulationError> {
        if condition == LinkCondition::Cut {
            return Ok(Some(Box::new(CutLink::default())));
        }
        let Some(spec) = condition.spec() else {
            return Ok(None);
        };
        let link = spec.build(&LinkPlace {
            seed: self.emulation.seed,
            link: &self.emulation.link,
            channel: &format!("{}.by-hand.{number}", self.name),
            way: self.emulation.way,
        })?;
        Ok(Some(link))
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

    fn own_link(number: u16, channel: &str) -> OwnLink {
        let emulation = EmulationLaunch {
            spec: LinkSpec::fixed(5 * MS, 0.0),
            link: "hop".to_owned(),
            way: Way::Forward,
            seed: 3,
            trace: None,
        };
        OwnLink {
            number,
            channel: channel.to_owned(),
            room: emulation.room(64).unwrap(),
            link: emulation.model(channel).unwrap(),
            emulation,
        }
    }

    fn switched() -> (LinkSwitch, SwitchHandle) {
        let (links, handle) = switch(vec![own_link(7, "a/b")]);
        (links, handle.unwrap())
    }

    fn ask(links: &mut LinkSwitch, channel: u16, now: Instant) -> Option<Fate> {
        let offer = Offer {
            channel,
            message: None,
        };
        FlowLinks::offer(links, now, 64, offer)
    }

    fn causes(links: &LinkSwitch) -> LossCauses {
        FlowLinks::loss_causes(links, 7).unwrap()
    }

    fn send(handle: &mut SwitchHandle, at: u32, condition: LinkCondition, number: u64) {
        assert!(handle.is_free());
        let replacements = handle.build(condition, number).unwrap();
        handle.send(Instant::ZERO + MS * at, replacements);
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
            assert_eq!(ask(&mut link, 7, now), Some(expected), "{at} ms");
        }
        assert_eq!(causes(&link).outage_count, 100);
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

    fn switched_from(spec: &LinkSpec) -> LinkSwitch {
        let own = OwnLink {
            link: link(spec, "a"),
            ..own_link(7, "a/b")
        };
        switch(vec![own]).0
    }

    /// Puts `replacement` in force at once; true when it took the place of another.
    fn put(switched: &mut LinkSwitch, replacement: Replacement) -> bool {
        let mut replacement = replacement;
        switched.links[0].put(&mut replacement);
        replacement.is_some()
    }

    fn offer_all(switched: &mut LinkSwitch, first: u32, count: u32) -> Vec<Fate> {
        let of = |index: u32| ask(switched, 7, Instant::ZERO + MS * index).unwrap();
        (first..first + count).map(of).collect()
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
        assert_eq!(
            offer_all(&mut switched, 0, 500),
            offer(&mut untouched, 0, 500)
        );
        let by_hand = link(&LinkSpec::fixed(50 * MS, 0.0), "a.by-hand.1");
        assert!(!put(&mut switched, Some(by_hand)));
        for (index, fate) in (500..).zip(offer_all(&mut switched, 500, 500)) {
            let due = Instant::ZERO + MS * (index + 50);
            assert_eq!(fate, Fate::Delivered(due));
        }
        assert!(put(&mut switched, Some(Box::new(CutLink::default()))));
        assert_eq!(offer_all(&mut switched, 1_000, 100), [Fate::Lost; 100]);
        // The draws of the topology's link go on where they were.
        put(&mut switched, None);
        let fates = offer_all(&mut switched, 1_100, 500);
        assert_eq!(fates, offer(&mut untouched, 1_100, 500));
        let lost = LinkModel::loss_causes(&untouched).unwrap().total();
        let causes = causes(&switched);
        assert_eq!(causes.total(), lost + 100);
        assert_eq!(causes.outage_count, 100, "a cut is an outage");
    }

    #[test]
    fn losses_of_a_replacement_stay_counted_after_it_went() {
        let mut switched = switched_from(&LinkSpec::default());
        put(
            &mut switched,
            Some(link(&LinkSpec::fixed(MS, 0.5), "a.by-hand.1")),
        );
        let is_lost = |fate: &Fate| *fate == Fate::Lost;
        let fates = offer_all(&mut switched, 0, 2_000);
        let lost = fates.iter().filter(|fate| is_lost(fate)).count() as u64;
        assert!((850..1_150).contains(&lost), "{lost}");
        assert_eq!(causes(&switched).chance_count, lost);
        put(&mut switched, None);
        assert_eq!(causes(&switched).chance_count, lost);
    }

    #[test]
    fn equal_seeds_give_equal_changed_links() {
        let run = || {
            let mut switched = switched_from(&LinkSpec::fixed(MS, 0.1));
            let mut fates = offer_all(&mut switched, 0, 300);
            put(
                &mut switched,
                Some(link(&LinkSpec::fixed(9 * MS, 0.3), "a.by-hand.1")),
            );
            fates.extend(offer_all(&mut switched, 300, 300));
            fates
        };
        assert_eq!(run(), run());
    }

    #[test]
    fn all_channels_of_a_flow_change_at_one_instant_each_with_draws_of_its_own() {
        let links = [9, 2, 5].map(|number| own_link(number, &format!("robot-{number}/state")));
        let (mut links, handle) = switch(links.into());
        let mut handle = handle.unwrap();
        send(&mut handle, 100, fixed(1, 0.5), 1);
        let mut fates = [(2, Vec::new()), (5, Vec::new()), (9, Vec::new())];
        for at in 0..400 {
            for (number, seen) in &mut fates {
                let now = Instant::ZERO + MS * at;
                let fate = ask(&mut links, *number, now).unwrap();
                if at < 100 {
                    assert_eq!(fate, Fate::Delivered(now + 5 * MS));
                } else {
                    assert!(matches!(fate, Fate::Lost) || fate == Fate::Delivered(now + MS));
                    seen.push(fate == Fate::Lost);
                }
            }
        }
        let [(_, two), (_, five), (_, nine)] = &fates;
        assert!(two != five && five != nine && two != nine);
        assert_eq!(ask(&mut links, 3, Instant::ZERO), None);
        assert!(switch(Vec::new()).1.is_none());
    }
}
