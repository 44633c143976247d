//! How sessions start, end and follow each other, and what is told about it.

use super::rig::{Rig, is_still, open_settings, standing, swing};
use crate::egm::controller::motion::home_rad;
use crate::egm::messages::{
    EgmEventKind, EgmFeedback, EgmStartParameters, EndCause, MotionKind, MotionRefusal,
    SessionState, Side,
};
use crate::egm::parameters::{ControllerSettings, Preset, RestartPolicy, StartMode, StopMode};
use crate::yumi::arm::{RIGHT_START_RAD, SPEED_MAX_RAD_PER_S};

/// The paper's preset with a power-on start.
fn settings(restart: RestartPolicy) -> ControllerSettings {
    ControllerSettings {
        start: StartMode::PowerOn,
        restart,
        ..ControllerSettings::of(Preset::Paper)
    }
}

/// Guided along the swing up to 5 s, then the client is killed.
fn killed(restart: RestartPolicy) -> Rig {
    let mut rig = Rig::new(settings(restart));
    rig.drive(5.0, 2, |time_s| Some(swing(time_s, false)));
    assert_eq!(rig.state(), SessionState::Running);
    rig
}

#[test]
fn a_killed_client_ends_the_session_after_the_time_out_and_the_robot_stands() {
    let mut rig = killed(RestartPolicy::ExternalTrigger);
    // In the middle of the cycle before the last one.
    let heard_s = rig.next_s() - 0.010;
    let feedback = rig.silence(8.0);
    let (cause, ended) = rig.ends()[0];
    assert_eq!(cause, EndCause::CommTimeout);
    let after_s = ended.at_ns as f64 * 1e-9 - heard_s;
    assert!((after_s - 1.0).abs() <= 0.004, "{after_s}");
    assert!((ended.value - 1.0).abs() <= 0.004, "{ended:?}");
    let text = ended.describe();
    assert!(
        text.starts_with("right arm: EGM session 1 ended: no message for 1.00"),
        "{text}"
    );
    assert!(text.ends_with("(CommTimeout = 1 s)"), "{text}");
    let last = feedback.last().unwrap();
    assert_eq!(last.session_state(), Some(SessionState::Idle));
    let stopped = &feedback[feedback.len() - 300..];
    assert!(
        stopped
            .iter()
            .all(|f| is_still(&f.measured_rad, &last.measured_rad))
    );
}

/// Seconds from the last session's end to the next one's first cycle, client back at once.
fn dead_time_s(rig: &mut Rig, until_s: f64) -> f64 {
    rig.silence(6.2);
    assert_eq!(rig.ends().len(), 1);
    rig.drive(until_s, 2, |time_s| Some(swing(time_s, false)));
    assert_eq!(rig.state(), SessionState::Running);
    let running = rig.of_kind(EgmEventKind::Running);
    assert_eq!(running.len(), 2);
    assert_eq!(running[1].session, 2);
    running[1].value
}

#[test]
fn each_restart_policy_has_its_dead_time() {
    let retry = dead_time_s(&mut killed(RestartPolicy::AutoRetry), 12.0);
    let wait = dead_time_s(&mut killed(RestartPolicy::WaitThenRestart), 12.0);
    assert!((retry - 0.5).abs() <= 0.004, "{retry}");
    assert!((wait - 2.0).abs() <= 0.004, "{wait}");

    let mut rig = killed(RestartPolicy::ExternalTrigger);
    rig.silence(9.0);
    assert_eq!(rig.state(), SessionState::Idle);
    rig.controller
        .start_guided_motion(&EgmStartParameters::KEEP)
        .unwrap();
    rig.silence(9.2);
    assert_eq!(rig.state(), SessionState::Activating);
    rig.drive(12.0, 2, |time_s| Some(swing(time_s, false)));
    let running = rig.of_kind(EgmEventKind::Running)[1];
    assert!((running.at_ns as f64 * 1e-9 - 9.5).abs() <= 0.008);
}

