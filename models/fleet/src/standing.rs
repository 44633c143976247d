//! Standstills of whole fleets: when no robot of a fleet moved, took a mission or reached a goal, for how long, and
//! what the log says of the cause.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_TRUTH};
use crate::messages::{Authority, Mission, Truth, TruthKind};
use hil_core::case_study::{ScoreEvent, Severity};
use hil_core::run_log::RunLog;
use hil_core::time::Instant;

/// One standstill.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Standstill {
    fleet_id: u32,
    from: Instant,
    to: Instant,
    /// Robots with a mission that was not done.
    under_way_count: usize,
    cause: Cause,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cause {
    NothingSent,
    NothingArrived { sent_count: usize },
    Waiting,
    ClocksDiffer,
}

/// Finds the standstills of more than `after` in a run from the first of `truths`, which come in order of time, to
/// `end`. A fleet without missions stands only where `has_more_missions`.
pub(crate) fn standstills(
    log: &RunLog,
    truths: &[Truth],
    end: Instant,
    after: Duration,
    has_more_missions: bool,
) -> Vec<Standstill> {
    let Some(start) = truths.first().map(|truth| Instant::from_ns(truth.at_ns)) else {
        return Vec::new();
    };
    let mut fleets: BTreeMap<u32, Watch> = BTreeMap::new();
    for truth in truths {
        let watch = fleets
            .entry(truth.fleet_id)
            .or_insert_with(|| Watch::from(start));
        watch.see(truth, after);
    }
    let mut found = Vec::new();
    for (fleet_id, mut watch) in fleets {
        watch.close(end, after);
        for (from, to, under_way_count) in watch.gaps {
            if under_way_count > 0 || has_more_missions {
                let cause = cause(log, truths, fleet_id, [from, to]);
                found.push(Standstill {
                    fleet_id,
                    from,
                    to,
                    under_way_count,
                    cause,
                });
            }
        }
    }
    found
}

/// One fleet, record by record.
#[derive(Debug)]
pub(crate) struct Watch {
    /// Per robot its last record.
    last: BTreeMap<u32, Truth>,
    is_under_way: BTreeMap<u32, bool>,
    /// Until when something moved or began, as far as is known.
    busy_until: Instant,
    gaps: Vec<(Instant, Instant, usize)>,
}

impl Watch {
    pub(crate) fn from(start: Instant) -> Self {
        Self {
            last: BTreeMap::new(),
            is_under_way: BTreeMap::new(),
            busy_until: start,
            gaps: Vec::new(),
        }
    }

    pub(crate) fn see(&mut self, truth: &Truth, after: Duration) {
        let at = Instant::from_ns(truth.at_ns);
        self.close(at, after);
        let kind = TruthKind::from_number(truth.kind);
        let is_under_way = match kind {
            Some(TruthKind::MissionStarted) => Some(true),
            Some(TruthKind::MissionDone | TruthKind::Replaced) => Some(false),
            _ => None,
        };
        if let Some(is_under_way) = is_under_way {
            self.is_under_way.insert(truth.robot_id, is_under_way);
        }
        self.last.insert(truth.robot_id, *truth);
        if is_under_way.is_some() || truth.speed_mps > 0.0 || truth.acceleration_mps2 > 0.0 {
            self.busy_until = self.busy_until.max(at);
        }
    }

    /// Since when nothing moves or begins, as far as the records until `at` tell.
    pub(crate) fn still_since(&self, at: Instant) -> Instant {
        let moves_until = |truth: &Truth| {
            let since = Instant::from_ns(truth.at_ns);
            if truth.speed_mps <= 0.0 && truth.acceleration_mps2 <= 0.0 {
                since
            } else if truth.acceleration_mps2 < 0.0 {
                let stops_s = truth.speed_mps / -truth.acceleration_mps2;
                (since + Duration::from_secs_f64(stops_s.min(1e6))).min(at)
            } else {
                at
            }
        };
        let moved = self
            .last
            .values()
            .filter(|truth| truth.speed_mps > 0.0 || truth.acceleration_mps2 > 0.0);
        moved.map(moves_until).fold(self.busy_until, Instant::max)
    }

    /// The standstills that are over, each with its begin, its end and the robots under way in it.
    pub(crate) fn take_gaps(&mut self) -> Vec<(Instant, Instant, usize)> {
        core::mem::take(&mut self.gaps)
    }

