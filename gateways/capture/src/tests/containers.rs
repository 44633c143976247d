//! pcap and pcapng, whole and broken.

use super::super::writer::{self, PacketToWrite};
use super::super::{CARD_CLOCK, CaptureInterface, Problem};
use super::read;
use hil_net::{Direction, link_type};

/// Numbers of either byte order.
#[derive(Clone, Copy)]
struct Maker {
    is_big: bool,
}

impl Maker {
    fn half(self, value: u16) -> Vec<u8> {
        let bytes = if self.is_big {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        };
        bytes.to_vec()
    }

    fn word(self, value: u32) -> Vec<u8> {
        let bytes = if self.is_big {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        };
        bytes.to_vec()
    }

    fn block(self, kind: u32, body: &[u8]) -> Vec<u8> {
        let length = self.word(u32::try_from(12 + body.len()).unwrap());
        [self.word(kind), length.clone(), body.to_vec(), length].concat()
    }

    fn section(self, length: i64) -> Vec<u8> {
        let bytes = if self.is_big {
            length.to_be_bytes()
        } else {
            length.to_le_bytes()
        };
        let magic = self.word(0x1a2b_3c4d);
        self.block(
            0x0a0d_0d0a,
            &[magic, self.half(1), self.half(0), bytes.to_vec()].concat(),
        )
    }

    fn interface(self, options: &[u8]) -> Vec<u8> {
        let body = [self.half(1), self.half(0), self.word(0), options.to_vec()].concat();
        self.block(1, &body)
    }

    fn option(self, code: u16, value: &[u8]) -> Vec<u8> {
        let length = self.half(u16::try_from(value.len()).unwrap());
        let mut bytes = [self.half(code), length, value.to_vec()].concat();
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        bytes
    }

    fn packet(self, interface: u32, units: u64, data: &[u8]) -> Vec<u8> {
        let length = u32::try_from(data.len()).unwrap();
        let (high, low) = ((units >> 32) as u32, (units & 0xffff_ffff) as u32);
        let words = [interface, high, low, length, length + 7]
            .map(|one| self.word(one))
            .concat();
        let mut body = [words, data.to_vec()].concat();
        body.resize(body.len().next_multiple_of(4), 0);
        self.block(6, &body)
    }

    fn pcap(self, magic: u32, records: &[(u32, u32, &[u8])]) -> Vec<u8> {
        let mut file = [
            self.word(magic),
            self.half(2),
            self.half(4),
            self.word(0),
            self.word(0),
            self.word(65_535),
            self.word(1),
        ]
        .concat();
        for (seconds, fraction, data) in records {
            let length = u32::try_from(data.len()).unwrap();
            let words = [*seconds, *fraction, length, length + 7];
            file.extend(words.map(|one| self.word(one)).concat());
            file.extend(*data);
        }
        file
    }
}

const ORDERS: [Maker; 2] = [Maker { is_big: false }, Maker { is_big: true }];

#[test]
fn pcap_of_either_order_and_resolution_gives_the_same_packets() {
    for maker in ORDERS {
        for (magic, unit_ns) in [(0xa1b2_c3d4, 1000), (0xa1b2_3c4d, 1)] {
            let file = maker.pcap(magic, &[(7, 42, b"first"), (4_000_000_000, 999_999, b"")]);
            for piece_bytes in [1, 3, 1000] {
                let (packets, faults, interfaces) = read(&file, piece_bytes);
                assert_eq!(faults, []);
                assert_eq!(interfaces[0].link_type, link_type::ETHERNET);
                assert_eq!(packets[0].stamp_ns, Some(7_000_000_000 + 42 * unit_ns));
                assert_eq!((packets[0].offset, packets[1].offset), (24, 45));
                assert_eq!(packets[0].data, b"first");
                assert_eq!(packets[0].original_bytes, 12);
                let late = 4_000_000_000_000_000_000 + 999_999 * unit_ns;
                assert_eq!(packets[1].stamp_ns, Some(late));
            }
        }
    }
}

