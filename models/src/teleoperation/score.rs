//! What the robot made of the motion: motion loops, joint error, lag, holds. It reads the run log
//! and nothing else, in time linear in the log's length.
//!
//! Commands and statuses are compared by the publication times the two producers stamped, so
//! both must have read one clock. Where they did not, joint error and lag are unavailable.

use crate::case_study::{Metric, Score};
use crate::egm::messages::{EgmCommand, EgmFeedback};
use crate::run_log::RunLog;
use crate::teleoperation::series::{
    Estimate, Sample, lag_s, peak_to_peak, peaks, poisson_interval,
};
use crate::teleoperation::{EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, Teleoperation};
use crate::time::Instant;
use crate::yumi::arm::Arm;
use crate::yumi::{JOINT_COUNT, Joints};

/// A motion loop counts when the tool falls back by this share of the nominal peak-to-peak.
const PROMINENCE_RATIO: f64 = 0.5;

/// Scores a run.
pub(crate) fn score(case: &Teleoperation, log: &RunLog) -> Score {
    let period_s = case.parameters.motion_period_s;
    let mut sent = Sent::read(log);
    let mut moved = Moved::read(log, period_s);
    if !log.has_one_clock() {
        // Hosts start together within milliseconds, which is nothing against a motion loop.
        for series in [&mut sent.tool_y, &mut moved.tool_y] {
            let start = series.first().map_or(0, |(at, _)| *at);
            for (at, _) in series.iter_mut() {
                *at -= start;
            }
        }
    }
    let mut metrics = Vec::from(motion_loops(case, &sent.tool_y, &moved.tool_y));
    metrics.extend(moved.joint_error());
    metrics.push(tracking_lag(&sent.tool_y, &moved.tool_y, period_s));
    let swung = after_rest(&moved.tool_y, case.parameters.motion_start_s);
    metrics.push(tool_travel(swung, period_s));
    metrics.extend(events(&sent, &moved));
    if !log.has_one_clock() {
        for metric in &mut metrics {
            withdraw_if_it_compares_clocks(metric);
        }
    }
    Score {
        metrics,
        ..Score::default()
    }
}

/// Error and lag set a command's stamp against a status's: without one clock there is no figure.
fn withdraw_if_it_compares_clocks(metric: &mut Metric) {
    let compares = metric.name.starts_with("joint_error") || metric.name == "tracking_lag_ms";
    if compares {
        metric.value = None;
        metric.interval = None;
        "commands and statuses were stamped by two clocks that are not aligned"
            .clone_into(&mut metric.method);
    }
}

/// What the controller sent.
#[derive(Debug, Default)]
struct Sent {
    tool_y: Vec<Sample>,
    failure_count: u64,
    limited_count: u64,
}

impl Sent {
    fn read(log: &RunLog) -> Self {
        const LIMITED: u32 = EgmCommand::LIMITED | EgmCommand::JUMP_LIMITED;
        let arm = Arm::right();
        let mut sent = Self::default();
        for (at, command) in log.messages::<EgmCommand>(EGM_RIGHT_COMMAND) {
            let tool_y_m = arm.tool(&command.position_rad).translation.y;
            sent.tool_y.push((at.as_ns(), tool_y_m));
            sent.failure_count += u64::from(command.flags & EgmCommand::UNREACHABLE != 0);
            sent.limited_count += u64::from(command.flags & LIMITED != 0);
        }
        sent
    }
}

/// What the robot did.
#[derive(Debug, Default)]
struct Moved {
    tool_y: Vec<Sample>,
    hold_count: u64,
    holding_count: u64,
    error: ErrorSums,
}

/// Sums over the right arm's joints and all statuses after the first command.
#[derive(Debug, Default)]
struct ErrorSums {
    count: f64,
    square: f64,
    max: f64,
    /// Mean square of each whole motion period.
    blocks: Vec<f64>,
    desired_mean: Joints,
    desired_square: f64,
}

