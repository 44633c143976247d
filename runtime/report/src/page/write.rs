//! Puts a report where the user wants it: whole or not at all, and never over what is not a report.

use std::fs::{self, File};
use std::io::{self, Read, Seek as _, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process;

use super::MARK;
use hil_platform::plain_file;

/// How much of a file is looked at for its mark, bytes.
const HEAD_BYTES: u64 = 4096;

/// Why a report was not written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Something else is there.
    #[error("{}: exists and is not a report of hil-runtime; say --force", .0.display())]
    Foreign(PathBuf),
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

/// Makes sure that `path` may be written: it is not there, is a report, or `force` is said.
///
/// # Errors
/// When something else is there.
pub fn check(path: &Path, force: bool) -> Result<(), WriteError> {
    let failed = |source| WriteError::File {
        path: path.to_owned(),
        source,
    };
    let facts = match fs::metadata(path) {
        Ok(facts) => facts,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(failed(error)),
    };
    if facts.is_dir() {
        return Err(failed(io::Error::from(io::ErrorKind::IsADirectory)));
    }
    // Through a pipe or device nothing is lost, and nothing can be renamed over it.
    if force || !facts.is_file() || facts.len() == 0 {
        return Ok(());
    }
    let mut head = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(HEAD_BYTES)
        .read_to_end(&mut head)
        .map_err(failed)?;
    let head = String::from_utf8_lossy(&head);
    let is_own = head.contains(MARK) || head.starts_with("run,channel,figure,value,unit,low,high");
    // Data and figures have no place for a mark, but a shape that nobody else has.
    let is_data = head.contains("\"program\": \"hil-runtime ");
    let is_print = head.starts_with("%PDF") && ends_with_mark(path).map_err(failed)?;
    let is_figure = head.contains("<svg") && head.contains("class=\"figure\"");
    if is_own || is_data || is_figure || is_print {
        Ok(())
    } else {
        Err(WriteError::Foreign(path.to_owned()))
    }
}

/// A PDF has its mark behind its end.
fn ends_with_mark(path: &Path) -> io::Result<bool> {
    let mut file = File::open(path)?;
    let mark = format!("% {MARK}\n");
    let behind = i64::try_from(mark.len()).map_err(io::Error::other)?;
    if file.seek(SeekFrom::End(-behind)).is_err() {
        return Ok(false);
    }
    let mut tail = Vec::new();
    file.read_to_end(&mut tail)?;
    Ok(tail == mark.as_bytes())
}

/// Writes bytes to `path`, beside it first.
///
/// # Errors
/// Names the file that cannot be written; nothing is left of a failed one.
pub fn write(path: &Path, text: impl AsRef<[u8]>) -> Result<(), WriteError> {
    let bytes = text.as_ref();
    let is_special = fs::metadata(path).is_ok_and(|facts| !facts.is_file());
    if is_special {
        return fs::write(path, bytes).map_err(|source| WriteError::File {
            path: path.to_owned(),
            source,
        });
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.partial", process::id()));
    let partial = path.with_file_name(name);
    let written = plain_file::create_anew(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&partial, path));
    written.map_err(|source| {
        drop(fs::remove_file(&partial));
        WriteError::File {
            path: path.to_owned(),
            source,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_reports_are_overwritten_unasked() {
        let folder = std::env::temp_dir().join(format!("hil-report-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("report.html");
        check(&path, false).unwrap();
        write(&path, "<!-- hil-runtime report -->").unwrap();
        check(&path, false).unwrap();
        write(&path, "a letter").unwrap();
        let error = check(&path, false).unwrap_err().to_string();
        assert!(
            error.ends_with("exists and is not a report of hil-runtime; say --force"),
            "{error}"
        );
        check(&path, true).unwrap();
        assert!(check(&folder, true).is_err());
        assert!(write(&folder.join("none/x"), "").is_err());
        let left: Vec<_> = fs::read_dir(&folder).unwrap().collect();
        assert_eq!(left.len(), 1, "{left:?}");
        fs::remove_dir_all(&folder).unwrap();
    }
}
