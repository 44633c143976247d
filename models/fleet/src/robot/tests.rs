//! A robot as a whole: missions, authorities by both rules, truth, and the promise that it never
//! passes its authority.

use core::time::Duration;

use super::*;
use crate::messages::{Authority, Mission, TO_GOAL};
use crate::referee::test_track;
use crate::scenario::{Scenario, WorldParameters};

pub(crate) fn scene(scenario: Scenario) -> Scene {
    let parameters = WorldParameters {
        scenario,
        path_spacing_m: 0.3,
        ..WorldParameters::default()
    };
    parameters.build().unwrap()
}

fn parameters(tracker: TrackerKind, inflation_delay_ms: f64) -> RobotParameters {
    RobotParameters {
        tracker,
        step_inflation: inflation_delay_ms > 0.0,
        inflation_delay_ms,
        ..RobotParameters::default()
    }
}

pub(crate) fn robot(scene: &Scene, number: u32, parameters: &RobotParameters) -> Robot {
    let random = RandomStream::new(u64::from(number), "robot tests");
    let mut robot = Robot::new(scene, parameters, 0, number, random);
    robot.start(Instant::ZERO, &mut |_| {});
    robot
}

pub(crate) fn mission(scene: &Scene, robot: u32, mission_id: u32, path_id: u32) -> Mission {
    let path = scene.world.path(PathId(path_id));
    Mission {
        header: Header {
            robot_id: robot,
            mission_id,
            header_id: mission_id,
            ..Header::default()
        },
        path_id,
        echo_header_id: 1,
        end_index: u32::try_from(path.last_index()).unwrap(),
        flags: 0,
        path_hash: path.hash(),
    }
}

pub(crate) fn authority(mission_id: u32, sequence: u32, index: i32, flags: u32) -> Authority {
    Authority {
        header: Header {
            mission_id,
            header_id: sequence,
            ..Header::default()
        },
        sequence,
        authority_index: index,
        flags,
        // Any state will do.
        echo_header_id: 1,
        ..Authority::default()
    }
}

fn at(seconds: f64) -> Instant {
    Instant::ZERO + Duration::from_secs_f64(seconds)
}

/// Runs all events up to `until`; gives the last state.
pub(crate) fn run(
    robot: &mut Robot,
    until: Instant,
    truth: &mut dyn FnMut(Truth),
) -> Option<State> {
    let mut last = None;
    while robot.next_event() <= until {
        let due = robot.next_event();
        last = robot.on_event(due, truth).or(last);
    }
    last
}

/// A robot of the crossing scene under way on its mission 1, with its whole path granted.
fn under_way(scene: &Scene, tracker: TrackerKind, until: Instant) -> Robot {
    let mut robot = robot(scene, 0, &parameters(tracker, 0.0));
    robot.on_mission(Instant::ZERO, &mission(scene, 0, 1, 0), &mut |_| {});
    robot.on_authority(Instant::ZERO, &authority(1, 1, TO_GOAL, 0), &mut |_| {});
    run(&mut robot, until, &mut |_| {});
    robot
}

fn drain(robot: &mut Robot, until: Instant) -> State {
    run(robot, until, &mut |_| {}).unwrap()
}

