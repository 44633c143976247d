//! The original's coordination: orders are believed delivered, sent again after a while at most,
//! and who can still stop is reckoned from the delay the coordinator was told. It is kept with
//! its weaknesses, because the published tables rest on them; no collision is drawn by lot.
//!
//! Written from a description of the algorithm, not from its code. Replicas are copies of each
//! authority; a replica of the status flow is left to the channel model.

#[cfg(test)]
mod tests;

use core::cmp::Ordering;
use core::time::Duration;

use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::policy::{Contest, OrderingPolicy};
use crate::coordinator::roster::{RobotView, Roster};
use crate::coordinator::sections::ActiveSection;
use crate::coordinator::{Cycle, Rules, reach_m};
use crate::messages::{Authority, Header, TO_GOAL, ToRobot};
use crate::scenario::Scene;
use crate::section::{Side, Span};
use crate::world::Vehicle;
use hil_core::time::Instant;

/// The legacy mode's state between control cycles.
#[derive(Debug)]
pub(crate) struct LegacyRules {
    forward: ForwardModel,
    trailing_points: usize,
    replicas: u32,
    breaks_deadlocks: bool,
    repeat_after: Duration,
    robots: Vec<Commanded>,
    beliefs: Vec<Belief>,
    /// By section slot.
    decisions: Vec<Option<Decision>>,
    /// What each robot has to wait for first.
    closest: Vec<Option<Dependency>>,
    circles: CircleFinder,
}

/// What a robot was told last.
#[derive(Debug, Clone, Copy, Default)]
struct Commanded {
    mission_id: u32,
    authority: Option<i32>,
    sent_at: Instant,
    sequence: u32,
    header_id: u32,
}

impl LegacyRules {
    pub(crate) fn new(scene: &Scene, parameters: &CoordinatorParameters) -> Self {
        let robot_count = scene.starts.len();
        let (period, delay) = (parameters.control_period(), parameters.known_delay());
        Self {
            forward: ForwardModel::new(&scene.world.vehicle, parameters),
            trailing_points: parameters.trailing_points as usize,
            replicas: parameters.replicas,
            breaks_deadlocks: parameters.break_deadlocks,
            repeat_after: 2 * (delay + period + parameters.tracking_period()) + period,
            robots: vec![Commanded::default(); robot_count],
            beliefs: vec![Belief::default(); robot_count],
            decisions: Vec::new(),
            closest: vec![None; robot_count],
            circles: CircleFinder::default(),
        }
    }

    fn believe(&mut self, roster: &Roster) {
        let views = roster.robots().iter().zip(&mut self.robots);
        for ((view, commanded), belief) in views.zip(&mut self.beliefs) {
            let mission_id = view.mission.as_ref().map_or(0, |mission| mission.id);
            if commanded.mission_id != mission_id {
                commanded.mission_id = mission_id;
                commanded.authority = None;
                commanded.sequence = 0;
            }
            *belief = Belief {
                commanded: commanded.authority,
                index: view.index(),
                earliest_stop: self.forward.earliest_stop(view),
            };
        }
    }

    fn order_sections(&mut self, cycle: &mut Cycle<'_>) {
        let slot_count = cycle.roster.sections.slot_count();
        self.decisions.resize(slot_count, None);
        for slot in 0..slot_count {
            self.decisions[slot] = decide(
                slot,
                cycle.roster,
                &self.beliefs,
                cycle.policy,
                self.trailing_points,
            );
        }
        for robot in 0..self.robots.len() {
            self.closest[robot] = self.closest_of(robot, cycle.roster);
        }
    }

