//! Tests of the virtual-time driver.

use super::*;
use bytemuck::{Pod, Zeroable};

use crate::component::{Component, Outbox, into_role};
use crate::message::Message;
use crate::time::PeriodicTimer;

#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Status {
    position_m: f64,
}

impl Message for Status {
    const NAME: &'static str = "test.Status.v1";
}

/// Tells the record where it is, and nobody listens.
#[derive(Debug)]
struct Diarist(PeriodicTimer);

impl Component for Diarist {
    type Input = Status;
    type Output = Status;

    fn on_start(&mut self, now: Instant) {
        self.0.start(now);
    }

    fn on_message(&mut self, _: Instant, _: &Status, _: &mut Outbox<Status>) {}

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<Status>) {
        if self.0.poll(now).is_some() {
            out.send(Status { position_m: 1.0 });
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
    ChannelSpec::of::<Status>("a/heard", "other", "diarist"),
    ChannelSpec::recorded::<Status>("a/diary", "diarist"),
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
