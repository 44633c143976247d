//! The score of constructed logs and of short runs in virtual time.

mod foreign;

use core::time::Duration;
use std::collections::BTreeMap;

use bytemuck::Zeroable;

use super::*;
use crate::{
    EGM_EVENT, EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, SendPolicy, TeleoperationParameters,
};
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EndCause, SessionState, Side};
use hil_arm::yumi::arm::RIGHT_START_RAD;
use hil_core::case_study::CaseStudy;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::message::{Envelope, Message};
use hil_core::score::Severity;
use hil_core::simulation::{Carrier, Simulation};
use hil_core::time::Instant;

fn case(change: impl FnOnce(&mut TeleoperationParameters)) -> Teleoperation {
    let mut parameters = TeleoperationParameters {
        motion_start_s: 0.0,
        ..TeleoperationParameters::default()
    };
    change(&mut parameters);
    Teleoperation::new(parameters, 3).unwrap()
}

/// Loses, or holds until the end, everything offered in a stretch of time.
#[derive(Debug, Clone, Copy)]
struct Silence {
    from_s: f64,
    until_s: f64,
    is_buffered: bool,
}

fn at_s(seconds: f64) -> Instant {
    Instant::ZERO + Duration::from_secs_f64(seconds)
}

impl LinkModel for Silence {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        if now < at_s(self.from_s) || now >= at_s(self.until_s) {
            Fate::Delivered(now)
        } else if self.is_buffered {
            Fate::Delivered(at_s(self.until_s))
        } else {
            Fate::Lost
        }
    }
}

fn run(case: &Teleoperation, silence: Option<Silence>, duration_s: f64) -> RunLog {
    let carriers: BTreeMap<String, Box<dyn Carrier>> = silence
        .map(|silence| {
            let carrier: Box<dyn Carrier> = Box::new(silence);
            (EGM_RIGHT_COMMAND.to_owned(), carrier)
        })
        .into_iter()
        .collect();
    let simulation = Simulation::new(case, carriers).unwrap();
    simulation
        .run(Duration::from_secs_f64(duration_s))
        .unwrap()
        .log
}

fn value(score: &Score, name: &str) -> f64 {
    let metric = score
        .get(name)
        .unwrap_or_else(|| panic!("no metric {name}"));
    metric.value.unwrap_or_else(|| panic!("{metric:?}"))
}

fn silence(from_s: f64, until_s: f64) -> Silence {
    Silence {
        from_s,
        until_s,
        is_buffered: false,
    }
}

const PERIOD_S: f64 = 4.033;

#[test]
fn an_empty_log_gives_no_figure_but_a_reason_for_each() {
    let case = case(|_| {});
    let score = case.score(&RunLog::default());
    assert_eq!(score.metrics.len(), 38);
    for metric in &score.metrics {
        assert_eq!(metric.value, None, "{metric:?}");
        assert_eq!(metric.interval, None, "{metric:?}");
        assert!(!metric.method.is_empty());
    }
    assert_eq!(score.events, []);
    assert_eq!(case.series(&RunLog::default()), []);
}

#[test]
fn a_perfect_channel_loses_nothing_and_adds_no_error() {
    let case = case(|_| {});
    let score = case.score(&run(&case, None, 6.0 * PERIOD_S));
    for name in [
        "motion_loss_ratio",
        "egm_trip_count",
        "hold_count",
        "hold_time_ratio",
        "joint_error_network_rad_rms",
        "joint_error_network_rad_max",
        "loops_extra_count",
        "ik_failure_count",
        "ik_limited_count",
    ] {
        assert!(value(&score, name).abs() < 1e-12, "{name}");
    }
    let total = value(&score, "joint_error_rad_rms");
    let controller = value(&score, "joint_error_controller_rad_rms");
    assert!((total - controller).abs() < 1e-12, "{total} {controller}");
    assert!((value(&score, "egm_session_count") - 1.0).abs() < 0.1);
    // A command every second cycle: its age is one or two cycles when feedback tells it.
    assert!((0.0..=12.0).contains(&value(&score, "reference_age_ms_max")));
    assert!(value(&score, "reference_age_ms_per_s").abs() < 0.05);
    let names: Vec<_> = score.metrics.iter().map(|metric| metric.name).collect();
    for (index, name) in names.iter().enumerate() {
        assert!(!names[..index].contains(name), "{name} twice");
    }
}

