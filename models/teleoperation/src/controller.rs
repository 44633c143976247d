//! The role "controller": human frames to joint commands of both arms, and the client that asks the
//! robot for guided motion. It computes neither mapping nor kinematics itself: see
//! [`super::follower`].

use core::time::Duration;

use bytemuck::Zeroable;

use crate::follower::{Followed, Follower};
use crate::messages::HumanFrame;
use crate::parameters::{LeftArm, ResumePolicy, SendPolicy, TeleoperationParameters};
use crate::robot::arms;
use crate::{
    EGM_LEFT_COMMAND, EGM_LEFT_FEEDBACK, EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, HUMAN_FRAME,
    MOTION_REQUEST, MOTION_RESPONSE,
};
use hil_arm::egm::messages::{
    EgmCommand, EgmFeedback, EgmStartParameters, MotionKind, MotionOutcome, MotionRefusal,
    MotionRequest, MotionResponse, SessionState, Side,
};
use hil_arm::egm::parameters::GuidedArms;
use hil_arm::yumi::arm::Arm;
use hil_arm::yumi::inverse::Reach;
use hil_arm::yumi::{JOINT_COUNT, Pose};
use hil_core::component::{Component, Output, Role, Timer};
use hil_core::time::Instant;

/// Frames farther apart than this count as one this far apart: after an outage the arm does not
/// get the whole gap's worth of speed at once.
const ELAPSED_MAX_S: f64 = 0.1;

/// Feedback of a lower cycle stamped so much earlier than the newest is of a clock that started
/// anew; less, it only came late.
const CLOCK_RESTART_MS: i32 = 10_000;

/// True when `feedback` takes the place of `newest`.
pub(crate) fn is_newer(feedback: &EgmFeedback, newest: &EgmFeedback) -> bool {
    // The cycles of a foreign robot never fall (the adapter counts them), though its clock does when
    // it starts anew.
    if feedback.cycle_index > newest.cycle_index {
        return true;
    }
    // Those of our robot fall when its process starts anew, and its clock goes on. It wraps.
    let later_ms = feedback
        .clock_ms
        .wrapping_sub(newest.clock_ms)
        .cast_signed();
    !(-CLOCK_RESTART_MS..=0).contains(&later_ms)
}

/// The role. Each arm engages on the first sound human frame after its own guided motion runs,
/// from the posture its own feedback reports; before that it is sent nothing.
#[derive(Debug)]
pub(crate) struct Controller {
    parameters: TeleoperationParameters,
    client: MotionClient,
    /// Those asked to start.
    guided: GuidedArms,
    arms: [ArmSender; 2],
    source_time_ns: Option<i64>,
    request: Output<MotionRequest>,
}

/// One arm as the controller sees it.
#[derive(Debug)]
struct ArmSender {
    side: Side,
    arm: Arm,
    newest: Option<EgmFeedback>,
    engaged: Option<Engaged>,
    /// What the newest frame came to.
    command: Option<EgmCommand>,
    next_seqno: u32,
    output: Output<EgmCommand>,
}

#[derive(Debug)]
struct Engaged {
    session: u32,
    follower: Follower,
}

/// The part of a human frame that the arms follow.
#[derive(Debug, Clone, Copy)]
struct Seen<'a> {
    frame: &'a HumanFrame,
    elapsed_s: f64,
}

impl ArmSender {
    fn new(side: Side) -> Self {
        Self {
            side,
            arm: arms()[side.index()],
            newest: None,
            engaged: None,
            command: None,
            next_seqno: 0,
            output: Output::default(),
        }
    }

    fn on_feedback(&mut self, feedback: &EgmFeedback) {
        if let Some(newest) = &self.newest {
            if !is_newer(feedback, newest) {
                return;
            }
            if feedback.cycle_index < newest.cycle_index
                && let Some(engaged) = &mut self.engaged
            {
                // Sessions count anew; none has this number.
                engaged.session = 0;
            }
        }
        self.newest = Some(*feedback);
    }

