//! What a run answers, and the report that a run prints.

use hil_account::flow::{DeadlineFold, DeadlineMetrics};
use hil_account::{ChannelAccount, FateCounts, MessageFate};
use hil_core::case_study::Severity;

use super::sample::{awkward, check_golden, demand, empty, flow, full, link};
use super::sample_events::few_events;
use crate::answer::{Answer, Clocks, HarmCount, Hurt, OccasionCount, Unresolved, Untested};
use crate::assessment::Assessment;
use crate::network::{PrecedingLoss, TimelineRow, TimelineSubject};
use crate::page::Format;
use crate::page::read::{Found, Material};
use crate::score_event::{EventOutage, ScoreEvents};
use crate::summary::{ChannelFlows, Fact, LinkKind, Outcome, RunSummary, ScoreMetric};
use crate::terminal::{Style, brief, render};
use hil_core::interval::{Interval, IntervalMethod, Spread};
use hil_present::Tone;
use hil_present::units::JOINT;
use hil_rundir::event::ProcessKind;
use hil_rundir::pipe::{CountByName, CounterGroup};
use hil_stats::histogram::Distribution;

fn lost_loops(count: Option<u64>, own_count: u64, sent_count: u64) -> HarmCount {
    HarmCount {
        what: "motion loops lost".to_owned(),
        count,
        own_count,
        occasions: Some(OccasionCount {
            what: "motion loops sent".to_owned(),
            count: sent_count,
        }),
        interval: Some(Spread::Known(Interval::new(
            0.01,
            0.15,
            IntervalMethod::EffectiveShare,
        ))),
        note: "hand movements out and back that the arm did not make".to_owned(),
    }
}

/// A run over a network on one clock whose host kept its ticks.
fn run(harm: HarmCount) -> RunSummary {
    let mut summary = full();
    summary.processes[0].skipped_tick_count = Some(0);
    summary.harms = vec![harm];
    summary
}

/// The page of a run.
fn page_text(summary: &RunSummary) -> String {
    let material = Material {
        folder: "run".to_owned(),
        found: Found::Ended(Box::new(summary.clone())),
        series: Vec::new(),
        problems: Vec::new(),
    };
    crate::page::render(&[material], None, Format::Html, None).unwrap()
}

fn answer(summary: &RunSummary) -> Answer {
    Answer::of(summary, &Assessment::of(summary))
}

#[test]
fn a_hurt_robot_is_put_down_to_a_network_that_misbehaved_before() {
    let summary = run(lost_loops(Some(2), 0, 40));
    let found = answer(&summary);
    assert_eq!(found.hurt, Hurt::Yes);
    assert_eq!(found.sentence(), "YES, the network hurt the robot");
    assert_eq!(found.tone(), Tone::Bad);
    let words = "2 of 40 motion loops sent: 5.00 % [1.00 %, 15.00 %]";
    assert_eq!(summary.harms[0].words().replace(JOINT, " "), words);
    // Nothing happened on the network, or to a message, before it.
    let mut alone = summary.clone();
    for event in &mut alone.score_events.events {
        event.outages.clear();
        event.messages.clear();
        if let Some(network) = &mut event.network {
            network.events.clear();
        }
    }
    let because = Unresolved::NoNetworkEventBefore;
    assert_eq!(answer(&alone).hurt, Hurt::NotResolvable { because });
    // A network event came before, as before most moments of the run.
    let mut noisy = summary.clone();
    for event in &mut noisy.score_events.events {
        event.outages.clear();
        event.messages.clear();
    }
    noisy.network.as_mut().unwrap().foregoing_chance_ratio = 0.1;
    assert_eq!(answer(&noisy).hurt, Hurt::Yes);
    noisy.network.as_mut().unwrap().foregoing_chance_ratio = 0.9;
    let because = Unresolved::NoNetworkEventBefore;
    assert_eq!(answer(&noisy).hurt, Hurt::NotResolvable { because });
    // Only what the robot coped with.
    let mut coped = summary.clone();
    for event in &mut coped.score_events.events {
        event.severity = Severity::Notice;
    }
    let because = Unresolved::NoNetworkEventBefore;
    assert_eq!(answer(&coped).hurt, Hurt::NotResolvable { because });
    let mut unordered = summary;
    unordered.score_events.clocks_differ = true;
    let because = Unresolved::ClocksDiffer;
    assert_eq!(answer(&unordered).hurt, Hurt::NotResolvable { because });
}