    /// What `robot` has to wait for first, by the present decisions.
    fn closest_of(&self, robot: usize, roster: &Roster) -> Option<Dependency> {
        let mut closest: Option<Dependency> = None;
        for (slot, active) in roster.sections.of_robot(robot) {
            let Some(decision) = self.decisions[slot] else {
                continue;
            };
            let side = active.side_of(robot);
            let driving = active.robot(side.other());
            // No wait point of this section lies before it, so it need not be computed then.
            let earliest = active.start(side).saturating_sub(self.trailing_points);
            let is_beaten = |wait| closest.is_some_and(|known| known.wait_index <= wait);
            let wait = if decision.leader == side {
                decision.leader_wait
            } else if is_beaten(earliest) {
                None
            } else {
                let leader_index = self.beliefs[driving].index;
                let points = self.trailing_points;
                Some(wait_index(active, decision.leader, leader_index, points))
            };
            if let Some(wait_index) = wait.filter(|&wait| !is_beaten(wait)) {
                closest = Some(Dependency {
                    driving,
                    wait_index,
                    release_index: active.end(side.other()),
                    slot,
                    leader: decision.leader,
                    is_reversible: decision.is_reversible,
                });
            }
        }
        closest
    }

    /// Turns orders round, one at a time, while that leaves fewer circles of waiting robots.
    fn break_deadlocks(&mut self, cycle: &mut Cycle<'_>) {
        let mut circle_count = self.circles.count(&self.closest);
        while circle_count > 0 && self.breaks_deadlocks {
            let Some(left_count) = self.reverse_one(cycle.roster, circle_count) else {
                break;
            };
            cycle.counters.counts.deadlocks_broken += (circle_count - left_count) as u64;
            circle_count = left_count;
        }
    }

    /// Reverses the first order that leaves fewer than `circle_count` circles; gives how many.
    fn reverse_one(&mut self, roster: &Roster, circle_count: usize) -> Option<usize> {
        for position in 0.. {
            let &waiting = self.circles.members().get(position)?;
            let Some(dependency) = self.closest[waiting].filter(|known| known.is_reversible) else {
                continue;
            };
            let before = [self.closest[waiting], self.closest[dependency.driving]];
            self.lead(dependency, dependency.leader.other(), waiting, roster);
            let left_count = self.circles.count(&self.closest);
            if left_count < circle_count {
                return Some(left_count);
            }
            self.lead(dependency, dependency.leader, waiting, roster);
            debug_assert_eq!(
                before,
                [self.closest[waiting], self.closest[dependency.driving]]
            );
            self.circles.count(&self.closest);
        }
        None
    }

    fn lead(&mut self, dependency: Dependency, leader: Side, waiting: usize, roster: &Roster) {
        if let Some(decision) = &mut self.decisions[dependency.slot] {
            decision.leader = leader;
        }
        for robot in [waiting, dependency.driving] {
            self.closest[robot] = self.closest_of(robot, roster);
        }
    }

    fn keep_orders(&self, cycle: &mut Cycle<'_>) {
        for (slot, decision) in self.decisions.iter().enumerate() {
            let (Some(active), Some(decision)) = (cycle.roster.sections.get_mut(slot), decision)
            else {
                continue;
            };
            let is_reversed = active.leader.is_some_and(|old| old != decision.leader);
            active.leader = Some(decision.leader);
            let counts = &mut cycle.counters.counts;
            counts.order_reversals += u64::from(is_reversed);
            counts.artificial_dependencies += u64::from(decision.leader_wait.is_some());
        }
    }

    /// Sends what changed, and what a robot does not show although it had the time to.
    fn command(&mut self, cycle: &mut Cycle<'_>) {
        let now = cycle.now;
        for (robot, view) in cycle.roster.robots().iter().enumerate() {
            // The original hands a mission over in shared memory, so no authority overtakes it.
            let Some(state) = view.state else {
                continue;
            };
            if view.mission.as_ref().is_none_or(|mission| mission.is_reset) {
                continue;
            }
            let authority = as_authority(self.closest[robot].map(|known| known.wait_index));
            let commanded = &mut self.robots[robot];
            let counts = &mut cycle.counters.counts;
            if commanded.authority != Some(authority) {
                counts.authority_changes += 1;
            } else if state.authority_index != authority
                && now.saturating_duration_since(commanded.sent_at) > self.repeat_after
            {
                counts.authority_repeats += 1;
            } else {
                continue;
            }
            commanded.authority = Some(authority);
            commanded.sent_at = now;
            commanded.sequence += 1;
            for _ in 0..self.replicas {
                commanded.header_id = commanded.header_id.wrapping_add(1);
                counts.authority_messages += 1;
                (cycle.send)(ToRobot::Authority(Authority {
                    header: Header {
                        fleet_id: cycle.roster.fleet_id,
                        robot_id: state.header.robot_id,
                        header_id: commanded.header_id,
                        mission_id: commanded.mission_id,
                        sent_ns: now.as_ns(),
                    },
                    sequence: commanded.sequence,
                    authority_index: authority,
                    echo_header_id: state.header.header_id,
                    ..Authority::default()
                }));
            }
        }
    }
}

