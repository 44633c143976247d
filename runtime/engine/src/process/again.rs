//! This program once more as a child that cannot outlive it: a run among others of which this process keeps account, or a
//! probe beside a run.

use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use std::{env, io, process, thread};

use hil_platform::own_process::{self, RUNNING_FILE};
use hil_platform::signals::Signals;
use hil_platform::systemd;
use nix::sys::signal::Signal;

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
    let mut command = command(arguments);
    command.stdout(output.try_clone()?);
    command.stderr(output.try_clone()?);
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

/// This program with `arguments`, bound to this process.
fn command(arguments: &[String]) -> Command {
    // As its user would start it, unless another file is there by now.
    let called = env::current_exe().ok().filter(|path| path.is_file());
    let program = called.unwrap_or_else(|| PathBuf::from(RUNNING_FILE));
    let mut command = own_process::again();
    command.args(["become", "--supervisor", &process::id().to_string()]);
    command.arg("--").arg(program).args(arguments);
    // Told by this process when to end, and once.
    command.stdin(Stdio::null()).process_group(0);
    for variable in systemd::VARIABLES {
        command.env_remove(variable);
    }
    command
}

/// This program once more beside this process.
#[derive(Debug)]
pub struct Beside(Child);

impl Beside {
    /// Starts it with `arguments`; only what it says of faults is heard.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn start(arguments: &[String]) -> io::Result<Self> {
        let mut command = command(arguments);
        command.stdout(Stdio::null());
        Child::spawn_apart(&mut command).map(Self)
    }

    /// Whether it has ended by itself.
    pub fn is_over(&mut self) -> bool {
        self.0.poll_end().is_some()
    }

    /// Tells it to end and gives its exit code; `None` where it was killed, as it had not ended `within` that time.
    pub fn end(mut self, within: Duration) -> Option<i32> {
        self.0.signal(Signal::SIGTERM);
        self.0.end(Instant::now() + within);
        self.0.poll_end()?.code()
    }
}
