//! An `AF_PACKET` socket that copies packets with nanosecond stamps into memory shared with the kernel
//! (`TPACKET_V2`). The live tap of a probe copies what is asked for, both ways, and takes no part in any
//! flow. The end of a cable takes every frame that arrives and sends others. What the packets mean is for
//! others.
//!
//! Version 2 of the ring, not 3: version 3 hands over blocks, and where every block times out with
//! one packet in it, it runs out of them. Nobody is woken for a packet unless somebody waits on the
//! descriptor, which the kernel would do at the expense of the sender: look into the ring now and
//! then instead. The ring holds what arrives in between, and the kernel counts what found no room.
//!
//! `unsafe` is allowed here because the ring is memory that the kernel writes, and no crate wraps its
//! counters.

use core::ffi::{c_int, c_uint};
use core::num::NonZeroUsize;
use core::ops::RangeInclusive;
use core::ptr::NonNull;
use core::sync::atomic::{AtomicU32, Ordering};
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};

use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};
use nix::sys::socket::{MsgFlags, getsockopt, send, setsockopt, sockopt};
use thiserror::Error;

use super::filter::{Instruction, PacketFilter, compile};
use super::link_type;
use super::packet_socket::{self, bind, link_of, listen_to_all, option_length, set_option};
use super::ring_frame::RingPacket;

/// Smallest and largest ring, bytes.
pub const RING_BYTES: RangeInclusive<usize> = (1 << 16)..=(1 << 28);
/// Fewest and most bytes kept of a packet.
const SNAP_BYTES: RangeInclusive<usize> = 64..=65_536;
/// The kernel gives the ring in pieces of this size.
const BLOCK_BYTES: usize = 1 << 16;
/// Room in a frame before the packet: the kernel's header and address, and what aligns them.
const FRAME_HEADER_BYTES: usize = 96;

/// `ETH_P_ALL` as a link address has it.
const EVERY_PROTOCOL: u16 = 3;
const _: () = assert!(EVERY_PROTOCOL as c_int == libc::ETH_P_ALL);
/// `linux/if_packet.h`; since Linux 4.20.
const PACKET_IGNORE_OUTGOING: c_int = 23;
/// How a tap is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RingSettings {
    /// Bytes kept of a packet, 64..=65536.
    pub snap_bytes: u32,
    /// Memory for packets that were not fetched yet; rounded up to a power of two.
    pub ring_bytes: usize,
    /// Whose stamps are wanted.
    pub stamps: RingStamps,
}

/// Whose stamps a ring asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RingStamps {
    /// The kernel's, of packets both ways.
    #[default]
    Kernel,
    /// The card's, of arriving packets: a tap sees what leaves before the card does. Packets that
    /// the card did not stamp come with the kernel's, and say so.
    Card,
}

/// Why there is no tap.
#[derive(Debug, Error)]
pub enum RingError {
    /// No such interface in this network namespace.
    #[error("no interface `{interface}` here: {source}")]
    Interface {
        /// Its name.
        interface: String,
        /// What the kernel said.
        source: io::Error,
    },
    /// The rights are missing.
    #[error("a tap on `{interface}` needs CAP_NET_RAW (run as root, or grant the file the right)")]
    Rights {
        /// Its name.
        interface: String,
    },
    /// A link layer whose packets could not be read.
    #[error(
        "interface `{interface}` has hardware type {hardware_type}; Ethernet, loopback and bare IP can be tapped"
    )]
    LinkLayer {
        /// Its name.
        interface: String,
        /// `ARPHRD_...`.
        hardware_type: u16,
    },
    /// A size that cannot be.
    #[error("{what} of {value} bytes is outside {min} to {max}")]
    Size {
        /// Which size.
        what: &'static str,
        /// Its value.
        value: usize,
        /// Smallest.
        min: usize,
        /// Largest.
        max: usize,
    },
    /// The kernel refused a step.
    #[error("cannot tap `{interface}`: {step}: {source}")]
    Refused {
        /// Its name.
        interface: String,
        /// What was tried.
        step: &'static str,
        /// What the kernel said.
        source: io::Error,
    },
}

