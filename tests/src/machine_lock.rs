//! A lock between tests, in whatever process each of them runs.

use std::env;
use std::fs::{File, OpenOptions};

use nix::fcntl::{Flock, FlockArg};

/// Waits for the lock called `name` on this machine; it is let go on drop, or when its owner dies. The file
/// behind it is the holder's to write into.
///
/// # Panics
/// When the file cannot be opened or locked.
pub fn machine_lock(name: &str) -> Flock<File> {
    let path = env::temp_dir().join(format!("hil-tests-{name}.lock"));
    let mut options = OpenOptions::new();
    let options = options.read(true).write(true).create(true).truncate(false);
    let locked = options
        .open(&path)
        .map_err(|error| error.to_string())
        .and_then(|file| {
            Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, errno)| errno.to_string())
        });
    match locked {
        Ok(held) => held,
        Err(reason) => panic!("{}: {reason}", path.display()),
    }
}
