//! Which runs go on this host, and which of them is meant.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::live_run::LiveRun;
use hil_platform::domain_address::domain_base_candidates;

/// Why no run could be chosen.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectError {
    /// Nothing runs.
    #[error("no run goes on this host")]
    NoneRuns,
    /// Nothing of that name runs.
    #[error("no run {wanted:?} goes on this host; {}", list(.running))]
    NoSuch {
        /// What was asked for.
        wanted: String,
        /// What runs.
        running: Vec<String>,
    },
    /// A folder of a run that is over.
    #[error("the run in {folder} does not go any more")]
    Over {
        /// The folder.
        folder: PathBuf,
    },
    /// More than one could be meant.
    #[error("{} runs could be meant: {}; give the name of one, or its folder", .running.len(), .running.join(", "))]
    Several {
        /// Their names.
        running: Vec<String>,
    },
}

fn list(running: &[String]) -> String {
    if running.is_empty() {
        "none does".to_owned()
    } else {
        format!("these do: {}", running.join(", "))
    }
}

/// The runs that go on this host, by name.
pub fn running_runs() -> Vec<LiveRun> {
    let bases = domain_base_candidates();
    let mut runs: Vec<LiveRun> = bases
        .iter()
        .flat_map(|base| running_runs_below(base))
        .collect();
    runs.sort_by(|one, other| (&one.name, &one.folder).cmp(&(&other.name, &other.folder)));
    runs.dedup_by(|one, other| one.folder == other.folder);
    runs
}

/// The runs whose shared-memory domains lie below `base`. Those of killed supervisors are left
/// out.
pub fn running_runs_below(base: &Path) -> Vec<LiveRun> {
    let mut found: BTreeMap<PathBuf, LiveRun> = BTreeMap::new();
    let entries = fs::read_dir(base).into_iter().flatten().flatten();
    for entry in entries {
        // Anything else there is not a domain's folder, or not one of a run that began.
        if let Ok(run) = LiveRun::read(&entry.path())
            && run.is_held()
        {
            found.insert(run.folder.clone(), run);
        }
    }
    found.into_values().collect()
}

/// The run that `wanted` means: a run's folder, its name, the beginning of its name (its topology,
/// for one), or without a word the only one.
///
/// # Errors
/// When none or several could be meant; the error names those that run.
pub fn select(wanted: Option<&str>) -> Result<LiveRun, SelectError> {
    choose(wanted, running_runs())
}

/// As [`select`], of the runs whose folders lie below `below` only.
///
/// # Errors
/// As [`select`].
pub fn select_below(below: &Path, wanted: Option<&str>) -> Result<LiveRun, SelectError> {
    choose(wanted, lying_below(below, running_runs()))
}

/// A run's folder is announced without symbolic links in it; one that is not there yet holds none.
fn lying_below(below: &Path, mut running: Vec<LiveRun>) -> Vec<LiveRun> {
    let below = fs::canonicalize(below).unwrap_or_else(|_absent| below.to_owned());
    running.retain(|run| run.folder.starts_with(&below));
    running
}

fn choose(wanted: Option<&str>, mut running: Vec<LiveRun>) -> Result<LiveRun, SelectError> {
    if let Some(wanted) = wanted {
        let folder = Path::new(wanted);
        if folder.is_dir() {
            return in_folder(folder);
        }
        let all = names(&running);
        if running.iter().any(|run| run.name == wanted) {
            running.retain(|run| run.name == wanted);
        } else {
            running.retain(|run| run.name.starts_with(wanted));
        }
        if running.is_empty() {
            return Err(SelectError::NoSuch {
                wanted: wanted.to_owned(),
                running: all,
            });
        }
    }
    if running.len() > 1 {
        let running = places(&running);
        return Err(SelectError::Several { running });
    }
    running.pop().ok_or(SelectError::NoneRuns)
}

/// A run's folder says itself where its domains are, wherever these lie.
fn in_folder(folder: &Path) -> Result<LiveRun, SelectError> {
    let over = || SelectError::Over {
        folder: folder.to_owned(),
    };
    let run = LiveRun::read(folder).map_err(|_absent| over())?;
    if run.is_held() { Ok(run) } else { Err(over()) }
}

fn names(runs: &[LiveRun]) -> Vec<String> {
    runs.iter().map(|run| run.name.clone()).collect()
}

/// Names, and folders of those that began in the same second in different places.
fn places(runs: &[LiveRun]) -> Vec<String> {
    let place = |run: &LiveRun| {
        let is_alone = runs.iter().filter(|one| one.name == run.name).count() == 1;
        if is_alone {
            run.name.clone()
        } else {
            run.folder.display().to_string()
        }
    };
    runs.iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(name: &str) -> LiveRun {
        let text = format!(
            r#"{{"schema_version": 1, "name": "{name}", "topology": "t", "folder": "/r/{name}",
               "pid": 1, "since": "", "domains": {{}}}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    fn chosen(wanted: Option<&str>, names: &[&str]) -> Result<String, String> {
        let running = names.iter().map(|name| run(name)).collect();
        let chosen = choose(wanted, running);
        chosen
            .map(|run| run.name)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_run_is_meant_by_name_by_beginning_or_by_being_the_only_one() {
        let two = ["teleop-1", "teleop-12"];
        assert_eq!(chosen(None, &["a-1"]), Ok("a-1".to_owned()));
        assert_eq!(chosen(Some("teleop-1"), &two), Ok("teleop-1".to_owned()));
        assert_eq!(chosen(Some("teleop-12"), &two), Ok("teleop-12".to_owned()));
        assert_eq!(
            chosen(Some("fleet"), &["teleop-1", "fleet-1"]),
            Ok("fleet-1".to_owned())
        );
    }

    #[test]
    fn runs_of_one_name_are_told_apart_by_their_folders() {
        let mut running = vec![run("fleet-1"), run("fleet-1")];
        running[1].folder = PathBuf::from("/elsewhere/fleet-1");
        let error = choose(Some("fleet-1"), running).unwrap_err().to_string();
        assert!(error.contains("/r/fleet-1, /elsewhere/fleet-1"), "{error}");
    }

    #[test]
    fn runs_of_other_folders_are_not_known_below_one() {
        let mut running = vec![run("fleet-1"), run("fleet-2")];
        running[1].folder = PathBuf::from("/elsewhere/fleet-2");
        let below = |folder: &str| {
            let found = lying_below(Path::new(folder), running.clone());
            names(&found)
        };
        assert_eq!(below("/elsewhere"), ["fleet-2"]);
        assert_eq!(below("/"), ["fleet-1", "fleet-2"]);
        assert!(below("/else").is_empty());
    }

    #[test]
    fn errors_name_what_runs() {
        let two = ["teleop-1", "teleop-2"];
        for wanted in [None, Some("teleop")] {
            let error = chosen(wanted, &two).unwrap_err();
            assert!(error.contains("teleop-1, teleop-2"), "{error}");
        }
        let error = chosen(Some("fleet"), &two).unwrap_err();
        assert!(
            error.contains("\"fleet\"") && error.contains("teleop-2"),
            "{error}"
        );
        assert!(
            chosen(Some("fleet"), &[])
                .unwrap_err()
                .contains("none does")
        );
        assert_eq!(chosen(None, &[]).unwrap_err(), "no run goes on this host");
        let folder = std::env::temp_dir();
        let error = chosen(folder.to_str(), &two).unwrap_err();
        assert!(error.contains("does not go any more"), "{error}");
    }
}
