//! The seed paper's Figures 6 to 11 from a run log: what the human did, where the tool went, joints
//! and their error. Columns of numbers; it draws nothing.

use crate::messages::HumanFrame;
use crate::score::Run;
use crate::score::loops::LossCause;
use crate::score::record::Record;
use crate::{EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, HUMAN_FRAME};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_arm::yumi::arm::Arm;
use hil_arm::yumi::{JOINT_COUNT, Joints};
use hil_core::case_study::ErrorSeries;
use hil_core::plot::{PlotColumn, PlotSeries};
use hil_core::run_log::RunLog;
use hil_core::time::Instant;

/// Rows a series has at most; a longer one keeps every n-th.
const ROWS_MAX: usize = 200_000;

const TIME: PlotColumn = column("time_s", "time since the robot's first feedback", "s");

const fn column(name: &'static str, label: &'static str, unit: &'static str) -> PlotColumn {
    PlotColumn { name, label, unit }
}

/// All figures the log has messages for.
pub(crate) fn series(log: &RunLog) -> Vec<PlotSeries> {
    let record = Record::read(log);
    let (robot, human) = match record.feedback.first() {
        Some(first) => (first.at_ns, first.at_ns - record.shift_ns),
        None => (0, 0),
    };
    let rows = RobotSeries {
        log,
        origin_ns: robot,
        shift: (!log.has_one_clock()).then_some(record.shift_ns),
    };
    let all = [
        input(log, human),
        rows.tool_y(),
        rows.joints(),
        rows.joint_error(),
    ];
    all.into_iter().flatten().collect()
}

/// The largest error of any joint of the right arm at each feedback, newest command sent by then
/// minus measured.
pub(crate) fn joint_error_over_time(log: &RunLog) -> Vec<ErrorSeries> {
    let record = Record::read(log);
    let shift = (!log.has_one_clock()).then_some(record.shift_ns);
    let cycles = log.with_newest(EGM_RIGHT_FEEDBACK, EGM_RIGHT_COMMAND, shift);
    let samples = cycles.filter_map(|(at, feedback, command): (_, EgmFeedback, _)| {
        let desired = desired_rad(Some(command?));
        let joints = desired.iter().zip(&feedback.measured_rad);
        let errors = joints.map(|(desired, measured)| (desired - measured).abs());
        let largest = errors.fold(0.0, f64::max);
        largest.is_finite().then_some((at, largest))
    });
    vec![ErrorSeries {
        name: "joint_error_rad",
        label: "joint error of the right arm",
        unit: "rad",
        clock_of: EGM_RIGHT_FEEDBACK,
        samples: samples.collect(),
    }]
}

/// What became of every motion loop; `None` without a whole one.
pub(crate) fn motion_loops(run: &Run) -> Option<PlotSeries> {
    let loops = run.counter.count(&run.sent.samples, &run.moved)?;
    let since_s = |at_ns: i64| seconds(Instant::from_ns(at_ns), run.origin_ns());
    let mut causes = vec![None; loops.sent_count()];
    for lost in &loops.lost {
        let evidence = &run.sessions.evidence;
        causes[lost.index] = Some(evidence.cause_of(lost.due_ns, run.counter.period_ns));
    }
    let rows = loops.sent_ns.iter().zip(&loops.answered_ns).zip(&causes);
    let values = rows
        .enumerate()
        .flat_map(|(index, ((sent, executed), cause))| {
            [
                index as f64 + 1.0,
                since_s(*sent),
                executed.map_or(f64::NAN, since_s),
                f64::from(u8::from(cause.is_some())),
                cause.map_or(0.0, |cause: LossCause| f64::from(cause.kind() as u8 + 1)),
            ]
        });
    Some(PlotSeries {
        name: "motion-loops".to_owned(),
        title: "Motion loops: when sent, when executed, which were lost".to_owned(),
        notes: vec![
            format!("times are those of {}", run.counter.text()),
            "cause: 0 not lost, 1 no session, 2 held for want of commands, 3 inverse kinematics, \
             4 throttled by MaxSpeedDeviation, 5 merged with a neighbour"
                .to_owned(),
        ],
        panel_lines: None,
        columns: vec![
            column("loop_index", "motion loop, from 1 as in the events", "1"),
            column("sent_s", "sent, since the robot's first feedback", "s"),
            column(
                "executed_s",
                "executed, since the robot's first feedback",
                "s",
            ),
            column("lost", "1 when no executed loop answers it", "1"),
            column("cause", "why it was lost, by the notes' numbers", "1"),
        ],
        values: values.collect(),
    })
}

/// Of so many rows, every how many-th is kept.
fn thinning(count: usize) -> usize {
    count.div_ceil(ROWS_MAX).max(1)
}

fn thinning_note(every: usize) -> Option<String> {
    (every > 1).then(|| format!("every {every}th message is shown"))
}

fn seconds(at: Instant, origin_ns: i64) -> f64 {
    at.as_ns().saturating_sub(origin_ns) as f64 * 1e-9
}

