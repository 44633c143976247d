//! The instructions of a tap's eBPF program (Linux `Documentation/bpf/standardization/instruction-set.rst`),
//! put together here, so that neither a compiler nor a file of object code is needed. The filter is the
//! one that the packet ring gives the kernel as well ([`crate::capture::program`]), translated
//! instruction by instruction; what passes it is copied into the ring of [`super::tap_ring`]. It makes
//! words; loading them is the business of `bpf_call`.
//!
//! The program changes nothing: it ends with `TCX_NEXT`, as if it were not there. Little-endian
//! processors only, as the kernel's registers of an instruction lie the other way round elsewhere.

use std::collections::BTreeMap;

use super::tap_ring::{Shape, at, flag, slot};
use crate::capture::program::{Instruction as Classic, code as classic};

#[cfg(not(target_endian = "little"))]
compile_error!("the eBPF tap encodes instructions for little-endian processors");

/// Offsets within the kernel's `struct __sk_buff`.
pub(super) mod context {
    pub(in super::super) const LEN: i16 = 0;
    pub(in super::super) const VLAN_PRESENT: i16 = 20;
    pub(in super::super) const VLAN_TCI: i16 = 24;
    pub(in super::super) const VLAN_PROTO: i16 = 28;
    pub(in super::super) const DATA: i16 = 76;
    pub(in super::super) const DATA_END: i16 = 80;
    pub(in super::super) const TSTAMP: i16 = 152;
}

/// Numbers of the kernel's helper functions.
mod helper {
    pub(super) const SKB_LOAD_BYTES: i32 = 26;
    /// Since Linux 6.1.
    pub(super) const KTIME_GET_TAI_NS: i32 = 208;
}

/// Lets the next program decide, or the stack where there is none.
pub(super) const TCX_NEXT: i32 = -1;
/// The second half of a 64-bit load is an address within a map's value.
const PSEUDO_MAP_VALUE: u8 = 2;
const FETCH_AND_ADD: i32 = 0x01;
const ADD_ONLY: i32 = 0x00;
#[cfg(not(target_arch = "x86_64"))]
const EXCHANGE: i32 = 0xe1;

/// One instruction, laid out as the kernel's `bpf_insn`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Instruction {
    code: u8,
    /// Destination in the lower half, source in the upper.
    registers: u8,
    offset: i16,
    immediate: i32,
}

/// A register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum R {
    R0,
    R1,
    R2,
    R3,
    R4,
    R6 = 6,
    R7,
    R8,
    R9,
    /// The end of the stack.
    R10,
}
use R::{R0, R1, R2, R3, R4, R6, R7, R8, R9, R10};

/// Width of an access, as instructions have it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Width {
    Byte,
    Half,
    Word,
    Double,
}

impl Width {
    const fn bits(self) -> u8 {
        match self {
            Self::Word => 0x00,
            Self::Half => 0x08,
            Self::Byte => 0x10,
            Self::Double => 0x18,
        }
    }

    const fn bytes(self) -> i32 {
        match self {
            Self::Byte => 1,
            Self::Half => 2,
            Self::Word => 4,
            Self::Double => 8,
        }
    }
}

const fn op(code: u8, (to, from): (R, R), offset: i16, immediate: i32) -> Instruction {
    Instruction {
        code,
        registers: (to as u8) | ((from as u8) << 4),
        offset,
        immediate,
    }
}

const fn copy(to: R, from: R) -> Instruction {
    op(0xbf, (to, from), 0, 0)
}

/// The sign is carried into the upper half.
const fn set(to: R, value: i32) -> Instruction {
    op(0xb7, (to, R0), 0, value)
}

/// The upper half becomes zero.
const fn set_word(to: R, value: u32) -> Instruction {
    op(0xb4, (to, R0), 0, value.cast_signed())
}

const fn add(to: R, value: i32) -> Instruction {
    op(0x07, (to, R0), 0, value)
}

const fn add_register(to: R, from: R) -> Instruction {
    op(0x0f, (to, from), 0, 0)
}

const fn subtract_register(to: R, from: R) -> Instruction {
    op(0x1f, (to, from), 0, 0)
}

const fn load(width: Width, to: R, from: R, offset: i16) -> Instruction {
    op(0x61 | width.bits(), (to, from), offset, 0)
}

const fn store(width: Width, to: R, offset: i16, from: R) -> Instruction {
    op(0x63 | width.bits(), (to, from), offset, 0)
}

const fn atomic(operation: i32, to: R, offset: i16, from: R) -> Instruction {
    op(0xdb, (to, from), offset, operation)
}

const fn call(helper: i32) -> Instruction {
    op(0x85, (R0, R0), 0, helper)
}

