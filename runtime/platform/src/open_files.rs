//! The descriptors of this process: how many it may have, and leaving none to a successor.
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

/// Closes all but the standard descriptors: what the process that started this one left open. Call it
/// before anything is opened.
///
/// # Errors
/// When the kernel does not list them.
pub fn close_inherited() -> io::Result<()> {
    const STANDARD_MAX: i32 = 2;
    let entries = fs::read_dir("/proc/self/fd")?;
    let numbers = entries.flatten().filter_map(|entry| {
        let name = entry.file_name();
        name.to_str()?.parse::<i32>().ok()
    });
    // Collected first: the listing has a descriptor of its own, which is gone by then.
    let numbers: Vec<i32> = numbers.filter(|number| *number > STANDARD_MAX).collect();
    for number in numbers {
        let _gone = nix::unistd::close(number).is_err();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

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
