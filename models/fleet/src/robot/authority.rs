//! What a robot makes of an authority: the original's rules and those of acknowledged movement
//! authority, as decisions without effect.

use crate::messages::{NO_AUTHORITY, TO_GOAL, TruthKind};

/// The authority in force and what is known of newer ones.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grant {
    /// As received; [`NO_AUTHORITY`] before the first.
    pub(crate) index: i32,
    /// Sequence last applied or noted; `None` before the first.
    pub(crate) applied: Option<u32>,
    /// Newest sequence seen.
    pub(crate) newest: Option<u32>,
    /// The newest was refused.
    pub(crate) is_refused: bool,
    /// The one in force came too late to stop at.
    pub(crate) is_late: bool,
}

impl Grant {
    pub(crate) const NONE: Self = Self {
        index: NO_AUTHORITY,
        applied: None,
        newest: None,
        is_refused: false,
        is_late: false,
    };

    pub(crate) const fn is_given(&self) -> bool {
        self.index != NO_AUTHORITY
    }

    /// Last pose the robot may reach, of a path that ends at `last_index`; 0 before the first.
    pub(crate) fn reach(&self, last_index: usize) -> usize {
        reach_of(self.index, last_index).unwrap_or(0)
    }
}

/// Last pose that `authority_index` lets a robot reach; `None` for a number without meaning.
pub(crate) fn reach_of(authority_index: i32, last_index: usize) -> Option<usize> {
    if authority_index == TO_GOAL {
        return Some(last_index);
    }
    let index = usize::try_from(authority_index).ok()?;
    Some(index.min(last_index))
}

/// True when `number` comes after `reference` on a counter that wraps.
pub(crate) const fn is_newer(number: u32, reference: u32) -> bool {
    let ahead = number.wrapping_sub(reference);
    ahead != 0 && ahead < 1 << 31
}

/// What becomes of an authority.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    Apply,
    /// Applied though the robot cannot stop there any more.
    ApplyLate,
    /// It is the one in force.
    Unchanged,
    /// Behind the robot: the old one stays.
    Ignore,
    /// The robot cannot stop there: the old one stays, and the controller is told.
    Refuse,
    Stale,
}

impl Verdict {
    pub(crate) const fn kind(self) -> TruthKind {
        match self {
            Self::Apply => TruthKind::AuthorityApplied,
            Self::ApplyLate => TruthKind::AuthorityLate,
            Self::Ignore => TruthKind::AuthorityIgnored,
            Self::Refuse => TruthKind::AuthorityRefused,
            Self::Unchanged | Self::Stale => TruthKind::MessageStale,
        }
    }
}

/// An authority as a robot sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Proposal {
    pub(crate) index: i32,
    pub(crate) sequence: u32,
    /// Last pose it lets the robot reach.
    pub(crate) reach: usize,
    /// Last pose the grant in force lets it reach.
    pub(crate) reach_now: usize,
    /// Pose the robot has passed last.
    pub(crate) passed: usize,
    pub(crate) can_stop: bool,
}

/// The original's rules: an order to stop behind the robot is dropped and it drives on; one it
/// cannot keep any more makes it brake at once and go past. Equal sequences are taken again.
pub(crate) fn original(grant: &Grant, proposal: &Proposal) -> Verdict {
    if grant
        .newest
        .is_some_and(|newest| is_newer(newest, proposal.sequence))
    {
        return Verdict::Stale;
    }
    if grant.is_given() && proposal.index == grant.index {
        return Verdict::Unchanged;
    }
    if proposal.index == TO_GOAL || !grant.is_given() {
        return Verdict::Apply;
    }
    if proposal.reach <= proposal.passed {
        return Verdict::Ignore;
    }
    if proposal.can_stop {
        Verdict::Apply
    } else {
        Verdict::ApplyLate
    }
}

/// Acknowledged movement authority: only newer sequences count, more way is always taken, less
/// only when the robot can still stop in it.
pub(crate) fn acknowledged(grant: &Grant, proposal: &Proposal) -> Verdict {
    if grant
        .newest
        .is_some_and(|newest| !is_newer(proposal.sequence, newest))
    {
        return Verdict::Stale;
    }
    let is_extending = !grant.is_given() || proposal.reach >= proposal.reach_now;
    if is_extending || proposal.can_stop {
        Verdict::Apply
    } else {
        Verdict::Refuse
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grant(index: i32, newest: u32) -> Grant {
        Grant {
            index,
            applied: Some(newest),
            newest: Some(newest),
            ..Grant::NONE
        }
    }

    fn proposal(index: i32, sequence: u32, can_stop: bool) -> Proposal {
        Proposal {
            index,
            sequence,
            reach: reach_of(index, 100).unwrap(),
            reach_now: 50,
            passed: 20,
            can_stop,
        }
    }

    #[test]
    fn the_original_drops_what_is_behind_and_overruns_what_is_near() {
        let check = |index, sequence, can_stop, expected| {
            let verdict = original(&grant(50, 7), &proposal(index, sequence, can_stop));
            assert_eq!(verdict, expected, "{index} {sequence}");
        };
        check(50, 8, true, Verdict::Unchanged);
        check(50, 7, true, Verdict::Unchanged);
        check(TO_GOAL, 8, true, Verdict::Apply);
        check(30, 8, true, Verdict::Apply);
        check(21, 8, false, Verdict::ApplyLate);
        check(20, 8, false, Verdict::Ignore);
        check(60, 6, true, Verdict::Stale);
        let first = original(&Grant::NONE, &proposal(0, 1, true));
        assert_eq!(first, Verdict::Apply);
    }

    #[test]
    fn an_acknowledged_authority_grows_freely_and_shrinks_only_to_where_one_can_stop() {
        let check = |index, sequence, can_stop, expected| {
            let verdict = acknowledged(&grant(50, 7), &proposal(index, sequence, can_stop));
            assert_eq!(verdict, expected, "{index} {sequence}");
        };
        check(50, 7, true, Verdict::Stale);
        check(60, 6, true, Verdict::Stale);
        check(60, 8, false, Verdict::Apply);
        check(TO_GOAL, 8, false, Verdict::Apply);
        check(30, 8, true, Verdict::Apply);
        check(30, 8, false, Verdict::Refuse);
    }

    #[test]
    fn a_counter_that_wraps_goes_on() {
        assert!(is_newer(0, u32::MAX) && is_newer(5, u32::MAX - 5));
        assert!(!is_newer(u32::MAX, 0) && !is_newer(3, 3));
    }

    #[test]
    fn an_index_below_the_goal_mark_means_nothing() {
        assert_eq!(reach_of(-2, 9), None);
        assert_eq!(reach_of(i32::MIN, 9), None);
        assert_eq!(reach_of(TO_GOAL, 9), Some(9));
        assert_eq!(reach_of(12, 9), Some(9));
    }
}