#[test]
fn what_a_killed_gateway_or_a_full_buffer_lost_is_not_the_network() {
    use MessageFate as Fate;
    let hurt = |fate: Fate, by_network_count: u64| {
        let mut summary = run(lost_loops(Some(2), 0, 40));
        for event in &mut summary.score_events.events {
            event.network.as_mut().unwrap().events.clear();
            for outage in &mut event.outages {
                assert!(outage.lost_count > 3);
                outage.lost_by_network_count = by_network_count;
            }
            for message in &mut event.messages {
                message.fate = Some(fate);
            }
        }
        answer(&summary).hurt
    };
    let because = Unresolved::NoNetworkEventBefore;
    let unexplained = Hurt::NotResolvable { because };
    for fate in [
        Fate::LostInInterruption,
        Fate::LostByHarness,
        Fate::LostOnWireOrByHarness,
    ] {
        assert_eq!(hurt(fate, 0), unexplained, "{fate:?}");
        // Single losses beside it are no outage of the network.
        assert_eq!(hurt(fate, 2), unexplained, "{fate:?}");
        assert_eq!(hurt(fate, 3), Hurt::Yes, "{fate:?}");
    }
    assert_eq!(hurt(Fate::LostOnWire, 0), Hurt::Yes, "a message is named");
}

#[test]
fn a_harm_without_occasions_is_tested_by_the_messages_that_crossed() {
    let of = |published_count: u64| {
        let mut summary = run(HarmCount {
            occasions: None,
            ..lost_loops(Some(0), 0, 0)
        });
        count_all(&mut summary);
        for channel in &mut summary.channels {
            if let Some(account) = &mut channel.account {
                account.published_count = if channel.link.is_crossing() {
                    published_count
                } else {
                    5_000
                };
                account.fates = FateCounts::default();
                account.segments.clear();
            }
        }
        answer(&summary)
    };
    // Two channels cross.
    assert_eq!(of(5).words(), "NO: no harm in 10 messages");
    let Hurt::NotResolvable {
        because: Unresolved::SampleTooSmall { count: 8, .. },
    } = of(4).hurt
    else {
        panic!("{:?}", of(4));
    };
}

#[test]
fn the_sample_of_an_answer_is_what_its_verdict_rests_on() {
    let mut summary = run(lost_loops(Some(0), 0, 600));
    summary.harms.push(HarmCount {
        occasions: Some(OccasionCount {
            what: "grasps".to_owned(),
            count: 12,
        }),
        ..lost_loops(Some(0), 0, 0)
    });
    assert_eq!(answer(&summary).words(), "NO: no harm in 12 grasps");
}

#[test]
fn what_the_robot_did_to_itself_is_not_the_network() {
    let summary = run(lost_loops(Some(2), 2, 40));
    assert_eq!(answer(&summary).hurt, Hurt::No);
    assert!(
        summary.harms[0]
            .words()
            .ends_with("; 2 by limits of the robot")
    );
    assert_eq!(answer(&run(lost_loops(Some(3), 2, 40))).hurt, Hurt::Yes);
}

