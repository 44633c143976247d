//! Where the records of a served run come from: a finished run's folder, or one that goes on.

use std::time::Duration;

use hil_rundir::status::Overruns;
use serde::Serialize;

use crate::view::LiveRecord;

/// How it goes on after a look.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Progress {
    /// More will come.
    Going,
    /// It begins again.
    Rewound,
    /// No more will come, and how the run ended.
    Ended(String),
}

/// Something that is amiss.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Warning {
    /// With which process, where that is known.
    pub(crate) process: Option<String>,
    /// What.
    pub(crate) what: String,
}

/// A run's records as they come.
pub(crate) trait Source {
    /// Now, on the axis of the records' times.
    fn now_ns(&self) -> i64;

    /// Gives out what came since the last look.
    fn poll(&mut self, take: &mut dyn FnMut(&LiveRecord)) -> Progress;

    /// Numbers that were never seen on channels read from shared memory; `None` where none is.
    fn missed_count(&self) -> Option<u64> {
        None
    }

    /// How long to rest before the next look, where that hangs on what was found.
    fn rest(&mut self) -> Option<Duration> {
        None
    }

    /// True when the stamps of all hosts compare; may become true while a run goes on.
    fn has_one_clock(&self) -> bool;

    /// What is amiss with the run or its host, as far as it is known by now.
    fn warnings(&self) -> Vec<Warning>;

    /// Ticks that the processes of the run skipped so far, and which hosts are heard; `None` where nobody tells, as of a finished run,
    /// whose report has them among its warnings.
    fn overruns(&mut self) -> Option<Overruns> {
        None
    }

    /// What could not be read since the last call.
    fn take_problems(&mut self) -> Vec<String> {
        Vec::new()
    }
}