const END: Instruction = op(0x95, (R0, R0), 0, 0);

/// Comparisons; the jump is taken when they hold.
mod when {
    pub(super) const ALWAYS: u8 = 0x05;
    pub(super) const ZERO: u8 = 0x15;
    pub(super) const NOT_ZERO: u8 = 0x55;
    /// Of signed numbers.
    pub(super) const AT_LEAST: u8 = 0x75;
    pub(super) const AT_MOST: u8 = 0xb5;
    pub(super) const BELOW: u8 = 0xa5;
    pub(super) const ABOVE_REGISTER: u8 = 0x2d;
    /// Of the lower 32 bits.
    pub(super) const EQUAL_WORD: u8 = 0x16;
    pub(super) const BITS_SET_WORD: u8 = 0x46;
}

/// A place to jump to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Label {
    /// An instruction of the filter.
    Filter(usize),
    /// Where its load goes on that met the end of the packet's first piece.
    Slow(usize),
    /// Behind that load.
    Loaded(usize),
    Accepted,
    NotOurs,
    NoRoom,
    Stamped,
    Untagged,
    Short,
    Copied,
}

/// What a program is made for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Purpose<'a> {
    /// The filter of the packet ring.
    pub(super) filter: &'a [Classic],
    pub(super) shape: Shape,
    /// Descriptor of the map that holds the ring.
    pub(super) map: i32,
    pub(super) is_outbound: bool,
}

/// Instructions and their jumps.
#[derive(Debug, Default)]
struct Assembler {
    code: Vec<Instruction>,
    labels: BTreeMap<Label, usize>,
    jumps: Vec<(usize, Label)>,
    /// Loads to be put behind the rest: width, filter instruction, offset, whether X is added.
    slow: Vec<(Width, usize, i32, bool)>,
}

impl Assembler {
    fn put(&mut self, one: Instruction) {
        self.code.push(one);
    }

    fn here(&mut self, label: Label) {
        self.labels.insert(label, self.code.len());
    }

    fn jump(&mut self, when: u8, (left, right): (R, R), value: i32, label: Label) {
        self.jumps.push((self.code.len(), label));
        self.put(op(when, (left, right), 0, value));
    }

    fn always(&mut self, label: Label) {
        self.jump(when::ALWAYS, (R0, R0), 0, label);
    }

    fn finish(mut self) -> Vec<Instruction> {
        for (from, label) in self.jumps {
            let target = self.labels[&label];
            let distance = i16::try_from(target.cast_signed() - from.cast_signed() - 1);
            self.code[from].offset = distance.expect("sixteen flows take a few thousand words");
        }
        self.code
    }
}

/// A program that only lets the next one decide.
pub(super) const fn nothing() -> [Instruction; 2] {
    [set(R0, TCX_NEXT), END]
}

/// The whole program. Registers: R6 the packet, R7 its first byte, R8 the end of its first piece, R9 the
/// filter's X, R0 its A; behind the filter R7 the ring and then the slot, R8 the number drawn, R9 the
/// packet's length.
pub(super) fn program(purpose: &Purpose<'_>) -> Vec<Instruction> {
    let mut code = Assembler::default();
    // The loads of packet bytes expect the packet in R6.
    code.put(copy(R6, R1));
    code.put(load(Width::Word, R7, R6, context::DATA));
    code.put(load(Width::Word, R8, R6, context::DATA_END));
    for (index, one) in purpose.filter.iter().enumerate() {
        code.here(Label::Filter(index));
        translate(&mut code, index, *one);
    }
    accept(&mut code, purpose);
    // Not ours: nothing has been touched.
    code.here(Label::NotOurs);
    code.put(set(R0, TCX_NEXT));
    code.put(END);
    // No free slot: counted, for the reader to tell.
    code.here(Label::NoRoom);
    code.put(set(R1, 1));
    code.put(atomic(ADD_ONLY, R7, signed(at::DROPPED), R1));
    code.put(set(R0, TCX_NEXT));
    code.put(END);
    slow_loads(&mut code);
    code.finish()
}

