//! The smallest case study: a cart on a rail follows a square wave. Tutorial, test and bench
//! subject; not a model of any product.
//!
//! ```text
//! controller --shuttle/command--> robot
//!            <--shuttle/status---
//! ```
//!
//! The controller ticks and commands a speed towards its target, from the newest status; the robot
//! integrates the speed and reports where it is. Everything a larger case has, this one has in small.
#![forbid(unsafe_code)]

mod score;

use core::time::Duration;

use hil_core::case_study::{CaseStudy, ChannelSpec, ErrorSeries, ParameterError, Score};
use hil_core::component::{Component, Output, Ports, Role, into_role};
use hil_core::run_log::RunLog;
use hil_core::time::{Instant, Tick};

hil_core::message! {
    /// Controller to robot: the speed to drive.
    pub struct ShuttleCommand = "hil.ShuttleCommand.v1", 16 bytes {
        /// Commanded speed along the rail.
        pub speed_mps: f64,
        /// Where the controller wants the cart, for the score.
        pub target_m: f64,
    }
}

hil_core::message! {
    /// Robot to controller: where the cart is.
    pub struct ShuttleStatus = "hil.ShuttleStatus.v1", 8 bytes {
        /// Position along the rail.
        pub position_m: f64,
    }
}

hil_core::parameters! {
    /// `[case.parameters]` of the shuttle.
    pub struct ShuttleParameters {
        /// Control and reporting rate, Hz.
        rate_hz: f64 = 100.0, in 1.0..=10_000.0;
        /// Proportional gain, per second.
        gain_per_s: f64 = 5.0, in 0.0..=100.0;
        /// Speed limit of the cart, m/s.
        speed_max_mps: f64 = 1.0, in 0.0..=10.0;
    }
}

impl ShuttleParameters {
    fn period(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.rate_hz)
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
        parameters.check()?;
        Ok(Self { parameters })
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        match name {
            "controller" => Some(into_role(Controller {
                parameters: self.parameters.clone(),
                command: Output::default(),
                position_m: 0.0,
            })),
            "robot" => Some(into_role(Robot {
                period: self.parameters.period(),
                status: Output::default(),
                moved_until: Instant::ZERO,
                speed_mps: 0.0,
                position_m: 0.0,
            })),
            _ => None,
        }
    }

    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        score::errors(log)
    }

    fn score(&self, log: &RunLog) -> Score {
        score::score(log)
    }
}

/// Half the period of the square wave the controller follows.
const HALF_WAVE_S: f64 = 2.0;

#[derive(Debug)]
struct Controller {
    parameters: ShuttleParameters,
    command: Output<ShuttleCommand>,
    position_m: f64,
}

impl Component for Controller {
    fn ports(&self, ports: &mut Ports<Self>) {
        ports.input("shuttle/status", Self::on_status);
        ports.output("shuttle/command", |own| &mut own.command);
        ports.every(self.parameters.period(), Self::on_tick);
    }
}

impl Controller {
    fn on_status(&mut self, _now: Instant, status: &ShuttleStatus) {
        self.position_m = status.position_m;
    }

    fn on_tick(&mut self, _now: Instant, tick: Tick) {
        let ShuttleParameters {
            rate_hz,
            gain_per_s,
            speed_max_mps,
        } = self.parameters;
        let phase_s = (tick.index as f64 / rate_hz).rem_euclid(2.0 * HALF_WAVE_S);
        let target_m = if phase_s < HALF_WAVE_S { 1.0 } else { 0.0 };
        let speed_mps = gain_per_s * (target_m - self.position_m);
        self.command.send(ShuttleCommand {
            speed_mps: speed_mps.clamp(-speed_max_mps, speed_max_mps),
            target_m,
        });
    }
}

#[derive(Debug)]
struct Robot {
    period: Duration,
    status: Output<ShuttleStatus>,
    moved_until: Instant,
    speed_mps: f64,
    position_m: f64,
}

impl Component for Robot {
    fn ports(&self, ports: &mut Ports<Self>) {
        ports.input("shuttle/command", Self::on_command);
        ports.output("shuttle/status", |own| &mut own.status);
        ports.every(self.period, Self::on_tick);
    }
}

impl Robot {
    fn on_command(&mut self, now: Instant, command: &ShuttleCommand) {
        self.advance(now);
        self.speed_mps = command.speed_mps;
    }

    fn on_tick(&mut self, now: Instant, _tick: Tick) {
        self.advance(now);
        self.status.send(ShuttleStatus {
            position_m: self.position_m,
        });
    }

    /// Integrates with the time that really passed, not with the nominal period.
    fn advance(&mut self, now: Instant) {
        self.position_m += self.speed_mps * now.seconds_since(self.moved_until);
        self.moved_until = now;
    }
}

#[cfg(test)]
mod tests;
