//! Tests of [`super`]; the reference poses are data, so they stand apart.

use super::*;
use hil_core::random::RandomStream;

/// Ten poses of one arm as published with rpiRobotics/yumi-ik (BSD-3-Clause), taken there from
/// RobotStudio: seven joint angles (degrees, chain order), position (mm), then roll, pitch and
/// yaw (degrees) with R = Rz(yaw) Ry(pitch) Rx(roll).
const ROBOTSTUDIO_POSES: [[f64; 13]; 10] = [
    [
        0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 341.5, 0.0, 598.0, 0.0, 90.0, 0.0,
    ],
    [
        20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 292.46, 234.73, 348.75, 148.67, 16.13, 175.45,
    ],
    [
        30.0, 30.0, 30.0, 30.0, 30.0, 30.0, 30.0, 165.49, 290.86, 255.37, 157.34, -19.80, -175.99,
    ],
    [
        -40.0, -40.0, -40.0, -40.0, -40.0, -40.0, -40.0, -219.17, 12.62, 796.12, 13.67, -3.39,
        -152.29,
    ],
    [
        -80.0, -80.0, -80.0, -80.0, -80.0, -80.0, -80.0, -126.60, 499.23, 441.88, 5.30, 17.08,
        34.27,
    ],
    [
        104.0, -31.0, 1.0, -18.0, -55.0, 117.0, 69.0, 32.02, 91.43, 763.94, 157.59, 43.43, 170.70,
    ],
    [
        162.0, 1.0, -23.0, -88.0, 241.0, 98.0, -44.0, 45.84, 32.22, 846.74, -98.58, 43.30, -76.21,
    ],
    [
        -20.0, -139.0, -144.0, 77.0, -263.0, 128.0, -104.0, -47.12, -136.89, 270.77, -106.88,
        -60.36, 122.56,
    ],
    [
        67.0, -142.0, 121.0, 78.0, -38.0, 113.0, -194.0, -100.23, 3.25, 338.01, 43.05, -59.81,
        44.29,
    ],
    [
        -58.0, -138.0, -35.0, 70.0, -283.0, 133.0, 207.0, -123.66, 141.01, 425.04, -118.25, -37.89,
        -10.09,
    ],
];

#[test]
fn the_ten_robotstudio_poses_are_met_within_a_hundredth() {
    let chain = Chain::new(BASE_TO_FIRST_JOINT_M);
    for row in &ROBOTSTUDIO_POSES {
        let q: Joints = core::array::from_fn(|joint| row[joint].to_radians());
        let tool = *chain.at(&q).tool();
        let published_m = Vector3::new(row[7], row[8], row[9]) * 1e-3;
        let error_mm = 1e3 * (tool.translation.vector - published_m).norm();
        let [roll, pitch, yaw] = [row[10], row[11], row[12]].map(f64::to_radians);
        let published = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let error_deg = tool.rotation.angle_to(&published).to_degrees();
        assert!(error_mm <= 0.01, "{error_mm} mm at {row:?}");
        assert!(error_deg <= 0.01, "{error_deg} deg at {row:?}");
    }
}

#[test]
fn the_jacobian_is_the_derivative_of_the_pose() {
    let chain = Chain::new(MOUNT_TO_FIRST_JOINT_M);
    let mut stream = RandomStream::new(5, "jacobian");
    for _ in 0..100 {
        let q: Joints = core::array::from_fn(|joint| {
            let (min, max) = (POSITION_MIN_RAD[joint], POSITION_MAX_RAD[joint]);
            min + (max - min) * stream.uniform()
        });
        let jacobian = chain.at(&q).jacobian();
        for joint in 0..JOINT_COUNT {
            let step = 1e-6;
            let (mut before, mut after) = (q, q);
            before[joint] -= step;
            after[joint] += step;
            let (before, after) = (*chain.at(&before).tool(), *chain.at(&after).tool());
            let linear = after.translation.vector - before.translation.vector;
            let angular = (after.rotation * before.rotation.inverse()).scaled_axis();
            let column = stacked(&linear, &angular) * (0.5 / step);
            assert!((column - jacobian.column(joint)).norm() < 1e-6);
        }
    }
}

#[test]
fn the_start_posture_puts_the_right_tool_in_front_of_the_body() {
    let tool = Arm::right().tool(&RIGHT_START_RAD);
    let published_m = Vector3::new(0.448, -0.161, 0.122);
    let apart_m = (tool.translation.vector - published_m).norm();
    assert!(apart_m < 1e-3, "{tool:?}");
}

#[test]
fn the_left_start_mirrors_the_right_as_far_as_the_mounts_do() {
    let right = Arm::right().tool(&RIGHT_START_RAD).translation;
    let left = Arm::left().tool(&LEFT_START_RAD).translation;
    let mirrored = Vector3::new(right.x, -right.y, right.z);
    // The two published mounting rotations differ by a few thousandths of a radian.
    assert!((left.vector - mirrored).norm() < 5e-3, "{left:?} {right:?}");
}

#[test]
fn the_right_mount_is_a_rotation_as_near_as_its_four_digits_allow() {
    let rotation = Arm::right().mount.rotation;
    assert!((rotation.norm() - 1.0).abs() < 1e-15);
    let apart = rotation.to_rotation_matrix().into_inner() - RIGHT_MOUNT;
    assert!(apart.amax() < 1e-4, "{apart}");
}

#[test]
fn body_and_mount_frames_are_there_and_back() {
    let arm = Arm::left();
    let tool = *arm.chain().at(&LEFT_START_RAD).tool();
    let back = arm.from_body(&arm.tool(&LEFT_START_RAD));
    assert!((back.translation.vector - tool.translation.vector).norm() < 1e-15);
    assert!(back.rotation.angle_to(&tool.rotation) < 1e-15);
}

#[test]
fn start_postures_stay_clear_of_the_limits() {
    for start in [RIGHT_START_RAD, LEFT_START_RAD].map(JointVector::from) {
        assert!(!within_limits(&start).1);
        let (inside, is_clipped) = within_limits(&(start * 100.0));
        assert!(is_clipped && !within_limits(&inside).1);
    }
}
