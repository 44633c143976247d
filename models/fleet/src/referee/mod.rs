//! The referee: from the robots' truth alone it counts critical sections and collisions, by three
//! checkers. It takes no part in a run and no one hears it before the end.
//!
//! It looks every [`SCAN_PERIOD`], as often as the original's checker. What begins and ends between
//! two looks it does not see: at most an overlap shorter than 30 ms, which two robots crossing at
//! 6 m/s can make 0.2 m deep.
//!
//! A collision, once counted, is over when the two are apart by more than two pose spacings. Less
//! would count one collision many times: at the last poses passed, where the original's checker
//! looks, robots that follow each other closely overlap and part with each pose.

mod approaches;
pub mod live;
mod pairs;
mod sections;
#[cfg(test)]
mod tests;

use core::time::Duration;
use std::sync::Arc;

use serde::Serialize;

use crate::geometry::{OrientedBox, Pose, floor_index};
use crate::messages::{Truth, TruthKind};
use crate::path::{Path, PathId};
use crate::referee::approaches::Approaches;
pub use crate::referee::approaches::Clearances;
use crate::referee::pairs::PairFinder;
use crate::referee::sections::ActiveSections;
use crate::robot::NO_PATH;
use crate::scenario::Scene;
use crate::world::{Vehicle, World};
use hil_core::time::Instant;

/// From scan to scan.
pub const SCAN_PERIOD: Duration = Duration::from_millis(30);

/// A robot that stands for so many scans before its goal has stopped. The stepped tracker stands between its ticks: with ticks of more than
/// half of this, what is no stop may count as one.
pub(crate) const STOP_SCANS: u32 = 10;

/// Incidents kept; more are counted.
pub const INCIDENTS_MAX: usize = 10_000;

/// Watches all fleets of a run.
#[derive(Debug)]
pub struct Referee {
    world: Arc<World>,
    per_fleet: usize,
    tracks: Vec<Track>,
    finder: PairFinder,
    sections: ActiveSections,
    overlapping: Vec<[u32; 2]>,
    approaches: Approaches,
    tally: Tally,
    incidents: Vec<Incident>,
    collided_after: Vec<u64>,
}

impl Referee {
    /// A referee for `fleet_count` fleets of the scene's robots, all in their starting bays.
    pub fn new(scene: &Scene, fleet_count: u32) -> Self {
        let world = Arc::clone(&scene.world);
        let stands = scene.starts.iter().map(|&bay| world.bays[bay].pose);
        let fleet: Vec<_> = stands.map(Track::standing).collect();
        let (per_fleet, count) = (fleet.len(), fleet.len() * fleet_count as usize);
        let spacing_m = (world.paths.ids())
            .filter_map(|id| world.paths.get(id))
            .map(|path| path.spacing_m())
            .fold(0.0, f64::max);
        let approaches = Approaches::new(spacing_m, 4 * count);
        let reach_m = 2.0 * world.vehicle.footprint.radius_m() + approaches.separated_m();
        Self {
            per_fleet,
            tracks: fleet.into_iter().cycle().take(count).collect(),
            finder: PairFinder::new(reach_m, per_fleet),
            sections: ActiveSections::new(count),
            overlapping: Vec::with_capacity(4 * count),
            approaches,
            tally: Tally::default(),
            incidents: Vec::with_capacity(INCIDENTS_MAX.min(64)),
            collided_after: Vec::new(),
            world,
        }
    }

    /// Takes a record; records of one robot must come in order of time.
    pub fn on_truth(&mut self, truth: &Truth) {
        let Some((robot, kind)) = self.check(truth) else {
            self.tally.unsound_count += 1;
            return;
        };
        let path = self.world.paths.get(PathId(truth.path_id));
        let track = &mut self.tracks[robot];
        let driven_m = track.take(truth, path);
        self.tally.count_kind(kind);
        if kind != TruthKind::Replaced {
            self.tally.travelled_m += driven_m;
        }
        let is_about_authority = matches!(
            kind,
            TruthKind::AuthorityApplied
                | TruthKind::AuthorityLate
                | TruthKind::AuthorityIgnored
                | TruthKind::AuthorityRefused
        );
        if is_about_authority {
            track.cause = Cause {
                kind: truth.kind,
                caused_by_sequence: truth.caused_by_sequence,
                at_ns: truth.at_ns,
            };
        }
        match kind {
            TruthKind::AuthorityApplied => track.is_late = false,
            TruthKind::AuthorityLate => track.is_late = true,
            TruthKind::MissionStarted => self.begin_mission(robot, truth),
            TruthKind::MissionDone => {
                let delay_s = self.tracks[robot].mission_delay_s(truth, &self.world.vehicle);
                if let Some(delay_s) = delay_s {
                    self.tally.missions_timed_count += 1;
                    self.tally.mission_delay_s += delay_s;
                }
                self.end_mission(robot, true);
            }
            TruthKind::Replaced => {
                self.tracks[robot].begun = None;
                self.end_mission(robot, false);
            }
            _ => {}
        }
        self.note_stop_error(robot, truth);
    }

