//! What authority one robot may hold: the account of every authority sent to it and of what its
//! states prove about them. It neither decides nor sends.
//!
//! **Claim.** Let a state of this mission say that, when it was sampled, the robot had applied
//! the authority of sequence `q` and held the authority `a`. From that moment on the robot holds
//! at most `max(a, largest index sent with a sequence above q)`.
//!
//! *Proof.* The robot applies only sequences above the last one it applied, and applying one
//! either sets its authority to that message's index or leaves it (refused). So each later
//! authority is `a` or the index of a message with a sequence above `q`.
//!
//! The claim holds for *every* state, in whatever order states arrive, however often, however
//! late; loss only leaves the bound where it was. Of two states the one with the larger `q` gives
//! the lower bound, because its `a` is one of the values over which the other takes its maximum.
//! So keeping the state with the largest `q` loses nothing, and no stale, repeated or reordered
//! state can lower the bound wrongly. States of equal `q` show the same authority.

use crate::messages::{NO_AUTHORITY, Phase, State, TO_GOAL};

/// Unacknowledged authorities that have to be remembered, at most. Each extension makes those
/// below it irrelevant, so only a chain of unacknowledged shrinks needs more than one.
pub const UNACKNOWLEDGED_MAX: usize = 4;

/// What a state did to a [`Ledger`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StateEffect {
    /// It belongs to another mission, or says nothing new.
    Nothing,
    /// It showed progress along the path or acknowledged an authority.
    News,
    /// It acknowledged the newest authority, which the robot refused.
    Refused,
    /// It says what cannot be: a sequence never sent, or an index beyond the path.
    Impossible,
    /// It shows an authority or a pose beyond what was granted.
    Exceeded,
}

/// One robot's account during one mission.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Ledger {
    mission_id: u32,
    last_index: usize,
    /// Furthest pose the robot is known to have passed.
    lower: usize,
    acknowledged: Entry,
    /// Sent and not known to be superseded: sequences ascend, indices descend strictly.
    open: [Entry; UNACKNOWLEDGED_MAX],
    open_count: usize,
    newest: Entry,
    /// Largest index sent.
    ceiling: usize,
    is_done: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
struct Entry {
    sequence: u32,
    index: usize,
}

impl Ledger {
    /// The account of a mission for which nothing was sent yet; its path ends at `last_index`.
    pub fn new(mission_id: u32, last_index: usize) -> Self {
        Self {
            mission_id,
            last_index,
            lower: 0,
            acknowledged: Entry::default(),
            open: [Entry::default(); UNACKNOWLEDGED_MAX],
            open_count: 0,
            newest: Entry::default(),
            ceiling: 0,
            is_done: false,
        }
    }

    /// The account of a mission under way of which nothing is known but `state`, and that nothing sent before can
    /// change what it shows. `None` when it says what cannot be.
    pub(crate) fn shown(last_index: usize, state: &State) -> Option<Self> {
        let mut ledger = Self::new(state.header.mission_id, last_index);
        let (index, sequence) = (ledger.held(state)?, state.applied_sequence);
        ledger.lower = ledger.passed(state)?;
        ledger.acknowledged = Entry { sequence, index };
        (ledger.newest, ledger.ceiling) = (ledger.acknowledged, index);
        ledger.is_done = ledger.shows_goal(state);
        Some(ledger)
    }

    fn shows_goal(&self, state: &State) -> bool {
        state.phase == Phase::Done as u8 && self.passed(state) == Some(self.last_index)
    }

    /// The mission.
    pub fn mission_id(&self) -> u32 {
        self.mission_id
    }

    /// Largest authority index that may be in force at the robot, now or at any later time,
    /// unless more is sent.
    pub fn bound(&self) -> usize {
        let open = self.open[..self.open_count].first();
        open.map_or(self.acknowledged.index, |entry| {
            self.acknowledged.index.max(entry.index)
        })
    }

    /// Furthest pose the robot is known to have passed; it only moves forward.
    pub fn lower(&self) -> usize {
        self.lower
    }

    /// True once a state showed the robot at its goal.
    pub fn is_done(&self) -> bool {
        self.is_done
    }

    /// Sequence and index of the newest authority sent; 0 and 0 before the first.
    pub fn newest(&self) -> (u32, usize) {
        (self.newest.sequence, self.newest.index)
    }

