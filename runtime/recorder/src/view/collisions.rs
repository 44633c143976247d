//! Collisions of a fleet while it drives: by the referee that scores the run, where the robots'
//! true motion is recorded on this host; else by the states that they report, which says less.

use std::collections::{BTreeSet, VecDeque};

use hil_core::time::Instant;
use hil_fleet::geometry::{Footprint, Pose};
use hil_fleet::messages::Truth;
use hil_fleet::referee::IncidentKind;
use hil_fleet::referee::live::LiveReferee;
use serde::Serialize;

use super::ground::Ground;
use super::{rounded, seconds};

/// Collisions listed.
const LISTED_MAX: usize = 100;

/// A collision.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Collision {
    pub(crate) at_s: f64,
    pub(crate) fleet: u32,
    pub(crate) robots: [u32; 2],
    pub(crate) x_m: f64,
    pub(crate) y_m: f64,
    /// `truth` or `states`.
    pub(crate) basis: &'static str,
    pub(crate) kind: IncidentKind,
}

/// Finds collisions.
#[derive(Debug, Default)]
pub(crate) struct Collisions {
    referee: LiveReferee,
    overlapping: BTreeSet<(u32, u32, u32)>,
    /// The last of them.
    pub(crate) listed: VecDeque<Collision>,
    count: u64,
    /// Collisions are those of the robots' true motion.
    pub(crate) has_truth: bool,
}

impl Collisions {
    /// The ground is known.
    pub(crate) fn begin(&mut self, ground: &Ground) {
        self.referee.begin(&ground.scene, ground.parameters.fleets);
    }

    /// Takes what a robot truly did.
    pub(crate) fn on_truth(&mut self, truth: Truth) {
        self.has_truth = true;
        self.referee.on_truth(truth);
    }

    /// Looks at all that was until shortly before `now_ns`; `origin_ns` is the run's beginning,
    /// both on the robots' clock.
    pub(crate) fn look(&mut self, now_ns: i64, origin_ns: i64) {
        let incidents = self.referee.look(Instant::from_ns(now_ns));
        let news = incidents.iter().map(|one| Collision {
            at_s: seconds(one.at.as_ns() - origin_ns),
            fleet: one.fleet_id,
            robots: one.robots,
            x_m: rounded(one.position_m[0]),
            y_m: rounded(one.position_m[1]),
            basis: "truth",
            kind: one.kind,
        });
        let news: Vec<Collision> = news.collect();
        for one in news {
            self.list(one);
        }
    }

    /// Looks at reported poses instead: `robots` of one fleet, with the footprint of all.
    pub(crate) fn look_at_states(
        &mut self,
        fleet: u32,
        robots: &[(u32, Pose)],
        vehicle: &Footprint,
        at_s: f64,
    ) {
        if self.has_truth {
            return;
        }
        for (index, (one, pose)) in robots.iter().enumerate() {
            let covered = vehicle.at(pose);
            for (other, there) in &robots[index + 1..] {
                let key = (fleet, *one, *other);
                let is_overlap = pose.distance_m(there) < 2.0 * vehicle.radius_m()
                    && covered.overlaps(&vehicle.at(there));
                if !is_overlap {
                    self.overlapping.remove(&key);
                } else if self.overlapping.insert(key) {
                    self.list(Collision {
                        at_s,
                        fleet,
                        robots: [*one, *other],
                        x_m: rounded(0.5 * (pose.x_m + there.x_m)),
                        y_m: rounded(0.5 * (pose.y_m + there.y_m)),
                        basis: "states",
                        kind: IncidentKind::Overlap,
                    });
                }
            }
        }
    }

    fn list(&mut self, one: Collision) {
        self.count += 1;
        if self.listed.len() == LISTED_MAX {
            self.listed.pop_front();
        }
        self.listed.push_back(one);
    }

    /// How many there were; a count that lacks something is not known.
    pub(crate) fn count(&self) -> Option<u64> {
        (self.referee.forgotten_count() == 0).then_some(self.count)
    }
}
