//! The live tap of a probe as two eBPF programs, one for what arrives at an interface and one for what
//! leaves (TCX, since Linux 6.6). They copy the packets of followed flows into memory shared with this
//! process, and cost a packet less than [`super::packet_ring`], for which the kernel makes a copy of the
//! packet's description and walks through the packet sockets. Nobody is woken for a packet.
//!
//! An arrival has the stack's stamp, the one its receiver gets too. A departure has the program's own,
//! taken before the queueing discipline; so has an arrival that the stack did not stamp. That is of
//! international atomic time, as programs may read that clock: it is stepped with the system clock, lies
//! whole seconds beside it, and is the same in every time namespace, unlike the monotonic clock.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};

use nix::net::if_::if_nametoindex;
use nix::sys::socket::{setsockopt, sockopt};
use nix::time::{ClockId, clock_gettime};

use super::bpf_call::{self, Place, SharedWords};
use super::bpf_code::{Purpose, nothing, program};
use super::packet_ring::{RING_BYTES, RingCounters, RingError, RingSettings, SNAP_BYTES, check};
use super::packet_socket;
use super::ring_frame::{RingPacket, StampSource};
use super::tap_ring::{Shape, TapReader, counts};
use crate::capture::flow::FlowFilter;
use crate::capture::program::compile;

/// Programs between looking for room and drawing a slot, at most, on each processor; one is the rule,
/// as the kernel does not interrupt one for another there.
const AT_ONCE: usize = 4;
const SECOND_NS: i64 = 1_000_000_000;
/// A kernel without TCX does not know the places asked for.
const ASKING: &str = "asking for its programs";
const MORE_RIGHTS: &str = " (it needs CAP_BPF and CAP_NET_ADMIN; run as root)";
const NEWER_KERNEL: &str = " (Linux 6.6 is the first that can)";

/// See the module documentation.
#[derive(Debug)]
pub struct BpfTap {
    // Closed in this order: first nothing writes any more.
    _links: [OwnedFd; 2],
    shared: SharedWords,
    reader: TapReader,
    shape: Shape,
    /// Keeps stamping on, and the card open for frames of other addresses.
    socket: OwnedFd,
    /// Of the interface; a name may be given to another.
    interface_index: u32,
    link_type: u16,
    /// Programs of others that see what leaves before ours does.
    earlier_program_count: u32,
    /// International atomic time less the system clock, nanoseconds.
    atomic_ahead_ns: i64,
    is_new_look: bool,
    was_up: bool,
    is_gone: bool,
    step_count: u64,
}

impl BpfTap {
    /// Opens a tap on an interface of this network namespace. Packets are in it from now on.
    ///
    /// # Errors
    /// See [`RingError`]; [`RingError::Program`] where the host cannot do it this way.
    pub fn open(
        interface: &str,
        flows: &[FlowFilter],
        settings: &RingSettings,
    ) -> Result<Self, RingError> {
        let snap_bytes = settings.snap_bytes as usize;
        check("snap_bytes", snap_bytes, SNAP_BYTES)?;
        let (least, most) = (*RING_BYTES.start(), *RING_BYTES.end());
        check("ring_bytes", settings.ring_bytes, (least, most))?;
        let (socket, index, link_type) = listen(interface)?;
        let refused = |step| refusal(interface, step);
        let unknown = || RingError::Refused {
            interface: interface.to_owned(),
            step: "filter",
            source: io::ErrorKind::Unsupported.into(),
        };
        // First, as the answer of a kernel that is too old is plainest here.
        let earlier_program_count =
            bpf_call::attached_count(index, Place::Departures).map_err(refused(ASKING))?;
        let filter = compile(link_type, flows, settings.snap_bytes).ok_or_else(unknown)?;
        let margin = AT_ONCE * bpf_call::processor_count();
        let shape = Shape::new(snap_bytes, settings.ring_bytes, margin);
        let bytes = shape.memory_bytes();
        let map = bpf_call::create_map(bytes).map_err(refused("creating its map"))?;
        let shared = SharedWords::of(&map, bytes).map_err(refused("mapping its memory"))?;
        let load = |is_outbound| {
            let purpose = Purpose {
                filter: &filter,
                shape,
                map: map.as_raw_fd(),
                is_outbound,
            };
            bpf_call::load_program(&program(&purpose)).map_err(refused("loading its program"))
        };
        let (arrivals, departures) = (load(false)?, load(true)?);
        let attach = |program, place| {
            bpf_call::attach(program, index, place).map_err(refused("attaching its program"))
        };
        let atomic_ahead_ns = atomic_ahead_ns().map_err(refused("reading the clocks"))?;
        Ok(Self {
            _links: [
                attach(&arrivals, Place::Arrivals)?,
                attach(&departures, Place::Departures)?,
            ],
            shared,
            reader: TapReader::new(shape),
            shape,
            socket,
            interface_index: index,
            link_type,
            earlier_program_count,
            atomic_ahead_ns,
            is_new_look: true,
            was_up: true,
            is_gone: false,
            step_count: 0,
        })
    }

    /// The link layer its packets begin with; see [`crate::capture::link_type`].
    pub fn link_type(&self) -> u16 {
        self.link_type
    }

    /// Packets it has room for.
    pub fn frame_count(&self) -> usize {
        self.shape.room()
    }

