//! The referee against planted collisions, touching robots and a pair-by-pair search.

use super::*;
use crate::geometry::Pose;
use crate::messages::TO_GOAL;
use crate::robot::tests::{authority, mission, robot, run, scene};
use crate::robot::{Robot, RobotParameters};
use crate::scenario::Scenario;
use hil_core::random::RandomStream;

fn at(seconds: f64) -> Instant {
    Instant::ZERO + Duration::from_secs_f64(seconds)
}

/// A robot standing at `travelled_m` of a path.
fn standing(robot_id: u32, path_id: u32, travelled_m: f64, kind: TruthKind) -> Truth {
    Truth {
        robot_id,
        mission_id: u32::from(kind != TruthKind::Motion),
        path_id,
        travelled_m,
        authority_index: TO_GOAL,
        kind: kind as u32,
        ..Truth::default()
    }
}

#[test]
fn touching_is_no_overlap_and_cutting_is_counted_once_until_separated() {
    // Robot 0 starts 6 m ahead of robot 1 on the same line; both are 2 m long.
    let scene = scene(Scenario::Following);
    let mut referee = Referee::new(&scene, 1);
    let mut place = |travelled_m, step: i32| {
        referee.on_truth(&standing(0, 0, 0.0, TruthKind::Motion));
        referee.on_truth(&standing(1, 2, travelled_m, TruthKind::Motion));
        referee.scan(at(0.03 * f64::from(step)));
        let tally = referee.tally();
        (tally.overlaps_count, tally.separation_min_m)
    };
    assert_eq!(place(0.0, 0), (0, None));
    let near = place(3.5, 1);
    assert_eq!(near.0, 0);
    assert!((near.1.unwrap() - 0.5).abs() < 1e-9);
    assert_eq!(place(4.0, 2).0, 0);
    assert_eq!(place(4.001, 3).0, 1);
    assert_eq!(place(4.5, 4).0, 1);
    assert_eq!(place(5.0, 5), (1, Some(0.0)));
    // Robots do not go back; a new mission may begin further back.
    assert_eq!(place(1.0, 6).0, 1);
    assert_eq!(place(4.2, 7).0, 2);
    // None of them was on a mission, so no section could cover it.
    assert_eq!(referee.tally().outside_count, 2);
    assert_eq!(referee.tally().section_collisions_count, 0);
    let kinds: Vec<_> = referee.incidents().iter().map(|one| one.kind).collect();
    assert_eq!(kinds, [IncidentKind::Outside; 2]);
}

/// Sends both robots of the crossing on their way, the second `delay_s` later.
fn cross(delay_s: f64) -> Referee {
    let scene = scene(Scenario::Crossing);
    let mut referee = Referee::new(&scene, 1);
    let mut robots: Vec<Robot> = (0..2)
        .map(|number| robot(&scene, number, &RobotParameters::default()))
        .collect();
    let starts = [0.0, delay_s];
    for step in 0..1500 {
        let now = at(0.03 * f64::from(step));
        for (number, robot) in (0..2).zip(&mut robots) {
            run(robot, now, &mut |truth| referee.on_truth(&truth));
            let is_due = robot.counters().missions_started_count == 0;
            if is_due && now >= at(starts[number as usize]) {
                let mission = mission(&scene, number, 1, 2 * number);
                robot.on_mission(now, &mission, &mut |truth| referee.on_truth(&truth));
                let go = authority(1, 1, TO_GOAL, 0);
                robot.on_authority(now, &go, &mut |truth| referee.on_truth(&truth));
            }
        }
        referee.scan(now);
    }
    referee
}

#[test]
fn a_planted_collision_is_seen_by_both_checkers_and_a_clear_pass_by_none() {
    let collided = cross(0.3);
    let tally = collided.tally();
    assert_eq!(tally.sections_created_count, 1);
    assert_eq!(tally.sections_passed_count, 1);
    assert_eq!((tally.encounters_count, tally.overlaps_count), (1, 1));
    assert_eq!(
        (tally.section_collisions_count, tally.outside_count),
        (1, 0)
    );
    assert_eq!(tally.missions_done_count, 2);
    assert!((tally.travelled_m - 80.0).abs() < 1e-6, "{tally:?}");
    assert!(tally.stop_error_max_m.abs() < 1e-9);
    let first = collided.incidents()[0];
    assert_eq!((first.robots, first.mission_ids), ([0, 1], [1, 1]));
    assert_eq!(first.causes[0].caused_by_sequence, 1);
    assert!(first.position_m[0].abs() < 3.0 && first.position_m[1].abs() < 3.0);

    // The second enters, 1.25 m before the middle, when the first is 1.25 m past it: 1.25 s later.
    let clear = cross(1.4);
    let tally = clear.tally();
    assert_eq!(
        (tally.overlaps_count, tally.section_collisions_count),
        (0, 0)
    );
    assert_eq!(
        (tally.sections_created_count, tally.sections_passed_count),
        (1, 1)
    );
    let near_m = tally.separation_min_m.unwrap();
    assert!((0.0..0.5).contains(&near_m), "{near_m}");
    assert!(clear.incidents().is_empty());
}