    /// True when a state showed the newest authority applied or refused.
    pub fn is_acknowledged(&self) -> bool {
        self.acknowledged.sequence == self.newest.sequence
    }

    /// True while a sent shrink is neither applied nor refused.
    pub fn is_shrinking(&self) -> bool {
        !self.is_acknowledged() && self.newest.index < self.bound()
    }

    /// Notes that an authority to `index` is sent now, and gives its sequence. `None` when too
    /// many shrinks are unacknowledged; nothing must be sent then.
    pub fn send(&mut self, index: usize) -> Option<u32> {
        let sequence = self.newest.sequence.checked_add(1)?;
        let index = index.min(self.last_index);
        let kept = self.open[..self.open_count]
            .iter()
            .take_while(|entry| entry.index > index)
            .count();
        if kept == UNACKNOWLEDGED_MAX {
            return None;
        }
        self.newest = Entry { sequence, index };
        self.ceiling = self.ceiling.max(index);
        self.open[kept] = self.newest;
        self.open_count = kept + 1;
        self.open[self.open_count..].fill(Entry::default());
        Some(sequence)
    }

    /// Takes over what `state` proves.
    pub fn on_state(&mut self, state: &State) -> StateEffect {
        if state.header.mission_id != self.mission_id || self.mission_id == 0 {
            return StateEffect::Nothing;
        }
        let (Some(held), Some(passed)) = (self.held(state), self.passed(state)) else {
            return StateEffect::Impossible;
        };
        if state.applied_sequence > self.newest.sequence {
            return StateEffect::Impossible;
        }
        let was = (self.lower, self.acknowledged, self.is_done);
        let shown = Entry {
            sequence: state.applied_sequence,
            index: held,
        };
        let is_first_answer = shown.sequence > self.acknowledged.sequence;
        let exceeds = is_first_answer && held > self.ceiling;
        if is_first_answer {
            self.acknowledge(shown);
        }
        self.lower = self.lower.max(passed);
        self.is_done |= self.shows_goal(state);
        if exceeds {
            return StateEffect::Exceeded;
        }
        if is_first_answer && self.is_acknowledged() && held != self.newest.index {
            return StateEffect::Refused;
        }
        if was == (self.lower, self.acknowledged, self.is_done) {
            StateEffect::Nothing
        } else {
            StateEffect::News
        }
    }

    fn acknowledge(&mut self, shown: Entry) {
        self.acknowledged = shown;
        let superseded = self.open[..self.open_count]
            .iter()
            .take_while(|entry| entry.sequence <= shown.sequence)
            .count();
        self.open.copy_within(superseded..self.open_count, 0);
        self.open_count -= superseded;
        self.open[self.open_count..].fill(Entry::default());
    }

    fn held(&self, state: &State) -> Option<usize> {
        match state.authority_index {
            NO_AUTHORITY => Some(0),
            TO_GOAL => Some(self.last_index),
            index => self.on_path(index),
        }
    }

    fn passed(&self, state: &State) -> Option<usize> {
        self.on_path(state.path_index)
    }

    fn on_path(&self, index: i32) -> Option<usize> {
        usize::try_from(index)
            .ok()
            .filter(|index| *index <= self.last_index)
    }
}

#[cfg(test)]
impl Ledger {
    /// Every sequence it keeps.
    pub(crate) fn sequences(&mut self) -> impl Iterator<Item = &mut u32> {
        let open = self.open[..self.open_count].iter_mut();
        let kept = [&mut self.acknowledged, &mut self.newest].into_iter();
        kept.chain(open).map(|entry| &mut entry.sequence)
    }

    /// Forgets what only a count rests on.
    pub(crate) fn forget_ceiling(&mut self) {
        self.ceiling = self.last_index;
    }

    /// A planted fault: what was sent last counts as acknowledged.
    pub(crate) fn plant_lost_acknowledgement(&mut self) {
        self.acknowledged = self.newest;
        (self.open, self.open_count) = (Default::default(), 0);
    }

