//! The memory between a tap's eBPF program and the process that reads it: a ring of slots of one size.
//! It knows words and their order, no kernel and no packet.
//!
//! The program draws a number (`HEAD` grows by one), fills the slot of that number and writes its state
//! last: the number plus one, different in every lap. The reader takes slots in the order of their
//! numbers, copies, and says in `TAIL` how far it is. Where fewer than a margin of slots is free, the
//! program draws no number but counts in `DROPPED`; the margin is larger than the number of programs
//! that can be between looking and drawing at once, so that no slot is written while it is read.

use core::sync::atomic::{AtomicU64, Ordering};

use crate::capture::Direction;

/// Offsets from the beginning, bytes. What the program writes and what the reader writes lie on cache
/// lines of their own, two apart because processors fetch them in pairs.
pub(super) mod at {
    pub(in super::super) const HEAD: u16 = 0;
    pub(in super::super) const DROPPED: u16 = 8;
    pub(in super::super) const TAIL: u16 = 256;
    pub(in super::super) const SLOTS: u16 = 512;
}

/// Offsets within a slot, bytes.
pub(super) mod slot {
    pub(in super::super) const STATE: u16 = 0;
    /// Nanoseconds.
    pub(in super::super) const STAMP: u16 = 8;
    /// Length on the wire, `u32`.
    pub(in super::super) const LENGTH: u16 = 16;
    /// Bytes kept, `u32`.
    pub(in super::super) const KEPT: u16 = 20;
    /// See [`super::flag`], `u32`.
    pub(in super::super) const FLAGS: u16 = 24;
    /// Type of the tag in network byte order, `u16`.
    pub(in super::super) const VLAN_TYPE: u16 = 28;
    /// The tag, `u16`.
    pub(in super::super) const VLAN_TAG: u16 = 30;
    pub(in super::super) const DATA: u16 = 32;
}

/// What the flags of a slot say.
pub(super) mod flag {
    pub(in super::super) const OUTBOUND: u32 = 1;
    /// The stamp is the stack's, of `CLOCK_REALTIME`; otherwise the program's, of `CLOCK_TAI`.
    pub(in super::super) const STACK_STAMP: u32 = 2;
    /// A tag was taken out of the packet.
    pub(in super::super) const TAGGED: u32 = 4;
}

const WORD_BYTES: usize = 8;
const LINE_BYTES: usize = 64;
/// A reader gives room back at least as often as once in this part of a lap.
const GIVEN_BACK_PART: u64 = 8;

/// How the memory is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) snap_bytes: usize,
    pub(super) slot_bytes: usize,
    /// A power of two.
    pub(super) slot_count: usize,
    /// Slots that stay free.
    pub(super) margin: usize,
}

impl Shape {
    /// As many slots as fit into `ring_bytes`, but at least twice the margin.
    pub(super) fn new(snap_bytes: usize, ring_bytes: usize, margin: usize) -> Self {
        let slot_bytes = (usize::from(slot::DATA) + snap_bytes).next_multiple_of(LINE_BYTES);
        let fitting = (ring_bytes / slot_bytes).max(1);
        let power = 1 << fitting.ilog2();
        Self {
            snap_bytes,
            slot_bytes,
            slot_count: power.max((2 * margin).next_power_of_two()),
            margin,
        }
    }

    /// Slots that can be filled before one is given back.
    pub(super) const fn room(&self) -> usize {
        self.slot_count - self.margin
    }

    pub(super) fn memory_bytes(&self) -> usize {
        usize::from(at::SLOTS) + self.slot_count * self.slot_bytes
    }

    /// Word at which the slot of a number begins.
    fn slot_word(&self, number: u64) -> usize {
        let lap = self.slot_count as u64;
        let index = usize::try_from(number % lap).expect("less than the count of slots");
        (usize::from(at::SLOTS) + index * self.slot_bytes) / WORD_BYTES
    }
}

/// What was in a slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Record<'a> {
    pub(super) stamp_ns: u64,
    pub(super) is_stack_stamp: bool,
    pub(super) direction: Direction,
    pub(super) original_bytes: u32,
    pub(super) vlan: Option<(u16, u16)>,
    pub(super) data: &'a [u8],
}

/// The reading end.
#[derive(Debug)]
pub(super) struct TapReader {
    shape: Shape,
    next: u64,
    given_back: u64,
    data: Vec<u8>,
}

impl TapReader {
    pub(super) fn new(shape: Shape) -> Self {
        Self {
            shape,
            next: 0,
            given_back: 0,
            data: Vec::with_capacity(shape.snap_bytes + WORD_BYTES),
        }
    }

