//! Tests of the shuttle in virtual time, and with it of the driver.

#![allow(clippy::unwrap_used, reason = "tests")]

use core::time::Duration;
use std::collections::BTreeMap;

use hil_core::link_model::PerfectLink;
use hil_core::simulation::{Carrier, Simulation, SimulationResult};
use hil_link::spec::{LinkPlace, LinkSpec};
use hil_shuttle::Shuttle;

fn run(seed: u64, loss_ratio: f64, delay_ms: u64) -> SimulationResult {
    let case = Shuttle::default();
    let link = LinkSpec::fixed(Duration::from_millis(delay_ms), loss_ratio)
        .build(&LinkPlace::alone(seed, "shuttle/command"))
        .unwrap();
    let carriers = BTreeMap::from([(
        "shuttle/command".to_owned(),
        Box::new(link) as Box<dyn Carrier>,
    )]);
    Simulation::new(&case, carriers)
        .unwrap()
        .run(Duration::from_secs(10))
        .unwrap()
}

#[test]
fn equal_seeds_give_equal_runs() {
    assert_eq!(run(7, 0.1, 10), run(7, 0.1, 10));
}

#[test]
fn unequal_seeds_give_unequal_runs() {
    assert_ne!(run(7, 0.1, 10).log, run(8, 0.1, 10).log);
}

#[test]
fn every_message_is_taken_lost_or_in_flight() {
    let clean = run(1, 0.0, 50).channels["shuttle/command"];
    assert_eq!(
        clean.published_count,
        clean.taken_count + clean.in_flight_count
    );
    assert!(clean.in_flight_count > 0);
    let lossy = run(1, 0.5, 50).channels["shuttle/command"];
    assert!(lossy.taken_count < lossy.published_count * 6 / 10);
}

#[test]
fn an_unknown_channel_is_named() {
    let case = Shuttle::default();
    let carriers = BTreeMap::from([("nope".to_owned(), Box::new(PerfectLink) as Box<dyn Carrier>)]);
    let error = Simulation::new(&case, carriers).unwrap_err();
    assert_eq!(error.to_string(), "case shuttle has no channel nope");
}