impl Moved {
    fn read(log: &RunLog, period_s: f64) -> Self {
        let mut moved = Self::default();
        let mut commands = log.messages::<EgmCommand>(EGM_RIGHT_COMMAND).peekable();
        let mut desired: Option<(Instant, EgmCommand)> = None;
        let mut block = Block::default();
        let mut was_holding = false;
        for (at, status) in log.messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK) {
            while let Some((sent_at, command)) = commands.next_if(|next| next.0 <= at) {
                let first_at = desired.map_or(sent_at, |(first_at, _)| first_at);
                desired = Some((first_at, command));
            }
            moved.tool_y.push((at.as_ns(), status.tool.position_m[1]));
            moved.hold_count += u64::from(status.has(EgmFeedback::HOLDING) && !was_holding);
            moved.holding_count += u64::from(status.has(EgmFeedback::HOLDING));
            was_holding = status.has(EgmFeedback::HOLDING);
            if let Some((first_at, command)) = &desired {
                let desired_rad = &command.position_rad;
                let square = moved.error.add(desired_rad, &status.measured_rad);
                let index = (at.seconds_since(*first_at) / period_s).floor();
                block.add(index, square, &mut moved.error.blocks);
            }
        }
        moved
    }

    fn joint_error(&self) -> [Metric; 3] {
        let sums = &self.error;
        let values_per_status = JOINT_COUNT as f64;
        let joint_values = sums.count * values_per_status;
        let rms = (sums.count > 0.0).then(|| (sums.square / joint_values).sqrt());
        let interval = Estimate::of_mean(&sums.blocks)
            .and_then(|estimate| estimate.interval)
            .map(|(low, high)| ((low.max(0.0)).sqrt(), high.sqrt()));
        let missing = "no status after a first command";
        let method = |text: &str| {
            if rms.is_some() {
                format!("{text}; {} statuses of the right arm", sums.count)
            } else {
                missing.to_owned()
            }
        };
        let ratio = (sums.desired_square > 0.0).then(|| (sums.square / sums.desired_square).sqrt());
        [
            Metric {
                name: "joint_error_rad_rms",
                label: "joint error, RMS",
                value: rms,
                interval,
                unit: "rad",
                method: method(
                    "newest command sent by then minus measured, all seven joints; interval from \
                     whole motion periods",
                ),
            },
            Metric {
                name: "joint_error_rad_max",
                label: "joint error, largest",
                value: rms.map(|_| sums.max),
                interval: None,
                unit: "rad",
                method: method("newest command sent by then minus measured, any joint"),
            },
            Metric {
                name: "joint_error_ratio",
                label: "joint error relative to the commanded motion",
                value: ratio,
                interval: None,
                unit: "1",
                method: if ratio.is_some() {
                    method("RMS error over RMS of the command about its mean")
                } else {
                    "no status after a first command, or commands that never move".to_owned()
                },
            },
        ]
    }
}

impl ErrorSums {
    /// Adds one status; gives its mean square error over the joints.
    fn add(&mut self, desired_rad: &Joints, measured_rad: &Joints) -> f64 {
        self.count += 1.0;
        let mut square = 0.0;
        for (joint, (desired, measured)) in desired_rad.iter().zip(measured_rad).enumerate() {
            let error = (desired - measured).abs();
            square += error * error;
            self.max = self.max.max(error);
            // Welford's update: a plain sum of squares would lose the small motion in the mean.
            let from_mean = desired - self.desired_mean[joint];
            self.desired_mean[joint] += from_mean / self.count;
            self.desired_square += from_mean * (desired - self.desired_mean[joint]);
        }
        self.square += square;
        square / JOINT_COUNT as f64
    }
}

/// Mean square of the motion period under way.
#[derive(Debug, Default)]
struct Block {
    index: f64,
    sum: f64,
    count: f64,
}

impl Block {
    /// Adds a status in period `index`; a period left behind goes to `blocks`.
    fn add(&mut self, index: f64, square: f64, blocks: &mut Vec<f64>) {
        if index > self.index {
            if self.count > 0.0 {
                blocks.push(self.sum / self.count);
            }
            *self = Self {
                index,
                ..Self::default()
            };
        }
        self.sum += square;
        self.count += 1.0;
    }
}