    /// The next record; `None` when there is none or it is still being written.
    ///
    /// # Panics
    /// When a slot holds more than fits into it.
    pub(super) fn take(&mut self, words: &[AtomicU64]) -> Option<Record<'_>> {
        let first = self.shape.slot_word(self.next);
        // Acquire: the state is written last, all else is there when it is.
        if words[first].load(Ordering::Acquire) != self.next + 1 {
            self.give_back(words);
            return None;
        }
        let word = |offset: u16| {
            let at = first + usize::from(offset) / WORD_BYTES;
            words[at].load(Ordering::Relaxed).to_ne_bytes()
        };
        let (stamp, lengths, marks) = (word(slot::STAMP), word(slot::LENGTH), word(slot::FLAGS));
        let original_bytes = u32_in(lengths, slot::LENGTH);
        let kept = u32_in(lengths, slot::KEPT) as usize;
        let snap_bytes = self.shape.snap_bytes;
        assert!(
            kept <= snap_bytes,
            "a slot says {kept} bytes, {snap_bytes} fit"
        );
        self.data.clear();
        let from = first + usize::from(slot::DATA) / WORD_BYTES;
        for one in &words[from..from + kept.div_ceil(WORD_BYTES)] {
            let bytes = one.load(Ordering::Relaxed).to_ne_bytes();
            self.data.extend_from_slice(&bytes);
        }
        self.data.truncate(kept);
        self.next += 1;
        // Copied, so the room may go back; seldom, as the program reads that line as well.
        if self.next - self.given_back >= self.shape.slot_count as u64 / GIVEN_BACK_PART {
            self.give_back(words);
        }
        let flags = u32_in(marks, slot::FLAGS);
        let half = |offset: u16| {
            let within = usize::from(offset) % WORD_BYTES;
            [marks[within], marks[within + 1]]
        };
        Some(Record {
            stamp_ns: u64::from_ne_bytes(stamp),
            is_stack_stamp: flags & flag::STACK_STAMP != 0,
            direction: if flags & flag::OUTBOUND == 0 {
                Direction::Inbound
            } else {
                Direction::Outbound
            },
            original_bytes,
            vlan: (flags & flag::TAGGED != 0).then(|| {
                let tag_type = u16::from_be_bytes(half(slot::VLAN_TYPE));
                (tag_type, u16::from_ne_bytes(half(slot::VLAN_TAG)))
            }),
            data: &self.data,
        })
    }

    fn give_back(&mut self, words: &[AtomicU64]) {
        if self.given_back != self.next {
            self.given_back = self.next;
            // Release: the slots were read before.
            words[usize::from(at::TAIL) / WORD_BYTES].store(self.next, Ordering::Release);
        }
    }
}

/// Packets that got a slot, and packets that found none.
pub(super) fn counts(words: &[AtomicU64]) -> (u64, u64) {
    let read = |offset: u16| words[usize::from(offset) / WORD_BYTES].load(Ordering::Relaxed);
    (read(at::HEAD), read(at::DROPPED))
}

