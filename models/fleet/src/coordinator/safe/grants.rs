//! One control cycle of the safe rules: who gets how much more way, in which order, and from whom
//! some is asked back. What is safe and live is not decided here but asked of the reservations
//! and the plan.

use core::cmp::Ordering;
use core::time::Duration;

use crate::coordinator::policy::Contest;
use crate::coordinator::roster::Roster;
use crate::coordinator::safe::reservation::Contact;
use crate::coordinator::safe::{SafeRules, lookahead_s};
use crate::coordinator::{Cycle, reach_m};
use crate::section::{Side, Span};
use hil_core::time::Instant;

/// A robot that could use more way in this cycle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    robot: usize,
    /// Authority index it could use.
    want: usize,
    /// Rivals for the same sections that the policy puts first.
    rivals_before: u32,
}

/// Robots that are looked at along one queue.
const QUEUE_MAX: usize = 16;
/// A robot from which authority was taken back keeps what it then gets for this long.
const SPARED: Duration = Duration::from_secs(30);

impl SafeRules {
    /// Extends authorities in the policy's order.
    pub(crate) fn grant_all(&mut self, cycle: &mut Cycle<'_>) {
        let may_reorder = !self.is_anyone_starving(cycle.now);
        self.admit_all(cycle.now, may_reorder);
        let mut order = core::mem::take(&mut self.order);
        order.clear();
        order.extend((0..self.robots.len()).filter_map(|robot| self.candidate(robot)));
        self.rank(&mut order, cycle);
        for view in &mut self.robots {
            view.stopped_by = None;
        }
        for candidate in &order {
            let extension = self
                .core
                .extend(candidate.robot, candidate.want, may_reorder);
            self.counts.grants_withheld += extension.withheld_count;
            let view = &mut self.robots[candidate.robot];
            view.stopped_by = extension.stopped_by;
            if extension.is_given {
                view.waited_since = view.waiting_since.take().or(view.waited_since);
            } else {
                view.waiting_since = view.waiting_since.or(Some(cycle.now));
            }
        }
        if self.takes_back && may_reorder {
            for candidate in &order {
                self.take_back(cycle, candidate.robot);
            }
        }
        self.order = order;
        self.count_held_up(cycle.roster);
    }

    fn is_anyone_starving(&self, now: Instant) -> bool {
        let mut waits = self.robots.iter().filter_map(|view| view.waiting_since);
        waits.any(|since| now > since + self.patience)
    }

    fn admit_all(&mut self, now: Instant, may_reorder: bool) {
        let (robots, counts) = (&mut self.robots, &mut self.counts);
        self.core.admit_all(may_reorder, |robot| {
            let view = &mut robots[robot];
            view.waiting_since = view.waiting_since.or(Some(now));
            counts.admissions_deferred += 1;
        });
    }

    fn candidate(&self, robot: usize) -> Option<Candidate> {
        let view = &self.robots[robot];
        if !self.core.is_open(robot) {
            return None;
        }
        let (ledger, last) = (
            &self.core.members[robot].ledger,
            self.core.traffic.last(robot),
        );
        let path = self.world.path(self.core.traffic.path(robot)?);
        let time_s = lookahead_s(
            self.cycles.expected_s(self.control_period),
            view.round_trip.estimate_s,
            self.reserve_ms,
        );
        // The robot may be almost a pose beyond the one it passed last.
        let vehicle = &self.world.vehicle;
        let speed_mps = view.speed_mps.min(vehicle.speed_max_mps);
        let way_m = path.way_to_m(ledger.lower() + 1) + reach_m(vehicle, 0.0, speed_mps, time_s);
        // One that came to stand short of the end of its authority still needs more to go on.
        let needed = ledger.lower() + self.core.margin.poses + 2;
        let want = (path.index_at(way_m) + 1).max(needed).min(last);
        (want > ledger.bound()).then_some(Candidate {
            robot,
            want,
            rivals_before: 0,
        })
    }