/// What the kernel counted since the account began: when the tap was opened, or at
/// [`PacketRing::begin`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RingCounters {
    /// Packets that passed the filters, dropped ones included.
    pub matched_count: u64,
    /// Of those, dropped because the ring was full.
    pub dropped_count: u64,
}

/// See the module documentation.
#[derive(Debug)]
pub struct PacketRing {
    socket: OwnedFd,
    map: Mapping,
    frame_bytes: usize,
    frame_count: usize,
    /// Where the next packet is looked for; `None` until the first is found that another reader left.
    next_index: Option<usize>,
    link_type: u16,
    /// What the kernel counted since the tap was opened.
    counted: RingCounters,
    /// Of that, before the account began.
    before: RingCounters,
    /// Packets that [`Self::begin`] took out.
    discarded_count: u64,
}

impl PacketRing {
    /// Opens a tap on an interface of this network namespace. Packets are in it from now on.
    ///
    /// # Errors
    /// See [`RingError`].
    pub fn open(
        interface: &str,
        filters: &[PacketFilter],
        settings: &RingSettings,
    ) -> Result<Self, RingError> {
        check("snap_bytes", settings.snap_bytes as usize, &SNAP_BYTES)?;
        check("ring_bytes", settings.ring_bytes, &RING_BYTES)?;
        let index = if_nametoindex(interface).map_err(|errno| RingError::Interface {
            interface: interface.to_owned(),
            source: errno.into(),
        })?;
        let refused = |step: &'static str| {
            move |source: io::Error| RingError::Refused {
                interface: interface.to_owned(),
                step,
                source,
            }
        };
        let socket = packet_socket::open().map_err(|error| {
            if error.kind() == io::ErrorKind::PermissionDenied {
                RingError::Rights {
                    interface: interface.to_owned(),
                }
            } else {
                refused("socket")(error)
            }
        })?;
        // Without a protocol it hears nothing yet, but tells the link layer.
        bind(&socket, index, 0).map_err(refused("bind"))?;
        let hardware_type =
            packet_socket::hardware_type(&socket).map_err(refused("getsockname"))?;
        let unknown = || RingError::LinkLayer {
            interface: interface.to_owned(),
            hardware_type,
        };
        let link = link_of(hardware_type).ok_or_else(unknown)?;
        let program = compile(link, filters, settings.snap_bytes).ok_or_else(unknown)?;
        let version = tpacket_version();
        set_option(&socket, libc::SOL_PACKET, libc::PACKET_VERSION, &version)
            .map_err(refused("PACKET_VERSION"))?;
        // Makes the kernel stamp packets in its stack even when no other socket asks for it.
        setsockopt(&socket, sockopt::ReceiveTimestampns, &true)
            .map_err(|errno| refused("SO_TIMESTAMPNS")(errno.into()))?;
        if settings.stamps == RingStamps::Card {
            prefer_nic(&socket).map_err(refused("PACKET_TIMESTAMP"))?;
        }
        attach(&socket, &program).map_err(refused("SO_ATTACH_FILTER"))?;
        let layout = Layout::of(settings);
        layout.ask_of(&socket).map_err(refused("PACKET_RX_RING"))?;
        let map = Mapping::of(&socket, layout.ring).map_err(refused("mmap"))?;
        let everything = EVERY_PROTOCOL.to_be();
        bind(&socket, index, everything).map_err(refused("bind"))?;
        listen_to_all(&socket, index).map_err(refused("PACKET_ADD_MEMBERSHIP"))?;
        Ok(Self::new(socket, map, &layout, link))
    }

    fn new(socket: OwnedFd, map: Mapping, layout: &Layout, link_type: u16) -> Self {
        Self {
            socket,
            map,
            frame_bytes: layout.frame,
            frame_count: layout.frame_count(),
            next_index: Some(0),
            link_type,
            counted: RingCounters::default(),
            before: RingCounters::default(),
            discarded_count: 0,
        }
    }

    /// The ring of a socket that [`CableSocket::attach`] prepared, perhaps in another process. With `was_read` another
    /// reader has perhaps read from it before; it must have ended.
    ///
    /// # Errors
    /// When the kernel does not map it.
    pub fn of_cable(socket: OwnedFd, settings: &RingSettings, was_read: bool) -> io::Result<Self> {
        let layout = Layout::of(settings);
        let map = Mapping::of(&socket, layout.ring)?;
        Ok(Self {
            next_index: (!was_read).then_some(0),
            ..Self::new(socket, map, &layout, link_type::ETHERNET)
        })
    }

    /// Readable while a packet waits.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// The link layer its packets begin with; see [`super::link_type`].
    pub fn link_type(&self) -> u16 {
        self.link_type
    }

    /// Packets it has room for.
    pub fn frame_count(&self) -> usize {
        self.frame_count
    }

    /// Hands the next packet to `take` and gives its room back; `false` when there is none.
    ///
    /// # Panics
    /// When the kernel places a packet outside its frame.
    #[allow(unsafe_code, reason = "the frame is memory shared with the kernel")]
    pub fn next_packet(&mut self, take: impl FnOnce(&RingPacket<'_>)) -> bool {
        let Some(index) = self.next_index.or_else(|| self.first_waiting()) else {
            return false;
        };
        let status_cell = self.status_of(index);
        let status = status_cell.load(Ordering::Acquire);
        if status & libc::TP_STATUS_USER == 0 {
            return false;
        }
        let frame = self.map.at(index * self.frame_bytes);
        // SAFETY: with the user bit set the whole frame is ours: the kernel leaves it alone until its
        // status is set back, which happens after `take` has returned.
        let bytes = unsafe { core::slice::from_raw_parts(frame.as_ptr(), self.frame_bytes) };
        take(&RingPacket::read(bytes, status));
        status_cell.store(libc::TP_STATUS_KERNEL, Ordering::Release);
        self.next_index = Some((index + 1) % self.frame_count);
        true
    }

    #[allow(unsafe_code, reason = "the status is memory shared with the kernel")]
    fn status_of(&self, index: usize) -> &AtomicU32 {
        let frame = self.map.at(index * self.frame_bytes);
        // SAFETY: a frame is aligned to at least 4 bytes, lies within the mapping, which lives as long as the ring,
        // begins with its status, and kernel and program touch that only atomically.
        unsafe { AtomicU32::from_ptr(frame.as_ptr().cast()) }
    }

    /// The oldest packet that waits, wherever the kernel is: those that wait lie one behind the other.
    fn first_waiting(&self) -> Option<usize> {
        // Asking the kernel costs less than looking everywhere.
        let mut polled = [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN)];
        if poll(&mut polled, PollTimeout::ZERO) == Ok(0) {
            return None;
        }
        let waits = |index: usize| {
            self.status_of(index).load(Ordering::Acquire) & libc::TP_STATUS_USER != 0
        };
        let found = (0..self.frame_count).find(|&index| waits(index))?;
        let backwards =
            (1..self.frame_count).map(|back| (found + self.frame_count - back) % self.frame_count);
        let first = backwards.take_while(|&index| waits(index)).last();
        Some(first.unwrap_or(found))
    }

    /// What has happened to the interface since it was last asked: `ENETDOWN` when it was taken down
    /// or has gone. Packets come again if it does.
    ///
    /// # Errors
    /// What happened.
    pub fn check(&self) -> io::Result<()> {
        // Reading sets the socket's error to zero.
        match getsockopt(&self.socket, sockopt::SocketError)? {
            0 => Ok(()),
            errno => Err(io::Error::from_raw_os_error(errno)),
        }
    }

    /// Discards the packets that it holds, at most one turn of the ring, and begins its account anew:
    /// neither they nor what found no room until now is counted. For taps that are to begin together
    /// and were opened one after the other. Gives how many packets that were.
    ///
    /// # Errors
    /// When the kernel does not say what it counted.
    pub fn begin(&mut self) -> io::Result<u64> {
        let discarded = (0..self.frame_count).take_while(|_| self.next_packet(|_| ()));
        let discarded_count = discarded.count() as u64;
        self.discarded_count += discarded_count;
        // Of a full ring the kernel's place is not known: it may be any.
        if discarded_count == self.frame_count as u64 {
            self.next_index = None;
        }
        // Read when the ring has room again. What came since then is in it, and counts: hence the sum,
        // and not what was matched until now.
        let dropped_count = self.count()?.dropped_count;
        let before = core::mem::replace(
            &mut self.before,
            RingCounters {
                matched_count: self.discarded_count + dropped_count,
                dropped_count,
            },
        );
        Ok(discarded_count + dropped_count - before.dropped_count)
    }

    /// What was counted since the account began.
    ///
    /// # Errors
    /// When the kernel does not say.
    pub fn counters(&mut self) -> io::Result<RingCounters> {
        let counted = self.count()?;
        Ok(RingCounters {
            matched_count: counted.matched_count - self.before.matched_count,
            dropped_count: counted.dropped_count - self.before.dropped_count,
        })
    }

    #[allow(unsafe_code, reason = "no crate wraps PACKET_STATISTICS")]
    fn count(&mut self) -> io::Result<RingCounters> {
        let mut fresh = libc::tpacket_stats {
            tp_packets: 0,
            tp_drops: 0,
        };
        let mut length = option_length::<libc::tpacket_stats>();
        let (pointer, descriptor) = ((&raw mut fresh).cast(), self.socket.as_raw_fd());
        let (level, name) = (libc::SOL_PACKET, libc::PACKET_STATISTICS);
        // SAFETY: the kernel writes at most `length` bytes at `pointer`, a live structure of that
        // size.
        let result = unsafe { libc::getsockopt(descriptor, level, name, pointer, &raw mut length) };
        if result != 0 {
            return Err(io::Error::last_os_error());
        }
        // Reading sets the kernel's counts to zero.
        self.counted.matched_count += u64::from(fresh.tp_packets);
        self.counted.dropped_count += u64::from(fresh.tp_drops);
        Ok(self.counted)
    }
}

