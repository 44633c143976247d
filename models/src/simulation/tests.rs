//! Tests of the virtual-time driver.

use super::*;
use crate::component::{Component, Outbox, into_role};
use crate::link::bernoulli::BernoulliLink;
use crate::random::RandomStream;
use crate::shuttle::{Shuttle, ShuttleParameters, ShuttleStatus};
use crate::time::PeriodicTimer;

fn run(seed: u64, loss_ratio: f64, delay_ms: u64) -> SimulationResult {
    let case = Shuttle::new(ShuttleParameters::default(), seed).unwrap();
    let stream = RandomStream::new(seed, "shuttle/command");
    let link = BernoulliLink::new(Duration::from_millis(delay_ms), loss_ratio, stream).unwrap();
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
    let case = Shuttle::new(ShuttleParameters::default(), 0).unwrap();
    let carriers = BTreeMap::from([("nope".to_owned(), Box::new(PerfectLink) as Box<dyn Carrier>)]);
    let error = Simulation::new(&case, carriers).unwrap_err();
    assert_eq!(error.to_string(), "case shuttle has no channel nope");
}

/// Tells the record where it is, and nobody listens.
#[derive(Debug)]
struct Diarist(PeriodicTimer);

impl Component for Diarist {
    type Input = ShuttleStatus;
    type Output = ShuttleStatus;

    fn on_start(&mut self, now: Instant) {
        self.0.start(now);
    }

    fn on_message(&mut self, _: Instant, _: &ShuttleStatus, _: &mut Outbox<ShuttleStatus>) {}

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<ShuttleStatus>) {
        if self.0.poll(now).is_some() {
            out.send(ShuttleStatus { position_m: 1.0 });
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        self.0.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.0.skipped_total()
    }
}

const DIARY: &[ChannelSpec] = &[
    ChannelSpec::of::<ShuttleStatus>("a/heard", "other", "diarist"),
    ChannelSpec::recorded::<ShuttleStatus>("a/diary", "diarist"),
];

fn diary(carriers: BTreeMap<String, Box<dyn Carrier>>) -> Result<Simulation, SimulationError> {
    let diarist = Diarist(PeriodicTimer::new(Duration::from_millis(100)));
    let roles = vec![("diarist", into_role(diarist))];
    Simulation::of_roles("diary", DIARY, roles, carriers)
}

#[test]
fn a_recorded_channel_is_logged_and_counted_and_has_no_fate() {
    let result = diary(BTreeMap::new()).unwrap();
    let result = result.run(Duration::from_secs(1)).unwrap();
    let count = result.recorded_counts["a/diary"];
    let logged = result.log.raw("a/diary");
    assert!(count >= 10);
    assert_eq!(logged.len() as u64, count);
    let sequences: Vec<u64> = logged.iter().map(|one| one.envelope.sequence).collect();
    assert_eq!(sequences, (0..count).collect::<Vec<_>>());
    assert!(!result.channels.contains_key("a/diary"));
}

#[test]
fn a_carrier_for_a_recorded_channel_is_refused() {
    let carrier = Box::new(PerfectLink) as Box<dyn Carrier>;
    let error = diary(BTreeMap::from([("a/diary".to_owned(), carrier)])).unwrap_err();
    assert_eq!(
        error.to_string(),
        "channel a/diary of case diary is only recorded; nothing carries it"
    );
}
