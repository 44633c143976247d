//! Captures as people have them, each with a property that made a reader go wrong. In `cases/`: one
//! sender, 50 datagrams 10 ms apart on one clock, number 20 lost on the way; `ref_a.pcap` is the first
//! point, the others are the second.

use super::super::join::{Doubt, JoinMetrics, JoinSettings, Loss, OrderSource, WINDOW_NS};
use super::super::observe::Observer;
use super::super::pairing::join_all;
use super::super::reader::{CaptureReader, Step};
use super::super::watch::Unread;
use super::udp_frame;
use hil_net::Direction;

const REFERENCE: &[u8] = include_bytes!("cases/ref_a.pcap");

pub(super) fn take(observer: &mut Observer, file_index: usize, file: &[u8]) {
    let mut reader = CaptureReader::default();
    reader.feed(file);
    reader.end();
    loop {
        match reader.next_step() {
            Step::Packet(packet) => observer.take(file_index, &packet),
            Step::Fault(fault) => {
                assert!(fault.is_passed, "file {file_index}: {fault}");
                observer.take_broken(file_index);
            }
            Step::NeedsMore | Step::Ended => break,
        }
    }
    observer.finish(file_index, reader.interfaces());
}

pub(super) fn joins_of(first: &[u8], second: &[u8], is_one_clock: bool) -> Vec<JoinMetrics> {
    joins_by("udp:dport=5004,id=0+4", first, second, is_one_clock)
}

pub(super) fn joins_by(
    flow: &str,
    first: &[u8],
    second: &[u8],
    is_one_clock: bool,
) -> Vec<JoinMetrics> {
    let mut observer = Observer::new(&[flow.parse().unwrap()]);
    take(&mut observer, 0, first);
    take(&mut observer, 1, second);
    let settings = JoinSettings {
        window_ns: WINDOW_NS,
        is_one_clock,
    };
    let joins = join_all(&observer, &settings).into_iter();
    joins.map(|(_, joined)| joined.figures).collect()
}

/// The only join with the reference.
fn beside_reference(second: &[u8]) -> JoinMetrics {
    let mut joins = joins_of(REFERENCE, second, true);
    assert_eq!(joins.len(), 1, "{joins:#?}");
    joins.remove(0)
}

pub(super) fn doubts(figures: &JoinMetrics) -> Vec<(Doubt, u64)> {
    match &figures.loss {
        Loss::Counted(_) => Vec::new(),
        Loss::Unavailable { doubts, .. } => {
            let doubts = doubts.iter();
            doubts.map(|one| (one.doubt.clone(), one.count)).collect()
        }
    }
}

#[test]
fn what_was_watched_and_seen_is_judged_and_nothing_else() {
    // File, lost, at an edge.
    for (name, file, lost, edge_count) in [
        ("late_b", &include_bytes!("cases/late_b.pcap")[..], 1, 10),
        (
            "late_isb_us_b",
            include_bytes!("cases/late_isb_us_b.pcapng"),
            1,
            10,
        ),
        (
            "late_1970_b",
            include_bytes!("cases/late_1970_b.pcap"),
            1,
            10,
        ),
        (
            "link_null_b",
            include_bytes!("cases/link_null_b.pcap"),
            1,
            0,
        ),
        (
            "onemillion_b",
            include_bytes!("cases/onemillion_b.pcap"),
            1,
            0,
        ),
        ("stepback_b", include_bytes!("cases/stepback_b.pcap"), 1, 0),
        (
            "sections_b",
            include_bytes!("cases/sections_b.pcapng"),
            0,
            0,
        ),
    ] {
        let figures = beside_reference(file);
        assert_eq!(figures.loss.count(), Some(lost), "{name}: {figures:#?}");
        assert_eq!(figures.edge_count, edge_count, "{name}: {figures:#?}");
        let wrong = (figures.duplicated_count, figures.unexplained_count);
        assert_eq!(wrong, (Some(0), 0), "{name}");
        assert_eq!(figures.reordered_count, 0, "{name}");
        let is_set = name == "stepback_b";
        assert_eq!(figures.clock_steps[1].len(), usize::from(is_set), "{name}");
        assert_eq!(figures.delay.measured().is_none(), is_set, "{name}");
    }
}

#[test]
fn what_a_point_could_not_show_makes_loss_unavailable_by_name() {
    let short = beside_reference(include_bytes!("cases/snap44_b.pcap"));
    let why = Doubt::Unread(Unread::CutShort);
    assert_eq!(doubts(&short), [(why, 49)], "{short:#?}");
    let dropped = beside_reference(include_bytes!("cases/ifdrop_b.pcapng"));
    assert_eq!(doubts(&dropped), [(Doubt::Dropped, 3)], "{dropped:#?}");
    let range = match dropped.loss {
        Loss::Unavailable { range, .. } => range,
        Loss::Counted(_) => None,
    };
    assert_eq!(range, Some((0, 3)));
    let mut foreign = include_bytes!("cases/link_null_b.pcap").to_vec();
    foreign[20..24].copy_from_slice(&147_u32.to_le_bytes());
    let why = Doubt::Unread(Unread::LinkType { link_type: 147 });
    assert_eq!(doubts(&beside_reference(&foreign)), [(why, 49)]);
}

