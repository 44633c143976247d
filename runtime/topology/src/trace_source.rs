//! Where a link's traces lie, and how they become its model: `[links.<name>.trace]`. It reads the
//! files; what a message meets then is `hil_trace::replay`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use std::{fs, io};

use hil_core::case_study::ParameterError;
use hil_core::link_model::TraceMatch;
use hil_core::options;
use hil_core::options::{Scalar as _, Setting, Shape, Short, Templates, TextRule};
use hil_core::text_file::{TextFault, TextFile};
use hil_link::delay::DELAY_MAX;
use hil_trace::fault::TraceFault;
use hil_trace::replay::{ReplayError, TraceEnd, TraceLink, TraceReplay};
use hil_trace::wire::Decoded;
use hil_trace::{Trace, csv, wire};
use serde::{Deserialize, Serialize};

use crate::Topology;

/// The file of `channel` in a folder of traces.
pub fn file_name(channel: &str) -> String {
    format!("{}.trace", channel.replace('/', "."))
}

options! {
    /// Recorded traces of a link. Paths are as written, relative to the topology file.
    #[derive(Eq)]
    pub struct TraceSource as short
    with {
        /// What the paths start from.
        #[serde(skip)]
        base: BaseFolder = BaseFolder(PathBuf::new()),
        /// What was read of them, so that nobody reads a file twice for it.
        #[serde(skip)]
        noted: NotedDelays = NotedDelays::NOTHING,
    }
    {
        /// Folder with one file per channel, named as a run names them.
        folder: Option<String>;
        /// Files by channel; they go before the folder.
        files: Option<BTreeMap<String, String>>;
        /// Which record a message meets.
        r#match: TraceMatch = TraceMatch::Index;
        /// What comes after the last record.
        end: TraceEnd = TraceEnd::Wrap;
        /// Delay of a delivered message whose delay the trace does not know.
        delay: Option<Duration>, in Duration::ZERO..=DELAY_MAX;
    }
    check TraceSource::check_names;
}

/// The traces of a link are a table, or the folder alone.
impl Short for TraceSource {
    const TEMPLATES: Option<Templates> = None;
    const KEY: &'static str = "trace";
    const ABOUT: &'static str = "The folder of the traces.";

    fn template(_index: usize) -> Self {
        Self::of_folder(None)
    }

    fn shape() -> Shape {
        Shape::Text(TextRule::ANY)
    }

    fn of_short(setting: Setting) -> Result<Self, String> {
        String::from_setting(setting).map(|folder| Self::of_folder(Some(folder)))
    }
}

/// The folder of the topology file. Where a file lies is no part of what it says, so any two are
/// equal: the same topology on two hosts is one.
#[derive(Debug, Clone, Default)]
pub struct BaseFolder(pub PathBuf);

impl PartialEq for BaseFolder {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl Eq for BaseFolder {}

/// The longest delay of each trace that was read. It is kept beside what names the files and is no
/// part of it, so any two are equal.
#[derive(Debug, Clone)]
pub struct NotedDelays(Option<Arc<Mutex<BTreeMap<PathBuf, Duration>>>>);

impl NotedDelays {
    /// Of a topology that names no trace: nothing is kept.
    const NOTHING: Self = Self(None);

    fn get(&self, file: &Path) -> Option<Duration> {
        let noted = self.0.as_ref()?.lock();
        noted
            .unwrap_or_else(PoisonError::into_inner)
            .get(file)
            .copied()
    }

    fn note(&self, file: &Path, delay_max: Duration) {
        if let Some(noted) = &self.0 {
            let mut noted = noted.lock().unwrap_or_else(PoisonError::into_inner);
            noted.insert(file.to_owned(), delay_max);
        }
    }
}

impl Default for NotedDelays {
    fn default() -> Self {
        Self(Some(Arc::default()))
    }
}

impl PartialEq for NotedDelays {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl Eq for NotedDelays {}

/// One channel's trace and how to replay it: what a gateway is told.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceLaunch {
    /// The key that names it in the topology.
    pub key: String,
    /// The file.
    pub file: PathBuf,
    /// How to replay it.
    pub replay: TraceReplay,
    /// Its longest delay, where whoever made this has read it.
    pub delay_max: Option<Duration>,
    /// Where that is noted once it was read.
    #[serde(skip)]
    pub noted: NotedDelays,
}

/// A trace that a topology names cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{key}: {source}")]
pub struct TraceError {
    /// The key that names it.
    pub key: String,
    /// What is wrong with it.
    pub source: TraceFileError,
}

/// Why a trace file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TraceFileError {
    /// It cannot be read.
    #[error("trace {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is no trace.
    #[error("trace {path}: {source}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TraceFault,
    },
    /// It is damaged; whoever can live with that part reads it with `hil-runtime trace convert`.
    #[error(
        "trace {path}: {source}; the {kept} records before it are whole: `hil-runtime trace convert` \
         keeps them"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TraceFault,
        /// Records before it.
        kept: usize,
    },
    /// It is a CSV file with a fault.
    #[error("trace {path}: {source}")]
    Csv {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TextFault,
    },
    /// It cannot be replayed.
    #[error("trace {path}: {source}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ReplayError,
    },
}

