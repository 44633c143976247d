//! What a capture cannot tell by itself: what its filter left out, pieces that never came, datagrams that look alike,
//! frames sent again by a radio, and stamps far from all others.

use super::super::CaptureInterface;
use super::super::join::{Doubt, Loss};
use super::super::writer::{self, PacketToWrite};
use super::cases::{
    BEGIN_US, datagram, doubts, enhanced, first_point, joins_by, joins_of, pcap, pcapng,
};
use hil_net::{Direction, link_type};

fn at_us(n: u32) -> i64 {
    BEGIN_US + 100_000 * i64::from(n) + 1000
}

/// A pcapng of a capture with this filter that has these numbers of the stream.
fn filtered(filter: &str, numbers: impl Iterator<Item = u32>) -> Vec<u8> {
    let mut file = Vec::new();
    writer::begin(&mut file, "test", "none");
    let interface = CaptureInterface {
        link_type: link_type::ETHERNET,
        ..CaptureInterface::default()
    };
    writer::interface(&mut file, &interface, filter);
    let at_ns = |n: u32| at_us(n).unsigned_abs() * 1000;
    for n in numbers {
        let frame = datagram(n, 32);
        let packet = PacketToWrite {
            interface_index: 0,
            stamp_ns: at_ns(n),
            original_bytes: u32::try_from(frame.len()).unwrap(),
            direction: Direction::Unknown,
            data: [&frame, &[]],
        };
        writer::packet(&mut file, &packet);
    }
    writer::statistics(&mut file, 0, at_ns(0), at_ns(100), 0, 0, None);
    file
}

#[test]
fn what_a_filter_may_have_left_out_is_not_lost() {
    let first = first_point();
    for filter in ["less 60", "udp port 5005", "tcp", "udp:dport=5005"] {
        let why = |count| {
            let filter = filter.to_owned();
            [(Doubt::Filtered { filter }, count)]
        };
        let some = &joins_of(
            &first,
            &filtered(filter, (0..100).filter(|n| n / 10 != 4)),
            true,
        )[0];
        assert_eq!(doubts(some), why(10), "{filter}: {some:#?}");
        assert!(matches!(
            some.loss,
            Loss::Unavailable {
                range: Some((0, 10)),
                ..
            }
        ));
        let none = &joins_of(&first, &filtered(filter, 0..0), true)[0];
        // The first left before the stated beginning.
        assert_eq!(doubts(none), why(99), "{filter}: {none:#?}");
        // Nothing is missing.
        let all = &joins_of(&first, &filtered(filter, 0..100), true)[0];
        assert_eq!(all.loss.count(), Some(0), "{filter}");
    }
    for filter in [
        "",
        "udp",
        "udp port 5004",
        "ip and not tcp",
        "udp:dport=5004,id=0+4",
    ] {
        let some = &joins_of(
            &first,
            &filtered(filter, (0..100).filter(|n| n / 10 != 4)),
            true,
        )[0];
        assert_eq!(some.loss.count(), Some(10), "{filter}: {some:#?}");
    }
}

/// The fragments of datagram `n`: 1480 bytes of the packet, and the rest.
fn in_fragments(n: u32) -> [Vec<u8>; 2] {
    let whole = datagram(n, 2000);
    [(0x20, 0, 34..34 + 1480), (0, 185, 34 + 1480..whole.len())].map(|(more, from, part)| {
        let mut frame = [&whole[..34], &whole[part]].concat();
        let bytes = u16::try_from(frame.len() - 14).unwrap();
        frame[16..18].copy_from_slice(&bytes.to_be_bytes());
        frame[18..20].copy_from_slice(&u16::try_from(n).unwrap().to_be_bytes());
        frame[20..22].copy_from_slice(&[more, from]);
        frame
    })
}

/// A capture of fragments; of datagram `n` those that `has` says by their place.
fn of_fragments(late_us: i64, order: [usize; 2], has: impl Fn(u32, usize) -> bool) -> Vec<u8> {
    let mut packets = Vec::new();
    for n in 0..50 {
        let fragments = in_fragments(n);
        for (at, place) in (0..).zip(order) {
            if has(n, place) {
                let at_us = BEGIN_US + 100_000 * i64::from(n) + late_us + at;
                packets.push((at_us, fragments[place].clone()));
            }
        }
    }
    pcap(&packets)
}

