//! A generic netlink socket towards the wireless subsystem: asks, listens and never blocks for
//! longer than its bound.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd, RawFd};

use nix::errno::Errno;
use nix::net::if_::if_nametoindex;
use nix::sys::socket::{MsgFlags, SockProtocol, recv};

use super::conversation::{Conversation, netlink_socket};
use super::netlink::{Answer, Answers, Attributes};
use super::nl80211;
use super::nl80211::{AssociationEvent, Station, Wireless, attribute};
use hil_rundir::radio_record::command;

/// The longest event of the kernel: it fills pages of 32 KiB at most.
const EVENT_BYTES: usize = 65_536;
/// A way to ask the wireless subsystem about one interface.
#[derive(Debug)]
pub struct RadioSocket {
    requests: Conversation,
    events: Option<OwnedFd>,
    family: u16,
    ifindex: u32,
    buffer: Box<[u8]>,
}

/// Why an interface cannot be asked about.
#[derive(Debug, thiserror::Error)]
pub enum RadioError {
    /// There is no such interface.
    #[error("interface {0} does not exist")]
    NoInterface(String),
    /// The kernel knows nothing of radios, or nothing of this one.
    #[error("{0} is not a wireless interface")]
    NotWireless(String),
    /// A call failed.
    #[error("cannot ask about the radio of {interface}: {source}")]
    Io {
        /// Which.
        interface: String,
        /// What the system said.
        source: io::Error,
    },
}

impl RadioSocket {
    /// Opens it for `interface`, and says what that is used as.
    ///
    /// # Errors
    /// When it is not wireless, or cannot be asked.
    pub fn open(interface: &str) -> Result<(Self, Wireless), RadioError> {
        let failed = |source: io::Error| RadioError::Io {
            interface: interface.to_owned(),
            source,
        };
        let ifindex = if_nametoindex(interface)
            .map_err(|_no_such| RadioError::NoInterface(interface.to_owned()))?;
        let mut requests = Conversation::open(SockProtocol::NetlinkGeneric).map_err(failed)?;
        let not_wireless = || RadioError::NotWireless(interface.to_owned());
        // Without the family no driver of a radio is loaded.
        let found = requests.family(b"nl80211\0", b"mlme\0").map_err(failed)?;
        let (family, group) = found.ok_or_else(not_wireless)?;
        let mut radio = Self {
            requests,
            events: None,
            family,
            ifindex,
            buffer: vec![0; EVENT_BYTES].into_boxed_slice(),
        };
        let interfaces = radio
            .ask(command::GET_INTERFACE, true, &[], |_, attributes| {
                let own = nl80211::number(attributes, attribute::IFINDEX) == Some(ifindex);
                own.then(|| Wireless::decode(attributes)).flatten()
            })
            .map_err(failed)?;
        let wireless = interfaces.into_iter().next().ok_or_else(not_wireless)?;
        // A socket of its own: an event between two parts of an answer would be in the way.
        let mask = group.and_then(|group| 1_u32.checked_shl(group.checked_sub(1)?));
        radio.events =
            mask.and_then(|mask| netlink_socket(SockProtocol::NetlinkGeneric, mask).ok());
        Ok((radio, wireless))
    }

    /// True while events of the association are heard.
    pub(crate) fn hears_events(&self) -> bool {
        self.events.is_some()
    }

    /// The stations this interface knows: of a station the access point, of an access point all.
    ///
    /// # Errors
    /// When the interface is gone or the kernel does not answer.
    pub fn stations(&mut self) -> io::Result<Vec<Station>> {
        let index = self.ifindex.to_ne_bytes();
        let attributes: [(u16, &[u8]); 1] = [(attribute::IFINDEX, &index)];
        self.ask(command::GET_STATION, true, &attributes, |_, attributes| {
            Station::decode(attributes)
        })
    }

    /// Whether the radio sleeps between beacons to save power.
    ///
    /// # Errors
    /// When the driver does not say (`EOPNOTSUPP`).
    pub fn is_power_save_on(&mut self) -> io::Result<bool> {
        let index = self.ifindex.to_ne_bytes();
        let attributes: [(u16, &[u8]); 1] = [(attribute::IFINDEX, &index)];
        let found = self.ask(
            command::GET_POWER_SAVE,
            false,
            &attributes,
            |_, attributes| nl80211::is_power_save_on(attributes),
        )?;
        let unanswered = || io::Error::from(io::ErrorKind::InvalidData);
        found.into_iter().next().ok_or_else(unanswered)
    }

    /// Gives `note` what happened to the association since the last call, and says how often the
    /// kernel threw events away because they came faster than they were taken; does not wait.
    ///
    /// # Errors
    /// When the socket breaks; what was there before has been given.
    pub(crate) fn happenings(&mut self, mut note: impl FnMut(AssociationEvent)) -> io::Result<u64> {
        let Some(events) = &self.events else {
            return Ok(0);
        };
        let (family, ifindex) = (self.family, self.ifindex);
        drain(events.as_raw_fd(), &mut self.buffer, |bytes| {
            for (_, answer) in Answers::new(bytes) {
                if let Answer::Message {
                    family: of,
                    command,
                    attributes,
                } = answer
                    && of == family
                    && let Some(happening) = AssociationEvent::decode(command, attributes)
                    && happening.ifindex == ifindex
                {
                    note(happening);
                }
            }
        })
    }

    fn ask<T>(
        &mut self,
        command: u8,
        is_dump: bool,
        attributes: &[(u16, &[u8])],
        take: impl FnMut(u8, Attributes<'_>) -> Option<T>,
    ) -> io::Result<Vec<T>> {
        self.requests
            .ask(self.family, command, is_dump, attributes, take)
    }
}

/// Takes every message there is without waiting; says how often the kernel reported an overrun.
fn drain(descriptor: RawFd, buffer: &mut [u8], mut take: impl FnMut(&[u8])) -> io::Result<u64> {
    let mut overrun_count = 0;
    loop {
        match recv(descriptor, buffer, MsgFlags::MSG_DONTWAIT) {
            // No message of netlink is empty.
            Err(Errno::EAGAIN) | Ok(0) => return Ok(overrun_count),
            Ok(length) => take(&buffer[..length]),
            Err(Errno::EINTR) => {}
            // Told once for each time the queue was full; what is in the queue is still good.
            Err(Errno::ENOBUFS) => overrun_count += 1,
            Err(errno) => return Err(errno.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_is_not_a_wireless_interface() {
        let error = RadioSocket::open("lo").unwrap_err();
        assert_eq!(error.to_string(), "lo is not a wireless interface");
        let error = RadioSocket::open("no-such-device").unwrap_err();
        assert_eq!(error.to_string(), "interface no-such-device does not exist");
    }
}
