//! `hil-runtime tables`: a case's study in virtual time, on as many threads as there are
//! processors. It starts no process, opens no socket and changes no figure: those come from the
//! tasks alone, whatever the number of threads.

mod pool;
mod render;

use std::fs;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use hil_models::study::{Batch, StudyReport};

use crate::console::Console;
use crate::registry::Registry;
use crate::signals::Signals;
use crate::topology::Topology;

use self::pool::Pool;

/// How to run a study and where to put its tables.
#[derive(Debug, Clone)]
pub(crate) struct StudyOptions {
    /// Threads; all processors if left out.
    pub(crate) jobs: Option<NonZeroUsize>,
    /// Print JSON instead of tables.
    pub(crate) is_json: bool,
    /// Folder for the tables as files.
    pub(crate) output: Option<PathBuf>,
}

/// How a study ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StudyEnd {
    /// Every criterion that could be judged is met.
    Passed,
    /// A criterion is missed.
    Missed,
    /// It was interrupted; what was complete is shown.
    Interrupted,
}

/// What a study cost this machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cost {
    pub(crate) wall: Duration,
    /// Processor time of all threads; `None` when the kernel does not tell.
    pub(crate) processor: Option<Duration>,
    pub(crate) jobs: usize,
    pub(crate) task_count: usize,
    pub(crate) ended_count: usize,
}

/// Why there are no tables.
#[derive(Debug, thiserror::Error)]
pub(crate) enum StudyError {
    /// The topology names no case.
    #[error("the topology names no case; only a case has tables")]
    NoCase,
    /// The case has none.
    #[error("case {case} has no tables")]
    NoTables {
        /// Its name.
        case: String,
    },
    /// The case refused its parameters.
    #[error("{message}")]
    Case {
        /// What it said.
        message: String,
    },
    /// A file could not be written.
    #[error("{}: {source}", path.display())]
    Output {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
}

/// The study of the topology's case.
pub(crate) fn batch_of(
    topology: &Topology,
    registry: &Registry,
) -> Result<Box<dyn Batch>, StudyError> {
    let case = topology.case().ok_or(StudyError::NoCase)?;
    let refused = |message: String| StudyError::Case { message };
    let none = || StudyError::NoTables {
        case: case.name.clone(),
    };
    let entry = registry.find(&case.name).ok_or_else(none)?;
    let parameters =
        serde_json::to_value(&case.parameters).map_err(|error| refused(error.to_string()))?;
    let made = entry
        .make(parameters, topology.run().seed)
        .map_err(|error| refused(error.to_string()))?;
    let batch = made.study().map_err(|error| refused(error.to_string()))?;
    batch.ok_or_else(none)
}

/// Runs every task, prints the tables and writes them where asked.
///
/// # Errors
/// When a file cannot be written; the tables are printed all the same.
pub(crate) fn run(
    batch: &dyn Batch,
    options: &StudyOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<StudyEnd, StudyError> {
    let jobs = options
        .jobs
        .or_else(|| thread::available_parallelism().ok())
        .map_or(1, NonZeroUsize::get)
        .min(batch.task_count().max(1));
    let pool = Pool::new(batch, jobs);
    let (outcomes, cost) = pool.run(signals, console);
    let report = batch.report(&outcomes);
    let text = if options.is_json {
        render::json(&report, &cost)
    } else {
        render::text(&report, &cost)
    };
    console.result(&text);
    if let Some(folder) = &options.output {
        write_files(folder, &report, &cost)?;
        console.say(&format!("wrote the tables to {}", folder.display()));
    }
    if let Some(signal) = signals.received() {
        console.warn(&format!(
            "ended by {signal}: {} of {} tasks are in the tables",
            cost.ended_count, cost.task_count
        ));
        return Ok(StudyEnd::Interrupted);
    }
    Ok(if report.is_passed() {
        StudyEnd::Passed
    } else {
        StudyEnd::Missed
    })
}

fn write_files(folder: &Path, report: &StudyReport, cost: &Cost) -> Result<(), StudyError> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |source| StudyError::Output { path, source }
    };
    fs::create_dir_all(folder).map_err(at(folder))?;
    let write = |name: String, text: String| {
        let path = folder.join(name);
        fs::write(&path, text).map_err(at(&path))
    };
    for table in &report.tables {
        write(format!("{}.csv", table.name), render::csv(table))?;
    }
    write("report.json".to_owned(), render::json(report, cost))?;
    write("report.txt".to_owned(), render::text(report, cost))
}