#[test]
fn a_datagram_that_lacks_a_fragment_has_not_arrived() {
    let first = of_fragments(0, [0, 1], |_, _| true);
    for order in [[0, 1], [1, 0]] {
        // Of five the second fragment never came, of three the first, of one neither.
        let second = of_fragments(1000, order, |n, place| match n {
            5 | 15 | 25 | 35 | 45 => place == 0,
            7 | 17 | 27 => place == 1,
            8 => false,
            _ => true,
        });
        let figures = &joins_of(&first, &second, true)[0];
        let told = (figures.loss.count(), figures.matched_count);
        assert_eq!(told, (Some(9), 41), "{order:?}: {figures:#?}");
    }
    // A capture of first fragments alone, as a filter by ports keeps them.
    let second = of_fragments(1000, [0, 1], |n, place| place == 0 && n != 20);
    let figures = &joins_of(&first, &second, true)[0];
    assert_eq!(doubts(figures), [(Doubt::Pieces, 49)], "{figures:#?}");
    // Such a one as the first point says when each left.
    let first = of_fragments(0, [0, 1], |n, place| place == 0 && n != 20);
    let second = of_fragments(1000, [0, 1], |_, _| true);
    let figures = &joins_of(&first, &second, true)[0];
    let told = (
        figures.loss.count(),
        figures.matched_count,
        figures.unexplained_count,
    );
    assert_eq!(told, (Some(0), 49, 1), "{figures:#?}");
}

/// A frame of a robot that holds still: payload, number of its packet, hop limit, and for which station it is.
fn still(packet_number: u16, hop_limit: u8, station: u8) -> Vec<u8> {
    let mut frame = datagram(7, 32);
    frame[5] = station;
    frame[18..20].copy_from_slice(&packet_number.to_be_bytes());
    frame[22] = hop_limit;
    frame
}

#[test]
fn equal_datagrams_for_other_stations_are_no_copies_but_by_their_packets() {
    let at = |n: u16| BEGIN_US + 10_000 * i64::from(n);
    let captured = |late_us: i64, frame: &dyn Fn(u16) -> Vec<Vec<u8>>| {
        let packets = (0..50).flat_map(|n| {
            let frames = frame(n).into_iter().zip(0..);
            frames.map(move |(frame, after)| (at(n) + late_us + after, frame))
        });
        pcap(&packets.collect::<Vec<_>>())
    };
    let first = captured(0, &|n| vec![still(n + 1, 64, 1)]);
    let in_turn = |n: u16| 1 + u8::from(n % 2 == 1);
    let later = |n: u16| 1 + u8::from(n >= 25);
    // The next hop changes once, or in turn; a host that numbers no packets; and both sides of a router, seen twice.
    let seconds = [
        captured(1000, &|n| vec![still(n + 1, 64, later(n))]),
        captured(1000, &|n| vec![still(n + 1, 64, in_turn(n))]),
        captured(1000, &|n| vec![still(0, 64, in_turn(n))]),
        captured(1000, &|n| vec![still(n + 1, 64, 1), still(n + 1, 63, 2)]),
        captured(1000, &|_| vec![still(0, 64, 1), still(0, 63, 2)]),
    ];
    for (at, second) in seconds.iter().enumerate() {
        let figures = &joins_by("udp:dport=5004", &first, second, true)[0];
        let told = (
            figures.loss.count(),
            figures.matched_count,
            figures.duplicated_count,
        );
        assert_eq!(told, (Some(0), 50, Some(0)), "{at}: {figures:#?}");
        assert_eq!(figures.delay.measured().unwrap().max_ns, 1_000_000, "{at}");
    }
}

#[test]
fn a_frame_that_a_radio_sends_again_bears_its_number() {
    let radio = |n: u16, is_retry: bool, frame: &[u8]| {
        let mut bytes = vec![0x88, 1 | u8::from(is_retry) << 3];
        bytes.extend([2; 20]);
        bytes.extend(((n & 0xfff) << 4).to_le_bytes());
        bytes.extend([0, 0, 0xaa, 0xaa, 3, 0, 0, 0, 8, 0]);
        bytes.extend(&frame[14..]);
        bytes
    };
    let at = |n: u16| BEGIN_US + 1000 * i64::from(n);
    // A counter of 8 bits, and a payload that does not change; every seventh frame is marked, of every 97th nothing came.
    let counted = |n: u16| datagram(u32::from(n), 32);
    let constant = |n: u16| still(n + 1, 64, 1);
    for (flow, frame) in [
        ("udp:dport=5004,id=3+1", &counted as &dyn Fn(u16) -> Vec<u8>),
        ("udp:dport=5004,id=0+4", &counted),
        ("udp:dport=5004", &constant),
    ] {
        let sent: Vec<_> = (0..200).map(|n| (at(n), frame(n))).collect();
        let (mut came, mut lost) = (Vec::new(), 0);
        for n in 0..200 {
            if n % 97 == 50 {
                lost += 1;
                continue;
            }
            came.push((at(n) + 300, radio(n, n % 7 == 0, &frame(n))));
            if n % 7 == 0 {
                came.push((at(n) + 400, radio(n, true, &frame(n))));
            }
        }
        let mut second = pcap(&came);
        second[20] = 105;
        let figures = &joins_by(flow, &pcap(&sent), &second, true)[0];
        assert_eq!(figures.duplicated_count, Some(0), "{flow}: {figures:#?}");
        assert_eq!(figures.second_count, 200 - lost, "{flow}: {figures:#?}");
        if flow.contains("id=") {
            assert_eq!(figures.matched_count, 200 - lost, "{flow}: {figures:#?}");
            let told = (figures.loss.count(), figures.reordered_count);
            assert_eq!(told, (Some(lost), 0), "{flow}: {figures:#?}");
        } else {
            // Which of equal datagrams a millisecond apart is which nothing tells: no figure rests on it.
            assert_eq!(figures.loss.count(), None, "{flow}: {figures:#?}");
            assert!(figures.delay_p50_interval.is_none(), "{flow}: {figures:#?}");
            assert!(
                figures.variation.measured().is_none(),
                "{flow}: {figures:#?}"
            );
        }
    }
}

