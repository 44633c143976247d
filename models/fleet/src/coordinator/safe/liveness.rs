//! The witness that a fleet can always finish: a list of moves, each possible once those before
//! it are done, after which every robot stands at its goal. It decides nothing about order of
//! merit and knows no time.
//!
//! The banker's rule (Dijkstra 1965; Habermann 1969) for robots on paths. A *move* takes one
//! robot from its reservation to a pose further on; it is possible when all poses between are
//! free of what the others have then. A plan is *valid* when its moves are possible one after
//! another and each robot's last one ends at its goal. The coordinator keeps one valid plan:
//!
//! - Authority is extended only if the plan stays valid with the larger reservation, or another
//!   valid plan is found for it. Otherwise the extension is withheld.
//! - Robots that go forward and authorities that shrink only make reservations smaller, which never invalidates a plan:
//!   no move ends short of what its robot has reserved (`Plan::extend`), so way that is taken back is still part of it.
//! - A mission is admitted only if a valid plan with it exists; until then its robot counts as
//!   parked. Its reservation, the bay's pose, is the same before and after.
//!
//! **No deadlock.** The first move's robot can always be given the way up to that move's end: it
//! is free of all reservations, and giving it keeps this very plan valid. With eventual delivery
//! it gets there, the move is dropped, and the same holds for the next.
//!
//! **No starvation.** A robot *waits* from when it is not admitted, or could use more way and gets
//! none, until it gets some; way that is taken back before the robot came further ends no waiting.
//! A path being finite, a robot that does not wait for ever arrives. Plans may be reordered, and way taken back,
//! only while no robot has waited beyond its patience. From then on the present plan is kept and
//! new missions are added at its end; it has finitely many moves, the waiting robot's last one
//! among them, so its mission ends.
//!
//! The search is a heuristic, as the question itself is NP-hard: failing to find a plan withholds
//! an extension that might have been harmless, and costs time but neither safety nor liveness.

use std::hash::{Hash, Hasher};

use crate::coordinator::safe::reservation::{Contact, Traffic};
use crate::section::{Side, Span};

/// How far from the end of its authority a robot may come to stand, in poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StopMargin {
    /// As many short of it as beyond it.
    pub(crate) poses: usize,
}

impl StopMargin {
    /// What a robot with authority up to `index` may cover at most.
    pub(crate) fn upper(&self, index: usize, last: usize) -> usize {
        index.saturating_add(self.poses).min(last)
    }

