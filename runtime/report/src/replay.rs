//! `hil-runtime replay`: hands the recorded messages of a finished run back to its case, which runs
//! the robot's side again in virtual time. What is compared, and how, is the case's to say.

use std::fs;
use std::path::PathBuf;

use hil_core::replay::Replay;
use serde_json::json;

use crate::analysis::AnalysisError;
use crate::analysis::records::{MessageRecords, missing_count};
use crate::summary::RunSummary;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::terminal::canvas::{Canvas, Style};
use hil_present::terminal::section;
use hil_present::{Section, Tone};
use hil_rundir::manifest::Manifest;
use hil_rundir::run_folder::RunFolder;
use hil_topology::registry::{CaseEntry, CaseError, Registry};

/// Why a run cannot be replayed at all.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// No manifest, or one that cannot be read.
    #[error("{}: not a run's folder: {problem}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The run was of the user's own programs.
    #[error("the run is of no case; only a case can be replayed")]
    NoCase,
    /// This binary does not have the case.
    #[error("the run is of case {name}, which this program does not know")]
    UnknownCase {
        /// Its name.
        name: String,
    },
    /// The case refused the parameters it was run with.
    #[error("case {name} cannot be made again: {source}")]
    Case {
        /// Its name.
        name: String,
        /// What it said.
        source: CaseError,
    },
    /// The case has no replay.
    #[error("case {name} has no replay; `hil-runtime cases` lists what each case offers")]
    NoReplay {
        /// Its name.
        name: String,
    },
    /// The records cannot be read.
    #[error(transparent)]
    Records(#[from] AnalysisError),
    /// There are no records.
    #[error("{}: no messages are recorded here, so there is nothing to replay", folder.display())]
    NoRecords {
        /// The records folder.
        folder: PathBuf,
    },
}

/// A run that was replayed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replayed {
    run: String,
    case: String,
    replay: Replay,
}

/// Replays the run in `folder`; `tell` hears what is done, and the share of it where that is known.
///
/// # Errors
/// When there is nothing to replay, or nobody who can.
pub fn replay(
    folder: &RunFolder,
    registry: &Registry,
    tell: &dyn Fn(Option<f64>, &str),
) -> Result<Replayed, ReplayError> {
    let manifest = Manifest::read(folder).map_err(|error| ReplayError::Manifest {
        path: folder.manifest(),
        problem: error.to_string(),
    })?;
    let case = manifest.topology.get("case").ok_or(ReplayError::NoCase)?;
    let name = case["name"].as_str().ok_or_else(|| ReplayError::Manifest {
        path: folder.manifest(),
        problem: format!("topology.case.name is {}, expected text", case["name"]),
    })?;
    let name = name.to_owned();
    let Some(entry) = registry.find(&name) else {
        return Err(ReplayError::UnknownCase { name });
    };
    let case = match entry.make(case["parameters"].clone(), manifest.seed) {
        Ok(case) => case,
        Err(source) => return Err(ReplayError::Case { name, source }),
    };
    let reach = |share| tell(Some(share), "reading messages");
    let mut records = MessageRecords::read(&folder.records(), &reach)?;
    tell(None, "running the robot again");
    if records.log.counts().next().is_none() {
        let folder = folder.records();
        return Err(ReplayError::NoRecords { folder });
    }
    if !has_one_clock(folder) {
        records.log.set_clocks_differ();
    }
    let Some(mut replay) = case.replay(&records.log) else {
        return Err(ReplayError::NoReplay { name });
    };
    let also = gaps(entry, &records, &replay.gaps);
    replay.gaps.extend(also);
    Ok(Replayed {
        run: folder.name(),
        case: name,
        replay,
    })
}

/// True when the run's summary says so; a run without one is taken at its worst.
fn has_one_clock(folder: &RunFolder) -> bool {
    let summary = fs::read_to_string(folder.summary())
        .ok()
        .and_then(|text| RunSummary::from_json(&text).ok());
    // Records are replayed as they were taken: aligned clocks are two clocks still.
    summary.is_some_and(|summary| {
        let clocks = summary.clocks.as_ref();
        clocks.map_or(!summary.score_events.clocks_differ, |one| one.has_one_clock)
    })
}

/// What is missing of the records and not told by the case already. A role that tells the record
/// more than the other roles is the one that runs again: what it said must be there, and what only
/// the record heard must be whole.
fn gaps(entry: &CaseEntry, records: &MessageRecords, told: &[String]) -> Vec<String> {
    let mut gaps = records.problems.clone();
    let channels = entry.channels.iter();
    let tells_more = |role: &str| {
        let mut recorded = channels.clone().filter(|one| one.is_recorded_only());
        recorded.any(|one| one.from == role)
    };
    for channel in channels.clone().filter(|one| tells_more(one.from)) {
        let name = channel.name;
        if told.iter().any(|gap| gap.contains(name)) {
            continue;
        }
        if !records.files.contains(name) {
            gaps.push(format!("{name}: no record is at hand"));
        }
        let missing = missing_count(records.log.raw(name));
        if channel.is_recorded_only() && missing > 0 {
            let count = grouped(missing);
            gaps.push(format!("{name}: {count} missing in its record"));
        }
    }
    gaps
}

impl Replayed {
    /// True when nothing differs and nothing is missing.
    pub fn is_identical(&self) -> bool {
        self.replay.is_identical()
    }

    fn verdict(&self) -> &'static str {
        let replay = &self.replay;
        if replay.is_identical() {
            "identical"
        } else if replay.different_count > 0 {
            "DIFFERENT"
        } else if replay.compared_count == 0 {
            "nothing was compared"
        } else {
            "records are missing"
        }
    }

    /// The outcome for people, as text of at most `width` columns.
    pub fn text(&self, width: usize) -> String {
        let replay = &self.replay;
        let mut outcome = Section::new("replay", "", "");
        let mut fact = |label: &str, words: String| outcome.fact(label, Tone::Plain, words);
        fact("method", replay.method.clone());
        fact("went in", counted(replay.input_count, "message"));
        let compared = counted(replay.compared_count, "message");
        let different = match replay.different_count {
            0 => "none differs".to_owned(),
            1 => "1 differs".to_owned(),
            count => format!("{} differ", grouped(count)),
        };
        fact("compared", format!("{compared}, {different}"));
        if let Some(first) = &replay.first_difference {
            fact("first difference", first.clone());
        }
        for (index, gap) in replay.gaps.iter().enumerate() {
            fact(if index == 0 { "gaps" } else { "" }, gap.clone());
        }
        let mut canvas = Canvas::new(width, Style::Plain);
        let title = format!("{} · {}: {}", self.case, self.run, self.verdict());
        canvas.paragraph(0, Tone::Plain, &title);
        section(&mut canvas, &outcome);
        canvas.finish()
    }

    /// The outcome for programs.
    pub fn json(&self) -> String {
        let document = json!({
            "run": self.run,
            "case": self.case,
            "is_identical": self.is_identical(),
            "replay": self.replay,
        });
        format!("{document:#}\n")
    }
}

#[cfg(test)]
mod tests;
