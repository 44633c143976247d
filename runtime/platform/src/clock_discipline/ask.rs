//! Asks the daemons that steer the clock, by their own tools and for a bounded time. What the
//! answers mean is read elsewhere.

use std::io::Read;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use super::{ChronyTracking, NtpVariables, PtpStatus};
use crate::host_facts::HostFiles;
use crate::open_files;

/// How long a tool may take; a daemon on this host answers within milliseconds, but `ntpq` of ntpsec
/// alone takes a third of a second to start on a busy machine.
const PATIENCE: Duration = Duration::from_secs(1);
const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// Longer than any answer.
const ANSWER_BYTES_MAX: u64 = 1 << 16;

/// The names of the processes that run here, as the kernel cuts them.
pub(super) fn running_processes() -> Vec<String> {
    let names = HostFiles::of_this_host().process_names();
    names.available().cloned().unwrap_or_default()
}

pub(super) fn chrony() -> Result<ChronyTracking, String> {
    ChronyTracking::parse(&answer("chronyc", &["-n", "-c", "tracking"])?)
}

pub(super) fn ptp() -> Result<PtpStatus, String> {
    let questions = ["GET TIME_STATUS_NP", "GET CURRENT_DATA_SET"];
    let [status, current] = questions;
    PtpStatus::parse(&answer("pmc", &["-u", "-b", "0", status, current])?)
}

pub(super) fn ntp() -> Result<NtpVariables, String> {
    NtpVariables::parse(&answer("ntpq", &["-n", "-c", "rv", "127.0.0.1"])?)
}

/// What `program` prints, if it ends in time and without a fault.
fn answer(program: &str, arguments: &[&str]) -> Result<String, String> {
    answer_within(PATIENCE, program, arguments)
}

fn answer_within(patience: Duration, program: &str, arguments: &[&str]) -> Result<String, String> {
    open_files::withhold().map_err(|error| format!("{program}: {error}"))?;
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .map_err(|error| format!("{program}: {error}"))?;
    let deadline = Instant::now() + patience;
    let ended = loop {
        match child.try_wait() {
            Ok(Some(status)) => break Ok(status),
            Ok(None) if Instant::now() < deadline => thread::sleep(LOOK_PERIOD),
            Ok(None) => {
                let limit_ms = patience.as_millis();
                break Err(format!("{program} did not answer within {limit_ms} ms"));
            }
            Err(error) => break Err(format!("{program}: {error}")),
        }
    };
    if ended.is_err() {
        // It may end by itself in between; waiting afterwards is what matters.
        let _already_ended = child.kill().is_err();
        let _already_waited_for = child.wait().is_err();
    }
    let status = ended?;
    if !status.success() {
        return Err(format!("{program} ended with {status}"));
    }
    let mut text = String::new();
    let output = child.stdout.take();
    let output = output.ok_or_else(|| format!("{program} printed nothing"))?;
    output
        .take(ANSWER_BYTES_MAX)
        .read_to_string(&mut text)
        .map_err(|error| format!("{program}: {error}"))?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tool_that_is_not_there_fails_or_hangs_is_an_error_and_one_that_answers_is_read() {
        assert!(answer("no-such-tool-here", &[]).is_err());
        // On a busy machine a program may start late.
        let at_length =
            |program, arguments: &[&str]| answer_within(Duration::from_mins(1), program, arguments);
        let failed = at_length("false", &[]).unwrap_err();
        assert!(failed.contains("ended with"));
        assert_eq!(at_length("echo", &["C0A80A01,1"]).unwrap(), "C0A80A01,1\n");
        assert!(answer("sleep", &["60"]).unwrap_err().contains("within"));
    }
}
