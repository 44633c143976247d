//! Claims about the sensor's adapter.
#![allow(
    clippy::float_cmp,
    reason = "what is handed on must come out unchanged"
)]

use core::time::Duration;

use super::adapter_tests::{AT, AT_ONCE, command, feedback, near, robot_adapter, sensor_adapter};
use super::*;
use crate::egm::messages::{EgmCommand, EgmFeedback, SessionState};
use crate::egm::wire::messages::*;
use crate::egm::wire::robot::{EgmMciState, EgmMotorState, EgmRapidCtrlExecState, EgmRobot};
use crate::egm::wire::{self, Cause, Refusal, Release};
use crate::yumi::arm::RIGHT_START_RAD;
use hil_core::time::Instant;

fn ms(ms: i64) -> Instant {
    Instant::from_ns(ms * 1_000_000)
}

/// What a foreign robot sends in the cycle `seqno` of a session, its clock at `tm`.
fn from_robot(seqno: u32, tm: u32) -> EgmRobot {
    let list = |values: &[f64]| {
        Some(EgmJoints {
            joints: values.to_vec(),
        })
    };
    let joints = list(&[98.4, -113.5, 19.4, -155.1, 98.4, 18.9]);
    let mtype = Some(MessageType::Data as i32);
    EgmRobot {
        header: Some(EgmHeader {
            seqno: Some(seqno),
            tm: Some(tm),
            mtype,
        }),
        feed_back: Some(EgmFeedBack {
            joints: joints.clone(),
            external_joints: list(&[-49.3]),
            ..EgmFeedBack::default()
        }),
        planned: Some(EgmPlanned {
            joints,
            external_joints: list(&[-49.3]),
            ..EgmPlanned::default()
        }),
        motor_state: Some(EgmMotorState { state: 1 }),
        mci_state: Some(EgmMciState { state: 3 }),
        ..EgmRobot::default()
    }
}

fn bytes(robot: &EgmRobot) -> Vec<u8> {
    let mut datagram = Vec::new();
    wire::encode(robot, &mut datagram);
    datagram
}

#[test]
fn our_own_robot_is_seen_as_it_is() {
    let mut robot = robot_adapter(Axes::Seven, RobotWare::Seven);
    let mut sensor = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut datagram = Vec::new();
    for cycle in 0..5 {
        let mut sent = feedback(100 + cycle);
        sent.planned_rad[4] += 0.01;
        assert!(robot.encode(&sent, AT, &mut datagram));
        let seen = sensor.decode(ms(4 * i64::from(cycle)), &datagram).unwrap();
        assert!(near(&seen.measured_rad, &sent.measured_rad));
        assert!(near(&seen.planned_rad, &sent.planned_rad));
        let (there, here) = (seen.tool.isometry().unwrap(), sent.tool.isometry().unwrap());
        assert!((there.translation.vector - here.translation.vector).norm() < 1e-12);
        assert!(there.rotation.angle_to(&here.rotation) < 1e-7);
        assert_eq!(
            (seen.clock_ms, seen.seqno, seen.session),
            (sent.clock_ms, cycle, 1)
        );
        assert_eq!(seen.session_state(), Some(SessionState::Running));
        assert_eq!(seen.reference_age_ns, i64::from(cycle) * 4_000_000);
        assert_eq!(seen.cycle_index, u64::from(cycle));
        assert_eq!(seen.queue_count, QUEUE_COUNT_UNKNOWN);
    }
    assert_eq!(sensor.release(), Some(Release::RobotWare7));
    for refused in [&datagram[..], &datagram[..20], &bytes(&from_robot(0, 396))] {
        assert!(sensor.decode(ms(20), refused).is_err());
        assert_eq!(sensor.release(), Some(Release::RobotWare7));
    }
}

#[test]
fn a_new_session_is_told_from_a_lost_and_from_a_late_datagram() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut see = |seqno: u32, tm: u32| {
        let outcome = adapter.decode(Instant::ZERO, &bytes(&from_robot(seqno, tm)));
        outcome.map(|seen| (seen.session, seen.cycle_index))
    };
    let overtaken = |seqno, newest| Err(Refusal::Overtaken { seqno, newest });
    assert_eq!(see(0, 1000), Ok((1, 0)));
    assert_eq!(see(1, 1004), Ok((1, 1)));
    assert_eq!(see(4, 1016), Ok((1, 4)), "two were lost");
    assert_eq!(see(3, 1012), overtaken(3, 4));
    assert_eq!(see(4, 1016), Err(Refusal::Repeated { seqno: 4 }));
    assert_eq!(see(3, 1012), Err(Refusal::Repeated { seqno: 3 }));
    assert_eq!(see(2, 1008), overtaken(2, 4));
    assert_eq!(see(0, 1020), Ok((2, 5)), "the robot starts anew");
    assert_eq!(see(5, 1019), overtaken(5, 0));
    assert_eq!(see(3, 1032), Ok((2, 8)));
    assert_eq!(see(2, 1044), Ok((3, 9)), "its first two were lost");
    assert_eq!(
        see(0, 8),
        Ok((4, 10)),
        "the controller has restarted, its clock too"
    );
    assert_eq!(see(1, u32::MAX - 40), overtaken(1, 0));
    assert_eq!(adapter.received().refused(Cause::Overtaken), 4);
    assert_eq!(adapter.received().refused(Cause::Repeated), 2);
    assert_eq!(adapter.received().total(), 13);
}