#[test]
fn a_replay_of_sorted_records_gives_the_same_tally() {
    let scene = scene(Scenario::Crossing);
    let mut records = Vec::new();
    for number in 0..2 {
        let mut robot = robot(&scene, number, &RobotParameters::default());
        let mut keep = |truth| records.push(truth);
        robot.on_mission(at(0.3), &mission(&scene, number, 1, 2 * number), &mut keep);
        robot.on_authority(at(0.3), &authority(1, 1, TO_GOAL, 0), &mut keep);
        run(&mut robot, at(40.0), &mut keep);
    }
    records.sort_by_key(|truth| truth.at_ns);
    let mut referee = Referee::new(&scene, 1);
    referee.replay(
        &mut records.into_iter(),
        Instant::ZERO,
        at(40.0),
        &mut |_, _| {},
    );
    let tally = referee.tally();
    assert_eq!((tally.overlaps_count, tally.missions_done_count), (1, 2));
    assert_eq!(tally.scans_count, 1334);
}

#[test]
fn records_that_make_no_sense_are_counted_and_passed_over() {
    let scene = scene(Scenario::Crossing);
    let mut referee = Referee::new(&scene, 2);
    let good = standing(0, 0, 0.0, TruthKind::Motion);
    for unsound in [
        Truth {
            fleet_id: 2,
            ..good
        },
        Truth {
            robot_id: 2,
            ..good
        },
        Truth {
            path_id: 77,
            ..good
        },
        Truth { kind: 10, ..good },
        Truth {
            travelled_m: f64::NAN,
            ..good
        },
    ] {
        referee.on_truth(&unsound);
    }
    assert_eq!(referee.tally().unsound_count, 5);
}

#[test]
fn a_replaced_robot_drops_its_sections_and_fleets_do_not_meet() {
    let scene = scene(Scenario::Crossing);
    let mut referee = Referee::new(&scene, 2);
    for robot in 0..2 {
        referee.on_truth(&standing(robot, 2 * robot, 0.0, TruthKind::MissionStarted));
    }
    assert_eq!(referee.tally().sections_created_count, 1);
    referee.on_truth(&standing(1, 2, 40.0, TruthKind::Replaced));
    assert_eq!(referee.tally().sections_dropped_count, 1);
    referee.on_truth(&Truth {
        fleet_id: 1,
        ..standing(1, 2, 0.0, TruthKind::MissionStarted)
    });
    assert_eq!(referee.tally().sections_created_count, 1);
    referee.scan(at(1.0));
    assert_eq!(referee.tally().overlaps_count, 0);
}

#[test]
fn the_grid_finds_the_pairs_a_search_of_all_pairs_finds() {
    let mut random = RandomStream::new(4, "pairs");
    for fleet_size in [20, 60, 224] {
        let mut grid = PairFinder::new(3.0, fleet_size);
        for _ in 0..50 {
            let mut position = || 60.0 * (random.uniform() - 0.5);
            let tracks: Vec<_> = (0..fleet_size)
                .map(|_| Track::standing(Pose::new(position(), position(), 0.0)))
                .collect();
            let count = grid.find(&tracks);
            let mut found: Vec<_> = (0..count).map(|index| grid.found(index)).collect();
            found.sort_unstable();
            let mut expected = Vec::new();
            for first in 0..fleet_size {
                for second in first + 1..fleet_size {
                    let [a, b] = [first, second].map(|index| tracks[index].position);
                    if (a[0] - b[0]).hypot(a[1] - b[1]) < 3.0 {
                        expected.push([first, second].map(|index| u32::try_from(index).unwrap()));
                    }
                }
            }
            assert_eq!(found, expected);
        }
    }
}
