//! Keeps `status.json` while a run goes. A thread of its own writes it: a disk that others write to may
//! keep a program waiting for half a minute, and by then the peers of a supervisor that waits, and its
//! service manager, take it for dead.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::{fs, io};

use super::status::{FILE_NAME, RunStatus};

/// The file for as long as the run goes; it is removed when this is dropped.
#[derive(Debug)]
pub struct StatusFile {
    path: PathBuf,
    shared: Arc<SharedStatus>,
    /// `None` when it could not be started.
    writer: Option<JoinHandle<()>>,
}

/// What the supervisor and the writing thread hand each other.
#[derive(Debug, Default)]
struct SharedStatus {
    pending: Mutex<PendingStatus>,
    bell: Condvar,
}

#[derive(Debug, Default)]
struct PendingStatus {
    /// The newest status, until the writer takes it.
    next: Option<RunStatus>,
    /// What hindered the writer, until the supervisor takes it.
    complaint: Option<String>,
    is_over: bool,
}

impl SharedStatus {
    /// Nothing that is held while this is can fail half way.
    fn pending(&self) -> MutexGuard<'_, PendingStatus> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The newest status, as soon as there is one; `None` when there will be no more.
    fn wait_for_next(&self) -> Option<RunStatus> {
        let is_idle = |pending: &mut PendingStatus| pending.next.is_none() && !pending.is_over;
        let waited = self.bell.wait_while(self.pending(), is_idle);
        waited.unwrap_or_else(PoisonError::into_inner).next.take()
    }
}

impl StatusFile {
    /// That of the run in `folder`; writes nothing yet.
    pub fn of(folder: &Path) -> Self {
        let path = folder.join(FILE_NAME);
        let shared = Arc::new(SharedStatus::default());
        let (theirs, file) = (Arc::clone(&shared), path.clone());
        let started = Builder::new()
            .name("status".to_owned())
            .spawn(move || keep(&theirs, &file));
        let writer = started
            .map_err(|error| shared.pending().complaint = Some(complaint(&path, &error)))
            .ok();
        Self {
            path,
            shared,
            writer,
        }
    }

    /// Has `status` written, so that a reader finds it whole, unless a newer one comes before the disk
    /// has time for it. Gives the complaint about an earlier one, once; what hindered it may be over.
    pub fn write(&self, status: RunStatus) -> Option<String> {
        let mut pending = self.shared.pending();
        pending.next = Some(status);
        let complaint = pending.complaint.take();
        drop(pending);
        self.shared.bell.notify_one();
        complaint
    }
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        self.shared.pending().is_over = true;
        self.shared.bell.notify_one();
        if let Some(writer) = self.writer.take() {
            // It has nothing to tell any more, not even that it panicked.
            let _is_over = writer.join().is_ok();
        }
        // Where it cannot be removed it only says how the run stood last.
        let _is_gone = fs::remove_file(&self.path).is_ok();
    }
}

/// The writing thread.
fn keep(shared: &SharedStatus, path: &Path) {
    let mut has_complained = false;
    while let Some(status) = shared.wait_for_next() {
        let Err(error) = replace(path, &status) else {
            continue;
        };
        if !has_complained {
            has_complained = true;
            shared.pending().complaint = Some(complaint(path, &error));
        }
    }
}

fn replace(path: &Path, status: &RunStatus) -> io::Result<()> {
    let new = path.with_extension("json.new");
    let text = serde_json::to_string(status).map_err(io::Error::other)?;
    let written = fs::write(&new, text).and_then(|()| fs::rename(&new, path));
    if written.is_err() {
        // A part of it would stay on a full disk; the error that is told is the first one.
        let _left = fs::remove_file(&new).is_err();
    }
    written
}

fn complaint(path: &Path, error: &io::Error) -> String {
    let path = path.display();
    format!(
        "{path}: {error}; until it can be written, `hil-runtime top` does not see how the processes \
         stand"
    )
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read;
    use std::thread;
    use std::time::Duration;

    use nix::sys::stat::Mode;
    use nix::unistd::mkfifo;

    use super::*;
    use crate::status::Phase;

    fn folder(name: &str) -> PathBuf {
        let name = format!("hil-status-file-{name}-{}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir_all(&path).unwrap();
        path
    }

    /// What `look` finds, as soon as it finds something.
    fn wait_for<T>(what: &str, look: impl Fn() -> Option<T>) -> T {
        for _ in 0..3_000 {
            if let Some(found) = look() {
                return found;
            }
            thread::sleep(Duration::from_millis(10));
        }
        panic!("waited for {what} for 30 s");
    }

    fn status(duration_ns: u64) -> RunStatus {
        RunStatus::new(Phase::Running, Some(duration_ns), Vec::new())
    }

    fn wait_until_read(folder: &Path, status: &RunStatus) {
        wait_for("the status", || {
            RunStatus::read(folder).ok().filter(|read| read == status)
        });
    }

    #[test]
    fn the_file_holds_what_was_said_last_and_goes_with_its_keeper() {
        let folder = folder("last");
        let file = StatusFile::of(&folder);
        for duration_ns in 0..100 {
            assert_eq!(file.write(status(duration_ns)), None);
        }
        let last = status(100);
        assert_eq!(file.write(last.clone()), None);
        wait_until_read(&folder, &last);
        drop(file);
        assert!(RunStatus::read(&folder).is_err());
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn what_hinders_it_is_told_once_and_may_be_over() {
        let folder = folder("hindered");
        fs::remove_dir_all(&folder).unwrap();
        let file = StatusFile::of(&folder);
        let told = wait_for("a complaint", || file.write(status(1)));
        assert!(told.contains("status.json"), "{told}");
        fs::create_dir_all(&folder).unwrap();
        let last = status(2);
        assert_eq!(file.write(last.clone()), None, "one complaint is enough");
        wait_until_read(&folder, &last);
        drop(file);
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_disk_that_does_not_answer_keeps_nobody_waiting() {
        let folder = folder("stuck");
        // Whoever opens a pipe to write to it waits for a reader.
        let pipe = folder.join("status.json.new");
        mkfifo(&pipe, Mode::S_IRWXU).unwrap();
        let file = StatusFile::of(&folder);
        for duration_ns in 0..10 {
            assert_eq!(file.write(status(duration_ns)), None);
            thread::sleep(Duration::from_millis(10));
        }
        let mut first = String::new();
        let mut reader = File::open(&pipe).unwrap();
        reader.read_to_string(&mut first).unwrap();
        assert!(first.contains("\"schema_version\""), "{first}");
        let last = status(10);
        assert_eq!(file.write(last.clone()), None);
        // Its name is the pipe's for a moment.
        wait_for("the file", || {
            let data = fs::symlink_metadata(folder.join(FILE_NAME)).ok()?;
            data.is_file().then_some(())
        });
        wait_until_read(&folder, &last);
        drop(file);
        fs::remove_dir_all(&folder).unwrap();
    }
}