#[test]
fn a_capture_on_any_is_told_apart_by_interface_and_packet_type() {
    let (a, b) = (
        include_bytes!("cases/any_sll2_a.pcap"),
        include_bytes!("cases/any_sll2_b.pcap"),
    );
    for (first, second) in [(&a[..], &b[..]), (b, a)] {
        for is_one_clock in [false, true] {
            let joins = joins_of(first, second, is_one_clock);
            assert_eq!(joins.len(), 1, "{joins:#?}");
            assert_eq!(joins[0].order, OrderSource::PacketDirection);
            assert_eq!(joins[0].first_count, 50);
            // The second clock is 2 ms behind: were it one, the datagrams would have gone the other way.
            let told = if is_one_clock {
                (None, vec![(Doubt::Order, 1)])
            } else {
                (Some(1), Vec::new())
            };
            assert_eq!((joins[0].loss.count(), doubts(&joins[0])), told);
        }
    }
    let joins = joins_of(REFERENCE, include_bytes!("cases/any_bridge_b.pcap"), true);
    let lost: Vec<_> = joins.iter().map(|one| one.loss.count()).collect();
    assert_eq!(lost, [Some(1), Some(1), Some(0)], "{joins:#?}");
    assert!(joins.iter().all(|one| one.duplicated_count == Some(0)));
}

/// A pcap of Ethernet frames: microseconds since 1970, and the frame.
pub(super) fn pcap(packets: &[(i64, Vec<u8>)]) -> Vec<u8> {
    let mut file = REFERENCE[..24].to_vec();
    for (at_us, frame) in packets {
        let length = u32::try_from(frame.len()).unwrap();
        let word = |value: i64| u32::try_from(value).unwrap();
        for word in [
            word(at_us / 1_000_000),
            word(at_us % 1_000_000),
            length,
            length,
        ] {
            file.extend(word.to_le_bytes());
        }
        file.extend(frame);
    }
    file
}

pub(super) const BEGIN_US: i64 = 1_700_000_000_000_000;

/// Number `n` of the stream, so many bytes long.
pub(super) fn datagram(n: u32, bytes: usize) -> Vec<u8> {
    let mut payload = n.to_be_bytes().to_vec();
    payload.resize(bytes, 7);
    udp_frame(5000, 5004, &payload)
}

/// Datagrams 0..100, a tenth of a second apart, without number 20 and as `at` says.
pub(super) fn second_point(at: impl Fn(i64) -> i64) -> Vec<u8> {
    let numbers = (0..100).filter(|n| *n != 20);
    let packet = |n: i64| (at(n), datagram(u32::try_from(n).unwrap(), 32));
    pcap(&numbers.map(packet).collect::<Vec<_>>())
}

pub(super) fn first_point() -> Vec<u8> {
    let packet = |n: i64| {
        (
            BEGIN_US + 100_000 * n,
            datagram(u32::try_from(n).unwrap(), 32),
        )
    };
    pcap(&(0..100).map(packet).collect::<Vec<_>>())
}

#[test]
fn a_clock_that_is_set_hides_no_loss_and_reorders_nothing() {
    let sent_us = |n: i64| BEGIN_US + 100_000 * n + 1000;
    // Set before number 50, by so many microseconds; and the frames of 1970 before a clock was set.
    for by_us in [-1_000_000, -40_000_000, -86_400_000_000, 3_000_000] {
        let file = second_point(|n| sent_us(n) + if n < 50 { 0 } else { by_us });
        let joins = joins_of(&first_point(), &file, true);
        let figures = &joins[0];
        assert_eq!(figures.loss.count(), Some(1), "{by_us}: {figures:#?}");
        assert_eq!(
            (figures.edge_count, figures.reordered_count),
            (0, 0),
            "{by_us}"
        );
        let is_told = !figures.clock_steps[1].is_empty() || !figures.delay_shifts.is_empty();
        assert!(is_told, "{by_us}: {figures:#?}");
    }
    let file = second_point(|n| {
        if n < 10 {
            5_000_000 + 100_000 * n
        } else {
            sent_us(n)
        }
    });
    let figures = &joins_of(&first_point(), &file, true)[0];
    assert_eq!(
        (figures.loss.count(), figures.edge_count),
        (Some(1), 0),
        "{figures:#?}"
    );
    // Parts of a file out of order are put in order: no clock was set.
    let numbers = (60..100).chain(0..60).filter(|n| *n != 20);
    let packet = |n: i64| (sent_us(n), datagram(u32::try_from(n).unwrap(), 32));
    let file = pcap(&numbers.map(packet).collect::<Vec<_>>());
    let figures = &joins_of(&first_point(), &file, true)[0];
    assert_eq!(
        (figures.loss.count(), figures.reordered_count),
        (Some(1), 0),
        "{figures:#?}"
    );
    assert_eq!(figures.delay.measured().unwrap().p50_ns, 1_000_000);
}

#[test]
fn small_steps_back_are_steps_and_late_packets_are_none() {
    let sent_us = |n: i64| BEGIN_US + 100_000 * n + 1000;
    for by_us in [-101_500, -120_000, -150_000, -190_000] {
        let file = second_point(|n| sent_us(n) + if n < 50 { 0 } else { by_us });
        let figures = &joins_of(&first_point(), &file, true)[0];
        let told = (figures.loss.count(), figures.reordered_count);
        assert_eq!(told, (Some(1), 0), "{by_us}: {figures:#?}");
        assert_eq!(figures.clock_steps[1].len(), 1, "{by_us}");
    }
    // Brought by another queue a little later: in the file behind its successor.
    let mut numbers: Vec<i64> = (0..100).filter(|n| *n != 20).collect();
    (30..90).step_by(10).for_each(|at| numbers.swap(at, at + 1));
    let sent_us = |n: i64| BEGIN_US + 20_000 * n;
    let packet = |n: &i64, late_us| {
        let number = u32::try_from(*n).unwrap();
        (sent_us(*n) + late_us, datagram(number, 32))
    };
    let first: Vec<_> = (0..100).map(|n| packet(&n, 0)).collect();
    let second: Vec<_> = numbers.iter().map(|n| packet(n, 1000)).collect();
    let figures = &joins_of(&pcap(&first), &pcap(&second), true)[0];
    let told = (figures.loss.count(), figures.reordered_count);
    assert_eq!(told, (Some(1), 0), "{figures:#?}");
    assert!(figures.clock_steps[1].is_empty(), "{figures:#?}");
    assert_eq!(figures.delay.measured().unwrap().max_ns, 1_000_000);
}