/// Loops sent, loops executed and their loss ratio (Lv et al., equation 1).
fn motion_loops(case: &Teleoperation, sent: &[Sample], moved: &[Sample]) -> [Metric; 3] {
    let prominence_m = PROMINENCE_RATIO * case.nominal_peak_to_peak_m();
    let period_ns = case.parameters.motion_period_s * 1e9;
    let counted = count_loops(sent, moved, prominence_m, period_ns);
    let method = |what: &str| match counted {
        Some(_) => format!(
            "peaks of the right tool's y, {what}, with a prominence of {prominence_m:.4} m (half \
             the nominal peak-to-peak); loops of the last half period are left out"
        ),
        None => "no whole motion loop between the first and the last status".to_owned(),
    };
    let lost = counted.and_then(|(sent, executed)| {
        let lost = u32::try_from(sent.checked_sub(executed)?).ok()?;
        let (low, high) = poisson_interval(lost);
        Some((low / sent as f64, (high / sent as f64).min(1.0)))
    });
    let metric = |name, label, value, interval, what: &str| Metric {
        name,
        label,
        value,
        interval,
        unit: "1",
        method: method(what),
    };
    let sent_count = counted.map(|(sent, _)| sent as f64);
    let executed_count = counted.map(|(_, executed)| executed as f64);
    let ratio = sent_count.zip(executed_count).map(|(s, a)| (s - a) / s);
    [
        metric(
            "motion_loops_sent_count",
            "motion loops sent",
            sent_count,
            None,
            "as commanded",
        ),
        metric(
            "motion_loops_executed_count",
            "motion loops executed",
            executed_count,
            None,
            "as measured",
        ),
        metric(
            "motion_loss_ratio",
            "motion loss rate",
            ratio,
            lost,
            "(sent - executed) / sent, interval of a Poisson count",
        ),
    ]
}

/// Peaks sent and executed. A loop sent so late that its execution may lie beyond the end of the
/// log counts on neither side.
fn count_loops(
    sent: &[Sample],
    moved: &[Sample],
    prominence_m: f64,
    period_ns: f64,
) -> Option<(usize, usize)> {
    let (begin, end) = (moved.first()?.0, moved.last()?.0);
    let (sent, moved) = (peaks(sent, prominence_m), peaks(moved, prominence_m));
    let until = end as f64 - 0.5 * period_ns;
    let in_time = |at: &&i64| **at >= begin && (**at as f64) <= until;
    let sent_count = sent.iter().filter(in_time).count();
    let last = *sent.iter().rfind(in_time)? as f64;
    let is_counted = |at: &&i64| (**at as f64) <= last + 0.75 * period_ns;
    Some((sent_count, moved.iter().filter(is_counted).count()))
}

fn tracking_lag(sent: &[Sample], moved: &[Sample], period_s: f64) -> Metric {
    let lag = lag_s(sent, moved, 0.5 * period_s);
    let to_ms = |seconds: f64| seconds * 1e3;
    Metric {
        name: "tracking_lag_ms",
        label: "tracking lag",
        value: lag.map(|lag| to_ms(lag.value)),
        interval: lag
            .and_then(|lag| lag.interval)
            .map(|(low, high)| (to_ms(low), to_ms(high))),
        unit: "ms",
        method: if lag.is_some() {
            "highest cross-correlation of the right tool's y, commanded and measured, on a 4 ms \
             grid; interval from blocks of the run"
                .to_owned()
        } else {
            "commands and statuses overlap for less than two motion periods, or nothing moved"
                .to_owned()
        },
    }
}

/// `moved` without the time in which the human rested; hosts start together within milliseconds.
fn after_rest(moved: &[Sample], motion_start_s: f64) -> &[Sample] {
    let begin = moved.first().map_or(0, |(at, _)| *at);
    let is_rest = |(at, _): &Sample| ((at - begin) as f64) < motion_start_s * 1e9;
    &moved[moved.partition_point(is_rest)..]
}

fn tool_travel(moved: &[Sample], period_s: f64) -> Metric {
    #[allow(
        clippy::cast_possible_truncation,
        reason = "a period of at most a minute in nanoseconds"
    )]
    let travel = peak_to_peak(moved, (period_s * 1e9) as i64);
    Metric {
        name: "tool_y_m_peak_to_peak",
        label: "side-to-side travel of the right tool",
        value: travel.map(|travel| travel.value),
        interval: travel.and_then(|travel| travel.interval),
        unit: "m",
        method: if travel.is_some() {
            "mean over whole motion periods of highest minus lowest measured y".to_owned()
        } else {
            "no whole motion period of statuses".to_owned()
        },
    }
}

