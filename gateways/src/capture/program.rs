//! The filter that the kernel applies for a probe, so that it copies the followed flows and nothing
//! else: classic BPF (Linux `Documentation/networking/filter.rst`). It compiles [`FlowFilter`]s; it
//! runs nothing, but for its tests.
//!
//! One VLAN tag and IPv4 options are followed. IPv6 extension headers and later fragments are not:
//! such packets do not pass.

use std::net::IpAddr;

use super::flow::{FlowFilter, FlowKind};
use super::link_type;

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
pub(crate) mod code {
    pub(crate) const LD_H_ABS: u16 = 0x28;
    pub(crate) const LD_B_ABS: u16 = 0x30;
    pub(crate) const LD_W_IND: u16 = 0x40;
    pub(crate) const LD_H_IND: u16 = 0x48;
    pub(crate) const LD_B_IND: u16 = 0x50;
    pub(crate) const LD_IMM: u16 = 0x00;
    pub(crate) const LD_MEM: u16 = 0x60;
    pub(crate) const LDX_MEM: u16 = 0x61;
    pub(crate) const ST: u16 = 0x02;
    pub(crate) const AND: u16 = 0x54;
    pub(crate) const LSH: u16 = 0x64;
    pub(crate) const ADD_X: u16 = 0x0c;
    pub(crate) const JA: u16 = 0x05;
    pub(crate) const JEQ: u16 = 0x15;
    pub(crate) const JSET: u16 = 0x45;
    pub(crate) const RET: u16 = 0x06;
}

/// Scratch cells: where IP begins, its ethertype, where UDP begins.
const IP_AT: u32 = 0;
const ETHERTYPE: u32 = 1;
const UDP_AT: u32 = 2;
const IPV4: u32 = 0x0800;
const IPV6: u32 = 0x86dd;
const MAGIC: u32 = u32::from_be_bytes(*b"HILG");

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

/// The program that keeps `snap_bytes` of each packet of one of the flows and drops the rest;
/// `None` for a link layer it does not know.
///
/// # Panics
/// When there are more than [`super::flow::FLOW_COUNT_MAX`] flows.
pub fn compile(link: u16, flows: &[FlowFilter], snap_bytes: u32) -> Option<Vec<Instruction>> {
    assert!(
        flows.len() <= super::flow::FLOW_COUNT_MAX,
        "{} flows are too many",
        flows.len()
    );
    let mut program = find_ip(link)?;
    program.extend(find_udp());
    // A load behind the end of a packet rejects it at once, so what looks into payloads is last.
    let (with_magic, without): (Vec<&FlowFilter>, Vec<&FlowFilter>) =
        flows.iter().partition(|flow| flow.kind == FlowKind::Hil);
    for flow in without.into_iter().chain(with_magic) {
        program.extend(accept(flow, snap_bytes));
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

/// Accepts one flow; falls through when the packet is not of it.
fn accept(flow: &FlowFilter, snap_bytes: u32) -> Vec<Instruction> {
    let mut part = Part::default();
    for (address, at) in [(flow.source, [12, 8]), (flow.destination, [16, 24])] {
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
    for (port, offset) in [(flow.source_port, 0), (flow.destination_port, 2)] {
        if let Some(port) = port {
            part.udp_half(offset);
            part.equals(port.into());
        }
    }
    if let Some(port) = flow.port {
        part.udp_half(0);
        part.jump(code::JEQ, port.into(), 2, 0);
        part.op(code::LD_H_IND, 2);
        part.equals(port.into());
    }
    if flow.kind == FlowKind::Hil {
        part.op(code::LDX_MEM, UDP_AT);
        part.op(code::LD_W_IND, 8);
        part.equals(MAGIC);
    }
    part.op(code::RET, snap_bytes);
    part.finish()
}
