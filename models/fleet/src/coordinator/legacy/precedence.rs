//! Who goes first through one section, and where the other waits: the original's rules for a
//! pair of robots. What follows from all sections together is decided elsewhere.

use core::cmp::Ordering;

use crate::coordinator::policy::{Contest, OrderingPolicy};
use crate::coordinator::roster::Roster;
use crate::coordinator::sections::ActiveSection;
use crate::messages::TO_GOAL;
use crate::section::{Side, Span};

/// What the coordinator believes of a robot when it orders a section.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Belief {
    /// Last authority sent, and believed delivered; `None` before the mission's first.
    pub(crate) commanded: Option<i32>,
    /// Last pose reported.
    pub(crate) index: usize,
    /// Pose where it could stop at the earliest.
    pub(crate) earliest_stop: usize,
}

impl Belief {
    /// The pose up to which it is believed allowed to go; `None` for the whole path and before
    /// the first order.
    fn held_at(&self) -> Option<usize> {
        self.commanded
            .and_then(|commanded| usize::try_from(commanded).ok())
    }

    /// It will stop before `start`, or it still could.
    fn can_stop_before(&self, start: usize) -> bool {
        self.earliest_stop < start
            || match self.commanded {
                Some(_) => self.held_at().is_some_and(|held| held < start),
                None => self.index < start,
            }
    }

    /// How far into a section it was allowed; the whole way counts most.
    fn allowed_beyond(&self, start: usize, end: usize) -> usize {
        match (self.commanded, self.held_at()) {
            (None, _) => self.index.saturating_sub(start),
            (Some(_), Some(held)) if held <= end => held.saturating_sub(start),
            _ => usize::MAX,
        }
    }
}

/// The order of one section.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Decision {
    /// Who goes first.
    pub(crate) leader: Side,
    /// Both could still wait, so the order may be turned round.
    pub(crate) is_reversible: bool,
    /// Where the leader must wait as well, because the other stands in its way: a deadlock made
    /// on purpose.
    pub(crate) leader_wait: Option<usize>,
}

impl Decision {
    fn fixed(leader: Side) -> Self {
        Self {
            leader,
            is_reversible: false,
            leader_wait: None,
        }
    }
}

/// Orders the section in `slot`; `None` when the slot is empty.
pub(crate) fn decide(
    slot: usize,
    roster: &Roster,
    beliefs: &[Belief],
    policy: &dyn OrderingPolicy,
    trailing_points: usize,
) -> Option<Decision> {
    let active = roster.sections().get(slot)?;
    let [first, second] = [Side::First, Side::Second]
        .map(|side| beliefs[active.robot(side)].can_stop_before(active.start(side)));
    Some(match (first, second) {
        (true, true) => Decision {
            leader: preferred(active, roster, policy),
            is_reversible: true,
            leader_wait: None,
        },
        (true, false) => Decision::fixed(Side::Second),
        (false, true) => Decision::fixed(Side::First),
        (false, false) => among_unstoppable(active, beliefs, trailing_points),
    })
}

/// Both could wait: who parks in the section yields, then the policy, then the way to the
/// section, then the lower number decides.
fn preferred(active: &ActiveSection, roster: &Roster, policy: &dyn OrderingPolicy) -> Side {
    let [first, second] = [Side::First, Side::Second].map(|side| {
        let robot = active.robot(side);
        (
            &roster.robots()[robot],
            robot,
            active.start(side),
            active.end(side),
        )
    });
    let parks_inside = [first, second].map(|(view, _, _, end)| end == view.last_index());
    match parks_inside {
        [true, false] => return Side::Second,
        [false, true] => return Side::First,
        _ => {}
    }
    let [first, second] =
        [first, second].map(|(view, robot, start, _)| view.contender(robot, start));
    let contest = Contest {
        section: active.section(),
        first,
        second,
    };
    let order = policy
        .compare(&contest)
        .then(first.to_start.cmp(&second.to_start));
    if order == Ordering::Greater {
        Side::Second
    } else {
        Side::First
    }
}

/// Neither can wait: one that began its mission inside goes first, else the order stays, else
/// the one allowed further goes first.
fn among_unstoppable(
    active: &ActiveSection,
    beliefs: &[Belief],
    trailing_points: usize,
) -> Decision {
    let belief = |side| &beliefs[active.robot(side)];
    let is_new = [Side::First, Side::Second].map(|side| belief(side).commanded.is_none());
    let leader = match (is_new, active.leader) {
        ([true, false], _) => Side::First,
        ([false, true], _) => Side::Second,
        (_, Some(leader)) => leader,
        _ => {
            let progress = |side| {
                let (start, end) = (active.start(side), active.end(side));
                let belief: &Belief = belief(side);
                (
                    belief.allowed_beyond(start, end),
                    belief.index.saturating_sub(start),
                )
            };
            if progress(Side::Second) > progress(Side::First) {
                Side::Second
            } else {
                Side::First
            }
        }
    };
    let mut decision = Decision::fixed(leader);
    let (leading, waiting) = (belief(leader), belief(leader.other()));
    let stands_at = waiting.held_at().unwrap_or(0).max(waiting.index);
    let sweep = Span {
        lower: leading.index,
        upper: active.end(leader),
    };
    let is_in_the_way = active
        .section()
        .partners(leader.other(), stands_at)
        .is_some_and(|(from, to)| from <= sweep.upper && sweep.lower <= to);
    if is_in_the_way {
        let conflict = active
            .section()
            .first_conflict(leader, leading.index, Span::at(stands_at));
        decision.leader_wait = conflict.map(|index| index.saturating_sub(trailing_points));
    }
    decision
}

/// Where the robot that goes second waits: short of the section until the leader is inside, then
/// short of all the leader has still to sweep.
pub(crate) fn wait_index(
    active: &ActiveSection,
    leader: Side,
    leader_index: usize,
    trailing_points: usize,
) -> usize {
    let waiting = leader.other();
    let start = active.start(waiting);
    let conflict = if leader_index <= active.start(leader) {
        start
    } else {
        let sweep = Span {
            lower: leader_index,
            upper: active.end(leader),
        };
        active
            .section()
            .first_conflict(waiting, start, sweep)
            .unwrap_or(start)
    };
    conflict.saturating_sub(trailing_points)
}

/// `TO_GOAL` or the pose as a message carries it.
pub(crate) fn as_authority(wait: Option<usize>) -> i32 {
    wait.map_or(TO_GOAL, |index| i32::try_from(index).unwrap_or(i32::MAX))
}