#[test]
fn harms_that_did_not_happen_are_named_in_one_line_and_counted_in_the_full_report() {
    let mut two = run(lost_loops(Some(0), 0, 600));
    count_all(&mut two);
    two.harms.push(HarmCount {
        what: "collisions".to_owned(),
        ..lost_loops(Some(0), 0, 700)
    });
    let page = brief(&two, 100, Style::Plain);
    assert!(page.contains("none seen"), "{page}");
    assert!(page.contains("motion loops lost; collisions"), "{page}");
    assert!(!page.contains("0 of 700"), "{page}");
    let whole = render(&two, 100, Style::Plain);
    assert!(!whole.contains("none seen"), "{whole}");
    for counted in ["0 of 600 motion loops sent", "0 of 700 motion loops sent"] {
        assert!(whole.contains(counted), "{whole}");
    }
}

#[test]
fn a_sample_that_is_too_small_shows_no_absence_of_harm() {
    let small = run(lost_loops(Some(0), 0, 9));
    let Hurt::NotResolvable {
        because: Unresolved::SampleTooSmall { count: 9, .. },
    } = answer(&small).hurt
    else {
        panic!("{:?}", answer(&small));
    };
    assert_eq!(small.harms[0].words(), "0 of 9 motion loops sent");
    assert!(brief(&small, 100, Style::Plain).contains("too small"));
    let mut enough = run(lost_loops(Some(0), 0, 10));
    count_all(&mut enough);
    let page = brief(&enough, 100, Style::Plain);
    let page = page.split_whitespace().collect::<Vec<_>>().join(" ");
    let means = "NO means none in 10 motion loops sent: a rate of up to 300 per 1,000 remains possible (95 %)";
    assert!(page.contains(means), "{page}");
    let enough = answer(&enough);
    assert_eq!((enough.hurt.clone(), enough.tone()), (Hurt::No, Tone::Good));
    // The harm with the fewest occasions decides.
    let mut few = run(lost_loops(Some(0), 0, 600));
    count_all(&mut few);
    few.harms.push(lost_loops(Some(0), 0, 2));
    let hurt = answer(&few).hurt;
    assert!(
        matches!(
            hurt,
            Hurt::NotResolvable {
                because: Unresolved::SampleTooSmall { count: 2, .. }
            }
        ),
        "{hurt:?}"
    );
    // Harm is harm, however small the sample.
    assert_eq!(answer(&run(lost_loops(Some(1), 0, 3))).hurt, Hurt::Yes);
    let because = Unresolved::NotCounted;
    assert_eq!(
        answer(&run(lost_loops(None, 0, 40))).hurt,
        Hurt::NotResolvable { because }
    );
}

#[test]
fn an_invalid_measurement_blames_nobody() {
    for count in [0, 2] {
        let mut summary = run(lost_loops(Some(count), 0, 40));
        summary.processes[1].skipped_tick_count = Some(500);
        let found = answer(&summary);
        let because = Unresolved::InvalidMeasurement;
        assert_eq!(found.hurt, Hurt::NotResolvable { because });
        assert_eq!(found.measurement.is_valid, Some(false));
        let page = brief(&summary, 100, Style::Plain);
        assert!(
            page.contains("NOT VALID: the host overran: 500 of"),
            "{page}"
        );
        assert!(page.contains("hil-runtime doctor"), "{page}");
    }
}

#[test]
fn without_a_network_or_a_score_nothing_was_tested() {
    let tested = |change: &dyn Fn(&mut RunSummary)| {
        let mut summary = run(lost_loops(Some(0), 0, 40));
        change(&mut summary);
        answer(&summary).hurt
    };
    let no_network = tested(&|summary| {
        for channel in &mut summary.channels {
            channel.link = LinkKind::SharedMemory;
        }
    });
    let because = Untested::NoNetwork;
    assert_eq!(no_network, Hurt::NotTested { because });
    let because = Untested::NoScore;
    assert_eq!(
        tested(&|one| one.harms.clear()),
        Hurt::NotTested { because }
    );
    let because = Untested::RunFailed;
    let failed = tested(&|one| one.run.outcome = Outcome::Failed);
    assert_eq!(failed, Hurt::NotTested { because });
    // In virtual time a link model is tested, where there is one.
    let is_virtual = |kind: LinkKind| {
        move |summary: &mut RunSummary| {
            summary.run.is_virtual = true;
            for channel in &mut summary.channels {
                channel.link = kind;
            }
        }
    };
    assert_eq!(tested(&is_virtual(LinkKind::Emulated)), Hurt::No);
    let because = Untested::NoNetwork;
    let direct = tested(&is_virtual(LinkKind::SharedMemory));
    assert_eq!(direct, Hurt::NotTested { because });
}