#[test]
fn points_that_have_no_time_in_common_tell_no_loss() {
    let sent_us = |n: i64| BEGIN_US + 100_000 * n;
    // A clock set on by more than the window, at once or while it stamped.
    for from in [0, 50] {
        let file = second_point(|n| sent_us(n) + if n < from { 0 } else { 10_000_000 });
        let joins = joins_of(&first_point(), &file, true);
        let why = doubts(&joins[0]);
        assert!(
            matches!(why[..], [(Doubt::Apart, 50 | 99)]),
            "{from}: {joins:#?}"
        );
    }
    let other = pcap(&[(sent_us(5000), datagram(5000, 32)); 1]);
    let empty = &REFERENCE[..24];
    for second in [&other[..], empty] {
        let joins = joins_of(&first_point(), second, true);
        assert_eq!(doubts(&joins[0])[0].0, Doubt::Unwatched, "{joins:#?}");
    }
    // First fragments of datagrams that are known by all of their payload.
    let mut fragments = Vec::new();
    for n in 0..10 {
        let mut frame = datagram(n, 32);
        frame[20] |= 0x20;
        fragments.push((sent_us(n.into()), frame));
    }
    let file = pcap(&fragments);
    let joins = joins_by("udp:dport=5004", &file, &file, true);
    let why = (Doubt::Unread(Unread::Fragmented), 10);
    assert_eq!(doubts(&joins[0]), [why.clone(), why], "{joins:#?}");
}

/// A pcapng of one interface and these blocks, by type and body.
pub(super) fn pcapng(blocks: &[(u32, Vec<u8>)]) -> Vec<u8> {
    let block = |kind: u32, body: &[u8]| {
        let length = u32::try_from(12 + body.len()).unwrap().to_le_bytes();
        [&kind.to_le_bytes()[..], &length, body, &length].concat()
    };
    let section = [
        &0x1a2b_3c4d_u32.to_le_bytes()[..],
        &[1, 0, 0, 0],
        &[0xff; 8],
    ]
    .concat();
    let mut file = block(0x0a0d_0d0a, &section);
    // Microseconds.
    file.extend(block(1, &[1, 0, 0, 0, 0, 0, 0, 0]));
    for (kind, body) in blocks {
        file.extend(block(*kind, body));
    }
    file
}

/// An enhanced packet block's body, with options.
pub(super) fn enhanced(interface: u32, n: u32, options: &[u8]) -> Vec<u8> {
    let at_us = (BEGIN_US + 100_000 * i64::from(n) + 1000).unsigned_abs();
    let mut frame = datagram(n, 32);
    let length = u32::try_from(frame.len()).unwrap();
    frame.resize(frame.len().next_multiple_of(4), 0);
    let words = [
        interface,
        u32::try_from(at_us >> 32).unwrap(),
        (at_us & 0xffff_ffff) as u32,
        length,
        length,
    ];
    let words = words.map(u32::to_le_bytes);
    [words.as_flattened(), &frame, options].concat()
}

#[test]
fn what_packet_blocks_tell_of_drops_and_what_cannot_be_read_of_them_makes_loss_unavailable() {
    let numbers = || (0..100_u32).filter(|n| ![20, 21].contains(n));
    let with_drops = |n: u32| {
        let count = u8::from(n == 22) * 2;
        let option = [&[4, 0, 8, 0, count][..], &[0; 11]].concat();
        (6, enhanced(0, n, &option))
    };
    let file = pcapng(&numbers().map(with_drops).collect::<Vec<_>>());
    let joins = joins_of(&first_point(), &file, true);
    assert_eq!(doubts(&joins[0]), [(Doubt::Dropped, 2)], "{joins:#?}");

    let of_unknown = |n: u32| (6, enhanced(u32::from(n == 60), n, &[]));
    let file = pcapng(&numbers().map(of_unknown).collect::<Vec<_>>());
    let joins = joins_of(&first_point(), &file, true);
    let why = Doubt::Unread(Unread::Malformed);
    assert_eq!(doubts(&joins[0]), [(why, 1)], "{joins:#?}");

    let without_stamp = |n: u32| {
        let body = enhanced(0, n, &[]);
        (3, [&body[16..20], &body[20..]].concat())
    };
    let file = pcapng(&numbers().map(without_stamp).collect::<Vec<_>>());
    let joins = joins_of(&first_point(), &file, true);
    let why = Doubt::Unread(Unread::NoStamp);
    assert_eq!(doubts(&joins[0]), [(why, 98)], "{joins:#?}");
}

#[test]
fn interfaces_of_a_merged_file_share_no_clock() {
    // The second interface's clock is 3 ms behind, and number 20 is lost before it.
    let mut blocks = vec![(1, vec![1, 0, 0, 0, 0, 0, 0, 0])];
    for n in 0..100 {
        blocks.push((6, enhanced(0, n, &[])));
        if n != 20 {
            let mut early = enhanced(1, n, &[]);
            let low = u32::from_le_bytes([early[8], early[9], early[10], early[11]]);
            early[8..12].copy_from_slice(&(low - 2000).to_le_bytes());
            blocks.push((6, early));
        }
    }
    let file = pcapng(&blocks);
    // The section says by option 4 who wrote it.
    let merged = {
        let option = [&[4, 0, 8, 0][..], b"Mergecap", &[0; 4]].concat();
        let mut merged = file.clone();
        merged.splice(24..24, option);
        for at in [4, 40] {
            merged[at] = 44;
        }
        merged
    };
    for (file, order, lost) in [
        (&file, OrderSource::Stamps, 0),
        (&merged, OrderSource::Missing, 1),
    ] {
        let mut observer = Observer::new(&["udp:dport=5004,id=0+4".parse().unwrap()]);
        take(&mut observer, 0, file);
        let settings = JoinSettings {
            window_ns: WINDOW_NS,
            is_one_clock: false,
        };
        let (_, joined) = &join_all(&observer, &settings)[0];
        let told = (joined.figures.order, joined.figures.loss.count());
        assert_eq!(told, (order, Some(lost)), "{joined:#?}");
    }
}