/// One instruction of the filter.
fn translate(code: &mut Assembler, index: usize, one: Classic) {
    let cell = |k: u32| -8 * (i16::try_from(k).expect("the filter has three cells") + 1);
    let value = one.k.cast_signed();
    match one.code {
        classic::LD_H_ABS => load_packet(code, (Width::Half, index), value, false),
        classic::LD_B_ABS => load_packet(code, (Width::Byte, index), value, false),
        classic::LD_W_IND => load_packet(code, (Width::Word, index), value, true),
        classic::LD_H_IND => load_packet(code, (Width::Half, index), value, true),
        classic::LD_B_IND => load_packet(code, (Width::Byte, index), value, true),
        classic::LD_IMM => code.put(set_word(R0, one.k)),
        // Cells lie on the stack.
        classic::LD_MEM => code.put(load(Width::Double, R0, R10, cell(one.k))),
        classic::LDX_MEM => code.put(load(Width::Double, R9, R10, cell(one.k))),
        classic::ST => code.put(store(Width::Double, R10, cell(one.k), R0)),
        // Of 32 bits each, as in the filter.
        classic::AND => code.put(op(0x54, (R0, R0), 0, value)),
        classic::LSH => code.put(op(0x64, (R0, R0), 0, value)),
        classic::ADD_X => code.put(op(0x0c, (R0, R9), 0, 0)),
        classic::JA => code.always(Label::Filter(index + 1 + one.k as usize)),
        classic::JEQ => branch(code, (when::EQUAL_WORD, index), one),
        classic::JSET => branch(code, (when::BITS_SET_WORD, index), one),
        classic::RET if one.k == 0 => code.always(Label::NotOurs),
        classic::RET => code.always(Label::Accepted),
        other => panic!("the filter has no operation {other:#x}"),
    }
}

/// A comparison of A with two ways to go on.
fn branch(code: &mut Assembler, (when, index): (u8, usize), one: Classic) {
    let target = |skipped: u8| Label::Filter(index + 1 + usize::from(skipped));
    let (held, failed) = (target(one.jump_true), target(one.jump_false));
    code.jump(when, (R0, R0), one.k.cast_signed(), held);
    if one.jump_false > 0 {
        code.always(failed);
    }
}

/// Loads from the packet into A, in the processor's order: at once where the bytes lie in the packet's
/// first piece, which they nearly always do.
fn load_packet(code: &mut Assembler, (width, index): (Width, usize), offset: i32, adds_x: bool) {
    let near = i16::try_from(offset).expect("the filter looks at headers only");
    // R1: where to read; R2: what must not lie behind the end of the piece.
    code.put(copy(R1, R7));
    if adds_x {
        code.put(add_register(R1, R9));
    }
    code.put(copy(R2, R1));
    code.put(add(R2, offset + width.bytes()));
    code.jump(when::ABOVE_REGISTER, (R2, R8), 0, Label::Slow(index));
    code.put(load(width, R0, R1, near));
    if width != Width::Byte {
        // From network order, 16 or 32 bits.
        code.put(op(0xdc, (R0, R0), 0, 8 * width.bytes()));
    }
    code.here(Label::Loaded(index));
    code.slow.push((width, index, offset, adds_x));
}

/// Loads that the kernel does itself, as the bytes lie in another piece or behind the packet's end. The
/// latter is asked first: such a load would end the program with a verdict.
fn slow_loads(code: &mut Assembler) {
    for (width, index, offset, adds_x) in core::mem::take(&mut code.slow) {
        code.here(Label::Slow(index));
        code.put(load(Width::Word, R1, R6, context::LEN));
        if adds_x {
            code.put(copy(R2, R9));
            code.put(add(R2, offset + width.bytes()));
        } else {
            code.put(set(R2, offset + width.bytes()));
        }
        code.jump(when::ABOVE_REGISTER, (R2, R1), 0, Label::NotOurs);
        let mode = if adds_x { 0x40 } else { 0x20 };
        let from = if adds_x { R9 } else { R0 };
        code.put(op(mode | width.bits(), (R0, from), 0, offset));
        code.always(Label::Loaded(index));
    }
}

/// Copies a packet that passed the filter.
fn accept(code: &mut Assembler, purpose: &Purpose<'_>) {
    code.here(Label::Accepted);
    draw_slot(code, purpose);
    if purpose.is_outbound {
        code.put(set_word(R3, flag::OUTBOUND));
    } else {
        stamp_arrival(code);
    }
    mark(code);
    let snap = i32::try_from(purpose.shape.snap_bytes).expect("checked when the tap is opened");
    // R4: bytes to keep.
    code.put(store(Width::Word, R7, signed(slot::LENGTH), R9));
    code.put(copy(R4, R9));
    code.jump(when::AT_MOST, (R4, R0), snap, Label::Short);
    code.put(set(R4, snap));
    code.here(Label::Short);
    code.put(store(Width::Word, R7, signed(slot::KEPT), R4));
    // skb_load_bytes(packet, 0, data of the slot, R4)
    code.put(copy(R1, R6));
    code.put(set(R2, 0));
    code.put(copy(R3, R7));
    code.put(add(R3, i32::from(slot::DATA)));
    code.put(call(helper::SKB_LOAD_BYTES));
    code.jump(when::ZERO, (R0, R0), 0, Label::Copied);
    // Not copied after all: the record says that nothing was kept.
    code.put(set(R1, 0));
    code.put(store(Width::Word, R7, signed(slot::KEPT), R1));
    code.here(Label::Copied);
    if purpose.is_outbound {
        // As late as can be: nearer to the wire by the copy.
        code.put(call(helper::KTIME_GET_TAI_NS));
        code.put(store(Width::Double, R7, signed(slot::STAMP), R0));
    }
    // The state makes the slot the reader's.
    code.put(add(R8, 1));
    publish(code);
    code.put(set(R0, TCX_NEXT));
    code.put(END);
}