    /// Follows a frame; nothing comes of it until the arm runs for the first time.
    fn on_frame(&mut self, parameters: &TeleoperationParameters, seen: &Seen<'_>) {
        self.engage_or_resume(parameters, seen.frame);
        let Some(engaged) = &mut self.engaged else {
            return;
        };
        let hand = seen.frame.right_hand.isometry();
        let followed = engaged.follower.follow(hand.as_ref(), seen.elapsed_s);
        let is_parked = engaged.follower.is_holding();
        self.command = Some(EgmCommand {
            frame_index: seen.frame.frame_index,
            source_time_ns: seen.frame.source_time_ns,
            answered_cycle: 0,
            position_rad: followed.position_rad,
            speed_rad_per_s: if parameters.feed_forward {
                followed.speed_rad_per_s
            } else {
                [0.0; JOINT_COUNT]
            },
            seqno: 0,
            flags: flag(parameters.feed_forward, EgmCommand::HAS_SPEED)
                | flag(is_parked, EgmCommand::PARKED)
                | reach_flags(&followed),
        });
    }

    /// Makes a session that is new to it its own.
    fn engage_or_resume(&mut self, parameters: &TeleoperationParameters, frame: &HumanFrame) {
        let Some(newest) = &self.newest else { return };
        let is_running = newest.session_state() == Some(SessionState::Running);
        let is_sound = newest.measured_rad.iter().all(|q| q.is_finite());
        if !is_running || !is_sound {
            return;
        }
        let (session, measured_rad) = (newest.session, newest.measured_rad);
        match &mut self.engaged {
            Some(engaged) if engaged.session == session => return,
            Some(engaged) if parameters.resume != ResumePolicy::Reclutch => {
                engaged.session = session;
                if parameters.resume == ResumePolicy::Blend {
                    engaged
                        .follower
                        .blend_from(measured_rad, parameters.blend_s);
                }
                return;
            }
            Some(_) | None => {}
        }
        let Some(hand) = frame.right_hand.isometry() else {
            return;
        };
        let is_mirrored = self.side == Side::Left;
        let follower = if is_mirrored && parameters.left_arm == LeftArm::Hold {
            Follower::holding(self.arm, measured_rad)
        } else {
            let settings = parameters.mapping(is_mirrored);
            Follower::engage(self.arm, measured_rad, settings, &hand)
        };
        self.engaged = Some(Engaged { session, follower });
    }

    /// Sends the newest command, if there is one.
    fn send(&mut self) {
        let Some(mut command) = self.command else {
            return;
        };
        if let Some(newest) = &self.newest {
            command.answered_cycle = newest.cycle_index;
            command.flags |= EgmCommand::ANSWERS;
        }
        command.seqno = self.next_seqno;
        self.next_seqno = self.next_seqno.wrapping_add(1);
        self.output.send(command);
    }
}

const fn flag(is_set: bool, bit: u32) -> u32 {
    if is_set { bit } else { 0 }
}

fn reach_flags(followed: &Followed) -> u32 {
    let reach = match followed.reach {
        Reach::Reached => 0,
        Reach::Approaching => EgmCommand::LIMITED,
        Reach::Unreachable => EgmCommand::UNREACHABLE,
    };
    reach | flag(followed.is_jump_limited, EgmCommand::JUMP_LIMITED)
}

impl Controller {
    pub(crate) fn new(parameters: TeleoperationParameters) -> Self {
        let trigger_after = Duration::from_secs_f64(parameters.trigger_after_s);
        let client = MotionClient::new(parameters.egm_start.message(), trigger_after);
        Self {
            guided: parameters.egm.guided_arms(),
            parameters,
            client,
            arms: Side::BOTH.map(ArmSender::new),
            source_time_ns: None,
            request: Output::default(),
        }
    }