#[test]
fn a_new_session_behind_an_outage_is_told_by_the_robots_clock() {
    // Numbers, and milliseconds of the clock, that an outage of 8 s hides; the sessions after it.
    for (lost, outage_ms, sessions) in [
        (2000, 8000, 1), // the same session, 4 ms a cycle
        (1984, 8000, 1), // 4.032 ms a cycle
        (1980, 8000, 1), // the robot itself lost 80 ms
        (1000, 8000, 2), // it ended after 1 s and the next one counted to beyond the last
        (1, 8000, 2),
        (1, 104, 1), // one late cycle of the robot
        (1, 105, 2),
        (500, -5000, 2), // the controller has restarted
    ] {
        let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
        let mut see = |seqno: u32, tm: i64| {
            let tm = u32::try_from(tm).unwrap();
            let outcome = adapter.decode(Instant::ZERO, &bytes(&from_robot(seqno, tm)));
            outcome.unwrap().session
        };
        for seqno in 0..=1500 {
            assert_eq!(see(seqno, 4 * i64::from(seqno)), 1);
        }
        let seen = see(1500 + lost, 6000 + outage_ms);
        assert_eq!(seen, sessions, "{lost} in {outage_ms} ms");
    }
}

#[test]
fn a_robot_of_long_cycles_keeps_its_session() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    for seqno in (0..20).chain([500, 501]) {
        let seen = adapter.decode(Instant::ZERO, &bytes(&from_robot(seqno, 24 * seqno)));
        assert_eq!(seen.unwrap().session, 1);
    }
}

#[test]
fn the_session_state_follows_motors_program_and_guided_motion() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut seqno = 0;
    let mut check = |motors: i32, program: i32, mci: i32, expected: SessionState| {
        let mut robot = from_robot(seqno, 4 * seqno);
        seqno += 1;
        robot.motor_state = Some(EgmMotorState { state: motors });
        robot.rapid_exec_state = Some(EgmRapidCtrlExecState { state: program });
        robot.mci_state = Some(EgmMciState { state: mci });
        let seen = adapter.decode(Instant::ZERO, &bytes(&robot)).unwrap();
        assert_eq!(
            seen.session_state(),
            Some(expected),
            "{motors} {program} {mci}"
        );
    };
    check(1, 2, 2, SessionState::Activating);
    check(1, 2, 3, SessionState::Running);
    check(1, 0, 3, SessionState::Running);
    check(1, 2, 2, SessionState::Stopping);
    check(2, 2, 3, SessionState::Idle);
    check(0, 2, 3, SessionState::Idle);
    check(1, 1, 3, SessionState::Idle);
    check(1, 2, 1, SessionState::Idle);
    check(1, 2, 0, SessionState::Idle);
    check(1, 2, 9, SessionState::Idle);
}

#[test]
fn what_a_robot_does_not_say_is_unknown_and_what_is_no_number_is_refused() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut robot = from_robot(0, 0);
    let seen = adapter.decode(Instant::ZERO, &bytes(&robot)).unwrap();
    assert_eq!(seen.tool.isometry(), None);
    assert!(!seen.has(EgmFeedback::HAS_REFERENCE));

    let part = robot.feed_back.as_mut().unwrap();
    let pos = EgmCartesian {
        x: 1.0,
        y: f64::NAN,
        z: 3.0,
    };
    part.cartesian = Some(EgmPose {
        pos: Some(pos),
        ..EgmPose::default()
    });
    let outcome = adapter.decode(Instant::ZERO, &bytes(&robot));
    assert_eq!(outcome, Err(Refusal::NotFinite { joint: 0 }));

    robot.planned = None;
    robot.feed_back.as_mut().unwrap().cartesian = None;
    let outcome = adapter.decode(Instant::ZERO, &bytes(&robot));
    assert_eq!(outcome, Err(Refusal::MissingJoints));
    robot.header.as_mut().unwrap().seqno = None;
    let outcome = adapter.decode(Instant::ZERO, &bytes(&robot));
    assert_eq!(outcome, Err(Refusal::MissingHeader));
}

#[test]
fn a_coupled_sensor_answers_each_datagram_once() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut datagram = Vec::new();
    let mut numbers = Vec::new();
    for cycle in 0..100_u32 {
        let now = ms(4 * i64::from(cycle));
        adapter
            .decode(now, &bytes(&from_robot(cycle, 4 * cycle)))
            .unwrap();
        if cycle >= 10 && cycle % 3 == 0 {
            adapter.command(&command(RIGHT_START_RAD)).unwrap();
            adapter.command(&command(RIGHT_START_RAD)).unwrap();
        }
        while adapter.poll_transmit(now, &mut datagram) {
            let header = wire::decode_sensor(&datagram).unwrap().header.unwrap();
            assert_eq!(header.tm, Some(4 * cycle));
            numbers.push(header.seqno.unwrap());
        }
    }
    // The first command comes with cycle 12; cycle 11 still waits then.
    let expected: Vec<u32> = (0..88).collect();
    assert_eq!(numbers, expected);
    let counts = adapter.transmit();
    assert_eq!((counts.sent_count, counts.superseded_count), (88, 30));
    assert_eq!((counts.repeated_count, counts.unanswered_count), (58, 12));
}

