//! Tests of [`super`].

use super::*;

/// A key: its name, its least and greatest value, how to set and where to find it.
struct Key {
    name: &'static str,
    range: [f64; 2],
    set: fn(&mut EgmParameters, f64),
    read: fn(&ControllerSettings) -> f64,
}

macro_rules! key {
    ($name:ident, $min:literal, $max:literal, $number:ident => $as_written:expr, $read:expr) => {
        Key {
            name: stringify!($name),
            range: [$min, $max],
            set: |keys, $number| keys.$name = Some($as_written),
            read: $read,
        }
    };
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "small counts of a test; what is below zero becomes zero"
)]
#[rustfmt::skip]
fn keys() -> [Key; 15] {
    [
        key!(cycle_us, 1000.0, 100_000.0, x => x, |s| s.cycle.as_secs_f64() * 1e6),
        key!(queue_capacity, 1.0, 100_000.0, x => x as u32, |s| s.queue_capacity as f64),
        key!(position_gain_per_s, 0.0, 20.0, x => x, |s| s.position_gain_per_s),
        key!(low_pass_hz, 0.0, 100.0, x => x, |s| s.low_pass_hz),
        key!(position_correction_ratio, 0.0, 1.0, x => x, |s| s.position_correction_ratio),
        key!(ramp_in_s, 0.0, 10.0, x => x, |s| s.ramp_in_s),
        key!(ramp_out_s, 0.0, 10.0, x => x, |s| s.ramp_out_s),
        key!(max_speed_deviation_deg_per_s, 0.01, 1000.0, x => x,
            |s| s.max_speed_deviation_rad_per_s.to_degrees()),
        key!(max_position_deviation_deg, 0.1, 1000.0, x => x,
            |s| s.max_position_deviation_rad.to_degrees()),
        key!(convergence_deg, 0.001, 100.0, x => x, |s| s.convergence_rad.to_degrees()),
        key!(condition_time_s, 0.0, 1e6, x => x, |s| s.condition_time_s),
        key!(comm_timeout_s, 0.004, 1e6, x => x, |s| s.comm_timeout_s),
        key!(restart_wait_s, 0.0, 60.0, x => x, |s| s.restart_wait_s),
        key!(activation_s, 0.0, 60.0, x => x, |s| s.activation_s),
        key!(control_delay_cycles, 0.0, 16.0, x => x as u32, |s| s.control_delay_cycles as f64),
    ]
}

fn with(key: &Key, value: f64) -> Result<ControllerSettings, ParameterError> {
    let mut parameters = EgmParameters::default();
    (key.set)(&mut parameters, value);
    parameters.settings()
}

#[test]
fn each_number_is_taken_to_both_ends_of_its_range() {
    for key in keys() {
        for value in key.range {
            let settings = with(&key, value).unwrap();
            let read = (key.read)(&settings);
            assert!((read - value).abs() <= 1e-9 * value, "{}: {read}", key.name);
        }
    }
}

#[test]
fn each_number_outside_its_range_is_refused_by_its_key() {
    for key in keys() {
        let [min, max] = key.range;
        let is_count = ["queue_capacity", "control_delay_cycles"].contains(&key.name);
        let (below, above) = if is_count {
            (min - 1.0, max + 1.0)
        } else {
            (min - 1e-6, max * 1.000_001)
        };
        for value in [below, above, f64::NAN, f64::INFINITY] {
            // A count has no sign and no NaN.
            if is_count && (!value.is_finite() || value < 0.0) {
                continue;
            }
            let error = with(&key, value).unwrap_err();
            assert_eq!(error.key, key.name);
            assert!(error.to_string().contains(" to "), "{error}");
        }
    }
}

#[test]
fn a_key_changes_only_its_own_setting() {
    let preset = ControllerSettings::of(Preset::default());
    for key in keys() {
        let changed = with(&key, key.range[0]).unwrap();
        for other in keys().iter().filter(|other| other.name != key.name) {
            let (a, b) = ((other.read)(&preset), (other.read)(&changed));
            assert_eq!(a.to_bits(), b.to_bits(), "{} by {}", other.name, key.name);
        }
    }
}

#[test]
fn choices_override_the_presets() {
    let parameters = EgmParameters {
        preset: Preset::AbbDefault,
        queue: Some(QueuePolicy::Latest),
        stop_mode: Some(StopMode::RampDown),
        start: Some(StartMode::PowerOn),
        restart: Some(RestartPolicy::GoHomeFirst),
        ..EgmParameters::default()
    };
    let settings = parameters.settings().unwrap();
    assert_eq!(
        settings,
        ControllerSettings {
            queue: QueuePolicy::Latest,
            stop_mode: StopMode::RampDown,
            start: StartMode::PowerOn,
            restart: RestartPolicy::GoHomeFirst,
            ..ControllerSettings::of(Preset::AbbDefault)
        }
    );
}

