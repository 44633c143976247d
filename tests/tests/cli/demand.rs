//! A channel over an emulated link with outages, held against a demand in the terms of 3GPP: what the command prints and
//! what the summary holds.

use std::fs;
use std::path::Path;

use hil_account::{DemandMetrics, DemandVerdict};
use hil_report::summary::RunSummary;
use hil_tests::binary::hil_runtime as run;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::emulated_shuttle;

const COMMAND: &str = "shuttle/command";

/// Five minutes over `link`; what was printed, and the demand of the commands.
fn simulated(name: &str, link: &str, availability: f64) -> (String, DemandMetrics) {
    let record = RunFolder::new(name);
    let demand = format!(
        "[channels.\"{COMMAND}\".demand]\nlatency_max = \"20 ms\"\nsurvival_time = \"25 ms\"\n\
         interval = \"10 ms\"\navailability = {availability}\n"
    );
    let text = emulated_shuttle(name, link) + &demand;
    let file = record.write("demand.toml", &text);
    let folder = record.join("simulated");
    let words = ["simulate", "--set", "run.duration=\"300 s\"", "--topology"].map(Path::new);
    let rest = [file.as_path(), Path::new("--output"), &folder];
    let finished = run(&[words.as_slice(), rest.as_slice()].concat());
    finished.assert_success();
    let summary = fs::read_to_string(folder.join("summary.json")).unwrap();
    let summary = RunSummary::from_json(&summary).unwrap();
    let mut channels = summary.channels.into_iter();
    let command = channels.find(|one| one.name == COMMAND).unwrap();
    (
        finished.stdout.replace('\u{a0}', " "),
        command.demand.unwrap(),
    )
}

#[test]
fn outages_miss_a_demand_that_a_link_without_them_meets() {
    let outages = "delay = \"5 ms\"\noutages = { mean = \"200 ms\", per_hour = 600 }";
    let (text, demand) = simulated("demand-missed", outages, 0.999);
    assert_eq!(demand.verdict, DemandVerdict::Missed);
    let service = demand.service.measured().unwrap();
    // An outage of `l` takes the messages of `l`; the service is down from 45 ms after the first to 5 ms after the next.
    assert!((20..80).contains(&service.failure_count), "{service:?}");
    assert!(
        service
            .longest
            .is_some_and(|one| one.length_ns > 200_000_000)
    );
    assert_eq!(service.down_ns, service.down_ns_max);
    assert_eq!(service.asked_ns + service.idle_ns, 300_000_000_000);
    assert_eq!(service.late_count + service.lost_by_host_count, 0);
    // The last one is under way at the end.
    assert!(service.unknown_count <= 1, "{service:?}");
    assert!(service.availability > 0.95 && service.availability < 0.995);
    let mean_ns = service.time_between_failures_ns.unwrap() as f64;
    let up_ns = (service.asked_ns - service.down_ns) as f64;
    assert!((mean_ns * service.failure_count as f64 / up_ns - 1.0).abs() < 1e-6);
    assert!(
        text.contains(&format!("{COMMAND} MISSED: available 9")),
        "{text}"
    );

    let (text, demand) = simulated("demand-met", "delay = \"5 ms\"", 0.999);
    assert_eq!(demand.verdict, DemandVerdict::Met);
    assert!(
        !text.contains("MISSED") && !text.contains("demand "),
        "{text}"
    );

    let (text, demand) = simulated("demand-short", "delay = \"5 ms\"", 0.99999);
    assert_eq!(demand.verdict, DemandVerdict::SampleTooSmall);
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    let expected =
        "not decided: no failure in 300 s, which shows 99.988 % (95 %), 99.999 % asked for";
    assert!(text.contains(expected), "{text}");

    let (_, demand) = simulated("demand-late", "delay = \"21 ms\"", 0.999);
    assert_eq!(demand.verdict, DemandVerdict::Missed);
    let service = demand.service.measured().unwrap();
    assert_eq!((service.in_time_count, service.failure_count), (0, 1));
    assert!(service.longest.is_some_and(|one| one.is_open));
}