#[test]
fn a_datagram_on_two_links_of_one_host_is_no_duplicate() {
    let sent_us = |n: u32| BEGIN_US + 100_000 * i64::from(n) + 1000;
    // A cooked capture of a bridge that names no interface; and a mirrored port, on both sides of a router.
    let cooked = |n: u32| [&[0; 14][..], &datagram(n, 32)[12..]].concat();
    let mirrored = |n: u32, side: u8| {
        let mut frame = datagram(n, 32);
        frame[5] = side;
        frame
    };
    for link_type in [113, 1] {
        let copy = |n, side| {
            if link_type == 113 {
                cooked(n)
            } else {
                mirrored(n, side)
            }
        };
        let packets = (0..100)
            .filter(|n| *n != 20)
            .flat_map(|n| [(sent_us(n), copy(n, 1)), (sent_us(n) + 5, copy(n, 2))]);
        let mut file = pcap(&packets.collect::<Vec<_>>());
        file[20] = link_type;
        let figures = &joins_of(&first_point(), &file, true)[0];
        let told = (figures.loss.count(), figures.duplicated_count);
        // Without interfaces a duplicate looks the same.
        let duplicated_count = (link_type == 1).then_some(0);
        assert_eq!(
            told,
            (Some(1), duplicated_count),
            "{link_type}: {figures:#?}"
        );
    }
    let packets = (0..100).flat_map(|n| {
        [
            (sent_us(n), datagram(n, 32)),
            (sent_us(n) + 5, datagram(n, 32)),
        ]
    });
    let twice = pcap(&packets.collect::<Vec<_>>());
    let figures = &joins_of(&first_point(), &twice, true)[0];
    assert_eq!(figures.duplicated_count, Some(100), "{figures:#?}");
}

#[test]
fn equal_datagrams_of_a_capture_on_any_are_no_copies_but_by_their_packets() {
    // A robot that holds still, at 1 kHz; of a host that numbers its packets, and of one that does not.
    let cooked = |packet_number: u16| {
        let mut frame = [&[0; 14][..], &datagram(7, 32)[12..]].concat();
        frame[20..22].copy_from_slice(&packet_number.to_be_bytes());
        frame
    };
    for flow in ["udp:dport=5004", "udp:dport=5004,id=3+1"] {
        for (is_numbered, copy_count, told) in [
            (true, 1, [100, 0]),
            (true, 2, [100, 100]),
            (false, 1, [100, 0]),
        ] {
            let packets = (0..100 * copy_count).map(|n| {
                let n = n / copy_count;
                let number = if is_numbered { n + 1 } else { 0 };
                (BEGIN_US + 1000 * i64::from(n), cooked(number))
            });
            let mut file = pcap(&packets.collect::<Vec<_>>());
            file[20] = 113;
            let mut observer = Observer::new(&[flow.parse().unwrap()]);
            take(&mut observer, 0, &file);
            let counts = observer.counts();
            let found = [counts.followed_count, counts.elsewhere_count];
            assert_eq!(found, told, "{flow}, {is_numbered}");
        }
    }
}

#[test]
fn a_cooked_capture_of_any_tells_no_duplicates_of_a_host_that_numbers_no_packets() {
    let cooked = |n: u32| [&[0; 14][..], &datagram(n, 32)[12..]].concat();
    for (copy_count, told) in [(1, Some(0)), (2, None)] {
        let packets = (0..100 * copy_count).map(|n| {
            let n = n / copy_count;
            (BEGIN_US + 100_000 * i64::from(n) + 1000, cooked(n))
        });
        let mut file = pcap(&packets.collect::<Vec<_>>());
        file[20] = 113;
        for flow in ["udp:dport=5004", "udp:dport=5004,id=0+4"] {
            let figures = &joins_by(flow, &first_point(), &file, true)[0];
            let found = (figures.loss.count(), figures.duplicated_count);
            assert_eq!(found, (Some(0), told), "{flow}: {figures:#?}");
        }
    }
}

#[test]
fn encrypted_packets_of_other_hosts_hide_nothing_of_a_flow_that_is_seen() {
    let sealed = |last: u8| {
        let mut frame = datagram(0, 32);
        (frame[23], frame[33]) = (50, last);
        frame
    };
    let second = |last: u8, is_readable: bool| {
        let numbers = (0..100).filter(|n| *n != 20);
        let packet = |n: u32| {
            let at_us = BEGIN_US + 100_000 * i64::from(n) + 1000;
            let frame = if n % 10 == 9 || !is_readable {
                sealed(last)
            } else {
                datagram(n, 32)
            };
            (at_us, frame)
        };
        pcap(&numbers.map(packet).collect::<Vec<_>>())
    };
    let readable = first_point();
    let of_others = &joins_of(&readable, &second(9, true), true)[0];
    assert_eq!(of_others.loss.count(), Some(11), "{of_others:#?}");
    let of_its_hosts = &joins_of(&readable, &second(2, true), true)[0];
    let encrypted = Doubt::Unread(Unread::Encrypted);
    assert_eq!(doubts(of_its_hosts), [(encrypted, 10)]);
    // A tunnel between other ends, of which nothing but that is seen.
    for joined in joins_of(&readable, &second(9, false), true) {
        assert_eq!(joined.loss.count(), None, "{joined:#?}");
    }
}

