//! Joint error of the right arm, split: what the controller's own law makes of the commands over a
//! perfect channel, and what the network adds. Both producers must have read one clock.

use core::iter::Peekable;

use crate::score::sessions::{events, is_right};
use crate::{
    EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, HUMAN_FRAME, MOTION_RECEIVED, SendPolicy, Teleoperation,
};
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{
    EgmCommand, EgmEventKind, EgmFeedback, EgmStartParameters, MotionArrival, MotionKind,
    MotionRequest, Side,
};
use hil_arm::egm::parameters::{ControllerSettings, StartMode};
use hil_arm::yumi::{JOINT_COUNT, Joints};
use hil_core::case_study::Metric;
use hil_core::run_log::RunLog;
use hil_core::time::{Instant, duration_ns};
use hil_stats::metric::{Label, label};
use hil_stats::series::Estimate;

/// Sums over all feedback after the first command.
#[derive(Debug, Default)]
pub(crate) struct JointError {
    total: ErrorSums,
    controller: ErrorSums,
    network: ErrorSums,
    /// Why there is no split.
    unsplit: Option<&'static str>,
    desired_mean: Joints,
    desired_square: f64,
    has_one_clock: bool,
    /// What there is to say of the clocks that commands and feedback were stamped by.
    clock: String,
}

impl JointError {
    pub(crate) fn read(case: &Teleoperation, log: &RunLog, period_s: f64) -> Self {
        let mut error = Self {
            has_one_clock: log.has_one_clock(),
            clock: log.clock_words(None),
            ..Self::default()
        };
        if !error.has_one_clock {
            error.unsplit = Some(TWO_CLOCKS);
            return error;
        }
        let mut ideal = match why_unsplit(case, log) {
            Some(why) => Err(why),
            None => Ideal::of(log, &case.settings),
        };
        error.unsplit = ideal.as_ref().err().copied();
        let mut commands = log.messages::<EgmCommand>(EGM_RIGHT_COMMAND).peekable();
        let mut desired: Option<(Instant, Joints)> = None;
        for (at, feedback) in log.messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK) {
            while let Some((sent_at, command)) = commands.next_if(|next| next.0 <= at) {
                let first_at = desired.map_or(sent_at, |(first_at, _)| first_at);
                if command.position_rad.iter().all(|q| q.is_finite()) {
                    desired = Some((first_at, command.position_rad));
                }
            }
            let ideal_rad = ideal.as_mut().ok().and_then(|ideal| ideal.at(&feedback));
            let Some((first_at, desired_rad)) = desired else {
                continue;
            };
            if !feedback.measured_rad.iter().all(|q| q.is_finite()) {
                continue;
            }
            let block = (at.seconds_since(first_at) / period_s).floor();
            error.add_desired(&desired_rad);
            error.total.add(block, &desired_rad, &feedback.measured_rad);
            if let Some(ideal_rad) = ideal_rad {
                error.controller.add(block, &desired_rad, &ideal_rad);
                error.network.add(block, &ideal_rad, &feedback.measured_rad);
            }
        }
        error
    }

    /// Welford's update: a plain sum of squares would lose the small motion in the mean.
    fn add_desired(&mut self, desired_rad: &Joints) {
        let count = self.total.count + 1.0;
        for (mean, desired) in self.desired_mean.iter_mut().zip(desired_rad) {
            let from_mean = desired - *mean;
            *mean += from_mean / count;
            self.desired_square += from_mean * (desired - *mean);
        }
    }

    pub(crate) fn metrics(&self) -> Vec<Metric> {
        let missing = if self.has_one_clock {
            "no feedback after a first command"
        } else {
            TWO_CLOCKS
        };
        let (total, square) = (&self.total, self.desired_square);
        let ratio = (square > 0.0).then(|| (total.square / square).sqrt());
        let mut metrics = vec![
            total.rms(
                label("joint_error_rad_rms", "joint error, RMS", "rad"),
                "newest command sent by then minus measured",
                missing,
            ),
            total.greatest(
                label("joint_error_rad_max", "joint error, largest", "rad"),
                "newest command sent by then minus measured",
                missing,
            ),
            label(
                "joint_error_ratio",
                "joint error relative to the commanded motion",
                "1",
            )
            .measured(
                ratio,
                format!(
                    "RMS error over RMS of the command about its mean; {} messages of feedback",
                    total.count
                ),
                if total.count > 0.0 {
                    "commands never move"
                } else {
                    missing
                },
            ),
        ];
        metrics.extend(self.split(self.unsplit.unwrap_or(missing)));
        for metric in metrics.iter_mut().filter(|metric| metric.value.is_some()) {
            metric.method.push_str(&self.clock);
        }
        metrics
    }

    /// Both parts; without them, for the reason `missing`.
    fn split(&self, missing: &str) -> [Metric; 4] {
        let (controller, network) = (&self.controller, &self.network);
        [
            controller.rms(
                label(
                    "joint_error_controller_rad_rms",
                    "joint error of the servo alone, RMS",
                    "rad",
                ),
                CONTROLLER_PART,
                missing,
            ),
            controller.greatest(
                label(
                    "joint_error_controller_rad_max",
                    "joint error of the servo alone, largest",
                    "rad",
                ),
                CONTROLLER_PART,
                missing,
            ),
            network.rms(
                label(
                    "joint_error_network_rad_rms",
                    "joint error the network adds, RMS",
                    "rad",
                ),
                NETWORK_PART,
                missing,
            ),
            network.greatest(
                label(
                    "joint_error_network_rad_max",
                    "joint error the network adds, largest",
                    "rad",
                ),
                NETWORK_PART,
                missing,
            ),
        ]
    }
}