    /// Robots with a mission that is not done.
    pub(crate) fn under_way_count(&self) -> usize {
        self.is_under_way.values().filter(|is| **is).count()
    }

    /// Nothing is known beyond the last records until `at`: a standstill may have been until then.
    fn close(&mut self, at: Instant, after: Duration) {
        let until = self.still_since(at);
        if at > until + after {
            self.gaps.push((until, at, self.under_way_count()));
            self.busy_until = at;
        } else {
            self.busy_until = until;
        }
    }
}

fn cause(log: &RunLog, truths: &[Truth], fleet_id: u32, span: [Instant; 2]) -> Cause {
    if !log.has_one_clock() {
        return Cause::ClocksDiffer;
    }
    let is_within = |at: Instant| span[0] < at && at < span[1];
    let authorities = log
        .messages::<Authority>(FLEET_AUTHORITY)
        .map(|(at, message)| (at, message.header.fleet_id));
    let missions = log
        .messages::<Mission>(FLEET_MISSION)
        .map(|(at, message)| (at, message.header.fleet_id));
    let sent_count = authorities
        .chain(missions)
        .filter(|(at, fleet)| *fleet == fleet_id && is_within(*at))
        .count();
    let has_arrived = truths.iter().any(|truth| {
        let is_caused =
            truth.caused_by_sequence != 0 || truth.kind == TruthKind::MessageStale as u32;
        truth.fleet_id == fleet_id && is_caused && is_within(Instant::from_ns(truth.at_ns))
    });
    match sent_count {
        0 => Cause::NothingSent,
        _ if has_arrived => Cause::Waiting,
        sent_count => Cause::NothingArrived { sent_count },
    }
}

impl Standstill {
    /// How long, seconds.
    pub(crate) fn duration_s(&self) -> f64 {
        self.to.seconds_since(self.from)
    }

    /// As an event of the score.
    pub(crate) fn event(&self) -> ScoreEvent {
        let cause = match self.cause {
            Cause::NothingSent => "the controller sent no command in that time".to_owned(),
            Cause::NothingArrived { sent_count } => {
                format!("none of the {sent_count} commands sent in that time reached a robot")
            }
            Cause::Waiting => {
                "commands arrived, and none gave a robot more way: they wait for one another"
                    .to_owned()
            }
            Cause::ClocksDiffer => {
                "cause unavailable, as the hosts' clocks are not aligned".to_owned()
            }
        };
        let what = format!(
            "fleet {} stood for {:.0} s, {} of its robots with a mission: {cause}",
            self.fleet_id,
            self.duration_s(),
            self.under_way_count
        );
        ScoreEvent::new(Severity::Hazard, self.from, FLEET_TRUTH, what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth(at_s: i64, robot_id: u32, kind: TruthKind, speed_mps: f64) -> Truth {
        Truth {
            at_ns: at_s * 1_000_000_000,
            robot_id,
            kind: kind as u32,
            speed_mps,
            ..Truth::default()
        }
    }

    fn found(truths: &[Truth], end_s: i64, has_more_missions: bool) -> Vec<(f64, usize)> {
        let end = Instant::from_ns(end_s * 1_000_000_000);
        let after = Duration::from_mins(2);
        let found = standstills(&RunLog::default(), truths, end, after, has_more_missions);
        found
            .iter()
            .map(|one| (one.duration_s(), one.under_way_count))
            .collect()
    }

    #[test]
    fn a_fleet_that_stands_to_the_end_of_the_run_is_told_with_those_under_way() {
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 0.0),
            truth(1, 1, TruthKind::MissionStarted, 0.0),
            truth(2, 0, TruthKind::Motion, 1.0),
            truth(60, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 3600, true), [(3540.0, 1)]);
        assert_eq!(found(&truths, 150, true), []);
    }

    #[test]
    fn a_fleet_that_has_had_all_its_missions_does_not_stand() {
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 1.0),
            truth(60, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 3600, false), []);
        assert_eq!(found(&truths, 3600, true), [(3540.0, 0)]);
    }

    #[test]
    fn a_robot_in_motion_ends_a_standstill_and_one_that_brakes_begins_it() {
        let mut braking = truth(100, 0, TruthKind::Motion, 2.0);
        braking.acceleration_mps2 = -1.0;
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 1.0),
            braking,
            truth(102, 0, TruthKind::Motion, 0.0),
            truth(400, 0, TruthKind::Motion, 1.0),
            truth(700, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 710, true), [(298.0, 1)]);
    }
}