/// A packet socket of a network namespace that is to be the end of a cable there. It receives nothing yet.
#[derive(Debug)]
pub struct CableSocket(OwnedFd);

impl CableSocket {
    /// Opens one in the namespace of this thread.
    ///
    /// # Errors
    /// What the kernel answers.
    pub fn open() -> io::Result<Self> {
        packet_socket::open().map(Self)
    }

    /// Binds it to the Ethernet interface with this index in its namespace, with a ring for every frame that
    /// arrives there from now on; for [`PacketRing::of_cable`] with the same settings.
    ///
    /// # Errors
    /// What the kernel answers.
    pub fn attach(self, interface_index: c_uint, settings: &RingSettings) -> io::Result<OwnedFd> {
        let Self(socket) = self;
        let version = tpacket_version();
        set_option(&socket, libc::SOL_PACKET, libc::PACKET_VERSION, &version)?;
        setsockopt(&socket, sockopt::ReceiveTimestampns, &true)?;
        ignore_outgoing(&socket)?;
        // An interface without carrier, as one whose other end is down, has a queue that takes frames and throws them
        // away (`noop`). Other packet sockets of this end do not see what is sent; those of the other end do.
        let bypass: c_int = 1;
        set_option(
            &socket,
            libc::SOL_PACKET,
            libc::PACKET_QDISC_BYPASS,
            &bypass,
        )?;
        Layout::of(settings).ask_of(&socket)?;
        bind(&socket, interface_index, EVERY_PROTOCOL.to_be())?;
        Ok(socket)
    }
}

