//! Claims about the robot's adapter, with the datagrams of foreign clients; and what the tests of both
//! adapters share.
#![allow(
    clippy::float_cmp,
    reason = "what is handed on must come out unchanged"
)]

use core::time::Duration;

use bytemuck::Zeroable;

use super::*;
use crate::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use crate::egm::wire::golden_tests::all;
use crate::egm::wire::{self, Cause, Refusal, Release};
use crate::yumi::Joints;
use crate::yumi::arm::{Arm, POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD};
use hil_core::time::Instant;

pub(super) const AT: Duration = Duration::from_nanos(1_700_000_000_123_456_789);

pub(super) fn robot_adapter(axes: Axes, robotware: RobotWare) -> RobotAdapter {
    RobotAdapter::new(RobotAdapterSettings {
        side: Side::Right,
        axes,
        robotware,
        cycle: Duration::from_millis(4),
        planned_lead: Duration::from_millis(16),
    })
}

pub(super) fn sensor_adapter(axes: Axes, policy: SendPolicy) -> SensorAdapter {
    SensorAdapter::new(SensorAdapterSettings {
        axes,
        held_rad: RIGHT_START_RAD[2],
        policy,
    })
}

pub(super) const AT_ONCE: SendPolicy = SendPolicy::Coupled {
    patience: Duration::ZERO,
};

/// Cycle `cycle_index` of a running session 1.
pub(super) fn feedback(cycle_index: u32) -> EgmFeedback {
    EgmFeedback {
        cycle_index: u64::from(cycle_index),
        measured_rad: RIGHT_START_RAD,
        planned_rad: RIGHT_START_RAD,
        tool: Arm::right().tool(&RIGHT_START_RAD).into(),
        clock_ms: 4 * cycle_index,
        session: 1,
        state: SessionState::Running as u32,
        ..EgmFeedback::zeroed()
    }
}

pub(super) fn command(position_rad: Joints) -> EgmCommand {
    EgmCommand {
        position_rad,
        ..EgmCommand::zeroed()
    }
}

/// A robot adapter that has opened a session.
pub(super) fn opened(axes: Axes) -> RobotAdapter {
    let mut adapter = robot_adapter(axes, RobotWare::Six);
    assert!(adapter.encode(&feedback(0), AT, &mut Vec::new()));
    adapter
}

pub(super) fn near(a: &Joints, b: &Joints) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
}

#[test]
fn each_clients_datagram_is_taken_or_refused_for_what_it_is() {
    let outcome = |axes: Axes, datagram: &[u8]| match opened(axes).decode(datagram) {
        Ok(command) if command.flags == 0 => "position",
        Ok(_) => "position and speed",
        Err(refusal) => refusal.cause().label(),
    };
    for (name, datagram) in all() {
        let both = [Axes::Six, Axes::Seven].map(|axes| outcome(axes, &datagram));
        let expected = match name {
            "sensor_joints"
            | "sensor_rapid_data"
            | "sensor_empty_external"
            | "sensor_digital_signal" => ["position", "wrong number of joints"],
            "sensor_joints_speed" => ["position and speed", "wrong number of joints"],
            "sensor_joints_external" => ["wrong number of joints", "position"],
            "sensor_joints_speed_external" => ["wrong number of joints", "position and speed"],
            "sensor_external_six" => ["wrong number of joints"; 2],
            "sensor_nan" => ["wrong number of joints", "not a finite number"],
            "path_correction" => ["wrong message type"; 2],
            "robot_empty_lists" => ["missing header"; 2],
            name if name.starts_with("robot") => ["wrong message type"; 2],
            name if name.starts_with("libegm_6_speed") => {
                ["position and speed", "wrong number of joints"]
            }
            name if name.starts_with("libegm_6") => ["position", "wrong number of joints"],
            name if name.starts_with("libegm_7_speed") => {
                ["wrong number of joints", "position and speed"]
            }
            name if name.starts_with("libegm_7") || name.starts_with("stream") => {
                ["wrong number of joints", "position"]
            }
            _ => ["no joints"; 2],
        };
        assert_eq!(both, expected, "{name}");
    }
}