    /// Looks at all robots where they are at `now`. To be called every [`SCAN_PERIOD`], with all
    /// records up to `now` taken.
    pub fn scan(&mut self, now: Instant) {
        self.tally.scans_count += 1;
        for robot in 0..self.tracks.len() {
            let track = &mut self.tracks[robot];
            if track.look(now) && track.is_driving {
                self.sections.update(robot, track.index, &mut self.tally);
            }
            self.tally.stops_count += u64::from(track.has_stopped());
        }
        for position in 0..self.finder.find(&self.tracks) {
            let pair = self.finder.found(position);
            self.judge(now, pair);
        }
        // Robots that have moved apart beyond reach are no pair to judge any more.
        let (tracks, finder) = (&self.tracks, &self.finder);
        let is_within_reach = |pair: &[u32; 2]| {
            let [one, other] = pair.map(|robot| &tracks[robot as usize]);
            finder.are_within_reach(one, other)
        };
        self.overlapping.retain(is_within_reach);
        self.approaches
            .end_apart(is_within_reach, &mut self.tally.clearances);
    }

    /// Feeds records, sorted by time, and scans every [`SCAN_PERIOD`] from `start` to `end`: for
    /// the recorded truth of a live run. `see` looks on after every scan.
    pub fn replay(
        &mut self,
        records: &mut dyn Iterator<Item = Truth>,
        start: Instant,
        end: Instant,
        see: &mut dyn FnMut(Instant, &Self),
    ) {
        let mut pending = records.next();
        let mut now = start;
        while now <= end {
            while let Some(record) = pending.filter(|record| record.at_ns <= now.as_ns()) {
                self.on_truth(&record);
                pending = records.next();
            }
            self.scan(now);
            see(now, self);
            now = now + SCAN_PERIOD;
        }
    }

    /// Robots that are on a mission and have not moved from the last scan but one to the last.
    pub(crate) fn standing_count(&self) -> usize {
        let on_mission = self.tracks.iter().filter(|track| track.is_driving);
        on_mission.filter(|track| !track.has_moved).count()
    }

    /// Largest distance of two poses of a path, metres: the unit of [`Clearances`].
    pub(crate) fn spacing_m(&self) -> f64 {
        self.approaches.spacing_m
    }

    /// What it has counted.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The first [`INCIDENTS_MAX`] incidents, in order of time.
    pub fn incidents(&self) -> &[Incident] {
        &self.incidents
    }

    /// How many critical sections were passed before each of the first [`INCIDENTS_MAX`] collisions by the section checker.
    pub(crate) fn collided_after(&self) -> &[u64] {
        &self.collided_after
    }

    fn check(&self, truth: &Truth) -> Option<(usize, TruthKind)> {
        let is_finite = truth.travelled_m.is_finite()
            && truth.speed_mps.is_finite()
            && truth.acceleration_mps2.is_finite();
        let robot = truth.robot_id as usize;
        let index = (truth.fleet_id as usize)
            .checked_mul(self.per_fleet)?
            .checked_add(robot)?;
        let is_known = robot < self.per_fleet && index < self.tracks.len();
        let has_path =
            truth.path_id == NO_PATH || self.world.paths.get(PathId(truth.path_id)).is_some();
        let kind = TruthKind::from_number(truth.kind)?;
        (is_finite && is_known && has_path).then_some((index, kind))
    }

    fn begin_mission(&mut self, robot: usize, truth: &Truth) {
        self.sections.end(robot, false, &mut self.tally);
        let track = &mut self.tracks[robot];
        track.is_driving = true;
        track.is_late = false;
        track.begun = Some(MissionStart {
            mission_id: truth.mission_id,
            at: Instant::from_ns(truth.at_ns),
        });
        track.still_count = 0;
        track.cause = Cause::default();
        track.index = track
            .path
            .as_ref()
            .map_or(0, |path| path.index_at(truth.travelled_m));
        let first = truth.fleet_id as usize * self.per_fleet;
        let fleet = first..first + self.per_fleet;
        self.sections
            .begin(robot, fleet, &self.tracks, &self.world, &mut self.tally);
    }

