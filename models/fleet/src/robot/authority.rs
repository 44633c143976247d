//! What a robot obeys: which missions and authorities count, by the original's rules and by those of acknowledged
//! movement authority. Whole numbers only; it knows neither motion nor time. What runs and what is searched
//! exhaustively (`coordinator::safe::search`) are this code.

use crate::messages::{Authority, Mission, NO_AUTHORITY, Phase, State, TO_GOAL, TruthKind};

/// What a robot is about, and holds.
///
/// **Void commands.** A command of the safe mode names the state it rests on. It is void when the robot sent that
/// state before it started, or before it heard the newest question of a coordinator; a coordinator that restarted, or
/// a robot that did, never meets what was under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Holder {
    pub(crate) mission_id: u32,
    pub(crate) path_id: u32,
    pub(crate) phase: Phase,
    pub(crate) grant: Grant,
    /// An authority that overtook its mission.
    early: Option<Authority>,
    /// Of the newest state.
    pub(crate) header_id: u32,
    /// Of the first state that commands may rest on.
    valid_from: u32,
    /// The newest question heard.
    answered: u32,
}

/// What is to become of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MissionVerdict {
    /// It may begin, where it fits map and place.
    Begin,
    /// The robot is to be put at its end.
    Replace,
    /// The present one again, an older one, or void.
    Stale,
    /// Another is under way.
    Busy,
}

/// Result of an authority.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Heard {
    /// It is a question.
    Question,
    /// It overtook its mission and is kept for it.
    Kept,
    /// It overtook its mission and is passed over.
    Early,
    /// Void, or of a mission that is over.
    Stale,
    /// Its index has no meaning.
    Meaningless,
    /// It was judged.
    Judged(Verdict),
}

/// Where a robot is when an authority reaches it.
#[derive(Clone, Copy)]
pub(crate) struct Standing<'a> {
    /// Last pose of its path.
    pub(crate) last_index: usize,
    /// Last pose passed.
    pub(crate) passed: usize,
    /// Whether it can still stop at a pose.
    pub(crate) can_stop_at: &'a dyn Fn(usize) -> bool,
}

impl Holder {
    /// A robot that starts, parked, with states from `first_id + 1` on.
    pub(crate) fn new(path_id: u32, first_id: u32) -> Self {
        Self {
            mission_id: 0,
            path_id,
            phase: Phase::Parked,
            grant: Grant::NONE,
            early: None,
            header_id: first_id,
            valid_from: first_id.wrapping_add(1),
            answered: 0,
        }
    }