#[test]
fn going_home_first_activates_at_home_and_the_reference_calls_the_arm_back() {
    let mut rig = killed(RestartPolicy::GoHomeFirst);
    let silent = rig.silence(6.2);
    assert_eq!(rig.state(), SessionState::Moving);
    let feedback = rig.drive(20.0, 2, |time_s| Some(swing(time_s, false)));
    let home = home_rad(Side::Right);
    let at_start = feedback
        .iter()
        .find(|f| f.session == 2 && f.session_state() == Some(SessionState::Running));
    let at_start = at_start.unwrap();
    assert!(is_still(&at_start.measured_rad, &home));
    for pair in silent
        .iter()
        .chain(&feedback)
        .collect::<Vec<_>>()
        .windows(2)
    {
        for (joint, speed_max) in SPEED_MAX_RAD_PER_S.iter().enumerate() {
            let speed = (pair[1].planned_rad[joint] - pair[0].planned_rad[joint]).abs() / 0.004;
            assert!(speed <= speed_max * (1.0 + 1e-9));
        }
    }
    let error = feedback.last().unwrap().measured_rad[1] - RIGHT_START_RAD[1];
    assert!(error.abs() < 1e-3, "{error}");
    let motions: Vec<_> = [EgmEventKind::MotionBegan, EgmEventKind::MotionEnded]
        .iter()
        .flat_map(|kind| rig.of_kind(*kind))
        .map(|event| MotionKind::from_number(event.cause).unwrap())
        .collect();
    assert_eq!(motions, [MotionKind::Home; 2]);
}

#[test]
fn a_session_nobody_talks_to_times_out_and_the_next_as_well() {
    let mut rig = Rig::new(settings(RestartPolicy::AutoRetry));
    rig.silence(10.0);
    // Set-up 0.5 s, time-out 1 s, and again.
    assert_eq!(rig.ends().len(), 6);
    assert!(
        rig.ends()
            .iter()
            .all(|(cause, _)| *cause == EndCause::CommTimeout)
    );
    assert_eq!(rig.feedback().session, 7);
    assert!(is_still(rig.controller.measured_rad(), &RIGHT_START_RAD));
}

#[test]
fn condition_time_ends_a_session_that_holds_still_and_is_named() {
    let abb = ControllerSettings {
        start: StartMode::PowerOn,
        max_speed_deviation_rad_per_s: 10.0,
        restart: RestartPolicy::ExternalTrigger,
        ..ControllerSettings::of(Preset::AbbDefault)
    };
    let mut rig = Rig::new(abb);
    rig.drive(5.0, 2, |_| Some(standing()));
    let (cause, ended) = rig.ends()[0];
    assert_eq!(cause, EndCause::ConditionTime);
    let text = ended.describe();
    assert!(text.contains("(CondTime = 1 s)"), "{text}");
    assert!((ended.at_ns as f64 * 1e-9 - 1.5).abs() < 0.03, "{ended:?}");

    // So does silence, even with a long time-out.
    let patient = ControllerSettings {
        comm_timeout_s: 60.0,
        ..abb
    };
    let mut rig = Rig::new(patient);
    rig.drive(5.0, 2, |time_s| Some(swing(time_s, false)));
    assert!(rig.ends().is_empty());
    rig.silence(10.0);
    let (cause, ended) = rig.ends()[0];
    assert_eq!(cause, EndCause::ConditionTime);
    let silent_s = ended.at_ns as f64 * 1e-9 - 5.0;
    assert!((1.0..2.0).contains(&silent_s), "{silent_s}");
}

#[test]
fn max_speed_deviation_throttles_visibly_and_is_named_once() {
    let abb = ControllerSettings {
        start: StartMode::PowerOn,
        ..ControllerSettings::of(Preset::AbbDefault)
    };
    let mut rig = Rig::new(abb);
    let feedback = rig.drive(20.0, 2, |time_s| Some(swing(time_s, false)));
    let highest = feedback
        .windows(2)
        .map(|pair| (pair[1].planned_rad[0] - pair[0].planned_rad[0]).abs() / 0.004)
        .fold(0.0, f64::max)
        .to_degrees();
    assert!(highest <= 1.000_001, "{highest} deg/s");
    assert!(
        feedback
            .last()
            .unwrap()
            .has(EgmFeedback::SPEED_DEVIATION_LIMITED)
    );
    let told = rig.of_kind(EgmEventKind::SpeedThrottled);
    assert_eq!(told.len(), 1);
    let text = told[0].describe();
    assert!(text.ends_with("(MaxSpeedDeviation = 1 deg/s)"), "{text}");

    // Standing still ends the episode.
    let hold_s = feedback.last().unwrap().planned_rad[0];
    let mut here = standing();
    here.position_rad[0] = hold_s;
    rig.drive(20.9, 2, |_| Some(here));
    let free = rig.of_kind(EgmEventKind::SpeedFree);
    assert_eq!(free.len(), 1);
    assert!(
        (19_000_000_000..20_000_000_000).contains(&free[0].count),
        "{free:?}"
    );
    // Far more was asked later than at the first instant.
    assert!(free[0].value > 5.0 * told[0].value, "{free:?} {told:?}");

    // A session that ends tells it first.
    rig.drive(25.0, 2, |time_s| Some(swing(time_s, false)));
    rig.silence(27.0);
    assert_eq!(rig.of_kind(EgmEventKind::SpeedFree).len(), 2);
    assert!(!rig.ends().is_empty());
}

