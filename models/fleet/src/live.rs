//! What happens to the robots while a run goes, from their records alone: collisions, fleets that stand still, and
//! commands that came too late. What the network did to the commands, only the finished run tells.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case::{FLEET_TRUTH, Fleet};
use crate::events::{Robots, collision};
use crate::messages::Truth;
use crate::referee::live::LiveReferee;
use crate::standing::Watch;
use hil_core::score::{LiveEvents, ScoreEvent, Severity};
use hil_core::time::Instant;

/// The events of the fleets of a run.
#[derive(Debug)]
pub(crate) struct FleetEvents {
    /// What was sent to them is not known here.
    robots: Robots,
    referee: LiveReferee,
    fleets: BTreeMap<u32, Standing>,
    stuck_after: Duration,
    /// A fleet without missions stands only where more are to come.
    has_more_missions: bool,
    found: Vec<ScoreEvent>,
}

#[derive(Debug)]
struct Standing {
    watch: Watch,
    /// Begin of the standstill told last.
    told: Option<Instant>,
}

impl FleetEvents {
    /// Those of the fleets of `case`.
    pub(crate) fn of(case: &Fleet) -> Self {
        let parameters = case.parameters();
        let mut referee = LiveReferee::default();
        referee.begin(case.scene(), parameters.fleets);
        Self {
            robots: Robots::default(),
            referee,
            fleets: BTreeMap::new(),
            stuck_after: parameters.coordinator.stuck_after(),
            has_more_missions: parameters.missions.never_end(),
            found: Vec::new(),
        }
    }

    fn tell_standstills(&mut self, now: Instant) {
        for (fleet_id, one) in &mut self.fleets {
            let since = one.watch.still_since(now);
            if now > since + self.stuck_after && one.watch.is_due() {
                let under_way_count = one.watch.under_way_count();
                let event = one.tell(*fleet_id, since, under_way_count);
                self.found.extend(event);
            }
        }
    }
}

impl Standing {
    /// A standstill, unless it was told already.
    fn tell(
        &mut self,
        fleet_id: u32,
        since: Instant,
        under_way_count: usize,
    ) -> Option<ScoreEvent> {
        if self.told.replace(since) == Some(since) {
            return None;
        }
        let what = format!(
            "fleet {fleet_id} stands still, {under_way_count} of its robots with a mission"
        );
        Some(ScoreEvent::new(Severity::Hazard, since, FLEET_TRUTH, what))
    }
}