impl TraceSource {
    /// Nothing but a folder, with notes of its own.
    fn of_folder(folder: Option<String>) -> Self {
        Self {
            noted: NotedDelays::default(),
            folder,
            ..Self::TEMPLATE
        }
    }

    fn check_names(&self) -> Result<(), ParameterError> {
        if self.folder.is_some() || self.files.is_some() {
            return Ok(());
        }
        let problem = "is missing: name a folder of traces, e.g. \"runs/NAME/traces\", or files = { \
                       \"CHANNEL\" = \"FILE\" }";
        Err(ParameterError::new("folder", problem))
    }

    /// How they are replayed.
    pub const fn replay(&self) -> TraceReplay {
        TraceReplay {
            matching: self.r#match,
            end: self.end,
            delay_otherwise: self.delay,
        }
    }

    /// The trace of `channel` on `link`; `None` for one that is not named where no folder is.
    pub fn launch(&self, link: &str, channel: &str) -> Option<TraceLaunch> {
        let (key, named) =
            if let Some(file) = self.files.as_ref().and_then(|files| files.get(channel)) {
                (format!("files.\"{channel}\""), PathBuf::from(file))
            } else {
                let folder = Path::new(self.folder.as_ref()?);
                ("folder".to_owned(), folder.join(file_name(channel)))
            };
        let file = self.base.0.join(named);
        // A gateway may run in another folder.
        let file = std::path::absolute(&file).unwrap_or(file);
        Some(TraceLaunch {
            key: format!("links.{link}.trace.{key}"),
            delay_max: self.noted.get(&file),
            file,
            replay: self.replay(),
            noted: self.noted.clone(),
        })
    }
}

/// Reads every trace that the links of `topology` replay, so that a run without one does not begin.
///
/// # Errors
/// All that cannot be used.
pub fn check(topology: &Topology) -> Result<(), Vec<TraceError>> {
    let mut faulty = Vec::new();
    for crossing in topology.crossings() {
        let source = crossing
            .link
            .emulation()
            .and_then(|emulation| emulation.trace.as_ref());
        let (link, channel) = (&crossing.link.name, &crossing.channel.name);
        if let Some(launch) = source.and_then(|source| source.launch(link, channel)) {
            faulty.extend(launch.model().err());
        }
    }
    if faulty.is_empty() {
        Ok(())
    } else {
        Err(faulty)
    }
}

impl TraceLaunch {
    /// The longest delay that it adds; the file is read unless it was before.
    ///
    /// # Errors
    /// As [`TraceLaunch::model`].
    pub fn delay_max(&self) -> Result<Duration, TraceError> {
        match self.delay_max.or_else(|| self.noted.get(&self.file)) {
            Some(known) => Ok(known),
            None => Ok(self.model()?.delay_max()),
        }
    }

    /// What it does, in words.
    pub fn describe(&self) -> String {
        let matching = match self.replay.matching {
            TraceMatch::Index => "message by message",
            TraceMatch::Time => "by the time of the run",
            TraceMatch::Tick => "tick by tick",
        };
        let end = match self.replay.end {
            TraceEnd::Wrap => "begins anew",
            TraceEnd::Perfect => "delivers at once",
            TraceEnd::Lost => "delivers nothing",
        };
        format!(
            "replay of {}, {matching}; after its end it {end}",
            self.file.display()
        )
    }

    /// The link.
    ///
    /// # Errors
    /// When the file is no whole trace, or cannot be replayed; with the key that names it.
    pub fn model(&self) -> Result<TraceLink, TraceError> {
        let failed = |source| TraceError {
            key: self.key.clone(),
            source,
        };
        let trace = read_whole(&self.file).map_err(failed)?;
        let link = TraceLink::new(trace, self.replay);
        let link = link.map_err(|source| {
            failed(TraceFileError::Replay {
                path: self.file.clone(),
                source,
            })
        })?;
        self.noted.note(&self.file, link.delay_max());
        Ok(link)
    }
}

