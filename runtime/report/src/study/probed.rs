//! What a passive probe saw of a run, kept in the run's folder: a row of a case's tables shows it beside the account.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::Path;

use hil_core::recorded_run::ProbedCrossing;

/// The file in the folder of a run.
pub const FILE: &str = "probe.json";

/// Keeps what a probe saw of the run in `folder`.
///
/// # Errors
/// When the file cannot be written.
pub fn write(folder: &Path, probed: &ProbedCrossing) -> io::Result<()> {
    let bytes = serde_json::to_vec(probed).map_err(io::Error::other)?;
    let mut file = File::create(folder.join(FILE))?;
    file.write_all(&bytes)?;
    file.sync_all()
}

/// What [`write`] left in `folder`.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn read(folder: &Path) -> io::Result<Option<ProbedCrossing>> {
    match fs::read(folder.join(FILE)) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .map(Some)
            .map_err(io::Error::other),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use hil_core::recorded_run::RecordedCrossing;

    #[test]
    fn what_is_kept_is_read_and_a_broken_file_is_an_error() {
        let folder = std::env::temp_dir().join(format!("hil-probed-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        assert_eq!(read(&folder).unwrap(), None);
        let probed = ProbedCrossing {
            crossing: RecordedCrossing {
                offered_count: 3,
                lost_count: Err("2 malformed".to_owned()),
                delays: Ok(Vec::new()),
            },
            left_out: vec!["motion/request".to_owned()],
        };
        write(&folder, &probed).unwrap();
        assert_eq!(read(&folder).unwrap(), Some(probed));
        fs::write(folder.join(FILE), "{}").unwrap();
        assert!(read(&folder).is_err());
        fs::remove_dir_all(folder).unwrap();
    }
}
