//! Tests of [`super`].

use super::*;
use crate::yumi::arm::{POSITION_MAX_RAD, RIGHT_START_RAD, SPEED_MAX_RAD_PER_S};

const CYCLE: Duration = Duration::from_millis(4);
const PERIOD_S: f64 = 4.033;
const AMPLITUDE_RAD: f64 = 0.3;

fn settings(gain_per_s: f64) -> ServoSettings {
    ServoSettings {
        gain_per_s,
        low_pass_hz: 20.0,
        cycle: CYCLE,
    }
}

fn sine(time_s: f64, feed_forward: bool) -> ArmCommand {
    let omega = core::f64::consts::TAU / PERIOD_S;
    let mut command = ArmCommand {
        position_rad: RIGHT_START_RAD,
        speed_rad_per_s: [0.0; JOINT_COUNT],
    };
    command.position_rad[0] += AMPLITUDE_RAD * (omega * time_s).sin();
    if feed_forward {
        command.speed_rad_per_s[0] = AMPLITUDE_RAD * omega * (omega * time_s).cos();
    }
    command
}

/// Lag (ms) and largest error as a share of the amplitude, for the third loop of a sine commanded
/// at 125 Hz. The lag is the phase of the first harmonic.
fn follow(gain_per_s: f64, feed_forward: bool) -> (f64, f64) {
    let mut servo = Servo::new(settings(gain_per_s), RIGHT_START_RAD);
    let (mut in_phase, mut quadrature, mut error_max) = (0.0, 0.0, 0.0_f64);
    for cycle in 0..3025_i32 {
        let now = Instant::from_ns(i64::from(cycle) * 4_000_000);
        let time_s = now.seconds_since(Instant::ZERO);
        servo.advance(now);
        if cycle >= 2017 {
            let moved = servo.q_rad()[0] - RIGHT_START_RAD[0];
            let angle = core::f64::consts::TAU * time_s / PERIOD_S;
            in_phase += moved * angle.sin();
            quadrature += moved * angle.cos();
            let desired = sine(time_s, false).position_rad[0];
            error_max = error_max.max((desired - servo.q_rad()[0]).abs());
        }
        if cycle % 2 == 0 {
            servo.set_reference(&sine(time_s, feed_forward));
        }
    }
    let lag_s = (-quadrature).atan2(in_phase) * PERIOD_S / core::f64::consts::TAU;
    (lag_s * 1e3, error_max / AMPLITUDE_RAD)
}

#[test]
fn the_default_gain_lags_195_ms_and_misses_by_30_percent() {
    let (lag_ms, error) = follow(5.0, false);
    assert!((lag_ms - 195.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.299).abs() <= 0.01, "{error}");
}

#[test]
fn the_highest_gain_lags_50_ms_and_misses_by_8_percent() {
    let (lag_ms, error) = follow(20.0, false);
    assert!((lag_ms - 50.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.078).abs() <= 0.005, "{error}");
}

#[test]
fn feed_forward_misses_by_less_than_a_percent() {
    for gain_per_s in [5.0, 20.0] {
        let (lag_ms, error) = follow(gain_per_s, true);
        assert!(error < 0.01, "{error} at gain {gain_per_s}, {lag_ms} ms");
    }
}

#[test]
fn silence_holds_the_last_reference() {
    let mut servo = Servo::new(settings(5.0), RIGHT_START_RAD);
    let reference = sine(1.0, false);
    servo.set_reference(&reference);
    servo.advance(Instant::from_ns(60_000_000_000));
    for (q, wanted) in servo.q_rad().iter().zip(&reference.position_rad) {
        assert!((q - wanted).abs() < 1e-9);
    }
}

#[test]
fn a_late_cycle_moves_as_far_as_the_cycles_it_replaces() {
    let (mut punctual, mut late) = (
        Servo::new(settings(20.0), RIGHT_START_RAD),
        Servo::new(settings(20.0), RIGHT_START_RAD),
    );
    for servo in [&mut punctual, &mut late] {
        servo.set_reference(&sine(1.0, false));
    }
    for cycle in 1..=50 {
        punctual.advance(Instant::from_ns(cycle * 4_000_000));
    }
    late.advance(Instant::from_ns(200_000_000));
    for (punctual, late) in punctual.q_rad().iter().zip(late.q_rad()) {
        assert!((punctual - late).abs() < 1e-12);
    }
}

#[test]
fn speed_and_position_limits_hold() {
    let mut servo = Servo::new(settings(20.0), RIGHT_START_RAD);
    servo.set_reference(&ArmCommand {
        position_rad: [100.0; JOINT_COUNT],
        speed_rad_per_s: [0.0; JOINT_COUNT],
    });
    let mut before = *servo.q_rad();
    let mut was_speed_limited = false;
    for cycle in 1..=2000 {
        servo.advance(Instant::from_ns(cycle * 4_000_000));
        was_speed_limited |= servo.is_speed_limited();
        for joint in 0..JOINT_COUNT {
            let speed = (servo.q_rad()[joint] - before[joint]) / 0.004;
            assert!(speed <= SPEED_MAX_RAD_PER_S[joint] * (1.0 + 1e-9));
            assert!(servo.q_rad()[joint] <= POSITION_MAX_RAD[joint]);
        }
        before = *servo.q_rad();
    }
    assert!(was_speed_limited && servo.is_at_position_limit());
}

#[test]
fn gain_zero_leaves_pure_speed_control() {
    let mut servo = Servo::new(
        ServoSettings {
            low_pass_hz: 0.0,
            ..settings(0.0)
        },
        RIGHT_START_RAD,
    );
    let mut reference = sine(1.0, false);
    reference.speed_rad_per_s = [0.1; JOINT_COUNT];
    servo.set_reference(&reference);
    servo.advance(Instant::from_ns(1_000_000_000));
    for (q, start) in servo.q_rad().iter().zip(&RIGHT_START_RAD) {
        assert!((q - start - 0.1).abs() < 1e-9);
    }
}
