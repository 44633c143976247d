//! The thread that waits for the end of a program, or ends it.

use std::process::{Child, ExitStatus};
use std::thread;
use std::time::{Duration, Instant};

use hil_platform::signals::Signals;
use hil_rundir::pipe::{FromProcess, Orders, ProcessReport, say};
use nix::sys::signal::{Signal, killpg};
use nix::unistd::getpgrp;

use crate::process::worker::{JobWork, WorkerError};
use crate::supervisor::ProcessEnd;

/// How often it is looked whether the program has ended.
const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// How long it may take to end when told to: less than this process may.
const PATIENCE: Duration = Duration::from_secs(2);

/// A program, or the helper that will become it.
#[derive(Debug)]
pub(super) struct Program {
    child: Child,
    name: String,
}

impl Program {
    pub(super) fn new(child: Child, name: &str) -> Self {
        Self {
            child,
            name: name.to_owned(),
        }
    }

    /// The same, whose group may be told to end: this process survives that by `signals`.
    pub(super) fn guarded_by(self, signals: Signals) -> Guarded {
        Guarded {
            program: self,
            _signals: signals,
        }
    }

    fn end(&mut self) -> Option<ExitStatus> {
        // A child of this process can be waited for until it has been.
        self.child.try_wait().ok().flatten()
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        if self.end().is_none() {
            // It may have ended just now.
            let _gone = self.child.kill().and_then(|()| self.child.wait()).is_err();
        }
    }
}

/// A program in a group with this process.
#[derive(Debug)]
pub(super) struct Guarded {
    program: Program,
    _signals: Signals,
}

impl JobWork for Guarded {
    fn run(&mut self, orders: &Orders) -> Result<(), WorkerError> {
        let Self { program, .. } = self;
        while !orders.is_stopping() {
            if let Some(status) = program.end() {
                return if status.success() {
                    Ok(())
                } else {
                    Err(WorkerError::ProgramEnded {
                        program: program.name.clone(),
                        end: ProcessEnd::Exited(status).to_string(),
                    })
                };
            }
            thread::sleep(LOOK_PERIOD);
        }
        // What it started is in the group, too.
        let _gone = killpg(getpgrp(), Signal::SIGTERM).is_err();
        let deadline = Instant::now() + PATIENCE;
        while program.end().is_none() {
            if Instant::now() >= deadline {
                let (name, patience_s) = (&program.name, PATIENCE.as_secs());
                let text = format!("{name} did not end within {patience_s} s and was killed");
                say(&FromProcess::Warning(text));
                break;
            }
            thread::sleep(LOOK_PERIOD);
        }
        Ok(())
    }

    fn report(&mut self) -> ProcessReport {
        ProcessReport::default()
    }
}