#[test]
fn max_position_deviation_ends_a_session_and_names_the_joint() {
    let bounded = ControllerSettings {
        max_position_deviation_rad: 10_f64.to_radians(),
        ..settings(RestartPolicy::ExternalTrigger)
    };
    let mut rig = Rig::new(bounded);
    let mut away = standing();
    away.position_rad[2] += 0.5;
    rig.drive(3.0, 2, |_| Some(away));
    let (cause, ended) = rig.ends()[0];
    assert_eq!(cause, EndCause::PositionDeviation);
    let text = ended.describe();
    // The third joint of the chain is the maker's seventh.
    assert!(text.contains("joint 7 is 10."), "{text}");
    assert!(text.ends_with("(MaxPosDeviation = 10 deg)"), "{text}");
}

#[test]
fn a_request_starts_a_session_and_its_parameters_override_the_settings() {
    let asleep = ControllerSettings {
        start: StartMode::Request,
        ..settings(RestartPolicy::WaitThenRestart)
    };
    let mut rig = Rig::new(asleep);
    rig.silence(1.0);
    assert_eq!(
        (rig.state(), rig.feedback().session),
        (SessionState::Idle, 0)
    );
    let asked = EgmStartParameters {
        comm_timeout_s: 0.2,
        max_speed_deviation_rad_per_s: 5_f64.to_radians(),
        ..EgmStartParameters::KEEP
    };
    assert_eq!(rig.controller.start_guided_motion(&asked), Ok(()));
    assert_eq!(
        rig.controller.start_guided_motion(&asked),
        Err(MotionRefusal::Busy)
    );
    rig.drive(3.0, 2, |time_s| Some(swing(time_s, false)));
    assert_eq!(
        rig.controller.start_guided_motion(&asked),
        Err(MotionRefusal::GuidedMotionRuns)
    );
    assert_eq!(rig.of_kind(EgmEventKind::SpeedThrottled).len(), 1);
    rig.silence(3.3);
    assert!(
        rig.ends()[0]
            .1
            .describe()
            .ends_with("(CommTimeout = 0.2 s)")
    );
    // The session that follows by itself has them too; one asked for anew has its own.
    rig.silence(6.0);
    assert!(
        rig.ends()[1]
            .1
            .describe()
            .ends_with("(CommTimeout = 0.2 s)")
    );
    rig.controller.stop_guided_motion();
    rig.step();
    assert_eq!(rig.state(), SessionState::Idle);
    rig.controller
        .start_guided_motion(&EgmStartParameters::KEEP)
        .unwrap();
    rig.silence(9.0);
    assert!(
        rig.ends()[2].1.describe().ends_with("(CommTimeout = 1 s)"),
        "{:?}",
        rig.lines()
    );
}

#[test]
fn a_bad_parameter_starts_nothing() {
    let asleep = ControllerSettings {
        start: StartMode::Request,
        ..open_settings()
    };
    let mut rig = Rig::new(asleep);
    let asked = EgmStartParameters {
        position_gain_per_s: 21.0,
        ..EgmStartParameters::KEEP
    };
    assert_eq!(
        rig.controller.start_guided_motion(&asked),
        Err(MotionRefusal::BadNumber)
    );
    rig.silence(1.0);
    assert_eq!(rig.state(), SessionState::Idle);
}

#[test]
fn a_requested_stop_holds_or_returns_to_where_the_session_started() {
    for (stop_mode, returns) in [(StopMode::Hold, false), (StopMode::RampDown, true)] {
        let stopping = ControllerSettings {
            stop_mode,
            ramp_out_s: 1.0,
            ..settings(RestartPolicy::AutoRetry)
        };
        let mut rig = Rig::new(stopping);
        let before = *rig
            .drive(2.0, 2, |time_s| Some(swing(time_s, false)))
            .last()
            .unwrap();
        rig.controller.stop_guided_motion();
        let first = rig.step();
        assert_eq!(first.session_state(), Some(SessionState::Stopping));
        rig.silence(5.0);
        let after = rig.feedback();
        assert_eq!(after.session_state(), Some(SessionState::Idle));
        let (cause, ended) = rig.ends()[0];
        assert_eq!((cause, ended.session), (EndCause::Requested, 1));
        let target = if returns {
            &RIGHT_START_RAD
        } else {
            &before.planned_rad
        };
        let off = (after.measured_rad[0] - target[0]).abs();
        assert!(off < if returns { 1e-9 } else { 0.02 }, "{off}");
        if returns {
            assert!((1.0..1.3).contains(&ended.value), "{ended:?}");
        }
        // Nothing restarts what was stopped by request.
        rig.silence(10.0);
        assert_eq!(rig.of_kind(EgmEventKind::Activating).len(), 1);
    }
}

