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
pub struct LiveTap {
    engine: Engine,
    /// What was counted before the account began.
    before: RingCounters,
    steps_before: u64,
    /// Packets that [`Self::begin`] took out.
    discarded_count: u64,
}

#[derive(Debug)]
enum Engine {
    Packet(PacketRing),
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
        Ok(Self {
            engine: match engine {
                TapEngine::Packet => Engine::Packet(PacketRing::open(interface, flows, settings)?),
                TapEngine::Bpf => Engine::Bpf(Box::new(BpfTap::open(interface, flows, settings)?)),
            },
            before: RingCounters::default(),
            steps_before: 0,
            discarded_count: 0,
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
        match &self.engine {
            Engine::Packet(_) => TapEngine::Packet,
            Engine::Bpf(_) => TapEngine::Bpf,
        }
    }

    /// The link layer its packets begin with; see [`crate::capture::link_type`].
    pub fn link_type(&self) -> u16 {
        match &self.engine {
            Engine::Packet(ring) => ring.link_type(),
            Engine::Bpf(tap) => tap.link_type(),
        }
    }

    /// Packets it has room for.
    pub fn frame_count(&self) -> usize {
        match &self.engine {
            Engine::Packet(ring) => ring.frame_count(),
            Engine::Bpf(tap) => tap.frame_count(),
        }
    }

    /// Hands the next packet to `take` and gives its room back; `false` when there is none.
    ///
    /// # Panics
    /// When the kernel places a packet outside its room.
    pub fn next_packet(&mut self, take: impl FnOnce(&RingPacket<'_>)) -> bool {
        match &mut self.engine {
            Engine::Packet(ring) => ring.next_packet(take),
            Engine::Bpf(tap) => tap.next_packet(take),
        }
    }

    /// What has happened to the interface since it was last asked.
    ///
    /// # Errors
    /// What happened.
    pub fn check(&mut self) -> io::Result<()> {
        match &mut self.engine {
            Engine::Packet(ring) => ring.check(),
            Engine::Bpf(tap) => tap.check(),
        }
    }

    /// Discards the packets that it holds, at most one turn of the ring, and begins its account anew:
    /// neither they nor what found no room until now is counted. For taps that are to begin together
    /// and were opened one after the other.
    ///
    /// # Errors
    /// When the kernel does not say what it counted.
    pub fn begin(&mut self) -> io::Result<()> {
        let discarded = (0..self.frame_count()).take_while(|_| self.next_packet(|_| ()));
        self.discarded_count += discarded.count() as u64;
        // Read when the ring has room again. What came since then is in it, and counts: hence the sum,
        // and not what was matched until now.
        let dropped_count = self.counted()?.dropped_count;
        self.before = RingCounters {
            matched_count: self.discarded_count + dropped_count,
            dropped_count,
        };
        self.steps_before = self.stepped();
        Ok(())
    }

    /// What was counted since the account began.
    ///
    /// # Errors
    /// When the kernel does not say.
    pub fn counters(&mut self) -> io::Result<RingCounters> {
        let counted = self.counted()?;
        Ok(RingCounters {
            matched_count: counted.matched_count - self.before.matched_count,
            dropped_count: counted.dropped_count - self.before.dropped_count,
        })
    }

    fn counted(&mut self) -> io::Result<RingCounters> {
        match &mut self.engine {
            Engine::Packet(ring) => ring.counters(),
            Engine::Bpf(tap) => Ok(tap.counters()),
        }
    }

    /// See [`BpfTap::earlier_program_count`]; 0 for a packet ring, which looks behind all of them.
    pub fn earlier_program_count(&self) -> u32 {
        match &self.engine {
            Engine::Packet(_) => 0,
            Engine::Bpf(tap) => tap.earlier_program_count(),
        }
    }

    /// See [`BpfTap::step_count`], since the account began; 0 for a packet ring, which reads no other
    /// clock.
    pub fn step_count(&self) -> u64 {
        self.stepped() - self.steps_before
    }

    fn stepped(&self) -> u64 {
        match &self.engine {
            Engine::Packet(_) => 0,
            Engine::Bpf(tap) => tap.step_count(),
        }
    }
}