impl Rules for LegacyRules {
    fn decide(&mut self, cycle: &mut Cycle<'_>) {
        self.believe(cycle.roster);
        self.order_sections(cycle);
        self.break_deadlocks(cycle);
        self.keep_orders(cycle);
        self.command(cycle);
    }
}

/// Robot `waiting` must not pass `wait_index` before robot `driving` passed `release_index`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Dependency {
    pub(crate) driving: usize,
    /// Pose of the waiting robot's path.
    pub(crate) wait_index: usize,
    /// Pose of the driving robot's path.
    pub(crate) release_index: usize,
    /// Where the section is kept.
    pub(crate) slot: usize,
    /// Who goes first there.
    pub(crate) leader: Side,
    /// The order of that section may be turned round.
    pub(crate) is_reversible: bool,
}

/// Finds circles; keeps its memory between calls.
#[derive(Debug, Default)]
pub(crate) struct CircleFinder {
    /// Number of the walk that reached each robot; 0 for none.
    walk_of: Vec<usize>,
    /// Robots of the circles that never dissolve by themselves, one circle after the other.
    members: Vec<usize>,
}

impl CircleFinder {
    /// Number of circles that never dissolve: each robot in them waits before the pose that
    /// would release the one behind it. `closest[r]` is what robot `r` waits for first; so each
    /// robot has one successor at most and each circle is met by following it.
    pub(crate) fn count(&mut self, closest: &[Option<Dependency>]) -> usize {
        self.walk_of.clear();
        self.walk_of.resize(closest.len(), 0);
        self.members.clear();
        let mut circle_count = 0;
        for start in 0..closest.len() {
            let walk = start + 1;
            let mut at = start;
            while self.walk_of[at] == 0 {
                self.walk_of[at] = walk;
                match closest[at] {
                    Some(dependency) => at = dependency.driving,
                    None => break,
                }
            }
            if self.walk_of[at] == walk && closest[at].is_some() {
                circle_count += usize::from(self.note_if_stuck(at, closest));
            }
        }
        circle_count
    }

    /// Robots of the circles found by the last count.
    pub(crate) fn members(&self) -> &[usize] {
        &self.members
    }

    fn note_if_stuck(&mut self, entry: usize, closest: &[Option<Dependency>]) -> bool {
        let known_count = self.members.len();
        let mut at = entry;
        while let Some(here) = closest[at] {
            let is_held =
                closest[here.driving].is_some_and(|next| next.wait_index <= here.release_index);
            if !is_held {
                self.members.truncate(known_count);
                return false;
            }
            self.members.push(at);
            at = here.driving;
            if at == entry {
                return true;
            }
        }
        self.members.truncate(known_count);
        false
    }
}

/// The forward model of one kind of vehicle.
#[derive(Debug, Clone)]
pub(crate) struct ForwardModel {
    vehicle: Vehicle,
    lookahead_s: f64,
}

/// Vehicles may speed up this much better, and brake as much worse, than they should.
const PESSIMISM_RATIO: f64 = 0.1;

impl ForwardModel {
    pub(crate) fn new(vehicle: &Vehicle, parameters: &CoordinatorParameters) -> Self {
        Self {
            vehicle: *vehicle,
            lookahead_s: lookahead(parameters).as_secs_f64(),
        }
    }

    /// Way a vehicle at `speed_mps` still makes when it first speeds up for the lookahead and
    /// then brakes, metres.
    pub(crate) fn stopping_way_m(&self, speed_mps: f64) -> f64 {
        reach_m(&self.vehicle, PESSIMISM_RATIO, speed_mps, self.lookahead_s)
    }