#[test]
fn an_aggregate_is_no_datagram() {
    // Ten frames of ten datagrams each, sent by segmentation offload.
    let large = (0..10).map(|n| (BEGIN_US + 10_000 * i64::from(n), datagram(10 * n, 10_000)));
    let large = pcap(&large.collect::<Vec<_>>());
    let small = (0..100).map(|n| (BEGIN_US + 1000 * i64::from(n) + 500, datagram(n, 1000)));
    let small = pcap(&small.collect::<Vec<_>>());
    for (first, second) in [(&large, &small), (&small, &large)] {
        let joins = joins_of(first, second, true);
        let (why, count) = &doubts(&joins[0])[0];
        assert_eq!(*why, Doubt::Unread(Unread::Aggregate));
        assert!(*count >= 10, "{joins:#?}");
    }
    // Small ones, together smaller than a frame; known by number or by payload.
    let ten = |n: u32| {
        let ten = (n..n + 10).flat_map(|n| datagram(n, 32)[42..].to_vec());
        udp_frame(5000, 5004, &ten.collect::<Vec<_>>())
    };
    let at_us = |n: u32| BEGIN_US + 10_000 * i64::from(n);
    let large: Vec<_> = (0..100).step_by(10).map(|n| (at_us(n), ten(n))).collect();
    let large = pcap(&large);
    let small: Vec<_> = (0..100)
        .map(|n| (at_us(n) + 500, datagram(n, 32)))
        .collect();
    let small = pcap(&small);
    for flow in ["udp:dport=5004,id=0+4", "udp:dport=5004"] {
        for (first, second) in [(&large, &small), (&small, &large)] {
            let joins = joins_by(flow, first, second, true);
            let (why, _) = &doubts(&joins[0])[0];
            assert_eq!(*why, Doubt::Unread(Unread::Aggregate), "{flow}: {joins:#?}");
        }
    }
    // A large one that was lost, and small ones that the first point missed and that are not its pieces.
    let sized = |n: u32| if n == 20 { 300 } else { 32 };
    let without = |missing: &[u32], late_us: i64| {
        let numbers = (0..100).filter(|n| !missing.contains(n));
        let packet = |n: u32| (at_us(n) + late_us, datagram(n, sized(n)));
        pcap(&numbers.map(packet).collect::<Vec<_>>())
    };
    let joins = joins_of(&without(&[60, 61], 0), &without(&[20], 500), true);
    assert_eq!(joins[0].loss.count(), Some(1), "{joins:#?}");
    // As large at both points: a link with jumbo frames, on which one was lost.
    let jumbo = |lost: u32, late_us: i64| {
        let numbers = (0..50).filter(|n| *n != lost);
        let packet = |n: u32| (BEGIN_US + 1000 * i64::from(n) + late_us, datagram(n, 8000));
        pcap(&numbers.map(packet).collect::<Vec<_>>())
    };
    let joins = joins_of(&jumbo(99, 0), &jumbo(20, 500), true);
    assert_eq!(joins[0].loss.count(), Some(1), "{joins:#?}");
}

#[test]
fn without_directions_or_one_clock_the_ends_are_told_apart_by_what_no_clock_changes() {
    // The second clock is 3 ms behind, so that most stamps are earlier where it arrived.
    let late_us = |n: i64| BEGIN_US + 100_000 * n - 3000;
    let joins = joins_of(&first_point(), &second_point(late_us), false);
    assert_eq!(
        (joins[0].order, joins[0].loss.count()),
        (OrderSource::Missing, Some(1))
    );
    // Named the other way, that capture may have begun by missing it, unless it states that it dropped none.
    let joins = joins_of(&second_point(late_us), &first_point(), false);
    assert_eq!(joins[0].order, OrderSource::Missing);
    assert_eq!(doubts(&joins[0]), [(Doubt::Order, 1)], "{joins:#?}");
    let numbers = (0..100).filter(|n| *n != 20);
    let packets = numbers.map(|n| (6, enhanced(0, n, &[])));
    // Interface statistics: none dropped.
    let statistics = [&[0; 12][..], &[5, 0, 8, 0], &[0; 12]].concat();
    let blocks: Vec<_> = packets.chain([(5, statistics)]).collect();
    let joins = joins_of(&pcapng(&blocks), &first_point(), false);
    let told = (joins[0].order, joins[0].loss.count());
    assert_eq!(told, (OrderSource::Missing, Some(1)), "{joins:#?}");

    let routed = |file: &[u8]| {
        let mut file = file.to_vec();
        for record in file[24..].chunks_mut(16 + 74) {
            record[16 + 22] -= 1;
        }
        file
    };
    let joins = joins_of(&routed(&second_point(late_us)), &first_point(), false);
    assert_eq!(
        (joins[0].order, joins[0].loss.count()),
        (OrderSource::HopLimit, Some(1))
    );

    // Each point lacks one: which was lost and which not captured, nothing tells.
    let mut packets: Vec<_> = (0..100).filter(|n| *n != 60).collect();
    packets.retain(|n| *n != 99);
    let first = packets
        .iter()
        .map(|n| (BEGIN_US + 100_000 * i64::from(*n), datagram(*n, 32)));
    let joins = joins_of(
        &pcap(&first.collect::<Vec<_>>()),
        &second_point(late_us),
        false,
    );
    assert_eq!(joins[0].order, OrderSource::Unknown);
    assert_eq!(doubts(&joins[0]), [(Doubt::Order, 2)], "{joins:#?}");
}

