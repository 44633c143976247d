//! The log of what a process prints, bounded: of a long one the beginning and the end are kept.
//!
//! The process writes to the file itself, so that it never waits for the supervisor. While it runs, the
//! disk space of the middle is given back (a hole, read as zeros) and the end is where it was; once the
//! process is gone for good, the hole is taken out and a line tells how much it held.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::{FallocateFlags, fallocate};

/// What is kept of each end.
const KEPT_BYTES: u64 = 1 << 20;
/// What a log may hold: both ends, and a half of one in between, so that not every look finds work.
const LOG_MAX_BYTES: u64 = 2 * KEPT_BYTES + KEPT_BYTES / 2;
/// Unit of [`MetadataExt::blocks`].
const BLOCK_BYTES: u64 = 512;

/// Gives back the disk space of the middle of `log`, to which its process goes on appending.
///
/// # Errors
/// When the file cannot be opened. A file system that makes no holes keeps it all until the end.
pub(crate) fn release_middle(log: &Path) -> io::Result<()> {
    let file = File::options().write(true).open(log)?;
    let metadata = file.metadata()?;
    if metadata.blocks() * BLOCK_BYTES <= LOG_MAX_BYTES || metadata.len() <= LOG_MAX_BYTES {
        return Ok(());
    }
    let middle_bytes = metadata.len() - 2 * KEPT_BYTES;
    let signed = |bytes: u64| i64::try_from(bytes).map_err(io::Error::other);
    let hole = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
    match fallocate(&file, hole, signed(KEPT_BYTES)?, signed(middle_bytes)?) {
        Ok(()) | Err(Errno::EOPNOTSUPP) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// Takes the middle out of `log`, to which nobody writes any more, and gives how many bytes it held;
/// 0 for a log that is not too long.
///
/// # Errors
/// When the file cannot be read or written.
pub(crate) fn cut_middle(log: &Path) -> io::Result<u64> {
    let mut file = File::options().read(true).write(true).open(log)?;
    let size_bytes = file.metadata()?.len();
    if size_bytes <= LOG_MAX_BYTES {
        return Ok(0);
    }
    let mut read = |at| -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(at))?;
        (&mut file).take(KEPT_BYTES).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let (head, tail) = (read(0)?, read(size_bytes - KEPT_BYTES)?);
    // Whole lines, where there are any.
    let line_end = |byte: &u8| *byte == b'\n';
    let head_bytes = head
        .iter()
        .rposition(line_end)
        .map_or(head.len(), |at| at + 1);
    let tail = &tail[tail.iter().position(line_end).map_or(0, |at| at + 1)..];
    let left_out_bytes = size_bytes - (head_bytes + tail.len()) as u64;
    file.set_len(head_bytes as u64)?;
    file.seek(SeekFrom::End(0))?;
    writeln!(file, "[hil-runtime left out {left_out_bytes} bytes here]")?;
    file.write_all(tail)?;
    Ok(left_out_bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{env, fs};

    fn appended(log: &Path, from: u64, until: u64) {
        let file = File::options().create(true).append(true).open(log).unwrap();
        let mut file = io::BufWriter::new(file);
        for index in from..until {
            writeln!(file, "line {index:09}").unwrap();
        }
    }

    #[test]
    fn of_a_long_log_both_ends_are_kept_and_the_rest_is_counted() {
        let log = env::temp_dir().join(format!("hil-long-log-{}.log", std::process::id()));
        let kept_lines = |text: &str| -> Vec<u64> {
            let lines = text.lines().filter_map(|line| line.strip_prefix("line "));
            lines.map(|number| number.parse().unwrap()).collect()
        };
        // 15 bytes a line: 30 MB, looked at after each tenth.
        for tenth in 0..10 {
            appended(&log, tenth * 200_000, (tenth + 1) * 200_000);
            release_middle(&log).unwrap();
            let metadata = fs::metadata(&log).unwrap();
            assert_eq!(metadata.len(), (tenth + 1) * 3_000_000);
            assert!(metadata.blocks() * BLOCK_BYTES <= LOG_MAX_BYTES);
        }
        let left_out_bytes = cut_middle(&log).unwrap();
        let text = fs::read_to_string(&log).unwrap();
        assert!(text.contains(&format!(
            "\n[hil-runtime left out {left_out_bytes} bytes here]\n"
        )));
        let lines = kept_lines(&text);
        assert_eq!((lines[0], lines[lines.len() - 1]), (0, 1_999_999));
        assert_eq!(lines.len() as u64 * 15 + left_out_bytes, 30_000_000);
        assert!(
            lines
                .windows(2)
                .filter(|pair| pair[1] != pair[0] + 1)
                .count()
                == 1
        );
        assert!(fs::metadata(&log).unwrap().len() <= LOG_MAX_BYTES);
        assert_eq!(cut_middle(&log).unwrap(), 0, "a second look finds nothing");
        fs::remove_file(log).unwrap();
    }

    #[test]
    fn a_log_without_lines_is_bounded_as_well_and_a_short_one_is_left_alone() {
        let log = env::temp_dir().join(format!("hil-plain-log-{}.log", std::process::id()));
        fs::write(&log, vec![b'x'; 5_000_000]).unwrap();
        assert_eq!(cut_middle(&log).unwrap(), 5_000_000 - 2 * KEPT_BYTES);
        let short = "a\nb\n";
        fs::write(&log, short).unwrap();
        release_middle(&log).unwrap();
        assert_eq!(cut_middle(&log).unwrap(), 0);
        assert_eq!(fs::read_to_string(&log).unwrap(), short);
        fs::remove_file(log).unwrap();
    }
}