    /// The pose at which the robot of `view` could stop at the earliest.
    pub(crate) fn earliest_stop(&self, view: &RobotView) -> usize {
        let (Some(mission), Some(state)) = (&view.mission, &view.state) else {
            return 0;
        };
        let way_m = state.travelled_m + self.stopping_way_m(f64::from(state.speed_mps));
        mission.path.index_at(way_m)
    }
}

/// The worst age of what the decision rests on when its order takes effect: a state up to a
/// tracking period and a delay old, an order that waits for the next cycle, takes a delay and
/// waits for a tracking period: Tc + 2 (D + TT).
fn lookahead(parameters: &CoordinatorParameters) -> Duration {
    parameters.control_period() + 2 * (parameters.known_delay() + parameters.tracking_period())
}

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
    let active = roster.sections.get(slot)?;
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
            .first_conflict(leader, sweep, Span::at(stands_at));
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
            .first_conflict(waiting, Span::between(start, active.end(waiting)), sweep)
            .unwrap_or(start)
    };
    conflict.saturating_sub(trailing_points)
}

/// `TO_GOAL` or the pose as a message carries it.
pub(crate) fn as_authority(wait: Option<usize>) -> i32 {
    wait.map_or(TO_GOAL, |index| i32::try_from(index).unwrap_or(i32::MAX))
}

#[cfg(test)]
mod deadlock_tests {
    use super::*;

    #[allow(clippy::unnecessary_wraps, reason = "what the finder takes")]
    fn waits_for(driving: usize, wait_index: usize, release_index: usize) -> Option<Dependency> {
        Some(Dependency {
            driving,
            wait_index,
            release_index,
            slot: 0,
            leader: Side::First,
            is_reversible: true,
        })
    }

    #[test]
    fn only_circles_that_never_dissolve_count() {
        let check = |closest: &[Option<Dependency>], expected: &[usize]| {
            let mut finder = CircleFinder::default();
            let count = finder.count(closest);
            assert_eq!(count, usize::from(!expected.is_empty()), "{closest:?}");
            assert_eq!(finder.members(), expected);
        };
        check(&[None, None], &[]);
        check(&[waits_for(1, 5, 9), None], &[]);
        check(&[waits_for(1, 5, 9), waits_for(0, 7, 8)], &[0, 1]);
        // Robot 1 passes pose 9, which releases robot 0, before it has to wait at 12.
        check(&[waits_for(1, 5, 9), waits_for(0, 12, 8)], &[]);
        // Robot 0 leads into the circle of 1 and 2 but is none of it.
        let tail = [waits_for(1, 1, 1), waits_for(2, 3, 6), waits_for(1, 4, 5)];
        check(&tail, &[1, 2]);
    }

    #[test]
    fn two_circles_are_two() {
        let pair = |other| waits_for(other, 1, 2);
        let mut finder = CircleFinder::default();
        assert_eq!(finder.count(&[pair(3), pair(2), pair(1), pair(0)]), 2);
        assert_eq!(finder.members().len(), 4);
    }
}

#[cfg(test)]
mod forward_tests {
    use super::*;
    use crate::geometry::Footprint;

    #[test]
    fn the_closed_form_agrees_with_small_steps() {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 2.0,
                width_m: 0.5,
            },
            speed_max_mps: 2.0,
            acceleration_mps2: 1.0,
        };
        let parameters = CoordinatorParameters {
            known_delay_ms: 70.0,
            ..CoordinatorParameters::default()
        };
        let model = ForwardModel::new(&vehicle, &parameters);
        assert!((model.lookahead_s - 1.2).abs() < 1e-12);
        for start_mps in [0.0, 0.5, 1.3, 1.99, 2.0, 2.3] {
            let (mut way_m, mut speed_mps, mut time_s) = (0.0, start_mps, 0.0);
            let step_s = 1e-5;
            while time_s < 1.2 {
                way_m += speed_mps * step_s;
                if speed_mps < 2.0 {
                    speed_mps += 1.1 * step_s;
                }
                time_s += step_s;
            }
            while speed_mps > 0.0 {
                way_m += speed_mps * step_s;
                speed_mps -= 0.9 * step_s;
            }
            let difference_m: f64 = model.stopping_way_m(start_mps) - way_m;
            assert!(difference_m.abs() < 1e-3, "{start_mps}: {difference_m}");
        }
    }
}
