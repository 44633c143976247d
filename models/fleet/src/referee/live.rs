//! The referee while a run goes: the robots' records come late and in pieces.

use std::collections::VecDeque;

use super::{Incident, Referee, SCAN_PERIOD};
use crate::messages::Truth;
use crate::scenario::Scene;
use hil_core::time::Instant;

/// The referee looks at what was so long ago: by then, all that was recorded has been read.
const BEHIND_NS: i64 = 150_000_000;
/// Records kept until they are looked at.
const WAITING_MAX: usize = 200_000;

/// A referee that is fed as a run goes.
#[derive(Debug, Default)]
pub struct LiveReferee {
    referee: Option<Box<Referee>>,
    waiting: VecDeque<Truth>,
    forgotten_count: u64,
    /// Time of the next look, on the robots' clock.
    next: Option<Instant>,
    /// By the last look.
    found: Vec<Incident>,
}

impl LiveReferee {
    /// The ground of `fleet_count` fleets is known.
    pub fn begin(&mut self, scene: &Scene, fleet_count: u32) {
        self.referee = Some(Box::new(Referee::new(scene, fleet_count)));
    }

    /// Takes what a robot truly did.
    pub fn on_truth(&mut self, truth: Truth) {
        if self.waiting.len() == WAITING_MAX {
            self.waiting.pop_front();
            self.forgotten_count += 1;
        }
        self.waiting.push_back(truth);
    }

    /// Looks at all that was until shortly before `now`, on the robots' clock; the incidents since the last call.
    pub fn look(&mut self, now: Instant) -> &[Incident] {
        self.found.clear();
        let Some(referee) = &mut self.referee else {
            return &[];
        };
        let first = self.waiting.front();
        let first = first.map(|truth| Instant::from_ns(truth.at_ns));
        let Some(mut at) = self.next.or(first) else {
            return &[];
        };
        while at.as_ns() + BEHIND_NS <= now.as_ns() {
            let before = |truth: &mut Truth| truth.at_ns <= at.as_ns();
            while let Some(truth) = self.waiting.pop_front_if(before) {
                referee.on_truth(&truth);
            }
            referee.scan(at);
            // However many there are in a run, none is left out for want of room.
            self.found.append(&mut referee.incidents);
            at = at + SCAN_PERIOD;
        }
        self.next = Some(at);
        &self.found
    }

    /// Records that found no room, as before the ground was known: incidents may be missing.
    pub const fn forgotten_count(&self) -> u64 {
        self.forgotten_count
    }
}
