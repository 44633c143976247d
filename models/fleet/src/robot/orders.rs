//! What a robot does with missions and authorities. The rules by which it judges an authority are
//! in `authority`; here they take effect and are counted.

use std::sync::Arc;

use crate::messages::{Authority, Header, MessageOrder, Mission, Phase, Truth, TruthKind};
use crate::path::{Path, PathId};
use crate::robot::Robot;
use crate::robot::authority::{self, Grant, Proposal, Verdict, is_newer, reach_of};
use hil_core::time::Instant;

impl Robot {
    /// Takes a mission when it is newer, fits the robot's map and place, and none is under way. A
    /// mission flagged [`Mission::REPLACE`], newer or the one under way, puts the robot at its end.
    pub fn on_mission(&mut self, now: Instant, mission: &Mission, truth: &mut dyn FnMut(Truth)) {
        self.advance(now, truth);
        let is_in_order = in_order(&mut self.newest_mission_header, &mission.header);
        if !is_in_order {
            self.counters.out_of_order_count += 1;
        }
        let is_replacing = mission.flags & Mission::REPLACE != 0;
        let is_present = mission.header.mission_id == self.mission_id;
        let may_replace = is_replacing && is_present && self.is_under_way();
        let is_new = is_newer(mission.header.mission_id, self.mission_id);
        let is_passed_over = !is_in_order && self.order == MessageOrder::Strict;
        if is_passed_over || !(is_new || may_replace) {
            self.counters.missions_repeated_count += 1;
            truth(self.record(now, TruthKind::MessageStale, 0));
            return;
        }
        if self.is_under_way() && !is_replacing {
            self.counters.missions_busy_count += 1;
            return;
        }
        let Some(path) = self.path_of(mission) else {
            self.counters.missions_refused_count += 1;
            return;
        };
        if is_replacing {
            self.replace(now, mission, path, truth);
            return;
        }
        if !self.stands_at_start_of(now, &path) {
            self.counters.missions_refused_count += 1;
            return;
        }
        self.begin(now, mission, path);
        self.hasten(now);
        self.counters.missions_started_count += 1;
        truth(self.record(now, TruthKind::MissionStarted, 0));
        let mission_id = self.mission_id;
        let kept = self.early.take();
        if let Some(authority) = kept.filter(|kept| kept.header.mission_id == mission_id) {
            self.judge(now, &authority, truth);
        }
    }

    /// Judges an authority by the rules its flag names and does as they say.
    pub fn on_authority(
        &mut self,
        now: Instant,
        authority: &Authority,
        truth: &mut dyn FnMut(Truth),
    ) {
        self.advance(now, truth);
        let is_in_order = in_order(&mut self.newest_authority_header, &authority.header);
        if !is_in_order {
            self.counters.out_of_order_count += 1;
        }
        let is_passed_over = !is_in_order && self.order == MessageOrder::Strict;
        let is_of_mission = self.is_under_way() && authority.header.mission_id == self.mission_id;
        if is_passed_over || !is_of_mission {
            let is_early = is_newer(authority.header.mission_id, self.mission_id);
            if is_early && !is_passed_over {
                self.counters.early_count += 1;
                if self.keep_early(authority) {
                    return;
                }
            } else {
                self.counters.stale_count += 1;
            }
            truth(self.record(now, TruthKind::MessageStale, authority.sequence));
            return;
        }
        self.judge(now, authority, truth);
    }

    /// Keeps an acknowledged authority that overtook its mission, which goes another way: the
    /// coordinator counts it as in force from the moment it was sent. One with a lease is not
    /// kept, as its time would begin too late. False when it is passed over.
    fn keep_early(&mut self, authority: &Authority) -> bool {
        let is_lasting = authority.flags & Authority::ACKNOWLEDGED != 0 && authority.lease_ns == 0;
        let is_newest = self.early.is_none_or(|kept| {
            let (new, old) = (&authority.header, &kept.header);
            is_newer(new.mission_id, old.mission_id)
                || (new.mission_id == old.mission_id && is_newer(authority.sequence, kept.sequence))
        });
        if is_lasting && is_newest {
            self.early = Some(*authority);
        }
        is_lasting && is_newest
    }

    /// Judges an authority of the mission under way.
    fn judge(&mut self, now: Instant, authority: &Authority, truth: &mut dyn FnMut(Truth)) {
        let Some(proposal) = self.proposal(now, authority) else {
            self.counters.invalid_count += 1;
            truth(self.record(now, TruthKind::MessageStale, authority.sequence));
            return;
        };
        let verdict = if authority.flags & Authority::ACKNOWLEDGED == 0 {
            authority::original(&self.grant, &proposal)
        } else {
            authority::acknowledged(&self.grant, &proposal)
        };
        self.count(verdict);
        if verdict != Verdict::Stale {
            self.grant.newest = Some(authority.sequence);
            self.carry_out(now, authority, verdict);
        }
        truth(self.record(now, verdict.kind(), authority.sequence));
        let is_taken = matches!(verdict, Verdict::Apply | Verdict::ApplyLate);
        if is_taken && self.update_phase(now) == TruthKind::MissionDone {
            truth(self.record(now, TruthKind::MissionDone, authority.sequence));
        }
    }

