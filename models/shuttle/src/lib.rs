//! The smallest case study: a cart on a rail follows a square wave. Tutorial, test and bench
//! subject; not a model of any product.
//!
//! The controller ticks, reads the newest status, and commands a speed; the robot integrates the
//! speed and reports where it is. Everything a larger case has, this one has in small.
#![forbid(unsafe_code)]

use core::time::Duration;

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use hil_core::case_study::{CaseStudy, ChannelSpec, ErrorSeries, Metric, ParameterError, Score};
use hil_core::component::{Component, Outbox, Role, into_role};
use hil_core::run_log::RunLog;
use hil_core::time::{Instant, PeriodicTimer};
use hil_stats::series::Estimate;
use hil_stats::special::ceil_count;

hil_core::message! {
    /// Controller to robot: the speed to drive.
    #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
    #[repr(C)]
    pub struct ShuttleCommand = "hil.ShuttleCommand.v1" {
        /// Commanded speed along the rail.
        pub speed_mps: f64,
        /// Where the controller wants the cart, for the score.
        pub target_m: f64,
    }
}

hil_core::message! {
    /// Robot to controller: where the cart is.
    #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
    #[repr(C)]
    pub struct ShuttleStatus = "hil.ShuttleStatus.v1" {
        /// Position along the rail.
        pub position_m: f64,
    }
}

/// `[case.parameters]` of the shuttle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShuttleParameters {
    /// Control and reporting rate, 1..=10000 Hz.
    pub rate_hz: f64,
    /// Proportional gain, 0..=100 per second.
    pub gain_per_s: f64,
    /// Speed limit of the cart, 0..=10 m/s.
    pub speed_max_mps: f64,
}

impl Default for ShuttleParameters {
    fn default() -> Self {
        Self {
            rate_hz: 100.0,
            gain_per_s: 5.0,
            speed_max_mps: 1.0,
        }
    }
}

/// The case study.
#[derive(Debug, Clone)]
pub struct Shuttle {
    parameters: ShuttleParameters,
}

impl CaseStudy for Shuttle {
    const NAME: &'static str = "shuttle";
    const SUMMARY: &'static str = "a cart on a rail follows a square wave (tutorial)";
    const ROLES: &'static [&'static str] = &["controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<ShuttleCommand>("shuttle/command", "controller", "robot"),
        ChannelSpec::of::<ShuttleStatus>("shuttle/status", "robot", "controller"),
    ];
    const SCORE_CLOCK: Option<&'static str> = Some("shuttle/status");
    type Parameters = ShuttleParameters;

    fn new(parameters: Self::Parameters, _seed: u64) -> Result<Self, ParameterError> {
        ParameterError::check("rate_hz", parameters.rate_hz, 1.0..=10_000.0, "1 to 10000")?;
        ParameterError::check("gain_per_s", parameters.gain_per_s, 0.0..=100.0, "0 to 100")?;
        ParameterError::check(
            "speed_max_mps",
            parameters.speed_max_mps,
            0.0..=10.0,
            "0 to 10",
        )?;
        Ok(Self { parameters })
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        let period = Duration::from_secs_f64(1.0 / self.parameters.rate_hz);
        match name {
            "controller" => Some(into_role(Controller {
                parameters: self.parameters.clone(),
                timer: PeriodicTimer::new(period),
                started: Instant::ZERO,
                position_m: 0.0,
            })),
            "robot" => Some(into_role(Robot {
                timer: PeriodicTimer::new(period),
                moved_until: Instant::ZERO,
                speed_mps: 0.0,
                position_m: 0.0,
            })),
            _ => None,
        }
    }

    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        // Stamps of two clocks cannot be told apart from an error.
        if log.has_one_clock() {
            vec![speed_error(log)]
        } else {
            Vec::new()
        }
    }

    fn score(&self, log: &RunLog) -> Score {
        let command_count = log.messages::<ShuttleCommand>("shuttle/command").count();
        let travel = travel(log);
        Score {
            metrics: vec![Metric {
                name: "travelled_m",
                label: "distance travelled",
                value: travel.map(|travel| travel.whole_m),
                interval: travel.and_then(|travel| travel.interval),
                unit: "m",
                method: format!(
                    "sum of status steps; {command_count} commands sent; 95 % interval from the half waves of the \
                     run, from 5 of them on"
                ),
            }],
            ..Score::default()
        }
    }
}

