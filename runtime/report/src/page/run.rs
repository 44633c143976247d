//! One run of a page, from what its folder holds. Judgements and words are those of the terminal report;
//! nothing is measured here.

use super::channel::{self, Sources};
use super::data::{AnswerView, Channel, FactGroup, Metric, Run, RunKind, Table, Verdict};
use super::events::{correlation, network_events, score_events};
use super::read::{Found, Manifest, Material};
use super::words::{UNAVAILABLE, count};
use super::{drawings, paper, timeline};
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::clock_summary::ClockSection;
use crate::score_event::ScoreEvents;
use crate::summary::{
    ChannelSummary, DirectionSummary, Fact, LinkKind, RunSummary, ScoreMetric, host_words,
};
use crate::terminal::{self, duration, seconds, unsigned_duration};
use hil_platform::text::grouped;
use hil_platform::words::counted;

/// How figures came about, for every run.
const METHOD: [&str; 3] = [
    terminal::CLOSING_METHOD,
    "Quantiles are from histograms with three digits, of messages that were taken; of the network, of \
     messages that arrived. Intervals are 95 %: Wilson for shares, Clopper and Pearson where a score \
     says so, block bootstrap for quantiles, because successive delays are correlated. The error of \
     the clocks' alignment is in no interval; it stands beside the figures as a bound.",
    "The network begins where the sending gateway hands a message to the kernel and ends where the \
     receiving gateway's receive call returned. What a host lost is not among its losses. That an \
     event stands beside an outage or follows a series is a matter of time, not of cause.",
];

/// The run in `material`; `steps` is how many points a series over time may have.
pub(super) fn of(material: &Material, index: usize, steps: usize) -> Run {
    let key = format!("run-{}", index + 1);
    let mut run = match &material.found {
        Found::Ended(summary) => live(&key, summary),
        Found::Unfinished(manifest) => unfinished(&key, manifest, &material.folder),
    };
    let nothing = ScoreEvents::default();
    let (network, events, changes) = match &material.found {
        Found::Ended(one) => (
            one.network.as_ref(),
            &one.score_events,
            &one.link_changes[..],
        ),
        Found::Unfinished(_) => (None, &nothing, &[][..]),
    };
    if let Some(report) = network {
        run.drawings.push(timeline::over_run(
            &key,
            report,
            events,
            changes,
            &material.series,
            steps,
        ));
        run.network_events = network_events(report);
        run.correlation = correlation(report);
    } else if run.kind != RunKind::Unfinished {
        run.missing.push(
            "Network over time: no channel crossed a network, so there is nothing to draw."
                .to_owned(),
        );
    }
    run.score_events = score_events(events);
    let (drawing, left_out) = timeline::of_case(&key, &material.series, steps);
    if drawing.is_none() && run.kind != RunKind::Unfinished {
        run.missing
            .push("The robot over time: the case left no series, or they are empty.".to_owned());
    }
    run.drawings.extend(drawing);
    let not_drawn = left_out
        .into_iter()
        .map(|file| format!("Not drawn for want of room: {file}."));
    run.missing.extend(not_drawn);
    run.missing.extend(material.problems.iter().cloned());
    run.headline = headline(&run);
    run.printed.clone_from(&material.printed);
    run
}

