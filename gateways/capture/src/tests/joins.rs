//! Figures of two points against a network whose truth is known.

use std::collections::BTreeMap;

use hil_core::random::RandomStream;

use super::super::flow::{DatagramIdentity, Numbered};
use super::super::join::{JoinSettings, Joined, Loss, OrderSource, Sight, WINDOW_NS, join};
use super::super::observe::{Observation, Observer, Point, Seen, Stream};
use super::super::pairing::join_all;
use super::super::point::{NumberMetrics, single_point_metrics};
use super::super::watch::Watch;
use super::super::{CaptureInterface, CapturedPacket, Span};
use super::udp_frame;
use hil_net::{Direction, link_type};

fn observation(stamp_ns: i64, number: u64) -> Observation {
    Observation {
        stamp_ns,
        is_stamp_sound: true,
        steady_ns: stamp_ns,
        level: 0,
        payload_bytes: 80,
        packet_bytes: 108,
        packet_number: 1,
        hop_limit: 64,
        station: [0; 6],
        is_of_any: false,
        radio_number: None,
        has_copy: false,
        lacks_pieces: false,
        identity: DatagramIdentity {
            key: number.wrapping_mul(0x9e37_79b9_7f4a_7c15),
            number: Some(Numbered {
                series: 1,
                number,
                bits: None,
                is_piece: false,
            }),
            own: None,
        },
    }
}

const STREAM: fn() -> Stream = || Stream {
    flow_index: 0,
    source: "10.0.0.1:1".parse().unwrap(),
    destination: "10.0.0.2:2".parse().unwrap(),
    own: None,
};

fn point(file_index: usize, direction: Direction) -> Point {
    Point {
        file_index,
        direction,
        ..Point::default()
    }
}

fn seen(list: Vec<Observation>, span: Span) -> (Watch, Seen) {
    let mut watch = Watch::default();
    watch.spans.push(span);
    (watch, BTreeMap::from([(STREAM(), list)]))
}

const ONE_CLOCK: JoinSettings = JoinSettings {
    window_ns: WINDOW_NS,
    is_one_clock: true,
};

/// Joins what two points saw, on one clock.
fn join_two(points: [&Point; 2], sides: [&(Watch, Seen); 2]) -> Joined {
    let sight = |index: usize| Sight {
        point: points[index],
        watch: &sides[index].0,
        seen: &sides[index].1,
        also: &[],
        beside: &[],
    };
    join(&STREAM(), sight(0), sight(1), &ONE_CLOCK, None).unwrap()
}

const ALWAYS: Span = Span {
    first_ns: i64::MIN / 2,
    last_ns: i64::MAX / 2,
};

fn joined(first: Vec<Observation>, second: Vec<Observation>) -> Joined {
    let (a, b) = (point(0, Direction::Outbound), point(1, Direction::Inbound));
    let (first, second) = (seen(first, ALWAYS), seen(second, ALWAYS));
    join_two([&a, &b], [&first, &second])
}

