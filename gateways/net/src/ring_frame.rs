//! One frame of a packet ring (`TPACKET_V2`): where the kernel puts the packet, its time, and who gave
//! that time. It reads bytes; whose turn it is, is the ring's business.

use super::Direction;

/// Who stamped a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampSource {
    /// The network card, on its own clock.
    Card,
    /// The kernel as the packet came or left, on the system clock.
    Stack,
    /// The tap when it saw the packet, some hundred nanoseconds later, on the system clock.
    Tap,
}

/// A packet in the ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RingPacket<'a> {
    /// Nanoseconds of the clock that `source` says; on the system clock since 1970.
    pub stamp_ns: u64,
    /// Who gave that time.
    pub source: StampSource,
    /// Which way.
    pub direction: Direction,
    /// Length on the wire, without a VLAN tag that was taken out.
    pub original_bytes: u32,
    /// A VLAN tag that the kernel took out behind the addresses: type and tag.
    pub vlan: Option<(u16, u16)>,
    /// What was kept, from the link layer on.
    pub data: &'a [u8],
}

/// Offsets within `struct tpacket2_hdr`.
mod at {
    use core::mem::offset_of;
    use libc::{sockaddr_ll, tpacket2_hdr as header};

    pub(super) const LENGTH: usize = offset_of!(header, tp_len);
    pub(super) const KEPT: usize = offset_of!(header, tp_snaplen);
    pub(super) const PACKET: usize = offset_of!(header, tp_mac);
    pub(super) const SECONDS: usize = offset_of!(header, tp_sec);
    pub(super) const NANOSECONDS: usize = offset_of!(header, tp_nsec);
    pub(super) const VLAN_TAG: usize = offset_of!(header, tp_vlan_tci);
    pub(super) const VLAN_TYPE: usize = offset_of!(header, tp_vlan_tpid);
    /// The link address lies behind the aligned header.
    pub(super) const WAY: usize =
        size_of::<header>().next_multiple_of(16) + offset_of!(sockaddr_ll, sll_pkttype);
}

impl<'a> RingPacket<'a> {
    /// Reads a whole frame with the status that handed it over.
    ///
    /// # Panics
    /// When the kernel places a packet outside its frame, or the frame is shorter than its header.
    pub(super) fn read(frame: &'a [u8], status: u32) -> Self {
        let has = |bit: u32| status & bit != 0;
        let (from, length) = (
            usize::from(u16_at(frame, at::PACKET)),
            u32_at(frame, at::KEPT) as usize,
        );
        let data = frame.get(from..from + length).unwrap_or_else(|| {
            let there = frame.len();
            panic!("packet at {from} of {length} bytes in a frame of {there}")
        });
        let (seconds, rest_ns) = (u32_at(frame, at::SECONDS), u32_at(frame, at::NANOSECONDS));
        Self {
            stamp_ns: u64::from(seconds) * 1_000_000_000 + u64::from(rest_ns),
            source: if has(libc::TP_STATUS_TS_RAW_HARDWARE) {
                StampSource::Card
            } else if has(libc::TP_STATUS_TS_SOFTWARE) {
                StampSource::Stack
            } else {
                StampSource::Tap
            },
            direction: match frame[at::WAY] {
                libc::PACKET_OUTGOING => Direction::Outbound,
                _ => Direction::Inbound,
            },
            original_bytes: u32_at(frame, at::LENGTH),
            vlan: has(libc::TP_STATUS_VLAN_VALID).then(|| {
                let is_typed = has(libc::TP_STATUS_VLAN_TPID_VALID);
                let tag_type = if is_typed {
                    u16_at(frame, at::VLAN_TYPE)
                } else {
                    0x8100
                };
                (tag_type, u16_at(frame, at::VLAN_TAG))
            }),
            data,
        }
    }
}

fn u16_at(frame: &[u8], offset: usize) -> u16 {
    u16::from_ne_bytes([frame[offset], frame[offset + 1]])
}

fn u32_at(frame: &[u8], offset: usize) -> u32 {
    let bytes = [0, 1, 2, 3].map(|index| frame[offset + index]);
    u32::from_ne_bytes(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const USER: u32 = libc::TP_STATUS_USER;
    const PACKET_AT: usize = 82;

    /// A frame as the kernel lays it out, with `packet` in it.
    fn frame(packet: &[u8], way: u8) -> Vec<u8> {
        let mut bytes = vec![0; 256];
        let mut put = |offset: usize, value: &[u8]| {
            bytes[offset..offset + value.len()].copy_from_slice(value);
        };
        let length = u32::try_from(packet.len()).unwrap();
        put(4, &(length + 1000).to_ne_bytes());
        put(8, &length.to_ne_bytes());
        put(12, &u16::try_from(PACKET_AT).unwrap().to_ne_bytes());
        put(16, &1_795_338_139_u32.to_ne_bytes());
        put(20, &876_353_805_u32.to_ne_bytes());
        put(24, &0x2007_u16.to_ne_bytes());
        put(26, &0x88a8_u16.to_ne_bytes());
        put(32 + 10, &[way]);
        put(PACKET_AT, packet);
        bytes
    }

    #[test]
    fn each_packet_says_who_stamped_it() {
        let bytes = frame(b"packet", libc::PACKET_HOST);
        for (status, source) in [
            (USER | libc::TP_STATUS_TS_RAW_HARDWARE, StampSource::Card),
            (USER | libc::TP_STATUS_TS_SOFTWARE, StampSource::Stack),
            (USER, StampSource::Tap),
        ] {
            let packet = RingPacket::read(&bytes, status);
            assert_eq!(packet.source, source);
            assert_eq!(packet.stamp_ns, 1_795_338_139_876_353_805);
            assert_eq!(packet.data, b"packet");
            assert_eq!(packet.original_bytes, 1006);
            assert_eq!(packet.vlan, None);
        }
    }

    #[test]
    fn direction_and_vlan_tag_are_the_kernels() {
        let tagged = USER | libc::TP_STATUS_VLAN_VALID;
        let typed = tagged | libc::TP_STATUS_VLAN_TPID_VALID;
        let bytes = frame(b"p", libc::PACKET_OUTGOING);
        let packet = RingPacket::read(&bytes, typed);
        assert_eq!(packet.direction, Direction::Outbound);
        assert_eq!(packet.vlan, Some((0x88a8, 0x2007)));
        let untyped = RingPacket::read(&bytes, tagged);
        assert_eq!(untyped.vlan, Some((0x8100, 0x2007)));
        let bytes = frame(b"p", libc::PACKET_OTHERHOST);
        assert_eq!(RingPacket::read(&bytes, USER).direction, Direction::Inbound);
    }

    #[test]
    #[should_panic(expected = "packet at 82 of 300 bytes in a frame of 256")]
    fn a_packet_beyond_its_frame_is_refused() {
        let mut bytes = frame(b"p", libc::PACKET_HOST);
        bytes[8..12].copy_from_slice(&300_u32.to_ne_bytes());
        let _packet = RingPacket::read(&bytes, USER);
    }
}