#[test]
fn frames_of_one_interface_with_other_tags_passed_other_points() {
    // A router on one port: in by VLAN 5, out by VLAN 6.
    let tagged = |n: u32, vlan: u8| {
        let frame = datagram(n, 32);
        [&frame[..12], &[0x81, 0, 0, vlan], &frame[12..]].concat()
    };
    let packets = (0..50).flat_map(|n| {
        let at_us = BEGIN_US + 1000 * i64::from(n);
        [(at_us, tagged(n, 5)), (at_us + 20, tagged(n, 6))]
    });
    let file = pcap(&packets.collect::<Vec<_>>());
    let mut observer = Observer::new(&["udp:dport=5004,id=0+4".parse().unwrap()]);
    take(&mut observer, 0, &file);
    let settings = JoinSettings {
        window_ns: WINDOW_NS,
        is_one_clock: false,
    };
    let joins = join_all(&observer, &settings);
    assert_eq!(joins.len(), 1, "{joins:#?}");
    let (_, joined) = &joins[0];
    assert_eq!(
        (joined.first_point.vlans, joined.second_point.vlans),
        ([0, 5], [0, 6])
    );
    assert_eq!(joined.first_point.direction, Direction::Unknown);
    assert_eq!(joined.figures.duplicated_count, Some(0));
    assert_eq!(joined.figures.loss.count(), Some(0));
}

/// A packet block: which interface, its stamp in the interface's unit, which way (1 in, 2 out, 0 unknown).
fn packet(interface: u32, units: i64, way: u8, frame: &[u8]) -> (u32, Vec<u8>) {
    let units = units.unsigned_abs();
    let length = u32::try_from(frame.len()).unwrap();
    let words = [
        interface,
        u32::try_from(units >> 32).unwrap(),
        (units & 0xffff_ffff) as u32,
        length,
        length,
    ];
    let words = words.map(u32::to_le_bytes);
    let mut body = [words.as_flattened(), frame].concat();
    body.resize(body.len().next_multiple_of(4), 0);
    body.extend([2, 0, 4, 0, way, 0, 0, 0, 0, 0, 0, 0]);
    (6, body)
}

/// A further interface, with stamps of `10^-digits` seconds.
fn interface(link_type: u8, digits: u8) -> (u32, Vec<u8>) {
    let option = [9, 0, 1, 0, digits, 0, 0, 0, 0, 0, 0, 0];
    (1, [&[link_type, 0, 0, 0, 0, 0, 0, 0][..], &option].concat())
}

fn routed(n: i64, hop_limit: u8) -> Vec<u8> {
    let mut frame = datagram(u32::try_from(n).unwrap(), 32);
    frame[22] = hop_limit;
    frame
}

/// Numbers 0..50 but 20.
fn arrived() -> impl Iterator<Item = i64> {
    (0..50).filter(|n| *n != 20)
}

const fn sent_us(n: i64) -> i64 {
    BEGIN_US + 10_000 * n
}

/// Datagrams 0..50, 10 ms apart.
fn sent_50() -> Vec<u8> {
    let packet = |n: i64| (sent_us(n), routed(n, 64));
    pcap(&(0..50).map(packet).collect::<Vec<_>>())
}

#[test]
fn a_router_captured_in_a_file_for_each_tap_is_passed_from_in_to_out() {
    let came = (0..50).map(|n| packet(0, sent_us(n), 1, &routed(n, 64)));
    let left = arrived().map(|n| packet(0, sent_us(n) + 30, 2, &routed(n, 63)));
    let came = pcapng(&came.collect::<Vec<_>>());
    let left = pcapng(&left.collect::<Vec<_>>());
    for is_one_clock in [false, true] {
        for (a, b) in [(&came, &left), (&left, &came)] {
            let figures = &joins_of(a, b, is_one_clock)[0];
            let told = (figures.first_count, figures.loss.count());
            assert_eq!(told, (50, Some(1)), "{figures:#?}");
            assert_eq!(figures.order, OrderSource::HopLimit);
            assert_eq!(figures.delay.measured().unwrap().p50_ns, 30_000);
        }
    }
}

#[test]
fn stamps_that_differ_by_less_than_their_unit_tell_no_order() {
    // 0.3 ms on the way from 0.5 ms after a full one: in whole milliseconds they come before they leave.
    let left = (0..50).map(|n| (sent_us(n) + 500, routed(n, 64)));
    let first = pcap(&left.collect::<Vec<_>>());
    let ms = arrived().map(|n| packet(1, sent_us(n) / 1000, 0, &routed(n, 64)));
    let stated = pcapng(&[vec![interface(1, 3)], ms.collect()].concat());
    let figures = &joins_of(&first, &stated, true)[0];
    let told = (figures.order, figures.loss.count());
    assert_eq!(told, (OrderSource::Missing, Some(1)), "{figures:#?}");
    // In a file of microseconds, a clock that ticks every 40 ms.
    let ticks = arrived().map(|n| (sent_us(n) / 40_000 * 40_000, routed(n, 64)));
    let figures = &joins_of(&first, &pcap(&ticks.collect::<Vec<_>>()), true)[0];
    let told = (figures.order, figures.loss.count());
    assert_eq!(told, (OrderSource::Missing, Some(1)), "{figures:#?}");
}