    fn end_mission(&mut self, robot: usize, has_passed: bool) {
        self.tracks[robot].is_driving = false;
        self.sections.end(robot, has_passed, &mut self.tally);
    }

    fn note_stop_error(&mut self, robot: usize, truth: &Truth) {
        let track = &self.tracks[robot];
        let (Some(path), Ok(reach)) = (&track.path, usize::try_from(truth.authority_index)) else {
            return;
        };
        let error_m = truth.travelled_m - path.way_to_m(reach.min(path.last_index()));
        let worst_m = if track.is_late {
            &mut self.tally.late_overshoot_max_m
        } else {
            &mut self.tally.stop_error_max_m
        };
        *worst_m = worst_m.max(error_m);
    }

    fn judge(&mut self, now: Instant, pair: [u32; 2]) {
        let [one, other] = pair.map(|robot| &self.tracks[robot as usize]);
        let vehicle = &self.world.vehicle;
        let covered = [one, other].map(|track| track.covered(vehicle));
        let gap_m = covered[0].gap_m(&covered[1]);
        let least_m = self.tally.separation_min_m.unwrap_or(f64::INFINITY);
        if gap_m < least_m {
            let distance_m = covered[0].distance_m(&covered[1]);
            self.tally.separation_min_m = Some(least_m.min(distance_m));
        }
        let is_separated = gap_m > self.approaches.separated_m();
        let is_under_way = one.is_driving && other.is_driving;
        let ground = is_under_way.then_some(&covered);
        self.approaches
            .judge(pair, gap_m, ground, &mut self.tally.clearances);
        if is_under_way {
            let begun_count = self.sections.judge(pair, is_separated, || {
                let at_index = [one, other].map(|track| track.covered_at_index(vehicle));
                at_index[0].overlaps(&at_index[1])
            });
            self.tally.section_collisions_count += u64::from(begun_count);
            let passed = self.tally.sections_passed_count;
            let room = INCIDENTS_MAX.saturating_sub(self.collided_after.len());
            let begun = core::iter::repeat_n(passed, begun_count as usize);
            self.collided_after.extend(begun.take(room));
            if begun_count > 0 {
                self.add_incident(now, pair, IncidentKind::Section);
            }
        }
        let known = self.overlapping.iter().position(|known| *known == pair);
        match known {
            None if gap_m < 0.0 => {
                self.overlapping.push(pair);
                self.count_overlap(now, pair);
            }
            Some(position) if is_separated => {
                self.overlapping.swap_remove(position);
            }
            _ => {}
        }
    }

    fn count_overlap(&mut self, now: Instant, pair: [u32; 2]) {
        let indices = pair.map(|robot| self.tracks[robot as usize].index);
        self.tally.overlaps_count += 1;
        if self.sections.covers(pair, indices) {
            self.add_incident(now, pair, IncidentKind::Overlap);
        } else {
            self.tally.outside_count += 1;
            self.add_incident(now, pair, IncidentKind::Outside);
        }
    }

    fn add_incident(&mut self, at: Instant, pair: [u32; 2], kind: IncidentKind) {
        if self.incidents.len() >= INCIDENTS_MAX {
            return;
        }
        let [one, other] = pair.map(|robot| &self.tracks[robot as usize]);
        let per_fleet = u32::try_from(self.per_fleet).unwrap_or(u32::MAX);
        self.incidents.push(Incident {
            at,
            kind,
            fleet_id: pair[0] / per_fleet,
            robots: pair.map(|robot| robot % per_fleet),
            mission_ids: [one.mission_id, other.mission_id],
            is_under_way: [one.is_driving, other.is_driving],
            position_m: [0, 1].map(|axis| 0.5 * (one.position[axis] + other.position[axis])),
            causes: [one.cause, other.cause],
        });
    }
}

#[cfg(test)]
pub(crate) fn test_track(scene: &Scene, truth: &Truth) -> Track {
    let mut track = Track::standing(scene.world.bays[0].pose);
    track.take(truth, scene.world.paths.get(PathId(truth.path_id)));
    track
}