    pub(crate) fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Driving | Phase::AtPoint)
    }

    /// Fills in what a state tells of it.
    pub(crate) fn describe(&self, state: &mut State) {
        state.header.header_id = self.header_id;
        state.header.mission_id = self.mission_id;
        state.path_id = self.path_id;
        state.authority_index = self.grant.index;
        state.applied_sequence = self.grant.applied.unwrap_or(0);
        state.answered = self.answered;
        state.phase = self.phase as u8;
        state.flags = u8::from(self.grant.is_refused) * State::REFUSED;
    }

    /// Draws the conclusion from where it is: under way, at its authority or at its goal. True when it has reached
    /// its goal.
    pub(crate) fn settle(&mut self, is_at_rest: bool, passed: usize, last_index: usize) -> bool {
        if !is_at_rest {
            self.phase = Phase::Driving;
            return false;
        }
        let is_goal = self.grant.is_given() && self.grant.reach(last_index) == last_index;
        let is_done = is_goal && passed == last_index;
        self.phase = if is_done { Phase::Done } else { Phase::AtPoint };
        is_done
    }

    fn is_void(&self, echo_header_id: u32) -> bool {
        is_newer(self.valid_from, echo_header_id)
    }

    pub(crate) fn judge_mission(&self, mission: &Mission) -> MissionVerdict {
        let is_replacing = mission.flags & Mission::REPLACE != 0;
        let is_present = mission.header.mission_id == self.mission_id;
        let may_replace = is_replacing && is_present && self.is_under_way();
        let is_void =
            mission.flags & Mission::ACKNOWLEDGED != 0 && self.is_void(mission.echo_header_id);
        let is_new = is_newer(mission.header.mission_id, self.mission_id);
        if is_void || !(is_new || may_replace) {
            MissionVerdict::Stale
        } else if is_replacing {
            MissionVerdict::Replace
        } else if self.is_under_way() {
            MissionVerdict::Busy
        } else {
            MissionVerdict::Begin
        }
    }

    /// The mission begins. Gives the authority that came before it, which is to be heard now.
    pub(crate) fn begin(&mut self, mission: &Mission) -> Option<Authority> {
        self.mission_id = mission.header.mission_id;
        self.path_id = mission.path_id;
        self.grant = Grant::NONE;
        self.phase = Phase::AtPoint;
        let kept = self.early.take();
        kept.filter(|kept| kept.header.mission_id == self.mission_id)
    }

    pub(crate) fn on_authority(&mut self, authority: &Authority, at: &Standing<'_>) -> Heard {
        let is_acknowledged = authority.flags & Authority::ACKNOWLEDGED != 0;
        if authority.flags & Authority::QUESTION != 0 {
            if self.answered == 0 || is_newer(authority.sequence, self.answered) {
                self.answered = authority.sequence;
                self.valid_from = self.header_id.wrapping_add(1);
                self.early = None;
            }
            return Heard::Question;
        }
        if is_acknowledged && self.is_void(authority.echo_header_id) {
            return Heard::Stale;
        }
        let mission_id = authority.header.mission_id;
        if !self.is_under_way() || mission_id != self.mission_id {
            return if !is_newer(mission_id, self.mission_id) {
                Heard::Stale
            } else if is_acknowledged && self.keep_early(authority) {
                Heard::Kept
            } else {
                Heard::Early
            };
        }
        let Some(reach) = reach_of(authority.authority_index, at.last_index) else {
            return Heard::Meaningless;
        };
        let proposal = Proposal {
            index: authority.authority_index,
            sequence: authority.sequence,
            reach,
            reach_now: self.grant.reach(at.last_index),
            passed: at.passed,
            can_stop: (at.can_stop_at)(reach),
        };
        let verdict = if is_acknowledged {
            acknowledged(&self.grant, &proposal)
        } else {
            original(&self.grant, &proposal)
        };
        self.grant.carry_out(authority, verdict);
        Heard::Judged(verdict)
    }

    /// Keeps an acknowledged authority that overtook its mission, which goes another way: the
    /// coordinator counts it as in force from the moment it was sent. False when it is passed over.
    fn keep_early(&mut self, authority: &Authority) -> bool {
        let is_newest = self.early.is_none_or(|kept| {
            let (new, old) = (&authority.header, &kept.header);
            is_newer(new.mission_id, old.mission_id)
                || (new.mission_id == old.mission_id && is_newer(authority.sequence, kept.sequence))
        });
        if is_newest {
            self.early = Some(*authority);
        }
        is_newest
    }
}

/// The authority in force and what is known of newer ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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

    fn carry_out(&mut self, authority: &Authority, verdict: Verdict) {
        if verdict == Verdict::Stale {
            return;
        }
        self.newest = Some(authority.sequence);
        match verdict {
            Verdict::Apply | Verdict::ApplyLate => {
                self.index = authority.authority_index;
                self.applied = Some(authority.sequence);
                self.is_refused = false;
                self.is_late = verdict == Verdict::ApplyLate;
            }
            Verdict::Unchanged => self.applied = Some(authority.sequence),
            Verdict::Refuse => {
                self.applied = Some(authority.sequence);
                self.is_refused = true;
            }
            Verdict::Ignore | Verdict::Stale => {}
        }
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
impl Holder {
    /// The header ids it keeps, that of its newest state last.
    pub(crate) fn header_ids(&mut self) -> [&mut u32; 2] {
        [&mut self.valid_from, &mut self.header_id]
    }

    /// Every sequence it keeps.
    pub(crate) fn sequences(&mut self) -> impl Iterator<Item = &mut u32> {
        let early = self.early.as_mut().map(|early| &mut early.sequence);
        let grant = [self.grant.applied.as_mut(), self.grant.newest.as_mut()];
        grant.into_iter().chain([early]).flatten()
    }

    /// The authority it keeps for a mission to come.
    pub(crate) fn early(&mut self) -> Option<&mut Authority> {
        self.early.as_mut()
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
