//! Sessions of the whole case in virtual time: who starts them, what ends them, and where the arms
//! go when they are back.

use core::time::Duration;
use std::collections::BTreeMap;

use bytemuck::Zeroable;

use crate::messages::HumanFrame;
use crate::{
    EGM_EVENT, EGM_LEFT_COMMAND, EGM_LEFT_FEEDBACK, EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK,
    HUMAN_FRAME, MOTION_REQUEST, MOTION_RESPONSE, ResumePolicy, SendPolicy, Teleoperation,
    TeleoperationParameters,
};
use hil_arm::egm::messages::{
    EgmCommand, EgmEvent, EgmEventKind, EgmFeedback, EndCause, MotionKind, MotionOutcome,
    MotionRefusal, MotionRequest, MotionResponse, SessionState, Side,
};
use hil_arm::egm::parameters::{GuidedArms, RestartPolicy, StartMode};
use hil_arm::yumi::arm::RIGHT_START_RAD;
use hil_core::case_study::CaseStudy;
use hil_core::component::Role;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::message::Message;
use hil_core::simulation::{Carrier, Simulation, SimulationResult};
use hil_core::time::Instant;
use hil_link::spec::{LinkPlace, LinkSpec};

fn case(change: impl FnOnce(&mut TeleoperationParameters)) -> Teleoperation {
    let mut parameters = TeleoperationParameters::default();
    change(&mut parameters);
    Teleoperation::new(parameters, 11).unwrap()
}

/// Loses everything from one instant to another, seconds.
#[derive(Debug, Clone, Copy)]
struct Outage(f64, f64);

impl LinkModel for Outage {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        if (self.0..self.1).contains(&now.seconds_since(Instant::ZERO)) {
            Fate::Lost
        } else {
            Fate::Delivered(now)
        }
    }
}

