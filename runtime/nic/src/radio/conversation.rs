//! Question and answer over a netlink socket, for any family whose messages begin with four bytes of
//! their own (generic netlink, nfnetlink). It never waits for longer than its bound.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, MsgFlags, NetlinkAddr, SockFlag, SockProtocol, SockType, bind, recv, send,
    setsockopt, socket, sockopt,
};
use nix::sys::time::{TimeVal, TimeValLike};

use super::netlink::{Answer, Answers, Attributes, CONTROL_FAMILY, Request};
use super::nl80211::{self, control};

/// The longest answer of the kernel: it fills pages of 32 KiB at most.
const ANSWER_BYTES: usize = 65_536;
/// How long an answer may take; the kernel gives it in the send call.
const ANSWER_WAIT: Duration = Duration::from_millis(200);

/// A socket to ask over.
#[derive(Debug)]
pub struct Conversation {
    socket: OwnedFd,
    sequence: u32,
    buffer: Box<[u8]>,
}

impl Conversation {
    /// Opens it.
    ///
    /// # Errors
    /// When the kernel does not have the protocol.
    pub fn open(protocol: SockProtocol) -> io::Result<Self> {
        Ok(Self {
            socket: netlink_socket(protocol, 0)?,
            sequence: 0,
            buffer: vec![0; ANSWER_BYTES].into_boxed_slice(),
        })
    }

    /// The number of the generic family called `name` (ending in a zero byte) and of its multicast
    /// group `group`; `None` when the kernel does not have the family.
    ///
    /// # Errors
    /// When it does not answer.
    pub fn family(&mut self, name: &[u8], group: &[u8]) -> io::Result<Option<(u16, Option<u32>)>> {
        let asked = self.ask(
            CONTROL_FAMILY,
            control::GET_FAMILY,
            false,
            &[(control::FAMILY_NAME, name)],
            |_, attributes| nl80211::family(attributes, group),
        );
        match asked {
            Err(error) if error.raw_os_error() == Some(libc::ENOENT) => Ok(None),
            other => Ok(other?.into_iter().next()),
        }
    }

    /// Sends a request and gives each answer to `take`: its first byte, for generic netlink the
    /// command, and its attributes.
    ///
    /// # Errors
    /// What the kernel refused with, or that it did not answer in time.
    pub fn ask<T>(
        &mut self,
        family: u16,
        command: u8,
        is_dump: bool,
        attributes: &[(u16, &[u8])],
        mut take: impl FnMut(u8, Attributes<'_>) -> Option<T>,
    ) -> io::Result<Vec<T>> {
        self.sequence = self.sequence.wrapping_add(1);
        let request = Request {
            family,
            command,
            is_dump,
            sequence: self.sequence,
            attributes,
        };
        let descriptor = self.socket.as_raw_fd();
        send(descriptor, &request.encode(), MsgFlags::empty())?;
        let mut found = Vec::new();
        loop {
            let length = match recv(descriptor, &mut self.buffer, MsgFlags::empty()) {
                Ok(length) => length,
                Err(Errno::EINTR) => continue,
                Err(errno) => return Err(errno.into()),
            };
            for (sequence, answer) in Answers::new(&self.buffer[..length]) {
                // An answer to an earlier request that was given up.
                if sequence != self.sequence {
                    continue;
                }
                match answer {
                    Answer::Done | Answer::Error(0) => return Ok(found),
                    Answer::Error(errno) => return Err(io::Error::from_raw_os_error(errno)),
                    Answer::Message {
                        command,
                        attributes,
                        ..
                    } => {
                        found.extend(take(command, attributes));
                        if !is_dump {
                            return Ok(found);
                        }
                    }
                }
            }
        }
    }
}

/// A socket bound to the groups of `mask`.
pub(super) fn netlink_socket(protocol: SockProtocol, mask: u32) -> io::Result<OwnedFd> {
    let opened = socket(
        AddressFamily::Netlink,
        SockType::Raw,
        SockFlag::SOCK_CLOEXEC,
        protocol,
    )?;
    bind(opened.as_raw_fd(), &NetlinkAddr::new(0, mask))?;
    let wait = TimeVal::milliseconds(i64::try_from(ANSWER_WAIT.as_millis()).unwrap_or(i64::MAX));
    setsockopt(&opened, sockopt::ReceiveTimeout, &wait)?;
    Ok(opened)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_family_that_no_kernel_has_is_none() {
        let mut talk = Conversation::open(SockProtocol::NetlinkGeneric).unwrap();
        assert_eq!(talk.family(b"no-such\0", b"").unwrap(), None);
        let (control, _) = talk.family(b"nlctrl\0", b"").unwrap().unwrap();
        assert_eq!(control, CONTROL_FAMILY);
    }
}
