//! Reports of runs with little or much to tell: nothing arrives, nothing is stamped, a million
//! messages. Each is rendered by the real binary, on the terminal and as a page, and how long that took
//! is printed.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use hil_account::{MessageFate, Stage};
use hil_report::summary::RunSummary;
use hil_tests::account::{account, assert_every_message_is_accounted_for};
use hil_tests::binary::hil_runtime as run;
use hil_tests::browser::Browser;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, emulated_shuttle};
use hil_tests::trial::{RunFiles, Trial};

const LIMIT: Duration = Duration::from_mins(5);
/// A page of one run, without a series of its own that would fill it.
const PAGE_BYTES_MAX: usize = 3_000_000;
/// What makes the page of a million messages open fast on any machine: how much there is to read, and to
/// lay out.
const MILLION_BYTES_MAX: usize = 500_000;
const MILLION_ELEMENT_COUNT_MAX: u64 = 2_000;

/// The page of the run in `folder`, with words of no break as plain ones.
fn page(folder: &Path, output: &Path) -> String {
    let began = Instant::now();
    let words = [Path::new("report"), folder, Path::new("-o"), output];
    run(&words).assert_success();
    let text = fs::read_to_string(output).unwrap();
    println!(
        "{}: {} bytes in {:?}",
        folder.display(),
        text.len(),
        began.elapsed()
    );
    assert!(text.len() < PAGE_BYTES_MAX, "{} bytes", text.len());
    assert!(text.trim_end().ends_with("</html>"));
    text.replace('\u{a0}', " ")
}

fn live(record: &RunFolder, name: &str, keys: &str) -> RunFiles {
    let file = record.write("live.toml", &emulated_shuttle(name, keys));
    let trial = Trial::of(&file, &record.join("runs")).set("run.duration=\"3 s\"");
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    let files = trial.folder("", LIMIT);
    assert_every_message_is_accounted_for(&files.summary());
    files
}

#[test]
fn a_run_in_which_nothing_arrives_says_so_and_makes_up_no_delay() {
    let record = RunFolder::new("report-nothing");
    let files = live(&record, "nothing", "loss_ratio = 1.0");
    let summary = files.summary();
    for name in CHANNELS {
        let account = account(&summary, name);
        assert!(account.published_count > 10, "{name}");
        assert_eq!(account.fates.of(MessageFate::Taken), 0);
        assert!(account.end_to_end.distribution.measured().is_none());
        assert!(account.end_to_end.p50_interval.is_none());
    }
    let text = files.read("report-full.txt");
    assert!(text.contains("lost by the emulated link"), "{text}");
    assert!(!text.contains("lost on the wire"), "{text}");
    assert!(!text.contains("NaN") && !text.contains("inf "), "{text}");
    let page = page(files.root(), &record.join("page.html"));
    assert!(page.contains("lost by the emulated link") && page.contains("unavailable"));
    assert!(!page.contains("NaN"));
}

#[test]
fn a_run_without_stamps_has_its_delays_and_names_what_it_lacks() {
    let record = RunFolder::new("report-unstamped");
    let keys = "delay = \"2 ms\"\ntimestamps = \"off\"";
    let files = live(&record, "unstamped", keys);
    let summary = files.summary();
    for name in CHANNELS {
        let account = account(&summary, name);
        assert!(account.end_to_end.distribution.measured().is_some());
        let stamped = [Stage::TxSoftware, Stage::RxSoftware];
        let of_kernel = account
            .segments
            .iter()
            .filter(|segment| !segment.is_combined && stamped.contains(&segment.from));
        for segment in of_kernel {
            assert!(segment.distribution.measured().is_none(), "{segment:?}");
        }
    }
    let page = page(files.root(), &record.join("page.html"));
    assert!(page.contains("unavailable"));
}

#[test]
fn a_run_of_a_million_messages_has_a_page_of_bounded_size() {
    let record = RunFolder::new("report-million");
    let file = record.write(
        "million.toml",
        &emulated_shuttle("million", "delay = \"5 ms\""),
    );
    let folder = record.join("simulated");
    let began = Instant::now();
    let words = [
        "simulate",
        "--set",
        "run.duration=\"500 s\"",
        "--set",
        "case.parameters.rate_hz=1000.0",
        "--topology",
    ];
    let words = words.map(Path::new);
    let rest = [file.as_path(), Path::new("--output"), &folder];
    run(&[words.as_slice(), rest.as_slice()].concat()).assert_success();
    println!("simulated in {:?}", began.elapsed());
    let summary = fs::read_to_string(folder.join("summary.json")).unwrap();
    let summary = RunSummary::from_json(&summary).unwrap();
    let published = |name: &&str| account(&summary, name).published_count;
    let count: u64 = CHANNELS.iter().map(published).sum();
    assert!(count >= 990_000, "{count}");
    let output = record.join("page.html");
    let page = page(&folder, &output);
    assert!(page.contains("million"));
    assert!(page.len() < MILLION_BYTES_MAX, "{} bytes", page.len());
    check_opened(&output);
}

/// How many elements the page has once a browser has read it, and, said only, how long that took.
fn check_opened(file: &Path) {
    let Some(mut browser) = Browser::start_or_skip() else {
        return;
    };
    let mut page = browser.page(1440, 900);
    page.go(&format!("file://{}", file.display()));
    page.wait_until("performance.getEntriesByType('navigation')[0]?.loadEventEnd > 0");
    let load_ms = page.value("performance.getEntriesByType('navigation')[0].loadEventEnd");
    let elements = page.value("document.getElementsByTagName('*').length");
    let elements = elements.as_u64().unwrap();
    println!("opened in {load_ms} ms, {elements} elements");
    assert!(elements > 100, "{elements} elements");
    assert!(elements < MILLION_ELEMENT_COUNT_MAX, "{elements} elements");
    assert!(page.complaints().is_empty(), "{:?}", page.complaints());
}
