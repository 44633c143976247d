//! What a robot counts of the messages it was given and of how it stopped.

use serde::Serialize;

/// Counted since the robot was made.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct RobotCounters {
    /// Missions begun.
    pub missions_started_count: u64,
    /// Missions driven to their goal.
    pub missions_done_count: u64,
    /// Missions passed over because they were the present one again, or an older one.
    pub missions_repeated_count: u64,
    /// Missions not taken because another was under way.
    pub missions_busy_count: u64,
    /// Missions refused: unknown path, another hash, another range, or not where the robot stands.
    pub missions_refused_count: u64,
    /// Times the robot was put at its goal to clear a stuck fleet.
    pub replaced_count: u64,
    /// Authorities applied, late ones included.
    pub applied_count: u64,
    /// Authorities that named the authority in force already (original's rules).
    pub unchanged_count: u64,
    /// Authorities that came too late to stop at; the robot went past (original's rules).
    pub late_count: u64,
    /// Authorities behind the robot, ignored; it drove on (original's rules).
    pub ignored_count: u64,
    /// Authorities refused because the robot could not stop at them (acknowledged rules).
    pub refused_count: u64,
    /// Authorities passed over: older, repeated, or for a mission that is over.
    pub stale_count: u64,
    /// Authorities that came before their mission: passed over by the original's rules, kept for
    /// it by the acknowledged ones.
    pub early_count: u64,
    /// Authorities with an index that means nothing.
    pub invalid_count: u64,
    /// Authorities and missions whose `header_id` was not newer than the newest of their kind.
    pub out_of_order_count: u64,
    /// Leases that ended before a newer authority came.
    pub leases_ended_count: u64,
    /// Times the robot came to rest after driving.
    pub stop_count: u64,
    /// Farthest it came to rest past an authority that came in time, metres.
    pub stop_error_max_m: f64,
    /// Farthest it came to rest past an authority that came too late, metres.
    pub late_overshoot_max_m: f64,
    /// Way driven, metres.
    pub travelled_m: f64,
    /// States given.
    pub states_count: u64,
    /// Ticks that went by without a call.
    pub skipped_ticks_count: u64,
}

#[cfg(test)]
impl RobotCounters {
    /// Adds the counts of another robot.
    pub(crate) fn add(&mut self, other: &Self) {
        self.missions_started_count += other.missions_started_count;
        self.missions_done_count += other.missions_done_count;
        self.missions_repeated_count += other.missions_repeated_count;
        self.missions_busy_count += other.missions_busy_count;
        self.missions_refused_count += other.missions_refused_count;
        self.replaced_count += other.replaced_count;
        self.applied_count += other.applied_count;
        self.unchanged_count += other.unchanged_count;
        self.late_count += other.late_count;
        self.ignored_count += other.ignored_count;
        self.refused_count += other.refused_count;
        self.stale_count += other.stale_count;
        self.early_count += other.early_count;
        self.invalid_count += other.invalid_count;
        self.out_of_order_count += other.out_of_order_count;
        self.leases_ended_count += other.leases_ended_count;
        self.stop_count += other.stop_count;
        self.stop_error_max_m = self.stop_error_max_m.max(other.stop_error_max_m);
        self.late_overshoot_max_m = self.late_overshoot_max_m.max(other.late_overshoot_max_m);
        self.travelled_m += other.travelled_m;
        self.states_count += other.states_count;
        self.skipped_ticks_count += other.skipped_ticks_count;
    }
}
