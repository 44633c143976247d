//! A run folder as far as it can be read: what is missing or cut short is said and counted, and the
//! rest is used. It makes no topic of anything.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{fs, io};

use hil_platform::words::counted_plainly;
use hil_report::summary::RunSummary;
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_rundir::record::{RecordFile, RecordKind};
use hil_rundir::run_folder::RunFolder;
use hil_trace::{Trace, wire};
use hil_watch::Seen;
use serde_json::Value;

use crate::failure::Failure;

/// The kinds of records that end in a recording.
const KINDS: [RecordKind; 6] = [
    RecordKind::Published,
    RecordKind::Taken,
    RecordKind::Egress,
    RecordKind::Ingress,
    RecordKind::Message,
    RecordKind::LinkCondition,
];

/// What could be read of a run.
#[derive(Debug)]
pub(crate) struct Run {
    /// Its folder.
    pub(crate) folder: RunFolder,
    /// What was run; `None` when that is missing or damaged.
    pub(crate) manifest: Option<Manifest>,
    /// Its figures; `None` for a run that was killed.
    pub(crate) summary: Option<RunSummary>,
    /// Record files that count, in the order of their names.
    pub(crate) files: Vec<RecordFile>,
    /// What the links did, in the order of their names.
    pub(crate) traces: Vec<Trace>,
    /// What could not be read, and how much.
    pub(crate) gaps: Gaps,
}

/// What a recording lacks of its run.
#[derive(Debug, Default)]
pub(crate) struct Gaps {
    /// Files left out because they cannot be read.
    pub(crate) unreadable_file_count: u64,
    /// Files that end within a record.
    pub(crate) truncated_file_count: u64,
    /// Bytes of such ends.
    pub(crate) truncated_bytes: u64,
    /// Messages whose size is not that of their channel, left out.
    pub(crate) misfit_count: u64,
    /// Messages and records that have no time on the recording's clock, and were left out.
    pub(crate) timeless_count: u64,
    /// Numbers below the highest of each start of a producer without a recorded message, by
    /// channel: its recorder was full, or its process was killed.
    pub(crate) missing: BTreeMap<String, u64>,
    /// All of it in words, one line each.
    pub(crate) words: Vec<String>,
}

impl Gaps {
    /// A file was left out, in words.
    pub(crate) fn leave_out(&mut self, words: String) {
        self.unreadable_file_count += 1;
        self.words.push(words);
    }

    /// True when anything of the run is not in the recording.
    pub(crate) const fn is_any(&self) -> bool {
        self.unreadable_file_count > 0
            || self.truncated_file_count > 0
            || self.misfit_count > 0
            || self.timeless_count > 0
    }
}

impl Run {
    /// Reads the folder at `path`; `goes_on` hears the name of each file and the share of all bytes that
    /// is read before it, and ends it with false.
    ///
    /// # Errors
    /// When it is no run's folder.
    pub(crate) fn read(
        path: &Path,
        goes_on: &mut dyn FnMut(f64, &str) -> bool,
    ) -> Result<Self, Failure> {
        let folder = RunFolder::existing(path);
        if !folder.records().is_dir() && folder.summary().is_file() {
            return Err(Failure::usage(format!(
                "{}: a folder of `simulate` has no records; only a run's folder can be converted",
                path.display()
            )));
        }
        let files = folder.record_files();
        let mut files = files.map_err(|source| not_a_run(&folder.records(), &source))?;
        // By name, so that the starts of a restarted process come in order.
        files.sort();
        let mut run = Self::without_records(folder);
        let all_bytes: u64 = files.iter().map(|(_, bytes)| bytes).sum();
        let mut read_bytes = 0;
        for (path, bytes) in files {
            let share = read_bytes as f64 / all_bytes.max(1) as f64;
            if !goes_on(share, &path.display().to_string()) {
                break;
            }
            read_bytes += bytes;
            run.read_records(&path);
        }
        run.read_traces()?;
        Ok(run)
    }

    /// What the folder tells beside its records and traces.
    pub(crate) fn without_records(folder: RunFolder) -> Self {
        let mut gaps = Gaps::default();
        Self {
            manifest: Manifest::read(&folder)
                .inspect_err(|why| {
                    let path = folder.manifest();
                    let path = path.display();
                    gaps.leave_out(format!("{path}: {why}; without the run's own layouts"));
                })
                .ok(),
            summary: read_summary(&folder, &mut gaps),
            files: Vec::new(),
            traces: Vec::new(),
            gaps,
            folder,
        }
    }