#[test]
fn a_stop_ends_what_a_restart_policy_is_about_to_do() {
    for restart in [
        RestartPolicy::AutoRetry,
        RestartPolicy::WaitThenRestart,
        RestartPolicy::GoHomeFirst,
    ] {
        let mut rig = killed(restart);
        rig.silence(6.3);
        assert_ne!(rig.state(), SessionState::Running);
        rig.controller.stop_guided_motion();
        rig.silence(12.0);
        assert_eq!(rig.state(), SessionState::Idle, "{restart:?}");
        assert!(rig.of_kind(EgmEventKind::Running).len() == 1);
    }
}

#[test]
fn a_motion_of_its_own_goes_through_its_points_and_is_not_interrupted() {
    let asleep = ControllerSettings {
        start: StartMode::Request,
        control_delay_cycles: 3,
        ..open_settings()
    };
    let mut rig = Rig::new(asleep);
    rig.step();
    let path: Vec<_> = (1..=50)
        .map(|point| {
            let mut q_rad = RIGHT_START_RAD;
            q_rad[1] += 0.001 * f64::from(point);
            q_rad
        })
        .collect();
    rig.controller
        .move_along(MotionKind::MoveJoints, path.clone())
        .unwrap();
    let busy = Err(MotionRefusal::Busy);
    assert_eq!(
        rig.controller
            .move_along(MotionKind::MoveJoints, Vec::new()),
        busy
    );
    for point in &path {
        let feedback = rig.step();
        assert_eq!(feedback.session_state(), Some(SessionState::Moving));
        assert!(is_still(&feedback.planned_rad, point));
    }
    assert_eq!(
        rig.controller
            .start_guided_motion(&EgmStartParameters::KEEP),
        busy
    );
    // The stop of guided motion is none of its business.
    rig.controller.stop_guided_motion();
    let settled: Vec<_> = (0..3).map(|_| rig.step()).collect();
    assert_eq!(settled[1].session_state(), Some(SessionState::Moving));
    assert_eq!(settled[2].session_state(), Some(SessionState::Idle));
    assert!(is_still(&settled[2].measured_rad, &path[49]));
    assert_eq!(rig.of_kind(EgmEventKind::MotionEnded).len(), 1);

    let mut outside = RIGHT_START_RAD;
    outside[0] = 10.0;
    let refused = rig
        .controller
        .move_along(MotionKind::MoveJoints, vec![outside]);
    assert_eq!(refused, Err(MotionRefusal::OutsideLimits));
    outside[0] = f64::NAN;
    let refused = rig
        .controller
        .move_along(MotionKind::MoveJoints, vec![outside]);
    assert_eq!(refused, Err(MotionRefusal::BadNumber));

    // Asking changes nothing.
    let controller = &mut rig.controller;
    let start = EgmStartParameters::KEEP;
    let rest = *controller.planned_rad();
    assert_eq!(controller.can_move(&[rest]), Ok(()));
    assert_eq!(controller.can_move(&[outside]), refused);
    assert_eq!(controller.can_start(&start), Ok(()));
    assert_eq!(controller.start_guided_motion(&start), Ok(()));
    assert_eq!(controller.can_move(&[rest]), Err(MotionRefusal::Busy));
    assert_eq!(controller.can_start(&start), Err(MotionRefusal::Busy));
}

#[test]
fn feedback_counts_cycles_and_sessions() {
    let mut rig = killed(RestartPolicy::AutoRetry);
    let first = rig.feedback();
    assert_eq!((first.session, first.clock_ms), (1, 4996));
    assert_eq!(first.cycle_index, 1249);
    // Guided motion began at 0.5 s.
    assert_eq!(u64::from(first.seqno), 1249 - 125);
    rig.silence(6.2);
    let feedback = rig.drive(8.0, 2, |time_s| Some(swing(time_s, false)));
    let running: Vec<_> = feedback
        .iter()
        .filter(|f| f.session == 2 && f.session_state() == Some(SessionState::Running))
        .collect();
    assert_eq!(running[0].seqno, 0);
    assert!(!running[0].has(EgmFeedback::HAS_REFERENCE));
    for (index, feedback) in running.iter().enumerate() {
        assert_eq!(feedback.seqno as usize, index);
    }
    assert_eq!(rig.events[0].kind, EgmEventKind::Started as u32);
    assert_eq!(rig.events[0].at_ns, 0);
}
