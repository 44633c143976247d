//! The filter that the kernel applies for a tap, so that it copies the wanted packets and nothing
//! else: classic BPF (Linux `Documentation/networking/filter.rst`). It compiles [`PacketFilter`]s and
//! runs nothing.
//!
//! One VLAN tag and IPv4 options are followed. IPv6 extension headers and later fragments are not:
//! such packets do not pass.

use std::net::IpAddr;

use super::link_type;

/// Filters one tap may have.
pub const FILTER_COUNT_MAX: usize = 16;

/// Which UDP packets to keep: those that meet every condition given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PacketFilter {
    /// Port of either end.
    pub port: Option<u16>,
    /// Port of the sender.
    pub source_port: Option<u16>,
    /// Port of the receiver.
    pub destination_port: Option<u16>,
    /// Address of the sender.
    pub source: Option<IpAddr>,
    /// Address of the receiver; of the sender's family.
    pub destination: Option<IpAddr>,
    /// What the payload begins with.
    pub magic: Option<[u8; 4]>,
}

/// One instruction, laid out as the kernel's `sock_filter`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instruction {
    /// Operation.
    pub code: u16,
    /// Instructions to skip when a comparison holds.
    pub jump_true: u8,
    /// Instructions to skip when it does not.
    pub jump_false: u8,
    /// Operand.
    pub k: u32,
}

/// Operation codes, by their names in the kernel's documentation.
pub mod code {
    /// Load a half-word at `k`.
    pub const LD_H_ABS: u16 = 0x28;
    /// Load a byte at `k`.
    pub const LD_B_ABS: u16 = 0x30;
    /// Load a word at the index register and `k`.
    pub const LD_W_IND: u16 = 0x40;
    /// Load a half-word there.
    pub const LD_H_IND: u16 = 0x48;
    /// Load a byte there.
    pub const LD_B_IND: u16 = 0x50;
    /// Load `k`.
    pub const LD_IMM: u16 = 0x00;
    /// Load a scratch cell.
    pub const LD_MEM: u16 = 0x60;
    /// Load a scratch cell into the index register.
    pub const LDX_MEM: u16 = 0x61;
    /// Store into a scratch cell.
    pub const ST: u16 = 0x02;
    /// Keep the bits of `k`.
    pub const AND: u16 = 0x54;
    /// Shift left by `k`.
    pub const LSH: u16 = 0x64;
    /// Add the index register.
    pub const ADD_X: u16 = 0x0c;
    /// Skip `k` instructions.
    pub const JA: u16 = 0x05;
    /// Compare with `k`.
    pub const JEQ: u16 = 0x15;
    /// Compare the bits of `k` with none.
    pub const JSET: u16 = 0x45;
    /// Keep `k` bytes of the packet.
    pub const RET: u16 = 0x06;
}

/// Scratch cells: where IP begins, its ethertype, where UDP begins.
const IP_AT: u32 = 0;
const ETHERTYPE: u32 = 1;
const UDP_AT: u32 = 2;
const IPV4: u32 = 0x0800;
const IPV6: u32 = 0x86dd;

/// Stands for "to the end of this part" until the part is complete.
const FAIL: u8 = u8::MAX;

#[derive(Debug, Default)]
struct Part(Vec<Instruction>);

impl Part {
    fn op(&mut self, code: u16, k: u32) {
        self.jump(code, k, 0, 0);
    }

    fn jump(&mut self, code: u16, k: u32, jump_true: u8, jump_false: u8) {
        self.0.push(Instruction {
            code,
            jump_true,
            jump_false,
            k,
        });
    }

    fn equals(&mut self, k: u32) {
        self.jump(code::JEQ, k, 0, FAIL);
    }

    /// Loads a half-word of the UDP header.
    fn udp_half(&mut self, offset: u32) {
        self.op(code::LDX_MEM, UDP_AT);
        self.op(code::LD_H_IND, offset);
    }

    /// Resolves the jumps to the end.
    fn finish(mut self) -> Vec<Instruction> {
        let end = self.0.len();
        for (index, one) in self.0.iter_mut().enumerate() {
            let distance = u8::try_from(end - index - 1).expect("a part has few instructions");
            for jump in [&mut one.jump_true, &mut one.jump_false] {
                if *jump == FAIL {
                    *jump = distance;
                }
            }
        }
        self.0
    }
}

/// The program that keeps `snap_bytes` of each packet that passes one of the filters and drops the
/// rest; `None` for a link layer it does not know.
///
/// # Panics
/// When there are more than [`FILTER_COUNT_MAX`] filters.
pub fn compile(link: u16, filters: &[PacketFilter], snap_bytes: u32) -> Option<Vec<Instruction>> {
    assert!(
        filters.len() <= FILTER_COUNT_MAX,
        "{} filters are too many",
        filters.len()
    );
    let mut program = find_ip(link)?;
    program.extend(find_udp());
    // A load behind the end of a packet rejects it at once, so what looks into payloads is last.
    let (with_magic, without): (Vec<&PacketFilter>, Vec<&PacketFilter>) =
        filters.iter().partition(|filter| filter.magic.is_some());
    for filter in without.into_iter().chain(with_magic) {
        program.extend(accept(filter, snap_bytes));
    }
    program.extend(reject());
    Some(program)
}

