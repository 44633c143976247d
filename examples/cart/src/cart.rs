//! The cart: goes as fast as it was told last, and reports 100 times a second where it is.

use std::time::Duration;

use hil_core::component::{Component, Output, Ports};
use hil_core::time::{Instant, Tick};

use crate::{Command, State};

const PERIOD: Duration = Duration::from_millis(10);

#[derive(Debug, Default)]
pub(crate) struct Cart {
    position_m: f64,
    speed_mps: f64,
    moved_until: Option<Instant>,
    state: Output<State>,
}

impl Component for Cart {
    fn ports(&self, ports: &mut Ports<Self>) {
        ports.input("cart/command", Self::on_command);
        ports.output("cart/state", |own| &mut own.state);
        ports.every(PERIOD, Self::on_tick);
    }
}

impl Cart {
    fn on_command(&mut self, _now: Instant, command: &Command) {
        self.speed_mps = command.speed_mps;
    }

    fn on_tick(&mut self, now: Instant, _tick: Tick) {
        // The time that passed, not the period: a late tick stands for several.
        let passed = now.saturating_duration_since(self.moved_until.unwrap_or(now));
        self.moved_until = Some(now);
        self.position_m += self.speed_mps * passed.as_secs_f64();
        self.state.send(State {
            position_m: self.position_m,
            speed_mps: self.speed_mps,
        });
    }
}
