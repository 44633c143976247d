//! What a process holds at one moment: memory, open files, threads (`proc(5)`); and what a host's
//! shared memory holds.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use nix::unistd::Pid;

/// What one process holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Held {
    /// Memory in use, shared pages included (`VmRSS`).
    pub resident_bytes: u64,
    /// Memory of its own that no file backs (`RssAnon`): what a leak makes grow.
    pub anonymous_bytes: u64,
    /// Shared memory that it has touched (`RssShmem`).
    pub shared_bytes: u64,
    /// Most memory it ever had in use (`VmHWM`).
    pub peak_bytes: u64,
    /// Threads.
    pub thread_count: u64,
    /// Open files.
    pub file_count: u64,
}

impl Held {
    /// What the process holds now; `None` when it has ended.
    pub fn of(process: Pid) -> Option<Self> {
        let folder = format!("/proc/{process}");
        let status = fs::read_to_string(format!("{folder}/status")).ok()?;
        let mut held = Self::of_status(&status)?;
        held.file_count = fs::read_dir(format!("{folder}/fd")).ok()?.count() as u64;
        Some(held)
    }

    /// From the text of `/proc/<process>/status`, without the open files; `None` for a process that
    /// has no memory any more.
    fn of_status(status: &str) -> Option<Self> {
        let number = |key: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(key))?;
            line.split_whitespace().next()?.parse::<u64>().ok()
        };
        let bytes = |key: &str| Some(number(key)? * 1024);
        Some(Self {
            resident_bytes: bytes("VmRSS:")?,
            anonymous_bytes: bytes("RssAnon:")?,
            shared_bytes: bytes("RssShmem:")?,
            peak_bytes: bytes("VmHWM:")?,
            thread_count: number("Threads:")?,
            file_count: 0,
        })
    }
}

/// Bytes that the files below `folder` take up, and how many files there are.
pub fn shared_memory(folder: &Path) -> (u64, u64) {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let held = entries.filter_map(|entry| entry.metadata().ok());
    // What a file takes up, not what it could: iceoryx2 makes large ones and touches little.
    held.fold((0, 0), |(bytes, count), data| {
        (bytes + data.blocks() * 512, count + 1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_process_holds_memory_threads_and_files() {
        let before = Held::of(Pid::this()).unwrap();
        assert!(before.resident_bytes >= before.anonymous_bytes && before.anonymous_bytes > 0);
        assert!(before.peak_bytes >= before.resident_bytes && before.thread_count >= 1);
        let memory = vec![1_u8; 8 << 20];
        let files: Vec<_> = (0..5).map(|_| fs::File::open("/dev/null")).collect();
        let after = Held::of(Pid::this()).unwrap();
        // Other tests run beside this one, and take and give back too, but not as much.
        assert!(after.anonymous_bytes > before.anonymous_bytes + (4 << 20));
        assert!(after.file_count > 0);
        drop((memory, files));
    }

    #[test]
    fn a_process_that_has_ended_holds_nothing() {
        assert_eq!(
            Held::of_status("Name: x\nState: Z (zombie)\nThreads: 1\n"),
            None
        );
    }

    #[test]
    fn shared_memory_is_what_files_take_up() {
        let folder = crate::run_folder::RunFolder::new("held");
        assert_eq!(shared_memory(folder.path()), (0, 0));
        fs::write(folder.join("a"), vec![1; 10_000]).unwrap();
        let sparse = fs::File::create(folder.join("b")).unwrap();
        sparse.set_len(1 << 30).unwrap();
        let (bytes, count) = shared_memory(folder.path());
        assert_eq!(count, 2);
        assert!((10_000..1 << 20).contains(&bytes), "{bytes}");
    }
}
