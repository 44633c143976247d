//! The teleoperated arms over a real hop between two hosts: nothing is lost on Ethernet, and over a
//! link with outages each lost loop stands beside the outage that made it.

use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_link::outages::{Outage, OutageSchedule, Outages};
use hil_report::summary::RunSummary;
use hil_tests::account::{account, assert_accounts_close, describe};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{ARM_CHANNELS, Split};
use hil_tests::trial::{RunFiles, Trial};

const COMMAND: &str = "egm/right/command";
const OUTAGES: Outages = Outages {
    mean_s: 4.0,
    per_hour: 200.0,
    buffered: false,
};

/// Runs the shipped split topology on two hosts for `seconds` with `settings`; gives both hosts' files.
fn split(record: &RunFolder, seconds: u32, settings: &[String]) -> Option<[RunFiles; 2]> {
    let lab = Lab::two_hosts_or_skip()?;
    let duration = format!("run.duration=\"{seconds} s\"");
    let trial = Trial::shipped("split.toml", record.path()).set(&duration);
    let trial = settings.iter().fold(trial, |trial, one| trial.set(one));
    let split = Split::start(&lab, &trial).carrying(ARM_CHANNELS);
    let files = split.files.clone();
    split.finish();
    Some(files)
}

fn figure(summary: &RunSummary, name: &str) -> f64 {
    let mut metrics = summary.score.iter();
    let metric = metrics.find(|metric| metric.name == name);
    let metric = metric.unwrap_or_else(|| panic!("no figure {name}"));
    let value = metric.value;
    value.unwrap_or_else(|| panic!("{name} is unavailable: {}", metric.method))
}

#[test]
fn over_ethernet_no_loop_is_lost_and_no_session_trips() {
    lose_nothing(10, 1.0);
}

#[test]
#[ignore = "takes a minute"]
fn over_ethernet_no_loop_is_lost_at_full_length() {
    lose_nothing(60, 9.0);
}

/// A run of `seconds` over Ethernet in which `loops_min` loops of the motion and more are sent.
fn lose_nothing(seconds: u32, loops_min: f64) {
    let record = RunFolder::new("teleop-ethernet");
    let Some(files) = split(&record, seconds, &[]) else {
        return;
    };
    for files in &files {
        let summary = files.summary();
        assert_accounts_close(&summary);
        println!("{}", describe(COMMAND, account(&summary, COMMAND)));
        assert!(figure(&summary, "motion_loops_sent_count") >= loops_min);
        assert!(figure(&summary, "motion_loss_ratio").abs() < 1e-12);
        assert!(figure(&summary, "egm_trip_count").abs() < 1e-12);
    }
}

/// The first seed whose only outage within the run is long enough to cost a loop for certain and
/// lies where the motion is under way; with that outage.
fn fitting_seed(run_s: f64) -> (u64, Outage) {
    let s = |at: Instant| at.seconds_since(Instant::ZERO);
    let fits = |seed: u64| {
        let stream = RandomStream::new(seed, "links.hop.outages");
        let mut schedule = OutageSchedule::new(OUTAGES, stream, Instant::ZERO).unwrap();
        let (first, second) = (schedule.next()?, schedule.next()?);
        let length_s = first.end.seconds_since(first.begin);
        ((6.0..7.5).contains(&s(first.begin))
            && (4.5..5.5).contains(&length_s)
            && s(second.begin) > run_s + 1.0)
            .then_some((seed, first))
    };
    (1..).find_map(fits).unwrap()
}

#[test]
fn a_lost_loop_stands_beside_the_outage_that_made_it() {
    let record = RunFolder::new("teleop-outages");
    let seconds = 16;
    let (seed, outage) = fitting_seed(f64::from(seconds));
    let settings = [
        format!("run.seed={seed}"),
        "links.hop.via=\"emulated\"".to_owned(),
        format!("links.hop.outages.mean=\"{} s\"", OUTAGES.mean_s),
        format!("links.hop.outages.per_hour={}", OUTAGES.per_hour),
    ];
    let Some(files) = split(&record, seconds, &settings) else {
        return;
    };
    let length_s = outage.end.seconds_since(outage.begin);
    println!("outage of {length_s:.3} s with seed {seed}");
    for files in &files {
        let summary = files.summary();
        println!("{}", files.read("events.log"));
        assert!(figure(&summary, "loops_lost_by_trip_count") >= 1.0);
        assert!(figure(&summary, "egm_trip_count") >= 1.0);
        let events = &summary.score_events.events;
        let mut lost = events.iter().filter(|event| event.what.contains("loop"));
        let lost = lost.next().expect("an event for the lost loop");
        assert!(lost.what.contains("CommTimeout"), "{}", lost.what);
        let mut outages = lost.outages.iter();
        let found = outages.find(|one| one.channel == COMMAND);
        let found = found.unwrap_or_else(|| panic!("{lost:?}"));
        // Seen from the messages alone: to a command period or two at each end, and the two
        // processes' starts.
        let found_s = found.length_s.unwrap();
        assert!((found_s - length_s).abs() < 0.1, "{found_s} for {length_s}");
        assert!(found.lost_count > 400, "{found:?}");
    }
}
