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

mod pairs;
mod sections;
mod tally;
mod track;

#[cfg(test)]
mod tests;

use core::time::Duration;
use std::sync::Arc;

pub use self::tally::{Cause, Incident, IncidentKind, Tally};

use crate::messages::{Truth, TruthKind};
use crate::path::PathId;
use crate::referee::pairs::PairFinder;
use crate::referee::sections::ActiveSections;
use crate::referee::track::Track;
use crate::robot::NO_PATH;
use crate::scenario::Scene;
use crate::world::World;
use hil_core::time::Instant;

/// From scan to scan.
pub const SCAN_PERIOD: Duration = Duration::from_millis(30);

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
    /// Robots this far apart have separated.
    separated_m: f64,
    overlapping: Vec<[u32; 2]>,
    tally: Tally,
    incidents: Vec<Incident>,
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
        // The original's checker looks where each robot was up to a pose spacing before.
        let separated_m = 2.0 * spacing_m;
        let reach_m = 2.0 * world.vehicle.footprint.radius_m() + separated_m;
        Self {
            per_fleet,
            tracks: fleet.into_iter().cycle().take(count).collect(),
            finder: PairFinder::new(reach_m, per_fleet),
            sections: ActiveSections::new(count),
            separated_m,
            overlapping: Vec::with_capacity(4 * count),
            tally: Tally::default(),
            incidents: Vec::with_capacity(INCIDENTS_MAX.min(64)),
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
            TruthKind::MissionDone => self.end_mission(robot, true),
            TruthKind::Replaced => self.end_mission(robot, false),
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
        }
        for position in 0..self.finder.find(&self.tracks) {
            let pair = self.finder.found(position);
            self.judge(now, pair);
        }
        // Robots that have moved apart beyond reach are no pair to judge any more.
        let (tracks, finder) = (&self.tracks, &self.finder);
        self.overlapping.retain(|pair| {
            let [one, other] = pair.map(|robot| &tracks[robot as usize]);
            finder.are_within_reach(one, other)
        });
    }

    /// Feeds records, sorted by time, and scans every [`SCAN_PERIOD`] from `start` to `end`: for
    /// the recorded truth of a live run.
    pub fn replay(
        &mut self,
        records: &mut dyn Iterator<Item = Truth>,
        start: Instant,
        end: Instant,
    ) {
        self.replay_seeing(records, start, end, &mut |_, _| {});
    }

    /// As [`Self::replay`]; `see` looks on after every scan.
    pub(crate) fn replay_seeing(
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

    /// What it has counted.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The first [`INCIDENTS_MAX`] incidents, in order of time.
    pub fn incidents(&self) -> &[Incident] {
        &self.incidents
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
        let kind = TruthKind::of(truth.kind)?;
        (is_finite && is_known && has_path).then_some((index, kind))
    }

    fn begin_mission(&mut self, robot: usize, truth: &Truth) {
        self.sections.end(robot, false, &mut self.tally);
        let track = &mut self.tracks[robot];
        track.is_driving = true;
        track.is_late = false;
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
        let is_separated = gap_m > self.separated_m;
        if one.is_driving && other.is_driving {
            let begun_count = self.sections.judge(pair, is_separated, || {
                let at_index = [one, other].map(|track| track.covered_at_index(vehicle));
                at_index[0].overlaps(&at_index[1])
            });
            self.tally.section_collisions_count += u64::from(begun_count);
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
            self.tally.incidents_dropped_count += 1;
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
