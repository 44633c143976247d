//! The original's coordination: orders are believed delivered, sent again after a while at most,
//! and who can still stop is reckoned from the delay the coordinator was told. It is kept with
//! its weaknesses, because the published tables rest on them; no collision is drawn by lot.
//!
//! Written from a description of the algorithm, not from its code. Replicas are copies of each
//! authority; a replica of the status flow is left to the channel model.

mod deadlock;
mod forward;
mod precedence;
#[cfg(test)]
mod tests;

use core::time::Duration;

use crate::coordinator::legacy::deadlock::{CircleFinder, Dependency};
use crate::coordinator::legacy::forward::ForwardModel;
use crate::coordinator::legacy::precedence::{Belief, Decision, as_authority, decide, wait_index};
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::roster::Roster;
use crate::coordinator::{Cycle, Rules};
use crate::messages::{Authority, Header, ToRobot};
use crate::scenario::Scene;
use crate::section::Side;
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
        let slot_count = cycle.roster.sections().slot_count();
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
        for (slot, active) in roster.sections().of_robot(robot) {
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
        cycle.counters.counts.deadlocked_cycles += u64::from(circle_count > 0);
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
            let (Some(active), Some(decision)) =
                (cycle.roster.sections_mut().get_mut(slot), decision)
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
                        fleet_id: cycle.roster.fleet_id(),
                        robot_id: state.header.robot_id,
                        header_id: commanded.header_id,
                        mission_id: commanded.mission_id,
                        sent_ns: now.as_ns(),
                    },
                    sequence: commanded.sequence,
                    authority_index: authority,
                    lease_ns: 0,
                    echo_header_id: state.header.header_id,
                    flags: 0,
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
