//! What a live recorder costs a whole run: the shuttle on two hosts with its own processes and gateways,
//! which in turns is recorded on both hosts and is not. Not a test: it states the aim and whether it
//! was met, or that the rounds were too few to tell, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench recorder_on_off -- [--rounds N] [--turn SECONDS] [--rate HZ]
//! [--pin CPU,CPU] [--set KEY=VALUE]...`, also by `HIL_BENCH_ROUNDS`, `HIL_BENCH_TURN_S` and
//! `HIL_BENCH_PIN`, which keeps the processes of each host on a processor of its own. About 9 s a round of
//! four turns, off, on, on, off or the other way round, and ten minutes for all. Both hops are judged
//! together as well, as "all channels": that is the figure with the least noise.
//!
//! `HIL_RUNTIME_BINARY` and `HIL_RECORDER_BINARY` name the programs; without them they are built, as tests
//! build them and not as users do. Namespaces take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::turns::{self, Arguments, Contest, Turn, wait_turn};
use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::wait_until;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::signal::Signal;
use nix::sys::time::TimeValLike;

/// What is left out of a turn at its beginning: recorders come or go.
const GUARD: Duration = Duration::from_millis(400);
const LIMIT: Duration = Duration::from_mins(1);

const CONTEST: Contest<2> = Contest {
    bench: "recorder_on_off",
    kinds: ["off", "on"],
    aims: [1.02, 1.05],
    // A recorder takes a moment to come and to go, after each of its turns.
    extra: Duration::from_secs(7),
};

/// What the recorders did in all turns.
#[derive(Debug, Default)]
struct Work {
    processor_s: f64,
    wall_s: f64,
    missed: Vec<String>,
}

fn recorded_turn(
    (lab, folder): (&Lab, &Path),
    length: Duration,
    work: &mut Work,
) -> Result<Turn, SetupError> {
    let files: [PathBuf; 2] = [0, 1].map(|index| folder.join(format!("{index}.mcap")));
    let mut recorders = [0, 1].map(|index| {
        let mut command = lab.host(index).command(hil_recorder_binary());
        let arguments = ["record", "--from-now", "--force", "-o"];
        ChildGuard::spawn(command.args(arguments).arg(&files[index]))
    });
    for file in &files {
        let partial = file.with_extension("mcap.partial");
        wait_until(LIMIT, "a recorder's file", || partial.is_file());
    }
    let turn = wait_turn(GUARD, length);
    let before_s = children_s()?;
    for recorder in &mut recorders {
        let recorder = recorder.as_mut().map_err(|error| error.to_string())?;
        recorder.signal(Signal::SIGINT)?;
        let finished = recorder.wait_within(LIMIT)?;
        // Interrupted, with a whole file.
        if finished.status.code() != Some(130) {
            return Err(format!("a recorder failed: {finished:?}").into());
        }
        if !finished.stdout.contains("missed 0") {
            work.missed.push(finished.stdout.trim().to_owned());
        }
    }
    work.processor_s += children_s()? - before_s;
    work.wall_s += 2.0 * (length + GUARD).as_secs_f64();
    Ok(turn)
}

/// Processor time of all children that have ended, seconds.
fn children_s() -> Result<f64, SetupError> {
    let usage = getrusage(UsageWho::RUSAGE_CHILDREN)?;
    let total = usage.user_time() + usage.system_time();
    Ok(total.num_microseconds() as f64 * 1e-6)
}

fn measure() -> Result<(), SetupError> {
    let arguments = Arguments::read((60, 1.5))?;
    // Built before anything is measured, not between.
    let binaries = [hil_runtime_binary(), hil_recorder_binary()];
    println!(
        "binaries: {}, {}",
        binaries[0].display(),
        binaries[1].display()
    );
    let network = Network::open();
    let Some(lab) = network.lab() else {
        return Err(network.note().to_owned().into());
    };
    let recordings = RunFolder::new("recordings");
    let mut work = Work::default();
    CONTEST.hold(&arguments, lab, &mut |kind, length| match kind {
        0 => Ok(wait_turn(GUARD, length)),
        _ => recorded_turn((lab, recordings.path()), length, &mut work),
    })?;
    println!(
        "\na recorder took {:.1} % of a processor, its start and end included",
        100.0 * work.processor_s / work.wall_s
    );
    for words in &work.missed {
        println!("MISSED {words}");
    }
    Ok(())
}

fn main() -> ExitCode {
    turns::exit(CONTEST.bench, measure())
}
