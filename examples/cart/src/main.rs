//! A case of one's own: a controller drives a cart to the middle of its rail.
//!
//! ```text
//! controller --cart/command--> cart
//!            <--cart/state----
//! ```

mod cart;

use std::process::ExitCode;

use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError};
use hil_core::component::{Component, Output, Ports, Role, into_role};
use hil_core::time::Instant;
use hil_runtime::Runtime;

hil_core::message! {
    struct Command = "example.CartCommand.v1" { speed_mps: f64 }
}
hil_core::message! {
    struct State = "example.CartState.v1" { position_m: f64, speed_mps: f64 }
}
hil_core::parameters! {
    struct CartCase { gain_per_s: f64 = 5.0, in 0.0..=100.0; }
}

#[derive(Debug)]
struct Controller {
    gain_per_s: f64,
    command: Output<Command>,
}

impl Component for Controller {
    fn ports(&self, ports: &mut Ports<Self>) {
        ports.input("cart/state", Self::on_state);
        ports.output("cart/command", |own| &mut own.command);
    }
}

impl Controller {
    fn on_state(&mut self, _now: Instant, state: &State) {
        self.command.send(Command {
            speed_mps: self.gain_per_s * (0.5 - state.position_m),
        });
    }
}

impl CaseStudy for CartCase {
    const NAME: &'static str = "cart";
    const SUMMARY: &'static str = "a cart drives to the middle of its rail";
    const ROLES: &'static [&'static str] = &["controller", "cart"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<Command>("cart/command", "controller", "cart"),
        ChannelSpec::of::<State>("cart/state", "cart", "controller"),
    ];
    type Parameters = Self;

    fn new(parameters: Self, _seed: u64) -> Result<Self, ParameterError> {
        parameters.check().map(|()| parameters)
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        match name {
            "controller" => Some(into_role(Controller {
                gain_per_s: self.gain_per_s,
                command: Output::default(),
            })),
            "cart" => Some(into_role(cart::Cart::default())),
            _ => None,
        }
    }
}

fn main() -> ExitCode {
    Runtime::new().case::<CartCase>().run()
}