/// A robot's motion from its last record on, and where it was at the last scan.
#[derive(Debug, Clone)]
pub(crate) struct Track {
    pub(crate) path: Option<Arc<Path>>,
    pub(crate) path_id: PathId,
    pub(crate) mission_id: u32,
    pub(crate) is_driving: bool,
    /// Its last authority came too late to stop at.
    pub(crate) is_late: bool,
    pub(crate) cause: Cause,
    since: Instant,
    way_m: f64,
    speed_mps: f64,
    acceleration_mps2: f64,
    /// At the last scan.
    pub(crate) seen_m: f64,
    /// Last pose passed at the last scan.
    pub(crate) index: usize,
    /// Reference point at the last scan, metres.
    pub(crate) position: [f64; 2],
    /// It stands elsewhere than at the scan before.
    pub(crate) has_moved: bool,
    /// Scans at which it stood still on its mission, one after the other.
    still_count: u32,
    /// Of the mission it is on; `None` where no record tells.
    begun: Option<MissionStart>,
    stand: Pose,
}

/// When a mission reached its robot.
#[derive(Debug, Clone, Copy)]
struct MissionStart {
    mission_id: u32,
    at: Instant,
}

impl Track {
    /// A robot nothing is known of but where it stands.
    pub(crate) fn standing(stand: Pose) -> Self {
        Self {
            path: None,
            path_id: PathId(u32::MAX),
            mission_id: 0,
            is_driving: false,
            is_late: false,
            cause: Cause::default(),
            since: Instant::ZERO,
            way_m: 0.0,
            speed_mps: 0.0,
            acceleration_mps2: 0.0,
            seen_m: 0.0,
            index: 0,
            position: [stand.x_m, stand.y_m],
            has_moved: true,
            still_count: 0,
            begun: None,
            stand,
        }
    }

    /// Goes over to a record's motion; gives the way driven since the last record.
    pub(crate) fn take(&mut self, truth: &Truth, path: Option<&Arc<Path>>) -> f64 {
        let is_same_way = self.path_id.0 == truth.path_id && self.mission_id == truth.mission_id;
        let driven_m = if is_same_way {
            (truth.travelled_m - self.way_m).max(0.0)
        } else {
            0.0
        };
        if self.path_id.0 != truth.path_id {
            self.path_id = PathId(truth.path_id);
            self.path = path.map(Arc::clone);
        }
        if !is_same_way {
            self.has_moved = true;
            // No way compares equal to it: the next look takes the robot as moved.
            self.seen_m = f64::NAN;
        }
        self.mission_id = truth.mission_id;
        self.since = Instant::from_ns(truth.at_ns);
        self.way_m = truth.travelled_m;
        self.speed_mps = truth.speed_mps;
        self.acceleration_mps2 = truth.acceleration_mps2;
        driven_m
    }

    /// Way along its path at `now`; never backwards, and not beyond where it comes to rest.
    pub(crate) fn way_at_m(&self, now: Instant) -> f64 {
        if self.speed_mps <= 0.0 && self.acceleration_mps2 <= 0.0 {
            return self.way_m;
        }
        let mut elapsed_s = now.seconds_since(self.since).max(0.0);
        if self.acceleration_mps2 < 0.0 {
            elapsed_s = elapsed_s.min(self.speed_mps / -self.acceleration_mps2);
        }
        self.way_m + (self.speed_mps + 0.5 * self.acceleration_mps2 * elapsed_s) * elapsed_s
    }

    /// Looks where it is at `now`; true when it has passed another pose since the last look.
    pub(crate) fn look(&mut self, now: Instant) -> bool {
        let way_m = self.way_at_m(now);
        self.has_moved = way_m.to_bits() != self.seen_m.to_bits();
        if !self.has_moved {
            return false;
        }
        self.seen_m = way_m;
        let Some(path) = &self.path else {
            self.position = [self.stand.x_m, self.stand.y_m];
            return false;
        };
        let position = way_m / path.spacing_m();
        // As the path's own rule for an index, without dividing once more.
        let index = floor_index(position + 1e-9).min(path.last_index());
        let here = &path.poses()[index];
        let next = &path.poses()[(index + 1).min(path.last_index())];
        let ratio = (position - index as f64).clamp(0.0, 1.0);
        self.position = [
            here.x_m + ratio * (next.x_m - here.x_m),
            here.y_m + ratio * (next.y_m - here.y_m),
        ];
        let has_passed = index != self.index;
        self.index = index;
        has_passed
    }

    /// After a look: it has now stood still on its mission for [`STOP_SCANS`] scans. At its goal it has not stopped: the
    /// stepped tracker stands there until its speed is gone, and ends its mission then.
    fn has_stopped(&mut self) -> bool {
        let is_at_goal = (self.path.as_ref()).is_some_and(|path| self.index >= path.last_index());
        if self.has_moved || !self.is_driving || is_at_goal {
            self.still_count = 0;
        } else {
            self.still_count = self.still_count.saturating_add(1);
        }
        self.still_count == STOP_SCANS
    }

