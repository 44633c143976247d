//! What the referee has counted and the list of what it saw happen.

use serde::Serialize;

use crate::messages::TruthKind;
use hil_core::time::Instant;

/// Counts of one run, all fleets together.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Tally {
    /// Critical sections of two missions under way at once, both still ahead.
    pub sections_created_count: u64,
    /// Of those, the ones a robot drove through to the end: the original's count.
    pub sections_passed_count: u64,
    /// Of those, the ones that ended because a robot was replaced.
    pub sections_dropped_count: u64,
    /// Of those, the ones both robots were in at the same time.
    pub encounters_count: u64,
    /// Sections with a collision by the original's checker: both robots in the section, and
    /// footprints overlapping at the last path poses passed. One count per section until they
    /// separate.
    pub section_collisions_count: u64,
    /// Times two robots of a fleet overlapped where they truly were, until they separated.
    pub overlaps_count: u64,
    /// Of those, the ones that began outside every section of the two: the section list misses
    /// them.
    pub outside_count: u64,
    /// Smallest distance between two robots of a fleet, metres; `None` when none came near.
    pub separation_min_m: Option<f64>,
    /// Farthest a robot went past an authority that came in time, metres.
    pub stop_error_max_m: f64,
    /// Farthest a robot went past an authority that came too late, metres.
    pub late_overshoot_max_m: f64,
    /// Way driven, metres.
    pub travelled_m: f64,
    /// Missions begun.
    pub missions_started_count: u64,
    /// Missions driven to their goal.
    pub missions_done_count: u64,
    /// Robots put at their goal to clear a stuck fleet.
    pub replaced_count: u64,
    /// Authorities applied in time.
    pub authorities_applied_count: u64,
    /// Authorities applied too late to stop at.
    pub authorities_late_count: u64,
    /// Authorities behind the robot, ignored.
    pub authorities_ignored_count: u64,
    /// Authorities refused because the robot could not stop at them.
    pub authorities_refused_count: u64,
    /// Older or repeated messages passed over.
    pub stale_count: u64,
    /// Leases that ended.
    pub leases_ended_count: u64,
    /// Scans made.
    pub scans_count: u64,
    /// Truth records that name an unknown fleet, robot, path or kind, or no finite motion.
    pub unsound_count: u64,
    /// Incidents not kept because the list was full.
    pub incidents_dropped_count: u64,
}

impl Tally {
    pub(crate) fn count_kind(&mut self, kind: TruthKind) {
        match kind {
            TruthKind::Motion => {}
            TruthKind::MissionStarted => self.missions_started_count += 1,
            TruthKind::MissionDone => self.missions_done_count += 1,
            TruthKind::AuthorityApplied => self.authorities_applied_count += 1,
            TruthKind::AuthorityLate => self.authorities_late_count += 1,
            TruthKind::AuthorityIgnored => self.authorities_ignored_count += 1,
            TruthKind::AuthorityRefused => self.authorities_refused_count += 1,
            TruthKind::MessageStale => self.stale_count += 1,
            TruthKind::LeaseEnded => self.leases_ended_count += 1,
            TruthKind::Replaced => self.replaced_count += 1,
        }
    }
}

/// What an incident is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum IncidentKind {
    /// A collision by the original's checker.
    Section,
    /// Two robots overlapped where they truly were, within a section.
    Overlap,
    /// The same, outside every section.
    Outside,
}

/// Something that must not happen, with what led to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Incident {
    /// The scan that saw it.
    pub at: Instant,
    /// What it is.
    pub kind: IncidentKind,
    /// In which fleet.
    pub fleet_id: u32,
    /// The two robots, the smaller number first.
    pub robots: [u32; 2],
    /// Their missions, also when done; 0 before the first.
    pub mission_ids: [u32; 2],
    /// Whether each was on its mission, and not parked.
    pub is_under_way: [bool; 2],
    /// Half way between the two, map frame, metres.
    pub position_m: [f64; 2],
    /// Per robot, what became of its last authority.
    pub causes: [Cause; 2],
}

/// What became of the authority a robot got last before an incident.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Cause {
    /// A [`TruthKind`] as a number; 0 when it had none.
    pub kind: u32,
    /// `sequence` of the authority message; 0 when it had none.
    pub caused_by_sequence: u32,
    /// When, nanoseconds on the robots' clock.
    pub at_ns: i64,
}