fn u32_in(word: [u8; WORD_BYTES], offset: u16) -> u32 {
    let within = usize::from(offset) % WORD_BYTES;
    u32::from_ne_bytes([0, 1, 2, 3].map(|index| word[within + index]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = Shape {
        snap_bytes: 70,
        slot_bytes: 128,
        slot_count: 8,
        margin: 2,
    };

    /// Made-up memory, and what the program does with it.
    struct Memory(Vec<AtomicU64>);

    impl Memory {
        fn new() -> Self {
            let count = SHAPE.memory_bytes() / WORD_BYTES;
            Self((0..count).map(|_| AtomicU64::new(0)).collect())
        }

        fn at(&self, offset: u16) -> &AtomicU64 {
            &self.0[usize::from(offset) / WORD_BYTES]
        }

        fn head(&self) -> u64 {
            self.at(at::HEAD).load(Ordering::SeqCst)
        }

        /// Draws a number, or counts a drop, by the `head` that was read before.
        fn draw_after(&self, head: u64) -> Option<u64> {
            let tail = self.at(at::TAIL).load(Ordering::SeqCst);
            let filled = head.wrapping_sub(tail).cast_signed();
            if filled >= i64::try_from(SHAPE.room()).unwrap() {
                self.at(at::DROPPED).fetch_add(1, Ordering::SeqCst);
                return None;
            }
            Some(self.at(at::HEAD).fetch_add(1, Ordering::SeqCst))
        }

        fn draw(&self) -> Option<u64> {
            self.draw_after(self.head())
        }

        fn put(&self, number: u64, offset: u16, bytes: &[u8]) {
            let first = SHAPE.slot_word(number) + usize::from(offset) / WORD_BYTES;
            for (index, chunk) in bytes.chunks(WORD_BYTES).enumerate() {
                let mut word = [0; WORD_BYTES];
                word[..chunk.len()].copy_from_slice(chunk);
                self.0[first + index].store(u64::from_ne_bytes(word), Ordering::SeqCst);
            }
        }

        fn fill(&self, number: u64, flags: u32, data: &[u8]) {
            let kept = u32::try_from(data.len()).unwrap();
            self.put(number, slot::STAMP, &(1000 + number).to_ne_bytes());
            let lengths = [(kept + 500).to_ne_bytes(), kept.to_ne_bytes()].concat();
            self.put(number, slot::LENGTH, &lengths);
            let mut marks = flags.to_ne_bytes().to_vec();
            marks.extend(0x88a8_u16.to_be_bytes());
            marks.extend(0x2007_u16.to_ne_bytes());
            self.put(number, slot::FLAGS, &marks);
            self.put(number, slot::DATA, data);
        }

        fn publish(&self, number: u64) {
            self.put(number, slot::STATE, &(number + 1).to_ne_bytes());
        }

        fn write(&self, flags: u32, data: &[u8]) -> bool {
            let Some(number) = self.draw() else {
                return false;
            };
            self.fill(number, flags, data);
            self.publish(number);
            true
        }
    }

    #[test]
    fn a_record_comes_out_as_it_went_in() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        assert_eq!(reader.take(&memory.0), None);
        let data: Vec<u8> = (0..70).collect();
        assert!(memory.write(flag::OUTBOUND, &data));
        assert!(memory.write(flag::STACK_STAMP | flag::TAGGED, &data[..13]));
        let first = Record {
            stamp_ns: 1000,
            is_stack_stamp: false,
            direction: Direction::Outbound,
            original_bytes: 570,
            vlan: None,
            data: &data,
        };
        assert_eq!(reader.take(&memory.0), Some(first));
        let second = Record {
            stamp_ns: 1001,
            is_stack_stamp: true,
            direction: Direction::Inbound,
            original_bytes: 513,
            vlan: Some((0x88a8, 0x2007)),
            data: &data[..13],
        };
        assert_eq!(reader.take(&memory.0), Some(second));
        assert_eq!(reader.take(&memory.0), None);
    }

    #[test]
    fn a_slot_that_is_being_written_is_waited_for_and_nothing_passes_it() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        let slow = memory.draw().unwrap();
        assert!(memory.write(0, b"second"));
        assert_eq!(reader.take(&memory.0), None, "nothing written yet");
        memory.fill(slow, 0, b"first");
        assert_eq!(reader.take(&memory.0), None, "the state is missing");
        memory.publish(slow);
        assert_eq!(reader.take(&memory.0).unwrap().data, b"first");
        assert_eq!(reader.take(&memory.0).unwrap().data, b"second");
    }

    #[test]
    fn laps_do_not_take_an_old_state_for_a_new_one() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        for number in 0_u64..1000 {
            let slow = memory.draw().expect("room, as all was read");
            assert_eq!(reader.take(&memory.0), None, "the slot of a lap before");
            memory.fill(slow, 0, &number.to_ne_bytes());
            memory.publish(slow);
            let taken = reader.take(&memory.0).unwrap();
            assert_eq!(taken.data, number.to_ne_bytes());
        }
        assert_eq!(counts(&memory.0), (1000, 0));
    }

    #[test]
    fn what_finds_no_room_is_counted_and_the_rest_stays_whole() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        let written: Vec<bool> = (0_u8..9).map(|one| memory.write(0, &[one])).collect();
        let kept = SHAPE.room();
        assert!(written[..kept].iter().all(|is| *is));
        assert!(written[kept..].iter().all(|is| !is));
        assert_eq!(counts(&memory.0), (6, 3));
        for one in 0_u8..6 {
            assert_eq!(reader.take(&memory.0).unwrap().data, [one]);
        }
        assert_eq!(reader.take(&memory.0), None);
        assert!(memory.write(0, b"room again"));
        assert_eq!(reader.take(&memory.0).unwrap().data, b"room again");
    }

    #[test]
    fn a_program_that_the_reader_has_passed_finds_room() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        let head = memory.head();
        // Held there, while others fill the ring and it is emptied, twice.
        for _ in 0..2 {
            while memory.write(0, b"other") {}
            while reader.take(&memory.0).is_some() {}
        }
        let dropped_before = counts(&memory.0).1;
        let number = memory.draw_after(head).expect("the ring is empty");
        memory.fill(number, 0, b"held");
        memory.publish(number);
        assert_eq!(reader.take(&memory.0).unwrap().data, b"held");
        assert_eq!(counts(&memory.0).1, dropped_before);
    }

    #[test]
    fn a_ring_is_never_smaller_than_its_margin_needs() {
        let small = Shape::new(65_536, 1 << 16, 64);
        assert_eq!((small.slot_count, small.room()), (128, 64));
        let usual = Shape::new(158, 8 << 20, 64);
        assert_eq!((usual.slot_bytes, usual.slot_count), (192, 32_768));
        assert!(usual.memory_bytes() <= (8 << 20) + usize::from(at::SLOTS));
    }

    #[test]
    #[should_panic(expected = "a slot says 71 bytes, 70 fit")]
    fn a_slot_with_more_than_fits_is_refused() {
        let (memory, mut reader) = (Memory::new(), TapReader::new(SHAPE));
        assert!(memory.write(0, &[0; 71]));
        let _record = reader.take(&memory.0);
    }
}
