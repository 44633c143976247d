//! A live tap by either engine: the packet ring or the eBPF programs. It chooses and hands on; the work
//! is theirs.

use core::fmt;
use std::io;

use super::bpf_tap::BpfTap;
use super::packet_ring::{PacketRing, RingCounters, RingError, RingSettings};
use super::ring_frame::RingPacket;
use crate::capture::flow::FlowFilter;

/// What takes the packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TapEngine {
    /// [`PacketRing`].
    Packet,
    /// [`BpfTap`].
    Bpf,
}

impl fmt::Display for TapEngine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Packet => "packet ring",
            Self::Bpf => "eBPF programs",
        })
    }
}

/// A tap, opened.
#[derive(Debug)]
pub enum LiveTap {
    /// By the packet ring.
    Packet(PacketRing),
    /// By eBPF programs.
    Bpf(Box<BpfTap>),
}

impl LiveTap {
    /// Opens a tap by one engine.
    ///
    /// # Errors
    /// See [`RingError`].
    pub fn open(
        engine: TapEngine,
        interface: &str,
        flows: &[FlowFilter],
        settings: &RingSettings,
    ) -> Result<Self, RingError> {
        Ok(match engine {
            TapEngine::Packet => Self::Packet(PacketRing::open(interface, flows, settings)?),
            TapEngine::Bpf => Self::Bpf(Box::new(BpfTap::open(interface, flows, settings)?)),
        })
    }

    /// Opens a tap by eBPF programs, or by the packet ring where the host cannot do that; then why.
    ///
    /// # Errors
    /// See [`RingError`].
    pub fn open_cheapest(
        interface: &str,
        flows: &[FlowFilter],
        settings: &RingSettings,
    ) -> Result<(Self, Option<RingError>), RingError> {
        match Self::open(TapEngine::Bpf, interface, flows, settings) {
            Ok(tap) => Ok((tap, None)),
            Err(reason @ RingError::Program { .. }) => {
                let tap = Self::open(TapEngine::Packet, interface, flows, settings)?;
                Ok((tap, Some(reason)))
            }
            Err(error) => Err(error),
        }
    }

    /// What takes its packets.
    pub fn engine(&self) -> TapEngine {
        match self {
            Self::Packet(_) => TapEngine::Packet,
            Self::Bpf(_) => TapEngine::Bpf,
        }
    }

    /// The link layer its packets begin with; see [`crate::capture::link_type`].
    pub fn link_type(&self) -> u16 {
        match self {
            Self::Packet(ring) => ring.link_type(),
            Self::Bpf(tap) => tap.link_type(),
        }
    }

    /// Packets it has room for.
    pub fn frame_count(&self) -> usize {
        match self {
            Self::Packet(ring) => ring.frame_count(),
            Self::Bpf(tap) => tap.frame_count(),
        }
    }

    /// Hands the next packet to `take` and gives its room back; `false` when there is none.
    ///
    /// # Panics
    /// When the kernel places a packet outside its room.
    pub fn next_packet(&mut self, take: impl FnOnce(&RingPacket<'_>)) -> bool {
        match self {
            Self::Packet(ring) => ring.next_packet(take),
            Self::Bpf(tap) => tap.next_packet(take),
        }
    }

    /// What has happened to the interface since it was last asked.
    ///
    /// # Errors
    /// What happened.
    pub fn check(&mut self) -> io::Result<()> {
        match self {
            Self::Packet(ring) => ring.check(),
            Self::Bpf(tap) => tap.check(),
        }
    }

    /// What was counted until now.
    ///
    /// # Errors
    /// When the kernel does not say.
    pub fn counters(&mut self) -> io::Result<RingCounters> {
        match self {
            Self::Packet(ring) => ring.counters(),
            Self::Bpf(tap) => Ok(tap.counters()),
        }
    }

    /// See [`BpfTap::earlier_program_count`]; 0 for a packet ring, which looks behind all of them.
    pub fn earlier_program_count(&self) -> u32 {
        match self {
            Self::Packet(_) => 0,
            Self::Bpf(tap) => tap.earlier_program_count(),
        }
    }

    /// See [`BpfTap::step_count`]; 0 for a packet ring, which reads no other clock.
    pub fn step_count(&self) -> u64 {
        match self {
            Self::Packet(_) => 0,
            Self::Bpf(tap) => tap.step_count(),
        }
    }
}
