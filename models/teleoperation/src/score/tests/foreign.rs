//! Runs of which only commands and feedback are known, as beside a foreign program.

use super::*;

/// A log of one channel each for commands and feedback of a foreign pair: no events, no human.
struct Foreign {
    log: RunLog,
    sequences: BTreeMap<&'static str, u64>,
}

impl Foreign {
    fn new() -> Self {
        Self {
            log: RunLog::default(),
            sequences: BTreeMap::new(),
        }
    }

    fn push<M: Message>(&mut self, channel: &'static str, at_ns: i64, message: &M) {
        let sequence = self.sequences.entry(channel).or_default();
        let envelope = Envelope {
            sequence: *sequence,
            published_ns: at_ns,
            ..Envelope::default()
        };
        *sequence += 1;
        self.log
            .push(channel, envelope, bytemuck::bytes_of(message));
    }
}

/// Ten loops in which the tool follows the first joint's swing, but for `is_down` at a time in
/// seconds: then no session runs and the tool stands.
fn foreign(is_down: impl Fn(f64) -> bool, flags: impl Fn(f64) -> u32) -> Foreign {
    let mut foreign = Foreign::new();
    let arm = hil_arm::yumi::arm::Arm::right();
    let mut standing = EgmFeedback::zeroed();
    let mut session = 1;
    let mut was_down = false;
    for step in 0..10_082_u32 {
        let time_s = f64::from(step) * 0.004;
        let at_ns = i64::from(step) * 4_000_000;
        let mut position_rad = RIGHT_START_RAD;
        position_rad[0] += 0.4 * (core::f64::consts::TAU * time_s / PERIOD_S).sin();
        let command = EgmCommand {
            frame_index: u64::from(step),
            position_rad,
            flags: flags(time_s),
            ..EgmCommand::zeroed()
        };
        foreign.push(EGM_RIGHT_COMMAND, at_ns, &command);
        let down = is_down(time_s);
        if !down {
            session += u32::from(was_down);
            standing = EgmFeedback {
                measured_rad: position_rad,
                tool: arm.tool(&position_rad).into(),
                reference_frame_index: u64::from(step),
                session,
                state: SessionState::Running as u32,
                flags: EgmFeedback::HAS_REFERENCE | EgmFeedback::TOOK_COMMAND,
                ..EgmFeedback::zeroed()
            };
        }
        was_down = down;
        let feedback = EgmFeedback {
            cycle_index: u64::from(step),
            state: if down {
                SessionState::Waiting as u32
            } else {
                standing.state
            },
            ..standing
        };
        foreign.push(EGM_RIGHT_FEEDBACK, at_ns + 1_000_000, &feedback);
    }
    foreign
}

#[test]
fn a_run_of_foreign_programs_is_scored_without_events() {
    let case = case(|_| {});
    let foreign = foreign(|time_s| (14.0..18.5).contains(&time_s), |_| 0);
    let score = case.score(&foreign.log);
    assert!((value(&score, "egm_trip_count") - 1.0).abs() < 0.1);
    assert!((value(&score, "loops_lost_by_trip_count") - 1.0).abs() < 0.1);
    let incident = score
        .events
        .iter()
        .find(|event| event.severity == Severity::Incident);
    assert!(incident.unwrap().what.contains("not recorded"));
    assert_eq!(score.get("commands_refused_count").unwrap().value, None);
    let split = score.get("joint_error_network_rad_rms").unwrap();
    assert_eq!(split.value, None);
    assert!(split.method.contains("behind the network"), "{split:?}");
    let sent = score.get("motion_loops_sent_count").unwrap();
    assert!(sent.method.contains("as the commands arrived"), "{sent:?}");
    assert!(value(&score, "tool_path_m_rms") < 1e-3);
}

#[test]
fn what_no_feedback_tells_of_is_not_known_rather_than_made_up() {
    let heard = foreign(|_| false, |_| 0).log;
    let mut log = RunLog::default();
    for channel in [EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK] {
        for logged in heard.raw(channel) {
            let is_lost = (14_000_000_000..22_000_000_000).contains(&logged.envelope.published_ns);
            if channel == EGM_RIGHT_COMMAND || !is_lost {
                log.push(channel, logged.envelope, &logged.payload);
            }
        }
    }
    let score = case(|_| {}).score(&log);
    assert!(value(&score, "loops_lost_unseen_count") >= 1.0);
    assert!(value(&score, "loops_lost_by_merging_count").abs() < 0.1);
    let mut incidents = score.events.iter();
    let lost = incidents.find(|event| event.severity == Severity::Incident);
    let what = &lost.unwrap().what;
    assert!(what.contains("no feedback came"), "{what}");
    for name in ["hold_count", "hold_time_ratio", "resume_saturation_ratio"] {
        let metric = score.get(name).unwrap();
        assert_eq!(metric.value, None, "{metric:?}");
        assert!(metric.method.contains("does not tell"), "{metric:?}");
    }
}

