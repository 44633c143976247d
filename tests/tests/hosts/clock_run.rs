//! Two hosts whose monotonic clocks differ by a known time: the report's alignment is held against
//! the truth. The offset is made by a time namespace, so no clock of this machine is touched.

use hil_clock::StampKind;
use hil_report::clock_summary::{ClockRung, HostPairClock};
use hil_report::network::{NetworkQuantity, TimelineSubject};
use hil_report::summary::{LinkKind, RunSummary};
use hil_tests::account::{account, carried};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{ARM_CHANNELS, HOSTS, Split};
use hil_tests::trial::Trial;

const AHEAD_S: u32 = 100_000;
/// `robot-pc = control-pc + truth`, to the nanosecond.
const TRUTH_NS: i64 = AHEAD_S as i64 * 1_000_000_000;

fn run(record: &RunFolder) -> Option<[RunSummary; 2]> {
    let lab = Lab::with_clock_ahead_or_skip(Some(AHEAD_S))?;
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"8 s\"");
    Some(Split::start(&lab, &trial).carrying(ARM_CHANNELS).finish())
}

fn check_alignment(pair: &HostPairClock) {
    assert_eq!((pair.from.as_str(), pair.to.as_str()), (HOSTS[0], HOSTS[1]));
    assert_eq!(pair.rung, ClockRung::Exchanges, "{pair:?}");
    assert_eq!(pair.contradiction, None);
    let figures = pair.exchanges.as_ref().unwrap();
    let offset = figures.offset.unwrap();
    let bound = figures.bound.unwrap();
    let error_ns = offset.estimate_ns - TRUTH_NS;
    println!(
        "{} exchanges, {} unused, stamps {:?}: estimate off by {error_ns} ns, guaranteed \
         {} to {} ns about the truth, bound median {} ns, largest {} ns, smallest round trip \
         {:?} ns, skew {:?} ± {:?} ppm",
        figures.exchange_count,
        figures.unused_count,
        figures.stamp_counts,
        offset.lowest_ns - TRUTH_NS,
        offset.highest_ns - TRUTH_NS,
        bound.median_ns,
        bound.largest_ns,
        figures.rtt_min_ns,
        figures.skew_ppm,
        figures.skew_error_ppm,
    );
    assert!(
        (offset.lowest_ns..=offset.highest_ns).contains(&TRUTH_NS),
        "{offset:?}"
    );
    assert!(error_ns.unsigned_abs() <= bound.largest_ns, "{offset:?}");
    assert_eq!(figures.steps, [], "no clock was stepped");
    assert!(figures.exchange_count >= 100, "{figures:?}");
    // Two of the four ways are UDP, whose stamps are the kernel's at all four places; those of TCP never
    // are. With one place missing it would be three eighths.
    let count = |kind| figures.stamp_counts.get(&kind).copied().unwrap_or(0);
    let kernel_count = count(StampKind::KernelSoftware);
    let all_count: u64 = figures.stamp_counts.values().sum();
    assert!(kernel_count * 100 >= all_count * 47, "{figures:?}");
}

/// The clocks are of one oscillator, so a delay measured across them is true within its bound; it
/// was not negative.
fn check_channels(summary: &RunSummary) {
    for channel in carried(summary).filter(|one| one.link == LinkKind::named("udp").unwrap()) {
        let account = account(summary, &channel.name);
        let Some(delays) = account.end_to_end.distribution.measured() else {
            continue;
        };
        let bound = account.end_to_end.bound.unwrap();
        println!(
            "{}: end to end p50 {} ns, bound median {} ns, largest {} ns",
            channel.name, delays.p50_ns, bound.median_ns, bound.largest_ns
        );
        assert!(bound.median_ns > 0 && bound.median_ns <= bound.largest_ns);
        assert_eq!(
            account.end_to_end.alignment_bound_ns(),
            Some(bound.largest_ns)
        );
        assert!(delays.min_ns >= -i64::try_from(bound.largest_ns).unwrap());
        let closing = account.closing.checked().unwrap();
        assert!(closing.is_converted);
        assert_eq!(closing.checked_count, closing.closed_count, "{closing:?}");
    }
}

/// What is made of delays says how far it may be off, and so does the score of both hosts' messages.
fn check_bounds(summary: &RunSummary) {
    let network = summary.network.as_ref().unwrap();
    assert!(!network.clocks_differ && network.clock_bound_s > Some(0.0));
    for one in &network.channels {
        let (name, figures) = (&one.channel, &one.figures);
        // A channel that answers requests may have had one.
        let measured = figures.delay.measured().zip(figures.successive.measured());
        let Some((delay, successive)) = measured else {
            continue;
        };
        let (bound_ns, variation) = (delay.alignment_bound_ns, delay.variation);
        assert!(bound_ns > 0 && variation.bound_ns > 0 && successive.bound_ns > 0);
        assert!(variation.bound_ns <= 2 * bound_ns, "{variation:?}");
        let row = network.timeline.rows.iter().find(|row| {
            let (channel, quantity) = (name.clone(), NetworkQuantity::Delay);
            row.subject == TimelineSubject::Channel { channel, quantity }
        });
        assert!(row.unwrap().bound > Some(0.0), "{name}");
    }
    let metric = summary
        .score
        .iter()
        .find(|one| one.name == "joint_error_rad_rms");
    let metric = metric.unwrap();
    println!("{}: {:?}, {}", metric.label, metric.value, metric.method);
    assert!(metric.value.is_some(), "{metric:?}");
    assert!(metric.method.contains("aligned within"), "{metric:?}");
}

#[test]
fn an_offset_of_a_day_is_found_within_its_bound_and_carries_the_account() {
    let record = RunFolder::new("clocks");
    let Some(summaries) = run(&record) else {
        return;
    };
    for summary in &summaries {
        let clocks = summary.clocks.as_ref().unwrap();
        assert!(!clocks.has_one_clock);
        assert!(
            !summary.score_events.clocks_differ,
            "one axis for all events"
        );
        assert_eq!(clocks.hosts.len(), 2, "{:?}", clocks.hosts);
        let [pair] = &clocks.pairs[..] else {
            panic!("{:?}", clocks.pairs);
        };
        check_alignment(pair);
        check_channels(summary);
        check_bounds(summary);
        let unaligned = summary
            .warnings
            .iter()
            .find(|one| one.contains("not aligned"));
        assert_eq!(unaligned, None);
    }
    let [one, other] = summaries.map(|summary| summary.clocks.unwrap().pairs);
    assert_eq!(one, other, "both hosts say the same");
}
