//! Descriptors from one process to another, with a few bytes beside them, over a socket pair or a
//! socket at a path.
//!
//! `unsafe` is allowed here because a received descriptor is a bare number.

use std::fs;
use std::io::{self, IoSlice, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::path::Path;

use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, Backlog, ControlMessage, ControlMessageOwned, MsgFlags, SockFlag, SockType,
    UnixAddr, accept4, bind, connect as connect_to, listen as listen_at, recv, recvmsg, sendmsg,
    socket, socketpair,
};

/// Descriptors of one message.
const DESCRIPTORS_MAX: usize = 4;

/// Two sockets that keep messages apart and know when the other end is gone.
///
/// # Errors
/// When the kernel gives none.
pub fn pair() -> io::Result<(OwnedFd, OwnedFd)> {
    let flags = SockFlag::SOCK_CLOEXEC;
    Ok(socketpair(
        AddressFamily::Unix,
        SockType::SeqPacket,
        None,
        flags,
    )?)
}

fn at_path(flags: SockFlag) -> io::Result<OwnedFd> {
    let flags = flags | SockFlag::SOCK_CLOEXEC;
    Ok(socket(
        AddressFamily::Unix,
        SockType::SeqPacket,
        flags,
        None,
    )?)
}

/// A socket at `path` that others [`connect`] to, in place of what was there.
///
/// # Errors
/// When there can be none.
pub fn listen(path: &Path) -> io::Result<OwnedFd> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let listener = at_path(SockFlag::SOCK_NONBLOCK)?;
    bind(listener.as_raw_fd(), &UnixAddr::new(path)?)?;
    listen_at(&listener, Backlog::MAXCONN)?;
    Ok(listener)
}

/// The next one that connected to `listener`; `None` while nobody has.
///
/// # Errors
/// When the kernel gives no more descriptors.
#[allow(unsafe_code, reason = "an accepted descriptor is a bare number")]
pub fn accept(listener: impl AsFd) -> io::Result<Option<OwnedFd>> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    match accept4(listener.as_fd().as_raw_fd(), flags) {
        // SAFETY: the kernel has just made this descriptor, and no other owner has it.
        Ok(number) => Ok(Some(unsafe { OwnedFd::from_raw_fd(number) })),
        Err(Errno::EAGAIN | Errno::ECONNABORTED | Errno::EINTR) => Ok(None),
        Err(errno) => Err(errno.into()),
    }
}

/// Connects to whoever listens at `path`; `None` where nobody does.
///
/// # Errors
/// When the kernel gives no socket.
pub fn connect(path: &Path) -> io::Result<Option<OwnedFd>> {
    let socket = at_path(SockFlag::SOCK_NONBLOCK)?;
    match connect_to(socket.as_raw_fd(), &UnixAddr::new(path)?) {
        Ok(()) => Ok(Some(socket)),
        Err(Errno::ENOENT | Errno::ECONNREFUSED | Errno::EAGAIN | Errno::EINTR) => Ok(None),
        Err(errno) => Err(errno.into()),
    }
}

/// What waits at a socket that does not block, as [`take`]; `None` while nothing does.
///
/// # Errors
/// When receiving fails.
pub fn take_waiting(socket: impl AsFd) -> io::Result<Option<(Vec<u8>, Vec<OwnedFd>)>> {
    match take(socket) {
        Ok(message) => Ok(Some(message)),
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(None),
        Err(error) => Err(error),
    }
}

/// Whether the other end is there; reads and allocates nothing.
pub fn is_open(socket: impl AsFd) -> bool {
    let flags = MsgFlags::MSG_PEEK | MsgFlags::MSG_DONTWAIT;
    match recv(socket.as_fd().as_raw_fd(), &mut [0], flags) {
        Ok(length) => length > 0,
        Err(errno) => matches!(errno, Errno::EAGAIN | Errno::EINTR),
    }
}

/// Sends `bytes` and copies of `descriptors`, four at most.
///
/// # Errors
/// When the other end is gone.
pub fn give(socket: impl AsFd, bytes: &[u8], descriptors: &[BorrowedFd<'_>]) -> io::Result<()> {
    let numbers: Vec<RawFd> = descriptors.iter().map(AsRawFd::as_raw_fd).collect();
    let rights = [ControlMessage::ScmRights(&numbers)];
    let control = if numbers.is_empty() { &[] } else { &rights[..] };
    let slices = [IoSlice::new(bytes)];
    let flags = MsgFlags::MSG_NOSIGNAL;
    sendmsg::<()>(socket.as_fd().as_raw_fd(), &slices, control, flags, None)?;
    Ok(())
}

/// Waits for a message: its bytes, cut to 4096, and its descriptors. No bytes once the other end is gone.
///
/// # Errors
/// When receiving fails.
#[allow(unsafe_code, reason = "a received descriptor is a bare number")]
pub fn take(socket: impl AsFd) -> io::Result<(Vec<u8>, Vec<OwnedFd>)> {
    let mut bytes = vec![0; 4096];
    let mut control = nix::cmsg_space!([RawFd; DESCRIPTORS_MAX]);
    let mut slices = [IoSliceMut::new(&mut bytes)];
    let flags = MsgFlags::MSG_CMSG_CLOEXEC;
    let descriptor = socket.as_fd().as_raw_fd();
    let message = recvmsg::<()>(descriptor, &mut slices, Some(&mut control), flags)?;
    let length = message.bytes;
    let mut descriptors = Vec::new();
    for one in message.cmsgs()? {
        if let ControlMessageOwned::ScmRights(numbers) = one {
            // SAFETY: the kernel has just put these descriptors into this process, and no other owner has them.
            descriptors.extend(
                numbers
                    .iter()
                    .map(|&number| unsafe { OwnedFd::from_raw_fd(number) }),
            );
        }
    }
    bytes.truncate(length);
    Ok((bytes, descriptors))
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::{Read as _, Write as _};

    use super::*;

    #[test]
    fn a_descriptor_goes_over_with_its_bytes_and_an_end_that_is_gone_says_nothing() {
        let (here, there) = pair().unwrap();
        let (read, write) = nix::unistd::pipe().unwrap();
        give(&here, b"ready", &[write.as_fd()]).unwrap();
        give(&here, b"word", &[]).unwrap();
        drop((here, write));
        let (bytes, mut descriptors) = take(&there).unwrap();
        assert_eq!((bytes.as_slice(), descriptors.len()), (&b"ready"[..], 1));
        File::from(descriptors.remove(0)).write_all(b"x").unwrap();
        let (bytes, descriptors) = take(&there).unwrap();
        assert_eq!((bytes.as_slice(), descriptors.len()), (&b"word"[..], 0));
        let mut text = String::new();
        File::from(read).read_to_string(&mut text).unwrap();
        assert_eq!(text, "x");
        assert!(take(&there).unwrap().0.is_empty());
        assert!(!is_open(&there));
        let (here, there) = pair().unwrap();
        assert!(is_open(&there));
        give(&here, b"word", &[]).unwrap();
        assert!(is_open(&there) && take(&there).unwrap().0 == b"word");
    }
}
