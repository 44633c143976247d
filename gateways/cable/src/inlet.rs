//! The cable's end in the thread that carries its frames: what the program sends comes out, and what is put
//! in it receives. The thread fetches it from the [`CableServer`](crate::CableServer) of the process that started the program,
//! and again after either has started anew.

use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::path::Path;

use hil_net::handover;
use hil_net::packet_ring::{FrameSender, PacketRing};

use crate::RING;
use crate::inside::{BEGAN, GO};

/// Ethernet's two addresses, behind which a VLAN tag stands.
const ADDRESSES_BYTES: usize = 12;

/// A connection to the [`CableServer`](crate::CableServer) of a program.
#[derive(Debug)]
pub struct CableClient(OwnedFd);

impl CableClient {
    /// Connects to the server at `path`; `None` where there is none.
    ///
    /// # Errors
    /// When the kernel gives no socket.
    pub fn at(path: &Path) -> io::Result<Option<Self>> {
        Ok(handover::connect(path)?.map(Self))
    }

    /// The cable's end, once the server has given it, and only once; `None` before.
    ///
    /// # Errors
    /// When the server is gone.
    pub fn take(&self) -> io::Result<Option<GivenEnd>> {
        let Some((word, mut descriptors)) = handover::take_waiting(&self.0)? else {
            return Ok(None);
        };
        let gone = || io::Error::from(io::ErrorKind::UnexpectedEof);
        Ok(Some(GivenEnd {
            socket: descriptors.pop().ok_or_else(gone)?,
            has_program_begun: word == BEGAN,
        }))
    }

    /// Lets the program begin.
    ///
    /// # Errors
    /// When the server is gone.
    pub fn begin_program(&self) -> io::Result<()> {
        handover::give(&self.0, GO, &[])
    }

    /// False once the process that started the program is gone.
    pub fn is_open(&self) -> bool {
        handover::is_open(&self.0)
    }
}

/// The cable's end as the server gives it.
#[derive(Debug)]
pub struct GivenEnd {
    socket: OwnedFd,
    /// Frames of the program may have come already.
    pub has_program_begun: bool,
}

impl GivenEnd {
    /// For the thread of what the program sends.
    ///
    /// # Errors
    /// When the kernel does not give the ring.
    pub fn into_inlet(self) -> io::Result<Inlet> {
        Ok(Inlet {
            ring: PacketRing::of_cable(self.socket, &RING, self.has_program_begun)?,
            tagged: Vec::with_capacity(RING.snap_bytes as usize),
        })
    }

    /// For the thread of what the program receives.
    pub fn into_sender(self) -> FrameSender {
        FrameSender::of(self.socket)
    }
}

/// See the module documentation.
#[derive(Debug)]
pub struct Inlet {
    ring: PacketRing,
    /// A frame with the tag that the kernel took out.
    tagged: Vec<u8>,
}

impl Inlet {
    /// Discards the frames that wait, and gives how many there were and found no room.
    ///
    /// # Errors
    /// When the kernel does not tell what it counted.
    pub fn begin(&mut self) -> io::Result<u64> {
        self.ring.begin()
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

    /// Readable while a frame waits.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.ring.descriptor()
    }

    /// Clears what woke whoever waits for frames when none waits: the interface went down, or is gone.
    pub fn clear_error(&self) {
        let _told_by_the_server = self.ring.check().is_err();
    }

    /// Frames that the program sent and found no room in the ring since [`Inlet::begin`].
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn ring_full_count(&mut self) -> io::Result<u64> {
        Ok(self.ring.counters()?.dropped_count)
    }
}
