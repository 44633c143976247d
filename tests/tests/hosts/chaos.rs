//! Seeded chaos on split runs: whatever is killed, paused, cut, flooded, forged or filled up, the
//! promises of `hil_tests::chaos::verdict` hold.
//!
//! `HIL_CHAOS_EPISODES=200` plays as many episodes from `HIL_CHAOS_SEED` on (0 unless given), several
//! at a time (`HIL_CHAOS_PARALLEL`, 2); one seed is one episode.

use std::fmt::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::{env, thread};

use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::chaos::episode::{Report, play};
use hil_tests::chaos::plan::Plan;
use hil_tests::chaos::table::table;
use hil_tests::lab::require_privileges;

const EPISODES_VARIABLE: &str = "HIL_CHAOS_EPISODES";
const SEED_VARIABLE: &str = "HIL_CHAOS_SEED";
const PARALLEL_VARIABLE: &str = "HIL_CHAOS_PARALLEL";
/// Played in every suite: between them every kind of injection but the slow ones.
const SUITE: [u64; 6] = [1, 2, 3, 4, 5, 6];
/// Once violated; played in every suite from then on.
const REGRESSIONS: [u64; 3] = [1035, 1104, 1184];
const PARALLEL_DEFAULT: usize = 3;

fn number<T: std::str::FromStr>(variable: &str) -> Option<T> {
    let text = env::var(variable).ok()?;
    let number = text.parse().ok();
    assert!(
        number.is_some(),
        "{variable} is {text:?}, a number is expected"
    );
    number
}

fn seeds() -> Vec<u64> {
    let (from, count) = (
        number::<u64>(SEED_VARIABLE),
        number::<u64>(EPISODES_VARIABLE),
    );
    match (from, count) {
        (None, None) => SUITE.into_iter().chain(REGRESSIONS).collect(),
        (from, count) => {
            let from = from.unwrap_or(0);
            (from..from + count.unwrap_or(1)).collect()
        }
    }
}

#[test]
fn whatever_happens_to_a_run_every_message_is_accounted_for_and_nothing_is_left() {
    if let Err(reason) = require_privileges() {
        println!("skipped: {reason}");
        return;
    }
    // Built once, before anything is timed.
    let _built = (hil_runtime_binary(), hil_recorder_binary());
    let seeds = seeds();
    let parallel = number(PARALLEL_VARIABLE).unwrap_or(PARALLEL_DEFAULT).max(1);
    let reports: Mutex<Vec<Report>> = Mutex::default();
    let next = AtomicUsize::new(0);
    thread::scope(|scope| {
        for _ in 0..parallel.min(seeds.len()) {
            scope.spawn(|| {
                while let Some(seed) = seeds.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let report = play(&Plan::of(*seed));
                    println!("{}", words(&report));
                    reports.lock().unwrap().push(report);
                }
            });
        }
    });
    let reports = reports.into_inner().unwrap();
    println!("{}", table(&reports));
    let violated: Vec<String> = reports
        .iter()
        .filter(|report| !report.violations.is_empty())
        .map(words)
        .collect();
    assert!(violated.is_empty(), "\n{}", violated.join("\n"));
}

fn words(report: &Report) -> String {
    let mut text = format!(
        "{}\n    -> {} / {}; {:.1} s; {:?} messages published and taken",
        report.plan,
        report.ends[0],
        report.ends[1],
        report.took.as_secs_f64(),
        report.messages
    );
    for note in &report.notes {
        write!(text, "\n    note: {note}").unwrap();
    }
    for violation in &report.violations {
        write!(
            text,
            "\n    VIOLATED: {violation}\n    again: {SEED_VARIABLE}={} cargo test --package \
             hil-tests --test hosts chaos:: -- --nocapture",
            report.plan.seed
        )
        .unwrap();
    }
    text
}
