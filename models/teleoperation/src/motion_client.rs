//! The controller's motion client: asks for guided motion when an arm has none, and asks again
//! until it runs. It sends nothing itself and knows no hand.

use core::time::Duration;

use bytemuck::Zeroable;

use crate::controller::is_newer;
use hil_arm::egm::messages::{
    EgmFeedback, EgmStartParameters, MotionKind, MotionOutcome, MotionRefusal, MotionRequest,
    MotionResponse, SessionState, Side,
};
use hil_arm::yumi::{JOINT_COUNT, Pose};
use hil_core::time::Instant;

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
