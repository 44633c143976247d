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
    println!("k = 5: {lag_ms:.1} ms, {:.2} %", error * 100.0);
    assert!((lag_ms - 195.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.299).abs() <= 0.01, "{error}");
}

#[test]
fn the_highest_gain_lags_50_ms_and_misses_by_8_percent() {
    let (lag_ms, error) = follow(gain(20.0), false);
    println!("k = 20: {lag_ms:.1} ms, {:.2} %", error * 100.0);
    assert!((lag_ms - 50.0).abs() <= 8.0, "{lag_ms} ms");
    assert!((error - 0.078).abs() <= 0.005, "{error}");
}
