//! The folder of a row: runs that are kept, refused or tried, each under its name only once it is whole, and the
//! one that is under way.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use hil_rundir::run_folder::RunFolder;

use super::trace_replay;
use crate::study::probed;

/// What a kept run needs for tables, reports and comparisons.
const KEPT: [&str; 5] = [
    "manifest.json",
    "summary.json",
    "report.txt",
    trace_replay::FOLDER,
    probed::FILE,
];
/// What is large in the folder of a run.
const LARGE: [&str; 3] = ["records", "traces", "series"];
/// Beside the hosts' folders of the run under way: what a passive probe captured.
const CAPTURES: &str = "captures";
/// Why a run was refused.
const CAUSE: &str = "cause.txt";
/// What a refused run said.
const SAID: &str = "said.txt";

/// What a folder in the row's is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Part {
    /// A sound run with this seed.
    Run(u64),
    /// A refused one.
    Refused(u64),
    /// A trial with so many copies.
    Trial(u64),
}

impl Part {
    /// The same, refused.
    pub(super) const fn refused(self) -> Self {
        match self {
            Self::Run(seed) | Self::Refused(seed) => Self::Refused(seed),
            Self::Trial(copies) => Self::Trial(copies),
        }
    }

    pub(super) const fn is_trial(self) -> bool {
        matches!(self, Self::Trial(_))
    }

    /// What the folder called `name` is of.
    fn named(name: &str) -> Option<Self> {
        let (word, number) = name.split_once('-')?;
        let number = number.parse().ok()?;
        match word {
            "run" => Some(Self::Run(number)),
            "refused" => Some(Self::Refused(number)),
            "trial" => Some(Self::Trial(number)),
            _ => None,
        }
    }
}

/// The folder of a row.
#[derive(Debug, Clone)]
pub(super) struct RowFolder {
    root: PathBuf,
}

impl RowFolder {
    pub(super) const fn new(root: PathBuf) -> Self {
        Self { root }
    }

    /// Where a run under way is recorded.
    pub(super) fn under_way(&self) -> PathBuf {
        self.root.join("under-way")
    }

    /// Where a passive probe captures meanwhile.
    pub(super) fn captures(&self) -> PathBuf {
        self.under_way().join(CAPTURES)
    }

    pub(super) fn path(&self, part: Part) -> PathBuf {
        let name = match part {
            Part::Run(seed) => format!("run-{seed}"),
            Part::Refused(seed) => format!("refused-{seed}"),
            Part::Trial(copies) => format!("trial-{copies}"),
        };
        self.root.join(name)
    }

    /// Makes place for a run, also where one was under way when its call was killed.
    pub(super) fn begin(&self) -> io::Result<()> {
        self.clear()?;
        fs::create_dir_all(self.under_way())
    }

    /// Removes what is under way.
    pub(super) fn clear(&self) -> io::Result<()> {
        removed(&self.under_way())
    }