    fn on_frame(&mut self, _now: Instant, frame: &HumanFrame) {
        let since_previous_ns = self
            .source_time_ns
            .map_or(0, |previous| frame.source_time_ns.saturating_sub(previous));
        self.source_time_ns = Some(frame.source_time_ns);
        // The first frame, and one of a human that started anew, count as one period.
        let elapsed_s = if since_previous_ns > 0 {
            (since_previous_ns as f64 * 1e-9).min(ELAPSED_MAX_S)
        } else {
            self.parameters.frame_period().as_secs_f64()
        };
        let seen = Seen { frame, elapsed_s };
        for arm in &mut self.arms {
            arm.on_frame(&self.parameters, &seen);
            if self.parameters.send == SendPolicy::Frame {
                arm.send();
            }
        }
    }

    fn on_feedback(&mut self, now: Instant, side: Side, feedback: &EgmFeedback) {
        if self.guided.include(side) {
            self.client.on_feedback(now, side, feedback);
        }
        let arm = &mut self.arms[side.index()];
        arm.on_feedback(feedback);
        if self.parameters.send == SendPolicy::Coupled {
            arm.send();
        }
    }
}

impl Controller {
    pub(crate) fn into_role(self) -> Box<dyn Role> {
        let free = (self.parameters.send == SendPolicy::Free).then(|| self.parameters.send_hz());
        let component = Component::of(self)
            .input(HUMAN_FRAME, Self::on_frame)
            .input(EGM_RIGHT_FEEDBACK, |own, now, feedback| {
                own.on_feedback(now, Side::Right, feedback);
            })
            .input(EGM_LEFT_FEEDBACK, |own, now, feedback| {
                own.on_feedback(now, Side::Left, feedback);
            })
            .input(MOTION_RESPONSE, |own, _, response| {
                own.client.on_response(response);
            })
            .output(EGM_RIGHT_COMMAND, |own| &mut own.arms[0].output)
            .output(EGM_LEFT_COMMAND, |own| &mut own.arms[1].output)
            .output(MOTION_REQUEST, |own| &mut own.request)
            .timer(Timer {
                next: |own| own.client.next_ask(),
                tick: |own, now| {
                    if let Some(request) = own.client.ask(now) {
                        own.request.send(request);
                    }
                },
                skipped: |_| 0,
            });
        let Some(send_hz) = free else {
            return component.into_role();
        };
        let period = Duration::from_secs_f64(1.0 / send_hz);
        let send = |own: &mut Self, _, _| own.arms.iter_mut().for_each(ArmSender::send);
        component.every(period, send).into_role()
    }
}

/// Wait for an answer in the feedback before the first repetition; it doubles up to
/// [`BACK_OFF_MAX`].
const BACK_OFF_MIN: Duration = Duration::from_millis(250);
const BACK_OFF_MAX: Duration = Duration::from_secs(4);

/// The client.
#[derive(Debug)]
pub(crate) struct MotionClient {
    parameters: EgmStartParameters,
    trigger_after: Duration,
    arms: [ArmView; 2],
    next_request_id: u64,
    /// The robot said that it will never do what is asked.
    is_hopeless: bool,
}

/// What is known of an arm, and what is to be done about it.
#[derive(Debug, Clone, Copy)]
struct ArmView {
    newest: Option<EgmFeedback>,
    has_run: bool,
    ask_at: Option<Instant>,
    back_off: Duration,
}

impl ArmView {
    const UNKNOWN: Self = Self {
        newest: None,
        has_run: false,
        ask_at: None,
        back_off: BACK_OFF_MIN,
    };
}

impl MotionClient {
    /// Asks with `parameters`; for a session that ran and ended, only `trigger_after` later.
    pub(crate) fn new(parameters: EgmStartParameters, trigger_after: Duration) -> Self {
        Self {
            parameters,
            trigger_after,
            arms: [ArmView::UNKNOWN; 2],
            next_request_id: 0,
            is_hopeless: false,
        }
    }