#[test]
fn a_clients_joints_come_out_in_chain_order() {
    let named = |wanted: &str| all().find(|(name, _)| *name == wanted).unwrap().1;
    let mut adapter = opened(Axes::Seven);
    let taken = adapter
        .decode(&named("sensor_joints_speed_external"))
        .unwrap();
    assert!(near(&taken.position_rad, &RIGHT_START_RAD));
    let speed = [1.0, -2.0, -7.5, 3.0, 0.0, 0.0, 0.125].map(f64::to_radians);
    assert!(near(&taken.speed_rad_per_s, &speed));
    assert_eq!((taken.frame_index, taken.flags), (0, EgmCommand::HAS_SPEED));

    let again = adapter.decode(&named("stream_003")).unwrap();
    assert_eq!((again.frame_index, again.flags), (1, 0));
    assert_eq!(again.speed_rad_per_s, [0.0; 7]);
}

#[test]
fn a_sessions_datagrams_count_from_zero_and_there_are_none_without_one() {
    use SessionState::{Activating, Idle, Moving, Running, Stopping, Waiting};
    let mut adapter = robot_adapter(Axes::Seven, RobotWare::Six);
    let mut datagram = Vec::new();
    let mut numbers = Vec::new();
    let script = [
        (0, Idle),
        (1, Activating),
        (1, Running),
        (1, Stopping),
        (1, Waiting),
        (2, Activating),
        (2, Running),
        (3, Activating),
        (3, Moving),
        (3, Running),
    ];
    for (cycle, (session, state)) in (0..).zip(script) {
        let feedback = EgmFeedback {
            session,
            state: state as u32,
            ..feedback(cycle)
        };
        if adapter.encode(&feedback, AT, &mut datagram) {
            let robot = wire::decode_robot(&datagram).unwrap();
            let header = robot.header.unwrap();
            assert_eq!(header.tm, Some(4 * cycle));
            let is_running = robot.mci_state.unwrap().state() == wire::robot::MciState::Running;
            assert_eq!(is_running, state == Running);
            numbers.push(header.seqno.unwrap());
        }
    }
    assert_eq!(numbers, [0, 1, 2, 0, 1, 0, 0]);
    assert_eq!(adapter.sent_count(), 7);
}

#[test]
fn our_datagrams_hold_everything_clients_read() {
    for (robotware, release) in [
        (RobotWare::Six, Release::From6_10),
        (RobotWare::Seven, Release::RobotWare7),
    ] {
        let mut adapter = robot_adapter(Axes::Seven, robotware);
        let mut datagram = Vec::new();
        let mut sent = feedback(0);
        sent.flags = EgmFeedback::CONVERGED;
        sent.planned_rad[0] += 0.01;
        assert!(adapter.encode(&sent, AT, &mut datagram));
        let robot = wire::decode_robot(&datagram).unwrap();
        assert_eq!(robot.release(), release);
        assert_eq!(robot.mci_convergence_met, Some(true));
        assert_eq!(robot.utilization_rate, Some(0.0));
        assert_eq!(
            robot.motor_state.unwrap().state(),
            wire::robot::MotorState::On
        );
        let program = robot.rapid_exec_state.unwrap().state();
        assert_eq!(program, wire::robot::RapidState::Running);

        let planned = robot.planned.unwrap();
        let tool_m = Arm::right().tool(&sent.planned_rad).translation.vector;
        let pose = planned.cartesian.unwrap();
        assert!((pose.pos.unwrap().y - 1e3 * tool_m.y).abs() < 1e-9);
        assert!(pose.euler.is_some() && pose.orient.is_some());
        assert_eq!(planned.time.unwrap().usec, 139_456);
        let measured = robot.feed_back.unwrap();
        assert_eq!(measured.time.unwrap().usec, 123_456);
        assert_eq!(measured.joints.unwrap().joints.len(), 6);
        assert_eq!(measured.external_joints.unwrap().joints.len(), 1);
    }
}

#[test]
fn utilisation_is_the_share_of_the_busiest_joints_speed_limit() {
    let mut adapter = opened(Axes::Seven);
    let mut datagram = Vec::new();
    let mut moved = feedback(2);
    // 90 degrees/s of 180 over two cycles, and 100 of 400.
    moved.planned_rad[1] += 90_f64.to_radians() * 0.008;
    moved.planned_rad[6] += 100_f64.to_radians() * 0.008;
    assert!(adapter.encode(&moved, AT, &mut datagram));
    let robot = wire::decode_robot(&datagram).unwrap();
    assert!((robot.utilization_rate.unwrap() - 50.0).abs() < 1e-9);
}