#[test]
fn patience_waits_for_a_fresh_command_and_then_repeats_the_last() {
    let patience = Duration::from_millis(2);
    let mut adapter = sensor_adapter(Axes::Seven, SendPolicy::Coupled { patience });
    let mut datagram = Vec::new();
    let see = |adapter: &mut SensorAdapter, seqno: u32| {
        let now = ms(4 * i64::from(seqno));
        adapter
            .decode(now, &bytes(&from_robot(seqno, 4 * seqno)))
            .unwrap();
    };
    see(&mut adapter, 0);
    assert_eq!(adapter.next_transmit(), None);
    adapter.command(&command(RIGHT_START_RAD)).unwrap();
    assert!(adapter.poll_transmit(ms(1), &mut datagram));
    see(&mut adapter, 1);
    assert_eq!(adapter.next_transmit(), Some(ms(6)));
    assert!(!adapter.poll_transmit(ms(5), &mut datagram));
    adapter.command(&command(RIGHT_START_RAD)).unwrap();
    assert!(adapter.poll_transmit(ms(5), &mut datagram));
    assert!(
        !adapter.poll_transmit(ms(6), &mut datagram),
        "one answer each"
    );
    see(&mut adapter, 2);
    assert!(adapter.poll_transmit(ms(10), &mut datagram));
    // A caller who slept through the patience still owes exactly two answers.
    see(&mut adapter, 3);
    see(&mut adapter, 4);
    assert!(adapter.poll_transmit(ms(16), &mut datagram));
    assert!(!adapter.poll_transmit(ms(16), &mut datagram));
    assert!(adapter.poll_transmit(ms(18), &mut datagram));
    let counts = adapter.transmit();
    assert_eq!(
        (
            counts.sent_count,
            counts.repeated_count,
            counts.unanswered_count
        ),
        (5, 3, 0)
    );
}

#[test]
fn a_new_session_gets_no_command_of_the_old_one() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut datagram = Vec::new();
    adapter.decode(ms(0), &bytes(&from_robot(0, 0))).unwrap();
    adapter.command(&command(RIGHT_START_RAD)).unwrap();
    assert!(adapter.poll_transmit(ms(0), &mut datagram));
    adapter
        .decode(ms(3000), &bytes(&from_robot(0, 3000)))
        .unwrap();
    assert!(!adapter.poll_transmit(ms(3000), &mut datagram));
    adapter.command(&command(RIGHT_START_RAD)).unwrap();
    assert!(adapter.poll_transmit(ms(3004), &mut datagram));
    let header = wire::decode_sensor(&datagram).unwrap().header.unwrap();
    assert_eq!(header.seqno, Some(0));
}

#[test]
fn a_free_sensor_sends_on_its_own_grid() {
    let period = Duration::from_millis(8);
    let mut adapter = sensor_adapter(Axes::Seven, SendPolicy::Free { period });
    let mut datagram = Vec::new();
    assert!(!adapter.poll_transmit(ms(0), &mut datagram));
    adapter.decode(ms(5), &bytes(&from_robot(0, 0))).unwrap();
    assert!(!adapter.poll_transmit(ms(5), &mut datagram));
    adapter.command(&command(RIGHT_START_RAD)).unwrap();
    let mut sent_at_ms = Vec::new();
    for now_ms in 6..60 {
        if adapter.poll_transmit(ms(now_ms), &mut datagram) {
            sent_at_ms.push(now_ms);
        }
    }
    assert_eq!(sent_at_ms, [13, 21, 29, 37, 45, 53]);
    assert!(adapter.poll_transmit(ms(85), &mut datagram));
    assert_eq!(adapter.next_transmit(), Some(ms(93)));
    let counts = adapter.transmit();
    assert_eq!((counts.sent_count, counts.skipped_count), (7, 1 + 3));
}

#[test]
fn a_command_that_shall_reach_no_robot_stays_here() {
    let mut adapter = sensor_adapter(Axes::Seven, AT_ONCE);
    adapter.decode(ms(0), &bytes(&from_robot(0, 0))).unwrap();
    let mut bad = command(RIGHT_START_RAD);
    bad.position_rad[2] = f64::NAN;
    assert_eq!(adapter.command(&bad), Err(Refusal::NotFinite { joint: 7 }));
    bad = command(RIGHT_START_RAD);
    bad.speed_rad_per_s[6] = 18.0;
    assert_eq!(adapter.command(&bad), Ok(()), "a speed that is not meant");
    bad.flags = EgmCommand::HAS_SPEED;
    assert_eq!(
        adapter.command(&bad).unwrap_err().cause().label(),
        "too fast"
    );
    assert_eq!(adapter.commands().accepted(), 1);
}
