//! What came of a run, and of several runs of one cell together.

use crate::coordinator::counters::{CoordinatorCounts, SafeCounts};
use crate::experiment::cells::Cell;
use crate::experiment::driver::Experiment;
use crate::referee::Tally;
use crate::scenario::Scene;
use hil_core::time::Instant;
use hil_link::impaired::LinkCounts;
use hil_stats::statistics::clopper_pearson;

/// Figures of one or more runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FleetTally {
    /// What the referee saw.
    pub referee: Tally,
    /// What the coordinators counted.
    pub coordinator: CoordinatorCounts,
    /// What the safe mode's rules counted; zeros in the legacy mode.
    pub safe: SafeCounts,
    /// What became of authorities and missions on their way.
    pub commands: LinkCounts,
    /// What became of states on their way.
    pub status: LinkCounts,
    /// States deleted on their way by a newer one.
    pub superseded_count: u64,
    /// Time run, seconds.
    pub run_s: f64,
    /// Time run times robots, seconds.
    pub robot_s: f64,
    /// Farthest a robot may stop past an authority that came in time, metres.
    pub stop_error_bound_m: f64,
    /// Runs that ended because the fleet stood.
    pub stand_count: u64,
    /// Runs with a collision.
    pub collided: Vec<CollidedRun>,
}

/// Where to see a collision again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CollidedRun {
    /// Which of the cell's runs.
    pub replica: u64,
    /// Its seed.
    pub seed: u64,
    /// When the first collision was seen.
    pub first_at: Instant,
}

/// Runs with a collision that a tally remembers.
const COLLIDED_MAX: usize = 8;

impl FleetTally {
    pub(crate) fn of(experiment: &Experiment) -> Self {
        let [commands, status] = experiment.link_counts();
        let run_s = experiment.now().seconds_since(Instant::ZERO);
        let first_at = experiment.incidents().first();
        Self {
            referee: *experiment.referee().tally(),
            coordinator: experiment.coordinator().counters().counts,
            safe: experiment.coordinator().counters().safe,
            commands,
            status,
            superseded_count: experiment.superseded_count(),
            run_s,
            robot_s: run_s * experiment.robots().len() as f64,
            collided: first_at
                .map(|incident| CollidedRun {
                    replica: 0,
                    seed: 0,
                    first_at: incident.at,
                })
                .into_iter()
                .collect(),
            ..Self::default()
        }
    }

    /// Adds what only the study knows of a run.
    pub(crate) fn conclude(&mut self, seed: u64, replica: u64, cell: &Cell, scene: &Scene) {
        let robot = &cell.setup.robot;
        self.stop_error_bound_m = robot.stop_error_bound_m(&scene.world.vehicle);
        for run in &mut self.collided {
            (run.seed, run.replica) = (seed, replica);
        }
    }

    /// Adds another run.
    pub fn merge(&mut self, other: &Self) {
        merge_referee(&mut self.referee, &other.referee);
        self.coordinator.merge(&other.coordinator);
        self.safe.merge(&other.safe);
        merge_link(&mut self.commands, &other.commands);
        merge_link(&mut self.status, &other.status);
        self.superseded_count += other.superseded_count;
        self.run_s += other.run_s;
        self.robot_s += other.robot_s;
        self.stop_error_bound_m = self.stop_error_bound_m.max(other.stop_error_bound_m);
        self.stand_count += other.stand_count;
        let room = COLLIDED_MAX.saturating_sub(self.collided.len());
        self.collided.extend(other.collided.iter().take(room));
    }

    /// Critical sections that a robot passed.
    pub fn section_count(&self) -> u64 {
        self.referee.sections_passed_count
    }

    /// Collisions by the original's checker: the count the tables' probability is of.
    pub fn collision_count(&self) -> u64 {
        self.referee.section_collisions_count
    }

    /// Collisions by any of the three checkers. The true overlaps include those outside every
    /// section.
    pub fn any_collision_count(&self) -> u64 {
        self.referee.section_collisions_count + self.referee.overlaps_count
    }

    /// Collisions per critical section; `None` without sections.
    pub fn collision_ratio(&self) -> Option<f64> {
        let sections = self.section_count();
        (sections > 0).then(|| self.collision_count() as f64 / sections as f64)
    }

    /// The 95 % interval of [`FleetTally::collision_ratio`]; `None` without sections.
    pub fn collision_interval(&self) -> Option<(f64, f64)> {
        collision_interval(self.collision_count(), self.section_count())
    }

    /// Missions driven to their end per hour of the fleet; `None` before it ran.
    pub fn missions_per_hour(&self) -> Option<f64> {
        (self.run_s > 0.0).then(|| 3600.0 * self.referee.missions_done_count as f64 / self.run_s)
    }
}

/// The exact interval (Clopper and Pearson 1934) of collisions per critical section, 95 %.
pub(crate) fn collision_interval(collisions: u64, sections: u64) -> Option<(f64, f64)> {
    // One section can see two collisions; more collisions than sections are no proportion.
    if collisions > sections {
        return None;
    }
    clopper_pearson(collisions, sections, 0.95).map(|interval| (interval.low, interval.high))
}

fn merge_link(sum: &mut LinkCounts, other: &LinkCounts) {
    sum.offered_count += other.offered_count;
    sum.lost_count += other.lost_count;
    sum.duplicated_count += other.duplicated_count;
    sum.held_count += other.held_count;
    sum.stalled_count += other.stalled_count;
}

fn merge_referee(sum: &mut Tally, other: &Tally) {
    sum.sections_created_count += other.sections_created_count;
    sum.sections_passed_count += other.sections_passed_count;
    sum.sections_dropped_count += other.sections_dropped_count;
    sum.encounters_count += other.encounters_count;
    sum.section_collisions_count += other.section_collisions_count;
    sum.overlaps_count += other.overlaps_count;
    sum.outside_count += other.outside_count;
    sum.separation_min_m = match (sum.separation_min_m, other.separation_min_m) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    };
    sum.stop_error_max_m = sum.stop_error_max_m.max(other.stop_error_max_m);
    sum.late_overshoot_max_m = sum.late_overshoot_max_m.max(other.late_overshoot_max_m);
    sum.travelled_m += other.travelled_m;
    sum.missions_started_count += other.missions_started_count;
    sum.missions_done_count += other.missions_done_count;
    sum.replaced_count += other.replaced_count;
    sum.authorities_applied_count += other.authorities_applied_count;
    sum.authorities_late_count += other.authorities_late_count;
    sum.authorities_ignored_count += other.authorities_ignored_count;
    sum.authorities_refused_count += other.authorities_refused_count;
    sum.stale_count += other.stale_count;
    sum.leases_ended_count += other.leases_ended_count;
    sum.scans_count += other.scans_count;
    sum.unsound_count += other.unsound_count;
    sum.incidents_dropped_count += other.incidents_dropped_count;
}
