//! Commands that must not reach the servo, and that the joints depend on nothing but the arrivals.

use super::rig::{Rig, is_still, open_settings, standing, swing};
use crate::egm::messages::{
    CommandRefusal, EgmCommand, EgmEvent, EgmEventKind, EndCause, SessionState,
};
use crate::egm::parameters::{ControllerSettings, Preset, QueuePolicy, RestartPolicy, StartMode};
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// Hands `command` to a running session and gives what was said at once and told later.
fn refused(command: &EgmCommand) -> (Result<(), CommandRefusal>, Vec<EgmEvent>, Rig) {
    let mut rig = Rig::new(open_settings());
    rig.silence(0.1);
    let answer = rig
        .controller
        .receive(Instant::from_ns(rig.next_at().as_ns() - 1), command);
    rig.silence(1.0);
    let told = rig.of_kind(EgmEventKind::CommandRefused);
    (answer, told, rig)
}

#[test]
fn what_is_no_number_never_reaches_the_servo() {
    for nonsense in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut position = standing();
        position.position_rad[4] = nonsense;
        let mut speed = standing();
        speed.speed_rad_per_s[4] = nonsense;
        speed.flags = EgmCommand::HAS_SPEED;
        for command in [position, speed] {
            let (answer, told, rig) = refused(&command);
            assert_eq!(answer, Err(CommandRefusal::NotFinite));
            assert_eq!(rig.controller.command_counters().refused_not_finite, 1);
            assert_eq!(rig.controller.command_counters().taken, 0);
            assert!(is_still(rig.controller.measured_rad(), &RIGHT_START_RAD));
            let text = told[0].describe();
            assert!(text.contains("command refused: joint 4"), "{text}");
        }
        // A speed that is not meant may be anything.
        speed.flags = 0;
        assert_eq!(refused(&speed).0, Ok(()));
    }
}

#[test]
fn what_lies_outside_the_limits_is_refused_with_joint_value_and_limit() {
    let mut command = standing();
    command.position_rad[2] = POSITION_MAX_RAD[2] + 0.1;
    let (answer, told, rig) = refused(&command);
    assert_eq!(answer, Err(CommandRefusal::OutsideLimits));
    let text = told[0].describe();
    assert!(
        text.contains("174.23 deg for joint 7 is beyond its limit of 168.5 deg"),
        "{text}"
    );
    assert!(is_still(rig.controller.measured_rad(), &RIGHT_START_RAD));

    command.position_rad[2] = POSITION_MIN_RAD[2] - 0.1;
    let (_, told, _) = refused(&command);
    assert!(told[0].describe().contains("limit of -168.5 deg"));

    // The limit itself, as it comes back from degrees, is none.
    for limits in [POSITION_MIN_RAD, POSITION_MAX_RAD] {
        command.position_rad = limits.map(|q| q.to_degrees().to_radians());
        assert_eq!(refused(&command).0, Ok(()));
    }
}

#[test]
fn a_row_of_equal_refusals_is_told_once_and_counted_each() {
    let mut rig = Rig::new(open_settings());
    rig.silence(0.1);
    let mut bad = standing();
    bad.position_rad[0] = f64::NAN;
    for round in 0..30 {
        let at = Instant::from_ns(rig.next_at().as_ns() - 1);
        let is_bad = round == 15;
        let command = if is_bad { bad } else { standing() };
        let answer = rig.controller.receive(at, &command);
        assert_eq!(answer.is_err(), is_bad);
        rig.step();
    }
    for _ in 0..30 {
        let at = Instant::from_ns(rig.next_at().as_ns() - 1);
        assert!(rig.controller.receive(at, &bad).is_err());
        rig.step();
    }
    assert_eq!(rig.controller.command_counters().refused_not_finite, 31);
    assert_eq!(rig.of_kind(EgmEventKind::CommandRefused).len(), 2);
}

#[test]
fn without_a_session_nobody_takes_commands() {
    let asleep = ControllerSettings {
        start: StartMode::Request,
        ..open_settings()
    };
    let mut rig = Rig::new(asleep);
    rig.drive(1.0, 1, |time_s| Some(swing(time_s, false)));
    let counters = *rig.controller.command_counters();
    assert_eq!(counters.refused_no_session, counters.received);
    let told = rig.of_kind(EgmEventKind::CommandRefused);
    assert_eq!(told.len(), 1);
    assert_eq!(
        told[0].describe(),
        "right arm: command refused: guided motion does not run"
    );
    assert!(is_still(rig.controller.measured_rad(), &RIGHT_START_RAD));
}