#[test]
fn a_damaged_frame_has_not_arrived() {
    // Bits of the packet's flags, and whether they tell of damage.
    for (bit, lost) in [(24, 4), (26, 4), (31, 4), (27, 0), (16, 0)] {
        let packet = |n: u32| {
            let flags = if n % 25 == 5 { 1_u32 << bit } else { 0 };
            let option = [&[2, 0, 4, 0][..], &flags.to_le_bytes(), &[0; 4]].concat();
            (6, enhanced(0, n, &option))
        };
        let file = pcapng(&(0..100).map(packet).collect::<Vec<_>>());
        let figures = &joins_of(&first_point(), &file, true)[0];
        assert_eq!(figures.loss.count(), Some(lost), "bit {bit}: {figures:#?}");
    }
}

#[test]
fn a_count_of_all_ones_is_unknown_and_large_ones_add_up() {
    let counts = |interface: u32, count: u64| {
        let mut body = interface.to_le_bytes().to_vec();
        body.extend([0; 8]);
        for code in [5, 7] {
            body.extend([code, 0, 8, 0]);
            body.extend(count.to_le_bytes());
        }
        (5, body)
    };
    let packets = || {
        (0..100)
            .filter(|n| *n != 20)
            .map(|n| (6, enhanced(0, n, &[])))
    };
    let told = |count: u64| {
        let blocks: Vec<_> = packets().chain([counts(0, count)]).collect();
        joins_of(&first_point(), &pcapng(&blocks), true).remove(0)
    };
    assert_eq!(told(u64::MAX).loss.count(), Some(1));
    assert_eq!(doubts(&told(u64::MAX - 1)), [(Doubt::Dropped, u64::MAX)]);
    let file = |count: u64| {
        let blocks: Vec<_> = packets().chain([counts(0, count)]).collect();
        pcapng(&blocks)
    };
    // Two sections of one interface.
    let sections = [
        file(u64::MAX - 1),
        pcapng(&[(6, enhanced(0, 101, &[])), counts(0, 9)]),
    ]
    .concat();
    let figures = joins_of(&first_point(), &sections, true).remove(0);
    assert_eq!(doubts(&figures), [(Doubt::Dropped, u64::MAX)]);
}

#[test]
fn stamps_far_from_all_others_are_no_time_of_watching() {
    // The second point watched from number 10 on, or to number 79; number 50 is lost.
    let other = |at_us: i64| {
        let mut frame = datagram(0, 32);
        frame[12..14].copy_from_slice(&[8, 6]);
        (at_us, frame)
    };
    let numbers = |from: u32, to: u32| {
        let numbers = (from..to).filter(|n| *n != 50);
        numbers
            .map(|n| (at_us(n), datagram(n, 32)))
            .collect::<Vec<_>>()
    };
    let hour_us = 3_600_000_000;
    for by_us in [30_000_000, hour_us] {
        for count in [1, 2] {
            let far = |from_us: i64| (0..count).map(move |n| other(from_us + n * 50_000));
            let early: Vec<_> = far(at_us(10) - by_us).chain(numbers(10, 100)).collect();
            let ahead: Vec<_> = numbers(0, 80)
                .into_iter()
                .chain(far(at_us(79) + by_us))
                .collect();
            // And come back.
            let mut between = numbers(0, 80);
            between.splice(30..30, far(at_us(29) + by_us));
            for (packets, edge_count) in [(early, 10), (ahead, 20), (between, 20)] {
                let figures = &joins_of(&first_point(), &pcap(&packets), true)[0];
                let told = (figures.loss.count(), figures.edge_count);
                assert_eq!(
                    told,
                    (Some(1), edge_count),
                    "{by_us}, {count}: {figures:#?}"
                );
                assert!(figures.clock_steps[1].is_empty(), "{figures:#?}");
            }
        }
    }
    // A silence as others are, at the beginning: nothing came then.
    let mut packets = vec![other(at_us(0) - 1000)];
    packets.extend(numbers(10, 40));
    packets.extend(numbers(60, 100));
    let figures = &joins_of(&first_point(), &pcap(&packets), true)[0];
    assert_eq!(figures.loss.count(), Some(30), "{figures:#?}");
}
