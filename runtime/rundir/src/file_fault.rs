//! What a run could not write, and the records that a host lacks in the end. Data only: what follows from
//! it is decided elsewhere.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Whether the disk had no room, or the user's share of it had none.
pub fn is_of_full_disk(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
    )
}

/// A file that could not be written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileFault {
    /// The file.
    pub path: PathBuf,
    /// What the system said.
    pub error: String,
}

impl FileFault {
    /// Of the file at `path`.
    pub fn new(path: &Path, error: &io::Error) -> Self {
        Self {
            path: path.to_owned(),
            error: error.to_string(),
        }
    }

    /// The file's name without its folders.
    pub fn file_name(&self) -> String {
        let name = self.path.file_name().unwrap_or(self.path.as_os_str());
        name.to_string_lossy().into_owned()
    }
}

impl fmt::Display for FileFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}: {}", self.path.display(), self.error)
    }
}

/// Records that a host lacks after the exchange. Of other hosts it lacks all, because an account with a part of the records
/// would call the rest lost; of its own, those that its disk did not take.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordGap {
    /// The host that lacks them.
    pub host: String,
    /// The hosts whose records they are.
    pub of: Vec<String>,
    /// Why it lacks them.
    pub cause: GapCause,
}

/// Why a host lacks records of another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapCause {
    /// Its disk did not take them.
    Unwritable(FileFault),
    /// They did not come, or not in full.
    Connection(String),
}

impl fmt::Display for GapCause {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unwritable(fault) => fault.fmt(formatter),
            Self::Connection(reason) => formatter.write_str(reason),
        }
    }
}