#[test]
fn a_mission_waits_for_its_first_authority_and_ends_at_its_goal() {
    let scene = scene(Scenario::Crossing);
    for tracker in [TrackerKind::Exact, TrackerKind::LegacyRk4] {
        let mut robot = robot(&scene, 0, &parameters(tracker, 0.0));
        robot.on_authority(at(0.1), &authority(1, 1, TO_GOAL, 0), &mut |_| {});
        robot.on_mission(at(0.2), &mission(&scene, 0, 1, 0), &mut |_| {});
        robot.on_mission(at(0.3), &mission(&scene, 0, 1, 0), &mut |_| {});
        let waiting = drain(&mut robot, at(2.0));
        assert_eq!(waiting.phase, Phase::AtPoint as u8);
        assert_eq!(waiting.authority_index, crate::messages::NO_AUTHORITY);
        assert_eq!((waiting.path_index, waiting.header.mission_id), (0, 1));
        robot.on_authority(at(2.0), &authority(1, 1, TO_GOAL, 0), &mut |_| {});
        let done = drain(&mut robot, at(60.0));
        assert_eq!(done.phase, Phase::Done as u8);
        assert!((done.travelled_m - 40.0).abs() < 1e-9 && done.speed_mps.abs() < 1e-9);
        let counters = robot.counters();
        assert_eq!(counters.early_count, 1);
        assert_eq!(counters.missions_repeated_count, 1);
        assert_eq!(counters.missions_done_count, 1);
        assert!((counters.travelled_m - 40.0).abs() < 1e-9);
        // Back again, by the reversed path.
        robot.on_mission(at(61.0), &mission(&scene, 0, 2, 1), &mut |_| {});
        robot.on_authority(at(61.0), &authority(2, 1, TO_GOAL, 0), &mut |_| {});
        let back = drain(&mut robot, at(120.0));
        assert!((back.x_m + 20.0).abs() < 1e-9);
        assert_eq!(robot.counters().missions_done_count, 2);
    }
}

#[test]
fn a_mission_that_does_not_fit_is_refused() {
    let scene = scene(Scenario::Crossing);
    let mut robot = robot(&scene, 0, &RobotParameters::default());
    let good = mission(&scene, 0, 1, 0);
    let wrong = [
        Mission {
            path_hash: 7,
            ..good
        },
        Mission {
            path_id: 99,
            ..good
        },
        Mission {
            end_index: 3,
            ..good
        },
        mission(&scene, 0, 1, 1),
        mission(&scene, 0, 1, 2),
    ];
    for mission in &wrong {
        robot.on_mission(at(0.1), mission, &mut |_| {});
    }
    assert_eq!(robot.counters().missions_refused_count, 5);
    robot.on_mission(at(0.1), &good, &mut |_| {});
    robot.on_mission(at(0.1), &mission(&scene, 0, 2, 0), &mut |_| {});
    assert_eq!(robot.counters().missions_busy_count, 1);
    assert_eq!(robot.counters().missions_started_count, 1);
}

#[test]
fn a_replaced_robot_stands_at_its_goal_at_once() {
    let scene = scene(Scenario::Crossing);
    let mut robot = under_way(&scene, TrackerKind::Exact, at(5.0));
    let mut kinds = Vec::new();
    let replace = Mission {
        flags: Mission::REPLACE,
        ..mission(&scene, 0, 1, 0)
    };
    robot.on_mission(at(5.0), &replace, &mut |truth| kinds.push(truth.kind));
    robot.on_mission(at(5.0), &replace, &mut |truth| kinds.push(truth.kind));
    let expected = [TruthKind::Replaced as u32, TruthKind::MessageStale as u32];
    assert_eq!(kinds, expected);
    let state = drain(&mut robot, at(5.1));
    assert_eq!(state.phase, Phase::Done as u8);
    assert!((state.x_m - 20.0).abs() < 1e-9);
    assert!((robot.counters().travelled_m - 8.0).abs() < 1e-9);
}

#[test]
fn the_original_overruns_late_orders_and_ignores_those_behind() {
    let scene = scene(Scenario::Crossing);
    for tracker in [TrackerKind::Exact, TrackerKind::LegacyRk4] {
        // After 8 s it is near 14 m, pose 46, at 2 m/s; it needs 2 m to stop.
        let mut robot = under_way(&scene, tracker, at(8.0));
        robot.on_authority(at(8.0), &authority(1, 2, 40, 0), &mut |_| {});
        assert_eq!(robot.state(at(8.0)).authority_index, TO_GOAL);
        robot.on_authority(at(8.0), &authority(1, 3, 49, 0), &mut |_| {});
        let stopped = drain(&mut robot, at(12.0));
        assert_eq!(stopped.phase, Phase::AtPoint as u8);
        assert!((15.8..16.3).contains(&stopped.travelled_m), "{stopped:?}");
        let counters = *robot.counters();
        assert_eq!((counters.ignored_count, counters.late_count), (1, 1));
        assert!(counters.late_overshoot_max_m > 1.0 && counters.stop_error_max_m <= 0.0);
        // An older order is passed over, one in force already changes nothing.
        robot.on_authority(at(12.0), &authority(1, 2, TO_GOAL, 0), &mut |_| {});
        robot.on_authority(at(12.0), &authority(1, 4, 49, 0), &mut |_| {});
        let counters = robot.counters();
        assert_eq!((counters.stale_count, counters.unchanged_count), (1, 1));
        assert_eq!(robot.state(at(12.0)).applied_sequence, 4);
    }
}