    /// Hands the next packet to `take`; `false` when there is none.
    ///
    /// # Panics
    /// When a slot of the ring holds more than fits into it.
    pub fn next_packet(&mut self, take: impl FnOnce(&RingPacket<'_>)) -> bool {
        let Some(record) = self.reader.take(self.shared.words()) else {
            self.is_new_look = true;
            return false;
        };
        if self.is_new_look {
            self.is_new_look = false;
            // Where the kernel refuses to read its clocks the last difference stays.
            if let Ok(newer) = atomic_ahead_ns() {
                self.step_count += u64::from(newer != self.atomic_ahead_ns);
                self.atomic_ahead_ns = newer;
            }
        }
        let (stamp_ns, source) = if record.is_stack_stamp {
            (record.stamp_ns, StampSource::Stack)
        } else {
            let real_ns = record.stamp_ns.saturating_add_signed(-self.atomic_ahead_ns);
            (real_ns, StampSource::Tap)
        };
        take(&RingPacket {
            stamp_ns,
            source,
            direction: record.direction,
            original_bytes: record.original_bytes,
            vlan: record.vlan,
            data: record.data,
        });
        true
    }

    /// What has happened to the interface since it was last asked: `ENETDOWN` when it was taken down,
    /// another when it has gone, once. Packets come again if it comes up, under whatever name; not when
    /// one of its name is made anew.
    ///
    /// # Errors
    /// What happened.
    pub fn check(&mut self) -> io::Result<()> {
        if self.is_gone {
            return Ok(());
        }
        let asked = packet_socket::is_up(&self.socket, self.interface_index);
        self.is_gone = asked.is_err();
        let is_up = asked?;
        let went_down = self.was_up && !is_up;
        self.was_up = is_up;
        if went_down {
            return Err(io::Error::from_raw_os_error(libc::ENETDOWN));
        }
        Ok(())
    }

    /// What was counted until now.
    pub fn counters(&self) -> RingCounters {
        let (kept, dropped_count) = counts(self.shared.words());
        RingCounters {
            matched_count: kept + dropped_count,
            dropped_count,
        }
    }

    /// Programs of anyone that were there before, and see what leaves before this tap does: what they
    /// keep back or send elsewhere never gets here. Arrivals it sees first.
    pub fn earlier_program_count(&self) -> u32 {
        self.earlier_program_count
    }

    /// How often the kernel was told another difference of atomic time and system clock, as a time
    /// service does once when it starts: stamps of departures between two looks are wrong by the change.
    pub fn step_count(&self) -> u64 {
        self.step_count
    }
}

/// How many eBPF programs, of anyone, see what arrives at and what leaves an interface of this network
/// namespace (TCX).
///
/// # Errors
/// When there is no such interface, or the kernel does not say.
pub fn attached_programs(interface: &str) -> io::Result<[u32; 2]> {
    let index = if_nametoindex(interface)?;
    let count = |place| bpf_call::attached_count(index, place);
    Ok([count(Place::Arrivals)?, count(Place::Departures)?])
}

/// Whether the kernel grants this process such a tap; it attaches nothing.
///
/// # Errors
/// What stands in the way.
pub fn is_granted() -> Result<(), RingError> {
    let anywhere = "lo";
    attached_programs(anywhere).map_err(refusal(anywhere, ASKING))?;
    bpf_call::load_program(&nothing()).map_err(refusal(anywhere, "loading a program"))?;
    Ok(())
}

/// International atomic time less the system clock. The kernel keeps it in whole seconds, so that the
/// time between the two reads does not matter.
fn atomic_ahead_ns() -> io::Result<i64> {
    let read = |clock| -> io::Result<i64> {
        let time = clock_gettime(clock)?;
        Ok(time.tv_sec() * SECOND_NS + time.tv_nsec())
    };
    let apart_ns = read(ClockId::CLOCK_TAI)? - read(ClockId::CLOCK_REALTIME)?;
    Ok((apart_ns + SECOND_NS / 2).div_euclid(SECOND_NS) * SECOND_NS)
}

/// A socket at the interface that hears nothing; the interface's number and its link layer.
fn listen(interface: &str) -> Result<(OwnedFd, u32, u16), RingError> {
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
    let socket = packet_socket::open().map_err(|error| match error.kind() {
        io::ErrorKind::PermissionDenied => RingError::Rights {
            interface: interface.to_owned(),
        },
        _ => refused("socket")(error),
    })?;
    packet_socket::bind(&socket, index, 0).map_err(refused("bind"))?;
    let hardware_type = packet_socket::hardware_type(&socket).map_err(refused("getsockname"))?;
    let link = packet_socket::link_of(hardware_type).ok_or_else(|| RingError::LinkLayer {
        interface: interface.to_owned(),
        hardware_type,
    })?;
    // Makes the kernel stamp arrivals even when no other socket asks for it.
    setsockopt(&socket, sockopt::ReceiveTimestampns, &true)
        .map_err(|errno| refused("SO_TIMESTAMPNS")(errno.into()))?;
    packet_socket::listen_to_all(&socket, index).map_err(refused("PACKET_ADD_MEMBERSHIP"))?;
    Ok((socket, index, link))
}

fn refusal(interface: &str, step: &'static str) -> impl Fn(io::Error) -> RingError {
    move |source| RingError::Program {
        interface: interface.to_owned(),
        step,
        hint: match source.raw_os_error() {
            Some(libc::EPERM | libc::EACCES) => MORE_RIGHTS,
            Some(libc::EINVAL | libc::ENOSYS | libc::EOPNOTSUPP) => NEWER_KERNEL,
            _ => "",
        },
        source,
    }
}
