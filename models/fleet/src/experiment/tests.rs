//! The fast driver against the generic one, and what links do to it.

use core::time::Duration;
use std::collections::BTreeMap;

use super::*;
use crate::messages::Truth;
use crate::mission::{MissionMode, MissionParameters};
use crate::path::PathId;
use crate::robot::{RobotParameters, TrackerKind};
use crate::scenario::{Scenario, Scene, WorldParameters};
use crate::section::Side;
use crate::{FLEET_TRUTH, Fleet, FleetParameters};
use hil_core::case_study::CaseStudy;
use hil_core::simulation::{Carrier, Observe, Simulation};
use hil_core::study::Study;
use hil_core::time::Instant;

fn parameters(scenario: Scenario, tracker: TrackerKind) -> FleetParameters {
    FleetParameters {
        world: WorldParameters {
            scenario,
            ..WorldParameters::default()
        },
        robot: RobotParameters {
            tracker,
            ..RobotParameters::default()
        },
        missions: MissionParameters {
            mode: MissionMode::Shuttle,
            ..MissionParameters::default()
        },
        ..FleetParameters::default()
    }
}

fn setup_of(parameters: &FleetParameters, links: &Links) -> Setup {
    Setup {
        robot: parameters.robot.clone(),
        coordinator: parameters.coordinator.clone(),
        missions: parameters.missions,
        links: *links,
        overrun_max_s: 0.0,
    }
}

fn scene_of(parameters: &FleetParameters) -> Scene {
    parameters.world.build().unwrap()
}

/// Truth of the fast driver.
fn fast(
    parameters: &FleetParameters,
    links: &Links,
    seed: u64,
    run_s: i64,
) -> (Vec<Truth>, FleetTally) {
    let setup = setup_of(parameters, links);
    let mut experiment = Experiment::new(&scene_of(parameters), &setup, seed).unwrap();
    let mut truths = Truths::default();
    let end = Instant::from_ns(run_s * 1_000_000_000);
    experiment.run_until(end, &mut truths);
    (truths.0, experiment.tally())
}

/// Keeps all records.
#[derive(Default)]
struct Truths(Vec<Truth>);

impl Observe<FleetModel> for Truths {
    fn recorded(&mut self, _now: Instant, truth: &Truth) {
        self.0.push(*truth);
    }
}

/// Truth of the same components joined by the generic driver, by robot.
fn generic(parameters: &FleetParameters, seed: u64, run_s: u64) -> Vec<Truth> {
    let case = Fleet::new(parameters.clone(), seed).unwrap();
    let carriers: BTreeMap<String, Box<dyn Carrier>> = BTreeMap::new();
    let simulation = Simulation::new(&case, carriers).unwrap();
    let log = simulation.run(Duration::from_secs(run_s)).unwrap().log;
    log.messages::<Truth>(FLEET_TRUTH)
        .map(|(_, truth)| truth)
        .collect()
}

/// Robot by robot: between robots, the order at one instant is the driver's own business.
fn by_robot(mut truth: Vec<Truth>) -> Vec<Truth> {
    truth.sort_by_key(|record| record.robot_id);
    truth
}

#[test]
fn on_a_perfect_link_both_drivers_move_the_robots_alike_to_the_bit() {
    for scenario in [
        Scenario::Crossing,
        Scenario::Following,
        Scenario::ThreeCycle,
    ] {
        for tracker in [TrackerKind::Exact, TrackerKind::LegacyRk4] {
            let parameters = parameters(scenario, tracker);
            for seed in [1, 2] {
                let (truth, tally) = fast(&parameters, &Links::default(), seed, 600);
                let mut expected = generic(&parameters, seed, 600);
                expected.retain(|record| record.at_ns < 600_000_000_000);
                assert!(tally.referee.missions_done_count > 10, "{scenario:?}");
                let (truth, expected) = (by_robot(truth), by_robot(expected));
                let differ = truth
                    .iter()
                    .zip(&expected)
                    .position(|(one, other)| one != other);
                assert_eq!(differ, None, "{scenario:?} {tracker:?} seed {seed}");
                assert_eq!(truth.len(), expected.len());
            }
        }
    }
}

#[test]
fn equal_seeds_give_equal_runs_and_unequal_ones_do_not() {
    let parameters = parameters(Scenario::ThreeCycle, TrackerKind::Exact);
    let mut links = Links::default();
    links.commands.loss_ratio = 0.2;
    links.status.loss_ratio = 0.2;
    let run = |seed| fast(&parameters, &links, seed, 300);
    assert_eq!(run(4), run(4));
    assert_ne!(run(4).0, run(5).0);
}