type Links = Vec<(&'static str, Box<dyn Carrier>)>;

fn run(case: &Teleoperation, links: Links, duration_s: f64) -> SimulationResult {
    let carriers = links
        .into_iter()
        .map(|(channel, link)| (channel.to_owned(), link))
        .collect::<BTreeMap<_, _>>();
    Simulation::new(case, carriers)
        .unwrap()
        .run(Duration::from_secs_f64(duration_s))
        .unwrap()
}

/// No command of the right arm from `from_s` to `until_s`.
fn outage(from_s: f64, until_s: f64) -> Links {
    vec![(EGM_RIGHT_COMMAND, Box::new(Outage(from_s, until_s)))]
}

fn events(result: &SimulationResult, kind: EgmEventKind, side: Side) -> Vec<EgmEvent> {
    let all = result.log.messages::<EgmEvent>(EGM_EVENT);
    all.map(|(_, event)| event)
        .filter(|event| event.kind == kind as u32 && event.side == side.number())
        .collect()
}

fn seconds(event: &EgmEvent) -> f64 {
    event.at_ns as f64 * 1e-9
}

fn requests(result: &SimulationResult) -> Vec<(f64, MotionRequest)> {
    let all = result.log.messages::<MotionRequest>(MOTION_REQUEST);
    all.map(|(at, request)| (at.seconds_since(Instant::ZERO), request))
        .collect()
}

fn feedback(result: &SimulationResult, channel: &str) -> Vec<(f64, EgmFeedback)> {
    let all = result.log.messages::<EgmFeedback>(channel);
    all.map(|(at, feedback)| (at.seconds_since(Instant::ZERO), feedback))
        .collect()
}

#[test]
fn one_request_starts_both_arms_and_commands_follow_only_then() {
    let result = run(&case(|_| {}), Vec::new(), 3.0);
    let requests = requests(&result);
    assert_eq!(requests.len(), 1, "{requests:?}");
    assert_eq!(requests[0].1.arms, 3);
    assert_eq!(requests[0].1.kind, MotionKind::EgmStart as u32);
    let answers: Vec<_> = result
        .log
        .messages::<MotionResponse>(MOTION_RESPONSE)
        .map(|(_, response)| response.outcome)
        .collect();
    let (accepted, done) = (MotionOutcome::Accepted, MotionOutcome::Done);
    assert_eq!(answers, [accepted as u32, done as u32]);
    for (side, channel) in [
        (Side::Right, EGM_RIGHT_COMMAND),
        (Side::Left, EGM_LEFT_COMMAND),
    ] {
        let running = events(&result, EgmEventKind::Running, side);
        assert_eq!(running.len(), 1);
        let mut commands = result.log.messages::<EgmCommand>(channel);
        let (first_at, first) = commands.next().unwrap();
        let after_s = first_at.seconds_since(Instant::ZERO) - seconds(&running[0]);
        assert!((0.0..0.009).contains(&after_s), "{after_s}");
        assert!(first.flags & EgmCommand::ANSWERS != 0);
        let is_parked = first.flags & EgmCommand::PARKED != 0;
        assert_eq!(is_parked, side == Side::Left);
        assert!(events(&result, EgmEventKind::Ended, side).is_empty());
        assert!(events(&result, EgmEventKind::CommandRefused, side).is_empty());
        let seqnos = result.log.messages::<EgmCommand>(channel);
        assert!((0..).zip(seqnos).all(|(count, one)| one.1.seqno == count));
    }
}

#[test]
fn a_program_that_starts_by_itself_is_not_asked() {
    let case = case(|parameters| parameters.egm.start = Some(StartMode::PowerOn));
    let result = run(&case, Vec::new(), 3.0);
    assert!(requests(&result).is_empty());
    assert_eq!(events(&result, EgmEventKind::Running, Side::Left).len(), 1);
}

#[test]
fn an_arm_left_out_of_power_on_stands_without_a_session() {
    for (arms, moving) in [
        (GuidedArms::Right, Side::Right),
        (GuidedArms::Left, Side::Left),
    ] {
        let case = case(|parameters| {
            parameters.egm.start = Some(StartMode::PowerOn);
            parameters.egm.arms = Some(arms);
        });
        let result = run(&case, Vec::new(), 3.0);
        assert!(requests(&result).is_empty());
        for side in Side::BOTH {
            let running = events(&result, EgmEventKind::Running, side);
            assert_eq!(running.len(), usize::from(side == moving), "{arms:?}");
        }
    }
}

#[test]
fn a_lost_request_is_repeated_ever_more_slowly() {
    let links: Links = vec![(MOTION_REQUEST, Box::new(Outage(0.0, 2.0)))];
    let result = run(&case(|_| {}), links, 6.0);
    let times: Vec<f64> = requests(&result).iter().map(|(at, _)| *at).collect();
    let expected = [0.0, 0.25, 0.75, 1.75, 3.75];
    assert_eq!(times.len(), expected.len(), "{times:?}");
    for (time, expected) in times.iter().zip(expected) {
        assert!((time - expected).abs() < 0.01, "{times:?}");
    }
    assert_eq!(events(&result, EgmEventKind::Running, Side::Right).len(), 1);
}

#[test]
fn a_bad_network_for_requests_still_gets_both_arms_going() {
    for seed in 0..5 {
        let lossy = |name| {
            let spec = LinkSpec::fixed(Duration::from_millis(120), 0.5);
            Box::new(spec.build(&LinkPlace::alone(seed, name)).unwrap()) as Box<dyn Carrier>
        };
        let links = [
            MOTION_REQUEST,
            MOTION_RESPONSE,
            EGM_RIGHT_FEEDBACK,
            EGM_LEFT_FEEDBACK,
        ]
        .map(|name| (name, lossy(name)));
        let result = run(&case(|_| {}), links.into(), 12.0);
        for side in Side::BOTH {
            assert_eq!(events(&result, EgmEventKind::Running, side).len(), 1);
        }
    }
}

#[test]
fn only_the_arm_without_commands_times_out_and_comes_back_by_itself() {
    let result = run(&case(|_| {}), outage(6.0, 7.5), 12.0);
    let ended = events(&result, EgmEventKind::Ended, Side::Right);
    assert_eq!(ended.len(), 1);
    assert_eq!(ended[0].cause, EndCause::CommTimeout as u32);
    // The last command arrived just before the outage.
    assert!((seconds(&ended[0]) - 7.0).abs() < 0.013, "{:?}", ended[0]);
    let running = events(&result, EgmEventKind::Running, Side::Right);
    assert_eq!(running.len(), 2);
    // `restart_wait_s` and `activation_s` of the preset `paper`.
    let back_s = seconds(&running[1]) - seconds(&ended[0]);
    assert!((back_s - 2.0).abs() < 0.013, "{back_s}");
    assert!(events(&result, EgmEventKind::Ended, Side::Left).is_empty());
    assert_eq!(requests(&result).len(), 1);
    let last = feedback(&result, EGM_RIGHT_FEEDBACK).last().unwrap().1;
    assert_eq!(
        (last.session, last.state),
        (2, SessionState::Running as u32)
    );
}

#[test]
fn an_external_trigger_comes_as_late_as_it_is_told_to() {
    let case = case(|parameters| {
        parameters.egm.restart = Some(RestartPolicy::ExternalTrigger);
        parameters.trigger_after_s = 2.5;
    });
    let result = run(&case, outage(6.0, 7.5), 14.0);
    let ended = events(&result, EgmEventKind::Ended, Side::Right);
    assert_eq!(ended.len(), 1);
    let requests = requests(&result);
    assert_eq!(requests.len(), 2, "{requests:?}");
    assert_eq!(requests[1].1.arms, MotionRequest::bit(Side::Right));
    let after_s = requests[1].0 - seconds(&ended[0]);
    assert!((after_s - 2.5).abs() < 0.013, "{after_s}");
    assert_eq!(events(&result, EgmEventKind::Running, Side::Right).len(), 2);
}

/// Right-arm command just before the session is back, and the commands and joint positions from
/// then on, with the arm's way to where it was when the session came back.
fn resumed(policy: ResumePolicy) -> (SimulationResult, f64) {
    let case = case(|parameters| {
        parameters.resume = policy;
        parameters.blend_s = 1.0;
    });
    let result = run(&case, outage(6.0, 7.5), 16.0);
    let running = events(&result, EgmEventKind::Running, Side::Right);
    (result, seconds(&running[1]))
}

fn command_at(result: &SimulationResult, at_s: f64) -> EgmCommand {
    let mut all = result.log.messages::<EgmCommand>(EGM_RIGHT_COMMAND);
    let found = all.find(|(at, _)| at.seconds_since(Instant::ZERO) >= at_s);
    found.unwrap().1
}

fn apart_rad(a: &[f64; 7], b: &[f64; 7]) -> f64 {
    let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    apart.fold(0.0, f64::max)
}

#[test]
fn a_jump_goes_on_as_if_nothing_had_happened() {
    let (result, back_s) = resumed(ResumePolicy::Jump);
    let clean = run(&case(|_| {}), Vec::new(), 16.0);
    for at_s in [5.0, back_s, back_s + 0.02, back_s + 3.0] {
        let [told, unhurt] = [&result, &clean].map(|run| command_at(run, at_s));
        let apart_rad = apart_rad(&told.position_rad, &unhurt.position_rad);
        assert!(apart_rad < 1e-12, "{apart_rad} rad at {at_s} s");
    }
    // Meanwhile commands went out, and the robot said why it did not take them.
    let refused = events(&result, EgmEventKind::CommandRefused, Side::Right);
    assert_eq!(refused.len(), 1);
}

#[test]
fn a_blend_starts_where_the_arm_is_and_ends_on_the_hand() {
    let (result, back_s) = resumed(ResumePolicy::Blend);
    let (jumped, _) = resumed(ResumePolicy::Jump);
    let arm = feedback(&result, EGM_RIGHT_FEEDBACK);
    let at_rest = arm
        .iter()
        .find(|(at, _)| *at >= back_s)
        .unwrap()
        .1
        .measured_rad;
    let first = command_at(&result, back_s + 0.005);
    assert!(apart_rad(&first.position_rad, &at_rest) < 0.01);
    let would_jump = command_at(&jumped, back_s + 0.005);
    assert!(apart_rad(&would_jump.position_rad, &at_rest) > 0.05);
    let half = [&result, &jumped].map(|run| command_at(run, back_s + 0.5).position_rad);
    assert!(apart_rad(&half[0], &half[1]) > 0.01);
    let after = [&result, &jumped].map(|run| command_at(run, back_s + 1.5).position_rad);
    // The redundant joint may be elsewhere; the tool is not.
    let tools = after.map(|q_rad| hil_arm::yumi::arm::Arm::right().tool(&q_rad));
    let apart_m = (tools[0].translation.vector - tools[1].translation.vector).norm();
    assert!(apart_m < 2e-5, "{apart_m}");
}

#[test]
fn a_new_clutch_starts_where_the_arm_is_and_stays_off_by_that() {
    let (result, back_s) = resumed(ResumePolicy::Reclutch);
    let (jumped, _) = resumed(ResumePolicy::Jump);
    let arm = feedback(&result, EGM_RIGHT_FEEDBACK);
    let at_rest = arm
        .iter()
        .find(|(at, _)| *at >= back_s)
        .unwrap()
        .1
        .measured_rad;
    let first = command_at(&result, back_s + 0.005);
    assert!(apart_rad(&first.position_rad, &at_rest) < 1e-3);
    // From then on both move alike, a constant way apart.
    let arm = hil_arm::yumi::arm::Arm::right();
    let offset_m = |at_s: f64| {
        let [new, old] = [&result, &jumped].map(|run| {
            arm.tool(&command_at(run, at_s).position_rad)
                .translation
                .vector
        });
        new - old
    };
    let first_m = offset_m(back_s + 0.005);
    assert!(first_m.norm() > 0.02, "{first_m}");
    for later_s in [0.5, 1.0, 3.0] {
        let changed_m = (offset_m(back_s + later_s) - first_m).norm();
        assert!(changed_m < 1e-3, "{changed_m} after {later_s} s");
    }
}

#[test]
fn commands_go_out_per_frame_per_feedback_or_by_the_clock() {
    let count = |send: SendPolicy, send_hz: f64| {
        let case = case(|parameters| {
            parameters.send = send;
            parameters.send_hz = (send == SendPolicy::Free).then_some(send_hz);
        });
        let result = run(&case, Vec::new(), 4.5);
        let all = result.log.messages::<EgmCommand>(EGM_LEFT_COMMAND);
        all.filter(|(at, _)| at.seconds_since(Instant::ZERO) > 2.5)
            .count()
    };
    assert!(count(SendPolicy::Frame, 1000.0).abs_diff(250) <= 1);
    assert!(count(SendPolicy::Coupled, 1000.0).abs_diff(500) <= 1);
    assert!(count(SendPolicy::Free, 100.0).abs_diff(200) <= 1);
}

/// Everything one call of a role said, with the number of its output port.
fn hear<M: Message>(role: &mut dyn Role, port: &str, message: &M) -> Vec<(usize, Vec<u8>)> {
    let mut said = Vec::new();
    let mut emit = |port: usize, bytes: &[u8]| said.push((port, bytes.to_vec()));
    role.hear(Instant::ZERO, port, message, &mut emit);
    said
}

fn frame() -> HumanFrame {
    let pose = case(|_| {}).player().at(0.0);
    HumanFrame {
        frame_index: 0,
        source_time_ns: 0,
        root: pose.root.into(),
        right_hand: pose.right_hand.into(),
        left_hand: pose.left_hand.into(),
    }
}

fn running() -> EgmFeedback {
    EgmFeedback {
        measured_rad: RIGHT_START_RAD,
        session: 1,
        state: SessionState::Running as u32,
        ..EgmFeedback::zeroed()
    }
}

#[test]
fn an_arm_engages_on_a_sound_frame_after_its_own_sound_feedback_of_a_running_session() {
    let mut controller = case(|_| {}).role("controller").unwrap();
    let controller = controller.as_mut();
    controller.start(Instant::ZERO);
    assert!(hear(controller, HUMAN_FRAME, &frame()).is_empty());

    let mut clock_ms = 0;
    let mut next = |change: &dyn Fn(&mut EgmFeedback)| {
        clock_ms += 4;
        let mut feedback = EgmFeedback {
            clock_ms,
            cycle_index: u64::from(clock_ms) / 4,
            ..running()
        };
        change(&mut feedback);
        feedback
    };
    for unfit in [
        next(&|feedback| feedback.state = SessionState::Activating as u32),
        next(&|feedback| feedback.state = 77),
        next(&|feedback| feedback.measured_rad[3] = f64::NAN),
    ] {
        assert!(hear(controller, EGM_RIGHT_FEEDBACK, &unfit).is_empty());
        assert!(hear(controller, HUMAN_FRAME, &frame()).is_empty());
    }
    assert!(hear(controller, EGM_RIGHT_FEEDBACK, &next(&|_| {})).is_empty());
    let mut broken = frame();
    broken.right_hand.position_m[0] = f64::INFINITY;
    assert!(hear(controller, HUMAN_FRAME, &broken).is_empty());

    // The right arm runs, the left does not: one command.
    let said = hear(controller, HUMAN_FRAME, &frame());
    assert_eq!(said.len(), 1);
    assert_eq!(said[0].0, controller.output(EGM_RIGHT_COMMAND));
    let command: EgmCommand = bytemuck::pod_read_unaligned(&said[0].1);
    assert!(apart_rad(&command.position_rad, &RIGHT_START_RAD) < 1e-6);
    assert_eq!(command.answered_cycle, 4);

    // Once engaged, a broken frame holds the target and says so.
    let said = hear(controller, HUMAN_FRAME, &broken);
    let command: EgmCommand = bytemuck::pod_read_unaligned(&said[0].1);
    let flags = EgmCommand::JUMP_LIMITED | EgmCommand::ANSWERS;
    assert_eq!(command.flags, flags);
    assert!(command.position_rad.iter().all(|q| q.is_finite()));

    // Feedback that comes late changes nothing.
    let mut late = running();
    late.state = SessionState::Idle as u32;
    assert!(hear(controller, EGM_RIGHT_FEEDBACK, &late).is_empty());
    assert_eq!(controller.next_tick(), None);
}

#[test]
fn a_refusal_that_will_last_ends_the_asking() {
    let mut controller = case(|_| {}).role("controller").unwrap();
    let controller = controller.as_mut();
    controller.start(Instant::ZERO);
    let mut idle = running();
    (idle.state, idle.session) = (SessionState::Idle as u32, 0);
    hear(controller, EGM_RIGHT_FEEDBACK, &idle);
    assert_eq!(controller.next_tick(), Some(Instant::ZERO));
    let mut response = MotionResponse::zeroed();
    response.outcome = MotionOutcome::Refused as u32;
    response.refusal = MotionRefusal::Busy as u32;
    hear(controller, MOTION_RESPONSE, &response);
    assert_eq!(controller.next_tick(), Some(Instant::ZERO));
    response.refusal = MotionRefusal::BadNumber as u32;
    hear(controller, MOTION_RESPONSE, &response);
    assert_eq!(controller.next_tick(), None);
}

#[test]
fn what_the_controller_asks_for_overrides_the_robots_settings() {
    let case = case(|parameters| parameters.egm_start.comm_timeout_s = Some(0.4));
    let result = run(&case, outage(6.0, 6.6), 8.0);
    let ended = events(&result, EgmEventKind::Ended, Side::Right);
    assert_eq!(ended.len(), 1);
    assert!((ended[0].limit - 0.4).abs() < 1e-12, "{:?}", ended[0]);
}
