//! The network of a run that never was, put together as that of a real one, for the reports that
//! are checked in.

use hil_account::network::{
    Crossing, Moment, NetworkContext, NetworkEvent, NetworkEventKind, Passage,
};
use hil_account::{ChannelPath, Side};
use hil_core::case_study::ErrorSeries;
use hil_core::random::RandomStream;
use hil_core::time::{Alignment, Instant};

use crate::analysis::network::{AxisClocks, ChannelPassages, NetworkBuilder, RobotSeries};
use crate::network::{Correlation, NetworkReport};
use crate::score_event::ScoreEvents;

const MS: i64 = 1_000_000;
const RUN_NS: i64 = 20_000 * MS;

/// Every 8 ms for 20 s: 2 ms and some noise, nothing from 3.6 to 4.4 s and from 15.0 to 15.3 s, and a
/// few late ones at 11 s.
fn passages(seed: u64, has_clock: bool) -> Vec<Passage> {
    let mut random = RandomStream::new(seed, "report sample network");
    let passage = |sequence: u64| {
        let offered_ns = i64::try_from(sequence).unwrap() * 8 * MS;
        let ms = offered_ns / MS;
        let is_lost = (3_600..4_400).contains(&ms) || (15_000..15_300).contains(&ms);
        let noise = random.uniform();
        #[allow(clippy::cast_possible_truncation, reason = "below 600 µs")]
        let noise_ns = (noise * 600e3) as i64;
        let late_ns = if (11_000..11_040).contains(&ms) {
            25 * MS
        } else {
            0
        };
        let delay_ns = 2 * MS + noise_ns + late_ns;
        Passage {
            epoch_rank: 0,
            sequence,
            count: 1,
            offered_ns: Some(offered_ns),
            received_ns: (!is_lost).then_some(offered_ns + delay_ns),
            delay_ns: (!is_lost && has_clock).then_some(delay_ns),
            delay_bound_ns: 40_000,
            crossing: if is_lost {
                Crossing::LostByNetwork
            } else {
                Crossing::Arrived
            },
        }
    };
    (0..2_500).map(passage).collect()
}

/// The robot's error: 300 ms after each outage began it grows, and falls when it is over.
fn error() -> RobotSeries {
    let error_rad = |ms: i64| {
        let spans = [(3_900, 4_700), (15_300, 15_600)];
        let within = spans
            .iter()
            .find(|(from, until)| (*from..*until).contains(&ms));
        within.map_or(0.001, |(from, _)| 0.001 + (ms - from) as f64 * 1e-4)
    };
    let samples = (0..5_000).map(|step| {
        let ms = step * 4;
        (Instant::from_ns(ms * MS), error_rad(ms))
    });
    let errors = ErrorSeries {
        name: "error_rad",
        label: "joint error of the right arm",
        unit: "rad",
        clock_of: "arm/status",
        samples: samples.collect(),
    };
    RobotSeries::of(errors, |at| Some(at.seconds_since(Instant::ZERO)))
}

/// The network of `names`, the second of which is between clocks that are not aligned; puts beside
/// `events` what came before them.
pub(crate) fn network(names: [&str; 2], events: &mut ScoreEvents) -> NetworkReport {
    let mut builder = NetworkBuilder::default();
    for (index, name) in names.into_iter().enumerate() {
        let down = NetworkEvent {
            kind: NetworkEventKind::ProcessDown {
                process: "robot gateway".to_owned(),
                is_gateway: true,
                cause: "killed by signal 9".to_owned(),
            },
            from: Moment {
                side: Side::Consumer,
                ns: 8_000 * MS,
            },
            until_ns: Some(8_760 * MS),
        };
        builder.add(ChannelPassages {
            channel: name,
            hosts: ["control-pc", "robot-pc"],
            passages: &passages(index as u64, index == 0).into_iter().collect(),
            other_events: vec![down],
            duration_ns: RUN_NS,
            place: &|at: Moment| Some(at.ns),
            context: NetworkContext {
                path: ChannelPath::Gateway {
                    alignment: (index == 0).then_some(Alignment {
                        offset_ns: 0,
                        bound_ns: 40_000,
                    }),
                },
                run_ns: Some((0, RUN_NS)),
                payload_bytes: Some(96.0),
            },
        });
    }
    let axis = AxisClocks {
        bound_s: (!events.clocks_differ).then_some(0.0),
    };
    let (report, series) = builder.finish(events, vec![error()], axis).unwrap();
    assert_eq!(series.len(), 2);
    report
}

#[test]
fn two_outages_are_too_few_to_test_and_a_process_is_down_once() {
    let report = network(["arm/command", "arm/status"], &mut ScoreEvents::default());
    let Correlation::Tested(tests) = &report.correlation else {
        panic!("{:?}", report.correlation);
    };
    assert!(
        tests.pairs.iter().all(|pair| !pair.robot.contains("joint")),
        "{tests:?}"
    );
    let seldom = tests.seldom.iter();
    let error = seldom.filter(|one| one.series.contains("joint"));
    assert_eq!(error.map(|one| one.spell_count).collect::<Vec<_>>(), [2]);
    // A process is down once, however many channels it carries.
    let is_down = |kind: &NetworkEventKind| matches!(kind, NetworkEventKind::ProcessDown { .. });
    let down_count = report
        .events
        .iter()
        .filter(|one| is_down(&one.kind))
        .count();
    assert_eq!(down_count, 1);
    // From 3.6 s on something was there at most 5 s before.
    assert!(
        (report.foregoing_chance_ratio - 0.82).abs() < 1e-9,
        "{report:?}"
    );
    assert!(
        tests.constant.contains(&"events of the score".to_owned()),
        "{tests:?}"
    );
}