#[test]
fn links_lose_delay_and_repeat_what_they_are_told_to() {
    let parameters = parameters(Scenario::Crossing, TrackerKind::Exact);
    let mut links = Links::default();
    links.status.loss_ratio = 0.5;
    links.status.duplicate_ratio = 0.1;
    links.status.duplicate_lag_ms = 100.0;
    links.commands.delay_ms = 40.0;
    let (_, tally) = fast(&parameters, &links, 1, 300);
    let lost = tally.status.lost_count as f64 / tally.status.offered_count as f64;
    assert!((lost - 0.5).abs() < 0.05, "{lost}");
    assert!(tally.status.duplicated_count > 0);
    assert_eq!(tally.commands.lost_count, 0);
    assert!(tally.coordinator.states_duplicate + tally.coordinator.states_reordered > 0);
}

#[test]
fn states_that_keep_order_are_deleted_by_newer_ones() {
    let parameters = parameters(Scenario::Crossing, TrackerKind::Exact);
    let mut links = Links::default();
    links.status.hold_ratio = 0.2;
    links.status.hold_ms = 200.0;
    let (_, free) = fast(&parameters, &links, 1, 300);
    assert!(free.coordinator.states_reordered > 0);
    assert_eq!(free.superseded_count, 0);
    links.status_keeps_order = true;
    let (_, kept) = fast(&parameters, &links, 1, 300);
    assert_eq!(kept.coordinator.states_reordered, 0);
    assert!(kept.superseded_count > 0);
}

#[test]
fn a_bypassed_status_path_sends_no_state() {
    let parameters = parameters(Scenario::Crossing, TrackerKind::LegacyRk4);
    let links = Links {
        status_path: StatusPath::Bypass,
        ..Links::default()
    };
    let (_, tally) = fast(&parameters, &links, 1, 600);
    assert_eq!(tally.status.offered_count, 0);
    assert!(tally.referee.missions_done_count > 10);
    assert!(tally.section_count() > 5);
}

/// Robot 1 gives way at the crossing: where it stops, from when to when it waits and when it
/// enters the section follow from the vehicle, the section and the control period alone.
#[test]
fn the_robot_that_yields_stops_waits_and_enters_when_the_closed_form_says() {
    let mut parameters = parameters(Scenario::Crossing, TrackerKind::Exact);
    parameters.missions.mode = MissionMode::Once;
    let links = Links {
        status_path: StatusPath::Bypass,
        ..Links::default()
    };
    let (truth, tally) = fast(&parameters, &links, 1, 60);
    let scene = scene_of(&parameters);
    let (speed, acceleration) = (2.0, 1.0);
    let of = |robot| {
        let records = truth.iter().filter(|record| record.mission_id > 0);
        records.filter(move |record| record.robot_id == robot)
    };
    let seconds = |record: &Truth| record.at_ns as f64 * 1e-9;
    let departs = |robot| {
        seconds(
            of(robot)
                .find(|record| record.acceleration_mps2 > 0.0)
                .unwrap(),
        )
    };
    let paths = [0, 1]
        .map(|robot| of(robot).next_back().unwrap().path_id)
        .map(PathId);
    let section = &scene.world.sections.between(paths[0], paths[1])[0];
    let way = |robot: usize, index| scene.world.path(paths[robot]).way_to_m(index);

    // From rest to rest over s: s / v + v / a. From rest to s at full speed: s / v + v / 2a.
    let stop_m = way(1, section.start(Side::Second) - 3);
    let arrives_s = departs(1) + stop_m / speed + speed / acceleration;
    let cleared_m = way(0, section.end(Side::First) + 1);
    let cleared_s = departs(0) + cleared_m / speed + 0.5 * speed / acceleration;
    let stands = |record: &&Truth| record.travelled_m > 1.0 && record.speed_mps.abs() < 1e-9;
    let stop = of(1).find(stands).unwrap();
    assert!((stop.travelled_m - stop_m).abs() < 1e-6, "{stop:?}");
    assert!(
        (seconds(stop) - arrives_s).abs() < 1e-6,
        "{stop:?} {arrives_s}"
    );

    // The next control cycle after the other has cleared the section lets it go.
    let goes = of(1).find(|record| seconds(record) > arrives_s && record.acceleration_mps2 > 0.0);
    let (goes_s, waited_s) = (seconds(goes.unwrap()), cleared_s.ceil() - arrives_s);
    assert!(waited_s > 0.0);
    assert!(
        (goes_s - arrives_s - waited_s).abs() < 1e-6,
        "{goes_s} {cleared_s}"
    );
    assert_eq!(tally.referee.sections_passed_count, 1);
    assert_eq!(tally.any_collision_count(), 0);
}

