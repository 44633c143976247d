//! Our codec against the bytes of programs nobody here wrote; see `testdata/README.md`.

#![allow(clippy::float_cmp, reason = "what was sent must come out unchanged")]

use super::messages::EgmSensorPathCorr;
use super::robot::{ForceForm, MciState, MotorState, RapidState};
use super::*;

const FILES: [&str; 4] = [
    include_str!("testdata/abbrobotegm.hex"),
    include_str!("testdata/abb_robot_client.hex"),
    include_str!("testdata/libegm.hex"),
    include_str!("testdata/robotware6.hex"),
];

/// Name and bytes of every datagram of a file.
pub(crate) fn datagrams(file: &str) -> impl Iterator<Item = (&str, Vec<u8>)> {
    file.lines().map(|line| {
        let (name, hex) = line.split_once(' ').unwrap();
        let digits = hex.as_bytes().chunks_exact(2);
        let byte = |pair: &[u8]| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap();
        (name, digits.map(byte).collect())
    })
}

/// Every datagram of every file.
pub(crate) fn all() -> impl Iterator<Item = (&'static str, Vec<u8>)> {
    FILES.into_iter().flat_map(datagrams)
}

fn one(file: usize, wanted: &str) -> Vec<u8> {
    let mut found = datagrams(FILES[file]).filter(|(name, _)| *name == wanted);
    found.next().unwrap().1
}

fn again(name: &str, datagram: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    if name.starts_with("robot") {
        encode(&decode_robot(datagram).unwrap(), &mut bytes);
    } else if name.starts_with("path") {
        let message: EgmSensorPathCorr = decode_path_correction(datagram).unwrap();
        encode(&message, &mut bytes);
    } else {
        encode(&decode_sensor(datagram).unwrap(), &mut bytes);
    }
    bytes
}

#[test]
fn every_datagram_of_every_client_comes_back_byte_for_byte() {
    let mut count = 0;
    for (name, datagram) in all() {
        assert_eq!(again(name, &datagram), datagram, "{name}");
        count += 1;
    }
    assert_eq!(count, 110);
}

#[test]
fn the_robots_release_is_told_by_its_fields() {
    let check = |file: usize, name: &str, expected: Release| {
        let robot = decode_robot(&one(file, name)).unwrap();
        assert_eq!(robot.release(), expected, "{name}");
    };
    for file in [0, 1] {
        check(file, "robot6_before_6_07", Release::Before6_07);
        check(file, "robot6_from_6_07", Release::From6_07);
        check(file, "robot6_from_6_10", Release::From6_10);
        check(file, "robot7_from_6_10", Release::From6_10);
        check(file, "robot6_release_7", Release::RobotWare7);
        check(file, "robot7_release_7", Release::RobotWare7);
    }
    check(3, "robot7_release_6_force", Release::From6_10);
    check(3, "robot7_release_6_no_utilization", Release::From6_07);
    check(3, "robot7_release_6_empty_force", Release::From6_10);
}

#[test]
fn both_forms_of_the_measured_force_are_read() {
    let force = |file: usize, name: &str| {
        let robot = decode_robot(&one(file, name)).unwrap();
        robot.measured_force.unwrap()
    };
    let old = force(3, "robot7_release_6_force");
    assert_eq!((old.form, old.fc_active), (ForceForm::RobotWare6, None));
    assert_eq!(old.force, [1.0, -2.0, 3.0, -4.0, 5.0, -6.5]);
    let new = force(0, "robot7_release_7");
    assert_eq!(
        (new.form, new.fc_active),
        (ForceForm::RobotWare7, Some(true))
    );
    assert_eq!(new.force, [1.0, 2.0, 3.0, 4.0, 5.0, 6.5]);
}