/// Every process ended in order and was never started again.
fn count_all(summary: &mut RunSummary) {
    for process in &mut summary.processes {
        process.restart_count = 0;
        process.cpu_time_s = Some(1.0);
    }
}

#[test]
fn counters_that_a_start_did_not_leave_are_unknown_and_not_zero() {
    // Of the robot's gateway neither start left any.
    let mut summary = run(lost_loops(Some(0), 0, 40));
    let found = answer(&summary);
    let assessment = Assessment::of(&summary);
    assert_eq!(found.measurement.is_valid, Some(true));
    assert_eq!(found.measurement.uncounted_start_count, 2);
    assert_eq!(found.tone(), Tone::Caution);
    let (_, words) = found.measurement_words(&assessment.network);
    let expected =
        "valid as far as known: what 1 killed or restarted process dropped or skipped is unknown";
    assert!(words.replace(JOINT, " ").starts_with(expected), "{words}");
    let named = "robot gateway: the counters of 2 of its 2 starts are unavailable";
    let named = |one: &String| one.replace(JOINT, " ").starts_with(named);
    assert!(assessment.warnings.iter().any(named), "{assessment:?}");
    // Its second start left its own, and where no component has ticks nothing else tells.
    summary.processes[2].cpu_time_s = Some(1.0);
    assert_eq!(answer(&summary).measurement.uncounted_start_count, 1);
    for process in &mut summary.processes {
        (process.tick_count, process.skipped_tick_count) = (None, None);
    }
    let found = answer(&summary);
    assert_eq!(found.measurement.is_valid, None);
    let because = Unresolved::HostUnknown;
    assert_eq!(found.hurt, Hurt::NotResolvable { because });
    let (_, words) = found.measurement_words(&Assessment::of(&summary).network);
    assert!(
        words
            .replace(JOINT, " ")
            .contains("; what 1 killed or restarted process"),
        "{words}"
    );
    count_all(&mut summary);
    let found = answer(&summary);
    assert_eq!(found.measurement.is_valid, Some(true));
    assert_eq!((found.hurt.clone(), found.tone()), (Hurt::No, Tone::Good));
    // A program without a channel of frames never leaves counters.
    summary.processes[0].kind = ProcessKind::OwnProgram;
    summary.processes[0].cpu_time_s = None;
    assert_eq!(answer(&summary).measurement.uncounted_start_count, 0);
    summary.flows = vec![ChannelFlows {
        channel: "arm/command".to_owned(),
        inlet_lost: Vec::new(),
        flows: vec![flow("arp", 2, [0, 0])],
    }];
    assert_eq!(answer(&summary).measurement.uncounted_start_count, 1);
}

#[test]
fn a_run_of_programs_alone_speaks_of_no_robot() {
    let mut summary = own_programs(LinkKind::Emulated);
    summary.run.case.clear();
    summary.score.clear();
    summary.score_events = ScoreEvents::default();
    let timeline = &mut summary.network.as_mut().unwrap().timeline;
    let is_robot = |row: &TimelineRow| matches!(row.subject, TimelineSubject::Robot { .. });
    timeline.rows.retain(|row| !is_robot(row));
    let answer = answer(&summary);
    assert_eq!(
        answer.question(),
        "Did the emulated link hurt the programs?"
    );
    let page = brief(&summary, 100, Style::Plain);
    // A process and a channel of the sample are called so.
    let page = page.replace("robot gateway", "").replace("robot-", "");
    assert!(!page.to_lowercase().contains("robot"), "{page}");
    assert!(page.contains("Network over time"), "{page}");
}