/// Figures of one run of a cell, to the bit.
#[derive(Debug, PartialEq, Eq)]
struct Pinned {
    cell: &'static str,
    sections: u64,
    collisions: u64,
    missions: u64,
    applied: u64,
    commands: [u64; 2],
    states: [u64; 2],
    superseded: u64,
    travelled_m_bits: u64,
    stop_error_m_bits: u64,
}

/// Recorded before the drivers of fleet, teleoperation and the generic one became one.
const PINNED: [Pinned; 7] = [
    Pinned {
        cell: "harbor, loss 0.1, 100 ms, 3 copies",
        sections: 105,
        collisions: 0,
        missions: 21,
        applied: 286,
        commands: [288, 1],
        states: [0, 0],
        superseded: 0,
        travelled_m_bits: 4_667_313_523_248_899_002,
        stop_error_m_bits: 4_605_202_897_834_773_312,
    },
    Pinned {
        cell: "harbor, 100 ms, nominal steps, delayed status, delay unknown",
        sections: 102,
        collisions: 0,
        missions: 28,
        applied: 342,
        commands: [377, 0],
        states: [80_243, 0],
        superseded: 0,
        travelled_m_bits: 4_668_440_237_050_994_231,
        stop_error_m_bits: 4_597_563_206_887_644_416,
    },
    Pinned {
        cell: "harbor, long-range Wi-Fi 6",
        sections: 100,
        collisions: 0,
        missions: 28,
        applied: 336,
        commands: [377, 6],
        states: [80_166, 2668],
        superseded: 0,
        travelled_m_bits: 4_668_429_853_508_544_314,
        stop_error_m_bits: 4_597_294_244_010_337_280,
    },
    Pinned {
        cell: "harbor, 10 % repeated to 3 s late, safe",
        sections: 111,
        collisions: 0,
        missions: 22,
        applied: 1859,
        commands: [1895, 0],
        states: [66_758, 0],
        superseded: 0,
        travelled_m_bits: 4_667_243_224_617_635_689,
        stop_error_m_bits: 0,
    },
    Pinned {
        cell: "warehouse, stalls, mean 3 s in 30 s, legacy",
        sections: 115,
        collisions: 0,
        missions: 28,
        applied: 178,
        commands: [250, 0],
        states: [50_948, 0],
        superseded: 0,
        travelled_m_bits: 4_657_688_720_174_610_774,
        stop_error_m_bits: 0,
    },
    Pinned {
        cell: "warehouse, overrun to 4 s, legacy",
        sections: 120,
        collisions: 0,
        missions: 36,
        applied: 173,
        commands: [215, 0],
        states: [63_036, 0],
        superseded: 0,
        travelled_m_bits: 4_659_107_493_767_640_605,
        stop_error_m_bits: 0,
    },
    Pinned {
        cell: "warehouse, loss 30 %, both, safe",
        sections: 117,
        collisions: 0,
        missions: 43,
        applied: 1442,
        commands: [2145, 638],
        states: [77_524, 23_215],
        superseded: 0,
        travelled_m_bits: 4_661_060_836_983_615_404,
        stop_error_m_bits: 0,
    },
];

#[test]
fn cells_of_the_tables_keep_their_figures_to_the_bit() {
    for expected in &PINNED {
        let mut parameters = FleetParameters::default();
        parameters.tables.sections = 100;
        parameters.tables.sections_per_task = 100;
        parameters.tables.cells = vec![expected.cell.to_owned()];
        let study = FleetStudy::new(&parameters, 7, Vec::new()).unwrap();
        assert_eq!(study.task_count(), 1, "{}", expected.cell);
        let tally = study.run(0, &mut |_| true).unwrap();
        let link =
            |counts: &hil_link::impaired::LinkCounts| [counts.offered_count, counts.lost_count];
        let found = Pinned {
            cell: expected.cell,
            sections: tally.section_count(),
            collisions: tally.any_collision_count(),
            missions: tally.referee.missions_done_count,
            applied: tally.referee.authorities_applied_count,
            commands: link(&tally.commands),
            states: link(&tally.status),
            superseded: tally.superseded_count,
            travelled_m_bits: tally.referee.travelled_m.to_bits(),
            stop_error_m_bits: tally.referee.stop_error_max_m.to_bits(),
        };
        assert_eq!(&found, expected);
    }
}
