//! What a passive probe saw of a run, kept in the run's folder: a row of a case's tables shows it beside the account.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::Path;

use hil_core::recorded_run::RecordedCrossing;

/// The file in the folder of a run.
pub const FILE: &str = "probe.json";

/// Keeps what a probe saw of the run in `folder`.
///
/// # Errors
/// When the file cannot be written.
pub fn write(folder: &Path, crossing: &RecordedCrossing) -> io::Result<()> {
    let bytes = serde_json::to_vec(crossing).map_err(io::Error::other)?;
    let mut file = File::create(folder.join(FILE))?;
    file.write_all(&bytes)?;
    file.sync_all()
}

/// What [`write`] left in `folder`.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn read(folder: &Path) -> io::Result<Option<RecordedCrossing>> {
    match fs::read(folder.join(FILE)) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .map(Some)
            .map_err(io::Error::other),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}