/// A trace that must be whole, in its binary form or as CSV.
///
/// # Errors
/// With the offset of the first fault.
pub fn read_whole(path: &Path) -> Result<Trace, TraceFileError> {
    let (path_owned, bytes) = (path.to_owned(), read(path)?);
    if looks_like_text(&bytes) {
        let decoded = TextFile::decode(&bytes).and_then(|text| csv::decode(&text));
        let whole = decoded.and_then(|read| read.fault.map_or(Ok(read.trace), Err));
        return whole.map_err(|source| TraceFileError::Csv {
            path: path_owned,
            source,
        });
    }
    let Decoded { trace, fault } = wire::decode(&bytes).map_err(|source| {
        let path = path.to_owned();
        TraceFileError::Foreign { path, source }
    })?;
    match fault {
        None => Ok(trace),
        Some(source) => Err(TraceFileError::Damaged {
            path: path_owned,
            source,
            kept: trace.records.len(),
        }),
    }
}

/// The bytes of a file.
///
/// # Errors
/// When it cannot be read.
pub fn read(path: &Path) -> Result<Vec<u8>, TraceFileError> {
    fs::read(path).map_err(|source| TraceFileError::Io {
        path: path.to_owned(),
        source,
    })
}

/// True for what may be text, of any encoding, by its first bytes, and is no trace. What is wrong with it, a
/// zero byte for instance, its decoder says.
pub fn looks_like_text(bytes: &[u8]) -> bool {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let start = &bytes[..bytes.len().min(512)];
    let is_wide = start.starts_with(b"\xff\xfe") || start.starts_with(b"\xfe\xff");
    let is_letter = |byte: &u8| {
        let is_ascii = byte.is_ascii_graphic() || byte.is_ascii_whitespace();
        is_ascii || matches!(*byte, 0 | 0x80..)
    };
    let letters = start.iter().filter(|byte| matches!(**byte, 1..0x80));
    let letters = letters.count();
    !start.starts_with(&wire::MAGIC)
        && (is_wide || (start.iter().all(is_letter) && 2 * letters >= start.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(folder: Option<&str>, channel: &str, file: &str) -> TraceSource {
        TraceSource {
            files: Some(BTreeMap::from([(channel.to_owned(), file.to_owned())])),
            base: BaseFolder(PathBuf::from("/lab")),
            ..TraceSource::of_folder(folder.map(str::to_owned))
        }
    }

    #[test]
    fn a_file_of_its_own_goes_before_the_folder() {
        let source = source(Some("runs/x/traces"), "a/b", "/tmp/one.trace");
        let of = |channel| source.launch("hop", channel).unwrap();
        assert_eq!(of("a/b").file, Path::new("/tmp/one.trace"));
        assert_eq!(of("a/b").key, "links.hop.trace.files.\"a/b\"");
        assert_eq!(of("b/a").file, Path::new("/lab/runs/x/traces/b.a.trace"));
        assert_eq!(of("b/a").key, "links.hop.trace.folder");
        let files_only = TraceSource {
            folder: None,
            ..source
        };
        assert_eq!(files_only.launch("hop", "b/a"), None);
    }

    #[test]
    fn a_trace_is_read_once_and_one_that_vanished_before_is_named_with_its_key() {
        let folder = std::env::temp_dir().join(format!("hil-trace-source-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let file = folder.join("a.csv");
        fs::write(&file, "published_ns,delay_ns\n0,7000\n10,9000\n").unwrap();
        let source = source(None, "a/b", &file.display().to_string());
        let launch = || source.launch("hop", "a/b").unwrap();
        assert_eq!(launch().delay_max, None);
        assert_eq!(launch().delay_max().unwrap(), Duration::from_micros(9));
        fs::remove_dir_all(&folder).unwrap();
        // What was read is still known, to a gateway too.
        assert_eq!(launch().delay_max().unwrap(), Duration::from_micros(9));
        let told = serde_json::to_string(&launch()).unwrap();
        let told: TraceLaunch = serde_json::from_str(&told).unwrap();
        assert_eq!(told.delay_max().unwrap(), Duration::from_micros(9));
        // But nothing is replayed that is not there.
        let anew = TraceSource {
            noted: NotedDelays::default(),
            ..source.clone()
        };
        let launch = anew.launch("hop", "a/b").unwrap();
        for error in [
            launch.delay_max().unwrap_err(),
            launch.model().unwrap_err(),
            told.model().unwrap_err(),
        ] {
            let text = error.to_string();
            let start = format!("links.hop.trace.files.\"a/b\": trace {}: ", file.display());
            assert!(text.starts_with(&start), "{text}");
        }
    }

    #[test]
    fn text_and_traces_are_told_apart() {
        assert!(looks_like_text(b"# run: x\npublished_ns,delay_ns\n"));
        assert!(!looks_like_text(b"HILTRACE\x01\0\0\0"));
        assert!(!looks_like_text(&[0xd4, 0xc3, 0xb2, 0xa1]));
        assert!(!looks_like_text(b"\0\0\0\x01\0\0a"));
        assert!(looks_like_text(b"") && looks_like_text(b"\xef\xbb\xbf"));
        assert!(looks_like_text(b"f\0a\0t\0e\0\n\0") && looks_like_text(b"1\n2\n\0\n"));
    }
}
