//! The cart: goes as fast as it was told last, and reports 100 times a second where it is.

use hil_core::prelude::*;

use crate::{Command, State};

const PERIOD: Duration = Duration::from_millis(10);

#[derive(Debug, Default)]
struct Cart {
    position_m: f64,
    speed_mps: f64,
    moved_until: Option<Instant>,
}

pub(crate) fn role() -> Box<dyn Role> {
    Component::of(Cart::default())
        .input("cart/command", |cart, _, command: &Command| {
            cart.speed_mps = command.speed_mps;
        })
        .publish("cart/state", PERIOD, Cart::advance)
        .into_role()
}

impl Cart {
    fn advance(&mut self, now: Instant, _tick: Tick) -> State {
        // The time that passed, not the period: a late tick stands for several.
        let passed = now.saturating_duration_since(self.moved_until.unwrap_or(now));
        self.moved_until = Some(now);
        self.position_m += self.speed_mps * passed.as_secs_f64();
        State {
            position_m: self.position_m,
            speed_mps: self.speed_mps,
        }
    }
}
