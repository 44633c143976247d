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

use hil_core::prelude::*;

hil_core::message! {
    /// Controller to robot: the speed to drive.
    pub struct ShuttleCommand = "hil.ShuttleCommand.v1", 16 bytes {
        /// Commanded speed along the rail.
        pub speed_mps: f64,
        /// Where the controller wants the cart.
        pub target_m: f64,
    }

    /// Robot to controller: where the cart is.
    pub struct ShuttleStatus = "hil.ShuttleStatus.v1", 8 bytes {
        /// Position along the rail.
        pub position_m: f64,
    }
}

hil_core::options! {
    /// The case study, which is its parameters.
    pub struct Shuttle {
        /// Control and reporting rate, Hz.
        rate_hz: f64 = 100.0, in 1.0..=10_000.0;
        /// Proportional gain, per second.
        gain_per_s: f64 = 5.0, in 0.0..=100.0;
        /// Speed limit of the cart, m/s.
        speed_max_mps: f64 = 1.0, in 0.0..=10.0;
    }
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
    type Parameters = Self;

    fn new(parameters: Self, _seed: u64) -> Result<Self, ParameterError> {
        parameters.check().map(|()| parameters)
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        let (case, period) = (self.clone(), Duration::from_secs_f64(1.0 / self.rate_hz));
        Some(match name {
            // Its state is where the cart was last.
            "controller" => Component::of(0.0)
                .input("shuttle/status", |position_m, _, status: &ShuttleStatus| {
                    *position_m = status.position_m;
                })
                .publish("shuttle/command", period, move |position_m, _, tick| {
                    // Two seconds at one metre, two at zero.
                    let target_m = f64::from(tick.index as f64 / case.rate_hz % 4.0 < 2.0);
                    let speed_mps = case.gain_per_s * (target_m - *position_m);
                    ShuttleCommand {
                        speed_mps: speed_mps.clamp(-case.speed_max_mps, case.speed_max_mps),
                        target_m,
                    }
                })
                .into_role(),
            "robot" => Component::of(Cart::default())
                .input("shuttle/command", |cart, now, command: &ShuttleCommand| {
                    cart.advance(now);
                    cart.speed_mps = command.speed_mps;
                })
                .publish("shuttle/status", period, |cart, now, _| cart.advance(now))
                .into_role(),
            _ => return None,
        })
    }

    /// By how much the cart's speed from status to status misses the newest command sent by the former:
    /// what a command that comes later than a period, or not at all, leaves undone.
    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        let mut before: Option<(Instant, ShuttleStatus, Option<ShuttleCommand>)> = None;
        let statuses = log.with_newest("shuttle/status", "shuttle/command", None);
        let samples = statuses.filter_map(|(at, status, command)| {
            let (from, was, told) = before.replace((at, status, command))?;
            let driven_mps = (status.position_m - was.position_m) / at.seconds_since(from);
            Some((at, (told?.speed_mps - driven_mps).abs())).filter(|_| at > from)
        });
        vec![ErrorSeries {
            name: "speed_error_mps",
            label: "error of the cart's speed",
            unit: "m/s",
            clock_of: "shuttle/status",
            samples: samples.collect(),
        }]
    }
}

#[derive(Debug, Default)]
struct Cart {
    moved_until: Instant,
    speed_mps: f64,
    position_m: f64,
}

impl Cart {
    /// Integrates with the time that really passed, not with the nominal period.
    fn advance(&mut self, now: Instant) -> ShuttleStatus {
        self.position_m += self.speed_mps * now.seconds_since(self.moved_until);
        self.moved_until = now;
        let position_m = self.position_m;
        ShuttleStatus { position_m }
    }
}