#[test]
fn an_acknowledged_authority_is_refused_rather_than_overrun() {
    let scene = scene(Scenario::Crossing);
    for tracker in [TrackerKind::Exact, TrackerKind::LegacyRk4] {
        let mut robot = under_way(&scene, tracker, at(8.0));
        let flags = Authority::ACKNOWLEDGED;
        robot.on_authority(at(8.0), &authority(1, 2, 49, flags), &mut |_| {});
        let state = robot.state(at(8.0));
        assert_eq!((state.flags, state.applied_sequence), (State::REFUSED, 2));
        assert_eq!(state.authority_index, TO_GOAL);
        robot.on_authority(at(8.0), &authority(1, 3, 60, flags), &mut |_| {});
        let state = robot.state(at(8.0));
        assert_eq!((state.flags, state.authority_index), (0, 60));
        let stopped = drain(&mut robot, at(20.0));
        let error_m = stopped.travelled_m - scene.world.path(PathId(0)).way_to_m(60);
        match tracker {
            TrackerKind::Exact => assert!(error_m.abs() < 1e-12),
            TrackerKind::LegacyRk4 => assert!(error_m.abs() < 0.15, "{error_m}"),
        }
    }
}

#[test]
fn an_acknowledged_authority_that_overtakes_its_mission_is_kept_for_it() {
    let scene = scene(Scenario::Crossing);
    let mut robot = robot(&scene, 0, &parameters(TrackerKind::Exact, 0.0));
    let flags = Authority::ACKNOWLEDGED;
    for (sequence, index) in [(2, 60), (1, 30)] {
        robot.on_authority(at(0.1), &authority(1, sequence, index, flags), &mut |_| {});
    }
    robot.on_mission(at(0.2), &mission(&scene, 0, 1, 0), &mut |_| {});
    let state = robot.state(at(0.2));
    assert_eq!((state.authority_index, state.applied_sequence), (60, 2));
    // Nothing is kept for a mission that never comes.
    robot.on_authority(at(0.3), &authority(2, 1, 40, flags), &mut |_| {});
    run(&mut robot, at(60.0), &mut |_| {});
    assert_eq!(robot.state(at(60.0)).authority_index, 60);
}

#[test]
fn strict_order_passes_over_what_legacy_order_takes() {
    let scene = scene(Scenario::Crossing);
    for (order, expected) in [(MessageOrder::Legacy, 30), (MessageOrder::Strict, 20)] {
        let parameters = RobotParameters {
            message_order: order,
            ..RobotParameters::default()
        };
        let mut robot = robot(&scene, 0, &parameters);
        robot.on_mission(Instant::ZERO, &mission(&scene, 0, 1, 0), &mut |_| {});
        robot.on_authority(Instant::ZERO, &authority(1, 2, 20, 0), &mut |_| {});
        // The same sequence and header again, with other contents: as a replica gone astray.
        robot.on_authority(Instant::ZERO, &authority(1, 2, 30, 0), &mut |_| {});
        assert_eq!(robot.state(Instant::ZERO).authority_index, expected);
        assert_eq!(robot.counters().out_of_order_count, 1);
    }
}

