//! A case of one's own: a controller drives a cart to the middle of its rail.
//!
//! ```text
//! controller --cart/command--> cart
//!            <--cart/state----
//! ```

mod cart;

use std::process::ExitCode;

use hil_core::prelude::*;
use hil_runtime::Runtime;

hil_core::message! {
    struct Command = "example.CartCommand.v1" { speed_mps: f64 }
    struct State = "example.CartState.v1" { position_m: f64, speed_mps: f64 }
}
hil_core::options! {
    /// The case, which is its one parameter.
    struct CartCase { gain_per_s: f64 = 5.0, in 0.0..=100.0; }
}

/// Has no state but its output port: answers every state of the cart with a command.
fn controller(gain_per_s: f64) -> Box<dyn Role> {
    let answer = move |command: &mut Output<Command>, _now: Instant, state: &State| {
        let speed_mps = gain_per_s * (0.5 - state.position_m);
        command.send(Command { speed_mps });
    };
    Component::of(Output::default())
        .input("cart/state", answer)
        .output("cart/command", |command| command)
        .into_role()
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
            "controller" => Some(controller(self.gain_per_s)),
            "cart" => Some(cart::role()),
            _ => None,
        }
    }
}

fn main() -> ExitCode {
    Runtime::new().case::<CartCase>().run()
}
