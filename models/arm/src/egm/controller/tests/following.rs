//! How well the joints follow: lag and error of the control law, limits, the measured joints'
//! delay.

use super::rig::{AMPLITUDE_RAD, PERIOD_S, Rig, is_still, open_settings, standing, swing};
use crate::egm::controller::DELAY_CYCLES_MAX;
use crate::egm::messages::EgmFeedback;
use crate::egm::parameters::ControllerSettings;
use crate::yumi::JOINT_COUNT;
use crate::yumi::arm::{POSITION_MAX_RAD, RIGHT_START_RAD, SPEED_MAX_RAD_PER_S};

/// Lag (ms) and largest error as a share of the amplitude of the measured joints, for the third
/// loop of a sine commanded at 125 Hz. The lag is the phase of the first harmonic.
fn follow(settings: ControllerSettings, has_speed: bool) -> (f64, f64) {
    let mut rig = Rig::new(settings);
    let (mut in_phase, mut quadrature, mut error_max) = (0.0, 0.0, 0.0_f64);
    for cycle in 0..3025_i64 {
        let time_s = rig.next_s();
        let command = swing(time_s, has_speed);
        if cycle % 2 == 0 && cycle > 0 {
            // There just before its cycle, so that only the law's own lag shows.
            rig.receive_at(rig.next_at().as_ns() - 1, &command);
        }
        let feedback = rig.step();
        if cycle >= 2017 {
            let moved = feedback.measured_rad[0] - RIGHT_START_RAD[0];
            let angle = core::f64::consts::TAU * time_s / PERIOD_S;
            in_phase += moved * angle.sin();
            quadrature += moved * angle.cos();
            error_max = error_max.max((command.position_rad[0] - feedback.measured_rad[0]).abs());
        }
    }
    let lag_s = (-quadrature).atan2(in_phase) * PERIOD_S / core::f64::consts::TAU;
    (lag_s * 1e3, error_max / AMPLITUDE_RAD)
}

fn gain(position_gain_per_s: f64) -> ControllerSettings {
    ControllerSettings {
        position_gain_per_s,
        ..open_settings()
    }
}

#[test]
fn the_default_gain_lags_195_ms_and_misses_by_30_percent() {
    let (lag_ms, error) = follow(gain(5.0), false);
    assert!((lag_ms - 195.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.299).abs() <= 0.01, "{error}");
}

#[test]
fn the_highest_gain_lags_50_ms_and_misses_by_8_percent() {
    let (lag_ms, error) = follow(gain(20.0), false);
    assert!((lag_ms - 50.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.078).abs() <= 0.005, "{error}");
}

#[test]
fn the_joints_own_speed_in_the_command_leaves_less_than_a_percent() {
    for position_gain_per_s in [5.0, 20.0] {
        let (_, error) = follow(gain(position_gain_per_s), true);
        assert!(error < 0.01, "{error} at gain {position_gain_per_s}");
    }
}

#[test]
fn the_measured_joints_lag_the_planned_ones_by_exactly_the_delay() {
    for control_delay_cycles in [0, 1, 4, DELAY_CYCLES_MAX] {
        let settings = ControllerSettings {
            control_delay_cycles,
            ..open_settings()
        };
        let mut rig = Rig::new(settings);
        let feedback = rig.drive(3.0, 2, |time_s| Some(swing(time_s, false)));
        for (now, ago) in feedback[control_delay_cycles..].iter().zip(&feedback) {
            assert_eq!(
                now.measured_rad.map(f64::to_bits),
                ago.planned_rad.map(f64::to_bits)
            );
        }
    }
    let (without_ms, _) = follow(gain(20.0), false);
    let delayed = ControllerSettings {
        control_delay_cycles: 4,
        ..gain(20.0)
    };
    let (with_ms, _) = follow(delayed, false);
    assert!(
        (with_ms - without_ms - 16.0).abs() < 0.1,
        "{with_ms} {without_ms}"
    );
}

#[test]
fn speed_and_position_limits_hold() {
    let mut rig = Rig::new(open_settings());
    let mut command = standing();
    command.position_rad = POSITION_MAX_RAD;
    command.flags = crate::egm::messages::EgmCommand::HAS_SPEED;
    // Pushes on beyond the limit.
    command.speed_rad_per_s = [1.0; JOINT_COUNT];
    let feedback = rig.drive(8.0, 1, |_| Some(command));
    let mut flags = 0;
    for pair in feedback.windows(2) {
        flags |= pair[1].flags;
        for joint in 0..JOINT_COUNT {
            let speed = (pair[1].planned_rad[joint] - pair[0].planned_rad[joint]) / 0.004;
            assert!(speed <= SPEED_MAX_RAD_PER_S[joint] * (1.0 + 1e-9));
            assert!(pair[1].planned_rad[joint] <= POSITION_MAX_RAD[joint]);
        }
    }
    assert_ne!(flags & EgmFeedback::SPEED_LIMITED, 0);
    assert_eq!(flags & EgmFeedback::SPEED_DEVIATION_LIMITED, 0);
    assert_ne!(
        feedback.last().unwrap().flags & EgmFeedback::AT_POSITION_LIMIT,
        0
    );
}

#[test]
fn an_absurd_speed_moves_no_faster_than_the_limits_and_poisons_nothing() {
    let mut rig = Rig::new(open_settings());
    let mut command = standing();
    command.flags = crate::egm::messages::EgmCommand::HAS_SPEED;
    command.speed_rad_per_s[0] = f64::MAX;
    let feedback = rig.drive(1.0, 1, |_| Some(command));
    assert!(
        feedback
            .iter()
            .all(|f| f.planned_rad.iter().all(|q| q.is_finite()))
    );
    let feedback = rig.drive(5.0, 1, |_| Some(standing()));
    assert!(is_still(
        &feedback.last().unwrap().planned_rad,
        &RIGHT_START_RAD
    ));
}

#[test]
fn pure_speed_control_keeps_moving_when_its_client_falls_silent() {
    let settings = ControllerSettings {
        position_correction_ratio: 0.0,
        low_pass_hz: 0.0,
        ..open_settings()
    };
    let mut rig = Rig::new(settings);
    let mut command = standing();
    command.flags = crate::egm::messages::EgmCommand::HAS_SPEED;
    command.speed_rad_per_s = [0.1; JOINT_COUNT];
    rig.drive(0.1, 1, |_| Some(command));
    let before = rig.feedback();
    let after = *rig.silence(1.1).last().unwrap();
    for joint in 0..JOINT_COUNT {
        let moved = after.planned_rad[joint] - before.planned_rad[joint];
        assert!((moved - 0.1).abs() < 1e-9, "{moved}");
    }
    assert!(after.has(EgmFeedback::HOLDING));
}

#[test]
fn the_share_of_the_correction_grows_over_the_ramp() {
    let ramped = ControllerSettings {
        ramp_in_s: 0.5,
        ..open_settings()
    };
    let mut away = standing();
    away.position_rad[0] += 0.05;
    let progress = |settings| {
        let mut rig = Rig::new(settings);
        let feedback = rig.drive(0.1, 1, |_| Some(away));
        feedback.last().unwrap().planned_rad[0] - RIGHT_START_RAD[0]
    };
    let (slow, fast) = (progress(ramped), progress(open_settings()));
    assert!(slow > 0.0 && slow < 0.25 * fast, "{slow} {fast}");
}