impl LiveEvents for FleetEvents {
    fn channels(&self) -> &'static [&'static str] {
        &[FLEET_TRUTH]
    }

    fn hear(&mut self, _channel: &str, _at: Instant, payload: &[u8]) {
        let Ok(truth) = bytemuck::try_pod_read_unaligned::<Truth>(payload) else {
            return;
        };
        self.found.extend(self.robots.told(&truth));
        let standing = self
            .fleets
            .entry(truth.fleet_id)
            .or_insert_with(|| Standing {
                watch: Watch::from(Instant::from_ns(truth.at_ns), self.has_more_missions),
                told: None,
            });
        standing.watch.see(&truth, self.stuck_after);
        // Those that were over before they could be told: many records come at once.
        for (since, _, under_way_count) in standing.watch.take_gaps() {
            let event = standing.tell(truth.fleet_id, since, under_way_count);
            self.found.extend(event);
        }
        self.referee.on_truth(truth);
    }

    fn take(&mut self, now: Instant) -> Vec<ScoreEvent> {
        self.tell_standstills(now);
        let incidents = self.referee.look(now);
        self.found.extend(incidents.iter().map(collision));
        core::mem::take(&mut self.found)
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;
    use std::collections::BTreeMap;

    use super::*;
    use crate::FLEET_AUTHORITY;
    use crate::FleetParameters;
    use crate::messages::TruthKind;
    use hil_core::case_study::CaseStudy;
    use hil_core::score::Severity;
    use hil_core::simulation::{Carrier, Simulation};
    use hil_link::spec::{LinkPlace, LinkSpec};

    #[test]
    fn a_run_that_goes_on_tells_of_the_collisions_of_its_score() {
        let case = Fleet::new(FleetParameters::default(), 3).unwrap();
        let link = LinkSpec::fixed(Duration::from_millis(20), 0.4);
        let link = link.build(&LinkPlace::alone(3, FLEET_AUTHORITY)).unwrap();
        let link: Box<dyn Carrier> = Box::new(link);
        let carriers = BTreeMap::from([(FLEET_AUTHORITY.to_owned(), link)]);
        let simulation = Simulation::new(&case, carriers).unwrap();
        let log = simulation.run(Duration::from_mins(10)).unwrap().log;
        let mut live = case.live_events().unwrap();
        assert_eq!(live.channels(), [FLEET_TRUTH]);
        let mut found = Vec::new();
        let mut end = Instant::ZERO;
        for message in log.raw(FLEET_TRUTH) {
            end = Instant::from_ns(message.envelope.published_ns);
            live.hear(FLEET_TRUTH, end, &message.payload);
            found.extend(live.take(end));
        }
        found.extend(live.take(end + Duration::from_secs(1)));
        let collisions = |events: &[ScoreEvent]| {
            let events = events.iter();
            events
                .filter(|event| event.severity == Severity::Incident)
                .count()
        };
        let expected = collisions(&case.score(&log).events);
        assert!(expected > 0);
        assert_eq!(collisions(&found), expected);
    }

    #[test]
    fn an_authority_that_is_refused_again_is_told_once_per_mission() {
        let case = Fleet::new(FleetParameters::default(), 3).unwrap();
        let mut live = case.live_events().unwrap();
        for (at_ns, mission_id, caused_by_sequence) in
            [(1, 1, 4), (2, 1, 4), (3, 1, 3), (4, 1, 5), (5, 2, 4)]
        {
            let refused = Truth {
                at_ns,
                mission_id,
                caused_by_sequence,
                kind: TruthKind::AuthorityRefused as u32,
                ..Truth::default()
            };
            live.hear(FLEET_TRUTH, Instant::ZERO, bytemuck::bytes_of(&refused));
        }
        let found = live.take(Instant::ZERO);
        let told: Vec<_> = found.iter().map(|event| event.at.as_ns()).collect();
        assert_eq!(told, [1, 4, 5]);
    }

    #[test]
    fn a_fleet_that_stands_still_is_told_once() {
        let case = Fleet::new(FleetParameters::default(), 3).unwrap();
        let mut live = case.live_events().unwrap();
        let begun = Truth {
            at_ns: 5_000_000_000,
            mission_id: 1,
            kind: TruthKind::MissionStarted as u32,
            ..Truth::default()
        };
        live.hear(FLEET_TRUTH, Instant::ZERO, bytemuck::bytes_of(&begun));
        let mut told_at = |at_s: u64| {
            let found = live.take(Instant::ZERO + Duration::from_secs(at_s));
            let what = found.iter().map(|event| event.what.clone());
            what.collect::<Vec<_>>()
        };
        assert!(told_at(125).is_empty());
        assert_eq!(
            told_at(126),
            ["fleet 0 stands still, 1 of its robots with a mission"]
        );
        assert!(told_at(400).is_empty());
    }

    #[test]
    fn a_standstill_that_is_over_when_its_records_are_read_is_told_once_too() {
        let case = Fleet::new(FleetParameters::default(), 3).unwrap();
        let mut live = case.live_events().unwrap();
        for at_s in [5, 200, 400, 401] {
            let begun = Truth {
                at_ns: at_s * 1_000_000_000,
                mission_id: 1,
                kind: TruthKind::MissionStarted as u32,
                ..Truth::default()
            };
            live.hear(FLEET_TRUTH, Instant::ZERO, bytemuck::bytes_of(&begun));
        }
        let found = live.take(Instant::from_ns(402_000_000_000));
        let at_s = |event: &ScoreEvent| event.at.as_ns() / 1_000_000_000;
        assert_eq!(found.iter().map(at_s).collect::<Vec<_>>(), [5, 200]);
    }
}