#[test]
fn a_crossing_is_entered_and_left_when_the_closed_form_says() {
    let scene = scene(Scenario::Crossing);
    let mut robot = robot(&scene, 0, &RobotParameters::default());
    let mut records = Vec::new();
    robot.on_mission(at(1.0), &mission(&scene, 0, 1, 0), &mut |truth| {
        records.push(truth);
    });
    robot.on_authority(at(1.0), &authority(1, 1, TO_GOAL, 0), &mut |truth| {
        records.push(truth);
    });
    run(&mut robot, at(60.0), &mut |truth| records.push(truth));
    let passes = |way_m: f64| {
        let (mut early_ns, mut late_ns) = (1_000_000_000_i64, 60_000_000_000);
        while late_ns - early_ns > 1 {
            let middle_ns = early_ns.midpoint(late_ns);
            let newest = records.iter().rev().find(|truth| truth.at_ns <= middle_ns);
            let track = test_track(&scene, newest.unwrap());
            if track.way_at_m(Instant::from_ns(middle_ns)) < way_m {
                early_ns = middle_ns;
            } else {
                late_ns = middle_ns;
            }
        }
        late_ns as f64 * 1e-9 - 1.0
    };
    // v = 2 m/s, a = 1 m/s^2: 2 s and 2 m to full speed. The section is 20 m -+ 1.25 m.
    for way_m in [18.75, 21.25] {
        let expected_s = 2.0 + (way_m - 2.0) / 2.0;
        assert!((passes(way_m) - expected_s).abs() < 1e-6);
    }
    assert!((passes(40.0 - 1e-12) - 22.0).abs() < 2e-6);
}

/// Drives a robot through a storm of authorities that are lost, doubled and reordered, and checks
/// at each event that it has not passed its authority by more than `margin_m`.
fn weather(scene: &Scene, parameters: &RobotParameters, margin_m: f64, seed: u64) -> RobotCounters {
    let mut random = RandomStream::new(seed, "storm");
    let mut robot = robot(scene, 0, parameters);
    let path = Arc::clone(scene.world.path(PathId(0)));
    robot.on_mission(Instant::ZERO, &mission(scene, 0, 1, 0), &mut |_| {});
    let mut in_flight: Vec<(Instant, Authority)> = Vec::new();
    let (mut next_send, mut sequence) = (Instant::ZERO, 0);
    let mut applied = 0;
    while robot.counters().missions_done_count == 0 && next_send < at(600.0) {
        let arrival = in_flight.iter().map(|(due, _)| *due).min();
        let now = arrival
            .map_or(next_send, |due| due.min(next_send))
            .min(robot.next_event());
        if now == next_send {
            sequence += 1;
            let here = f64::from(robot.state(now).path_index);
            let index = index_i32(floor_index(here - 5.0 + 40.0 * random.uniform()));
            let message = authority(1, sequence, index, Authority::ACKNOWLEDGED);
            for _ in 0..[0, 1, 1, 1, 2][floor_index(5.0 * random.uniform())] {
                in_flight.push((after(now, whole_ns(2e9 * random.uniform())), message));
            }
            next_send = after(now, whole_ns(5e8 * random.uniform()));
        }
        while let Some(position) = in_flight.iter().position(|(due, _)| *due <= now) {
            let (_, message) = in_flight.swap_remove(position);
            robot.on_authority(now, &message, &mut |_| {});
        }
        robot.on_event(now, &mut |_| {});
        let state = robot.state(now);
        let reach = if state.authority_index == TO_GOAL {
            path.last_index()
        } else {
            usize::try_from(state.authority_index).unwrap_or(0)
        };
        let passed_m = state.travelled_m - path.way_to_m(reach.min(path.last_index()));
        assert!(
            passed_m <= margin_m,
            "seed {seed}: {passed_m} past its authority"
        );
        assert!(state.applied_sequence >= applied, "seed {seed}");
        applied = state.applied_sequence;
    }
    *robot.counters()
}