#[test]
fn every_datagram_of_a_random_network_has_one_fate() {
    for seed in 0..50 {
        let mut random = RandomStream::new(seed, "joins");
        let (mut first, mut second) = (Vec::new(), Vec::new());
        let (mut lost, mut duplicated, mut hidden) = (0, 0, 0);
        for number in 0..2_000 {
            let left = i64::try_from(number).unwrap() * 1_000_000;
            let delay = 200_000 + i64::try_from(random.next_u64() % 2_000_000).unwrap();
            // The first capture misses some: no loss of the network.
            if random.chance(0.02) {
                hidden += 1;
            } else {
                first.push(observation(left, number));
                if random.chance(0.1) {
                    lost += 1;
                    continue;
                }
                if random.chance(0.05) {
                    duplicated += 1;
                    second.push(observation(left + delay + 50_000, number));
                }
            }
            second.push(observation(left + delay, number));
        }
        let figures = joined(first.clone(), second.clone()).figures;
        let Loss::Counted(found) = &figures.loss else {
            panic!("seed {seed}: {:?}", figures.loss)
        };
        assert_eq!(found.count, lost, "seed {seed}");
        assert_eq!(figures.duplicated_count, Some(duplicated), "seed {seed}");
        assert_eq!(figures.unexplained_count, hidden, "seed {seed}");
        assert_eq!(figures.edge_count, 0);
        assert_eq!(figures.matched_count + lost, first.len() as u64);
        if let Some(interval) = found.interval.unwrap().known() {
            assert!(interval.holds(found.ratio.unwrap()));
        }
        let in_bursts: u64 = found
            .bursts
            .iter()
            .map(|(length, count)| length * count)
            .sum();
        assert_eq!(in_bursts, lost);
        let delay = figures.delay.measured().unwrap();
        assert!(delay.min_ns >= 200_000 && delay.max_ns <= 2_200_000);
        assert!(figures.reordered_count > 0);
        if let Some(interval) = figures.delay_p50_interval.unwrap().known() {
            let p50_ns = delay.p50_ns as f64;
            assert!(interval.low <= p50_ns && p50_ns <= interval.high + 2_000.0);
        }
    }
}

#[test]
fn reordering_and_jitter_follow_their_definitions() {
    // Arrivals 0 2 3 1 4: one late datagram, overtaken first by position 1 of the arrivals.
    let first = (0..5)
        .map(|n| observation(i64::try_from(n).unwrap() * 100, n))
        .collect();
    let arrivals = [(0, 1_000), (2, 1_010), (3, 1_020), (1, 1_030), (4, 1_040)];
    let second = arrivals
        .iter()
        .map(|(n, at)| observation(*at, *n))
        .collect();
    let figures = joined(first, second).figures;
    assert_eq!(
        (figures.reordered_count, figures.reordering_extent_max),
        (1, 2)
    );
    // Delays in the order of arrival: 1000, 810, 720, 930, 640.
    let mut jitter = 0.0_f64;
    for difference in [190.0, 90.0, 210.0, 290.0] {
        jitter += (difference - jitter) / 16.0;
    }
    assert!((figures.jitter_last_ns.unwrap() - jitter).abs() < 1e-9);
    assert_eq!(figures.variation.measured().unwrap().max_ns, 360);
    // In the order of departure: 1000, 930, 810, 720, 640.
    let successive = figures.successive.measured().unwrap();
    assert_eq!((successive.min_ns, successive.max_ns), (70, 120));
    assert_eq!(figures.reordering_n_max, 2);
}

#[test]
fn what_leaves_at_the_edge_of_the_other_capture_is_not_lost() {
    let first: Vec<_> = (0..100)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000, n))
        .collect();
    let watched = Span {
        first_ns: 20_000,
        last_ns: 80_000,
    };
    let second: Vec<_> = (0..100)
        .filter(|n| *n != 50)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000 + 500, n))
        .filter(|one| (watched.first_ns..=watched.last_ns).contains(&one.stamp_ns))
        .collect();
    let (a, b) = (point(0, Direction::Outbound), point(1, Direction::Inbound));
    let sides = (seen(first, ALWAYS), seen(second, watched));
    let figures = join_two([&a, &b], [&sides.0, &sides.1]).figures;
    assert_eq!(figures.loss.count(), Some(1));
    assert_eq!(figures.edge_count, 40);
}

#[test]
fn the_order_of_points_comes_from_directions_or_else_from_stamps() {
    let early: Vec<_> = (0..9)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000, n))
        .collect();
    let late: Vec<_> = (0..9)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000 + 70, n))
        .collect();
    for (directions, order, expected_ns) in [
        // A clock of the sender that is ahead shows as a negative delay, not as a swapped path.
        (
            (Direction::Inbound, Direction::Outbound),
            OrderSource::PacketDirection,
            -70,
        ),
        (
            (Direction::Unknown, Direction::Unknown),
            OrderSource::Stamps,
            70,
        ),
    ] {
        let (a, b) = (point(0, directions.0), point(1, directions.1));
        let sides = (seen(early.clone(), ALWAYS), seen(late.clone(), ALWAYS));
        let joined = join_two([&a, &b], [&sides.0, &sides.1]);
        assert_eq!(joined.figures.order, order);
        assert_eq!(joined.figures.delay.measured().unwrap().p50_ns, expected_ns);
    }
}

