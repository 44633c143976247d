//! A program of somebody's own, for tests: publishes every output of its card at a rate, and takes every input.
//!
//! `hil-traffic HZ`, started by a supervisor.

use std::env;
use std::error::Error;
use std::time::Duration;

use hil_core::message::Envelope;
use hil_platform::clock::MonotonicClock;
use hil_platform::signals::Signals;
use hil_shm::{Domain, RawInput, RawOutput, Waiter};
use hil_topology::RoleSpec;

fn main() -> Result<(), Box<dyn Error>> {
    let hz: f64 = env::args().nth(1).ok_or("a rate is missing")?.parse()?;
    let card: RoleSpec = serde_json::from_slice(&std::fs::read(env::var("HIL_CARD")?)?)?;
    let signals = Signals::install()?;
    let domain = Domain::open(&env::var("HIL_DOMAIN")?.parse()?)?;
    let mut outputs = Vec::new();
    for channel in &card.outputs {
        let output = RawOutput::open(&domain, &channel.name, true)?;
        outputs.push((output, vec![1; channel.message_size_bytes]));
    }
    let mut inputs = Vec::new();
    for channel in &card.inputs {
        inputs.push(RawInput::open(&domain, &channel.name, channel.depth)?);
    }
    let names: Vec<&str> = card.inputs.iter().map(|one| one.name.as_str()).collect();
    let mut waiter = (!names.is_empty())
        .then(|| Waiter::open(&domain, &names))
        .transpose()?;
    let period = Duration::from_secs_f64(1.0 / hz);
    let mut due = MonotonicClock::now();
    let mut sequence = 0;
    while signals.received().is_none() {
        let now = MonotonicClock::now();
        if due <= now {
            due = due + period;
            for (output, payload) in &mut outputs {
                let envelope = Envelope {
                    sequence,
                    published_ns: MonotonicClock::now().as_ns(),
                    epoch: std::process::id(),
                    ..Envelope::default()
                };
                output.publish(&envelope, payload)?;
            }
            sequence += 1;
        }
        for input in &mut inputs {
            while input.receive(&mut |_, _| {})? {}
        }
        match &mut waiter {
            // What comes before the next turn is taken in it.
            Some(waiter) => drop(waiter.wait_until(Some(due))?),
            None => std::thread::sleep(due.saturating_duration_since(MonotonicClock::now())),
        }
    }
    Ok(())
}
