//! Tests of the link model behind a socket: on the run's clock, and whole messages in pieces.

use hil_core::link_model::TraceMatch;
use hil_core::random::RandomStream;
use hil_link::outages::{Outage, OutageSchedule, Outages};
use hil_link::spec::{LinkSpec, Way};
use hil_protocol::wire::Header;
use hil_topology::emulation::EmulationLaunch;
use hil_trace::replay::{TraceLink, TraceReplay};
use hil_trace::{Trace, TraceFate, TraceHeader, TraceRecord};
use hil_transport::queue::queue_pair;

use super::*;

fn emulation(per_hour: f64) -> EmulationLaunch {
    let outages = Outages {
        mean_s: 0.5,
        per_hour,
        buffered: false,
    };
    EmulationLaunch {
        spec: LinkSpec {
            outages,
            ..LinkSpec::fixed(Duration::from_millis(5), 0.0)
        },
        link: "hop".to_owned(),
        way: Way::Forward,
        seed: 3,
        trace: None,
    }
}

fn live(channel: &str, start: &RunStart) -> SinceStart<impl LinkModel + use<>> {
    SinceStart {
        link: emulation(600.0).model(channel).unwrap(),
        start: start.clone(),
    }
}

#[test]
fn outages_count_from_the_start_of_the_run_on_every_channel_alike() {
    let start = RunStart::default();
    let began = Instant::from_ns(77_000_000_000_123);
    let (mut there, mut back) = (live("a/b", &start), live("b/a", &start));
    // Nothing fails before the start, however long it takes.
    for step in 0..1_000 {
        let now = Instant::from_ns(step * 1_000_000_000);
        assert_eq!(
            there.offer(now, 1),
            Fate::Delivered(now + Duration::from_millis(5))
        );
    }
    start.set(began);
    let mut restarted = None;
    let mut virtual_time = emulation(600.0).model("a/b").unwrap();
    let mut lost_count = 0;
    for step in 0..100_000 {
        let elapsed = Duration::from_millis(4 * step);
        let now = began + elapsed;
        let is_lost = there.offer(now, 1) == Fate::Lost;
        lost_count += u32::from(is_lost);
        assert_eq!(back.offer(now, 1) == Fate::Lost, is_lost);
        let simulated = virtual_time.offer(Instant::ZERO + elapsed, 1);
        assert_eq!(simulated == Fate::Lost, is_lost);
        if step >= 50_000 {
            // A gateway that was started again in the middle of the run.
            let restarted = restarted.get_or_insert_with(|| live("a/b", &start));
            assert_eq!(restarted.offer(now, 1) == Fate::Lost, is_lost);
        }
    }
    assert!(lost_count > 1_000, "{lost_count}");
}

/// A piece of three of a message of 300 bytes, published every 10 ms.
fn piece(sequence: u64, index: u16) -> Vec<u8> {
    let mut bytes = vec![0; wire::HEADER_BYTES + 100];
    Header {
        sequence,
        published_ns: i64::try_from(sequence).unwrap() * 10_000_000,
        total_len: 300,
        fragment_index: index,
        fragment_count: 3,
        epoch: 4,
        ..Header::new(Kind::Data, 1, 1)
    }
    .encode(&mut bytes);
    bytes
}

/// Every 10 ms; every third lost.
fn traced(matching: TraceMatch) -> TraceLink {
    let record = |n: u64| {
        let at_ns = i64::try_from(n).unwrap() * 10_000_000;
        let mut record =
            TraceRecord::published(at_ns, n, 300).delivered(2_000_000 + at_ns / 1_000, 0);
        if n % 3 == 1 {
            record = TraceRecord::published(at_ns, n, 300);
            record.fate = TraceFate::LostInNetwork;
        }
        record
    };
    let trace = Trace {
        header: TraceHeader::new("a/b"),
        records: (0..60).map(record).collect(),
    };
    let replay = TraceReplay {
        matching,
        ..TraceReplay::default()
    };
    TraceLink::new(trace, replay).unwrap()
}

#[test]
fn a_message_in_pieces_meets_one_record_whole() {
    for matching in [TraceMatch::Index, TraceMatch::Tick, TraceMatch::Time] {
        let (mut sender, inner) = queue_pair();
        let link = traced(matching);
        let tally = link.tally();
        let settings = EmulatedSettings::default();
        let mut receiver =
            EmulatedReceiver::new(Box::new(inner), Box::new(link), offer_of, 1, settings);
        let mut arrived_count = [0; 60];
        for ms in 0..600_i64 {
            let now = Instant::from_ns(ms * 1_000_000);
            let sequence = u64::try_from(ms / 10).unwrap();
            // The network brings the last piece twice.
            if let Some(index) = [0, 1, 2, 2].get(usize::try_from(ms % 10).unwrap()) {
                sender.send(&piece(sequence, *index)).unwrap();
            }
            let mut buffer = [0; 1_472];
            while let Some(received) = receiver.receive(now, &mut buffer).unwrap() {
                let header = wire::decode(&buffer[..received.length_bytes])
                    .unwrap()
                    .header;
                let held = received.emulated.unwrap();
                let delay_ns = 2_000_000 + i64::try_from(header.sequence).unwrap() * 10_000;
                assert_eq!(held.due.ns_since(held.arrived), delay_ns, "{matching:?}");
                arrived_count[usize::try_from(header.sequence).unwrap()] += 1;
            }
        }
        for (sequence, count) in arrived_count.into_iter().enumerate() {
            assert_eq!(
                count,
                if sequence % 3 == 1 { 0 } else { 4 },
                "{matching:?} {sequence}"
            );
        }
        let counts = tally.counts();
        assert_eq!(
            (counts.offered_count, counts.met_count),
            (60, 60),
            "{matching:?}"
        );
        assert_eq!((counts.delivered_count, counts.repeated_count), (40, 0));
    }
}

#[test]
fn two_links_of_one_run_fail_apart() {
    let first = |link: &str| -> Outage {
        let emulation = emulation(600.0);
        let name = format!("links.{link}.outages");
        let stream = RandomStream::new(emulation.seed, &name);
        let mut schedule =
            OutageSchedule::new(emulation.spec.outages, stream, Instant::ZERO).unwrap();
        schedule.next().unwrap()
    };
    assert_ne!(first("hop"), first("wire"));
}