#[test]
fn clipped_commands_explain_a_loop_that_nothing_else_does() {
    let case = case(|_| {});
    let window = |time_s: f64| (14.0..18.5).contains(&time_s);
    let clipped = |time_s| {
        if window(time_s) {
            EgmCommand::UNREACHABLE
        } else {
            0
        }
    };
    // The session runs on, but the tool stands: as in a hold that nobody flags.
    let mut foreign = Foreign::new();
    let source = self::foreign(window, clipped).log;
    for (at, command) in source.messages::<EgmCommand>(EGM_RIGHT_COMMAND) {
        foreign.push(EGM_RIGHT_COMMAND, at.as_ns(), &command);
    }
    for (at, feedback) in source.messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK) {
        let running = EgmFeedback {
            state: SessionState::Running as u32,
            session: 1,
            ..feedback
        };
        foreign.push(EGM_RIGHT_FEEDBACK, at.as_ns(), &running);
    }
    let score = case.score(&foreign.log);
    assert!((value(&score, "loops_lost_by_clipping_count") - 1.0).abs() < 0.1);
    assert!(value(&score, "ik_failure_count") > 1000.0);
}

#[test]
fn loops_before_the_first_session_are_lost_because_none_had_begun() {
    let case = case(|_| {});
    let mut foreign = Foreign::new();
    let source = self::foreign(|time_s| time_s < 9.0, |_| 0).log;
    for (at, command) in source.messages::<EgmCommand>(EGM_RIGHT_COMMAND) {
        foreign.push(EGM_RIGHT_COMMAND, at.as_ns(), &command);
    }
    for (at, feedback) in source.messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK) {
        let is_running = feedback.state == SessionState::Running as u32;
        let session = u32::from(is_running);
        let feedback = EgmFeedback {
            session,
            ..feedback
        };
        foreign.push(EGM_RIGHT_FEEDBACK, at.as_ns(), &feedback);
    }
    let score = case.score(&foreign.log);
    assert!(value(&score, "loops_lost_by_trip_count") > 0.5);
    assert!(value(&score, "egm_trip_count").abs() < 0.1);
    let lost = |event: &&hil_core::score::ScoreEvent| event.severity == Severity::Incident;
    let incident = score.events.iter().find(lost).unwrap();
    assert!(
        incident.what.contains("in no EGM session until 9.000 s"),
        "{}",
        incident.what
    );
}

#[test]
fn a_throttled_arm_loses_its_loops_to_max_speed_deviation() {
    let case = case(|parameters| {
        parameters.egm.max_speed_deviation_deg_per_s = Some(1.0);
    });
    let score = case.score(&run(&case, None, 8.0 * PERIOD_S));
    assert!(value(&score, "loops_lost_by_throttling_count") > 3.0);
    assert!(value(&score, "loops_lost_by_merging_count").abs() < 0.1);
    assert!(value(&score, "throttled_time_ratio") > 0.5);
    let throttled = |event: &&hil_core::score::ScoreEvent| {
        event.what.contains("lost: throttled by MaxSpeedDeviation")
    };
    assert!(score.events.iter().any(|event| throttled(&event)));
}

#[test]
fn the_recorded_end_cause_is_named() {
    let case = case(|_| {});
    let mut foreign = foreign(|time_s| (14.0..18.5).contains(&time_s), |_| 0);
    let ended = EgmEvent {
        at_ns: 14_000_000_000,
        kind: EgmEventKind::Ended as u32,
        cause: EndCause::ConditionTime as u32,
        side: u32::try_from(Side::Right.index()).unwrap(),
        session: 1,
        ..EgmEvent::zeroed()
    };
    foreign.push(EGM_EVENT, 14_000_000_000, &ended);
    let score = case.score(&foreign.log);
    let incident = score
        .events
        .iter()
        .find(|event| event.severity == Severity::Incident);
    assert!(incident.unwrap().what.contains("CondTime"));
    assert!(value(&score, "commands_refused_count").abs() < 0.1);
}
