//! What a probe costs a whole run: the shuttle on two hosts with a switch between them, with its own
//! processes and gateways, whose wire is in turns not tapped, tapped at a mirror port of the switch,
//! and tapped on the hosts' own interfaces. Not a test: it states the aim and whether it was met, or that
//! the rounds were too few to tell, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench probe_in_a_run -- [--rounds N] [--turn SECONDS] [--rate HZ]
//! [--set KEY=VALUE]...`, about 9 s a round. Namespaces and taps take root; without, it
//! says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::process::ExitCode;
use std::time::Duration;

use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::gateway::tap::Drainer;
use hil_benches::turns::{self, Arguments, Contest, wait_turn};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::lab::INTERFACE;

/// What is left out of a turn at its beginning: a tap is being opened or closed.
const GUARD: Duration = Duration::from_millis(150);

/// Where the wire is tapped in a turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Tap {
    /// Nowhere.
    None,
    /// At a mirror port of the switch between the hosts: no datagram's way leads through it.
    Mirror,
    /// By packet rings on the hosts' own interfaces: every datagram's way leads through two.
    Hosts,
}

const TAPS: [Tap; 3] = [Tap::None, Tap::Mirror, Tap::Hosts];
const TAP_COUNT: usize = TAPS.len();

impl Tap {
    const fn name(self) -> &'static str {
        match self {
            Self::None => "alone",
            Self::Mirror => "mirror",
            Self::Hosts => "hosts",
        }
    }

    /// Host and interface of each.
    fn places(self, mirror: &'static str) -> Vec<(usize, &'static str)> {
        match self {
            Self::None => Vec::new(),
            Self::Mirror => vec![(0, mirror)],
            Self::Hosts => vec![(0, INTERFACE), (1, INTERFACE)],
        }
    }
}

const CONTEST: Contest<TAP_COUNT> = Contest {
    bench: "probe_in_a_run",
    kinds: [TAPS[0].name(), TAPS[1].name(), TAPS[2].name()],
    aims: [1.02, 1.02],
    extra: Duration::from_secs(2),
};

/// What the taps saw.
#[derive(Debug, Default)]
struct Tapped {
    matched_count: u64,
    dropped_count: u64,
}

fn measure() -> Result<(), SetupError> {
    let arguments = Arguments::read(30, 1.0)?;
    // Built before anything is measured, not between.
    println!("binary: {}", hil_runtime_binary().display());
    let drainer = Drainer::start();
    let network = Network::open();
    let Some(lab) = network.lab() else {
        return Err(network.note().to_owned().into());
    };
    lab.put_bridge_between();
    let mirror = lab.add_mirror_port();
    let mut tapped = Tapped::default();
    CONTEST.hold(&arguments, lab, &mut |kind, length| {
        let places = TAPS[kind].places(mirror);
        let (turn, counters) =
            drainer.while_tapped(&network, &places, || wait_turn(GUARD, length))?;
        tapped.matched_count += counters.matched_count;
        tapped.dropped_count += counters.dropped_count;
        Ok(turn)
    })?;
    println!(
        "\ntapped {} datagrams, {} dropped",
        tapped.matched_count, tapped.dropped_count
    );
    drainer.finish();
    Ok(())
}

fn main() -> ExitCode {
    turns::exit(CONTEST.bench, measure())
}
