//! A host made of a handful of text files, for tests of what is read from a host.

use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::files::HostFiles;

/// A folder of planted files, removed on drop.
#[derive(Debug)]
pub struct FakeHost {
    root: PathBuf,
}

impl FakeHost {
    /// A host with `files`, each a path and its text.
    ///
    /// # Panics
    /// When they cannot be written.
    pub fn with(files: &[(&str, &str)]) -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let index = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("hil-fake-host-{}-{index}", std::process::id());
        let host = Self {
            root: std::env::temp_dir().join(name),
        };
        for (path, text) in files {
            let path = host.files().locate(path);
            let folder = path.parent().expect("it lies below the root");
            fs::create_dir_all(folder).expect("a temporary folder can be made");
            fs::write(path, text).expect("a temporary file can be written");
        }
        host
    }

    /// Its files.
    pub fn files(&self) -> HostFiles {
        HostFiles::under(&self.root)
    }
}

impl Drop for FakeHost {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.root));
    }
}
