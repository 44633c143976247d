//! Captures of packets: files, and the frames in them.

use hil_capture::flow::FlowFilter;
use hil_capture::observe::Observer;
use hil_capture::reader::{CaptureReader, Step};
use hil_capture::writer::PacketToWrite;
use hil_capture::{CaptureFault, CaptureInterface, CapturedPacket, esl, link, writer};
use hil_net::{Direction, link_type};

use crate::Verdict;
use crate::input::Input;

/// A packet that has left its reader.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Kept {
    interface_index: usize,
    link_type: u16,
    stamp_ns: Option<i64>,
    original_bytes: u32,
    direction: Direction,
    data: Vec<u8>,
}

impl From<&CapturedPacket<'_>> for Kept {
    fn from(packet: &CapturedPacket<'_>) -> Self {
        Self {
            interface_index: packet.interface_index,
            link_type: packet.link_type,
            stamp_ns: packet.stamp_ns,
            original_bytes: packet.original_bytes,
            direction: packet.direction,
            data: packet.data.to_vec(),
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
struct Contents {
    packets: Vec<Kept>,
    faults: Vec<CaptureFault>,
    interfaces: Vec<CaptureInterface>,
}

fn read(file: &[u8], portion: usize) -> Contents {
    let (mut packets, mut faults) = (Vec::new(), Vec::new());
    let mut reader = CaptureReader::default();
    let mut parts = file.chunks(portion);
    // A step passes at least a byte, or asks for a portion, or is the last.
    for step_count in 0.. {
        assert!(step_count <= 3 * file.len() + 8, "reading does not end");
        match reader.next_step() {
            Step::Packet(packet) => {
                let end = packet.offset + packet.data.len() as u64;
                assert!(
                    end <= file.len() as u64,
                    "a packet lies beyond the file's end"
                );
                packets.push(Kept::from(&packet));
            }
            Step::NeedsMore => match parts.next() {
                Some(part) => reader.feed(part),
                None => reader.end(),
            },
            Step::Fault(fault) => {
                assert!(
                    fault.offset <= file.len() as u64,
                    "a fault beyond the file's end"
                );
                assert!(!fault.to_string().is_empty());
                faults.push(fault);
            }
            Step::Ended => break,
        }
    }
    assert!(matches!(reader.next_step(), Step::Ended));
    Contents {
        packets,
        faults,
        interfaces: reader.interfaces().to_vec(),
    }
}

/// However the file is fed, the same is read; packets with stamps can be written and read again.
pub(crate) fn capture(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let portion = 1 + usize::from(input.byte());
    let file = input.rest();
    let whole = read(file, file.len().max(1));
    assert_eq!(read(file, portion), whole, "portions of {portion} bytes");
    let kept_bytes: usize = whole.packets.iter().map(|packet| packet.data.len()).sum();
    assert!(
        kept_bytes <= file.len(),
        "more was read than the file holds"
    );
    if whole.packets.is_empty() {
        return Verdict::Refused;
    }
    write_and_read_again(&whole);
    Verdict::Accepted
}

fn write_and_read_again(contents: &Contents) {
    let stamped = contents.packets.iter().filter_map(|packet| {
        let stamp_ns = u64::try_from(packet.stamp_ns?).ok()?;
        Some((stamp_ns, packet))
    });
    let mut file = Vec::new();
    writer::begin(&mut file, "check", "none");
    for interface in &contents.interfaces {
        let unbounded = CaptureInterface {
            snap_bytes: 0,
            ..interface.clone()
        };
        writer::interface(&mut file, &unbounded, "all");
    }
    let mut expected = Vec::new();
    for (stamp_ns, packet) in stamped {
        let interface_index = u32::try_from(packet.interface_index).expect("an index of 32 bits");
        let (first, second) = packet.data.split_at(packet.data.len() / 3);
        writer::packet(
            &mut file,
            &PacketToWrite {
                interface_index,
                stamp_ns,
                original_bytes: packet.original_bytes,
                direction: packet.direction,
                data: [first, second],
            },
        );
        expected.push(packet.clone());
    }
    let again = read(&file, file.len());
    assert_eq!(again.faults, [], "what was written is faulty");
    assert_eq!(again.packets, expected, "what was written reads otherwise");
}

const LINK_TYPES: [u16; 15] = [
    link_type::ETHERNET,
    link_type::RAW,
    link_type::LINUX_SLL,
    link_type::IPV4,
    link_type::IPV6,
    link_type::LINUX_SLL2,
    link_type::NULL,
    link_type::LOOP,
    link_type::PPP,
    link_type::PPP_ETHER,
    link_type::IEEE802_11,
    link_type::RADIOTAP,
    link_type::RAW_12,
    link_type::PPP_SERIAL,
    999,
];

/// A frame shows no more than it has, and is counted once, whatever flow it may belong to.
pub(crate) fn frame(bytes: &[u8]) -> Verdict {
    thread_local! {
        /// Parsed once: the flows are not what is looked at here.
        static FLOWS: Vec<FlowFilter> = ["hil", "egm:port=6510", "udp:port=7000,id=3+4le", "udp:port=7001"]
            .iter()
            .map(|text| text.parse().expect("the flows are fixed"))
            .collect();
    }
    let mut input = Input::new(bytes);
    let link_type = LINK_TYPES[usize::from(input.byte()) % LINK_TYPES.len()];
    let original_bytes = u32::from(input.short());
    let frame = input.rest();
    let inner = esl::split(frame).map_or(frame, |(header, inner)| {
        assert_eq!(inner.len() + esl::HEADER_BYTES, frame.len());
        assert!(header.port().is_some() == (header.port_count() > 0));
        let again = [&header.encode()[..], inner].concat();
        assert_eq!(esl::split(&again), Some((header, inner)));
        inner
    });
    let datagram = link::udp_datagram(link_type, inner, original_bytes as usize);
    if let Ok(datagram) = &datagram {
        assert!(datagram.payload.len() <= datagram.payload_bytes);
        assert!(
            datagram.payload.len() + 28 <= inner.len(),
            "no room for the headers"
        );
        assert!(datagram.dscp < 64 && datagram.place.vlans.iter().all(|vlan| *vlan < 4096));
        assert_eq!(
            datagram.is_cut_short(),
            datagram.payload.len() < datagram.payload_bytes
        );
    }
    let packet = CapturedPacket {
        offset: 0,
        interface_index: 0,
        interface_number: None,
        link_type,
        stamp_ns: (original_bytes & 1 == 0).then_some(i64::from(original_bytes)),
        original_bytes,
        is_damaged: false,
        is_nic_stamped: false,
        direction: Direction::Unknown,
        data: frame,
    };
    let mut observer = FLOWS.with(|flows| Observer::new(flows));
    observer.take(0, &packet);
    observer.finish(0, &[CaptureInterface::default()]);
    let counts = observer.counts();
    let parts = counts.followed_count
        + counts.other_flow_count
        + counts.foreign_count
        + counts.unidentified_count
        + counts.not_ip_count
        + counts.not_udp_count
        + counts.later_fragment_count
        + counts.unreadable_count
        + counts.stampless_count
        + counts.damaged_count;
    assert_eq!((counts.packet_count, parts), (1, 1), "{counts:?}");
    Verdict::of(datagram.is_ok())
}