/// Sends frames out of the interface of a ring, which does not see them.
#[derive(Debug)]
pub struct FrameSender(OwnedFd);

impl FrameSender {
    /// Sends through the socket of a ring that [`CableSocket::attach`] prepared.
    pub const fn of(socket: OwnedFd) -> Self {
        Self(socket)
    }

    /// Sends `frame`, or fails at once.
    ///
    /// # Errors
    /// When the kernel does not take it.
    pub fn send(&self, frame: &[u8]) -> io::Result<()> {
        let descriptor = self.0.as_raw_fd();
        Ok(send(descriptor, frame, MsgFlags::MSG_DONTWAIT).map(|_whole| ())?)
    }
}

/// How a ring lies in memory, in bytes.
#[derive(Debug, Clone, Copy)]
struct Layout {
    frame: usize,
    block: usize,
    ring: usize,
}

impl Layout {
    fn of(settings: &RingSettings) -> Self {
        let frame_bytes = (FRAME_HEADER_BYTES + settings.snap_bytes as usize).next_power_of_two();
        let block_bytes = BLOCK_BYTES.max(frame_bytes);
        Self {
            frame: frame_bytes,
            block: block_bytes,
            ring: settings.ring_bytes.next_power_of_two().max(block_bytes),
        }
    }

    const fn frame_count(&self) -> usize {
        self.ring / self.frame
    }