#[test]
fn a_six_axis_session_leaves_the_seventh_joint_where_it_found_it() {
    let mut adapter = opened(Axes::Six);
    let mut datagram = Vec::new();
    let mut moved = feedback(1);
    moved.planned_rad[2] += 0.1;
    assert!(adapter.encode(&moved, AT, &mut datagram));
    let part = wire::decode_robot(&datagram).unwrap().feed_back.unwrap();
    assert!(part.external_joints.is_none());
    let joints = all().find(|(name, _)| *name == "sensor_joints").unwrap().1;
    assert_eq!(
        adapter.decode(&joints).unwrap().position_rad[2],
        RIGHT_START_RAD[2]
    );
    moved.session = 2;
    assert!(adapter.encode(&moved, AT, &mut datagram));
    assert_eq!(
        adapter.decode(&joints).unwrap().position_rad[2],
        moved.planned_rad[2]
    );
}

#[test]
fn a_robot_that_started_anew_opens_a_session_although_it_counts_like_the_first() {
    let mut adapter = opened(Axes::Six);
    let mut datagram = Vec::new();
    let mut see = |cycle_index: u64, clock_ms: u32, moved_rad: f64| {
        let mut seen = EgmFeedback {
            cycle_index,
            clock_ms,
            ..feedback(0)
        };
        seen.planned_rad[2] += moved_rad;
        assert!(adapter.encode(&seen, AT, &mut datagram));
        let header = wire::decode_robot(&datagram).unwrap().header.unwrap();
        let joints = all().find(|(name, _)| *name == "sensor_joints").unwrap().1;
        let held_rad = adapter.decode(&joints).unwrap().position_rad[2];
        (header.seqno.unwrap(), held_rad, adapter.session_count())
    };
    let first_rad = RIGHT_START_RAD[2];
    assert_eq!(see(500, 2000, 0.1), (1, first_rad, 1));
    assert_eq!(
        see(499, 1996, 0.1),
        (2, first_rad, 1),
        "late, not restarted"
    );
    assert_eq!(see(500, 2000, 0.1), (3, first_rad, 1));
    assert_eq!(see(130, 4000, 0.2), (0, first_rad + 0.2, 2));
    assert_eq!(see(131, 4004, 0.3), (1, first_rad + 0.2, 2));
}

#[test]
fn limits_bind_exactly_and_survive_the_conversion_to_degrees() {
    let mut robot = opened(Axes::Seven);
    let mut sensor = sensor_adapter(Axes::Seven, AT_ONCE);
    let mut datagram = Vec::new();
    for (index, limits) in (0..).zip([POSITION_MIN_RAD, POSITION_MAX_RAD]) {
        let cycle = EgmFeedback {
            measured_rad: limits,
            planned_rad: limits,
            ..feedback(1 + index)
        };
        assert!(robot.encode(&cycle, AT, &mut datagram));
        sensor.decode(Instant::ZERO, &datagram).unwrap();
        sensor.command(&command(limits)).unwrap();
        assert!(sensor.poll_transmit(Instant::ZERO, &mut datagram));
        let taken = robot.decode(&datagram).unwrap();
        assert!(near(&taken.position_rad, &limits));
        for place in 0..7 {
            let range = POSITION_MIN_RAD[place]..=POSITION_MAX_RAD[place];
            assert!(range.contains(&taken.position_rad[place]));
            let mut beyond = limits;
            beyond[place] *= 1.0 + 1e-6;
            assert_eq!(
                sensor
                    .command(&command(beyond))
                    .unwrap_err()
                    .cause()
                    .label(),
                "outside joint limits"
            );
        }
    }
    assert_eq!(sensor.commands().refused(Cause::OutsideLimits), 14);
}

#[test]
fn no_command_is_taken_before_the_robot_has_spoken() {
    let (_, datagram) = all().find(|(name, _)| *name == "sensor_joints").unwrap();
    let mut adapter = robot_adapter(Axes::Six, RobotWare::Six);
    assert_eq!(adapter.decode(&datagram), Err(Refusal::NoSession));
    assert_eq!(adapter.received().refused(Cause::NoSession), 1);
    let mut adapter = sensor_adapter(Axes::Six, AT_ONCE);
    assert_eq!(
        adapter.command(&command(RIGHT_START_RAD)),
        Err(Refusal::NoSession)
    );
    assert!(!adapter.poll_transmit(Instant::ZERO, &mut Vec::new()));
}
