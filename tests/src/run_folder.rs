//! A folder for one test's files, removed when the test ends, however it ends.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::{fs, process};

/// A fresh folder below the system's temporary folder, removed on drop.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// Creates a folder nobody else uses; `label` shows up in its name.
    ///
    /// # Panics
    /// When the folder cannot be created: no test can go on without it.
    pub fn new(label: &str) -> Self {
        Self::below(&std::env::temp_dir(), label)
    }

    /// The same below `parent`.
    ///
    /// # Panics
    /// As [`RunFolder::new`].
    pub fn below(parent: &Path, label: &str) -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let index = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("hil-test-{}-{index}-{label}", process::id());
        let path = parent.join(name);
        // A folder of this name can only be left over from a process whose identifier came round.
        drop(fs::remove_dir_all(&path));
        let created = fs::create_dir(&path);
        assert!(
            created.is_ok(),
            "cannot create {}: {created:?}",
            path.display()
        );
        Self { path }
    }

    /// Where the folder is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The path of `name` inside it.
    pub fn join(&self, name: impl AsRef<Path>) -> PathBuf {
        self.path.join(name)
    }

    /// Writes a file into it and returns its path.
    ///
    /// # Panics
    /// When the file cannot be written.
    pub fn write(&self, name: impl AsRef<Path>, text: &str) -> PathBuf {
        let path = self.join(name);
        let written = fs::write(&path, text);
        assert!(
            written.is_ok(),
            "cannot write {}: {written:?}",
            path.display()
        );
        path
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        // Nothing can be done about a failure here, and panicking would hide the test's own.
        drop(fs::remove_dir_all(&self.path));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_its_own_and_goes_with_its_owner() {
        let (first, second) = (RunFolder::new("same"), RunFolder::new("same"));
        assert_ne!(first.path(), second.path());
        let file = first.write("topology.toml", "name = 1");
        assert_eq!(fs::read_to_string(&file).unwrap(), "name = 1");
        let path = first.path().to_owned();
        drop(first);
        assert!(!path.exists());
        assert!(second.path().exists());
    }

    #[test]
    fn a_folder_goes_after_a_panic_too() {
        let (sender, receiver) = std::sync::mpsc::channel();
        let result = std::thread::spawn(move || {
            let folder = RunFolder::new("panic");
            sender.send(folder.path().to_owned()).unwrap();
            panic!("planted");
        })
        .join();
        assert!(result.is_err());
        assert!(!receiver.recv().unwrap().exists());
    }
}
