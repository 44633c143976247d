//! The header by which the Beckhoff ET2000 tells at which of its ports a frame was seen, and when:
//! the `EtherCAT` switch link. 16 bytes in front of the Ethernet frame or behind it, before no frame
//! check sequence:
//!
//! | offset | bytes | field |
//! |-------:|------:|-------|
//! | 0 | 6 | cookie `01 01 05 10 00 00`, fourth byte also `11` |
//! | 6 | 2 | flags, little-endian, see [`FLAG_BITS`] |
//! | 8 | 8 | time stamp, little-endian, 1 ns, the device's own clock |
//!
//! The layout is that of Wireshark's `plugins/epan/ethercat/packet-esl.c` (Beckhoff, 2007), whose
//! dissector is off until `--enable-heuristic esl_eth` or *Enabled Protocols* switches it on. It
//! gives a frame with several port bits to the lowest port, and so do we. Its stamps start at any
//! value: two ports of one device can be subtracted, a port and a PC cannot.

use super::bytes::array_at;

/// Bytes of the header.
pub const HEADER_BYTES: usize = 16;
/// Ports of a device that the flags can name.
pub const PORT_COUNT: u8 = 12;
/// Flag bit: frame check sequence wrong.
pub const CRC_ERROR: u16 = 0x1000;
/// Flag bit: no whole number of bytes.
pub const ALIGNMENT_ERROR: u16 = 0x0800;
/// Flag bit: the stamp is valid.
pub const STAMP_ENABLED: u16 = 0x2000;
/// The flag bit of each port, by its number.
pub const FLAG_BITS: [u16; PORT_COUNT as usize] = [
    0x0080, 0x0040, 0x0020, 0x0010, 0x0008, 0x0004, 0x0002, 0x0001, 0x8000, 0x4000, 0x0400, 0x0200,
];

/// What the header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EslHeader {
    /// Port bits and errors.
    pub flags: u16,
    /// Nanoseconds on the device's clock.
    pub stamp_ns: u64,
}

impl EslHeader {
    /// The lowest port named; `None` when none is.
    pub fn port(&self) -> Option<u8> {
        (0..PORT_COUNT).find(|port| self.flags & FLAG_BITS[usize::from(*port)] != 0)
    }

    /// How many ports are named: one, unless the file is not what it seems.
    pub fn port_count(&self) -> usize {
        let named = FLAG_BITS.iter().filter(|bit| self.flags & **bit != 0);
        named.count()
    }

    /// True when the device counted the frame as damaged.
    pub const fn is_damaged(&self) -> bool {
        self.flags & (CRC_ERROR | ALIGNMENT_ERROR) != 0
    }

    /// The header as bytes.
    pub fn encode(&self) -> [u8; HEADER_BYTES] {
        let mut bytes = [0; HEADER_BYTES];
        bytes[..6].copy_from_slice(&[0x01, 0x01, 0x05, 0x10, 0x00, 0x00]);
        bytes[6..8].copy_from_slice(&self.flags.to_le_bytes());
        bytes[8..].copy_from_slice(&self.stamp_ns.to_le_bytes());
        bytes
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        let cookie: [u8; 6] = array_at(bytes, 0)?;
        if !matches!(cookie, [0x01, 0x01, 0x05, 0x10 | 0x11, 0x00, 0x00]) {
            return None;
        }
        Some(Self {
            flags: u16::from_le_bytes(array_at(bytes, 6)?),
            stamp_ns: u64::from_le_bytes(array_at(bytes, 8)?),
        })
    }
}

/// The header of a frame and the frame without it; `None` for a frame that has none. A frame that
/// the capture cut short cannot show a header behind it.
pub fn split(frame: &[u8]) -> Option<(EslHeader, &[u8])> {
    if let Some(header) = EslHeader::decode(frame) {
        return Some((header, &frame[HEADER_BYTES..]));
    }
    let at = frame.len().checked_sub(HEADER_BYTES)?;
    EslHeader::decode(&frame[at..]).map(|header| (header, &frame[..at]))
}
