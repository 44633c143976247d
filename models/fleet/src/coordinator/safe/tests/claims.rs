//! The claims themselves: no overlap, every mission ends, equal seeds give equal runs.

use super::rig::{CONDITIONS, Chaos, Rig, RigSetup, coordinator, safe_parameters};
use super::world::random_scene;
use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::policy::PolicyName;
use crate::coordinator::safe::SafeParameters;
use crate::messages::{Authority, ToRobot};
use crate::mission::{MissionMode, MissionParameters};
use crate::robot::authority::is_newer;
use crate::robot::{RobotParameters, TrackerKind};
use crate::scenario::{Scenario, Scene, WorldParameters};
use core::time::Duration;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

fn seconds(count: i64) -> Instant {
    Instant::from_ns(count * 1_000_000_000)
}

fn setup(chaos: Chaos) -> RigSetup {
    RigSetup {
        coordinator: safe_parameters(),
        robot: RobotParameters::default(),
        missions_per_robot: 0,
        mode: MissionMode::Random,
        chaos,
        restart_every: None,
        robot_restart_at: None,
    }
}

/// Runs until all missions are done.
fn check_run(name: &str, scene: &Scene, setup: &RigSetup, seed: u64) {
    let mut rig = Rig::new(scene, setup, seed);
    let wanted = u64::from(setup.missions_per_robot) * scene.starts.len() as u64;
    rig.run(seconds(20_000), |rig| {
        rig.coordinator.counters().counts.missions_done == wanted
    });
    let counters = rig.coordinator.counters();
    let tally = rig.referee.tally();
    let (counts, safe) = (&counters.counts, &counters.safe);
    let context = format!("{name}, seed {seed}: {counts:?} {safe:?} {tally:?}");
    assert_eq!(tally.section_collisions_count, 0, "{context}");
    assert_eq!(tally.overlaps_count, 0, "{context}");
    assert_eq!(tally.outside_count, 0, "{context}");
    assert!(
        tally.stop_error_max_m <= setup.coordinator.safe.stop_error_m + 1e-6,
        "{context}"
    );
    assert_eq!(counters.safe.margins_exceeded, 0, "{context}");
    assert_eq!(counters.safe.authorities_exceeded, 0, "{context}");
    assert_eq!(counters.safe.states_impossible, 0, "{context}");
    assert_eq!(counters.safe.admissions_deferred, 0, "{context}");
    assert_eq!(counters.counts.missions_done, wanted, "{context}");
    assert_eq!(counters.safe.stuck + counters.counts.resets, 0, "{context}");
}

#[test]
fn every_mission_ends_without_overlap_in_random_worlds_over_any_channel() {
    for (name, chaos) in CONDITIONS {
        for seed in 0..12_u64 {
            let mut random = RandomStream::new(seed, "world");
            let count = 2 + usize::try_from(seed % 5).unwrap();
            let scene = random_scene(count, &mut random);
            let setup = RigSetup {
                missions_per_robot: 4,
                ..setup(chaos)
            };
            check_run(name, &scene, &setup, seed);
        }
    }
}

#[test]
fn small_scenarios_end_without_overlap_over_any_channel() {
    for scenario in [
        Scenario::Crossing,
        Scenario::HeadOn,
        Scenario::Following,
        Scenario::ThreeCycle,
    ] {
        let world = WorldParameters {
            scenario,
            ..WorldParameters::default()
        };
        let scene = world.build().unwrap();
        for (name, chaos) in CONDITIONS {
            let setup = RigSetup {
                missions_per_robot: 1,
                mode: MissionMode::Once,
                ..setup(chaos)
            };
            check_run(name, &scene, &setup, 1);
        }
    }
}

#[test]
fn a_coarse_tracker_keeps_within_the_margin_of_its_stop_error() {
    let robot = RobotParameters {
        tracker: TrackerKind::LegacyRk4,
        step_inflation: true,
        inflation_delay_ms: 100.0,
        ..RobotParameters::default()
    };
    let stop_error_m = robot.stop_error_bound_m(&super::world::CART);
    for (name, chaos) in CONDITIONS {
        for seed in 0..3_u64 {
            let scene = random_scene(5, &mut RandomStream::new(seed, "world"));
            let setup = RigSetup {
                coordinator: CoordinatorParameters {
                    safe: SafeParameters {
                        stop_error_m,
                        ..SafeParameters::default()
                    },
                    ..safe_parameters()
                },
                robot: robot.clone(),
                missions_per_robot: 3,
                ..setup(chaos)
            };
            check_run(name, &scene, &setup, seed);
        }
    }
}

#[test]
fn a_coordinator_that_restarts_again_and_again_keeps_every_robot_safe_and_the_fleet_going() {
    for (name, chaos) in CONDITIONS {
        for seed in 0..4_u64 {
            let scene = random_scene(5, &mut RandomStream::new(seed, "world"));
            let setup = RigSetup {
                restart_every: Some(Duration::from_secs(47)),
                ..setup(chaos)
            };
            let mut rig = Rig::new(&scene, &setup, seed);
            rig.run(seconds(1_500), |_| false);
            let tally = rig.referee.tally();
            let context = format!("{name}, seed {seed}: {tally:?}");
            assert!(rig.restart_count > 25, "{context}");
            assert_eq!(tally.section_collisions_count, 0, "{context}");
            assert_eq!(tally.overlaps_count + tally.outside_count, 0, "{context}");
            assert!(tally.missions_done_count > 50, "{context}");
            assert!(tally.sections_passed_count > 20, "{context}");
        }
    }
}