fn input(log: &RunLog, origin_ns: i64) -> Option<PlotSeries> {
    let every = thinning(log.raw(HUMAN_FRAME).len());
    let frames = log.messages::<HumanFrame>(HUMAN_FRAME);
    let values: Vec<f64> = frames
        .step_by(every)
        .flat_map(|(at, frame)| [seconds(at, origin_ns), frame.right_hand.position_m[0]])
        .collect();
    (!values.is_empty()).then(|| PlotSeries {
        name: "fig6-input".to_owned(),
        title: "Input human motion: side-to-side position of the right hand".to_owned(),
        notes: thinning_note(every).into_iter().collect(),
        panel_lines: None,
        columns: vec![
            TIME,
            column(
                "hand_lateral_m",
                "right hand, towards the person's left",
                "m",
            ),
        ],
        values,
    })
}

/// Series with a row for each feedback of the right arm.
struct RobotSeries<'a> {
    log: &'a RunLog,
    /// Zero of the time column.
    origin_ns: i64,
    /// Added to the commands' stamps when their clock is not aligned with the robot's.
    shift: Option<i64>,
}

impl RobotSeries<'_> {
    /// The series whose columns behind the time `row` fills.
    fn series(
        &self,
        name: &str,
        title: &str,
        note: Option<&str>,
        columns: impl IntoIterator<Item = PlotColumn>,
        row: impl Fn(&EgmFeedback, Option<EgmCommand>, &mut Vec<f64>),
    ) -> Option<PlotSeries> {
        let every = thinning(self.log.raw(EGM_RIGHT_FEEDBACK).len());
        let mut values = Vec::new();
        let cycles = self
            .log
            .with_newest(EGM_RIGHT_FEEDBACK, EGM_RIGHT_COMMAND, self.shift);
        for (at, feedback, command) in cycles.step_by(every) {
            let command: Option<EgmCommand> = command;
            values.push(seconds(at, self.origin_ns));
            row(&feedback, command, &mut values);
        }
        let notes = note.map(str::to_owned).into_iter();
        let notes = notes.chain(thinning_note(every)).chain(self.clock_note());
        (!values.is_empty()).then(|| PlotSeries {
            name: name.to_owned(),
            title: title.to_owned(),
            notes: notes.collect(),
            panel_lines: None,
            columns: [TIME].into_iter().chain(columns).collect(),
            values,
        })
    }

    fn clock_note(&self) -> Option<String> {
        if let Some(shift_ns) = self.shift {
            return Some(format!(
                "commands and feedback were stamped by two clocks; {shift_ns} ns were added to the \
                 commands' stamps, as if the fastest had taken no time"
            ));
        }
        let bound_ns = self.log.clock_bound_ns();
        (bound_ns > 0).then(|| {
            format!(
                "commands and feedback were stamped by two clocks; the commands' stamps are on the \
                 robot's, by an alignment within {:.1} us",
                bound_ns as f64 * 1e-3
            )
        })
    }

    fn tool_y(&self) -> Option<PlotSeries> {
        let arm = Arm::right();
        self.series(
            "fig7-9-tool-y",
            "Robot position: y of the right tool, measured and commanded",
            None,
            [
                column("measured_tool_y_m", "measured, robot's body frame", "m"),
                column("commanded_tool_y_m", "newest command sent by then", "m"),
            ],
            |feedback, command, values| {
                values.push(arm.tool(&feedback.measured_rad).translation.y);
                values.push(command.map_or(f64::NAN, |known| {
                    arm.tool(&known.position_rad).translation.y
                }));
            },
        )
    }

    fn joints(&self) -> Option<PlotSeries> {
        let joints = self.series(
            "fig10-joints",
            "Desired and measured joint positions",
            Some(JOINT_NOTE),
            DESIRED.into_iter().zip(MEASURED).flat_map(<[_; 2]>::from),
            |feedback, command, values| {
                let joints = desired_rad(command).into_iter().zip(feedback.measured_rad);
                values.extend(joints.flat_map(<[_; 2]>::from));
            },
        )?;
        Some(PlotSeries {
            panel_lines: Some(2),
            ..joints
        })
    }

    fn joint_error(&self) -> Option<PlotSeries> {
        self.series(
            "fig11-joint-error",
            "Joint position error: desired minus measured",
            Some(JOINT_NOTE),
            ERROR,
            |feedback, command, values| {
                let joints = desired_rad(command).into_iter().zip(feedback.measured_rad);
                values.extend(joints.map(|(desired, measured)| desired - measured));
            },
        )
    }
}

/// Columns of all joints in chain order, by the maker's numbers: `<key>_j1_rad` and so on, titled
/// `joint 1<title>`.
macro_rules! of_joints {
    ($key:literal, $title:literal) => {
        of_joints!($key, $title, 1, 2, 7, 3, 4, 5, 6)
    };
    ($key:literal, $title:literal, $($joint:literal),+) => {
        [$(column(
            concat!($key, "_j", $joint, "_rad"),
            concat!("joint ", $joint, $title),
            "rad",
        )),+]
    };
}

const DESIRED: [PlotColumn; JOINT_COUNT] = of_joints!("desired", " desired");
const MEASURED: [PlotColumn; JOINT_COUNT] = of_joints!("measured", " measured");
const ERROR: [PlotColumn; JOINT_COUNT] = of_joints!("error", ", desired minus measured");

const JOINT_NOTE: &str = "right arm, joints in chain order, the maker's numbers; desired: newest \
                          command sent by then";

fn desired_rad(command: Option<EgmCommand>) -> Joints {
    command.map_or([f64::NAN; JOINT_COUNT], |known| known.position_rad)
}
