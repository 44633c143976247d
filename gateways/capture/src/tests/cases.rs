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

fn take(observer: &mut Observer, file_index: usize, file: &[u8]) {
    let mut reader = CaptureReader::default();
    reader.feed(file);
    reader.end();
    loop {
        match reader.next_step() {
            Step::Packet(packet) => observer.take(file_index, &packet),
            Step::Fault(fault) => panic!("file {file_index}: {fault}"),
            Step::NeedsMore | Step::Ended => break,
        }
    }
    observer.finish(file_index, reader.interfaces());
}

fn joins_of(first: &[u8], second: &[u8], is_one_clock: bool) -> Vec<JoinMetrics> {
    let mut observer = Observer::new(&["udp:dport=5004,id=0+4".parse().unwrap()]);
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

fn doubts(figures: &JoinMetrics) -> Vec<(Doubt, u64)> {
    match &figures.loss {
        Loss::Counted(_) => Vec::new(),
        Loss::Unavailable { doubts, .. } => {
            doubts.iter().map(|one| (one.doubt, one.count)).collect()
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
        assert_eq!(wrong, (0, 0), "{name}");
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
            assert_eq!((joins[0].first_count, joins[0].loss.count()), (50, Some(1)));
        }
    }
    let joins = joins_of(REFERENCE, include_bytes!("cases/any_bridge_b.pcap"), true);
    let lost: Vec<_> = joins.iter().map(|one| one.loss.count()).collect();
    assert_eq!(lost, [Some(1), Some(1), Some(0)], "{joins:#?}");
    assert!(joins.iter().all(|one| one.duplicated_count == 0));
}

/// A pcap of Ethernet frames: microseconds since 1970, and the frame.
fn pcap(packets: &[(i64, Vec<u8>)]) -> Vec<u8> {
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

const BEGIN_US: i64 = 1_700_000_000_000_000;

/// Number `n` of the stream, so many bytes long.
fn datagram(n: u32, bytes: usize) -> Vec<u8> {
    let mut payload = n.to_be_bytes().to_vec();
    payload.resize(bytes, 7);
    udp_frame(5000, 5004, &payload)
}

/// Datagrams 0..100, a tenth of a second apart, without number 20 and as `at` says.
fn second_point(at: impl Fn(i64) -> i64) -> Vec<u8> {
    let numbers = (0..100).filter(|n| *n != 20);
    let packet = |n: i64| (at(n), datagram(u32::try_from(n).unwrap(), 32));
    pcap(&numbers.map(packet).collect::<Vec<_>>())
}

fn first_point() -> Vec<u8> {
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
        let is_told = !figures.clock_steps[1].is_empty() || figures.delay_shift.is_some();
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
fn an_aggregate_is_no_datagram() {
    // Ten frames of ten datagrams each, sent by segmentation offload.
    let large = (0..10).map(|n| (BEGIN_US + 10_000 * i64::from(n), datagram(10 * n, 10_000)));
    let large = pcap(&large.collect::<Vec<_>>());
    let small = (0..100).map(|n| (BEGIN_US + 1000 * i64::from(n) + 500, datagram(n, 1000)));
    let small = pcap(&small.collect::<Vec<_>>());
    for (first, second) in [(&large, &small), (&small, &large)] {
        let joins = joins_of(first, second, true);
        let (why, count) = doubts(&joins[0])[0];
        assert_eq!(why, Doubt::Unread(Unread::Aggregate));
        assert!(count >= 10, "{joins:#?}");
    }
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
    let joins = joins_of(&second_point(late_us), &first_point(), false);
    assert_eq!(
        (joins[0].order, joins[0].loss.count()),
        (OrderSource::Missing, Some(1))
    );

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
        (joined.first_point.vlan, joined.second_point.vlan),
        (Some(5), Some(6))
    );
    assert_eq!(joined.first_point.direction, Direction::Unknown);
    assert_eq!(joined.figures.duplicated_count, 0);
    assert_eq!(joined.figures.loss.count(), Some(0));
}
