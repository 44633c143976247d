//! The right arm's commands and feedback as a run's log has them, on one time axis: the robot's
//! clock. It judges nothing.

use crate::{EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState};
use hil_arm::yumi::arm::Arm;
use hil_core::message::Envelope;
use hil_core::run_log::RunLog;
use hil_core::score::MessageRef;
use hil_core::time::Instant;
use hil_stats::series::Sample;

/// One command of the log.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Command {
    /// Its publication; see [`Record::shift_ns`].
    pub(crate) at_ns: i64,
    pub(crate) frame_index: u64,
    pub(crate) flags: u32,
    /// The tool where it sends the arm, body frame.
    pub(crate) tool_m: [f64; 3],
    pub(crate) message: MessageRef,
}

impl Command {
    const CLIPPED: u32 = EgmCommand::UNREACHABLE | EgmCommand::LIMITED;

    /// True when inverse kinematics did not reach the hand.
    pub(crate) fn is_clipped(&self) -> bool {
        self.flags & Self::CLIPPED != 0
    }
}

/// One feedback of the log.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Feedback {
    pub(crate) at_ns: i64,
    pub(crate) reference_frame_index: u64,
    pub(crate) reference_age_ns: i64,
    pub(crate) session: u32,
    pub(crate) state: Option<SessionState>,
    pub(crate) flags: u32,
    pub(crate) tool_m: [f64; 3],
}

impl Feedback {
    pub(crate) const fn has(&self, bit: u32) -> bool {
        self.flags & bit != 0
    }

    pub(crate) fn is_running(&self) -> bool {
        self.state == Some(SessionState::Running)
    }
}

/// The right arm's part of a log.
#[derive(Debug, Default)]
pub(crate) struct Record {
    pub(crate) commands: Vec<Command>,
    pub(crate) feedback: Vec<Feedback>,
    /// What was added to the commands' stamps, where the clocks are not aligned.
    pub(crate) shift_ns: i64,
}

impl Record {
    pub(crate) fn read(log: &RunLog) -> Self {
        let mut record = Self {
            commands: commands(log),
            feedback: feedback(log),
            shift_ns: 0,
        };
        if !log.has_one_clock() {
            record.shift_ns = record
                .fastest_answer_ns()
                .unwrap_or_else(|| record.start_ns());
            for command in &mut record.commands {
                command.at_ns += record.shift_ns;
            }
        }
        record
    }

    /// From a command's stamp to that of the feedback which first says it is in use, at the
    /// smallest: what separates the clocks, but for the fastest command's way and a cycle or two.
    fn fastest_answer_ns(&self) -> Option<i64> {
        let mut next = 0;
        let mut fastest: Option<i64> = None;
        for feedback in &self.feedback {
            if !feedback.has(EgmFeedback::HAS_REFERENCE) || !feedback.has(EgmFeedback::TOOK_COMMAND)
            {
                continue;
            }
            let frame_index = feedback.reference_frame_index;
            let commands = &self.commands;
            while next < commands.len() && commands[next].frame_index < frame_index {
                next += 1;
            }
            let Some(command) = commands.get(next) else {
                break;
            };
            if command.frame_index == frame_index {
                let apart_ns = feedback.at_ns - command.at_ns;
                fastest = Some(fastest.map_or(apart_ns, |known| known.min(apart_ns)));
            }
        }
        fastest
    }

    /// Hosts start together within milliseconds, which is nothing against a motion loop.
    fn start_ns(&self) -> i64 {
        let command = self.commands.first().map_or(0, |command| command.at_ns);
        self.feedback.first().map_or(0, |first| first.at_ns) - command
    }

    /// Commanded tool y.
    pub(crate) fn sent_y(&self) -> Vec<Sample> {
        let samples = self.commands.iter();
        samples
            .map(|command| (command.at_ns, command.tool_m[1]))
            .filter(|sample| sample.1.is_finite())
            .collect()
    }

    /// Measured tool y.
    pub(crate) fn moved_y(&self) -> Vec<Sample> {
        let samples = self.feedback.iter();
        samples
            .map(|feedback| (feedback.at_ns, feedback.tool_m[1]))
            .filter(|sample| sample.1.is_finite())
            .collect()
    }

    /// The commands that were under way when the robot had none to use: those after the one in
    /// use at `begin_ns`, up to the one in use at `end_ns`. Empty where frame numbers do not tell.
    pub(crate) fn commands_between(&self, begin_ns: i64, end_ns: i64) -> &[Command] {
        let reference_at = |at_ns: i64| {
            let next = self.feedback.partition_point(|known| known.at_ns <= at_ns);
            let mut before = self.feedback[..next].iter().rev();
            // Between sessions nothing is in use; the last one that was, counts.
            before.find(|known| known.has(EgmFeedback::HAS_REFERENCE))
        };
        let begin = match reference_at(begin_ns) {
            Some(feedback) => self.after_frame(feedback.reference_frame_index),
            None => 0,
        };
        let end = self.commands.partition_point(|known| known.at_ns <= end_ns);
        self.commands.get(begin..end).unwrap_or(&[])
    }

    /// Number of commands up to and with this frame.
    fn after_frame(&self, frame_index: u64) -> usize {
        self.commands
            .partition_point(|command| command.frame_index <= frame_index)
    }
}

fn commands(log: &RunLog) -> Vec<Command> {
    let arm = Arm::right();
    let command = |(envelope, message): (Envelope, EgmCommand)| Command {
        at_ns: envelope.published_ns,
        frame_index: message.frame_index,
        flags: message.flags,
        tool_m: arm.tool(&message.position_rad).translation.vector.into(),
        message: MessageRef::of(EGM_RIGHT_COMMAND, &envelope),
    };
    logged(log, EGM_RIGHT_COMMAND).map(command).collect()
}

fn feedback(log: &RunLog) -> Vec<Feedback> {
    // Not the tool the robot names: a foreign one may say it in a frame of its own.
    let arm = Arm::right();
    let feedback = |(at, message): (Instant, EgmFeedback)| Feedback {
        at_ns: at.as_ns(),
        reference_frame_index: message.reference_frame_index,
        reference_age_ns: message.reference_age_ns,
        session: message.session,
        state: message.session_state(),
        flags: message.flags,
        tool_m: arm.tool(&message.measured_rad).translation.vector.into(),
    };
    log.messages(EGM_RIGHT_FEEDBACK).map(feedback).collect()
}

/// The messages of `channel` with their envelopes.
fn logged<'a>(log: &'a RunLog, channel: &str) -> impl Iterator<Item = (Envelope, EgmCommand)> + 'a {
    log.raw(channel).iter().filter_map(|logged| {
        let message = bytemuck::try_pod_read_unaligned(&logged.payload).ok()?;
        Some((logged.envelope, message))
    })
}