#[test]
fn a_client_whose_every_message_is_refused_times_out_like_a_silent_one() {
    let patient = ControllerSettings {
        comm_timeout_s: 0.2,
        restart: RestartPolicy::ExternalTrigger,
        ..open_settings()
    };
    let mut rig = Rig::new(patient);
    let mut silent = rig.clone();
    let mut bad = standing();
    bad.position_rad[0] = f64::NAN;
    for _ in 0..250 {
        let at = Instant::from_ns(rig.next_at().as_ns() - 1);
        assert!(rig.controller.receive(at, &bad).is_err());
        rig.step();
        silent.step();
    }
    assert_eq!(rig.ends()[0].0, EndCause::CommTimeout);
    assert_eq!(rig.ends()[0].1.at_ns, silent.ends()[0].1.at_ns);
}

#[test]
fn messages_that_find_the_queue_full_still_show_that_the_client_lives() {
    let narrow = ControllerSettings {
        comm_timeout_s: 0.2,
        queue_capacity: 1,
        ..open_settings()
    };
    let mut rig = Rig::new(narrow);
    for _ in 0..250 {
        let at = Instant::from_ns(rig.next_at().as_ns() - 1);
        for _ in 0..2 {
            assert_eq!(rig.controller.receive(at, &standing()), Ok(()));
        }
        rig.step();
    }
    assert!(rig.controller.command_counters().dropped > 200);
    assert_eq!(rig.state(), SessionState::Running);
}

/// Arrivals of a client behind a bad network, good and bad ones, in bursts and with gaps.
fn wild_arrivals(seed: u64, until_ns: i64) -> Vec<(Instant, EgmCommand)> {
    let mut random = RandomStream::new(seed, "arrivals");
    let mut arrivals = Vec::new();
    let mut at_ns = 0;
    while at_ns < until_ns {
        #[allow(clippy::cast_possible_truncation, reason = "below a second")]
        let step_ns = (random.uniform() * 8e6) as i64;
        at_ns += if random.chance(0.01) {
            400_000_000
        } else {
            step_ns
        };
        // Every now and then exactly at a grid point.
        if random.chance(0.1) {
            at_ns += 4_000_000 - at_ns % 4_000_000;
        }
        let burst = if random.chance(0.02) { 40 } else { 1 };
        for _ in 0..burst {
            let mut command = swing(at_ns as f64 * 1e-9, random.chance(0.5));
            if random.chance(0.02) {
                command.position_rad[3] = f64::NAN;
            }
            arrivals.push((Instant::from_ns(at_ns), command));
        }
    }
    arrivals
}

/// Bits of planned and measured joints at every cycle, and the events in words, when the driver
/// comes to the grid only every now and then: `batch()` cycles at a time, having handed over all
/// that arrived until then.
fn outputs(
    settings: ControllerSettings,
    arrivals: &[(Instant, EgmCommand)],
    mut batch: impl FnMut() -> i64,
) -> (Vec<u64>, Vec<String>) {
    let mut rig = Rig::new(settings);
    let (mut bits, mut next) = (Vec::new(), 0);
    while rig.next_s() < 20.0 {
        let cycles = batch();
        let now = Instant::from_ns(rig.next_at().as_ns() + (cycles - 1) * 4_000_000);
        while next < arrivals.len() && arrivals[next].0 <= now {
            let (at, command) = &arrivals[next];
            let answer = rig.controller.receive(*at, command);
            assert_eq!(answer.is_err(), command.position_rad[3].is_nan());
            next += 1;
        }
        for _ in 0..cycles {
            let feedback = rig.step();
            let joints = feedback.planned_rad.iter().chain(&feedback.measured_rad);
            bits.extend(joints.map(|q| q.to_bits()));
            bits.push(u64::from(feedback.flags) << 32 | u64::from(feedback.queue_count));
        }
    }
    bits.truncate(5000 * 15);
    let lines = rig.events.iter().filter(|event| event.cycle_index < 5000);
    (bits, lines.map(EgmEvent::describe).collect())
}

#[test]
fn equal_arrivals_give_equal_joints_however_late_they_are_handed_over() {
    for (queue, restart) in [
        (QueuePolicy::Fifo1, RestartPolicy::AutoRetry),
        (QueuePolicy::Latest, RestartPolicy::GoHomeFirst),
        (QueuePolicy::Fifo1, RestartPolicy::WaitThenRestart),
    ] {
        let settings = ControllerSettings {
            start: StartMode::PowerOn,
            queue,
            restart,
            queue_capacity: 30,
            comm_timeout_s: 0.2,
            restart_wait_s: 0.1,
            activation_s: 0.1,
            ..ControllerSettings::of(Preset::Paper)
        };
        for seed in 0..4 {
            let arrivals = wild_arrivals(seed, 21_000_000_000);
            let punctual = outputs(settings, &arrivals, || 1);
            let mut random = RandomStream::new(seed, "lateness");
            let late = outputs(settings, &arrivals, || {
                1 + i64::try_from(random.next_u64() % 40).unwrap()
            });
            assert!(punctual == late, "seed {seed}, {queue:?}, {restart:?}");
            let told = |word: &str| punctual.1.iter().filter(|line| line.contains(word)).count();
            assert!(told("CommTimeout") > 3 && told("command refused") > 3);
        }
    }
}
