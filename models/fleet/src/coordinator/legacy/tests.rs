//! The legacy rules against states made by hand, on the crossing whose section is known: poses
//! 188 to 212 of paths of 400 steps of 0.1 m.

use super::*;
use crate::coordinator::Coordinator;
use crate::messages::{NO_AUTHORITY, Phase, State, TO_GOAL};
use crate::mission::{MissionMode, MissionParameters, MissionSource};
use crate::scenario::{Scenario, WorldParameters};
use hil_core::random::RandomStream;

struct Bench {
    coordinator: Coordinator,
    header_id: u32,
    now_s: i64,
}

impl Bench {
    fn new(parameters: &CoordinatorParameters) -> Self {
        let world = WorldParameters {
            scenario: Scenario::Crossing,
            path_spacing_m: 0.1,
            ..WorldParameters::default()
        };
        let scene = world.build().unwrap();
        let missions = MissionParameters {
            mode: MissionMode::Once,
            ..MissionParameters::default()
        };
        let source = MissionSource::new(&missions, &scene, RandomStream::new(1, "missions"));
        let parameters = CoordinatorParameters {
            missions_per_cycle: 2,
            ..parameters.clone()
        };
        let mut bench = Self {
            coordinator: Coordinator::new(&scene, &parameters, 0, source),
            header_id: 0,
            now_s: -1,
        };
        assert_eq!(bench.cycle(), []);
        bench
    }

    /// Both robots report pose, speed and the authority in force; then the next cycle. Gives
    /// robot and authority of each message.
    fn step(&mut self, reports: [(i32, f32, i32); 2]) -> Vec<(u32, i32)> {
        for (robot_id, (path_index, speed_mps, authority_index)) in (0..).zip(reports) {
            self.header_id += 1;
            let header = Header {
                robot_id,
                header_id: self.header_id,
                mission_id: 1,
                ..Header::default()
            };
            let state = State {
                header,
                path_index,
                travelled_m: 0.1 * f64::from(path_index),
                speed_mps,
                authority_index,
                phase: Phase::Driving as u8,
                ..State::default()
            };
            let now = Instant::from_ns(self.now_s * 1_000_000_000 + 1);
            self.coordinator.on_state(now, &state);
        }
        self.cycle()
    }

    fn cycle(&mut self) -> Vec<(u32, i32)> {
        self.now_s += 1;
        let mut sent = Vec::new();
        let now = Instant::from_ns(self.now_s * 1_000_000_000);
        self.coordinator.on_cycle(now, &mut |message| {
            if let ToRobot::Authority(authority) = message {
                sent.push((authority.header.robot_id, authority.authority_index));
            }
        });
        sent
    }
}

const START: [(i32, f32, i32); 2] = [(0, 0.0, NO_AUTHORITY); 2];

#[test]
fn the_lower_number_goes_first_from_equal_distance() {
    let mut bench = Bench::new(&CoordinatorParameters::default());
    assert_eq!(bench.step(START), [(0, TO_GOAL), (1, 185)]);
    // Nothing changed, nothing is sent.
    assert_eq!(bench.step([(3, 0.5, TO_GOAL), (3, 0.5, 185)]), []);
}

#[test]
fn the_order_is_reversed_while_both_can_stop_and_stays_when_one_cannot() {
    let mut bench = Bench::new(&CoordinatorParameters::default());
    bench.step(START);
    let sent = bench.step([(50, 2.0, TO_GOAL), (100, 2.0, 185)]);
    assert_eq!(sent, [(0, 185), (1, TO_GOAL)]);
    assert_eq!(bench.coordinator.counters().counts.order_reversals, 1);
    // From pose 160 at 2 m/s the forward model stops beyond pose 188.
    let sent = bench.step([(180, 0.0, 185), (160, 2.0, TO_GOAL)]);
    assert_eq!(sent, []);
    assert_eq!(bench.coordinator.counters().counts.order_reversals, 1);
}

#[test]
fn who_was_told_to_wait_is_believed_to_whatever_it_reports() {
    let mut bench = Bench::new(&CoordinatorParameters::default());
    bench.step(START);
    // Robot 1 never got its order and is about to enter; it is still taken as one that stops.
    let sent = bench.step([(187, 2.0, TO_GOAL), (186, 2.0, TO_GOAL)]);
    assert_eq!(sent, []);
    let sent = bench.step([(190, 2.0, TO_GOAL), (190, 2.0, TO_GOAL)]);
    assert_eq!(sent, []);
}

#[test]
fn the_section_goes_away_when_the_leader_is_past_its_end() {
    let mut bench = Bench::new(&CoordinatorParameters::default());
    bench.step(START);
    assert_eq!(bench.step([(212, 2.0, TO_GOAL), (185, 0.0, 185)]), []);
    assert_eq!(
        bench.step([(213, 2.0, TO_GOAL), (185, 0.0, 185)]),
        [(1, TO_GOAL)]
    );
    assert_eq!(bench.coordinator.counters().counts.sections_obsolete, 1);
    assert_eq!(bench.coordinator.roster.sections.iter().count(), 0);
}

#[test]
fn an_order_a_robot_does_not_show_is_sent_again_after_three_periods_and_more() {
    let mut bench = Bench::new(&CoordinatorParameters {
        replicas: 3,
        ..CoordinatorParameters::default()
    });
    assert_eq!(bench.step(START).len(), 6);
    for _ in 0..3 {
        assert_eq!(bench.step([(0, 0.0, TO_GOAL), (0, 0.0, NO_AUTHORITY)]), []);
    }
    let again = bench.step([(0, 0.0, TO_GOAL), (0, 0.0, NO_AUTHORITY)]);
    assert_eq!(again, [(1, 185); 3]);
    let counts = bench.coordinator.counters().counts;
    assert_eq!((counts.authority_changes, counts.authority_repeats), (2, 1));
    assert_eq!(counts.authority_messages, 9);
}

#[test]
fn between_two_that_cannot_stop_the_order_stays_and_a_blocked_leader_waits_too() {
    let mut bench = Bench::new(&CoordinatorParameters::default());
    let sent = bench.step([(190, 1.0, NO_AUTHORITY), (195, 1.0, NO_AUTHORITY)]);
    // Robot 0 was first when both were in their bays; robot 1 stands in its way now, so a
    // deadlock is made on purpose.
    assert_eq!(sent, [(0, 187), (1, 185)]);
    let counts = bench.coordinator.counters().counts;
    assert_eq!(
        (counts.artificial_dependencies, counts.order_reversals),
        (1, 0)
    );
}