const TWO_CLOCKS: &str = "commands and feedback were stamped by two clocks that are not aligned";
const CONTROLLER_PART: &str = "newest command sent by then minus what the same controller makes of \
                               the same commands over a perfect channel";
const NETWORK_PART: &str = "what the same controller makes of the same commands over a perfect \
                            channel, minus measured";

/// Differences of joints.
#[derive(Debug, Default)]
struct ErrorSums {
    count: f64,
    square: f64,
    max: f64,
    /// Mean square of each whole motion period, and that of the one under way.
    blocks: Vec<f64>,
    block: Block,
}

/// Mean square of the motion period under way.
#[derive(Debug, Default)]
struct Block {
    index: f64,
    sum: f64,
    count: f64,
}

impl ErrorSums {
    fn add(&mut self, block_index: f64, from_rad: &Joints, to_rad: &Joints) {
        let mut square = 0.0;
        for (from, to) in from_rad.iter().zip(to_rad) {
            let error = (from - to).abs();
            square += error * error;
            self.max = self.max.max(error);
        }
        self.count += 1.0;
        self.square += square;
        if block_index > self.block.index {
            if self.block.count > 0.0 {
                self.blocks.push(self.block.sum / self.block.count);
            }
            self.block = Block {
                index: block_index,
                ..Block::default()
            };
        }
        self.block.sum += square / JOINT_COUNT as f64;
        self.block.count += 1.0;
    }

    fn rms(&self, label: Label, what: &str, missing: &str) -> Metric {
        let values = self.count * JOINT_COUNT as f64;
        let rms = (self.count > 0.0).then(|| (self.square / values).sqrt());
        let interval = Estimate::of_mean(&self.blocks)
            .map(|estimate| estimate.interval.map(|end| end.max(0.0).sqrt()));
        let method = format!(
            "{what}, all seven joints, {} messages; interval from whole motion periods",
            self.count
        );
        Metric {
            interval: rms.and(interval),
            ..label.measured(rms, method, missing)
        }
    }

    fn greatest(&self, label: Label, what: &str, missing: &str) -> Metric {
        let max = (self.count > 0.0).then_some(self.max);
        label.measured(max, format!("{what}, any joint"), missing)
    }
}

/// Longer than any run, and a time the controller takes.
const NEVER_S: f64 = 1e6;

/// Why nobody can tell what the robot would have done over a perfect channel.
fn why_unsplit(case: &Teleoperation, log: &RunLog) -> Option<&'static str> {
    let is_asked_otherwise = |arrival: MotionArrival| {
        let harmless = [MotionKind::EgmStart, MotionKind::GetState];
        !harmless
            .map(|kind| kind as u32)
            .contains(&arrival.request.kind)
    };
    let mut requests = log.messages::<MotionArrival>(MOTION_RECEIVED);
    if log.raw(HUMAN_FRAME).is_empty() {
        Some("the commands were recorded behind the network: what it lost is not among them")
    } else if case.parameters.send == SendPolicy::Coupled {
        Some("commands that answer feedback would be others over another channel")
    } else if requests.any(|(_, arrival)| is_asked_otherwise(arrival)) {
        Some("the robot was asked for motions of its own, or to stop")
    } else {
        None
    }
}

