//! Figures of two points against a network whose truth is known.

use std::collections::BTreeMap;

use hil_models::random::RandomStream;

use super::super::Direction;
use super::super::flow::{DatagramIdentity, Numbered};
use super::super::join::{Joined, OrderSource, WINDOW_NS, join};
use super::super::observe::{Observation, Point, Seen, Stream};
use super::super::point::single_point_figures;

fn observation(stamp_ns: i64, number: u64) -> Observation {
    Observation {
        stamp_ns,
        payload_bytes: 80,
        identity: DatagramIdentity {
            key: number.wrapping_mul(0x9e37_79b9_7f4a_7c15),
            number: Some(Numbered {
                series: 1,
                number,
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
        interface_index: 0,
        esl_port: None,
        direction,
    }
}

fn seen(list: Vec<Observation>, span_ns: (i64, i64)) -> Seen {
    Seen {
        span_ns: Some(span_ns),
        streams: BTreeMap::from([(STREAM(), list)]),
    }
}

const ALWAYS: (i64, i64) = (i64::MIN / 2, i64::MAX / 2);

fn joined(first: Vec<Observation>, second: Vec<Observation>) -> Joined {
    let (a, b) = (point(0, Direction::Outbound), point(1, Direction::Inbound));
    let (first, second) = (seen(first, ALWAYS), seen(second, ALWAYS));
    join(&STREAM(), (&a, &first), (&b, &second), WINDOW_NS).unwrap()
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
        assert_eq!(figures.lost_count, lost, "seed {seed}");
        assert_eq!(figures.duplicated_count, duplicated, "seed {seed}");
        assert_eq!(figures.unexplained_count, hidden, "seed {seed}");
        assert_eq!(figures.edge_count, 0);
        assert_eq!(figures.matched_count + lost, first.len() as u64);
        let (low, high) = figures.loss_interval.unwrap();
        assert!(low < figures.loss_ratio.unwrap() && figures.loss_ratio.unwrap() < high);
        let in_bursts: u64 = figures
            .loss_bursts
            .iter()
            .map(|(length, count)| length * count)
            .sum();
        assert_eq!(in_bursts, lost);
        let delay = figures.delay.measured().unwrap();
        assert!(delay.min_ns >= 200_000 && delay.max_ns <= 2_200_000);
        assert!(figures.reordered_count > 0);
        let interval = figures.delay_p50_interval.unwrap();
        assert!(interval.low_ns <= delay.p50_ns && delay.p50_ns <= interval.high_ns + 2_000);
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
}

#[test]
fn what_leaves_at_the_edge_of_the_other_capture_is_not_lost() {
    let first: Vec<_> = (0..100)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000, n))
        .collect();
    let watched = (20_000, 80_000);
    let second: Vec<_> = (0..100)
        .filter(|n| *n != 50)
        .map(|n| observation(i64::try_from(n).unwrap() * 1_000 + 500, n))
        .filter(|one| (watched.0..=watched.1).contains(&one.stamp_ns))
        .collect();
    let (a, b) = (point(0, Direction::Outbound), point(1, Direction::Inbound));
    let sides = (seen(first, ALWAYS), seen(second, watched));
    let figures = join(&STREAM(), (&a, &sides.0), (&b, &sides.1), WINDOW_NS)
        .unwrap()
        .figures;
    assert_eq!(figures.lost_count, 1);
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
        let joined = join(&STREAM(), (&a, &sides.0), (&b, &sides.1), WINDOW_NS).unwrap();
        assert_eq!(joined.figures.order, order);
        assert_eq!(joined.figures.delay.measured().unwrap().p50_ns, expected_ns);
    }
}

#[test]
fn one_point_alone_tells_gaps_and_missing_numbers() {
    // Counted by two, as a known client does; 8 is missing, 10 comes twice, 12 before 10.
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
    let figures = single_point_figures(&list).unwrap();
    let found = figures.numbers.unwrap();
    assert_eq!((found.step, found.skipped_count), (2, 1));
    assert_eq!((found.repeated_count, found.reordered_count), (Some(1), 2));
    assert_eq!(figures.longest_gap.unwrap().length_ns, 510);
    assert_eq!(single_point_figures(&[]), None);
}
