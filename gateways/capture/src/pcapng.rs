//! The pcapng file: blocks of a type, a length, a body and the length again
//! (draft-ietf-opsawg-pcapng). Section, interface, packet, simple packet and statistics blocks are
//! read; blocks of other types are passed over, as the draft asks.

use super::bytes::{ByteOrder, Numbers, array_at};
use super::reader::{Found, Next, Window};
use super::{CaptureInterface, Problem, Span};
use hil_net::Direction;

pub(super) const SECTION: u32 = 0x0a0d_0d0a;
pub(super) const INTERFACE: u32 = 1;
const OBSOLETE_PACKET: u32 = 2;
const SIMPLE_PACKET: u32 = 3;
pub(super) const STATISTICS: u32 = 5;
pub(super) const ENHANCED_PACKET: u32 = 6;
pub(super) const BYTE_ORDER_MAGIC: u32 = 0x1a2b_3c4d;
const BLOCK_BYTES_MIN: u32 = 12;
/// Largest block taken for one; the same as Wireshark's.
const BLOCK_BYTES_MAX: u32 = 16 * 1024 * 1024;
/// Interfaces a file may describe; a broken one could claim any number.
const INTERFACE_COUNT_MAX: usize = 4096;
/// Of a packet's flags: wrong check sequence, too long, too short, unaligned, wrong delimiter, preamble or symbol.
/// The gap before it, which may be wrong too (bit 27), damages nothing.
const DAMAGED: u32 = 0xf700_0000;
const SECTION_BODY_BYTES: u64 = 16;

/// Where in the file the reader is.
#[derive(Debug, Default)]
pub(super) struct PcapngFile {
    order: Option<ByteOrder>,
    /// First of this section's interfaces.
    interface_base: usize,
    /// This section was written by mergecap.
    is_merged: bool,
    /// Where the next section begins, if this one says.
    section_end: Option<u64>,
}

impl PcapngFile {
    pub(super) fn next(&mut self, window: &Window, interfaces: &mut Vec<CaptureInterface>) -> Next {
        let bytes = window.bytes();
        if bytes.is_empty() {
            return Next::NeedsMore;
        }
        if bytes.len() < BLOCK_BYTES_MIN as usize {
            return window.needs("a block", BLOCK_BYTES_MIN.into());
        }
        // A section says the order of its numbers.
        if array_at(bytes, 0) == Some(SECTION.to_be_bytes()) {
            self.order = match array_at(bytes, 8).map(u32::from_le_bytes) {
                Some(BYTE_ORDER_MAGIC) => Some(ByteOrder::Little),
                Some(other) if other.swap_bytes() == BYTE_ORDER_MAGIC => Some(ByteOrder::Big),
                _ => return self.lost(window, Problem::Malformed("no byte-order magic")),
            };
        }
        let Some(order) = self.order else {
            let problem = Problem::Malformed("a block before the first section");
            return self.lost(window, problem);
        };
        let block = Numbers { order, bytes };
        let (Some(kind), Some(length)) = (block.u32(0), block.u32(4)) else {
            return window.needs("a block", BLOCK_BYTES_MIN.into());
        };
        let is_sound = (BLOCK_BYTES_MIN..=BLOCK_BYTES_MAX).contains(&length);
        if !is_sound || !length.is_multiple_of(4) {
            let problem = Problem::Length {
                what: "a block's length (a multiple of 4)",
                length: length.into(),
                min: BLOCK_BYTES_MIN.into(),
                max: BLOCK_BYTES_MAX.into(),
            };
            return self.lost(window, problem);
        }
        if bytes.len() < length as usize {
            return window.needs("a block", length.into());
        }
        let second = block.u32(length as usize - 4).unwrap_or(0);
        if second != length {
            let first = length;
            return self.lost(window, Problem::LengthsDiffer { first, second });
        }
        let body = block.part(&bytes[8..length as usize - 4]);
        let length = u64::from(length);
        let base = self.interface_base;
        let outcome = match kind {
            SECTION => return self.section(window, body, interfaces.len(), length),
            INTERFACE => describe(body, interfaces, base, self.is_merged).map(|()| None),
            ENHANCED_PACKET | OBSOLETE_PACKET | SIMPLE_PACKET => {
                packet(kind, body, interfaces, base).map(Some)
            }
            STATISTICS => statistics(body, interfaces, base).map(|()| None),
            _ => Ok(None),
        };
        match outcome {
            Ok(Some(found)) => Next::Packet(found, length),
            Ok(None) => Next::Passed(length),
            Err(problem) => Next::Fault(problem, Some(length)),
        }
    }

