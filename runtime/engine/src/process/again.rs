//! This program once more as a child that cannot outlive it: a run among others of which this process keeps account.

use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Duration;
use std::{env, io, process, thread};

use hil_platform::own_process::{self, RUNNING_FILE};
use hil_platform::signals::Signals;
use hil_platform::systemd;

use crate::supervisor::Child;

/// How often it is looked whether the child has ended.
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// Runs this program with `arguments` to its end and gives its exit code; `None` where it was killed. Both of its outputs go to
/// `output`. It is told once of a signal that this process gets, and killed where this process is. `meanwhile` is called
/// at each look.
///
/// # Errors
/// When it cannot be started.
pub fn run_again(
    arguments: &[String],
    output: &File,
    signals: &Signals,
    mut meanwhile: impl FnMut(),
) -> io::Result<Option<i32>> {
    // As its user would start it, unless another file is there by now.
    let called = env::current_exe().ok().filter(|path| path.is_file());
    let program = called.unwrap_or_else(|| PathBuf::from(RUNNING_FILE));
    let mut command = own_process::again();
    command.args(["become", "--supervisor", &process::id().to_string()]);
    command.arg("--").arg(program).args(arguments);
    command.stdin(Stdio::null()).stdout(output.try_clone()?);
    // Told by this process when to end, and once.
    command.stderr(output.try_clone()?).process_group(0);
    for variable in systemd::VARIABLES {
        command.env_remove(variable);
    }
    let mut child = Child::spawn_apart(&mut command)?;
    let mut is_told = false;
    loop {
        if let Some(end) = child.poll_end() {
            return Ok(end.code());
        }
        if !is_told && let Some(signal) = signals.received_signal() {
            is_told = true;
            child.signal(signal);
        }
        meanwhile();
        thread::sleep(LOOK_PERIOD);
    }
}
