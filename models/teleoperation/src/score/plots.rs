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
    let shift = (!log.has_one_clock()).then_some(record.shift_ns);
    let rows = Thinned::of(log.raw(EGM_RIGHT_FEEDBACK).len());
    let all = [
        input(log, human),
        tool_y(log, rows, (robot, shift)),
        joints(log, rows, (robot, shift)),
        joint_error(log, rows, (robot, shift)),
    ];
    all.into_iter().flatten().collect()
}

/// The largest error of any joint of the right arm at each feedback, newest command sent by then
/// minus measured.
pub(crate) fn joint_error_over_time(log: &RunLog) -> Vec<ErrorSeries> {
    let record = Record::read(log);
    let shift = (!log.has_one_clock()).then_some(record.shift_ns);
    let samples = paired(log, shift).filter_map(|(at, feedback, command)| {
        let desired = desired_rad(Some(command?));
        let joints = desired.iter().zip(&feedback.measured_rad);
        let errors = joints.map(|(desired, measured)| (desired - measured).abs());
        let largest = errors.fold(0.0, f64::max);
        largest.is_finite().then_some((at, largest))
    });
    vec![ErrorSeries {
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
                cause.map_or(0.0, |cause: LossCause| cause.kind() as f64 + 1.0),
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

/// Which rows are kept.
#[derive(Debug, Clone, Copy)]
struct Thinned {
    every: usize,
}

impl Thinned {
    fn of(count: usize) -> Self {
        Self {
            every: count.div_ceil(ROWS_MAX).max(1),
        }
    }

    fn note(self) -> Option<String> {
        (self.every > 1).then(|| format!("every {}th message is shown", self.every))
    }
}

fn seconds(at: Instant, origin_ns: i64) -> f64 {
    at.as_ns().saturating_sub(origin_ns) as f64 * 1e-9
}

fn input(log: &RunLog, origin_ns: i64) -> Option<PlotSeries> {
    let thinned = Thinned::of(log.raw(HUMAN_FRAME).len());
    let frames = log.messages::<HumanFrame>(HUMAN_FRAME);
    let values: Vec<f64> = frames
        .step_by(thinned.every)
        .flat_map(|(at, frame)| [seconds(at, origin_ns), frame.right_hand.position_m[0]])
        .collect();
    (!values.is_empty()).then(|| PlotSeries {
        name: "fig6-input".to_owned(),
        title: "Input human motion: side-to-side position of the right hand".to_owned(),
        notes: thinned.note().into_iter().collect(),
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

/// Feedback with the newest command published by then.
fn paired(
    log: &RunLog,
    shift: Option<i64>,
) -> impl Iterator<Item = (Instant, EgmFeedback, Option<EgmCommand>)> + '_ {
    let mut commands = log.messages::<EgmCommand>(EGM_RIGHT_COMMAND).peekable();
    let mut newest = None;
    let shift_ns = shift.unwrap_or(0);
    log.messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK)
        .map(move |(at, feedback)| {
            let is_sent = |sent: &Instant| sent.as_ns().saturating_add(shift_ns) <= at.as_ns();
            while let Some((_, command)) = commands.next_if(|next| is_sent(&next.0)) {
                newest = Some(command);
            }
            (at, feedback, newest)
        })
}

fn notes(log: &RunLog, rows: Thinned, shift: Option<i64>) -> Vec<String> {
    let aligned = (log.clock_bound_ns() > 0).then(|| {
        format!(
            "commands and feedback were stamped by two clocks; the commands' stamps are on the \
             robot's, by an alignment within {:.1} us",
            log.clock_bound_ns() as f64 * 1e-3
        )
    });
    let shifted = shift.map(|shift_ns| {
        format!(
            "commands and feedback were stamped by two clocks; {shift_ns} ns were added to the \
             commands' stamps, as if the fastest had taken no time"
        )
    });
    let clocks = shifted.or(aligned);
    rows.note().into_iter().chain(clocks).collect()
}

fn tool_y(
    log: &RunLog,
    rows: Thinned,
    (origin_ns, shift): (i64, Option<i64>),
) -> Option<PlotSeries> {
    let arm = Arm::right();
    let commanded_m = |command: Option<EgmCommand>| {
        command.map_or(f64::NAN, |known| {
            arm.tool(&known.position_rad).translation.y
        })
    };
    let values: Vec<f64> = paired(log, shift)
        .step_by(rows.every)
        .flat_map(|(at, feedback, command)| {
            let measured_m = arm.tool(&feedback.measured_rad).translation.y;
            [seconds(at, origin_ns), measured_m, commanded_m(command)]
        })
        .collect();
    (!values.is_empty()).then(|| PlotSeries {
        name: "fig7-9-tool-y".to_owned(),
        title: "Robot position: y of the right tool, measured and commanded".to_owned(),
        notes: notes(log, rows, shift),
        columns: vec![
            TIME,
            column("measured_tool_y_m", "measured, robot's body frame", "m"),
            column("commanded_tool_y_m", "newest command sent by then", "m"),
        ],
        values,
    })
}

const DESIRED: [PlotColumn; JOINT_COUNT] = [
    column("desired_j1_rad", "joint 1 desired", "rad"),
    column("desired_j2_rad", "joint 2 desired", "rad"),
    column("desired_j7_rad", "joint 7 desired", "rad"),
    column("desired_j3_rad", "joint 3 desired", "rad"),
    column("desired_j4_rad", "joint 4 desired", "rad"),
    column("desired_j5_rad", "joint 5 desired", "rad"),
    column("desired_j6_rad", "joint 6 desired", "rad"),
];

const MEASURED: [PlotColumn; JOINT_COUNT] = [
    column("measured_j1_rad", "joint 1 measured", "rad"),
    column("measured_j2_rad", "joint 2 measured", "rad"),
    column("measured_j7_rad", "joint 7 measured", "rad"),
    column("measured_j3_rad", "joint 3 measured", "rad"),
    column("measured_j4_rad", "joint 4 measured", "rad"),
    column("measured_j5_rad", "joint 5 measured", "rad"),
    column("measured_j6_rad", "joint 6 measured", "rad"),
];

const ERROR: [PlotColumn; JOINT_COUNT] = [
    column("error_j1_rad", "joint 1, desired minus measured", "rad"),
    column("error_j2_rad", "joint 2, desired minus measured", "rad"),
    column("error_j7_rad", "joint 7, desired minus measured", "rad"),
    column("error_j3_rad", "joint 3, desired minus measured", "rad"),
    column("error_j4_rad", "joint 4, desired minus measured", "rad"),
    column("error_j5_rad", "joint 5, desired minus measured", "rad"),
    column("error_j6_rad", "joint 6, desired minus measured", "rad"),
];

const JOINT_NOTE: &str = "right arm, joints in chain order, the maker's numbers; desired: newest \
                          command sent by then";

fn desired_rad(command: Option<EgmCommand>) -> Joints {
    command.map_or([f64::NAN; JOINT_COUNT], |known| known.position_rad)
}

fn joints(
    log: &RunLog,
    rows: Thinned,
    (origin_ns, shift): (i64, Option<i64>),
) -> Option<PlotSeries> {
    let mut values = Vec::new();
    for (at, feedback, command) in paired(log, shift).step_by(rows.every) {
        values.push(seconds(at, origin_ns));
        values.extend(desired_rad(command));
        values.extend(feedback.measured_rad);
    }
    let columns = [TIME].into_iter().chain(DESIRED).chain(MEASURED);
    (!values.is_empty()).then(|| PlotSeries {
        name: "fig10-joints".to_owned(),
        title: "Desired and measured joint positions".to_owned(),
        notes: [JOINT_NOTE.to_owned()]
            .into_iter()
            .chain(notes(log, rows, shift))
            .collect(),
        columns: columns.collect(),
        values,
    })
}

fn joint_error(
    log: &RunLog,
    rows: Thinned,
    (origin_ns, shift): (i64, Option<i64>),
) -> Option<PlotSeries> {
    let mut values = Vec::new();
    for (at, feedback, command) in paired(log, shift).step_by(rows.every) {
        values.push(seconds(at, origin_ns));
        let desired = desired_rad(command);
        values.extend((0..JOINT_COUNT).map(|joint| desired[joint] - feedback.measured_rad[joint]));
    }
    (!values.is_empty()).then(|| PlotSeries {
        name: "fig11-joint-error".to_owned(),
        title: "Joint position error: desired minus measured".to_owned(),
        notes: [JOINT_NOTE.to_owned()]
            .into_iter()
            .chain(notes(log, rows, shift))
            .collect(),
        columns: [TIME].into_iter().chain(ERROR).collect(),
        values,
    })
}