    fn section(
        &mut self,
        window: &Window,
        body: Numbers<'_>,
        interface_count: usize,
        length: u64,
    ) -> Next {
        let fields = (body.u16(4), body.u16(6), body.u64(8));
        let (Some(major), Some(minor), Some(section_bytes)) = fields else {
            let problem = Problem::Length {
                what: "a section header's body",
                length: body.bytes.len() as u64,
                min: SECTION_BODY_BYTES,
                max: BLOCK_BYTES_MAX.into(),
            };
            return self.lost(window, problem);
        };
        self.interface_base = interface_count;
        self.is_merged = false;
        // Of options that are broken, those before the fault; the section can be read all the same.
        let _passed_over = body.options(16, |code, value| {
            self.is_merged |= code == 4 && value.starts_with(b"Mergecap");
            Ok(())
        });
        // A negative length is one that the writer did not know.
        let is_known = section_bytes.cast_signed() >= 0;
        let end = window.offset.checked_add(length).filter(|_| is_known);
        self.section_end = end.and_then(|end| end.checked_add(section_bytes));
        if major != 1 {
            return self.lost(window, Problem::Version { major, minor });
        }
        Next::Passed(length)
    }

    /// The next block cannot be found from this one: go on at the next section, if it is known.
    fn lost(&self, window: &Window, problem: Problem) -> Next {
        let end = self.section_end.filter(|end| *end > window.offset);
        Next::Fault(problem, end.map(|end| end - window.offset))
    }
}

impl<'a> Numbers<'a> {
    const fn part(self, bytes: &'a [u8]) -> Self {
        Self { bytes, ..self }
    }

    /// A stamp as two halves, the upper first, in either byte order.
    fn stamp(self, offset: usize) -> Option<u64> {
        let (high, low) = (self.u32(offset)?, self.u32(offset + 4)?);
        Some(u64::from(high) << 32 | u64::from(low))
    }