#[test]
fn of_equal_stamps_the_file_tells_which_came_first() {
    // 10 comes behind 12, and 30 behind 33, under stamps of 100 ms.
    let mut numbers: Vec<i64> = arrived().collect();
    for (number, behind) in [(10, 12), (30, 33)] {
        numbers.retain(|n| *n != number);
        let at = numbers.iter().position(|n| *n == behind).unwrap();
        numbers.insert(at + 1, number);
    }
    let packets = numbers.iter().zip(arrived()).map(|(n, place)| {
        let at_us = (sent_us(place) + 100_999) / 100_000 * 100_000;
        (at_us, routed(*n, 64))
    });
    let figures = &joins_of(&sent_50(), &pcap(&packets.collect::<Vec<_>>()), true)[0];
    let told = (figures.reordered_count, figures.reordering_extent_max);
    assert_eq!(told, (2, 3), "{figures:#?}");
    assert_eq!(figures.loss.count(), Some(1));
}

#[test]
fn each_change_of_the_level_is_told_and_withdraws_delays_and_stamps_tell_no_order_across_it() {
    let set = |at: &[(i64, i64)], n: i64| -> i64 {
        let passed = at.iter().filter(|(from, _)| n >= *from);
        passed.map(|(_, by_us)| by_us).sum()
    };
    for (at, told) in [
        (
            &[(15, 1_000_000), (30, 1_000_000)][..],
            &[1_000_000_000, 1_000_000_000][..],
        ),
        (
            &[(15, 100_000), (30, 2_000_000)],
            &[100_000_000, 2_000_000_000],
        ),
        (
            &[(15, 200_000), (25, 300_000), (40, 200_000)],
            &[200_000_000, 300_000_000, 200_000_000],
        ),
    ] {
        let packets = arrived().map(|n| (sent_us(n) + 1000 + set(at, n), routed(n, 64)));
        let figures = &joins_of(&sent_50(), &pcap(&packets.collect::<Vec<_>>()), true)[0];
        let by_ns: Vec<i64> = figures.delay_shifts.iter().map(|one| one.by_ns).collect();
        assert_eq!(by_ns, told, "{figures:#?}");
        assert_eq!(figures.delay.measured(), None);
        assert_eq!((figures.loss.count(), figures.edge_count), (Some(1), 0));
    }
    // Set at the first point, by a second: half of the datagrams seem to come before they left.
    let left = (0..50).map(|n| (sent_us(n) + set(&[(25, 1_000_000)], n), routed(n, 64)));
    let came = arrived().map(|n| (sent_us(n) + 1000, routed(n, 64)));
    let (left, came) = (left.collect::<Vec<_>>(), came.collect::<Vec<_>>());
    let figures = &joins_of(&pcap(&left), &pcap(&came), true)[0];
    assert_eq!((figures.first_count, figures.loss.count()), (50, Some(1)));
    assert_eq!(figures.delay_shifts.len(), 1, "{figures:#?}");
    // Every other stamp of the second point is that of 1970.
    let zero = arrived().map(|n| {
        (
            if n % 2 == 0 { sent_us(n) + 1000 } else { 0 },
            routed(n, 64),
        )
    });
    let figures = &joins_of(&sent_50(), &pcap(&zero.collect::<Vec<_>>()), true)[0];
    let told = (figures.order, figures.first_count, figures.loss.count());
    assert_eq!(told, (OrderSource::Stamps, 50, Some(1)), "{figures:#?}");
}

#[test]
fn what_lies_at_an_edge_tells_no_order_and_what_a_capture_may_have_missed_is_in_doubt() {
    let came = pcap(
        &(0..50)
            .map(|n| (sent_us(n) + 1000, routed(n, 64)))
            .collect::<Vec<_>>(),
    );
    let from_10 = (10..50).map(|n| (sent_us(n), routed(n, 64)));
    let figures = &joins_of(&pcap(&from_10.collect::<Vec<_>>()), &came, false)[0];
    let told = (
        figures.order,
        figures.first_count,
        figures.loss.count(),
        figures.edge_count,
    );
    assert_eq!(
        told,
        (OrderSource::Unknown, 40, Some(0), 10),
        "{figures:#?}"
    );
    let leaky = (0..50).filter(|n| ![7, 8, 30].contains(n));
    let leaky = leaky.map(|n| (sent_us(n), routed(n, 64)));
    let figures = &joins_of(&pcap(&leaky.collect::<Vec<_>>()), &came, false)[0];
    assert_eq!(doubts(figures), [(Doubt::Order, 3)], "{figures:#?}");
}

#[test]
fn points_of_one_host_that_each_saw_a_part_of_a_stream_count_as_one() {
    let frame = |n: i64| routed(n, 64);
    let came = |n: i64| sent_us(n) + 1000;
    let tagged = |n: i64| {
        let frame = frame(n);
        [&frame[..12], &[0x81, 0, 0, 7], &frame[12..]].concat()
    };
    let bond = arrived().map(|n| packet(u32::from(n % 2 == 1), came(n), 0, &frame(n)));
    let bond = pcapng(&[vec![interface(1, 6)], bond.collect()].concat());
    let half_tagged = arrived().map(|n| (came(n), if n < 25 { frame(n) } else { tagged(n) }));
    let half_told = arrived().map(|n| packet(0, came(n), u8::from(n % 2 == 1), &frame(n)));
    for second in [
        bond,
        pcap(&half_tagged.collect::<Vec<_>>()),
        pcapng(&half_told.collect::<Vec<_>>()),
    ] {
        let joins = joins_of(&sent_50(), &second, true);
        assert_eq!(joins.len(), 1, "{joins:#?}");
        let figures = &joins[0];
        let told = (
            figures.loss.count(),
            figures.second_count,
            figures.reordered_count,
        );
        assert_eq!(told, (Some(1), 49, 0), "{figures:#?}");
    }
    // Through two taps of a host in series, of which the second lost one more.
    let series = arrived().flat_map(|n| {
        let out = (n != 30).then(|| packet(1, came(n) + 10, 0, &frame(n)));
        [Some(packet(0, came(n), 0, &frame(n))), out]
            .into_iter()
            .flatten()
    });
    let series = pcapng(&[vec![interface(1, 6)], series.collect()].concat());
    let joins = joins_of(&sent_50(), &series, true);
    let lost: Vec<_> = joins.iter().map(|one| one.loss.count()).collect();
    assert_eq!(lost, [Some(1), Some(2), Some(1)], "{joins:#?}");
    // The other half came over a link that is not read.
    let unread = arrived().map(|n| packet(u32::from(n % 2 == 1), came(n), 0, &frame(n)));
    let unread = pcapng(&[vec![interface(189, 6)], unread.collect()].concat());
    let figures = &joins_of(&sent_50(), &unread, true)[0];
    let why = Doubt::Unread(Unread::LinkType { link_type: 189 });
    assert_eq!(doubts(figures), [(why, 25)], "{figures:#?}");
}

