//! What the benches of two hosts say before they measure, and how they end.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::process::ExitCode;

use serde_json::json;

use super::hosts::SetupError;
use crate::HostFacts;

/// Says where it is measured: who runs on which processor (`threads`), over which wire (`network`).
pub fn announce(bench: &str, threads: &str, network: &str) {
    let facts = HostFacts::read(threads);
    println!(
        "{}",
        json!({"bench": bench, "host": facts.to_json(), "network": network})
    );
    println!(
        "network: {network}; load {} at the start; policy {}; governor {}",
        facts.load_average, facts.scheduling_policy, facts.governor
    );
}

/// A bench is no test: what could not be measured is said, and the code is 0 all the same.
pub fn ended(bench: &str, outcome: Result<(), SetupError>) -> ExitCode {
    if let Err(error) = outcome {
        println!("{bench}: not measurable here: {error}");
    }
    ExitCode::SUCCESS
}

/// Measures, given the number of processors, where each of two hosts can have one.
pub fn with_a_processor_each(
    bench: &str,
    measure: impl FnOnce(usize) -> Result<(), SetupError>,
) -> ExitCode {
    let cpu_count = std::thread::available_parallelism().map_or(1, Into::into);
    let outcome = if cpu_count < 2 {
        Err(format!("{cpu_count} processor, 2 hosts that want one each").into())
    } else {
        measure(cpu_count)
    };
    ended(bench, outcome)
}
