//! The folder a run leaves behind: where each file lies. What the files say is decided by those
//! who write them.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Paths of one run.
///
/// | path | content |
/// |---|---|
/// | `manifest.json` | resolved topology, layouts of messages, versions, host facts, seed |
/// | `result.json` | how the run ended and what its processes said, before any figure |
/// | `summary.json` | every figure of the report |
/// | `report.txt` | the report as printed, which ends in the answer |
/// | `report-full.txt` | every figure as text, as `report --full` prints it |
/// | `events.log` | what happened to the robot, one line each |
/// | `series/*.csv` | what the case has to plot; `series/series.json` explains the columns |
/// | `traces/*.trace` | what each link did to every message; `hil-runtime trace` reads them |
/// | `records/*.rec` | one fixed-size record per message and stage |
/// | `cards/*.json` | what each component was told it is |
/// | `launch/*.json` | how each process was started here |
/// | `logs/*.log` | what each process printed, of much the first and last MiB |
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunFolder {
    root: PathBuf,
}

impl RunFolder {
    /// Makes `<parent>/<name>-<UTC time>[-<host>]` with its sub-folders; never reuses one.
    ///
    /// # Errors
    /// When a folder cannot be made.
    pub fn create(parent: &Path, name: &str, host: Option<&str>) -> io::Result<Self> {
        let stamp = utc_stamp(SystemTime::now());
        let suffix = host.map(|host| format!("-{host}")).unwrap_or_default();
        fs::create_dir_all(parent)?;
        // Whatever the umask: who could write to it could have its files lead elsewhere.
        let mut folders = DirBuilder::new();
        folders.mode(0o755);
        for attempt in 0..100 {
            let again = if attempt == 0 {
                String::new()
            } else {
                format!(".{attempt}")
            };
            let root = parent.join(format!("{name}-{stamp}{suffix}{again}"));
            match folders.create(&root) {
                Ok(()) => {
                    let folder = Self {
                        root: root.canonicalize()?,
                    };
                    for part in ["records", "cards", "launch", "logs"] {
                        folders.create(folder.root.join(part))?;
                    }
                    return Ok(folder);
                }
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
        Err(io::Error::new(
            io::ErrorKind::AlreadyExists,
            "a hundred runs began this second",
        ))
    }

    /// A run that exists.
    pub fn existing(root: &Path) -> Self {
        Self {
            root: root.to_owned(),
        }
    }

    /// The folder itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Its last part, the name of the run.
    pub fn name(&self) -> String {
        self.root
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default()
    }

    /// Record files.
    pub fn records(&self) -> PathBuf {
        self.root.join("records")
    }

    /// The record files that are there, with their sizes in bytes, in no order.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn record_files(&self) -> io::Result<Vec<(PathBuf, u64)>> {
        let mut files = Vec::new();
        for entry in fs::read_dir(self.records())? {
            let (entry, path) = entry.map(|entry| (entry.metadata(), entry.path()))?;
            if path.extension().is_some_and(|ending| ending == "rec") {
                files.push((path, entry?.len()));
            }
        }
        Ok(files)
    }

    /// Card of a component.
    pub fn role_spec(&self, process: &str) -> PathBuf {
        self.root.join("cards").join(format!("{process}.json"))
    }

    /// Launch file of a process's start.
    pub fn launch(&self, process: &str, instance: u32) -> PathBuf {
        self.root
            .join("launch")
            .join(format!("{process}.{instance}.json"))
    }

    /// Log of a process.
    pub fn log(&self, process: &str) -> PathBuf {
        self.root.join("logs").join(format!("{process}.log"))
    }

    /// What ran.
    pub fn manifest(&self) -> PathBuf {
        self.root.join("manifest.json")
    }

    /// How it ended, before any figure.
    pub fn result(&self) -> PathBuf {
        self.root.join("result.json")
    }

    /// Every figure.
    pub fn summary(&self) -> PathBuf {
        self.root.join("summary.json")
    }

    /// What happened to the robot, line by line.
    pub fn events(&self) -> PathBuf {
        self.root.join("events.log")
    }

    /// What the case has to plot.
    pub fn series(&self) -> PathBuf {
        self.root.join("series")
    }

    /// What the links did to every message, one file per channel that crossed one.
    pub fn traces(&self) -> PathBuf {
        self.root.join("traces")
    }

    /// The report as printed, without colours.
    pub fn report(&self) -> PathBuf {
        self.root.join("report.txt")
    }

    /// Every figure as text.
    pub fn full_report(&self) -> PathBuf {
        self.root.join("report-full.txt")
    }
}

/// `YYYYMMDD-HHMMSS` in UTC.
pub fn utc_stamp(at: SystemTime) -> String {
    let [year, month, day, hour, minute, second] = utc_parts(at);
    format!("{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}")
}

/// `YYYY-MM-DD HH:MM:SS UTC`.
pub fn utc_text(at: SystemTime) -> String {
    let [year, month, day, hour, minute, second] = utc_parts(at);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
}

/// Year, month, day, hour, minute, second of the proleptic Gregorian calendar, by the
/// era-based day count of Hinnant, "chrono-Compatible Low-Level Date Algorithms" (2013).
fn utc_parts(at: SystemTime) -> [u64; 6] {
    let seconds = at
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_secs());
    let (days, second) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 {
        shifted_month + 3
    } else {
        shifted_month - 9
    };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    [
        year,
        month,
        day,
        second / 3600,
        second / 60 % 60,
        second % 60,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::sys::stat::{Mode, umask};
    use std::os::unix::fs::PermissionsExt as _;
    use std::time::Duration;

    #[test]
    fn times_are_written_as_the_calendar_has_them() {
        for (seconds, expected) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (1_709_251_199, "2024-02-29 23:59:59 UTC"),
            (4_107_542_400, "2100-03-01 00:00:00 UTC"),
        ] {
            assert_eq!(
                utc_text(UNIX_EPOCH + Duration::from_secs(seconds)),
                expected
            );
        }
        assert_eq!(utc_stamp(UNIX_EPOCH), "19700101-000000");
    }

    #[test]
    fn nobody_else_may_write_to_a_run_folder_whatever_the_umask() {
        let parent = std::env::temp_dir().join(format!("hil-folder-{}", std::process::id()));
        let before = umask(Mode::empty());
        let folder = RunFolder::create(&parent, "x", None);
        umask(before);
        let folder = folder.unwrap();
        for path in [folder.root(), &folder.records()] {
            let mode = fs::metadata(path).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o755, "{}", path.display());
        }
        fs::remove_dir_all(parent).unwrap();
    }

    #[test]
    fn two_runs_of_one_second_get_two_folders() {
        let parent = std::env::temp_dir().join(format!("hil-folders-{}", std::process::id()));
        let first = RunFolder::create(&parent, "x", None).unwrap();
        let second = RunFolder::create(&parent, "x", None).unwrap();
        assert_ne!(first.root(), second.root());
        assert!(second.records().is_dir());
        fs::remove_dir_all(parent).unwrap();
    }
}