#[test]
fn pcapng_keeps_to_each_interfaces_resolution_over_several_sections() {
    for maker in ORDERS {
        let other = Maker {
            is_big: !maker.is_big,
        };
        let name = maker.option(2, b"lan1");
        let file = [
            maker.section(-1),
            maker.interface(&[]),
            maker.interface(&[name, maker.option(9, &[9])].concat()),
            maker.packet(1, 1_700_000_000_123_456_789, b"nano"),
            maker.packet(0, 1_700_000_000_123_456, b"micro!"),
            maker.block(0x0bad, b"anything"),
            other.section(-1),
            // 2^-10 seconds.
            other.interface(&other.option(9, &[0x8a])),
            other.packet(0, 3 << 9, b"binary"),
        ]
        .concat();
        for piece_bytes in [1, 7, 4096] {
            let (packets, faults, interfaces) = read(&file, piece_bytes);
            assert_eq!(faults, []);
            assert_eq!(interfaces.len(), 3);
            assert_eq!(interfaces[1].name.as_deref(), Some("lan1"));
            let stamps: Vec<i64> = packets.iter().map(|one| one.stamp_ns.unwrap()).collect();
            let nano = 1_700_000_000_123_456_789;
            assert_eq!(stamps, [nano, nano / 1000 * 1000, 1_500_000_000]);
            let indexes: Vec<usize> = packets.iter().map(|one| one.interface_index).collect();
            assert_eq!(indexes, [1, 0, 2]);
            assert_eq!(packets[2].data, b"binary");
        }
    }
}

#[test]
fn simple_packets_have_no_stamp_and_statistics_reach_their_interface() {
    let maker = ORDERS[0];
    let simple = [maker.word(5), b"short\0\0\0".to_vec()].concat();
    let counts = [
        maker.word(0),
        maker.word(0),
        maker.word(0),
        maker.option(7, &41_u64.to_le_bytes()),
        maker.option(2, &[0, 0, 0, 0, 9, 0, 0, 0]),
    ]
    .concat();
    let file = [
        maker.section(-1),
        maker.interface(&[]),
        maker.block(3, &simple),
        maker.block(5, &counts),
    ]
    .concat();
    let (packets, faults, interfaces) = read(&file, 10);
    assert_eq!(faults, []);
    assert_eq!(
        (packets[0].stamp_ns, packets[0].data.as_slice()),
        (None, &b"short"[..])
    );
    assert_eq!(interfaces[0].dropped_count, Some(41));
    assert_eq!(interfaces[0].watch, [None, None], "no end is stated");
}

#[test]
fn a_truncated_file_keeps_its_packets_and_names_the_last_offset() {
    let maker = ORDERS[0];
    let ng = [
        maker.section(-1),
        maker.interface(&[]),
        maker.packet(0, 1, b"kept"),
        maker.packet(0, 2, b"cut"),
    ]
    .concat();
    let old = maker.pcap(0xa1b2_c3d4, &[(1, 0, b"kept"), (2, 0, b"cut")]);
    for (file, last) in [(ng, 28 + 20 + 36), (old, 24 + 20)] {
        for length in last + 1..file.len() {
            let (packets, faults, _) = read(&file[..length], 64);
            assert_eq!(packets.len(), 1, "{length} of {}", file.len());
            assert_eq!(packets[0].data, b"kept");
            assert_eq!(faults.len(), 1);
            assert_eq!(faults[0].offset, last as u64);
            assert!(
                matches!(faults[0].problem, Problem::Truncated { .. }),
                "{}",
                faults[0]
            );
        }
        let (packets, faults, _) = read(&file[..last], 64);
        assert_eq!((packets.len(), faults.len()), (1, 0));
    }
}

