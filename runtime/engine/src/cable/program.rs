//! The thread that waits for the end of a program, or ends it, and looks after the server of its cable.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_cable::{CableServer, InterfaceDrops};
use hil_platform::signals::Signals;
use hil_rundir::pipe::{
    CountByName, CounterGroup, FromProcess, InletReport, Orders, ProcessReport, ToProcess, say,
};

use crate::process::worker::{JobWork, WorkerError};
use crate::supervisor::Child;

/// How often it is looked whether the program has ended.
const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// How long it may take to end when told to: less than this process may.
const PATIENCE: Duration = Duration::from_secs(2);

/// A program in a group with this process, or the helper that will become it.
#[derive(Debug)]
pub(super) struct Program {
    pub(super) child: Child,
    pub(super) server: CableServer,
    pub(super) name: String,
    /// Of what it sends, and of what it receives.
    pub(super) channels: [String; 2],
    /// Set by the end of the program.
    pub(super) stop: Arc<AtomicBool>,
    /// The group is told to end by a signal, which is not meant for this process.
    pub(super) _signals: Signals,
}

impl JobWork for Program {
    fn begin(&mut self, _orders: &Orders) -> Result<bool, WorkerError> {
        Ok(true)
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        self.server.attend().map_err(WorkerError::Socket)?;
        let Some(end) = self.child.poll_end() else {
            return Ok(false);
        };
        self.stop.store(true, Ordering::Release);
        if end.code() == Some(0) {
            return Ok(true);
        }
        Err(WorkerError::ProgramEnded {
            program: self.name.clone(),
            end: end.to_string(),
        })
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        thread::sleep(LOOK_PERIOD);
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        // What it started is in the group, too.
        self.child.order(&ToProcess::Stop);
        if !self.child.end(Instant::now() + PATIENCE) {
            let (name, patience_s) = (&self.name, PATIENCE.as_secs());
            let text = format!("{name} did not end within {patience_s} s and was killed");
            say(&FromProcess::Warning(text));
        }
        Ok(())
    }

    fn report(&mut self) -> ProcessReport {
        // What the kernel does not tell is left out.
        let Ok(InterfaceDrops {
            inward_count,
            outward_count,
        }) = self.server.drops()
        else {
            return ProcessReport::default();
        };
        let [output, input] = &self.channels;
        let dropped = |channel: &String, counted| InletReport {
            channel: channel.clone(),
            lost: CountByName::all(CounterGroup::Own, [counted]).collect(),
        };
        ProcessReport {
            inlets: vec![
                dropped(output, (InletReport::DROPPED_SENT, outward_count)),
                dropped(input, (InletReport::DROPPED_GIVEN, inward_count)),
            ],
            ..ProcessReport::default()
        }
    }
}