#[test]
fn every_answer_names_the_emulated_links_or_what_the_messages_went_over() {
    let mut summary = run(lost_loops(Some(2), 0, 40));
    summary.run.links = vec![Fact::new("hop", "fixed delay of 5 ms, 1 % lost")];
    let words = "hop: fixed delay of 5 ms, 1 % lost";
    let full = render(&summary, 100, Style::Plain);
    let head: Vec<&str> = full.lines().take(6).collect();
    let line = format!("emulated link {words}");
    assert!(head.iter().any(|one| one.contains(&line)), "{head:?}");
    for page in [brief(&summary, 100, Style::Plain), full] {
        let (_, block) = page.rsplit_once("\u{2500}\n").unwrap();
        let block = block.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(block.contains(&line), "{block}");
        let sample = "sample 40 motion loops sent in 20.0 s";
        assert!(block.contains(sample), "{block}");
    }
    let page = page_text(&summary).replace(JOINT, " ");
    assert!(page.contains(words), "{page}");
}

#[test]
fn a_loss_that_is_one_of_many_is_no_cause_by_itself() {
    let mut summary = run(lost_loops(Some(2), 0, 40));
    let channel = summary.network.as_ref().unwrap().channels[0]
        .channel
        .clone();
    let incident = summary.score_events.events.last_mut().unwrap();
    incident.outages.clear();
    incident.messages.truncate(1);
    incident.messages[0].channel.clone_from(&channel);
    let network = incident.network.as_mut().unwrap();
    network.events.clear();
    network.losses = vec![PrecedingLoss {
        channel,
        lost_count: 26,
        sent_count: 100,
    }];
    let cause = |summary: &RunSummary| {
        let page = brief(summary, 100, Style::Plain);
        page.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let words = "network before it: losses all along: arm/command lost 26.00 % in the 5.00 s before, 5.52 % in \
                 the whole run";
    assert!(cause(&summary).contains(words), "{}", cause(&summary));
    // As so few in a row are, and an outage is not.
    let mut outages = summary.clone();
    let outage = few_events().events[1].outages[0].clone();
    let incident = outages.score_events.events.last_mut().unwrap();
    incident.outages = vec![EventOutage {
        channel: "arm/command".to_owned(),
        ..outage
    }];
    assert!(cause(&outages).contains("network before it: outage of 800 ms"));
    let incident = outages.score_events.events.last_mut().unwrap();
    incident.outages[0].lost_by_network_count = 1;
    assert!(cause(&outages).contains(words), "{}", cause(&outages));
    // Seldom ones are causes by themselves.
    summary.network.as_mut().unwrap().foregoing_chance_ratio = 0.1;
    let words = "network before it: arm/command 900: lost on link hop: emulated loss";
    assert!(cause(&summary).contains(words), "{}", cause(&summary));
}

/// Two programs of the user's with an emulated or a real link between them.
fn own_programs(link: LinkKind) -> RunSummary {
    let mut summary = run(lost_loops(None, 0, 0));
    summary.harms.clear();
    for process in &mut summary.processes {
        if process.kind == ProcessKind::Component {
            process.kind = ProcessKind::OwnProgram;
        }
        (process.tick_count, process.skipped_tick_count) = (None, None);
    }
    for channel in &mut summary.channels {
        channel.link = link;
    }
    summary
}

#[test]
fn requests_that_the_network_made_late_or_lost_are_harm_and_others_are_not() {
    let of = |late: [u64; 4], missing: [u64; 3]| {
        let counts = DeadlineMetrics {
            request_count: 500,
            late_by_network_count: late[0],
            late_by_both_count: late[1],
            late_by_program_count: late[2],
            late_by_harness_count: late[3],
            missing_by_network_count: missing[0],
            missing_by_program_count: missing[1],
            missing_by_harness_count: missing[2],
            hurt_count: late[0] + late[1] + missing[0],
            ..DeadlineFold::new("command", 4_000_000).finish()
        };
        let mut summary = own_programs(LinkKind::Emulated);
        summary.run.case.clear();
        count_all(&mut summary);
        summary.harms = vec![HarmCount::from(&counts)];
        summary.deadlines = vec![counts];
        (answer(&summary).hurt, brief(&summary, 100, Style::Plain))
    };
    let (hurt, page) = of([3, 2, 90, 7], [20, 8, 0]);
    assert_eq!(hurt, Hurt::Yes);
    for words in [
        "Did the emulated link hurt the programs?  YES",
        "command late or missing  25 of 500 requests of command: 5.00 %",
        "answers that would have come in time but for the network",
        "3 network, 90 program, 2 both",
    ] {
        assert!(page.contains(words), "{words}:\n{page}");
    }
    let (hurt, page) = of([0, 0, 90, 7], [0, 8, 0]);
    assert_eq!(hurt, Hurt::No);
    assert!(
        page.contains("0 of 500 requests of command: 0.00 %"),
        "{page}"
    );
    assert!(
        page.contains("NO: no harm in 500 requests of command"),
        "{page}"
    );
}

#[test]
fn programs_without_ticks_are_measured_by_what_the_gateways_and_inlets_lost() {
    let measured = |summary: &RunSummary| {
        let found = answer(summary);
        let because = Untested::NoScore;
        assert_eq!(found.hurt, Hurt::NotTested { because });
        let page = brief(summary, 100, Style::Plain);
        let words: Vec<&str> = page.split_whitespace().collect();
        (found.measurement.is_valid, words.join(" "))
    };
    for kind in [LinkKind::Emulated, link("udp")] {
        let mut summary = own_programs(kind);
        count_all(&mut summary);
        let (is_valid, page) = measured(&summary);
        assert_eq!(is_valid, Some(true), "{page}");
        let frames = |inlet_lost_count| ChannelFlows {
            channel: "first/second".to_owned(),
            inlet_lost: CountByName::all(CounterGroup::Own, [("ring full", inlet_lost_count)])
                .collect(),
            flows: vec![flow("icmp", 4_000 - inlet_lost_count, [0, 0])],
        };
        // 0.1 % of 4 000 frames is 4.
        for (lost_count, expected) in [(4, true), (5, false)] {
            summary.flows = vec![frames(lost_count)];
            let (is_valid, page) = measured(&summary);
            assert_eq!(is_valid, Some(expected), "{page}");
            let words = "a host lost 5 of 4,000 frames (0.125 %, limit 0.10 %) of first/second";
            assert_eq!(
                page.replace(JOINT, " ").contains(words),
                !expected,
                "{page}"
            );
        }
        summary.flows.clear();
        summary.directions.clear();
        let (is_valid, page) = measured(&summary);
        assert_eq!(is_valid, None, "{page}");
        assert!(page.contains("unknown: nothing that ran tells"), "{page}");
        summary.harms = vec![lost_loops(Some(0), 0, 40)];
        let because = Unresolved::HostUnknown;
        assert_eq!(answer(&summary).hurt, Hurt::NotResolvable { because });
    }
}

#[test]
fn unaligned_clocks_are_told_beside_a_valid_measurement() {
    let mut summary = run(lost_loops(Some(0), 0, 40));
    let network = summary.network.as_mut().unwrap();
    network.clocks_differ = true;
    network.clock_bound_s = None;
    let found = answer(&summary);
    assert_eq!(found.measurement.clocks, Clocks::Unaligned);
    count_all(&mut summary);
    let counted = answer(&summary);
    assert_eq!(
        (counted.hurt.clone(), counted.tone()),
        (Hurt::No, Tone::Caution)
    );
    assert_eq!(found.measurement.is_valid, Some(true));
    let page = brief(&summary, 100, Style::Plain);
    let page = page.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(
        page.contains("one-way delays and the order of events are unavailable"),
        "{page}"
    );
}

#[test]
fn a_robot_of_which_nothing_is_known_is_not_called_unhurt() {
    for summary in [
        empty(),
        RunSummary {
            score: vec![ScoreMetric {
                value: None,
                method: "the case gave no score".to_owned(),
                ..full().score[2].clone()
            }],
            harms: vec![lost_loops(None, 0, 0)],
            ..empty()
        },
    ] {
        for page in [
            brief(&summary, 100, Style::Plain),
            render(&summary, 100, Style::Plain),
            page_text(&summary),
        ] {
            let page = page.to_lowercase();
            assert!(!page.contains("no incident"), "{page}");
            assert!(!page.contains("0 incidents"), "{page}");
            assert!(
                page.contains("unavailable: the case gave no score"),
                "{page}"
            );
        }
    }
}

#[test]
fn losses_that_only_missing_records_tell_are_unknown_and_not_none() {
    let of = |change: &dyn Fn(&mut ChannelAccount)| {
        let mut summary = run(lost_loops(Some(0), 0, 40));
        for channel in &mut summary.channels {
            channel.account.iter_mut().for_each(change);
        }
        let page = brief(&summary, 100, Style::Plain);
        let words = page.split_whitespace().collect::<Vec<_>>().join(" ");
        let sections = crate::sections::of_run(&summary, &Assessment::of(&summary));
        let metrics = sections.iter().flat_map(hil_present::Section::metrics);
        let lost = metrics.filter(|(_, one)| one.name == "lost");
        let lost: Vec<_> = lost.map(|(_, one)| one.value).collect();
        (words, lost)
    };
    let peers = |account: &mut ChannelAccount| {
        account.fates = FateCounts::default();
        let fate = MessageFate::UnknownPeerRecordsUnavailable;
        account.fates.add(fate, account.published_count);
    };
    let producers = |account: &mut ChannelAccount| account.published_unrecorded_count = None;
    for (page, lost) in [of(&peers), of(&producers)] {
        assert!(page.contains("how many were lost is unknown"), "{page}");
        assert!(page.contains("unknown of 5,000"), "{page}");
        for words in ["none lost", "0 of 5,000", "% lost"] {
            assert!(!page.contains(words), "{words}: {page}");
        }
        assert_eq!(lost, [None; 3], "{page}");
    }
}

#[test]
fn the_printed_report_reads_as_checked_in() {
    let hurt = run(lost_loops(Some(2), 0, 40));
    for (summary, width, file, expected) in [
        (
            hurt,
            100,
            "brief_100.txt",
            include_str!("../testdata/brief_100.txt"),
        ),
        (
            awkward(),
            80,
            "brief_awkward_80.txt",
            include_str!("../testdata/brief_awkward_80.txt"),
        ),
        (
            empty(),
            80,
            "brief_empty_80.txt",
            include_str!("../testdata/brief_empty_80.txt"),
        ),
    ] {
        check_golden(&brief(&summary, width, Style::Plain), file, expected);
    }
}

#[test]
fn answer_cause_and_validity_stand_in_twelve_lines() {
    let summary = run(lost_loops(Some(2), 0, 40));
    let page = brief(&summary, 100, Style::Plain);
    let (_, block) = page.rsplit_once("\u{2500}\n").unwrap();
    assert!(block.lines().count() <= 12, "{block}");
    let block = block.split_whitespace().collect::<Vec<_>>().join(" ");
    for words in [
        "Did the network hurt the robot? YES",
        "measurement valid as far as known: what 1 killed",
        "gravest harm at 4.921 s: robots 3 and 5",
        "network before it outage of 800 ms on fleet/authority",
        "after one was due (every",
        "(hand movements out and back",
    ] {
        assert!(block.contains(words), "{words}:\n{block}");
    }
    // What comes many at once is due at no interval.
    let mut summary = run(lost_loops(Some(2), 0, 40));
    for account in summary
        .channels
        .iter_mut()
        .filter_map(|one| one.account.as_mut())
    {
        account.gaps.between_taken = Distribution::of_samples(&[700, 700, 700, 30_000_000], "");
    }
    let page = brief(&summary, 100, Style::Plain);
    let page = page.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(page.contains("after one was due, on"), "{page}");
}

#[test]
fn a_demand_that_was_missed_or_not_decided_is_a_line_of_the_answer_and_all_of_it_stands_with_its_channel()
 {
    let words = |text: String| {
        let text = text.replace(JOINT, " ");
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let told = |availability: f64| {
        let mut summary = run(lost_loops(Some(2), 0, 40));
        summary.channels[0].demand = Some(demand(availability));
        let read = RunSummary::from_json(&summary.to_json().unwrap()).unwrap();
        assert_eq!(read, summary);
        let page = words(brief(&summary, 100, Style::Plain));
        (
            page,
            words(render(&summary, 100, Style::Plain)),
            words(page_text(&summary)),
        )
    };
    let missed =
        "arm/command MISSED: available 96.26 %, 99.99 % asked for; 1 failure, longest 747 ms";
    let (page, full, html) = told(0.9999);
    assert!(page.contains(missed), "{page}");
    for text in [full, html] {
        for part in [
            "MISSED: available 96.26 %",
            "in time within 1.00 ms, survival time 12.0 ms, a message every 4.00 ms",
            "TS 22.261; 4,803 of 5,000, 197 lost, 193 of these by a host",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
    let (page, full, _) = told(0.5);
    assert!(!page.contains("demand"), "{page}");
    assert!(
        full.contains("met: available 96.26 %, 50.00 % asked for"),
        "{full}"
    );
}

#[test]
fn the_printed_report_is_a_page_and_ends_in_the_answer() {
    let mut many = run(lost_loops(Some(2), 0, 40));
    let channel = many.channels[0].clone();
    for index in 0..400 {
        let mut one = channel.clone();
        one.name = format!("robot-{}/part-{index}/state", index % 20);
        one.link = link("udp");
        many.channels.push(one);
    }
    many.run.links = (0..5)
        .map(|index| Fact::new(format!("hop-{index}"), "5 ms delay, ".repeat(20)))
        .collect();
    many.run.folder = format!("/{}run", "a-long-folder-name/".repeat(12));
    many.harms = (0..20)
        .map(|index| HarmCount {
            what: format!("answers {index} late or missing"),
            ..lost_loops(Some(index % 2), 0, 40)
        })
        .collect();
    many.warnings = (0..50).map(|index| format!("warning {index}")).collect();
    let mut deep = run(lost_loops(Some(2), 0, 40));
    deep.run.folder = format!("/{}run", "a-long-folder-name/".repeat(80));
    for summary in [many, deep, full(), awkward(), empty()] {
        for width in [80, 100, 120] {
            let page = brief(&summary, width, Style::Plain);
            // A terminal breaks what is longer.
            let rows = page
                .lines()
                .map(|line| line.chars().count().max(1).div_ceil(width));
            let count: usize = rows.sum();
            assert!(count <= 50, "{count} lines:\n{page}");
            // A command to copy is not broken.
            let is_command = |line: &&str| line.contains("hil-runtime ");
            for line in page.lines().filter(|line| !is_command(line)) {
                assert!(line.chars().count() <= width, "beyond {width}: {line}");
            }
            // Nothing stands below the answer.
            let (_, end) = page.rsplit_once("\u{2500}\n").unwrap();
            let question = end.lines().next().unwrap();
            assert!(question.contains(" hurt the robot?"), "{page}");
        }
    }
}

#[test]
fn the_answer_is_in_the_summary_for_programs() {
    let text = run(lost_loops(Some(2), 0, 40)).to_json().unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(json["answer"]["state"], "yes");
    assert_eq!(json["answer"]["subject"], "network");
    assert_eq!(json["answer"]["measurement"]["is_valid"], true);
    assert_eq!(json["answer"]["sample"]["occasions"]["count"], 40);
}