#[test]
fn one_point_alone_tells_gaps_and_missing_numbers() {
    // Counted by two, as a known client does; 8 is missing, 10 comes twice, 12 before 10. The copy is not late.
    let numbers = [
        (0, 0),
        (10, 2),
        (20, 4),
        (30, 6),
        (540, 12),
        (550, 10),
        (560, 10),
        (570, 14),
    ];
    let list: Vec<_> = numbers
        .iter()
        .map(|(at, number)| observation(*at, *number))
        .collect();
    let figures = single_point_metrics(&list).unwrap();
    let found = figures.numbers.unwrap();
    assert_eq!((found.step, found.skipped_count), (2, 1));
    assert_eq!((found.repeated_count, found.reordered_count), (Some(1), 1));
    assert_eq!(figures.longest_gap.unwrap().length_ns, 510);
    assert_eq!(single_point_metrics(&[]), None);
}

/// Figures of these numbers of 16 bits, one every microsecond.
fn counted(numbers: impl IntoIterator<Item = u64>) -> NumberMetrics {
    let mut list = Vec::new();
    for (at, number) in (0_i64..).zip(numbers) {
        let mut one = observation(at * 1000, number);
        if let Some(numbered) = &mut one.identity.number {
            numbered.bits = Some(16);
        }
        list.push(one);
    }
    single_point_metrics(&list).unwrap().numbers.unwrap()
}

#[test]
fn numbers_that_wrap_count_on_and_numbers_that_begin_anew_are_another_series() {
    let expected = |series_count, skipped_count, repeated_count, reordered_count| NumberMetrics {
        series_count,
        step: 1,
        skipped_count,
        repeated_count: Some(repeated_count),
        reordered_count,
    };
    // RTP over three laps, from anywhere.
    let laps = (40_000..200_000).map(|n| n % 65_536);
    assert_eq!(counted(laps), expected(1, 0, 0, 0));
    // Across the wrap: 65534 late, 1 missing, 3 twice.
    let late = [
        65_530, 65_531, 65_532, 65_533, 65_535, 0, 65_534, 2, 3, 3, 4,
    ];
    assert_eq!(counted(late), expected(1, 1, 1, 1));
    // Late as the very first ones.
    assert_eq!(counted([1, 0, 65_535, 2, 3]), expected(1, 0, 0, 2));
    // A session that begins anew, from low and from beyond half the lap.
    for end in [5_000, 40_000, 62_000] {
        let restarted = (0..end).chain(0..2_000);
        assert_eq!(counted(restarted), expected(2, 0, 0, 0), "restart at {end}");
    }
    // A long gap is no restart.
    assert_eq!(
        counted((0..100).chain(10_100..10_200)),
        expected(1, 10_000, 0, 0)
    );
}

/// Takes packets from 10.77.0.1 to 10.77.0.`host`: file, direction, stamp, port.
fn observer_of(packets: &[(usize, Direction, i64, u16)], host: u8) -> Observer {
    let flow = "udp:src=10.77.0.1,dst=10.77.0.2".parse().unwrap();
    let other_flow = "udp:src=10.77.0.1,dst=10.77.0.9".parse().unwrap();
    let mut observer = Observer::new(&[flow, other_flow]);
    for (file_index, direction, stamp_ns, port) in packets {
        let mut data = udp_frame(9, *port, &(stamp_ns / 100).to_le_bytes());
        if *file_index == 1 {
            data[33] = host;
        }
        observer.take(
            *file_index,
            &CapturedPacket {
                offset: 0,
                interface_index: 0,
                interface_number: None,
                link_type: link_type::ETHERNET,
                stamp_ns: Some(*stamp_ns),
                original_bytes: u32::try_from(data.len()).unwrap(),
                is_damaged: false,
                is_nic_stamped: false,
                direction: *direction,
                data: &data,
            },
        );
    }
    observer.finish(0, &[]);
    observer.finish(1, &[]);
    observer
}

