//! The cable's end in the process that carries its frames: what the program sends comes out, and what is put
//! in it receives. What found no room anywhere in between is counted.

use std::fs::File;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::os::unix::fs::FileExt;

use hil_net::handover;
use hil_net::packet_ring::{FrameSender, PacketRing};

use crate::inside::{ENTERED, GO};
use crate::{INTERFACE, RING};

/// Ethernet's two addresses, behind which a VLAN tag stands.
const ADDRESSES_BYTES: usize = 12;

/// Why there is no inlet.
#[derive(Debug, thiserror::Error)]
pub enum InletError {
    /// The helper said why.
    #[error("{0}")]
    Refused(String),
    /// It ended without a word.
    #[error("the process that was to become the program ended before it began")]
    Gone,
    /// The kernel does not give the ring.
    #[error("cannot use the cable's end: {0}")]
    Ring(#[from] io::Error),
}

/// Frames that were lost between a program and us, on this host and in no network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct InletCounters {
    /// Sent by the program and found the ring full.
    pub ring_full_count: u64,
    /// Sent by the program and dropped by its interface.
    pub dropped_outward_count: u64,
    /// Put in for the program and dropped by its interface.
    pub dropped_inward_count: u64,
}

/// See the module documentation.
#[derive(Debug)]
pub struct Inlet {
    ring: PacketRing,
    devices: File,
    /// To the helper, until it becomes the program.
    helper: OwnedFd,
    before: InletCounters,
    /// A frame with the tag that the kernel took out.
    tagged: Vec<u8>,
}

impl Inlet {
    /// Waits for the cable's end from the helper at the other end of `helper`.
    ///
    /// # Errors
    /// When the helper could not make one.
    pub fn take(helper: OwnedFd) -> Result<Self, InletError> {
        let (word, descriptors) = handover::take(&helper)?;
        if word.is_empty() {
            return Err(InletError::Gone);
        }
        let [socket, devices] = <[OwnedFd; 2]>::try_from(descriptors)
            .map_err(|_none| InletError::Refused(String::from_utf8_lossy(&word).into_owned()))?;
        debug_assert_eq!(word, ENTERED);
        Ok(Self {
            ring: PacketRing::of_cable(socket, &RING)?,
            devices: devices.into(),
            helper,
            before: InletCounters::default(),
            tagged: Vec::with_capacity(RING.snap_bytes as usize),
        })
    }

    /// Forgets what the interface said while it came up, then lets the program begin.
    ///
    /// # Errors
    /// When the helper is gone, or the kernel does not tell what it counted.
    pub fn begin(&mut self) -> io::Result<()> {
        self.ring.begin()?;
        self.before = self.counters_in_all()?;
        handover::give(&self.helper, GO, &[])
    }

    /// Hands the next frame that the program sent to `take`, with the kernel's stamp of it on the real-time
    /// clock; false when none waits.
    pub fn next_frame(&mut self, take: impl FnOnce(i64, &[u8])) -> bool {
        let tagged = &mut self.tagged;
        self.ring.next_packet(|packet| {
            let stamp_ns = i64::try_from(packet.stamp_ns).unwrap_or(i64::MAX);
            match packet.vlan {
                Some((kind, tag)) if packet.data.len() >= ADDRESSES_BYTES => {
                    let (addresses, rest) = packet.data.split_at(ADDRESSES_BYTES);
                    tagged.clear();
                    tagged.extend_from_slice(addresses);
                    tagged.extend_from_slice(&kind.to_be_bytes());
                    tagged.extend_from_slice(&tag.to_be_bytes());
                    tagged.extend_from_slice(rest);
                    take(stamp_ns, tagged);
                }
                _ => take(stamp_ns, packet.data),
            }
        })
    }

    /// Puts frames in, in whatever thread.
    ///
    /// # Errors
    /// When the kernel gives no more descriptors.
    pub fn sender(&self) -> io::Result<FrameSender> {
        self.ring.sender()
    }

    /// Readable while a frame waits.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.ring.descriptor()
    }

    /// What was lost since the program began.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn counters(&mut self) -> io::Result<InletCounters> {
        let (now, before) = (self.counters_in_all()?, self.before);
        Ok(InletCounters {
            ring_full_count: now.ring_full_count,
            dropped_outward_count: now.dropped_outward_count - before.dropped_outward_count,
            dropped_inward_count: now.dropped_inward_count - before.dropped_inward_count,
        })
    }

    fn counters_in_all(&mut self) -> io::Result<InletCounters> {
        let mut text = vec![0; 4096];
        let length = self.devices.read_at(&mut text, 0)?;
        let text = String::from_utf8_lossy(&text[..length]);
        let [inward, outward] = drops(&text).ok_or(io::ErrorKind::InvalidData)?;
        Ok(InletCounters {
            ring_full_count: self.ring.counters()?.dropped_count,
            dropped_outward_count: outward,
            dropped_inward_count: inward,
        })
    }
}

/// Received and sent frames that the program's interface dropped, of `/proc/net/dev`.
fn drops(devices: &str) -> Option<[u64; 2]> {
    let mut lines = devices
        .lines()
        .filter_map(|line| line.trim().split_once(':'));
    let (_, counts) = lines.find(|(name, _)| *name == INTERFACE)?;
    let mut counts = counts.split_whitespace().map(|count| count.parse().ok());
    Some([counts.nth(3)??, counts.nth(7)??])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_drops_of_the_interface_are_those_of_its_line() {
        let text = "Inter-|   Receive  |  Transmit\n face |bytes packets errs drop fifo frame compressed \
                    multicast|bytes packets errs drop fifo colls carrier compressed\n    lo: 1 2 3 4 5 6 7 8 9 \
                    10 11 12 13 14 15 16\n  eth0: 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26\n";
        assert_eq!(drops(text), Some([14, 22]));
        assert_eq!(drops("lo: 1"), None);
    }
}