    /// What a robot covers that came to stand at the end of its authority.
    fn standing(&self, index: usize, last: usize) -> Span {
        if index >= last {
            return Span::at(last);
        }
        Span {
            lower: index.saturating_sub(self.poses),
            upper: self.upper(index, last),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Move {
    robot: usize,
    /// Authority index at which it ends.
    to: usize,
}

/// The plan a coordinator keeps, and room for looking for another.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    margin: StopMargin,
    moves: Vec<Move>,
    trial: Vec<Move>,
    spans: Vec<Span>,
    pending: Vec<usize>,
    is_pending: Vec<bool>,
    /// Robots a search is about: those connected by sections. The rest keeps its moves.
    is_member: Vec<bool>,
    found: Vec<usize>,
}

impl Plan {
    pub(crate) fn new(margin: StopMargin, robot_count: usize) -> Self {
        Self {
            margin,
            moves: Vec::with_capacity(4 * robot_count),
            trial: Vec::with_capacity(4 * robot_count),
            spans: Vec::with_capacity(robot_count),
            pending: Vec::with_capacity(robot_count),
            is_pending: vec![false; robot_count],
            is_member: vec![false; robot_count],
            found: Vec::with_capacity(robot_count),
        }
    }

    /// End of the first move of `robot`, if it has one.
    pub(crate) fn next_end(&self, robot: usize) -> Option<usize> {
        let mut moves = self.moves.iter();
        moves.find(|step| step.robot == robot).map(|step| step.to)
    }

    /// Drops the moves that are done; the reservation shows the robot there.
    pub(crate) fn drop_done(&mut self, traffic: &Traffic) {
        let margin = self.margin;
        self.moves.retain(|step| {
            step.to >= traffic.last(step.robot)
                || traffic.span(step.robot).lower + margin.poses < step.to
        });
    }

    /// Drops all moves of `robot`, which stands at its goal.
    pub(crate) fn finish(&mut self, robot: usize) {
        self.moves.retain(|step| step.robot != robot);
    }

    /// Takes in `robot`, which stands at the start of a new path. False, and nothing changes, when
    /// no plan was found.
    pub(crate) fn admit(&mut self, traffic: &Traffic, robot: usize, may_reorder: bool) -> bool {
        self.spans.clear();
        self.spans.extend_from_slice(&traffic.spans);
        for step in &self.moves {
            let last = traffic.last(step.robot);
            self.spans[step.robot] = self.margin.standing(step.to, last);
        }
        let last = traffic.last(robot);
        let from = self.spans[robot].upper + 1;
        if traffic
            .first_conflict(robot, from, last, &self.spans)
            .is_none()
        {
            self.moves.push(Move { robot, to: last });
            return true;
        }
        may_reorder && {
            self.begin_search(traffic, robot);
            // Not yet among the moves, so it is tried first; last is where it belongs.
            self.pending.rotate_left(1);
            self.search(traffic)
        }
    }

    /// Takes in `robots`, which are under way and not in the plan. False, and nothing changes, when no plan was found.
    pub(crate) fn admit_together(&mut self, traffic: &Traffic, robots: &[usize]) -> bool {
        robots.iter().any(|&first| {
            self.begin_search(traffic, first);
            self.is_member.fill(true);
            for step in &self.moves {
                if step.to >= traffic.last(step.robot) && !self.is_pending[step.robot] {
                    self.pending.push(step.robot);
                    self.is_pending[step.robot] = true;
                }
            }
            for &robot in robots {
                if !self.is_pending[robot] {
                    self.pending.push(robot);
                    self.is_pending[robot] = true;
                }
            }
            self.search(traffic)
        })
    }

    /// Whether `robot` may reserve up to `upper`, which is free of all reservations now: the plan
    /// stays valid, or another is found and taken.
    pub(crate) fn extend(
        &mut self,
        traffic: &Traffic,
        robot: usize,
        upper: usize,
        may_reorder: bool,
    ) -> bool {
        if self.keeps(traffic, robot, upper) {
            let end = upper.saturating_sub(self.margin.poses);
            for step in self.moves.iter_mut().filter(|step| step.robot == robot) {
                step.to = step.to.max(end);
            }
            return true;
        }
        may_reorder && {
            self.begin_search(traffic, robot);
            self.spans[robot].upper = upper;
            self.search(traffic)
        }
    }

    /// Whether the plan stays valid when `robot` reserves up to `upper` and none of its moves ends short of that. Only the
    /// moves of robots that still need one of the new poses can become impossible, and only by this robot.
    fn keeps(&mut self, traffic: &Traffic, robot: usize, upper: usize) -> bool {
        let is_new = |contact: &Contact| {
            contact.own.lower <= upper
                && contact.own.upper > traffic.span(robot).upper
                && contact.others.upper > traffic.span(contact.other).upper
        };
        let contacts = traffic.contacts(robot);
        self.is_member.fill(false);
        self.spans.resize(traffic.robot_count(), Span::at(0));
        let mut may_block = false;
        for contact in contacts.iter().filter(|contact| is_new(contact)) {
            may_block = true;
            self.is_member[contact.other] = true;
            self.spans[contact.other] = traffic.span(contact.other);
        }
        if !may_block {
            return true;
        }
        let last = traffic.last(robot);
        let end = upper.saturating_sub(self.margin.poses);
        let mut own = Span {
            lower: traffic.span(robot).lower,
            upper,
        };
        for step in &self.moves {
            if step.robot == robot {
                let standing = self.margin.standing(step.to.max(end), last);
                own = Span {
                    lower: standing.lower.max(own.lower),
                    ..standing
                };
                continue;
            }
            if !self.is_member[step.robot] {
                continue;
            }
            let other = self.margin.standing(step.to, traffic.last(step.robot));
            let poses = Span::between(self.spans[step.robot].upper + 1, other.upper);
            let is_blocked = contacts.iter().any(|contact| {
                contact.other == step.robot
                    && is_new(contact)
                    && (contact.section().first_conflict(Side::Second, poses, own)).is_some()
            });
            if is_blocked {
                return false;
            }
            let span = &mut self.spans[step.robot];
            *span = if other.upper >= span.upper {
                other
            } else {
                *span
            };
        }
        true
    }

    /// Starts from the present reservations; robots are tried in the order in which the present
    /// plan finishes them, `first` before all.
    fn begin_search(&mut self, traffic: &Traffic, first: usize) {
        self.spans.clear();
        self.spans.extend_from_slice(&traffic.spans);
        self.is_pending.fill(false);
        self.is_pending[first] = true;
        self.pending.clear();
        self.pending.push(first);
        self.mark_connected(traffic, first);
        for step in &self.moves {
            let is_last = step.to >= traffic.last(step.robot);
            if is_last && self.is_member[step.robot] && step.robot != first {
                self.pending.push(step.robot);
                self.is_pending[step.robot] = true;
            }
        }
        self.trial.clear();
    }

    fn mark_connected(&mut self, traffic: &Traffic, first: usize) {
        self.is_member.fill(false);
        self.is_member[first] = true;
        self.found.clear();
        self.found.push(first);
        while let Some(robot) = self.found.pop() {
            for contact in traffic.contacts(robot) {
                if !self.is_member[contact.other] {
                    self.is_member[contact.other] = true;
                    self.found.push(contact.other);
                }
            }
        }
    }

    fn search(&mut self, traffic: &Traffic) -> bool {
        let mut aside_left = SIDESTEPS_PER_ROBOT * self.pending.len();
        while !self.pending.is_empty() {
            let before = self.pending.len();
            let mut position = 0;
            while let Some(&robot) = self.pending.get(position) {
                if self.try_goal(traffic, robot) {
                    self.pending.remove(position);
                    self.is_pending[robot] = false;
                } else {
                    position += 1;
                }
            }
            if self.pending.len() < before {
                continue;
            }
            let moved = (0..self.pending.len())
                .any(|position| self.try_aside(traffic, self.pending[position]));
            if !moved || aside_left == 0 {
                return false;
            }
            aside_left -= 1;
        }
        // Robots without a section in common do not care in which order they move.
        let is_member = &self.is_member;
        let others = self.moves.iter().filter(|step| !is_member[step.robot]);
        self.trial.extend(others);
        core::mem::swap(&mut self.moves, &mut self.trial);
        true
    }

    fn try_goal(&mut self, traffic: &Traffic, robot: usize) -> bool {
        let last = traffic.last(robot);
        let from = self.spans[robot].upper + 1;
        let is_free = traffic
            .first_conflict(robot, from, last, &self.spans)
            .is_none();
        if is_free {
            self.spans[robot] = Span::at(last);
            self.trial.push(Move { robot, to: last });
        }
        is_free
    }

    /// Moves `robot` forward to a pose where it stands in nobody's way more than before.
    fn try_aside(&mut self, traffic: &Traffic, robot: usize) -> bool {
        let last = traffic.last(robot);
        let Span { lower, upper } = self.spans[robot];
        let Some((conflict, _)) = traffic.first_conflict(robot, upper + 1, last, &self.spans)
        else {
            return false;
        };
        let margin = self.margin;
        let present = upper.saturating_sub(margin.poses);
        let mut end = (conflict - 1).saturating_sub(margin.poses);
        while end > present {
            let standing = margin.standing(end, last);
            let span = Span {
                lower: standing.lower.max(lower),
                ..standing
            };
            if self.is_harmless(traffic, robot, span) {
                self.spans[robot] = span;
                self.trial.push(Move { robot, to: end });
                return true;
            }
            // Next, before the section that begins last before this end.
            end =
                section_start(traffic.contacts(robot), span.upper).saturating_sub(margin.poses + 1);
        }
        false
    }

    /// True when no robot that still has to move would be stopped by `robot` at `span` earlier
    /// than by `robot` where it is.
    fn is_harmless(&self, traffic: &Traffic, robot: usize, span: Span) -> bool {
        let present = self.spans[robot];
        let contacts = traffic.contacts(robot);
        contacts.chunk_by(|a, b| a.other == b.other).all(|group| {
            let other = group[0].other;
            if !self.is_pending[other] {
                return true;
            }
            let poses = Span::between(self.spans[other].upper + 1, traffic.last(other));
            let stopped_by = |taken: Span| {
                let conflicts = group.iter();
                conflicts
                    .filter_map(|contact| {
                        contact.section().first_conflict(Side::Second, poses, taken)
                    })
                    .min()
            };
            stopped_by(span)
                .is_none_or(|there| stopped_by(present).is_some_and(|here| here <= there))
        })
    }
}

#[cfg(test)]
impl Plan {
    /// Whether each move can be made once those before it are, from the present reservations, each robot then standing
    /// at the end of its move or of the way it has, and each ends at its goal.
    pub(crate) fn is_possible(&self, traffic: &Traffic) -> bool {
        let mut spans = traffic.spans.clone();
        let can_be_made = self.moves.iter().all(|step| {
            let (robot, last) = (step.robot, traffic.last(step.robot));
            let reserved = spans[robot].upper;
            let end = step.to.max(reserved.saturating_sub(self.margin.poses));
            let standing = self.margin.standing(end, last);
            let conflict = traffic.first_conflict(robot, reserved + 1, standing.upper, &spans);
            let lower = standing.lower.max(spans[robot].lower);
            spans[robot] = Span { lower, ..standing };
            conflict.is_none()
        });
        let at_goal = |step: &Move| spans[step.robot] == Span::at(traffic.last(step.robot));
        can_be_made && self.moves.iter().all(at_goal)
    }
}

/// Scratch space says nothing.
impl PartialEq for Plan {
    fn eq(&self, other: &Self) -> bool {
        self.moves == other.moves
    }
}

impl Eq for Plan {}

impl Hash for Plan {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.moves.hash(state);
    }
}

const SIDESTEPS_PER_ROBOT: usize = 4;

/// Start of the section that begins last at or before `upper`; 0 without one.
pub(crate) fn section_start(contacts: &[Contact], upper: usize) -> usize {
    let starts = contacts.iter().map(|contact| contact.own.lower);
    starts.filter(|start| *start <= upper).max().unwrap_or(0)
}
