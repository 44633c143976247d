//! The descriptors of this process: how many it may have, and leaving none to those it starts.
//!
//! Programs that use `select` break above 1024, so the soft limit is low by convention and ours raise
//! it for themselves. A user's own program gets back what there was.

use std::sync::OnceLock;
use std::{fs, io};

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// The soft limit before [`raise_limit`].
static INHERITED: OnceLock<u64> = OnceLock::new();

/// Raises the soft limit to the hard one, as far as the kernel lets it.
///
/// # Errors
/// When the kernel refuses; the limit is what it was.
pub fn raise_limit() -> io::Result<()> {
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    let _inherited = INHERITED.get_or_init(|| soft);
    if soft < hard {
        setrlimit(Resource::RLIMIT_NOFILE, hard, hard)?;
    }
    Ok(())
}

/// How many this process may have, by the soft limit.
///
/// # Errors
/// When the kernel does not tell.
pub fn limit() -> io::Result<u64> {
    let (soft, _) = getrlimit(Resource::RLIMIT_NOFILE)?;
    Ok(soft)
}

/// The soft limit that this process was started with; `None` where it was not raised.
pub fn inherited_limit() -> Option<u64> {
    INHERITED.get().copied()
}

/// Sets the soft limit, for a program that this process becomes.
///
/// # Errors
/// When the kernel refuses.
pub fn set_limit(soft: u64) -> io::Result<()> {
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    Ok(setrlimit(Resource::RLIMIT_NOFILE, soft.min(hard), hard)?)
}

/// Keeps all descriptors but the standard ones from whatever this process starts or becomes from here on:
/// what its parent left open, and those of libraries that do not mark theirs (shared memory). Call it
/// directly before.
///
/// # Errors
/// When the kernel does not list them.
#[allow(unsafe_code, reason = "a descriptor of another's has no safe setter")]
pub fn withhold() -> io::Result<()> {
    const STANDARD_MAX: i32 = 2;
    for entry in fs::read_dir("/proc/self/fd")?.flatten() {
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.parse::<i32>().ok());
        if let Some(number) = number.filter(|number| *number > STANDARD_MAX) {
            // SAFETY: the call closes nothing and touches no memory; a descriptor that is gone by now is an
            // error, which leaves nothing to keep from anybody.
            let _gone = unsafe { libc::fcntl(number, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::process::Command;

    use nix::fcntl::{FcntlArg, FdFlag, fcntl};

    use super::*;

    #[test]
    fn a_descriptor_that_a_library_left_open_for_all_is_not_had_by_a_child() {
        let shared = File::open("/proc/version").unwrap();
        fcntl(&shared, FcntlArg::F_SETFD(FdFlag::empty())).unwrap();
        let listed = || {
            let listing = Command::new("ls").args(["-l", "/proc/self/fd"]).output();
            String::from_utf8(listing.unwrap().stdout).unwrap()
        };
        assert!(listed().contains("/proc/version"));
        withhold().unwrap();
        assert!(!listed().contains("/proc/version"));
    }

    #[test]
    fn the_limit_is_raised_and_what_there_was_is_remembered_and_set_again() {
        let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
        let low = soft.min(200);
        setrlimit(Resource::RLIMIT_NOFILE, low, hard).unwrap();
        raise_limit().unwrap();
        assert_eq!(limit().unwrap(), hard);
        raise_limit().unwrap();
        assert_eq!(inherited_limit(), Some(low));
        set_limit(low).unwrap();
        assert_eq!(getrlimit(Resource::RLIMIT_NOFILE).unwrap(), (low, hard));
        setrlimit(Resource::RLIMIT_NOFILE, soft, hard).unwrap();
    }
}