fn reject() -> [Instruction; 1] {
    [Instruction {
        code: code::RET,
        jump_true: 0,
        jump_false: 0,
        k: 0,
    }]
}

/// Notes where IP begins and which it is.
fn find_ip(link: u16) -> Option<Vec<Instruction>> {
    let mut part = Part::default();
    match link {
        link_type::ETHERNET => {
            part.op(code::LD_H_ABS, 12);
            part.op(code::ST, ETHERTYPE);
            part.op(code::LD_IMM, 14);
            part.op(code::ST, IP_AT);
            part.op(code::LD_MEM, ETHERTYPE);
            part.jump(code::JEQ, 0x8100, 1, 0);
            part.jump(code::JEQ, 0x88a8, 0, FAIL);
            part.op(code::LD_H_ABS, 16);
            part.op(code::ST, ETHERTYPE);
            part.op(code::LD_IMM, 18);
            part.op(code::ST, IP_AT);
        }
        link_type::RAW => {
            part.op(code::LD_IMM, 0);
            part.op(code::ST, IP_AT);
            part.op(code::LD_IMM, IPV4);
            part.op(code::ST, ETHERTYPE);
            part.op(code::LD_B_ABS, 0);
            part.op(code::AND, 0xf0);
            part.jump(code::JEQ, 0x60, 0, FAIL);
            part.op(code::LD_IMM, IPV6);
            part.op(code::ST, ETHERTYPE);
        }
        _ => return None,
    }
    Some(part.finish())
}

/// Notes where UDP begins; what is not UDP, or not its beginning, is rejected here.
fn find_udp() -> Vec<Instruction> {
    let mut part = Part::default();
    part.op(code::LDX_MEM, IP_AT);
    part.op(code::LD_MEM, ETHERTYPE);
    part.jump(code::JEQ, IPV4, 0, 8);
    part.op(code::LD_B_IND, 9);
    part.jump(code::JEQ, 17, 0, 10);
    part.op(code::LD_H_IND, 6);
    part.jump(code::JSET, 0x1fff, 8, 0);
    part.op(code::LD_B_IND, 0);
    part.op(code::AND, 0x0f);
    part.op(code::LSH, 2);
    // To the sum below.
    part.op(code::JA, 6);
    // Here without IPv4, ethertype still loaded.
    part.op(code::LD_MEM, ETHERTYPE);
    part.jump(code::JEQ, IPV6, 0, 2);
    part.op(code::LD_B_IND, 6);
    part.jump(code::JEQ, 17, 1, 0);
    part.0.extend(reject());
    part.op(code::LD_IMM, 40);
    part.op(code::ADD_X, 0);
    part.op(code::ST, UDP_AT);
    part.0
}

/// Accepts what passes one filter; falls through when the packet does not.
fn accept(filter: &PacketFilter, snap_bytes: u32) -> Vec<Instruction> {
    let mut part = Part::default();
    for (address, at) in [(filter.source, [12, 8]), (filter.destination, [16, 24])] {
        let Some(address) = address else { continue };
        part.op(code::LD_MEM, ETHERTYPE);
        let (ethertype, offset, octets): (u32, u32, Vec<u8>) = match address {
            IpAddr::V4(v4) => (IPV4, at[0], v4.octets().to_vec()),
            IpAddr::V6(v6) => (IPV6, at[1], v6.octets().to_vec()),
        };
        part.equals(ethertype);
        part.op(code::LDX_MEM, IP_AT);
        for (index, word) in (0_u32..).zip(octets.as_chunks::<4>().0) {
            part.op(code::LD_W_IND, offset + 4 * index);
            part.equals(u32::from_be_bytes(*word));
        }
    }
    for (port, offset) in [(filter.source_port, 0), (filter.destination_port, 2)] {
        if let Some(port) = port {
            part.udp_half(offset);
            part.equals(port.into());
        }
    }
    if let Some(port) = filter.port {
        part.udp_half(0);
        part.jump(code::JEQ, port.into(), 2, 0);
        part.op(code::LD_H_IND, 2);
        part.equals(port.into());
    }
    if let Some(magic) = filter.magic {
        part.op(code::LDX_MEM, UDP_AT);
        part.op(code::LD_W_IND, 8);
        part.equals(u32::from_be_bytes(magic));
    }
    part.op(code::RET, snap_bytes);
    part.finish()
}