#[test]
fn without_keys_a_preset_is_itself() {
    for preset in [
        Preset::AbbDefault,
        Preset::Raw,
        Preset::KthYumi,
        Preset::Paper,
    ] {
        let parameters = EgmParameters {
            preset,
            ..EgmParameters::default()
        };
        assert_eq!(
            parameters.settings().unwrap(),
            ControllerSettings::of(preset)
        );
    }
}

#[test]
fn the_real_controllers_cycle_is_exact() {
    let parameters = EgmParameters {
        cycle_us: Some(4032.0),
        ..EgmParameters::default()
    };
    let settings = parameters.settings().unwrap();
    assert_eq!(settings.cycle, Duration::from_micros(4032));
}

#[test]
fn a_session_keeps_every_setting_it_does_not_ask_to_change() {
    for preset in [Preset::AbbDefault, Preset::Raw, Preset::Paper] {
        let settings = ControllerSettings::of(preset);
        assert_eq!(settings.with(&EgmStartParameters::KEEP), Ok(settings));
    }
}

#[test]
fn a_session_may_ask_for_what_a_key_may_be_and_no_more() {
    type Field = fn(&mut EgmStartParameters) -> &mut f64;
    let fields: [(Field, [f64; 2]); 8] = [
        (|asked| &mut asked.comm_timeout_s, [0.004, 1e6]),
        (|asked| &mut asked.condition_time_s, [0.0, 1e6]),
        (
            |asked| &mut asked.max_speed_deviation_rad_per_s,
            [0.01_f64.to_radians(), 1000_f64.to_radians()],
        ),
        (
            |asked| &mut asked.max_position_deviation_rad,
            [0.1_f64.to_radians(), 1000_f64.to_radians()],
        ),
        (|asked| &mut asked.ramp_in_s, [0.0, 10.0]),
        (|asked| &mut asked.position_correction_ratio, [0.0, 1.0]),
        (|asked| &mut asked.position_gain_per_s, [0.0, 20.0]),
        (|asked| &mut asked.low_pass_hz, [0.0, 100.0]),
    ];
    let settings = ControllerSettings::of(Preset::Paper);
    for (field, range) in fields {
        for value in range {
            let mut asked = EgmStartParameters::KEEP;
            *field(&mut asked) = value;
            assert_ne!(settings.with(&asked), Err(MotionRefusal::BadNumber));
        }
        for value in [range[0] - 1e-3, range[1] * 1.001, f64::INFINITY] {
            let mut asked = EgmStartParameters::KEEP;
            *field(&mut asked) = value;
            assert_eq!(settings.with(&asked), Err(MotionRefusal::BadNumber));
        }
    }
}

const PRESETS: [Preset; 4] = [
    Preset::AbbDefault,
    Preset::Raw,
    Preset::KthYumi,
    Preset::Paper,
];

#[test]
fn a_preset_spelled_out_is_the_same_to_the_last_bit() {
    for preset in PRESETS {
        let parameters = EgmParameters {
            preset,
            comm_timeout_s: Some(0.3),
            ..EgmParameters::default()
        };
        let spelled_out = parameters.spelled_out();
        assert_eq!(spelled_out.settings(), parameters.settings());
        assert_eq!(spelled_out.spelled_out(), spelled_out);
        assert_eq!(spelled_out.comm_timeout_s, Some(0.3));
        // No longer the preset's doing.
        let elsewhere = EgmParameters {
            preset: Preset::Paper,
            ..spelled_out.clone()
        };
        let cycle_us = elsewhere.cycle_us.unwrap();
        assert!((cycle_us - 4000.0).abs() < 1e-12, "{cycle_us}");
        let speed_deg = spelled_out.max_speed_deviation_deg_per_s.unwrap();
        assert!((speed_deg - speed_deg.round()).abs() < 1e-12, "{speed_deg}");
    }
}

#[test]
fn every_key_in_force_is_spelled_out() {
    let parameters = EgmParameters::default();
    let written = format!("{:?}", parameters.spelled_out());
    assert!(!written.contains("None"), "{written}");
    let never_waits = EgmParameters {
        restart: Some(RestartPolicy::AutoRetry),
        ..EgmParameters::default()
    };
    let never_waits = never_waits.spelled_out();
    assert_eq!(never_waits.restart_wait_s, None);
    assert!(never_waits.settings().is_ok());
}

#[test]
fn a_wait_is_refused_where_nothing_waits() {
    for restart in [
        RestartPolicy::AutoRetry,
        RestartPolicy::ExternalTrigger,
        RestartPolicy::GoHomeFirst,
    ] {
        let parameters = EgmParameters {
            restart: Some(restart),
            restart_wait_s: Some(1.0),
            ..EgmParameters::default()
        };
        let error = parameters.settings().unwrap_err();
        assert_eq!(error.key, "restart_wait_s");
        assert!(error.problem.contains("wait_then_restart"), "{error}");
    }
}