#[test]
fn a_loop_lost_to_a_time_out_is_told_with_its_cause_and_the_commands_that_were_lost() {
    let case = case(|_| {});
    let log = run(&case, Some(silence(12.0, 14.5)), 8.0 * PERIOD_S);
    let score = case.score(&log);
    assert!((value(&score, "egm_trip_count") - 1.0).abs() < 0.1);
    assert!((value(&score, "loops_lost_by_trip_count") - 1.0).abs() < 0.1);
    assert!((value(&score, "reactivation_s_max") - 2.0).abs() < 0.01);
    assert!(value(&score, "joint_error_network_rad_rms") > 0.01);
    let lost: Vec<_> = score
        .events
        .iter()
        .filter(|event| event.severity == Severity::Incident)
        .collect();
    assert_eq!(lost.len(), 1);
    assert!(
        lost[0].what.contains("ended by CommTimeout"),
        "{}",
        lost[0].what
    );
    assert_eq!(lost[0].messages.len(), 16);
    // The first of them was the first to be lost.
    let mut first = log.raw(EGM_RIGHT_COMMAND).iter();
    let first = first.find(|logged| Instant::from_ns(logged.envelope.published_ns) >= at_s(12.0));
    assert_eq!(
        lost[0].messages[0].sequence,
        first.unwrap().envelope.sequence
    );
    let ended = score
        .events
        .iter()
        .find(|event| event.what.contains("CommTimeout ="));
    let ended = ended.unwrap();
    assert_eq!(ended.severity, Severity::Hazard);
    assert_eq!(ended.messages[0], lost[0].messages[0]);
    assert!(score.events.is_sorted_by_key(|event| event.at));

    let series = case.series(&log);
    let loops = series
        .iter()
        .find(|one| one.name == "motion-loops")
        .unwrap();
    let missing: Vec<_> = loops.rows().filter(|row| row[3] > 0.5).collect();
    assert_eq!(missing.len(), 1);
    assert!(missing[0][2].is_nan());
    assert!((missing[0][4] - 1.0).abs() < 1e-12);
    let number = format!("motion loop {} of", missing[0][0]);
    assert!(lost[0].what.starts_with(&number), "{number}");
    let answered: Vec<_> = loops.rows().filter(|row| row[3] < 0.5).collect();
    assert!(
        answered
            .iter()
            .all(|row| row[2] > row[1] && row[4].abs() < 1e-12)
    );
    assert!(answered.len() >= 6);
}

#[test]
fn a_loop_lost_in_a_hold_is_told_as_held() {
    let case = case(|parameters| {
        parameters.egm.comm_timeout_s = Some(60.0);
    });
    let log = run(&case, Some(silence(12.0, 12.0 + PERIOD_S)), 8.0 * PERIOD_S);
    let score = case.score(&log);
    assert!(value(&score, "egm_trip_count").abs() < 0.1);
    assert!((value(&score, "hold_count") - 1.0).abs() < 0.1);
    assert!((value(&score, "loops_lost_by_hold_count") - 1.0).abs() < 0.1);
    let incident = score
        .events
        .iter()
        .find(|event| event.severity == Severity::Incident);
    assert!(incident.unwrap().what.contains("held through"));
    assert_eq!(incident.unwrap().messages.len(), 16);
}

#[test]
fn a_buffered_second_makes_the_reference_older_for_good() {
    let case = case(|parameters| {
        parameters.send = SendPolicy::Coupled;
        parameters.egm.comm_timeout_s = Some(60.0);
    });
    let buffered = Silence {
        from_s: 8.0,
        until_s: 9.0,
        is_buffered: true,
    };
    let log = run(&case, Some(buffered), 30.0);
    let score = case.score(&log);
    let median_ms = value(&score, "reference_age_ms_p50");
    // A second of commands stands in the queue, and one comes for each that is taken.
    assert!((median_ms - 1000.0).abs() < 20.0, "{median_ms}");
}

