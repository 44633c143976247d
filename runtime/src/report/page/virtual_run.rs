//! Runs that were not live: in virtual time, or begun and never finished.

use super::channel::{self, Sources};
use super::data::{Channel, FactGroup, Run, RunKind, Verdict};
use super::drawings;
use super::material::{Manifest, VirtualCounts, VirtualReport};
use super::paper;
use super::run::{METHOD, score};
use super::words::UNAVAILABLE;
use crate::report::summary::{Fact, host_words};
use crate::report::terminal::{duration, grouped, percent, seconds};

/// A run of `simulate`.
pub(super) fn virtual_time(key: &str, report: &VirtualReport, folder: &str) -> Run {
    let mut run = Run {
        key: key.to_owned(),
        name: report.name.clone(),
        case: UNAVAILABLE.to_owned(),
        kind: RunKind::Virtual,
        outcome: Verdict {
            tone: "good",
            word: "simulated".to_owned(),
            text: format!("{} in virtual time", seconds(report.duration_s)),
        },
        network_verdict: Verdict {
            tone: "plain",
            word: "virtual time".to_owned(),
            text: "virtual time: a result about the link models, not about a network".to_owned(),
        },
        facts: vec![FactGroup {
            title: "Run".to_owned(),
            facts: vec![
                Fact::new("length", seconds(report.duration_s)),
                Fact::new("seed", report.seed.to_string()),
                Fact::new("hosts", "none: virtual time"),
                Fact::new("folder", folder),
            ],
        }],
        score: score(&report.score.metrics),
        method: METHOD.map(str::to_owned).to_vec(),
        clocks: vec!["Virtual time: one clock, bound 0.".to_owned()],
        missing: vec![
            "Kernel, pinning, time stamps and the command line: a folder of `simulate` has none of them."
                .to_owned(),
        ],
        ..Run::default()
    };
    run.method.insert(
        0,
        "In virtual time the network begins at publication; what the link model delays and \
                          loses is all there is."
            .to_owned(),
    );
    for (name, counts) in &report.channels {
        run.channels
            .push(virtual_channel(key, (name, counts), report));
    }
    let model = report
        .links
        .values()
        .next()
        .map_or("no network", |link| link.model.as_str());
    run.paper = paper::table("", &report.score.metrics, report.network.as_ref(), model);
    run
}

fn virtual_channel(
    key: &str,
    (name, counts): (&str, &VirtualCounts),
    report: &VirtualReport,
) -> Channel {
    let network = report.network.as_ref();
    let network = network.and_then(|report| report.channels.iter().find(|one| one.channel == name));
    let link = report.links.get(name);
    let hosts = network.map(|one| (one.from_host.clone(), one.to_host.clone()));
    let (from, to) = hosts.unwrap_or_default();
    let mut channel = Channel {
        name: name.to_owned(),
        from,
        to: Some(to).filter(|to| !to.is_empty()),
        link: link.map_or_else(|| "no link".to_owned(), |link| link.model.clone()),
        ..Channel::default()
    };
    let sources = Sources {
        crosses: network.is_some() || link.is_some(),
        network: network.map(|one| &one.figures),
        outages: report.outages.get(name),
        virtual_counts: Some((
            counts.published_count,
            counts.taken_count,
            counts.in_flight_count,
        )),
        virtual_order: link.map(|link| (link.duplicated_count, link.overtaken_count)),
        ..Sources::default()
    };
    channel::fill(&mut channel, &sources);
    if let Some(link) = link {
        let asked = link
            .requested_loss_ratio
            .map_or_else(|| UNAVAILABLE.to_owned(), percent);
        let given = link
            .delay
            .map_or_else(|| UNAVAILABLE.to_owned(), |one| duration(one.p50_ns));
        channel.notes.push(format!(
            "loss asked for {asked}; median delay given {given}"
        ));
    }
    channel.drawings = drawings::of_channel((key, name), &sources);
    channel
}

/// A run without a summary.
pub(super) fn unfinished(key: &str, manifest: &Manifest, folder: &str) -> Run {
    let (files, bytes) = manifest.records;
    let seed = manifest
        .seed
        .map_or_else(|| UNAVAILABLE.to_owned(), |seed| seed.to_string());
    Run {
        key: key.to_owned(),
        name: manifest.name.clone(),
        case: manifest.case.clone(),
        kind: RunKind::Unfinished,
        outcome: Verdict {
            tone: "bad",
            word: "unfinished".to_owned(),
            text: "this run never began or was killed outright, so it left no summary".to_owned(),
        },
        network_verdict: Verdict {
            tone: "caution",
            word: "no verdict".to_owned(),
            text: "no verdict: there are no figures".to_owned(),
        },
        missing: vec![
            "Score, channels, delays, losses and events: unavailable without summary.json."
                .to_owned(),
            format!(
                "{} files of records with {} bytes are whole up to the moment it ended.",
                grouped(files),
                grouped(bytes)
            ),
        ],
        facts: vec![
            FactGroup {
                title: "Run".to_owned(),
                facts: vec![
                    Fact::new("begun", &manifest.created),
                    Fact::new("seed", seed),
                    Fact::new("folder", folder),
                ],
            },
            FactGroup {
                title: "Host".to_owned(),
                facts: host_words(&manifest.host_facts),
            },
        ],
        repeat_command: Some(manifest.command_line.join(" ")).filter(|line| !line.is_empty()),
        ..Run::default()
    }
}