    /// Reads what the links did.
    ///
    /// # Errors
    /// When the folder of traces cannot be listed.
    pub(crate) fn read_traces(&mut self) -> Result<(), Failure> {
        let folder = self.folder.traces();
        if !folder.is_dir() {
            return Ok(());
        }
        let entries = fs::read_dir(&folder)
            .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
        let mut paths: Vec<PathBuf> = entries.map_err(|source| not_a_run(&folder, &source))?;
        paths.retain(|path| path.extension().is_some_and(|ending| ending == "trace"));
        paths.sort();
        for path in paths {
            self.read_trace(&path);
        }
        Ok(())
    }

    fn read_records(&mut self, path: &Path) {
        match RecordFile::read(path) {
            Ok(file) if KINDS.contains(&file.header.kind) => {
                if file.truncated_bytes > 0 {
                    self.gaps.truncated_file_count += 1;
                    self.gaps.truncated_bytes += file.truncated_bytes as u64;
                    self.gaps.words.push(format!(
                        "{}: the last {} bytes are half a record; left out",
                        path.display(),
                        file.truncated_bytes
                    ));
                }
                self.files.push(file);
            }
            Ok(_) => {}
            Err(error) => self.gaps.leave_out(format!("{error}; left out")),
        }
    }

    fn read_trace(&mut self, path: &Path) {
        let decoded = fs::read(path)
            .map_err(|error| error.to_string())
            .and_then(|bytes| wire::decode(&bytes).map_err(|fault| fault.to_string()));
        match decoded {
            Ok(decoded) => {
                if let Some(fault) = decoded.fault {
                    self.gaps.truncated_file_count += 1;
                    let words = format!("{}: {fault}; what is before it is kept", path.display());
                    self.gaps.words.push(words);
                }
                self.traces.push(decoded.trace);
            }
            Err(why) => {
                let words = format!("trace {}: {why}; left out", path.display());
                self.gaps.leave_out(words);
            }
        }
    }

    /// The topology with every default spelled out; null when there is no manifest.
    pub(crate) fn topology(&self) -> &Value {
        const NOTHING: &Value = &Value::Null;
        self.manifest.as_ref().map_or(NOTHING, |one| &one.topology)
    }

    /// What the manifest says of `channel`.
    pub(crate) fn described(&self, channel: &str) -> Option<&ChannelDescription> {
        let manifest = self.manifest.as_ref()?;
        manifest.channels.iter().find(|one| one.name == channel)
    }

    /// Its files of this channel and kind, with their places.
    pub(crate) fn files_of(
        &self,
        channel: &str,
        kind: RecordKind,
    ) -> impl Iterator<Item = (usize, &RecordFile)> {
        let files = self.files.iter().enumerate();
        files.filter(move |(_, one)| one.header.kind == kind && one.header.channel == channel)
    }

    /// Counts the messages that their producers numbered and nobody recorded.
    pub(crate) fn count_missing(&mut self) {
        let mut seen: BTreeMap<&str, Seen> = BTreeMap::new();
        for file in &self.files {
            let messages = (0..file.record_count()).map_while(|index| file.message(index));
            for (envelope, _) in messages {
                let channel = seen.entry(&file.header.channel).or_default();
                channel.insert(envelope.epoch, envelope.sequence);
            }
        }
        let missing = seen.into_iter();
        let missing = missing.map(|(channel, seen)| (channel.to_owned(), seen.missing_count()));
        self.gaps.missing = missing.filter(|(_, count)| *count > 0).collect();
        for (channel, count) in &self.gaps.missing {
            let words = format!(
                "{channel}: {} numbered and not recorded",
                counted_plainly(*count, "message")
            );
            self.gaps.words.push(words);
        }
    }

    /// Names of all channels with records, in order; where orders to links are kept is none.
    pub(crate) fn channels(&self) -> Vec<String> {
        let files = self.files.iter();
        let files = files.filter(|file| file.header.kind != RecordKind::LinkCondition);
        let names = files.map(|file| file.header.channel.clone());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names.dedup();
        names
    }
}

fn not_a_run(folder: &Path, source: &io::Error) -> Failure {
    let folder = folder.display();
    Failure::usage(format!("{folder}: not a run's folder: {source}"))
}

/// A run that was killed has none, which is said and is no gap in what was recorded of it.
fn read_summary(folder: &RunFolder, gaps: &mut Gaps) -> Option<RunSummary> {
    let path = folder.summary();
    let Ok(text) = fs::read_to_string(&path) else {
        let why =
            "the run was killed, or still goes on; without its events and the links' verdicts";
        gaps.words.push(format!("no {}: {why}", path.display()));
        return None;
    };
    RunSummary::from_json(&text)
        .inspect_err(|error| {
            gaps.leave_out(format!("{}: {error}; without its events", path.display()));
        })
        .ok()
}