#[test]
fn no_storm_of_acknowledged_authorities_drives_a_robot_past_its_authority() {
    let scene = scene(Scenario::Crossing);
    let mut sum = RobotCounters::default();
    for (tracker, inflation_ms) in [
        (TrackerKind::Exact, 0.0),
        (TrackerKind::LegacyRk4, 0.0),
        (TrackerKind::LegacyRk4, 100.0),
    ] {
        let parameters = parameters(tracker, inflation_ms);
        let margin_m = parameters.stop_error_bound_m(&scene.world.vehicle) + 1e-9;
        for seed in 0..200 {
            let counters = weather(&scene, &parameters, margin_m, seed);
            assert_eq!(counters.late_count + counters.ignored_count, 0);
            assert!(counters.stop_error_max_m <= margin_m);
            sum.add(&counters);
        }
    }
    assert!(sum.refused_count > 500 && sum.stale_count > 500, "{sum:?}");
    assert!(sum.missions_done_count > 300, "{sum:?}");
}

#[test]
fn truth_tells_where_the_robot_is_at_any_time() {
    let scene = scene(Scenario::HeadOn);
    for tracker in [TrackerKind::Exact, TrackerKind::LegacyRk4] {
        let mut random = RandomStream::new(3, "truth");
        let mut robot = robot(&scene, 1, &parameters(tracker, 20.0));
        let mut last = Truth::default();
        robot.on_mission(Instant::ZERO, &mission(&scene, 1, 1, 2), &mut |truth| {
            last = truth;
        });
        let (mut now, mut sequence) = (Instant::ZERO, 0);
        while robot.counters().missions_done_count == 0 {
            now = after(now, whole_ns(2e8 * random.uniform()));
            run(&mut robot, now, &mut |truth| last = truth);
            if random.chance(0.1) {
                sequence += 1;
                let index = robot.state(now).path_index
                    + index_i32(floor_index(60.0 * random.uniform()))
                    - 5;
                let message = authority(1, sequence, index.max(0), 0);
                robot.on_authority(now, &message, &mut |truth| last = truth);
            }
            let way_m = test_track(&scene, &last).way_at_m(now);
            let state = robot.state(now);
            assert!(
                (way_m - state.travelled_m).abs() < 1e-9,
                "{tracker:?} {now}"
            );
            let pose = scene.world.path(PathId(last.path_id)).pose_at(way_m);
            assert!((pose.x_m - state.x_m).hypot(pose.y_m - state.y_m) < 1e-9);
        }
    }
}

#[test]
fn states_come_every_tracking_period_under_way_and_rarely_when_parked() {
    let scene = scene(Scenario::Crossing);
    let count = |robot: &mut Robot, until| {
        let before = robot.counters().states_count;
        run(robot, until, &mut |_| {});
        robot.counters().states_count - before
    };
    let mut parked = robot(&scene, 0, &RobotParameters::default());
    assert!((33..=34).contains(&count(&mut parked, at(10.0))));
    let mut driving = under_way(&scene, TrackerKind::Exact, at(1.0));
    assert!((333..=334).contains(&count(&mut driving, at(11.0))));
    // One that is called late says how many ticks went by.
    let state = driving.on_event(at(12.0), &mut |_| {}).unwrap();
    assert_eq!(state.sampled_ns, 12_000_000_000);
    assert!((32..=33).contains(&driving.counters().skipped_ticks_count));
}

#[test]
fn a_host_that_is_late_moves_no_grid_of_the_stepped_tracker_and_counts_what_it_left_out() {
    let scene = scene(Scenario::Crossing);
    let mut robot = under_way(&scene, TrackerKind::LegacyRk4, at(1.0));
    let period = Duration::from_millis(30);
    let first = robot.next_event();
    let mut late = |due: Instant, by_ms: u64| {
        let now = due + Duration::from_millis(by_ms);
        assert!(robot.on_event(now, &mut |_| {}).is_some());
        (robot.next_event(), robot.counters().skipped_ticks_count)
    };
    assert_eq!(late(first, 10), (first + period, 0));
    assert_eq!(late(first + period, 0), (first + 2 * period, 0));
    assert_eq!(late(first + 2 * period, 70), (first + 5 * period, 2));
}