    /// Takes note of an arm's state.
    pub(crate) fn on_feedback(&mut self, now: Instant, side: Side, feedback: &EgmFeedback) {
        let view = &mut self.arms[side.index()];
        match &view.newest {
            Some(newest) if !is_newer(feedback, newest) => return,
            // A robot that started anew has never run.
            Some(newest) if feedback.cycle_index < newest.cycle_index => *view = ArmView::UNKNOWN,
            Some(_) | None => {}
        }
        view.newest = Some(*feedback);
        match feedback.session_state() {
            Some(SessionState::Idle) => {
                let wait = if view.has_run {
                    self.trigger_after
                } else {
                    Duration::ZERO
                };
                view.ask_at.get_or_insert(now + wait);
            }
            Some(state) => {
                view.ask_at = None;
                view.back_off = BACK_OFF_MIN;
                view.has_run |= state == SessionState::Running;
            }
            None => {}
        }
    }

    /// Takes note of an answer.
    pub(crate) fn on_response(&mut self, response: &MotionResponse) {
        // Busy and running pass by themselves; these do not, however often one asks.
        const LASTING: [MotionRefusal; 3] = [
            MotionRefusal::UnknownKind,
            MotionRefusal::NoArm,
            MotionRefusal::BadNumber,
        ];
        let is_refused = response.outcome == MotionOutcome::Refused as u32;
        self.is_hopeless |= is_refused
            && LASTING
                .into_iter()
                .any(|refusal| response.refusal == refusal as u32);
    }

    /// When it next wants to ask.
    pub(crate) fn next_ask(&self) -> Option<Instant> {
        if self.is_hopeless {
            return None;
        }
        self.arms.iter().filter_map(|view| view.ask_at).min()
    }

    /// The request that is due, for all arms that need one by now.
    pub(crate) fn ask(&mut self, now: Instant) -> Option<MotionRequest> {
        if self.is_hopeless {
            return None;
        }
        let mut arms = 0;
        for (side, view) in Side::BOTH.into_iter().zip(&mut self.arms) {
            if view.ask_at.is_some_and(|due| due <= now) {
                arms |= MotionRequest::bit(side);
                // Requests and feedback can get lost: once more, unless the feedback says that
                // the arm is on its way.
                view.ask_at = Some(now + view.back_off);
                view.back_off = (view.back_off * 2).min(BACK_OFF_MAX);
            }
        }
        if arms == 0 {
            return None;
        }
        let request_id = self.next_request_id;
        self.next_request_id += 1;
        Some(MotionRequest {
            request_id,
            kind: MotionKind::EgmStart as u32,
            arms,
            joints_rad: [[0.0; JOINT_COUNT]; 2],
            poses: [Pose::zeroed(); 2],
            speed: 0.0,
            egm: self.parameters,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn feedback(cycle_index: u64, clock_ms: u32) -> EgmFeedback {
        EgmFeedback {
            cycle_index,
            clock_ms,
            ..EgmFeedback::zeroed()
        }
    }

    #[test]
    fn feedback_after_a_restart_is_newer_and_late_feedback_is_not() {
        let newest = feedback(2000, 8000);
        let is_newer = |cycle_index, clock_ms| is_newer(&feedback(cycle_index, clock_ms), &newest);
        assert!(is_newer(2001, 8004));
        for clock_ms in [0, 4, 4000, 7999] {
            assert!(
                is_newer(2001, clock_ms),
                "a foreign robot's clock restarted"
            );
        }
        assert!(is_newer(0, 9000), "our robot's process restarted");
        assert!(is_newer(0, 8000_u32.wrapping_sub(10_001)), "and its host");
        assert!(!is_newer(2000, 8000), "repeated");
        assert!(!is_newer(1999, 7996), "late");
        assert!(!is_newer(1999, 8000), "late, both within one millisecond");
    }

    #[test]
    fn an_arm_whose_foreign_robot_restarted_leaves_its_old_session_at_once() {
        let mut arm = ArmSender::new(Side::Right);
        let old = EgmFeedback {
            session: 1,
            ..feedback(2000, 8000)
        };
        arm.on_feedback(&old);
        let new = EgmFeedback {
            session: 2,
            ..feedback(2001, 0)
        };
        arm.on_feedback(&new);
        assert_eq!(arm.newest.map(|newest| newest.session), Some(2));
    }
}