    /// Calls `take` with code and value of each option from `offset` to the end mark.
    fn options(
        self,
        offset: usize,
        mut take: impl FnMut(u16, &'a [u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let mut at = offset;
        while at < self.bytes.len() {
            let (Some(code), Some(length)) = (self.u16(at), self.u16(at + 2)) else {
                return Err(Problem::Malformed("an option is cut short"));
            };
            if code == 0 {
                break;
            }
            let end = at + 4 + usize::from(length);
            let Some(value) = self.bytes.get(at + 4..end) else {
                return Err(Problem::Malformed("an option is longer than its block"));
            };
            take(code, value)?;
            at = end.next_multiple_of(4);
        }
        Ok(())
    }
}

fn describe(
    body: Numbers<'_>,
    interfaces: &mut Vec<CaptureInterface>,
    base: usize,
    is_merged: bool,
) -> Result<(), Problem> {
    const SHORT: Problem = Problem::Malformed("an interface block shorter than 8 bytes");
    let link_type = body.u16(0).ok_or(SHORT)?;
    let snap_bytes = body.u32(4).ok_or(SHORT)?;
    if interfaces.len() >= INTERFACE_COUNT_MAX {
        return Err(Problem::Malformed("more than 4096 interfaces"));
    }
    let mut interface = CaptureInterface {
        link_type,
        snap_bytes,
        unit_ns: (1000, 1),
        is_merged,
        ..CaptureInterface::default()
    };
    let outcome = body.options(8, |code, value| {
        match (code, value) {
            (2, name) => interface.name = Some(String::from_utf8_lossy(name).into_owned()),
            (3, text) => interface.description = Some(String::from_utf8_lossy(text).into_owned()),
            (11, value) => interface.filter = filter(value),
            (9, &[resolution]) => interface.unit_ns = unit_ns(resolution)?,
            (14, seconds) => {
                let seconds = body.part(seconds).u64(0).map(u64::cast_signed);
                let offset_ns = seconds.and_then(|s| s.checked_mul(1_000_000_000));
                interface.offset_ns = offset_ns.ok_or(Problem::Malformed(
                    "if_tsoffset does not fit into nanoseconds",
                ))?;
            }
            (9, _) => return Err(Problem::Malformed("if_tsresol is not one byte long")),
            _ => {}
        }
        Ok(())
    });
    // A rotated or joined file describes its interfaces again in each section.
    let place = interfaces.len() - base;
    let is_same = |(index, known): &(usize, &CaptureInterface)| {
        known.link_type == link_type
            && known.name == interface.name
            && known.description == interface.description
            && (known.name.is_some() || *index == place)
            && interfaces[base..]
                .iter()
                .all(|one| one.repeats != Some(*index))
    };
    let mut earlier = interfaces[..base].iter().enumerate();
    let first = earlier
        .find(is_same)
        .map(|(index, known)| known.repeats.unwrap_or(index));
    interface.repeats = first;
    // The interface keeps its number also when an option is broken.
    interfaces.push(interface);
    outcome
}

/// What `if_filter` says: a text behind a 0, or instructions. Some writers leave out what tells which.
fn filter(value: &[u8]) -> Option<String> {
    let text = match value.split_first()? {
        (0, text) => text,
        (b' '.., _) => value,
        _ => return Some("compiled".to_owned()),
    };
    Some(
        String::from_utf8_lossy(text)
            .trim_end_matches('\0')
            .to_owned(),
    )
}

/// Nanoseconds to a unit, as a fraction: `if_tsresol` holds a negative power of 10, or of 2 with its
/// top bit set.
fn unit_ns(resolution: u8) -> Result<(u64, u64), Problem> {
    let exponent = u32::from(resolution & 0x7f);
    let base: u64 = if resolution & 0x80 == 0 { 10 } else { 2 };
    let denominator = base
        .checked_pow(exponent)
        .ok_or(Problem::Malformed("if_tsresol is finer than 64 bits hold"))?;
    Ok((1_000_000_000, denominator))
}

/// Nanoseconds since 1970.
fn in_ns(units: u64, interface: &CaptureInterface) -> Result<i64, Problem> {
    let ns = scaled(units, interface.unit_ns);
    ns.and_then(|ns| ns.checked_add(interface.offset_ns))
        .ok_or(Problem::Stamp { units })
}

fn scaled(units: u64, (numerator, denominator): (u64, u64)) -> Option<i64> {
    let ns = u128::from(units) * u128::from(numerator) / u128::from(denominator);
    i64::try_from(ns).ok()
}

fn packet(
    kind: u32,
    body: Numbers<'_>,
    interfaces: &mut [CaptureInterface],
    base: usize,
) -> Result<Found, Problem> {
    const SHORT: Problem = Problem::Malformed("a packet block shorter than its fixed part");
    let index = match kind {
        ENHANCED_PACKET => body.u32(0).ok_or(SHORT)?,
        OBSOLETE_PACKET => body.u16(0).ok_or(SHORT)?.into(),
        _ => 0,
    };
    let count = interfaces.len() - base;
    let described = interfaces[base..].get_mut(index as usize);
    let interface = described.ok_or(Problem::UnknownInterface { index, count })?;
    let interface_index = base + index as usize;
    // A simple packet block says only how long the packet was; snap length or block cut it.
    let (header_bytes, captured, original_bytes) = if kind == SIMPLE_PACKET {
        let original = body.u32(0).ok_or(SHORT)?;
        let limit = match interface.snap_bytes {
            0 => u32::MAX,
            snap_bytes => snap_bytes,
        };
        let there = u32::try_from(body.bytes.len() - 4).unwrap_or(u32::MAX);
        (4, original.min(limit).min(there), original)
    } else {
        (20, body.u32(12).ok_or(SHORT)?, body.u32(16).ok_or(SHORT)?)
    };
    let end = header_bytes + captured as usize;
    if body.bytes.len() < end {
        return Err(Problem::Length {
            what: "a packet's captured length",
            length: captured.into(),
            min: 0,
            max: (body.bytes.len() - header_bytes) as u64,
        });
    }
    let mut direction = Direction::Unknown;
    let mut is_damaged = false;
    let mut stamp_ns = None;
    // Between this packet and the one before; all ones where the writer did not know.
    let mut dropped_count = None;
    if kind == OBSOLETE_PACKET {
        let told = body.u16(2).filter(|count| *count != u16::MAX);
        dropped_count = told.map(u64::from);
    }
    if kind != SIMPLE_PACKET {
        body.options(end.next_multiple_of(4), |code, value| {
            let value = body.part(value);
            match code {
                2 => {
                    let flags = value.u32(0).unwrap_or(0);
                    is_damaged = flags & DAMAGED != 0;
                    direction = match flags & 3 {
                        1 => Direction::Inbound,
                        2 => Direction::Outbound,
                        _ => Direction::Unknown,
                    }
                }
                4 => dropped_count = known(value.u64(0)),
                _ => {}
            }
            Ok(())
        })?;
        stamp_ns = Some(in_ns(body.stamp(4).ok_or(SHORT)?, interface)?);
    }
    if let Some(count) = dropped_count {
        let before = interface.dropped_count.unwrap_or(0);
        interface.dropped_count = Some(before.saturating_add(count));
    }
    Ok(Found {
        interface_index,
        interface_number: None,
        stamp_ns,
        original_bytes,
        direction,
        is_damaged,
        data: 8 + header_bytes..8 + end,
    })
}

/// A count; all ones where the writer did not know it.
fn known(count: Option<u64>) -> Option<u64> {
    count.filter(|count| *count != u64::MAX)
}

fn statistics(
    body: Numbers<'_>,
    interfaces: &mut [CaptureInterface],
    base: usize,
) -> Result<(), Problem> {
    const SHORT: Problem = Problem::Malformed("a statistics block shorter than 12 bytes");
    let index = body.u32(0).ok_or(SHORT)?;
    let count = interfaces.len() - base;
    let interface = interfaces[base..].get_mut(index as usize);
    let interface = interface.ok_or(Problem::UnknownInterface { index, count })?;
    let (mut start, mut end) = (None, None);
    let (mut by_interface, mut by_system) = (None, None);
    body.options(12, |code, value| {
        let value = body.part(value);
        match (code, value.bytes.len()) {
            // 0 is not a time: the writer did not fill it in.
            (2, 8) => start = value.stamp(0).filter(|units| *units > 0),
            (3, 8) => end = value.stamp(0).filter(|units| *units > 0),
            (4, 8) => interface.received_count = known(value.u64(0)),
            // isb_ifdrop, the only one that dumpcap writes, and isb_osdrop: no room was left.
            (5, 8) => by_interface = known(value.u64(0)),
            (7, 8) => by_system = known(value.u64(0)),
            _ => {}
        }
        Ok(())
    })?;
    let dropped = [by_interface, by_system].into_iter().flatten();
    // Of the same drops that packet blocks may have told.
    let dropped_count = dropped.reduce(u64::saturating_add);
    interface.dropped_count = interface.dropped_count.max(dropped_count);
    let at = |units: u64, unit_ns| scaled(units, unit_ns)?.checked_add(interface.offset_ns);
    let watch = |unit_ns| {
        let first_ns = at(start?, unit_ns)?;
        let last_ns = at(end?, unit_ns)?;
        (first_ns <= last_ns).then_some(Span { first_ns, last_ns })
    };
    if start.is_some() && end.is_some() {
        interface.watch = [watch(interface.unit_ns), watch((1000, 1))];
    }
    Ok(())
}
