//! Scores of runs in virtual time, clean and lossy, and of nothing.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case_study::CaseStudy;
use crate::fleet::coordinator::parameters::CoordinatorMode;
use crate::fleet::mission::MissionMode;
use crate::fleet::scenario::Scenario;
use crate::fleet::{FLEET_AUTHORITY, Fleet, FleetParameters};
use crate::link::bernoulli::BernoulliLink;
use crate::random::RandomStream;
use crate::run_log::RunLog;
use crate::score::{Score, Severity};
use crate::simulation::{Carrier, Simulation};

fn case(mode: CoordinatorMode) -> Fleet {
    let mut parameters = FleetParameters {
        fleets: 2,
        ..FleetParameters::default()
    };
    parameters.world.scenario = Scenario::ThreeCycle;
    parameters.missions.mode = MissionMode::Shuttle;
    parameters.coordinator.mode = mode;
    Fleet::new(parameters, 3).unwrap()
}

fn log_of(case: &Fleet, loss_ratio: f64) -> RunLog {
    let random = RandomStream::new(1, "loss");
    let link = BernoulliLink::new(Duration::from_millis(5), loss_ratio, random).unwrap();
    let carriers = BTreeMap::from([(
        FLEET_AUTHORITY.to_owned(),
        Box::new(link) as Box<dyn Carrier>,
    )]);
    let simulation = Simulation::new(case, carriers).unwrap();
    simulation.run(Duration::from_secs(300)).unwrap().log
}

fn figure(score: &Score, name: &str) -> f64 {
    score.get(name).unwrap().value.unwrap()
}

#[test]
fn a_clean_run_passes_sections_without_collision_or_event() {
    for mode in [CoordinatorMode::Legacy, CoordinatorMode::Safe] {
        let case = case(mode);
        let score = case.score(&log_of(&case, 0.0));
        assert!(figure(&score, "critical_sections_count") > 20.0, "{mode:?}");
        for name in [
            "section_collisions_count",
            "overlaps_count",
            "outside_count",
            "authorities_unheard_count",
            "resets_count",
        ] {
            assert!(figure(&score, name).abs() < f64::EPSILON, "{mode:?} {name}");
        }
        let ratio = score.get("collision_ratio").unwrap();
        let (low, high) = ratio.interval.unwrap();
        assert!(low.abs() < f64::EPSILON && high < 0.2, "{high}");
        assert!(ratio.method.contains("rule of three"));
        assert!(figure(&score, "state_age_ms_p50") <= 35.0);
        assert!(figure(&score, "missions_per_hour") > 60.0);
        let is_incident = |severity| severity == Severity::Incident;
        assert!(!score.events.iter().any(|event| is_incident(event.severity)));
    }
}

#[test]
fn lost_orders_are_events_that_name_their_messages() {
    for mode in [CoordinatorMode::Legacy, CoordinatorMode::Safe] {
        let case = case(mode);
        let log = log_of(&case, 0.3);
        let score = case.score(&log);
        assert!(!score.events.is_empty(), "{mode:?}");
        let sent_count = log.raw(FLEET_AUTHORITY).len() as u64;
        for event in &score.events {
            assert!(!event.messages.is_empty(), "{event:?}");
            for message in &event.messages {
                assert!(message.sequence < sent_count);
            }
        }
        let repeated = |text: &str| text.contains("sends") || text.contains("never heard");
        assert!(score.events.iter().any(|event| repeated(&event.what)));
        for two in score.events.windows(2) {
            assert!(two[0].at <= two[1].at, "in order of time");
        }
    }
}

#[test]
fn an_empty_log_gives_no_figure_but_a_reason_for_each() {
    let case = case(CoordinatorMode::Legacy);
    let score = case.score(&RunLog::default());
    for metric in &score.metrics {
        assert_eq!(metric.value, None, "{metric:?}");
        assert_eq!(metric.interval, None, "{metric:?}");
        assert!(!metric.method.is_empty(), "{metric:?}");
    }
    assert!(score.events.is_empty());
}

#[test]
fn two_clocks_withdraw_what_compares_them_but_not_the_collisions() {
    let case = case(CoordinatorMode::Safe);
    let mut log = log_of(&case, 0.3);
    log.set_clocks_differ();
    let score = case.score(&log);
    assert_eq!(score.get("state_age_ms_p50").unwrap().value, None);
    assert!(figure(&score, "critical_sections_count") > 10.0);
    assert!(
        score
            .events
            .iter()
            .all(|event| !event.what.contains(" s after"))
    );
}