#[test]
fn a_robot_that_restarts_on_its_way_holds_up_a_coordinator_that_restarts() {
    for (name, chaos) in CONDITIONS {
        for seed in 0..4_u64 {
            let scene = random_scene(5, &mut RandomStream::new(seed, "world"));
            let setup = RigSetup {
                restart_every: Some(Duration::from_secs(150)),
                robot_restart_at: Some(Duration::from_secs(50)),
                ..setup(chaos)
            };
            let mut rig = Rig::new(&scene, &setup, seed);
            rig.run(seconds(300), |_| false);
            let tally = rig.referee.tally();
            let counters = rig.coordinator.counters();
            let context = format!("{name}, seed {seed}: {counters:?} {tally:?}");
            assert_eq!(rig.restart_count, 1, "{context}");
            assert!(counters.safe.answers_unplaced > 0, "{context}");
            assert_eq!(tally.section_collisions_count, 0, "{context}");
            assert_eq!(tally.overlaps_count + tally.outside_count, 0, "{context}");
            let mut sent = Vec::new();
            rig.coordinator
                .on_cycle(seconds(300), &mut |message| sent.push(message));
            let is_question = |message: &ToRobot| {
                matches!(message, ToRobot::Authority(authority)
                    if authority.flags & Authority::QUESTION != 0)
            };
            assert!(
                !sent.is_empty() && sent.iter().all(is_question),
                "{context}"
            );
        }
    }
}

#[test]
fn a_coordinator_that_starts_later_asks_a_newer_question() {
    let scene = random_scene(2, &mut RandomStream::new(1, "world"));
    let questions = |start: Instant| {
        let mut coordinator =
            coordinator(&scene, &safe_parameters(), &MissionParameters::default(), 1);
        let mut questions = Vec::new();
        coordinator.on_cycle(start, &mut |message| {
            if let ToRobot::Authority(authority) = message {
                assert_ne!(authority.flags & Authority::QUESTION, 0);
                questions.push(authority.sequence);
            }
        });
        questions
    };
    // Milliseconds; the last two are before and after the question's range is through.
    let starts_ms = [0, 2, 1000, i64::from(u32::MAX), i64::from(u32::MAX) + 3];
    let asked = starts_ms.map(|ms| questions(Instant::from_ns(ms * 1_000_000)));
    for (start_ms, asked) in starts_ms.iter().zip(&asked) {
        assert_eq!(asked.len(), 2, "{start_ms} ms");
        assert_eq!(asked[0], asked[1], "{start_ms} ms");
    }
    for (earlier, later) in [(0, 1), (1, 2), (3, 4)] {
        let (earlier, later) = (asked[earlier][0], asked[later][0]);
        assert!(is_newer(later, earlier), "{earlier} {later}");
    }
}

#[test]
fn equal_seeds_give_equal_runs() {
    let run = || {
        let scene = random_scene(5, &mut RandomStream::new(3, "world"));
        let (_, chaos) = CONDITIONS[5];
        let mut rig = Rig::new(&scene, &setup(chaos), 3);
        rig.run(seconds(600), |_| false);
        let counters = rig.coordinator.counters();
        (
            counters.counts,
            counters.safe,
            rig.referee.tally().travelled_m.to_bits(),
        )
    };
    assert_eq!(run(), run());
}

#[test]
fn three_that_would_block_each_other_are_kept_from_it() {
    let world = WorldParameters {
        scenario: Scenario::ThreeCycle,
        ..WorldParameters::default()
    };
    let scene = world.build().unwrap();
    let setup = RigSetup {
        coordinator: CoordinatorParameters {
            missions_per_cycle: 3,
            ..safe_parameters()
        },
        missions_per_robot: 1,
        mode: MissionMode::Once,
        ..setup(Chaos::default())
    };
    let mut rig = Rig::new(&scene, &setup, 1);
    rig.run(seconds(300), |rig| {
        rig.coordinator.counters().counts.missions_done == 3
    });
    let counters = rig.coordinator.counters();
    assert_eq!(counters.counts.missions_done, 3);
    assert!(counters.safe.grants_withheld > 0, "{:?}", counters.safe);
    assert_eq!(rig.referee.tally().overlaps_count, 0);
}

#[test]
fn every_policy_lets_every_mission_end() {
    for policy in [
        PolicyName::ClosestFirst,
        PolicyName::FirstCome,
        PolicyName::LongestQueue,
        PolicyName::QuickestThrough,
    ] {
        let scene = random_scene(8, &mut RandomStream::new(2, "world"));
        let setup = RigSetup {
            coordinator: CoordinatorParameters {
                policy,
                ..safe_parameters()
            },
            missions_per_robot: 4,
            ..setup(CONDITIONS[5].1)
        };
        check_run(&format!("{policy:?}"), &scene, &setup, 7);
    }
}