/// A run without a summary.
fn unfinished(key: &str, manifest: &Manifest, folder: &str) -> Run {
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

fn live(key: &str, summary: &RunSummary) -> Run {
    let assessment = Assessment::of(summary);
    let facts = &summary.run;
    let (tone, word) = terminal::outcome_words(facts.outcome);
    let mut run = Run {
        key: key.to_owned(),
        name: facts.name.clone(),
        case: facts.case.clone(),
        kind: if facts.is_virtual {
            RunKind::Virtual
        } else {
            RunKind::Live
        },
        outcome: Verdict {
            tone: tone.word(),
            word: word.to_owned(),
            text: facts.exit_reason.clone(),
        },
        answer: Some(answer_view(summary, &assessment)),
        warnings: assessment.warnings,
        facts: live_facts(summary),
        score: score(&summary.score),
        channels: summary
            .channels
            .iter()
            .map(|one| live_channel(key, one, summary))
            .collect(),
        processes: processes(summary),
        clocks: summary.clocks.as_ref().map(clocks).unwrap_or_default(),
        method: METHOD.map(str::to_owned).to_vec(),
        files: facts.files.clone(),
        repeat_command: Some(facts.repeat_command.clone()),
        ..Run::default()
    };
    run.paper = paper::table(
        &run.case,
        &summary.score,
        summary.network.as_ref(),
        &links(summary),
    );
    let accounts = summary.channels.iter();
    let accounts = accounts.filter_map(|one| Some((one.name.as_str(), one.account.as_ref()?)));
    let waterfall = drawings::of_accounts(key, accounts);
    if waterfall.is_none() {
        run.missing
            .push("Where the time went: no channel has a measured segment.".to_owned());
    }
    run.drawings.extend(waterfall);
    run
}

fn answer_view(summary: &RunSummary, assessment: &Assessment) -> AnswerView {
    let answer = Answer::of(summary, assessment);
    let plain = |text: String| text.replace(terminal::JOINT, " ");
    let (tone, words) = answer.measurement_words(&assessment.network);
    AnswerView {
        question: answer.question(),
        answer: Verdict {
            tone: answer.tone().word(),
            word: plain(answer.words()),
            text: plain(answer.sentence()),
        },
        measurement: Verdict {
            tone: tone.word(),
            word: "measurement".to_owned(),
            text: plain(words),
        },
        sample: plain(answer.sample_words()),
        harms: summary
            .harms
            .iter()
            .map(|harm| Fact::new(&harm.what, plain(harm.words())))
            .collect(),
    }
}

fn links(summary: &RunSummary) -> String {
    let mut words: Vec<&str> = Vec::new();
    let crossing = |name: &str| {
        let report = summary.network.as_ref();
        report.is_some_and(|report| report.channels.iter().any(|one| one.channel == name))
    };
    for one in summary.channels.iter().filter(|one| crossing(&one.name)) {
        if !words.contains(&one.link.label()) {
            words.push(one.link.label());
        }
    }
    if words.is_empty() {
        "no network".to_owned()
    } else {
        words.join(", ")
    }
}

fn live_facts(summary: &RunSummary) -> Vec<FactGroup> {
    let run = &summary.run;
    let mut hosts: Vec<&str> = summary
        .processes
        .iter()
        .map(|one| one.host.as_str())
        .collect();
    hosts.sort_unstable();
    hosts.dedup();
    let mut facts = vec![
        Fact::new("started", &run.started),
        Fact::new("length", seconds(run.duration_s)),
        Fact::new(
            "hosts",
            if hosts.is_empty() {
                UNAVAILABLE.to_owned()
            } else {
                hosts.join(", ")
            },
        ),
        Fact::new("written by", &run.host),
        Fact::new(
            "topology",
            format!("{} ({})", run.topology_file, run.topology_hash),
        ),
        Fact::new("seed", run.seed.to_string()),
        Fact::new("folder", &run.folder),
    ];
    let security = run.security.iter();
    facts.extend(security.map(|one| Fact::new("hops between hosts", one.to_string())));
    let group = |title: &str, facts: Vec<Fact>| FactGroup {
        title: title.to_owned(),
        facts,
    };
    let or_none = |facts: &[Fact], none: &str| {
        if facts.is_empty() {
            vec![Fact::new(none, "")]
        } else {
            facts.to_vec()
        }
    };
    let changes = summary.link_changes.iter();
    let changes: Vec<Fact> = changes
        .map(|change| Fact::new(change.time(), change.what()))
        .collect();
    let by_hand = (!changes.is_empty()).then(|| group("Links changed by hand", changes));
    let groups = vec![
        group("Run", facts),
        group(
            "Granted by the kernel",
            or_none(&summary.realtime.granted, "nothing was asked for"),
        ),
        group(
            "Refused by the kernel",
            or_none(&summary.realtime.refused, "nothing"),
        ),
        group(
            "Host that wrote this",
            or_none(&host_words(&summary.host_facts), UNAVAILABLE),
        ),
    ];
    let gateways = gateways(&summary.directions);
    groups.into_iter().chain(gateways).chain(by_hand).collect()
}

fn live_channel(key: &str, one: &ChannelSummary, summary: &RunSummary) -> Channel {
    let report = summary.network.as_ref();
    let network =
        report.and_then(|report| report.channels.iter().find(|each| each.channel == one.name));
    let mut channel = Channel {
        name: one.name.clone(),
        from: one.from.clone(),
        to: one.to.clone(),
        link: one.link.label().to_owned(),
        ..Channel::default()
    };
    if one.to.is_none() {
        let recorded = one.recorded.map_or_else(
            || format!("{UNAVAILABLE}: no record of this channel"),
            |figures| {
                let all = counted(figures.message_count, "message");
                let missing = grouped(figures.missing_count);
                format!("{all} recorded, {missing} missing in the record")
            },
        );
        channel.notes.push(recorded);
        return channel;
    }
    let is_local = matches!(one.link, LinkKind::SharedMemory | LinkKind::RecordOnly);
    let sources = Sources {
        crosses: network.is_some() || !is_local,
        account: one.account.as_ref(),
        link: Some(one.link),
        network: network.map(|network| &network.figures),
        outages: one.outages.as_ref(),
    };
    channel::fill(&mut channel, &sources);
    channel.notes.extend(notes(one));
    channel.drawings = drawings::of_channel(key, &one.name, &sources);
    channel
}

/// What has no figure: whether the account closes, the link model, the gateways.
fn notes(one: &ChannelSummary) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(account) = &one.account {
        notes.extend(terminal::closing_text(&account.closing));
        if account.published_count == 0 {
            notes.push("no message was published".to_owned());
        }
    }
    if let Some(figures) = &one.emulation {
        let [asked, done] = [figures.requested, figures.achieved].map(|one| duration(one.p50_ns));
        let late = duration(figures.scheduling_error.p99_ns);
        let limit = duration(figures.error_max_ns);
        notes.push(format!(
            "emulated link: delay asked for {asked}, given {done} (medians); released late by {late} at \
             p99, limit {limit}"
        ));
    }
    notes
}

