//! The referee against planted collisions, touching robots and a pair-by-pair search.

use super::*;
use crate::geometry::Pose;
use crate::messages::TO_GOAL;
use crate::robot::tests::{authority, mission, robot, run, scene};
use crate::robot::{Robot, RobotParameters, TrackerKind};
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
fn a_mission_loses_what_it_took_beyond_a_drive_without_a_stop() {
    // 40 m at 2 m/s and 1 m/s^2 take 22 s. A robot that stops half way is there after 12 s and, sent on at 20.01 s, needs 12 s more.
    let scene = scene(Scenario::Crossing);
    let path = scene.world.paths.get(PathId(0)).unwrap();
    let half = i32::try_from(path.last_index() / 2).unwrap();
    assert!((path.way_to_m(path.last_index() / 2) - 20.0).abs() < 1e-6);
    let drive = |tracker: TrackerKind, first: i32| {
        let mut referee = Referee::new(&scene, 1);
        let parameters = RobotParameters {
            tracker,
            ..RobotParameters::default()
        };
        let mut robot = robot(&scene, 0, &parameters);
        for step in 0..1_200 {
            let now = at(0.03 * f64::from(step));
            run(&mut robot, now, &mut |truth| referee.on_truth(&truth));
            if step == 0 {
                let mission = mission(&scene, 0, 1, 0);
                robot.on_mission(now, &mission, &mut |truth| referee.on_truth(&truth));
                let go = authority(1, 1, first, 0);
                robot.on_authority(now, &go, &mut |truth| referee.on_truth(&truth));
            } else if step == 667 {
                let go = authority(1, 2, TO_GOAL, 0);
                robot.on_authority(now, &go, &mut |truth| referee.on_truth(&truth));
            }
            referee.scan(now);
        }
        *referee.tally()
    };
    // The stepped one begins, stops, begins again and ends on ticks of 30 ms.
    for (tracker, near_s) in [
        (TrackerKind::Exact, 1e-6),
        (TrackerKind::LegacyRk4, 4.0 * 0.03),
    ] {
        let straight = drive(tracker, TO_GOAL);
        assert_eq!((straight.missions_done_count, straight.stops_count), (1, 0));
        assert!(straight.mission_delay_s.abs() < near_s, "{straight:?}");
        let stopped = drive(tracker, half);
        assert_eq!((stopped.missions_done_count, stopped.stops_count), (1, 1));
        let lost_s = stopped.mean_mission_delay_s().unwrap();
        assert!((lost_s - 10.01).abs() < near_s, "{tracker:?}: {lost_s}");
    }
    assert!((scene.world.vehicle.least_time_s(1.0) - 2.0).abs() < 1e-9);
}