#[test]
fn every_field_of_a_robots_message_is_where_it_belongs() {
    let robot = decode_robot(&one(0, "robot7_release_7")).unwrap();
    let header = robot.header.unwrap();
    assert_eq!((header.seqno, header.tm), (Some(70_000), Some(380_000)));
    assert_eq!(header.mtype(), MessageType::Data);
    assert_eq!(robot.motor_state.unwrap().state(), MotorState::On);
    assert_eq!(robot.mci_state.unwrap().state(), MciState::Running);
    assert_eq!(robot.rapid_exec_state.unwrap().state(), RapidState::Running);
    assert_eq!(robot.mci_convergence_met, Some(false));
    assert_eq!(
        (robot.utilization_rate, robot.move_index),
        (Some(12.5), Some(300))
    );
    assert_eq!(robot.test_signals.unwrap().signals, [1.5, -2.25]);
    let collision = robot.collision_info.unwrap();
    assert_eq!(collision.collision_triggered, Some(false));
    assert_eq!(collision.coll_det_quota, [0.1; 6]);
    let signals = robot.rapid_from_robot.unwrap();
    assert_eq!(
        (signals.dig_val, &*signals.dnum),
        (Some(true), &[1.0, 2.0, -3.0][..])
    );
    assert_eq!(robot.torque_ref.unwrap().joints, [0.25; 7]);
    let planned = robot.planned.unwrap();
    assert_eq!(planned.time.unwrap().sec, 1_700_000_280);
    assert_eq!(planned.time_stamp.unwrap().nsec, Some(123_456_789));
    assert_eq!(planned.external_joints.unwrap().joints, [-49.3 + 0.125]);
    let pose = robot.feed_back.unwrap().cartesian.unwrap();
    assert_eq!(pose.pos.unwrap().y, -160.75);
    assert_eq!(pose.orient.unwrap().u3, -0.5);
    assert_eq!(pose.euler.unwrap().z, 179.5);
}

#[test]
fn every_field_of_a_sensors_message_is_where_it_belongs() {
    let sensor = decode_sensor(&one(2, "libegm_7_speed_128")).unwrap();
    let header = sensor.header.unwrap();
    assert_eq!((header.seqno, header.tm), (Some(128), Some(0)));
    assert_eq!(header.mtype(), MessageType::Correction);
    let planned = sensor.planned.unwrap();
    assert_eq!(planned.joints.unwrap().joints.len(), 6);
    assert_eq!(planned.external_joints.unwrap().joints.len(), 1);
    assert!(planned.cartesian.unwrap().euler.is_some());
    let speed = sensor.speed_ref.unwrap();
    assert_eq!(speed.joints.unwrap().joints.len(), 6);
    assert_eq!(speed.external_joints.unwrap().joints.len(), 1);
    assert_eq!(speed.cartesians.unwrap().value, [0.0; 6]);
    let sensor = decode_sensor(&one(0, "sensor_rapid_data")).unwrap();
    assert_eq!(sensor.rapid_to_robot.unwrap().dnum.len(), 40);
    let path = decode_path_correction(&one(0, "path_correction")).unwrap();
    let correction = path.path_corr.unwrap();
    assert_eq!((correction.pos.z, correction.age), (0.5, 1));
}

#[test]
fn a_missing_required_number_is_not_a_number() {
    // A pose whose position has x only.
    let datagram = [
        0x12, 0x0d, 0x12, 0x0b, 0x0a, 0x09, 0x09, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
    ];
    let pose = decode_sensor(&datagram)
        .unwrap()
        .planned
        .unwrap()
        .cartesian
        .unwrap();
    let pos = pose.pos.unwrap();
    assert_eq!(pos.x, 1.0);
    assert!(pos.y.is_nan() && pos.z.is_nan());
}

#[test]
fn what_is_not_kept_is_only_what_is_documented() {
    let mut bytes = Vec::new();
    // A field 15 no message has, after a header with number 1.
    let unknown = [0x0a, 0x02, 0x08, 0x01, 0x78, 0x05];
    encode(&decode_sensor(&unknown).unwrap(), &mut bytes);
    assert_eq!(bytes, unknown[..4]);
    // A packed list of two numbers: taken, and sent again unpacked.
    let mut packed = vec![0x12, 0x14, 0x0a, 0x12, 0x0a, 0x10];
    packed.extend([1.0_f64, 2.0].map(f64::to_le_bytes).concat());
    let sensor = decode_sensor(&packed).unwrap();
    encode(&sensor, &mut bytes);
    assert_eq!(decode_sensor(&bytes).unwrap(), sensor);
    assert_eq!(sensor.planned.unwrap().joints.unwrap().joints, [1.0, 2.0]);
    assert_ne!(bytes, packed);
}

#[test]
fn what_is_no_message_is_refused() {
    let cut = &one(0, "sensor_joints")[..30];
    assert!(matches!(decode_sensor(cut), Err(Refusal::NotProtobuf)));
    let long = vec![0; DATAGRAM_BYTES_MAX + 1];
    let length_bytes = long.len();
    assert_eq!(decode_robot(&long), Err(Refusal::TooLong { length_bytes }));
    assert_eq!(
        message_type(&one(0, "path_correction")),
        Some(MessageType::PathCorrection)
    );
    assert_eq!(message_type(cut), None);
}