/// The gateways at both ends of each way of each link.
fn gateways(directions: &[DirectionSummary]) -> Option<FactGroup> {
    let rows = directions.iter().map(|one| {
        let mut words = one.words();
        let refused = one.refusal_words();
        if !refused.is_empty() {
            words.push(format!("datagrams refused: {}", refused.join(", ")));
        }
        let stalls = one.stalls.iter();
        words.extend(stalls.map(|one| format!("stalls: {}", terminal::stall_words(one))));
        let label = format!("{}, {}", one.label(), one.direction.word());
        Fact::new(label, words.join(", "))
    });
    let facts: Vec<Fact> = rows.collect();
    (!facts.is_empty()).then(|| FactGroup {
        title: "Gateways".to_owned(),
        facts,
    })
}

/// The figures of a score.
pub(super) fn score(metrics: &[ScoreMetric]) -> Vec<Metric> {
    let figure = |one: &ScoreMetric| {
        Metric::maybe(&one.name, &one.label, &one.unit, one.value, &one.method)
            .within(one.interval)
            .by(&one.method)
    };
    metrics.iter().map(figure).collect()
}

fn processes(summary: &RunSummary) -> Option<Table> {
    if summary.processes.is_empty() {
        return None;
    }
    let columns = [
        "process",
        "host",
        "role",
        "ended",
        "restarts",
        "ticks",
        "skipped",
        "processor time",
    ];
    let mut table = Table::new("Processes", &columns);
    for one in &summary.processes {
        let ticks = |count_of: Option<u64>| {
            if one.kind.counts_ticks() {
                count(count_of)
            } else {
                "–".to_owned()
            }
        };
        let cpu = one
            .cpu_time_s
            .map_or_else(|| UNAVAILABLE.to_owned(), terminal::duration_s);
        let words = [
            one.name.clone(),
            one.host.clone(),
            one.label(),
            one.exit.clone(),
        ];
        let figures = [
            grouped(one.restart_count),
            ticks(one.tick_count),
            ticks(one.skipped_tick_count),
            cpu,
        ];
        table.rows.push([words, figures].concat());
    }
    Some(table)
}