    /// How much longer the mission that is `done` took than a drive without a stop, seconds; less than 0 where the stepped
    /// tracker drove faster than the vehicle. `None` where no record tells when it began.
    fn mission_delay_s(&mut self, done: &Truth, vehicle: &Vehicle) -> Option<f64> {
        let begun = self
            .begun
            .take()
            .filter(|one| one.mission_id == done.mission_id)?;
        let taken_s = Instant::from_ns(done.at_ns).seconds_since(begun.at);
        Some(taken_s - vehicle.least_time_s(done.travelled_m))
    }

    /// The ground it covered at the last look.
    pub(crate) fn covered(&self, vehicle: &Vehicle) -> OrientedBox {
        let pose = match &self.path {
            Some(path) => path.pose_at(self.seen_m),
            None => self.stand,
        };
        vehicle.footprint.at(&pose)
    }

    /// The ground it would cover at the last pose passed, as the original looks at it.
    pub(crate) fn covered_at_index(&self, vehicle: &Vehicle) -> OrientedBox {
        let pose = match &self.path {
            Some(path) => path.poses()[self.index],
            None => self.stand,
        };
        vehicle.footprint.at(&pose)
    }
}

hil_core::counts! {
    /// Counts of one run, all fleets together.
    pub struct Tally {
        /// Critical sections of two missions under way at once, both still ahead.
        sections_created_count: u64;
        /// Of those, the ones a robot drove through to the end: the original's count.
        sections_passed_count: u64;
        /// Of those, the ones that ended because a robot was replaced.
        sections_dropped_count: u64;
        /// Of those, the ones both robots were in at the same time.
        encounters_count: u64;
        /// Sections with a collision by the original's checker: both robots in the section, and
        /// footprints overlapping at the last path poses passed. One count per section until they
        /// separate.
        section_collisions_count: u64;
        /// Times two robots of a fleet overlapped where they truly were, until they separated.
        overlaps_count: u64;
        /// Of those, the ones that began outside every section of the two: the section list misses
        /// them.
        outside_count: u64;
        /// Smallest distance between two robots of a fleet, metres; `None` when none came near.
        separation_min_m: Option<f64> => least;
        /// Least distance in each approach: two robots of a fleet, both under way, nearer than two pose spacings until
        /// they have separated. An approach that is not over does not count.
        clearances: Clearances;
        /// Farthest a robot went past an authority that came in time, metres.
        stop_error_max_m: f64 => f64::max;
        /// Farthest a robot went past an authority that came too late, metres.
        late_overshoot_max_m: f64 => f64::max;
        /// Way driven, metres.
        travelled_m: f64;
        /// Missions begun.
        missions_started_count: u64;
        /// Missions driven to their goal.
        missions_done_count: u64;
        /// Of those, the ones whose beginning was recorded.
        missions_timed_count: u64;
        /// How much longer these took than drives without a stop, all together, seconds.
        mission_delay_s: f64;
        /// Times a robot stood still on its mission for [`STOP_SCANS`] scans or longer; before it set out too, and not at
        /// its goal.
        stops_count: u64;
        /// Robots put at their goal to clear a stuck fleet.
        replaced_count: u64;
        /// Authorities applied in time.
        authorities_applied_count: u64;
        /// Authorities applied too late to stop at.
        authorities_late_count: u64;
        /// Authorities behind the robot, ignored.
        authorities_ignored_count: u64;
        /// Authorities refused because the robot could not stop at them.
        authorities_refused_count: u64;
        /// Older or repeated messages passed over.
        stale_count: u64;
        /// Scans made.
        scans_count: u64;
        /// Truth records that name an unknown fleet, robot, path or kind, or no finite motion.
        unsound_count: u64;
    }
}

/// The smaller of two distances that may be unknown.
fn least(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}

impl Tally {
    /// How much longer a mission took than a drive without a stop, seconds; `None` where none was timed.
    pub(crate) fn mean_mission_delay_s(&self) -> Option<f64> {
        (self.missions_timed_count > 0)
            .then(|| self.mission_delay_s / self.missions_timed_count as f64)
    }

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
#[derive(Debug, Clone, Copy, PartialEq)]
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
    /// Per robot, the fate of its last authority.
    pub causes: [Cause; 2],
}

/// What became of the authority a robot got last before an incident.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cause {
    /// A [`TruthKind`] as a number; 0 when it had none.
    pub kind: u32,
    /// `sequence` of the authority message; 0 when it had none.
    pub caused_by_sequence: u32,
    /// When, nanoseconds on the robots' clock.
    pub at_ns: i64,
}