#[test]
fn a_mission_whose_beginning_was_not_recorded_is_done_and_not_timed() {
    let scene = scene(Scenario::Crossing);
    let mut referee = Referee::new(&scene, 1);
    let mut record = |kind, mission_id, at_ns| {
        referee.on_truth(&Truth {
            at_ns,
            mission_id,
            ..standing(0, 0, 40.0, kind)
        });
        let tally = referee.tally();
        (tally.missions_done_count, tally.missions_timed_count)
    };
    record(TruthKind::MissionStarted, 1, 1_000_000_000);
    assert_eq!(record(TruthKind::MissionDone, 2, 60_000_000_000), (1, 0));
    assert_eq!(record(TruthKind::MissionDone, 3, 90_000_000_000), (2, 0));
    assert_eq!(referee.tally().mean_mission_delay_s(), None);
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

/// A robot on its mission 1, standing at `travelled_m` of a path.
fn under_way(robot_id: u32, path_id: u32, travelled_m: f64) -> Truth {
    Truth {
        mission_id: 1,
        ..standing(robot_id, path_id, travelled_m, TruthKind::Motion)
    }
}

/// Clearances of two robots under way on the paths 0 and 2, looked at where each of `places` puts them.
fn clearances(scenario: Scenario, places: &[[f64; 2]]) -> Clearances {
    let scene = scene(scenario);
    let mut referee = Referee::new(&scene, 1);
    for robot in 0..2 {
        referee.on_truth(&standing(robot, 2 * robot, 0.0, TruthKind::MissionStarted));
    }
    for (step, place) in (0..).zip(places) {
        for (robot, travelled_m) in (0..).zip(place) {
            referee.on_truth(&under_way(robot, 2 * robot, *travelled_m));
        }
        referee.scan(at(0.03 * f64::from(step)));
    }
    referee.tally().clearances
}

fn counts(seen: &Clearances) -> (u64, u64) {
    (seen.count(), seen.near_miss_count())
}

/// Robot 0 starts with 4 m free behind it; the gap is 4 m, and what it drives, less what robot 1 drives.
fn follow(gaps_m: &[f64]) -> Clearances {
    let mut place = [0.0, 0.0];
    let places: Vec<_> = gaps_m
        .iter()
        .map(|gap_m| {
            // Neither goes back.
            place[0] = f64::max(place[0], place[1] - 4.0 + gap_m);
            place[1] = 4.0 + place[0] - gap_m;
            place
        })
        .collect();
    clearances(Scenario::Following, &places)
}

#[test]
fn a_pass_is_one_approach_with_its_least_distance() {
    // Poses are about 0.3 m apart: 0.2 m is in the seventh bin of a tenth of that. Out of reach it is over.
    let seen = follow(&[3.0, 0.5, 0.2, 0.4, 2.0]);
    assert_eq!(counts(&seen), (1, 1));
    assert_eq!(seen.quantile(0.5), Some(0.65));
    // It is over as well within reach, two spacings apart; a second is counted anew.
    let seen = follow(&[3.0, 0.5, 0.2, 0.7, 0.4, 0.7]);
    assert_eq!(counts(&seen), (2, 1));
    assert_eq!(seen.quantile(0.5), Some(0.65));
    assert_eq!(seen.quantile(1.0), Some(1.35));
    // Farther away than two spacings there is none.
    let seen = follow(&[3.0, 0.7, 0.61, 2.0]);
    assert_eq!((counts(&seen), seen.quantile(0.5)), ((0, 0), None));
}

#[test]
fn a_collision_is_an_approach_and_no_near_miss() {
    let seen = follow(&[3.0, 0.5, -0.1, 0.2, 2.0]);
    assert_eq!(counts(&seen), (1, 0));
    assert_eq!(seen.quantile(0.5), Some(0.0));
}

#[test]
fn robots_that_are_still_near_at_the_end_do_not_count() {
    assert_eq!(counts(&follow(&[3.0, 0.5, 0.2, 0.5])), (0, 0));
}

#[test]
fn robots_that_part_by_less_than_they_must_are_in_one_approach() {
    let seen = follow(&[3.0, 0.4, 0.55, 0.1, 0.55, 0.25, 2.0]);
    assert_eq!(counts(&seen), (1, 1));
    assert_eq!(seen.quantile(0.5), Some(0.35));
}

#[test]
fn a_clearance_is_the_distance_of_corners_and_not_the_gap_between_sides() {
    // Both 0.24 m from where they would touch the lane of the other, 0.339 m from corner to corner; 2 m by 0.5 m each.
    let before = 20.0 - 1.25 - 0.24;
    let seen = clearances(Scenario::Crossing, &[[0.0; 2], [before; 2], [30.0, before]]);
    assert_eq!(counts(&seen), (1, 0));
    assert_eq!(seen.quantile(0.5), Some(1.15));
    // Sides 0.5 m apart, which is within two spacings, and corners 0.707 m, which is not.
    let before = 20.0 - 1.25 - 0.5;
    let seen = clearances(Scenario::Crossing, &[[0.0; 2], [before; 2], [30.0, before]]);
    assert_eq!(counts(&seen), (0, 0));
}

#[test]
fn robots_that_are_not_both_under_way_approach_no_one() {
    let scene = scene(Scenario::Following);
    let mut referee = Referee::new(&scene, 1);
    referee.on_truth(&standing(1, 2, 0.0, TruthKind::MissionStarted));
    for (step, travelled_m) in (0..).zip([0.0, 3.8, 10.0]) {
        referee.on_truth(&under_way(1, 2, travelled_m));
        referee.scan(at(0.03 * f64::from(step)));
    }
    assert!((referee.tally().separation_min_m.unwrap() - 0.2).abs() < 1e-9);
    assert_eq!(counts(&referee.tally().clearances), (0, 0));
}

#[test]
fn clearances_of_runs_add_up() {
    let mut all = Tally::default();
    for gaps_m in [[3.0, 0.2, 2.0], [3.0, -0.1, 2.0], [3.0, 0.4, 2.0]] {
        all.merge(&Tally {
            clearances: follow(&gaps_m),
            ..Tally::default()
        });
    }
    assert_eq!(counts(&all.clearances), (3, 1));
    let quantiles = [0.05, 0.34, 0.5, 0.99].map(|one| all.clearances.quantile(one));
    assert_eq!(quantiles, [Some(0.0), Some(0.65), Some(0.65), Some(1.35)]);
}
