//! The log of what a process prints, bounded: of a long one the beginning and the end are kept.
//!
//! The process writes to the file itself, so that it waits for the disk as before and never for the
//! supervisor's turn. While it runs, the disk space of the middle is given back where the file system
//! can do that (the range reads as zeros), and the end is where it was. Once the process is gone for
//! good, the middle is taken out and a line tells how much it held.

use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_platform::plain_file;
use nix::fcntl::{FallocateFlags, fallocate};

/// What is kept of each end.
const KEPT_BYTES: u64 = 1 << 20;
/// What a log may hold: both ends, and a half of one in between, so that not every look finds work.
const LOG_MAX_BYTES: u64 = 2 * KEPT_BYTES + KEPT_BYTES / 2;
/// An end is cut after a whole line where one begins or ends this close to the cut.
const LINE_BYTES_MAX: usize = 4096;
/// Unit of [`MetadataExt::blocks`].
const BLOCK_BYTES: u64 = 512;
/// How often the logs are looked at.
const PERIOD: Duration = Duration::from_secs(1);

/// Gives back the disk space of long logs, from a thread of its own: a disk that does not answer holds
/// up no supervisor.
#[derive(Debug)]
pub(crate) struct LogKeeper {
    stop: Sender<()>,
    thread: JoinHandle<()>,
}

impl LogKeeper {
    /// Looks at `logs` until [`LogKeeper::finish`].
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(crate) fn start(logs: Vec<PathBuf>) -> io::Result<Self> {
        let (stop, stopped) = channel();
        let keep = move || {
            while stopped.recv_timeout(PERIOD) == Err(RecvTimeoutError::Timeout) {
                for log in &logs {
                    // What cannot be given back now is taken out at the end, or told there.
                    let _kept = release_middle(log).is_err();
                }
            }
        };
        let thread = thread::Builder::new().name("logs".to_owned()).spawn(keep)?;
        Ok(Self { stop, thread })
    }

    /// Ends the thread and waits for it.
    pub(crate) fn finish(self) {
        drop(self.stop);
        // It has nothing that could panic, and nothing to tell.
        let _panicked = self.thread.join().is_err();
    }
}

/// Gives back the disk space of the middle of `log`, to which its process still appends.
///
/// # Errors
/// When there is no such file, or its file system makes no holes.
fn release_middle(log: &Path) -> io::Result<()> {
    let metadata = fs::metadata(log)?;
    if metadata.blocks() * BLOCK_BYTES <= LOG_MAX_BYTES || metadata.len() <= LOG_MAX_BYTES {
        return Ok(());
    }
    let file = File::options().write(true).open(log)?;
    let middle_bytes = metadata.len() - 2 * KEPT_BYTES;
    let signed = |bytes: u64| i64::try_from(bytes).map_err(io::Error::other);
    let hole = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
    fallocate(&file, hole, signed(KEPT_BYTES)?, signed(middle_bytes)?)?;
    Ok(())
}

/// Takes the middle out of `log`, whose process has ended, and gives how many bytes it held; 0 for a
/// log that is not too long. On an error the log is as it was.
///
/// # Errors
/// When the file cannot be read, or its shorter form cannot be written beside it.
pub(crate) fn cut_middle(log: &Path) -> io::Result<u64> {
    let mut file = File::open(log)?;
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
    let (mut head, mut tail) = (read(0)?, read(size_bytes - KEPT_BYTES)?);
    let is_line_end = |byte: &u8| *byte == b'\n';
    let last = head.len().saturating_sub(LINE_BYTES_MAX);
    if let Some(at) = head[last..].iter().rposition(is_line_end) {
        head.truncate(last + at + 1);
    }
    let first = LINE_BYTES_MAX.min(tail.len());
    if let Some(at) = tail[..first].iter().position(is_line_end) {
        tail.drain(..=at);
    }
    let left_out_bytes = size_bytes - (head.len() + tail.len()) as u64;
    let line_break = if head.last().is_none_or(is_line_end) {
        ""
    } else {
        "\n"
    };
    // Its disk space is what the shorter form needs.
    let _kept = release_middle(log).is_err();
    let cut = log.with_extension("cut");
    let written = plain_file::create_anew(&cut).and_then(|mut out| {
        out.write_all(&head)?;
        writeln!(
            out,
            "{line_break}[hil-runtime left out {left_out_bytes} bytes here]"
        )?;
        out.write_all(&tail)
    });
    let replaced = written.and_then(|()| fs::rename(&cut, log));
    if replaced.is_err() {
        // The error that is told is the first one.
        let _left = fs::remove_file(&cut).is_err();
    }
    replaced.map(|()| left_out_bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::env;

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
    fn of_a_log_without_lines_both_ends_are_kept_as_well_and_a_short_one_is_left_alone() {
        let log = env::temp_dir().join(format!("hil-plain-log-{}.log", std::process::id()));
        let middle = "x".repeat(5_000_000);
        for (first, last) in [("first\n", "\rlast\n"), ("", "")] {
            fs::write(&log, format!("{first}{middle}{last}")).unwrap();
            let size_bytes = fs::metadata(&log).unwrap().len();
            assert_eq!(cut_middle(&log).unwrap(), size_bytes - 2 * KEPT_BYTES);
            let text = fs::read_to_string(&log).unwrap();
            assert!(text.starts_with(first) && text.ends_with(last));
            assert!(text.contains("x\n[hil-runtime left out "));
            assert!(text.contains(" bytes here]\nx"));
        }
        let short = "a\nb\n";
        fs::write(&log, short).unwrap();
        release_middle(&log).unwrap();
        assert_eq!(cut_middle(&log).unwrap(), 0);
        assert_eq!(fs::read_to_string(&log).unwrap(), short);
        fs::remove_file(log).unwrap();
    }

    #[test]
    fn a_log_that_cannot_be_shortened_is_left_as_it_was() {
        let folder = env::temp_dir().join(format!("hil-stuck-log-{}", std::process::id()));
        let log = folder.join("robot.log");
        // What the shorter form would be written to is a folder.
        fs::create_dir_all(log.with_extension("cut")).unwrap();
        fs::write(&log, vec![b'x'; 5_000_000]).unwrap();
        assert!(cut_middle(&log).is_err());
        assert_eq!(fs::metadata(&log).unwrap().len(), 5_000_000);
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn the_keeper_ends_when_it_is_told_to() {
        let keeper = LogKeeper::start(vec!["/no/such/log".into()]).unwrap();
        keeper.finish();
    }
}