    fn carry_out(&mut self, now: Instant, authority: &Authority, verdict: Verdict) {
        match verdict {
            Verdict::Apply | Verdict::ApplyLate => {
                self.grant.index = authority.authority_index;
                self.grant.applied = Some(authority.sequence);
                self.grant.is_refused = false;
                self.grant.has_lapsed = false;
                self.grant.is_late = verdict == Verdict::ApplyLate;
                self.grant.lease_end = lease_end(now, authority.lease_ns);
                if let Some(path) = &self.path {
                    let reach = self.grant.reach(path.last_index());
                    self.tracker.aim(now, path.way_to_m(reach));
                }
            }
            Verdict::Unchanged => self.grant.applied = Some(authority.sequence),
            Verdict::Refuse => {
                self.grant.applied = Some(authority.sequence);
                self.grant.is_refused = true;
            }
            Verdict::Ignore | Verdict::Stale => {}
        }
    }

    fn proposal(&self, now: Instant, authority: &Authority) -> Option<Proposal> {
        let path = self.path.as_ref()?;
        let reach = reach_of(authority.authority_index, path.last_index())?;
        let motion = self.tracker.motion(now);
        Some(Proposal {
            index: authority.authority_index,
            sequence: authority.sequence,
            reach,
            reach_now: self.grant.reach(path.last_index()),
            passed: path.index_at(motion.way_m),
            can_stop: self.tracker.can_stop_at(now, path.way_to_m(reach)),
        })
    }

    fn count(&mut self, verdict: Verdict) {
        let counters = &mut self.counters;
        match verdict {
            Verdict::Apply => counters.applied_count += 1,
            Verdict::ApplyLate => {
                counters.applied_count += 1;
                counters.late_count += 1;
            }
            Verdict::Unchanged => counters.unchanged_count += 1,
            Verdict::Ignore => counters.ignored_count += 1,
            Verdict::Refuse => counters.refused_count += 1,
            Verdict::Stale => counters.stale_count += 1,
        }
    }

    /// The path a mission names, if this robot's map agrees with it.
    fn path_of(&self, mission: &Mission) -> Option<Arc<Path>> {
        let path = self.world.paths.get(PathId(mission.path_id))?;
        let is_whole = mission.start_index == 0 && mission.end_index as usize == path.last_index();
        (is_whole && mission.path_hash == path.hash()).then(|| Arc::clone(path))
    }

    /// True when the path begins within one pose spacing of where the robot stands.
    fn stands_at_start_of(&self, now: Instant, path: &Path) -> bool {
        let here = match &self.path {
            Some(own) => own.pose_at(self.tracker.motion(now).way_m),
            None => self.stand,
        };
        here.distance_m(&path.poses()[0]) <= path.spacing_m()
    }

    fn begin(&mut self, now: Instant, mission: &Mission, path: Arc<Path>) {
        self.mission_id = mission.header.mission_id;
        self.path_id = mission.path_id;
        self.tracker.place(now, 0.0, path.length_m());
        self.path = Some(path);
        self.accounted_m = 0.0;
        self.grant = Grant::NONE;
        self.phase = Phase::AtPoint;
    }

    fn replace(
        &mut self,
        now: Instant,
        mission: &Mission,
        path: Arc<Path>,
        truth: &mut dyn FnMut(Truth),
    ) {
        let length_m = path.length_m();
        self.account(self.tracker.motion(now).way_m);
        self.begin(now, mission, path);
        self.tracker.place(now, length_m, length_m);
        self.accounted_m = length_m;
        self.phase = Phase::Done;
        self.hasten(now);
        self.counters.replaced_count += 1;
        truth(self.record(now, TruthKind::Replaced, 0));
    }
}

/// Notes a message's `header_id`; false when it is not newer than the newest.
fn in_order(newest: &mut Option<u32>, header: &Header) -> bool {
    if newest.is_some_and(|newest| !is_newer(header.header_id, newest)) {
        return false;
    }
    *newest = Some(header.header_id);
    true
}

fn lease_end(now: Instant, lease_ns: i64) -> Option<Instant> {
    (lease_ns > 0).then(|| Instant::from_ns(now.as_ns().saturating_add(lease_ns)))
}