    /// Sorts by how many rivals go before, so that no inconsistency of a policy matters.
    fn rank(&mut self, order: &mut [Candidate], cycle: &Cycle<'_>) {
        self.places.fill(None);
        for (place, candidate) in order.iter().enumerate() {
            self.places[candidate.robot] = Some(place);
        }
        for place in 0..order.len() {
            let first = order[place];
            for contact in self.wanted(&first) {
                // Each pair once, from the lower number.
                let rival = self.places[contact.other].filter(|rival| *rival > place);
                let Some(rival) = rival else {
                    continue;
                };
                let second = order[rival];
                if contact.others.lower > self.core.margin.upper(second.want, usize::MAX)
                    || contact.others.upper <= self.core.traffic.span(second.robot).upper
                {
                    continue;
                }
                match self.compare(cycle, first.robot, contact) {
                    Ordering::Less => order[rival].rivals_before += 1,
                    Ordering::Greater => order[place].rivals_before += 1,
                    Ordering::Equal => {}
                }
            }
        }
        order.sort_by_key(|candidate| (candidate.rivals_before, candidate.robot));
    }

    /// The sections of which the candidate wants poses it does not have.
    fn wanted(&self, candidate: &Candidate) -> impl Iterator<Item = &Contact> {
        let from = self.core.traffic.span(candidate.robot).upper;
        let to = self.core.margin.upper(candidate.want, usize::MAX);
        let contacts = self.core.traffic.contacts(candidate.robot).iter();
        contacts.filter(move |contact| contact.own.upper > from && contact.own.lower <= to)
    }

    fn compare(&self, cycle: &Cycle<'_>, robot: usize, contact: &Contact) -> Ordering {
        let contender = |robot: usize, start| {
            let mut contender = cycle.roster.robots()[robot].contender(robot, start);
            contender.held_up_count = self.robots[robot].held_up_count;
            contender
        };
        let contest = Contest {
            section: contact.section(),
            first: contender(robot, contact.own.lower),
            second: contender(contact.other, contact.others.lower),
        };
        let by_number = || robot.cmp(&contact.other);
        cycle.policy.compare(&contest).then_with(by_number)
    }

    /// Asks way back from the robot that stops `robot`, where the policy prefers the latter and
    /// the former has not yet come so far that it must enter.
    fn take_back(&mut self, cycle: &Cycle<'_>, robot: usize) {
        let Some(holder) = self.robots[robot].stopped_by else {
            return;
        };
        let from = self.core.traffic.span(robot).upper + 1;
        let span = self.core.traffic.span(holder);
        let ledger = &self.core.members[holder].ledger;
        let is_spared = cycle.now < self.robots[holder].spared_until;
        if ledger.is_done() || ledger.is_shrinking() || is_spared {
            return;
        }
        let Some(state) = cycle.roster.robots()[holder].state else {
            return;
        };
        let may_stop = usize::try_from(state.stop_index).unwrap_or(usize::MAX);
        let earliest = may_stop.max(ledger.lower()) + 1;
        let contacts = self.core.traffic.contacts(robot).iter();
        let end = contacts
            .filter(|contact| contact.other == holder && contact.own.upper >= from)
            .filter_map(|contact| {
                let entry = contact.section().first_conflict(
                    Side::Second,
                    Span::between(span.lower, usize::MAX),
                    Span {
                        lower: from,
                        upper: contact.own.upper,
                    },
                )?;
                let end = entry.checked_sub(self.core.margin.poses + 1)?;
                let is_useful = end >= earliest && entry <= span.upper;
                let prefers = || self.compare(cycle, robot, contact) == Ordering::Less;
                (is_useful && prefers()).then_some(end)
            })
            .min();
        let Some(end) = end.filter(|end| *end < ledger.bound()) else {
            return;
        };
        if self.core.shrink(holder, end) {
            let view = &mut self.robots[holder];
            view.spared_until = cycle.now + SPARED;
            view.waiting_since = view.waited_since.or(view.waiting_since);
        }
    }

    fn count_held_up(&mut self, roster: &Roster) {
        for view in &mut self.robots {
            view.held_up_count = 0;
        }
        for robot in 0..self.robots.len() {
            if roster.robots()[robot].waiting_since.is_none() {
                continue;
            }
            // Whoever waits for one that waits is held up by the one in front as well.
            let mut next = self.robots[robot].stopped_by;
            for _ in 0..QUEUE_MAX {
                let Some(holder) = next.filter(|holder| *holder != robot) else {
                    break;
                };
                self.robots[holder].held_up_count += 1;
                next = self.robots[holder].stopped_by;
            }
        }
    }
}
