//! The commands of a whole run, computed once and shared by all of its repetitions: what the real
//! controller role makes of the human's frames. It sends nothing.

use core::time::Duration;

use bytemuck::Zeroable;

use crate::messages::HumanFrame;
use crate::score::loops::LoopCounter;
use crate::{
    EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, HUMAN_FRAME, ResumePolicy, SendPolicy, Teleoperation,
};
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use hil_arm::egm::parameters::{ControllerSettings, StartMode};
use hil_arm::yumi::arm::{Arm, RIGHT_START_RAD};
use hil_core::case_study::{CaseStudy, ParameterError};
use hil_core::time::{Instant, duration_ns};
use hil_stats::series::{Sample, peaks};

/// Right-arm commands frame by frame, and the loops in them.
#[derive(Debug)]
pub(crate) struct Trajectory {
    /// From frame to frame.
    pub(crate) frame_ns: i64,
    /// The frame at which the controller engages: the first in `commands`.
    first_frame: i64,
    commands: Vec<EgmCommand>,
    /// When the sent loops have their peaks.
    pub(crate) sent_peaks_ns: Vec<i64>,
    /// What counts as a loop.
    pub(crate) counter: LoopCounter,
    /// When a run ends.
    pub(crate) end: Instant,
}

impl Trajectory {
    /// The commands of `loops` motion loops.
    ///
    /// # Errors
    /// When the motion has no such loops: a motion file whose hand stands still.
    pub(crate) fn new(case: &Teleoperation, loops: u32) -> Result<Self, ParameterError> {
        let mut case = case.clone();
        // Frame by frame, wherever the arm is: the policies of sending come later.
        case.parameters.send = SendPolicy::Frame;
        case.parameters.resume = ResumePolicy::Jump;
        let period_s = case.parameters.motion_period_s;
        let counter = LoopCounter::new(case.nominal_peak_to_peak_m(), period_s);
        let frame_ns = duration_ns(case.parameters.frame_period());
        let first_frame = running_from(&case.settings).as_ns() / frame_ns + 1;
        let length_s = case.parameters.motion_start_s + (f64::from(loops) + 2.0) * period_s;
        let frame_count = whole(length_s * 1e9 / frame_ns as f64);
        let commands = commands(&case, first_frame, frame_count);
        let sent = tool_y(&commands, first_frame, frame_ns);
        let mut sent_peaks_ns = peaks(&sent, counter.prominence_m);
        sent_peaks_ns.truncate(loops as usize);
        let last_ns = match sent_peaks_ns.last() {
            Some(last_ns) if sent_peaks_ns.len() == loops as usize => *last_ns,
            _ => {
                let problem = format!(
                    "{loops} cannot be counted: the motion has {} loops in their time",
                    sent_peaks_ns.len()
                );
                return Err(ParameterError::new("tables.loops", problem));
            }
        };
        let rest = Duration::from_secs_f64(0.75 * period_s);
        Ok(Self {
            frame_ns,
            first_frame,
            commands,
            sent_peaks_ns,
            counter,
            end: Instant::from_ns(last_ns) + rest,
        })
    }

    /// When the first command is sent.
    pub(crate) fn begin_ns(&self) -> i64 {
        self.first_frame * self.frame_ns
    }

    /// What the controller would send at `at`: the newest frame's command.
    pub(crate) fn at(&self, at: Instant) -> Option<&EgmCommand> {
        let index = at.as_ns() / self.frame_ns - self.first_frame;
        self.commands.get(usize::try_from(index).ok()?)
    }
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "thousands of loops of at most a minute, a thousand frames a second"
)]
fn whole(value: f64) -> i64 {
    value.ceil() as i64
}

/// When guided motion runs, asked for in the robot's first cycle over a perfect channel.
fn running_from(settings: &ControllerSettings) -> Instant {
    let mut arm = requested(settings);
    let mut at = Instant::ZERO;
    while arm.state() != SessionState::Running {
        at = at + settings.cycle;
        arm.cycle(at, &mut |_| {});
    }
    at
}

/// The right arm after its first cycle, with guided motion asked for.
pub(crate) fn requested(settings: &ControllerSettings) -> Controller {
    let settings = ControllerSettings {
        start: StartMode::Request,
        ..*settings
    };
    let mut arm = Controller::new(Side::Right, settings, RIGHT_START_RAD);
    arm.cycle(Instant::ZERO, &mut |_| {});
    arm.start_guided_motion(&hil_arm::egm::messages::EgmStartParameters::KEEP)
        .expect("an idle arm starts with its own settings");
    arm
}

/// Lets the controller role follow the human from `first_frame` on, with an arm that runs and
/// stands in its start posture.
fn commands(case: &Teleoperation, first_frame: i64, frame_count: i64) -> Vec<EgmCommand> {
    let mut controller = case.role("controller").expect("the case has this role");
    controller.start(Instant::ZERO);
    let mut player = case.player();
    let frame_ns = duration_ns(case.parameters.frame_period());
    let mut commands = Vec::with_capacity(usize::try_from(frame_count).unwrap_or(0));
    let right = controller.output(EGM_RIGHT_COMMAND);
    let mut emit = |port, bytes: &[u8]| {
        if port == right {
            commands.push(bytemuck::pod_read_unaligned(bytes));
        }
    };
    let at = Instant::ZERO;
    controller.hear(at, EGM_RIGHT_FEEDBACK, &running_feedback(), &mut emit);
    for frame in first_frame..first_frame + frame_count {
        let source_time_ns = frame * frame_ns;
        let pose = player.at(source_time_ns as f64 * 1e-9);
        let message = HumanFrame {
            frame_index: frame.unsigned_abs(),
            source_time_ns,
            root: pose.root.into(),
            right_hand: pose.right_hand.into(),
            left_hand: pose.left_hand.into(),
        };
        controller.hear(at, HUMAN_FRAME, &message, &mut emit);
    }
    commands
}

fn running_feedback() -> EgmFeedback {
    EgmFeedback {
        measured_rad: RIGHT_START_RAD,
        planned_rad: RIGHT_START_RAD,
        tool: Arm::right().tool(&RIGHT_START_RAD).into(),
        session: 1,
        state: SessionState::Running as u32,
        ..EgmFeedback::zeroed()
    }
}

fn tool_y(commands: &[EgmCommand], first_frame: i64, frame_ns: i64) -> Vec<Sample> {
    let arm = Arm::right();
    let frames = (first_frame..).zip(commands);
    frames
        .map(|(frame, command)| {
            let tool_y_m = arm.tool(&command.position_rad).translation.y;
            (frame * frame_ns, tool_y_m)
        })
        .collect()
}
