//! `hil-runtime tables` and `calibrate`: a case's study in virtual time, on as many threads as
//! there are processors. It starts no process, opens no socket and changes no figure: those come from the
//! tasks alone, whatever the number of threads.

mod pool;
pub mod probed;
mod recorded;
pub mod recording;
mod sections;

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, thread};

use hil_core::study::{Batch, StudyReport};

use clap::Args;
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_present::csv;
use hil_present::terminal::canvas::Style;
use hil_topology::Topology;
use hil_topology::registry::Registry;

pub use self::recorded::RunArgument;

use self::pool::Pool;
use self::sections::Extent;

/// How a batch of virtual-time tasks is computed, and where its tables go.
#[derive(Debug, Args)]
pub struct BatchArgs {
    /// Threads; all processors if left out.
    #[arg(long, short, value_name = "N")]
    pub jobs: Option<NonZeroUsize>,
    /// Print every table with all of its columns, and every criterion.
    #[arg(long, conflicts_with = "json")]
    pub full: bool,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
    /// Also write the tables to this folder: one CSV file each, report.txt and report.json.
    #[arg(long, short, value_name = "DIR")]
    pub output: Option<PathBuf>,
    /// Print no progress, only the tables.
    #[arg(long, short)]
    pub quiet: bool,
}

/// How the command was called, to be shown with other values, and where it is shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Invocation {
    /// Without what follows `--set`.
    pub words: Vec<String>,
    /// `KEY=VALUE` each.
    pub overrides: Vec<String>,
    /// What is to be said of the rows that it recorded.
    pub remarks: Vec<String>,
    /// Columns of the page.
    pub columns: usize,
}

/// What a study cost this machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cost {
    pub(crate) wall: Duration,
    pub(crate) jobs: usize,
    pub(crate) task_count: usize,
    pub(crate) ended_count: usize,
}

/// Why there are no tables.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    /// The topology names no case.
    #[error("the topology names no case; only a case can be studied")]
    NoCase,
    /// The case has none.
    #[error("case {case} has no tables")]
    NoTables {
        /// Its name.
        case: String,
    },
    /// The case has no search for that figure.
    #[error("case {case} cannot be calibrated for {figure}; {known}")]
    NoCalibration {
        /// Its name.
        case: String,
        /// The figure.
        figure: String,
        /// What it can be calibrated for, in words.
        known: String,
    },
    /// The case refused its parameters, a recorded run, or the figure's value.
    #[error("{message}")]
    Case {
        /// What it said.
        message: String,
    },
    /// A recorded run can be no row.
    #[error("--run: {problem}")]
    Run {
        /// Which one, and why not.
        problem: String,
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

/// What is wanted of a case.
#[derive(Debug, Clone, Copy)]
pub enum Wanted<'a> {
    /// Its tables.
    Tables {
        /// Recorded runs that become rows of them.
        runs: &'a [RunArgument],
    },
    /// The link parameters under which a figure comes out as a value.
    Calibration {
        /// The figure's name.
        figure: &'a str,
        /// Its value.
        value: f64,
    },
}

/// The study of the topology's case.
///
/// # Errors
/// When the case has no study, or refuses its parameters or a recorded run.
pub fn batch_of(
    topology: &Topology,
    registry: &Registry,
    wanted: Wanted<'_>,
) -> Result<Box<dyn Batch>, StudyError> {
    let refused = |message: String| StudyError::Case { message };
    let made = registry
        .make_case(topology)
        .map_err(|error| refused(error.to_string()))?;
    let (entry, case) = made.ok_or(StudyError::NoCase)?;
    let name = || entry.name.to_owned();
    match wanted {
        Wanted::Tables { runs } => {
            let recorded = recorded::read(runs, entry.name);
            let recorded = recorded.map_err(|problem| StudyError::Run { problem })?;
            case.study(recorded)
                .map_err(|error| refused(error.to_string()))?
                .ok_or_else(|| StudyError::NoTables { case: name() })
        }
        Wanted::Calibration { figure, value } => case
            .calibration(figure, value)
            .map_err(|error| refused(error.to_string()))?
            .ok_or_else(|| StudyError::NoCalibration {
                case: name(),
                figure: figure.to_owned(),
                known: match entry.calibrated_metrics {
                    [] => "it has no calibration".to_owned(),
                    figures => format!("there is {}", figures.join(", ")),
                },
            }),
    }
}

/// Runs every task, prints the tables and writes them where asked.
///
/// # Errors
/// When a file cannot be written; the tables are printed all the same.
pub fn run(
    batch: &dyn Batch,
    args: &BatchArgs,
    invocation: &Invocation,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, StudyError> {
    let jobs = args
        .jobs
        .or_else(|| thread::available_parallelism().ok())
        .map_or(1, NonZeroUsize::get)
        .min(batch.task_count().max(1));
    let pool = Pool::new(batch, jobs);
    let (outcomes, cost) = pool.run(signals, console);
    let mut report = batch.report(&outcomes);
    report.summary.extend_from_slice(&invocation.remarks);
    let text = |extent, style| sections::text(&report, &cost, invocation, extent, style);
    console.result(&if args.json {
        sections::json(&report, &cost)
    } else if args.full {
        text(Extent::Full, Style::Coloured)
    } else {
        text(Extent::Brief, Style::Coloured)
    });
    if let Some(folder) = &args.output {
        let text = text(Extent::Full, Style::Plain);
        write_files(folder, &report, &cost, text)?;
        console.say(&format!("wrote the tables to {}", folder.display()));
    }
    if let Some(signal) = signals.received() {
        console.warn(&format!(
            "ended by {signal}: {} of {} tasks are in the tables",
            cost.ended_count, cost.task_count
        ));
        return Ok(CommandEnd::Interrupted);
    }
    Ok(if report.is_passed() {
        CommandEnd::Done
    } else {
        CommandEnd::Failed
    })
}

fn write_files(
    folder: &Path,
    report: &StudyReport,
    cost: &Cost,
    text: String,
) -> Result<(), StudyError> {
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
        let rows = csv::table(&sections::table(table));
        write(format!("{}.csv", table.name), rows)?;
    }
    write("report.json".to_owned(), sections::json(report, cost))?;
    write("report.txt".to_owned(), text)
}

#[cfg(test)]
mod tests;