fn events(sent: &Sent, moved: &Moved) -> [Metric; 4] {
    let (commands, statuses) = (sent.tool_y.len(), moved.tool_y.len());
    let metric = |name, label, of: usize, value: f64, method: String| Metric {
        name,
        label,
        value: (of > 0).then_some(value),
        interval: None,
        unit: "1",
        method: if of > 0 {
            method
        } else {
            "nothing was recorded".to_owned()
        },
    };
    [
        metric(
            "ik_failure_count",
            "inverse kinematics failures",
            commands,
            sent.failure_count as f64,
            format!("commands flagged unreachable, of {commands}"),
        ),
        metric(
            "ik_limited_count",
            "commands held back by a limit",
            commands,
            sent.limited_count as f64,
            format!("commands flagged as limited in speed, position or jump, of {commands}"),
        ),
        metric(
            "hold_count",
            "holds for want of commands",
            statuses,
            moved.hold_count as f64,
            "times the robot's reference grew older than five command periods".to_owned(),
        ),
        metric(
            "hold_time_ratio",
            "share of time held",
            statuses,
            moved.holding_count as f64 / statuses.max(1) as f64,
            format!("statuses flagged as holding, of {statuses}"),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::case_study::CaseStudy;
    use crate::simulation::Simulation;
    use crate::teleoperation::TeleoperationParameters;
    use core::time::Duration;
    use std::collections::BTreeMap;

    #[test]
    fn an_empty_log_gives_no_figure_but_a_reason_for_each() {
        let case = Teleoperation::new(TeleoperationParameters::default(), 0).unwrap();
        let score = case.score(&RunLog::default());
        assert_eq!(score.metrics.len(), 12);
        for metric in &score.metrics {
            assert_eq!(metric.value, None, "{metric:?}");
            assert_eq!(metric.interval, None, "{metric:?}");
            assert!(!metric.method.is_empty());
        }
    }

    #[test]
    fn two_clocks_withdraw_error_and_lag_but_not_the_loops() {
        let case = Teleoperation::new(TeleoperationParameters::default(), 0).unwrap();
        let simulation = Simulation::new(&case, BTreeMap::new()).unwrap();
        let whole = simulation.run(Duration::from_secs(20)).unwrap().log;
        let mut log = RunLog::default();
        for (channel, offset_ns) in [(EGM_RIGHT_COMMAND, 0), (EGM_RIGHT_FEEDBACK, 77_000_000_000)] {
            for logged in whole.raw(channel) {
                let mut envelope = logged.envelope;
                envelope.published_ns += offset_ns;
                log.push(channel, envelope, &logged.payload);
            }
        }
        log.set_clocks_differ();
        let (exact, apart) = (case.score(&whole), case.score(&log));
        for name in [
            "motion_loops_sent_count",
            "motion_loops_executed_count",
            "hold_count",
        ] {
            assert_eq!(
                apart.get(name).unwrap().value,
                exact.get(name).unwrap().value,
                "{name}"
            );
        }
        for name in [
            "joint_error_rad_rms",
            "joint_error_ratio",
            "tracking_lag_ms",
        ] {
            assert!(exact.get(name).unwrap().value.is_some());
            assert_eq!(apart.get(name).unwrap().value, None);
            assert!(apart.get(name).unwrap().method.contains("not aligned"));
        }
    }

    #[test]
    fn a_loop_whose_execution_lies_beyond_the_log_is_not_lost() {
        let wave = |lag_s: f64, end_s: f64| -> Vec<Sample> {
            let count = (end_s * 125.0).round();
            let frames = (0..10_000).take_while(|index| f64::from(*index) < count);
            frames
                .map(|index: i32| {
                    let time_s = f64::from(index) * 0.008;
                    let value = (core::f64::consts::TAU * (time_s - lag_s).max(0.0) / 4.0).sin();
                    (i64::from(index) * 8_000_000, value)
                })
                .collect()
        };
        for tenth in 0..80 {
            let end_s = 40.0 + f64::from(tenth) * 0.1;
            for lag_s in [0.0, 0.2, 0.9] {
                let (sent, executed) =
                    count_loops(&wave(0.0, end_s), &wave(lag_s, end_s), 1.0, 4e9).unwrap();
                assert_eq!(sent, executed, "end {end_s} s, lag {lag_s} s");
            }
        }
    }
}