    /// A planted fault: the next state counts as newer than all before.
    pub(crate) fn plant_stale_state(&mut self) {
        self.acknowledged = Entry::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    fn state(applied: u32, held: i32, passed: i32) -> State {
        let mut state = State {
            authority_index: held,
            applied_sequence: applied,
            path_index: passed,
            ..State::default()
        };
        state.header.mission_id = 7;
        state
    }

    #[test]
    fn an_extension_counts_at_once_and_a_shrink_only_when_acknowledged() {
        let mut ledger = Ledger::new(7, 100);
        assert_eq!((ledger.bound(), ledger.send(40)), (0, Some(1)));
        assert_eq!((ledger.bound(), ledger.send(20)), (40, Some(2)));
        assert_eq!(ledger.bound(), 40);
        assert!(ledger.is_shrinking());
        assert_eq!(ledger.on_state(&state(1, 40, 3)), StateEffect::News);
        assert_eq!(ledger.bound(), 40);
        assert_eq!(ledger.on_state(&state(2, 20, 3)), StateEffect::News);
        assert_eq!((ledger.bound(), ledger.lower()), (20, 3));
        // Stale news of the time before changes nothing.
        assert_eq!(ledger.on_state(&state(1, 40, 2)), StateEffect::Nothing);
        assert_eq!((ledger.bound(), ledger.lower()), (20, 3));
    }

    #[test]
    fn a_refused_shrink_leaves_the_bound_at_what_is_in_force() {
        let mut ledger = Ledger::new(7, 100);
        ledger.send(40);
        ledger.send(20);
        assert_eq!(ledger.on_state(&state(2, 40, 30)), StateEffect::Refused);
        assert_eq!(ledger.bound(), 40);
        assert!(!ledger.is_shrinking());
    }

    #[test]
    fn what_cannot_be_is_told_apart_from_what_must_not_be() {
        let mut ledger = Ledger::new(7, 100);
        ledger.send(40);
        assert_eq!(ledger.on_state(&state(2, 40, 0)), StateEffect::Impossible);
        assert_eq!(ledger.on_state(&state(1, 101, 0)), StateEffect::Impossible);
        assert_eq!(ledger.on_state(&state(1, 40, -1)), StateEffect::Impossible);
        assert_eq!(ledger.on_state(&state(1, 60, 0)), StateEffect::Exceeded);
        assert_eq!(ledger.bound(), 60);
    }

    #[test]
    fn a_chain_of_unacknowledged_shrinks_is_bounded() {
        let mut ledger = Ledger::new(7, 100);
        for index in [50, 40, 30, 20] {
            assert!(ledger.send(index).is_some());
        }
        assert_eq!(ledger.send(10), None);
        assert_eq!(ledger.send(60), Some(5));
        assert_eq!(ledger.bound(), 60);
    }

    /// The robot's side of the agreement, with a stop index drawn at random.
    fn apply(robot: &mut (u32, usize), sequence: u32, index: usize, stop_index: usize) {
        if sequence > robot.0 {
            let may_apply = index >= robot.1 || index >= stop_index;
            *robot = (sequence, if may_apply { index } else { robot.1 });
        }
    }

    #[test]
    fn no_order_of_messages_makes_the_bound_fall_below_what_is_in_force() {
        let mut random = RandomStream::new(1, "ledger");
        let mut pick =
            |count: usize| usize::try_from(random.next_u64() % count as u64).expect("below count");
        for _ in 0..2000 {
            let mut ledger = Ledger::new(7, 100);
            let (mut robot, mut commands, mut states) = ((0, 0), Vec::new(), Vec::new());
            for _ in 0..60 {
                match pick(4) {
                    0 => {
                        let index = pick(101);
                        commands.extend(ledger.send(index).map(|sequence| (sequence, index)));
                    }
                    // Any command ever sent may arrive again.
                    1 if !commands.is_empty() => {
                        let (sequence, index) = commands[pick(commands.len())];
                        apply(&mut robot, sequence, index, pick(101));
                    }
                    2 => states.push(state(robot.0, i32::try_from(robot.1).unwrap(), 0)),
                    _ if !states.is_empty() => {
                        ledger.on_state(&states[pick(states.len())]);
                    }
                    _ => {}
                }
                assert!(robot.1 <= ledger.bound());
                // Nor may any command still under way raise it above.
                for &(sequence, index) in &commands {
                    assert!(sequence <= robot.0 || index <= ledger.bound());
                }
            }
        }
    }
}
