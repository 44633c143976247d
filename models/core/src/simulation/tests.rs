//! Tests of the virtual-time driver.

use super::*;
use crate::component::{Component, Output, Ports, into_role};
use crate::time::Tick;

crate::message! {
    struct Status = "test.Status.v1" { position_m: f64 }
}

/// Tells the record where it is, and nobody listens.
#[derive(Debug, Default)]
struct Diarist {
    diary: Output<Status>,
}

impl Component for Diarist {
    fn ports(&self, ports: &mut Ports<Self>) {
        ports.input("a/heard", |_, _, _: &Status| {});
        ports.output("a/diary", |own| &mut own.diary);
        ports.every(Duration::from_millis(100), Self::on_tick);
    }
}

impl Diarist {
    fn on_tick(&mut self, _now: Instant, _tick: Tick) {
        self.diary.send(Status { position_m: 1.0 });
    }
}

const DIARY: &[ChannelSpec] = &[
    ChannelSpec::of::<Status>("a/heard", "other", "diarist"),
    ChannelSpec::recorded::<Status>("a/diary", "diarist"),
];

fn diary(carriers: BTreeMap<String, Box<dyn Carrier>>) -> Result<Simulation, SimulationError> {
    let roles = vec![("diarist", into_role(Diarist::default()))];
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

#[test]
fn a_role_that_does_not_fit_its_case_does_not_start() {
    const MISSPELT: &[ChannelSpec] = &[
        ChannelSpec::of::<Status>("a/herd", "other", "diarist"),
        ChannelSpec::recorded::<Status>("a/diary", "diarist"),
    ];
    let roles = vec![("diarist", into_role(Diarist::default()))];
    let error = Simulation::of_roles("diary", MISSPELT, roles, BTreeMap::new()).unwrap_err();
    let expected = "input port a/heard of role diarist takes test.Status.v1 (8 bytes aligned to 8), \
                    but case diary states no such channel";
    assert_eq!(error.to_string(), expected);
}