/// By how much the cart's speed from status to status misses the newest command sent by the former:
/// what a command that comes later than a period, or not at all, leaves undone.
fn speed_error(log: &RunLog) -> ErrorSeries {
    let mut commands = log.messages::<ShuttleCommand>("shuttle/command").peekable();
    let mut newest: Option<ShuttleCommand> = None;
    let mut before: Option<(Instant, f64)> = None;
    let mut samples = Vec::new();
    for (at, status) in log.messages::<ShuttleStatus>("shuttle/status") {
        let passed_s = before.map_or(0.0, |before| at.seconds_since(before.0));
        if let (Some(command), Some((_, from_m))) = (newest, before)
            && passed_s > 0.0
        {
            let driven_mps = (status.position_m - from_m) / passed_s;
            samples.push((at, (command.speed_mps - driven_mps).abs()));
        }
        while let Some((_, command)) = commands.next_if(|next| next.0 <= at) {
            newest = Some(command);
        }
        before = Some((at, status.position_m));
    }
    ErrorSeries {
        label: "error of the cart's speed",
        unit: "m/s",
        clock_of: "shuttle/status",
        samples,
    }
}

/// How far the cart went.
#[derive(Debug, Clone, Copy)]
struct Travel {
    whole_m: f64,
    interval: Option<(f64, f64)>,
}

/// The whole way, and what the scatter of the half waves says of it; `None` without a status.
fn travel(log: &RunLog) -> Option<Travel> {
    let mut statuses = log.messages::<ShuttleStatus>("shuttle/status");
    let first = statuses.next()?;
    let start = first.0;
    let mut last = first;
    let (mut blocks, mut whole_m): (Vec<f64>, f64) = (Vec::new(), 0.0);
    for after in statuses {
        let before = core::mem::replace(&mut last, after);
        let step_m = (after.1.position_m - before.1.position_m).abs();
        whole_m += step_m;
        let half_waves = before.0.seconds_since(start) / HALF_WAVE_S;
        let index = ceil_count(half_waves.floor());
        if blocks.len() <= index {
            blocks.resize(index + 1, 0.0);
        }
        blocks[index] += step_m;
    }
    // The cart rests at the end of a half wave, so one that is all but over counts as whole.
    let half_waves = (last.0.seconds_since(start) / HALF_WAVE_S).round();
    blocks.truncate(ceil_count(half_waves));
    let mean = Estimate::of_mean(&blocks)?;
    let spread_m = mean
        .interval
        .map(|(low, high)| 0.5 * (high - low) * half_waves);
    Some(Travel {
        whole_m,
        interval: spread_m.map(|spread_m| (whole_m - spread_m, whole_m + spread_m)),
    })
}

/// Half the period of the square wave the controller follows.
const HALF_WAVE_S: f64 = 2.0;

#[derive(Debug)]
struct Controller {
    parameters: ShuttleParameters,
    timer: PeriodicTimer,
    started: Instant,
    position_m: f64,
}

impl Component for Controller {
    type Input = ShuttleStatus;
    type Output = ShuttleCommand;

    fn on_start(&mut self, now: Instant) {
        self.started = now;
        self.timer.start(now);
    }

    fn on_message(
        &mut self,
        _now: Instant,
        input: &ShuttleStatus,
        _out: &mut Outbox<ShuttleCommand>,
    ) {
        self.position_m = input.position_m;
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<ShuttleCommand>) {
        let Some(tick) = self.timer.poll(now) else {
            return;
        };
        let phase = tick
            .scheduled
            .seconds_since(self.started)
            .rem_euclid(2.0 * HALF_WAVE_S);
        let target_m = if phase < HALF_WAVE_S { 1.0 } else { 0.0 };
        let limit = self.parameters.speed_max_mps;
        let speed = self.parameters.gain_per_s * (target_m - self.position_m);
        out.send(ShuttleCommand {
            speed_mps: speed.clamp(-limit, limit),
            target_m,
        });
    }

    fn next_tick(&self) -> Option<Instant> {
        self.timer.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.timer.skipped_total()
    }
}

#[derive(Debug)]
struct Robot {
    timer: PeriodicTimer,
    moved_until: Instant,
    speed_mps: f64,
    position_m: f64,
}

impl Robot {
    /// Integrates with the time that really passed, not with the nominal period.
    fn advance(&mut self, now: Instant) {
        self.position_m += self.speed_mps * now.seconds_since(self.moved_until);
        self.moved_until = now;
    }
}

impl Component for Robot {
    type Input = ShuttleCommand;
    type Output = ShuttleStatus;

    fn on_start(&mut self, now: Instant) {
        self.moved_until = now;
        self.timer.start(now);
    }

    fn on_message(
        &mut self,
        now: Instant,
        input: &ShuttleCommand,
        _out: &mut Outbox<ShuttleStatus>,
    ) {
        self.advance(now);
        self.speed_mps = input.speed_mps;
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<ShuttleStatus>) {
        if self.timer.poll(now).is_some() {
            self.advance(now);
            out.send(ShuttleStatus {
                position_m: self.position_m,
            });
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        self.timer.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.timer.skipped_total()
    }
}

#[cfg(test)]
mod tests;