/// This processor's stores are seen in their order.
#[cfg(target_arch = "x86_64")]
fn publish(code: &mut Assembler) {
    code.put(store(Width::Double, R7, signed(slot::STATE), R8));
}

/// An exchange orders all that was stored before.
#[cfg(not(target_arch = "x86_64"))]
fn publish(code: &mut Assembler) {
    code.put(atomic(EXCHANGE, R7, signed(slot::STATE), R8));
}

/// Draws a number and finds its slot: R7 the slot, R8 the number, R9 the packet's length.
fn draw_slot(code: &mut Assembler, purpose: &Purpose<'_>) {
    let shape = &purpose.shape;
    let narrow = |value: usize| i32::try_from(value).expect("a ring is at most 256 MiB");
    code.put(load(Width::Word, R9, R6, context::LEN));
    // Tells the kernel's check that there is a byte to copy.
    code.jump(when::BELOW, (R9, R0), 1, Label::NotOurs);
    // R7: the address of the ring, in two words.
    let mut first = op(0x18, (R7, R0), 0, purpose.map);
    first.registers |= PSEUDO_MAP_VALUE << 4;
    code.put(first);
    code.put(op(0, (R0, R0), 0, 0));
    // Slots in use: drawn less given back. A program that is held between the two loads may find more
    // given back than it knows to be drawn: less than none, so the comparison has a sign. The other
    // order of loads would never be below zero, but would take a ring for full that was emptied
    // meanwhile. Too small a number is no danger: what was drawn since HEAD was read is drawn by
    // programs between looking and drawing, for which the margin is there.
    code.put(load(Width::Double, R1, R7, signed(at::HEAD)));
    code.put(load(Width::Double, R2, R7, signed(at::TAIL)));
    code.put(subtract_register(R1, R2));
    let room = narrow(shape.room());
    code.jump(when::AT_LEAST, (R1, R0), room, Label::NoRoom);
    code.put(set(R8, 1));
    code.put(atomic(FETCH_AND_ADD, R7, signed(at::HEAD), R8));
    // The slot is that number modulo their count, a power of two, times their size.
    code.put(copy(R1, R8));
    code.put(op(0x57, (R1, R0), 0, narrow(shape.slot_count - 1)));
    code.put(op(0x27, (R1, R0), 0, narrow(shape.slot_bytes)));
    code.put(add(R7, i32::from(at::SLOTS)));
    code.put(add_register(R7, R1));
}

/// An arrival's stamp, and flags in R3.
fn stamp_arrival(code: &mut Assembler) {
    // The stack's stamp; the kernel gives 0 here for a time of departure.
    code.put(load(Width::Double, R0, R6, context::TSTAMP));
    code.put(set_word(R3, flag::STACK_STAMP));
    code.jump(when::NOT_ZERO, (R0, R0), 0, Label::Stamped);
    code.put(call(helper::KTIME_GET_TAI_NS));
    code.put(set_word(R3, 0));
    code.here(Label::Stamped);
    code.put(store(Width::Double, R7, signed(slot::STAMP), R0));
}

/// The flags of R3, with the VLAN tag if there is one.
fn mark(code: &mut Assembler) {
    // A tag that the kernel keeps beside the packet.
    code.put(load(Width::Word, R1, R6, context::VLAN_PRESENT));
    code.jump(when::ZERO, (R1, R0), 0, Label::Untagged);
    code.put(load(Width::Word, R1, R6, context::VLAN_PROTO));
    code.put(store(Width::Half, R7, signed(slot::VLAN_TYPE), R1));
    code.put(load(Width::Word, R1, R6, context::VLAN_TCI));
    code.put(store(Width::Half, R7, signed(slot::VLAN_TAG), R1));
    code.put(op(0x44, (R3, R0), 0, flag::TAGGED.cast_signed()));
    code.here(Label::Untagged);
    code.put(store(Width::Word, R7, signed(slot::FLAGS), R3));
}

const fn signed(offset: u16) -> i16 {
    offset.cast_signed()
}