    fn ask_of(&self, socket: &OwnedFd) -> io::Result<()> {
        let request = libc::tpacket_req {
            tp_block_size: narrow(self.block),
            tp_block_nr: narrow(self.ring / self.block),
            tp_frame_size: narrow(self.frame),
            tp_frame_nr: narrow(self.frame_count()),
        };
        set_option(socket, libc::SOL_PACKET, libc::PACKET_RX_RING, &request)
    }
}

fn check(
    what: &'static str,
    value: usize,
    allowed: &RangeInclusive<usize>,
) -> Result<(), RingError> {
    if allowed.contains(&value) {
        return Ok(());
    }
    Err(RingError::Size {
        what,
        value,
        min: *allowed.start(),
        max: *allowed.end(),
    })
}

const fn tpacket_version() -> c_int {
    libc::tpacket_versions::TPACKET_V2 as c_int
}

fn narrow(value: usize) -> c_uint {
    c_uint::try_from(value).expect("a ring is at most 256 MiB")
}

/// Gives arriving packets the card's stamp where there is one, and leaves out what leaves.
fn prefer_nic(socket: &OwnedFd) -> io::Result<()> {
    let hardware = libc::SOF_TIMESTAMPING_RAW_HARDWARE;
    set_option(socket, libc::SOL_PACKET, libc::PACKET_TIMESTAMP, &hardware)?;
    ignore_outgoing(socket)
}

fn ignore_outgoing(socket: &OwnedFd) -> io::Result<()> {
    let ignore: c_int = 1;
    set_option(socket, libc::SOL_PACKET, PACKET_IGNORE_OUTGOING, &ignore)
}

fn attach(socket: &OwnedFd, program: &[Instruction]) -> io::Result<()> {
    let mut filter: Vec<libc::sock_filter> = program
        .iter()
        .map(|one| libc::sock_filter {
            code: one.code,
            jt: one.jump_true,
            jf: one.jump_false,
            k: one.k,
        })
        .collect();
    let program = libc::sock_fprog {
        len: u16::try_from(filter.len()).expect("sixteen filters take a few hundred instructions"),
        filter: filter.as_mut_ptr(),
    };
    // The kernel copies the program before it returns.
    set_option(socket, libc::SOL_SOCKET, libc::SO_ATTACH_FILTER, &program)
}

/// The ring's memory.
#[derive(Debug)]
struct Mapping {
    start: NonNull<u8>,
    length_bytes: usize,
}

#[allow(
    unsafe_code,
    reason = "a ring may be looked into by another thread than opened it"
)]
// SAFETY: the memory belongs to the process, not to a thread, and a mapping is never shared.
unsafe impl Send for Mapping {}

impl Mapping {
    #[allow(unsafe_code, reason = "mapping memory is what this is for")]
    fn of(socket: &OwnedFd, length_bytes: usize) -> io::Result<Self> {
        let length = NonZeroUsize::new(length_bytes).ok_or(io::ErrorKind::InvalidInput)?;
        let access = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        // Populated now, so that no page is missing when the first packets come.
        let flags = MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE;
        // SAFETY: a fresh mapping at an address of the kernel's choice overlaps nothing.
        let start = unsafe { mmap(None, length, access, flags, socket, 0) }?;
        Ok(Self {
            start: start.cast(),
            length_bytes,
        })
    }

    #[allow(unsafe_code, reason = "a pointer into the mapping")]
    fn at(&self, offset_bytes: usize) -> NonNull<u8> {
        assert!(offset_bytes < self.length_bytes, "frame outside the ring");
        // SAFETY: just checked to lie within the mapping.
        unsafe { self.start.add(offset_bytes) }
    }
}

impl Drop for Mapping {
    #[allow(unsafe_code, reason = "see Mapping::of")]
    fn drop(&mut self) {
        // SAFETY: made by mmap with this length, and nothing points into it any more.
        let _unmapped = unsafe { munmap(self.start.cast(), self.length_bytes) }.is_ok();
    }
}