/// The same controller with the same commands, each arriving as it was published. It never ends its
/// session: commands that a real one would miss are the network's part.
struct Ideal<C: Iterator<Item = (Instant, EgmCommand)>> {
    controller: Controller,
    commands: Peekable<C>,
    origin: Instant,
    cycle_ns: i64,
    first_cycle: u64,
    next_cycle: u64,
}

impl Ideal<core::iter::Empty<(Instant, EgmCommand)>> {
    /// The controller as it stood when its first session was set up; without a record of that, why
    /// there is none.
    fn of<'a>(
        log: &'a RunLog,
        settings: &ControllerSettings,
    ) -> Result<Ideal<impl Iterator<Item = (Instant, EgmCommand)> + 'a>, &'static str> {
        let first = |kind: EgmEventKind| {
            events(log).find(|event| {
                event.kind == kind as u32 && (is_right(event) || kind == EgmEventKind::Started)
            })
        };
        let origin = first(EgmEventKind::Started)
            .ok_or("the robot recorded no beginning of its cycles")?
            .at_ns;
        let set_up = first(EgmEventKind::Activating).ok_or("no session was ever set up")?;
        let at_rest = log
            .messages::<EgmFeedback>(EGM_RIGHT_FEEDBACK)
            .take_while(|(_, known)| known.cycle_index <= set_up.cycle_index)
            .last()
            .ok_or("no feedback from before the first session")?
            .1;
        let settings = ControllerSettings {
            start: StartMode::Request,
            ..*settings
        };
        let mut controller = Controller::new(Side::Right, settings, at_rest.measured_rad);
        let asked = EgmStartParameters {
            comm_timeout_s: NEVER_S,
            condition_time_s: NEVER_S,
            ..asked_for(log, set_up.at_ns)
        };
        controller.start_guided_motion(&asked).map_err(
            |_refusal| "the recorded request for guided motion is not one the controller takes",
        )?;
        Ok(Ideal {
            controller,
            commands: log.messages::<EgmCommand>(EGM_RIGHT_COMMAND).peekable(),
            origin: Instant::from_ns(origin),
            cycle_ns: duration_ns(settings.cycle),
            first_cycle: set_up.cycle_index,
            next_cycle: set_up.cycle_index,
        })
    }
}

/// What the request that led to the session set up at `at_ns` asked for.
fn asked_for(log: &RunLog, at_ns: i64) -> EgmStartParameters {
    let is_start = |arrival: &MotionArrival| {
        arrival.request.kind == MotionKind::EgmStart as u32
            && arrival.request.arms & MotionRequest::bit(Side::Right) != 0
    };
    log.messages::<MotionArrival>(MOTION_RECEIVED)
        .map(|(_, arrival)| arrival)
        .take_while(|arrival| arrival.at_ns <= at_ns)
        .filter(is_start)
        .last()
        .map_or(EgmStartParameters::KEEP, |arrival| arrival.request.egm)
}

impl<C: Iterator<Item = (Instant, EgmCommand)>> Ideal<C> {
    /// The joints in the cycle of `feedback`; `None` before the first session was set up.
    fn at(&mut self, feedback: &EgmFeedback) -> Option<Joints> {
        while self.next_cycle <= feedback.cycle_index {
            let steps = i64::try_from(self.next_cycle).unwrap_or(i64::MAX);
            let grid_ns = self.cycle_ns.saturating_mul(steps);
            let at = Instant::from_ns(self.origin.as_ns().saturating_add(grid_ns));
            while let Some((sent_at, command)) = self.commands.next_if(|next| next.0 < at) {
                // A refusal is the controller's answer; here nobody listens.
                let _refused = self.controller.receive(sent_at, &command).is_err();
            }
            self.controller.cycle(at, &mut |_| {});
            self.next_cycle += 1;
        }
        (feedback.cycle_index >= self.first_cycle).then(|| *self.controller.measured_rad())
    }
}