#[test]
fn a_number_that_comes_again_within_the_window_is_told_apart_by_the_delay() {
    // A number of eight bits, one a millisecond: a lap is 256 ms. 0.3 ms on the way, by a clock 0.4 s ahead.
    let at_us = |n: i64| BEGIN_US + 1000 * n;
    let of = |numbers: &mut dyn Iterator<Item = i64>, late_us: &dyn Fn(i64) -> i64| {
        pcap(
            &numbers
                .map(|n| (at_us(n) + late_us(n), routed(n, 64)))
                .collect::<Vec<_>>(),
        )
    };
    let lost = [300, 301, 302, 900];
    let first = of(&mut (0..2000), &|_| 0);
    for late_us in [300, 400_300] {
        let mut numbers = (0..2000).filter(|n| !lost.contains(n));
        let second = of(&mut numbers, &|_| late_us);
        let figures = &joins_by("udp:dport=5004,id=3+1", &first, &second, true)[0];
        let told = (
            figures.loss.count(),
            figures.edge_count,
            figures.reordered_count,
        );
        assert_eq!(told, (Some(4), 0, 0), "{late_us}: {figures:#?}");
        assert_eq!(figures.delay.measured().unwrap().max_ns, late_us * 1000);
    }
    // The delays vary by more than the lap.
    let mut numbers = (0..2000).filter(|n| !lost.contains(n));
    let second = of(&mut numbers, &|n| n % 7 * 60_000);
    let figures = &joins_by("udp:dport=5004,id=3+1", &first, &second, true)[0];
    let why = doubts(figures);
    assert!(
        why.iter().any(|one| one.0 == Doubt::Ambiguous),
        "{figures:#?}"
    );
    assert_eq!(figures.delay.measured(), None);
}

#[test]
fn a_stream_under_a_translated_address_is_not_lost() {
    let readdressed = |n: i64| {
        let mut frame = routed(n, 64);
        frame[26..30].copy_from_slice(&[192, 0, 2, 9]);
        frame
    };
    let second = arrived().map(|n| (sent_us(n) + 1000, readdressed(n)));
    let second: Vec<_> = second.collect();
    let joins = joins_of(&sent_50(), &pcap(&second), true);
    assert_eq!(joins.len(), 2, "{joins:#?}");
    for figures in &joins {
        assert!(
            matches!(doubts(figures)[..], [(Doubt::Readdressed, 47..=48)]),
            "{figures:#?}"
        );
    }
    // Another sender's, with other numbers in part: what was lost was lost.
    let other = (0..500).map(|n| (sent_us(n) + 1000, readdressed(n)));
    let joins = joins_of(&sent_50(), &pcap(&other.collect::<Vec<_>>()), true);
    // All but the first, which left before that capture began.
    assert_eq!(joins[0].loss.count(), Some(49), "{joins:#?}");
}

#[test]
fn a_round_trip_tells_the_order_only_of_datagrams_near_in_time() {
    // The second clock runs 50 ppm fast; 2 ms there, 3 ms back. Three are lost there, two back.
    let back = |n: i64| {
        let payload = [&u32::try_from(n).unwrap().to_be_bytes()[..], &[7; 28]].concat();
        let mut frame = udp_frame(5004, 5000, &payload);
        frame[26..34].copy_from_slice(&[10, 77, 0, 2, 10, 77, 0, 1]);
        frame
    };
    let fast = |at_us: i64| BEGIN_US + 3_000_000 + (at_us - BEGIN_US) * 20_001 / 20_000;
    let files = |back_us: i64| {
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for n in 0..1000 {
            let (there_us, back_us) = (sent_us(n), sent_us(n) + back_us);
            a.push((there_us, routed(n, 64)));
            if ![100, 101, 500].contains(&n) {
                b.push((fast(there_us + 2000), routed(n, 64)));
            }
            b.push((fast(back_us), back(n)));
            if ![200, 201].contains(&n) {
                a.push((back_us + 3000, back(n)));
            }
        }
        a.sort();
        b.sort();
        (pcap(&a), pcap(&b))
    };
    let (a, b) = files(500);
    let joins = joins_by("udp:port=5004,id=0+4", &a, &b, false);
    let told: Vec<_> = joins
        .iter()
        .map(|one| (one.order, one.loss.count()))
        .collect();
    let expected = [3, 2].map(|lost| (OrderSource::RoundTrip, Some(lost)));
    assert_eq!(told, expected, "{joins:#?}");
    let (a, b) = files(300_000_000);
    let joins = joins_by("udp:port=5004,id=0+4", &a, &b, false);
    assert_eq!(joins[0].loss.count(), Some(3), "{joins:#?}");
    assert_eq!(doubts(&joins[1]), [(Doubt::Order, 2)], "{joins:#?}");
}