#[test]
fn two_clocks_withdraw_error_and_lag_but_not_the_loops() {
    let case = case(|_| {});
    let whole = run(&case, Some(silence(12.0, 14.5)), 8.0 * PERIOD_S);
    let mut log = RunLog::default();
    for (channel, offset_ns) in [
        (EGM_RIGHT_COMMAND, 0),
        (EGM_RIGHT_FEEDBACK, 77_000_000_000),
        (EGM_EVENT, 77_000_000_000),
    ] {
        for logged in whole.raw(channel) {
            let mut envelope = logged.envelope;
            envelope.published_ns += offset_ns;
            log.push(channel, envelope, &logged.payload);
        }
    }
    log.set_clocks_differ();
    let (exact, apart) = (case.score(&whole), case.score(&log));
    for name in [
        "motion_loops_sent_count",
        "motion_loops_executed_count",
        "loops_lost_by_trip_count",
        "hold_count",
        "egm_trip_count",
    ] {
        assert_eq!(
            apart.get(name).unwrap().value,
            exact.get(name).unwrap().value,
            "{name}"
        );
    }
    for name in [
        "joint_error_rad_rms",
        "joint_error_ratio",
        "joint_error_network_rad_rms",
        "tracking_lag_ms",
    ] {
        assert!(exact.get(name).unwrap().value.is_some(), "{name}");
        assert_eq!(apart.get(name).unwrap().value, None);
        assert!(apart.get(name).unwrap().method.contains("not aligned"));
    }
    // An alignment that is off by 15 us brings them back, and they say so.
    let bound_ns = 15_000;
    let source_of = |channel: &str| Some(channel.to_owned());
    let stamp = |at_ns, bound_ns| {
        Some(hil_core::run_log::ConvertedStamp {
            at_ns,
            bound_ns,
            is_early: false,
        })
    };
    let aligned = log.bring_to_one_clock(source_of, |channel, ns| match channel {
        EGM_RIGHT_COMMAND => stamp(ns + 77_000_000_000 - 15_000, bound_ns),
        _ => stamp(ns, 0),
    });
    assert_eq!(aligned, Ok(()));
    let aligned = case.score(&log);
    for (name, off_max) in [
        ("joint_error_rad_rms", 1e-4),
        ("tracking_lag_ms", 0.015 + 1e-6),
    ] {
        let [told, truth] = [&aligned, &exact].map(|score| value(score, name));
        assert!((told - truth).abs() <= off_max, "{name}: {told}, {truth}");
        let method = &aligned.get(name).unwrap().method;
        assert!(method.contains("aligned within ±15.0 us"), "{method}");
        assert!(!exact.get(name).unwrap().method.contains("aligned"));
    }
    let plots = series(&case, &log);
    let noted = |one: &PlotSeries| one.notes.iter().any(|note| note.contains("within 15.0 us"));
    assert!(plots.iter().any(noted), "{:?}", plots[0].notes);
}

#[test]
fn loops_that_a_coupled_sender_could_not_send_are_lost_all_the_same() {
    // Without feedback a coupled sender has nothing to answer: two and a half loops are never sent.
    let case = case(|parameters| parameters.send = SendPolicy::Coupled);
    let carrier: Box<dyn Carrier> = Box::new(silence(9.0, 19.0));
    let carriers = BTreeMap::from([(EGM_RIGHT_FEEDBACK.to_owned(), carrier)]);
    let simulation = Simulation::new(&case, carriers).unwrap();
    let run = simulation.run(Duration::from_secs_f64(10.0 * PERIOD_S));
    let score = case.score(&run.unwrap().log);
    let sent = score.get("motion_loops_sent_count").unwrap();
    assert!(sent.method.contains("human's hand"), "{sent:?}");
    assert!((value(&score, "motion_loops_sent_count") - 10.0).abs() <= 1.0);
    assert!(value(&score, "motion_loss_ratio") > 0.15);
    let split = score.get("joint_error_network_rad_rms").unwrap();
    assert_eq!(split.value, None);
    assert!(split.method.contains("answer feedback"), "{split:?}");
}

#[test]
fn the_figures_have_their_columns_and_a_row_per_message() {
    let case = case(|_| {});
    let log = run(&case, None, 2.0 * PERIOD_S);
    let series = case.series(&log);
    let names: Vec<_> = series.iter().map(|known| known.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "fig6-input",
            "fig7-9-tool-y",
            "fig10-joints",
            "fig11-joint-error",
            "motion-loops"
        ]
    );
    for known in &series {
        assert_eq!(
            known.values.len() % known.columns.len(),
            0,
            "{}",
            known.name
        );
        let notes = match known.name.as_str() {
            "motion-loops" => 2,
            name => usize::from(name.contains("joint")),
        };
        assert_eq!(known.notes.len(), notes);
    }
    assert_eq!(series[0].rows().count(), log.raw(HUMAN_FRAME).len());
    assert_eq!(series[2].rows().count(), log.raw(EGM_RIGHT_FEEDBACK).len());
    assert!(
        series[1].values[2].is_nan(),
        "no command before guided motion runs"
    );
    let last = series[3].rows().last().unwrap();
    let joints = series[2].rows().last().unwrap();
    for joint in 1..=7 {
        assert!((joints[2 * joint - 1] - joints[2 * joint] - last[joint]).abs() < 1e-12);
    }
}