#[test]
fn foreign_and_empty_files_are_named_as_such() {
    let (_, faults, _) = read(b"\x7fELF and so on", 5);
    assert_eq!(faults[0].problem, Problem::Foreign(*b"\x7fELF"));
    assert!(faults[0].to_string().starts_with("byte 0: not a capture"));
    assert_eq!(read(b"", 1).1[0].problem, Problem::Empty);
    assert!(matches!(
        read(b"ab", 1).1[0].problem,
        Problem::Truncated { .. }
    ));
    let mut file = ORDERS[0].pcap(0xa1b2_c3d4, &[]);
    file[4] = 9;
    assert_eq!(
        read(&file, 9).1[0].problem,
        Problem::Version { major: 9, minor: 4 }
    );
}

#[test]
fn a_corrupt_block_with_sound_lengths_is_passed_and_broken_lengths_end_the_section() {
    let maker = ORDERS[0];
    let section = maker.section(-1);
    let blocks = [maker.interface(&[]), maker.packet(0, 1, b"one")].concat();
    let unknown = maker.packet(6, 2, b"two");
    let third = maker.packet(0, 3, b"three");
    let file = [
        section.clone(),
        blocks.clone(),
        unknown.clone(),
        third.clone(),
    ]
    .concat();
    let (packets, faults, _) = read(&file, 100);
    assert_eq!(packets.len(), 2);
    assert_eq!(faults[0].offset, (section.len() + blocks.len()) as u64);
    assert_eq!(
        faults[0].problem,
        Problem::UnknownInterface { index: 6, count: 1 }
    );
    assert!(faults[0].is_passed);

    // The same with a broken length: the rest of this section is lost, the next one is not.
    let mut broken = unknown;
    broken[4] = 0xff;
    let length = i64::try_from(blocks.len() + broken.len() + third.len()).unwrap();
    let first = [
        maker.section(length),
        blocks.clone(),
        broken.clone(),
        third.clone(),
    ]
    .concat();
    let file = [first, section.clone(), blocks.clone()].concat();
    let (packets, faults, _) = read(&file, 100);
    assert_eq!(packets.len(), 2, "{faults:?}");
    assert!(
        matches!(faults[0].problem, Problem::Length { length: 0xff, .. }),
        "{faults:?}"
    );

    // Without the section's length nothing says where to go on.
    let file = [
        section.clone(),
        blocks.clone(),
        broken,
        third,
        section,
        blocks,
    ]
    .concat();
    let (packets, faults, _) = read(&file, 100);
    assert_eq!((packets.len(), faults.len()), (1, 1));
    assert!(!faults[0].is_passed);
}

#[test]
fn blocks_out_of_order_cost_only_those_that_came_too_early() {
    let maker = ORDERS[0];
    let section = maker.section(-1);
    let early = maker.packet(0, 1, b"early");
    let file = [
        section.clone(),
        early,
        maker.interface(&[]),
        maker.packet(0, 2, b"fine"),
    ]
    .concat();
    let (packets, faults, _) = read(&file, 30);
    assert_eq!(packets[0].data, b"fine");
    assert_eq!(faults[0].offset, section.len() as u64);
}

