use super::rig::{CONDITIONS, Chaos, Rig, RigSetup, safe_parameters};
use super::world::random_scene;
use crate::fleet::mission::MissionMode;
use crate::fleet::robot::RobotParameters;
use crate::fleet::scenario::{Scenario, WorldParameters};
use crate::random::RandomStream;
use crate::time::Instant;

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
    }
}

/// Runs until all missions are done; gives the time it took and the sections passed.
fn check_run(scene: &crate::fleet::scenario::Scene, setup: &RigSetup, seed: u64) -> (f64, u64) {
    let mut rig = Rig::new(scene, setup, seed);
    let wanted = u64::from(setup.missions_per_robot) * scene.starts.len() as u64;
    let end = rig.run(seconds(20_000), |rig| {
        rig.coordinator.counters().counts.missions_done == wanted
    });
    let counters = rig.coordinator.counters();
    let tally = rig.referee.tally();
    let (counts, safe) = (&counters.counts, &counters.safe);
    let context = format!("seed {seed}: {counts:?} {safe:?} {tally:?}");
    assert_eq!(tally.section_collisions_count, 0, "{context}");
    assert_eq!(tally.overlaps_count, 0, "{context}");
    assert_eq!(tally.outside_count, 0, "{context}");
    assert_eq!(counters.safe.margins_exceeded, 0, "{context}");
    assert_eq!(counters.safe.authorities_exceeded, 0, "{context}");
    assert_eq!(counters.safe.states_impossible, 0, "{context}");
    assert_eq!(counters.safe.admissions_deferred, 0, "{context}");
    assert_eq!(counters.counts.missions_done, wanted, "{context}");
    assert_eq!(counters.safe.stuck + counters.counts.resets, 0, "{context}");
    (end.as_ns() as f64 * 1e-9, tally.sections_passed_count)
}

#[test]
fn every_mission_ends_without_overlap_in_random_worlds_over_any_channel() {
    for (name, chaos) in CONDITIONS {
        let (mut time_s, mut sections) = (0.0, 0);
        for seed in 0..6_u64 {
            let mut random = RandomStream::new(seed, "world");
            let count = 2 + usize::try_from(seed % 5).unwrap();
            let scene = random_scene(count, &mut random);
            let setup = RigSetup {
                missions_per_robot: 4,
                ..setup(chaos)
            };
            let (run_s, run_sections) = check_run(&scene, &setup, seed);
            time_s += run_s;
            sections += run_sections;
        }
        println!("{name}: {time_s:.0} s, {sections} sections");
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
            let (time_s, _) = check_run(&scene, &setup, 1);
            println!("{scenario:?} {name}: {time_s:.0} s");
        }
    }
}