fn clocks(section: &ClockSection) -> Vec<String> {
    let mut words = Vec::new();
    if section.has_one_clock {
        words.push("All hosts read one clock: stamps compare as they are, bound 0.".to_owned());
    }
    for pair in &section.pairs {
        let bound = pair.exchanges.as_ref().and_then(|figures| figures.bound);
        let bound = bound.map_or_else(
            || format!("bound of the exchanges {UNAVAILABLE}"),
            |bound| {
                let largest = unsigned_duration(bound.largest_ns);
                format!("exchanges bound the error by {largest}")
            },
        );
        let (from, to, rung) = (&pair.from, &pair.to, pair.rung_words());
        words.push(format!("{from} and {to}: {rung}; {bound}. {}", pair.basis));
        words.extend(pair.contradiction.clone());
    }
    for (host, discipline) in &section.hosts {
        words.push(format!("{host}: {}", discipline.basis));
    }
    words
}

/// True when the 99th percentile of a channel is more than its largest value: that of two messages is
/// no figure to see first.
fn has_a_hundredth(channel: &Channel) -> bool {
    let mut figures = channel.figures.iter();
    let delivered = figures.find(|one| one.name == "delivered");
    delivered.and_then(|one| one.value).unwrap_or(0.0) >= 100.0
}

/// Figures of which the channel with the largest is shown first, and what they are called.
pub(super) const WORST: [(&str, &str); 3] = [
    ("loss_ratio", "largest loss"),
    ("p99", "largest p99"),
    ("network_p99", "network's largest p99"),
];

/// The figures to see first: what the case is about, the worst of the network, and how often the
/// robot came to harm.
fn headline(run: &Run) -> Vec<Metric> {
    let wanted = ["collision_ratio", "motion_loss_ratio"];
    let named = run
        .score
        .iter()
        .find(|one| wanted.contains(&one.name.as_str()));
    let mut figures: Vec<Metric> = named
        .or_else(|| run.score.first())
        .cloned()
        .into_iter()
        .collect();
    for (name, words) in WORST {
        let is_quantile = name != "loss_ratio";
        let channels = run.channels.iter();
        let told = channels.filter(|one| !is_quantile || has_a_hundredth(one));
        let found = told.flat_map(|channel| {
            let of_name = channel
                .figures
                .iter()
                .filter(|one| one.name == name && one.value.is_some());
            of_name.map(|one| (channel.name.as_str(), one))
        });
        let worst = found.max_by(|a, b| {
            a.1.value
                .partial_cmp(&b.1.value)
                .unwrap_or(core::cmp::Ordering::Equal)
        });
        if let Some((channel, figure)) = worst {
            let label = format!("{words}: {channel}");
            figures.push(Metric {
                label,
                ..figure.clone()
            });
        }
    }
    figures
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_delay_to_see_first_rests_on_a_hundred_messages() {
        let channel = |name: &str, delivered, p99| Channel {
            name: name.to_owned(),
            figures: vec![
                Metric::new("delivered", "delivered", "1", delivered),
                Metric::new("p99", "p99", "s", p99),
            ],
            ..Channel::default()
        };
        let mut run = Run {
            channels: vec![channel("often", 100.0, 1e-3), channel("twice", 2.0, 5e-3)],
            ..Run::default()
        };
        let [first] = headline(&run).try_into().unwrap();
        assert_eq!(first.label, "largest p99: often");
        run.channels.remove(0);
        assert!(headline(&run).is_empty());
    }
}