#[test]
fn what_the_writer_wrote_reads_the_same() {
    use Direction::{Inbound, Outbound, Unknown};

    let mut file = Vec::new();
    writer::begin(&mut file, "test", "none");
    let interface = CaptureInterface {
        name: Some("eth0".to_owned()),
        link_type: link_type::ETHERNET,
        snap_bytes: 200,
        ..CaptureInterface::default()
    };
    writer::interface(&mut file, &interface, "hil");
    let card = CaptureInterface {
        description: Some(format!("{CARD_CLOCK} (/dev/ptp0)")),
        ..interface.clone()
    };
    writer::interface(&mut file, &card, "hil");
    let stamp_ns = 1_790_000_000_987_654_321;
    for (interface_index, direction, data) in [
        (0, Inbound, [&b"abc"[..], &b"defg"[..]]),
        (0, Outbound, [b"", b""]),
        (1, Unknown, [b"x", b""]),
    ] {
        let packet = PacketToWrite {
            interface_index,
            stamp_ns,
            original_bytes: 1500,
            direction,
            data,
        };
        writer::packet(&mut file, &packet);
    }
    writer::statistics(&mut file, 0, stamp_ns - 5, stamp_ns + 5, 12, 2, Some("why"));
    let (packets, faults, interfaces) = read(&file, 11);
    assert_eq!(faults, []);
    assert_eq!(packets[0].data, b"abcdefg");
    let directions: Vec<Direction> = packets.iter().map(|one| one.direction).collect();
    assert_eq!(directions, [Inbound, Outbound, Unknown]);
    for packet in &packets {
        assert_eq!(packet.stamp_ns, Some(stamp_ns.cast_signed()));
        assert_eq!(packet.original_bytes, 1500);
    }
    let of_nic: Vec<bool> = packets.iter().map(|one| one.is_nic_stamped).collect();
    assert_eq!(of_nic, [false, false, true]);
    assert_eq!(interfaces[1].description, card.description);
    let read_back = &interfaces[0];
    assert_eq!(read_back.name, interface.name);
    let watch = read_back.watch[0].unwrap();
    assert_eq!(watch.last_ns, (stamp_ns + 5).cast_signed());
    assert_eq!(read_back.repeats, None);
    assert_eq!(read_back.filter.as_deref(), Some("hil"));
    assert_eq!(
        (read_back.received_count, read_back.dropped_count),
        (Some(12), Some(2))
    );
}

#[test]
fn a_whole_second_in_the_fraction_is_carried_and_more_is_no_stamp() {
    let file = ORDERS[0].pcap(
        0xa1b2_c3d4,
        &[
            (7, 1_000_000, b"carried"),
            (7, 2_000_000, b"none"),
            (8, 1, b"fine"),
        ],
    );
    let (packets, faults, _) = read(&file, 64);
    assert_eq!(faults, []);
    let stamps: Vec<_> = packets.iter().map(|one| one.stamp_ns).collect();
    assert_eq!(stamps, [Some(8_000_000_000), None, Some(8_000_001_000)]);
}

#[test]
fn the_modified_format_names_interface_and_direction() {
    for maker in ORDERS {
        let mut file = maker.pcap(0xa1b2_cd34, &[]);
        for (kind, data) in [(0, b"in"), (4, b"ex")] {
            let words = [7, 42, 2, 2, 3].map(|one| maker.word(one)).concat();
            file.extend([words, maker.half(0x0800), vec![kind, 0], data.to_vec()].concat());
        }
        let (packets, faults, _) = read(&file, 5);
        assert_eq!(faults, []);
        let directions: Vec<_> = packets.iter().map(|one| one.direction).collect();
        assert_eq!(directions, [Direction::Inbound, Direction::Outbound]);
        assert_eq!(packets[0].stamp_ns, Some(7_000_042_000));
        assert_eq!(
            (packets[1].data.as_slice(), packets[1].offset),
            (&b"ex"[..], 50)
        );
    }
}

#[test]
fn drops_of_system_and_interface_count_and_a_later_section_may_repeat_an_interface() {
    let maker = ORDERS[0];
    let counts = [
        maker.word(0),
        maker.word(0),
        maker.word(0),
        maker.option(5, &3_u64.to_le_bytes()),
        maker.option(7, &4_u64.to_le_bytes()),
    ]
    .concat();
    let interface = maker.interface(&maker.option(2, b"lan1"));
    let file = [
        maker.section(-1),
        interface.clone(),
        maker.block(5, &counts),
        maker.section(-1),
        maker.interface(&maker.option(2, b"lan2")),
        interface,
    ]
    .concat();
    let (_, faults, interfaces) = read(&file, 64);
    assert_eq!(faults, []);
    assert_eq!(interfaces[0].dropped_count, Some(7));
    let repeats: Vec<_> = interfaces.iter().map(|one| one.repeats).collect();
    assert_eq!(repeats, [None, None, Some(0)]);
}
