//! The kernel's filter against the analyser: run here by an interpreter of the few operations it
//! uses, it must let pass exactly the packets of the flows.

use hil_core::random::RandomStream;

use super::super::flow::FlowFilter;
use super::super::link::udp_datagram;
use super::{message, udp_frame};
use hil_net::filter::{Instruction, PacketFilter, code, compile};
use hil_net::link_type;

/// Bytes the program keeps of `packet`.
pub(super) fn run(program: &[Instruction], packet: &[u8]) -> u32 {
    let load = |at: u32, count: usize| -> Option<u32> {
        let bytes = packet.get(at as usize..at as usize + count)?;
        Some(
            bytes
                .iter()
                .fold(0, |sum, byte| sum << 8 | u32::from(*byte)),
        )
    };
    let (mut a, mut x, mut cells, mut at) = (0_u32, 0_u32, [0_u32; 16], 0);
    loop {
        let one = program[at];
        at += 1;
        let loaded = match one.code {
            code::LD_H_ABS => load(one.k, 2),
            code::LD_B_ABS => load(one.k, 1),
            code::LD_W_IND => load(x + one.k, 4),
            code::LD_H_IND => load(x + one.k, 2),
            code::LD_B_IND => load(x + one.k, 1),
            code::LD_IMM => Some(one.k),
            code::LD_MEM => Some(cells[one.k as usize]),
            code::AND => Some(a & one.k),
            code::LSH => Some(a << one.k),
            code::ADD_X => Some(a.wrapping_add(x)),
            code::RET => return one.k,
            _ => {
                let jump = |holds: bool| if holds { one.jump_true } else { one.jump_false };
                match one.code {
                    code::LDX_MEM => x = cells[one.k as usize],
                    code::ST => cells[one.k as usize] = a,
                    code::JA => at += one.k as usize,
                    code::JEQ => at += usize::from(jump(a == one.k)),
                    code::JSET => at += usize::from(jump(a & one.k != 0)),
                    other => panic!("operation {other:#x} is not used"),
                }
                Some(a)
            }
        };
        // The kernel rejects a packet that is shorter than what the program reads.
        let Some(value) = loaded else { return 0 };
        a = value;
    }
}

/// Whether the analyser finds a packet to be of the flows.
pub(super) fn is_of(flows: &[FlowFilter], link: u16, packet: &[u8]) -> bool {
    let Ok(datagram) = udp_datagram(link, packet, packet.len()) else {
        return false;
    };
    let is_ours = datagram.payload.starts_with(b"HILG");
    flows.iter().any(|flow| {
        let is_any = flow.kind != super::super::flow::FlowKind::Hil;
        flow.has_addresses_of(&datagram) && (is_any || is_ours)
    })
}

/// Flows to try, so that every condition and every mixture is there.
pub(super) const FLOW_SETS: [&[&str]; 4] = [
    &["hil"],
    &["hil:dst=10.77.0.2", "udp:port=7000"],
    &[
        "udp:sport=7000,src=10.77.0.1",
        "egm:dport=6510",
        "hil:port=9",
    ],
    &["udp:src=fd00::1,dst=fd00::2", "udp:dst=10.77.0.9"],
];

/// A packet with or without what the flows ask for: tags, fragments, IPv6, other protocols.
pub(super) fn made_up_frame(random: &mut RandomStream, case: u64, link: u16) -> Vec<u8> {
    let ports = [9, 6510, 7000, 7001];
    let mut pick = || ports[usize::try_from(random.next_u64() % 4).unwrap()];
    let payload = if case.is_multiple_of(3) {
        vec![7; 30]
    } else {
        message(case)
    };
    let mut frame = udp_frame(pick(), pick(), &payload);
    if random.chance(0.2) {
        frame[33] = 9;
    }
    if random.chance(0.1) {
        frame[20 + usize::from(random.chance(0.5))] = 0x21;
    }
    if random.chance(0.1) {
        frame[23] = 6;
    }
    if random.chance(0.3) {
        let mut six = frame[..12].to_vec();
        six.extend([0x86, 0xdd, 0x60, 0, 0, 0, 0, frame[39], 17, 64]);
        for last in [1, 2] {
            six.extend([0xfd, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, last]);
        }
        six.extend(&frame[34..]);
        frame = six;
    }
    if link == link_type::RAW {
        frame.drain(..14);
    } else if random.chance(0.3) {
        frame.splice(12..12, [0x81, 0, 0, 5]);
    }
    frame
}

#[test]
fn the_kernels_filter_and_the_analyser_agree_on_every_packet() {
    let mut random = RandomStream::new(5, "filters");
    let mut pass_count = 0;
    for set in FLOW_SETS {
        let flows: Vec<FlowFilter> = set.iter().map(|text| text.parse().unwrap()).collect();
        let filters: Vec<PacketFilter> = flows.iter().map(|flow| flow.packets).collect();
        for link in [link_type::ETHERNET, link_type::RAW] {
            let program = compile(link, &filters, 99).unwrap();
            assert!(program.len() < 256);
            for case in 0..25_000_u64 {
                let frame = made_up_frame(&mut random, case, link);
                let is_kept = run(&program, &frame) == 99;
                assert_eq!(
                    is_kept,
                    is_of(&flows, link, &frame),
                    "{set:?} {case} {frame:02x?}"
                );
                pass_count += u64::from(is_kept);
            }
        }
    }
    assert!(
        (40_000..160_000).contains(&pass_count),
        "{pass_count} passed"
    );
    assert_eq!(compile(113, &[FlowFilter::hil().packets], 1), None);
}