#[test]
fn a_stream_that_was_lost_altogether_has_its_line() {
    use Direction::{Inbound, Outbound, Unknown};
    let of_port = |port| (0..50).map(move |n| (0, Outbound, 1000 + 100 * n, port));
    let both: Vec<_> = of_port(1).chain(of_port(2)).collect();
    let came = |direction| (0..60).map(move |n| (1, direction, 930 + 100 * n, 1));

    // Port 2 never came, though port 1 of the same host did.
    let seen: Vec<_> = both.iter().copied().chain(came(Inbound)).collect();
    let joins = join_all(&observer_of(&seen, 2), &ONE_CLOCK);
    assert_eq!(joins.len(), 2, "{joins:?}");
    let figures = &joins[1].1.figures;
    assert_eq!((figures.first_count, figures.second_count), (50, 0));
    let Loss::Counted(loss) = &figures.loss else {
        panic!("{:?}", figures.loss)
    };
    assert_eq!(
        (loss.count, loss.ratio, figures.edge_count),
        (50, Some(1.0), 0)
    );
    assert_eq!(joins[1].1.first_point.direction, Outbound);
    assert_eq!(joins[0].1.figures.loss.count(), Some(0));

    // What came there was for another host: no stream of port 1 or 2 was to come by.
    assert!(join_all(&observer_of(&seen, 9), &ONE_CLOCK).is_empty());

    // The second capture is empty: nothing says that it was watching, then it says how long.
    let mut observer = observer_of(&both, 2);
    let joins = join_all(&observer, &ONE_CLOCK);
    assert_eq!(joins.len(), 2, "{joins:?}");
    assert!(joins.iter().all(|one| one.1.figures.loss.count().is_none()));
    let watched = CaptureInterface {
        watch: [
            Some(Span {
                first_ns: 0,
                last_ns: 4000,
            }),
            None,
        ],
        ..CaptureInterface::default()
    };
    observer.finish(1, &[watched]);
    let joins = join_all(&observer, &ONE_CLOCK);
    assert_eq!(joins.len(), 2, "{joins:?}");
    for (_, joined) in &joins {
        assert_eq!(
            (joined.figures.loss.count(), joined.figures.edge_count),
            (Some(31), 19)
        );
    }

    // Without directions too; the point that saw it is the first.
    let mut seen: Vec<_> = both.iter().copied().chain(came(Unknown)).collect();
    for one in &mut seen {
        one.1 = Unknown;
    }
    let joins = join_all(&observer_of(&seen, 2), &ONE_CLOCK);
    assert_eq!(joins.len(), 2, "{joins:?}");
    assert_eq!(joins[1].1.figures.loss.count(), Some(50));
    assert_eq!(joins[1].1.first_point.file_index, 0);
}

#[test]
fn through_a_host_with_two_taps_the_stamps_tell_the_order() {
    let list = |from| (0..9).map(move |n| observation(i64::try_from(n).unwrap() * 1000 + from, n));
    let (came, left) = (
        seen(list(0).collect(), ALWAYS),
        seen(list(70).collect(), ALWAYS),
    );
    let (a, mut b) = (point(0, Direction::Inbound), point(0, Direction::Outbound));
    b.interface_index = 1;
    let joined = join_two([&b, &a], [&left, &came]);
    assert_eq!(joined.figures.order, OrderSource::Stamps);
    assert_eq!(joined.figures.delay.measured().unwrap().p50_ns, 70);
}