    /// All that is kept.
    pub(super) fn parts(&self) -> io::Result<Vec<Part>> {
        let entries = match fs::read_dir(&self.root) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?,
        };
        let names = entries.map(|entry| Ok::<_, io::Error>(entry?.file_name()));
        let names = names.collect::<Result<Vec<_>, _>>()?;
        let parts = names.iter().filter_map(|name| Part::named(name.to_str()?));
        let mut parts: Vec<_> = parts.collect();
        parts.sort_unstable();
        Ok(parts)
    }

    /// Why `part` was refused; `None` where it was not.
    pub(super) fn cause(&self, part: Part) -> io::Result<Option<String>> {
        match fs::read_to_string(self.path(part).join(CAUSE)) {
            Ok(text) => Ok(Some(text.trim_end().to_owned())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The folder that a host wrote of the run under way, if one has a summary: of several the first by name, as all have
    /// the same figures.
    pub(super) fn ended(&self) -> io::Result<Option<PathBuf>> {
        let folders = folders_in(&self.under_way())?;
        Ok(folders
            .into_iter()
            .find(|path| RunFolder::existing(path).summary().is_file()))
    }

    /// Keeps the run of `folder`, which a host wrote, as `part`.
    pub(super) fn keep(&self, folder: &Path, part: Part) -> io::Result<()> {
        let is_kept = |name: &OsStr| KEPT.iter().any(|kept| name == *kept);
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            if !is_kept(&entry.file_name()) {
                removed(&entry.path())?;
            }
        }
        self.settle(folder, part)
    }

    /// Keeps what is there of the run under way as `part`, which was refused because of `cause`; `said` is what it said.
    pub(super) fn put_aside(&self, part: Part, cause: &str, said: &str) -> io::Result<()> {
        let under_way = self.under_way();
        removed(&self.captures())?;
        for folder in folders_in(&under_way)? {
            LARGE
                .iter()
                .try_for_each(|name| removed(&folder.join(name)))?;
        }
        fs::write(under_way.join(SAID), said)?;
        fs::write(under_way.join(CAUSE), format!("{cause}\n"))?;
        self.settle(&under_way, part)
    }

    /// Gives what lies on the disk as a whole the name of `part`.
    fn settle(&self, folder: &Path, part: Part) -> io::Result<()> {
        let place = self.path(part);
        // A trial may come again.
        removed(&place)?;
        for entry in fs::read_dir(folder)? {
            File::open(entry?.path())?.sync_all()?;
        }
        File::open(folder)?.sync_all()?;
        fs::rename(folder, place)?;
        File::open(&self.root)?.sync_all()?;
        self.clear()
    }
}

fn folders_in(path: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = fs::read_dir(path)?.map(|entry| Ok(entry?.path()));
    let mut paths = entries.collect::<io::Result<Vec<_>>>()?;
    paths.retain(|path| path.is_dir());
    paths.sort();
    Ok(paths)
}

/// Removes what lies at `path`, if anything does.
fn removed(path: &Path) -> io::Result<()> {
    let outcome = if path.is_dir() {
        fs::remove_dir_all(path)
    } else {
        fs::remove_file(path)
    };
    outcome.or_else(|error| match error.kind() {
        io::ErrorKind::NotFound => Ok(()),
        _ => Err(error),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(path: &Path) -> Vec<String> {
        let entries = fs::read_dir(path).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn a_part_has_its_name_once_it_is_whole_and_only_what_is_read_again() {
        let root = std::env::temp_dir().join(format!("hil-row-{}", std::process::id()));
        let row = RowFolder::new(root.clone());
        assert_eq!(row.parts().unwrap(), []);
        let run = |host: &str| {
            let folder = row.under_way().join(host);
            fs::create_dir_all(folder.join("records")).unwrap();
            fs::create_dir_all(folder.join("logs")).unwrap();
            for name in [
                "records/a.rec",
                "logs/robot.log",
                "summary.json",
                "manifest.json",
            ] {
                fs::write(folder.join(name), "{}").unwrap();
            }
            folder
        };
        row.begin().unwrap();
        let folder = run("robot-pc");
        run("control-pc");
        assert_eq!(
            row.ended().unwrap(),
            Some(folder.with_file_name("control-pc"))
        );
        row.keep(&folder, Part::Run(12)).unwrap();
        assert_eq!(names(&root), ["run-12"]);
        assert_eq!(
            names(&root.join("run-12")),
            ["manifest.json", "summary.json"]
        );
        assert_eq!(row.cause(Part::Run(12)).unwrap(), None);
        // A call that was killed leaves it, and the next one begins anew.
        row.begin().unwrap();
        run("control-pc");
        row.begin().unwrap();
        assert_eq!(row.ended().unwrap(), None);
        run("control-pc");
        row.put_aside(Part::Refused(13), "3 ticks", "warning")
            .unwrap();
        let refused = root.join("refused-13");
        assert_eq!(names(&refused), ["cause.txt", "control-pc", "said.txt"]);
        assert_eq!(
            names(&refused.join("control-pc")),
            ["logs", "manifest.json", "summary.json"]
        );
        row.begin().unwrap();
        row.put_aside(Part::Trial(8), "3 ticks", "").unwrap();
        fs::create_dir(root.join("run-x")).unwrap();
        let found = [Part::Run(12), Part::Refused(13), Part::Trial(8)];
        assert_eq!(row.parts().unwrap(), found);
        assert_eq!(row.cause(Part::Trial(8)).unwrap().unwrap(), "3 ticks");
        fs::remove_dir_all(root).unwrap();
    }
}
