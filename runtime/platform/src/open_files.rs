//! The descriptors of this process: how many it may have, leaving none to those it starts, and finding one
//! that a library keeps to itself.
//!
//! Programs that use `select` break above 1024, so the soft limit is low by convention and ours raise
//! it for themselves. A user's own program gets back what there was.

use std::net::SocketAddr;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::sync::OnceLock;
use std::{fs, io};

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::socket::{SockaddrStorage, getsockname, getsockopt, sockopt};

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
    for number in numbers()?.filter(|number| *number > STANDARD_MAX) {
        // SAFETY: the call closes nothing and touches no memory; a descriptor that is gone by now is an
        // error, which leaves nothing to keep from anybody.
        let _gone = unsafe { libc::fcntl(number, libc::F_SETFD, libc::FD_CLOEXEC) };
    }
    Ok(())
}

/// Another descriptor of the socket of this process that takes TCP connections at `address`.
///
/// # Errors
/// When there is none, or the kernel does not list them.
#[allow(
    unsafe_code,
    reason = "a descriptor of another's cannot be borrowed safely"
)]
pub fn listener_at(address: SocketAddr) -> io::Result<OwnedFd> {
    for number in numbers()? {
        // Nothing else is copied: closing a copy of a file drops the record locks that this process has on it, by
        // which others know that it is alive.
        if !is_at(number, address) {
            continue;
        }
        // SAFETY: the call touches no memory and leaves `number` as it is; one that is gone by now is an error.
        let copy = unsafe { libc::fcntl(number, libc::F_DUPFD_CLOEXEC, 0) };
        if copy < 0 {
            continue;
        }
        // SAFETY: the kernel made `copy` just now, for nobody else.
        let copy = unsafe { OwnedFd::from_raw_fd(copy) };
        // It may be another's by now.
        let is_listener = getsockopt(&copy, sockopt::AcceptConn) == Ok(true);
        if is_listener && is_at(copy.as_raw_fd(), address) {
            return Ok(copy);
        }
    }
    Err(io::Error::other(format!(
        "nothing of this process listens at {address}"
    )))
}

/// Whether `number` is a socket with this address here.
fn is_at(number: RawFd, address: SocketAddr) -> bool {
    let at = getsockname::<SockaddrStorage>(number).ok();
    let v4 = at.and_then(|at| at.as_sockaddr_in().map(|at| SocketAddr::V4((*at).into())));
    let v6 = at.and_then(|at| at.as_sockaddr_in6().map(|at| SocketAddr::V6((*at).into())));
    v4.or(v6) == Some(address)
}

fn numbers() -> io::Result<impl Iterator<Item = i32>> {
    // All of them first: the listing has one of its own.
    let listed: Vec<_> = fs::read_dir("/proc/self/fd")?.flatten().collect();
    let number = |entry: fs::DirEntry| entry.file_name().to_str()?.parse().ok();
    Ok(listed.into_iter().filter_map(number))
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
    fn a_listener_is_found_by_its_address_and_a_connection_is_none() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let stream = std::net::TcpStream::connect(address).unwrap();
        assert!(listener_at(stream.local_addr().unwrap()).is_err());
        let found = std::net::TcpListener::from(listener_at(address).unwrap());
        assert_eq!(found.accept().unwrap().1, stream.local_addr().unwrap());
        drop((listener, found));
        assert!(listener_at(address).is_err());
    }

    #[test]
    fn looking_for_a_listener_leaves_the_locks_of_this_process_alone() {
        let path = std::env::temp_dir().join(format!("hil-locked-{}", std::process::id()));
        let file = File::create_new(&path).unwrap();
        let whole = libc::flock {
            l_type: i16::try_from(libc::F_WRLCK).unwrap(),
            l_whence: i16::try_from(libc::SEEK_SET).unwrap(),
            l_start: 0,
            l_len: 0,
            l_pid: 0,
        };
        fcntl(&file, FcntlArg::F_SETLK(&whole)).unwrap();
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        listener_at(listener.local_addr().unwrap()).unwrap();
        let own = format!(" {} ", std::process::id());
        let locks = fs::read_to_string("/proc/locks").unwrap();
        fs::remove_file(&path).unwrap();
        assert!(
            locks
                .lines()
                .any(|lock| lock.contains("POSIX") && lock.contains(&own)),
            "{locks}"
        );
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
