//! The bare loop against the whole case, and the table against the published figures.

use core::time::Duration;
use std::collections::BTreeMap;

use super::conditions::{Condition, Expected, LONG_RANGE, SHORT_RANGE, base, changed, conditions};
use super::drive::{Channel, OUTAGE_STREAM, Tally, drive};
use super::study::seed_of;
use super::trajectory::Trajectory;
use super::{Calibration, MotionLossStudy};
use crate::score::loops::{LoopCounter, Loops};
use crate::score::record::Record;
use crate::{EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK, Teleoperation, TeleoperationParameters};
use hil_core::case_study::CaseStudy;
use hil_core::random::RandomStream;
use hil_core::simulation::{Carrier, Simulation};
use hil_core::study::{Cell, Study, StudyRefusal, Verdict, into_batch};
use hil_core::time::Instant;
use hil_link::outages::{OutageLink, Outages};
use hil_link::wifi::WifiPreset;

fn case(change: impl FnOnce(&mut TeleoperationParameters)) -> Teleoperation {
    let mut parameters = TeleoperationParameters::default();
    change(&mut parameters);
    Teleoperation::new(parameters, 5).unwrap()
}

/// Loops of the whole case under `outages`, as long as `trajectory`.
fn simulated(case: &Teleoperation, outages: Outages, seed: u64, end: Instant) -> (Loops, f64) {
    let carrier = || {
        let stream = RandomStream::new(seed, OUTAGE_STREAM);
        Box::new(OutageLink::new(outages, stream, Instant::ZERO).unwrap()) as Box<dyn Carrier>
    };
    let carriers: BTreeMap<_, _> = [EGM_RIGHT_COMMAND, EGM_RIGHT_FEEDBACK]
        .into_iter()
        .map(|channel| (channel.to_owned(), carrier()))
        .collect();
    let simulation = Simulation::new(case, carriers).unwrap();
    let duration = Duration::from_nanos(end.as_ns().unsigned_abs());
    let log = simulation.run(duration).unwrap().log;
    let record = Record::read(&log);
    let counter = LoopCounter::new(
        case.nominal_peak_to_peak_m(),
        case.parameters.motion_period_s,
    );
    // The bare loop looks at every fourth cycle: of two loops that merge, which one is lost hangs
    // on less than a micrometre.
    let mut moved = record.moved_y();
    moved.retain(|(at, _)| at % 16_000_000 == 0);
    let loops = counter.count(&record.sent_y(), &moved).unwrap();
    let score = case.score(&log);
    let figure = |name| score.get(name).unwrap().value.unwrap();
    let executed = figure("motion_loops_executed_count");
    assert!((executed - loops.executed_count as f64).abs() < 0.5);
    (loops, figure("egm_trip_count"))
}

#[test]
fn the_bare_loop_loses_the_loops_that_the_whole_case_loses() {
    let case = case(|_| {});
    let trajectory = Trajectory::new(&case, 40).unwrap();
    // An outage a minute, as long as the time-out on average.
    let outages = Outages {
        mean_s: 1.0,
        per_hour: 200.0,
        buffered: false,
    };
    let setup = changed(&base(&case), |setup| {
        setup.channel = Channel::Outages(outages);
    });
    let mut lost_count = 0;
    for seed in [1, 2] {
        let bare = drive(&trajectory, &setup, seed, &mut |_| true).unwrap();
        let (loops, trips) = simulated(&case, outages, seed, trajectory.end);
        let lost: Vec<_> = loops.lost.iter().map(|lost| lost.index).collect();
        assert_eq!(bare.lost, lost, "seed {seed}");
        assert_eq!(bare.sent_count, loops.sent_count() as u64);
        assert_eq!(bare.executed_count, loops.executed_count as u64);
        assert!(
            (trips - bare.trip_count as f64).abs() < 0.5,
            "{trips} {bare:?}"
        );
        lost_count += lost.len();
    }
    assert!(lost_count > 0, "the comparison needs lost loops");
}

fn study(change: impl FnOnce(&mut TeleoperationParameters)) -> MotionLossStudy {
    MotionLossStudy::new(&case(change), Vec::new()).unwrap()
}

#[test]
fn independent_losses_of_up_to_a_half_lose_none_of_890_loops() {
    let study = study(|parameters| {
        parameters.tables.seeds = 1;
        parameters.tables.conditions = ["perfect", "loss-0.01", "loss-0.5"]
            .map(str::to_owned)
            .into();
    });
    let outcomes: Vec<_> = (0..study.task_count())
        .map(|task| study.run(task, &mut |_| true).unwrap())
        .collect();
    for outcome in &outcomes {
        assert_eq!((outcome.sent_count, outcome.executed_count), (890, 890));
        assert_eq!(outcome.lost, []);
    }
    let outcomes: Vec<_> = outcomes.iter().map(Some).collect();
    let report = study.report(&outcomes);
    assert_eq!(report.criteria.len(), 3);
    assert!(report.criteria.iter().all(|c| c.is_met == Some(true)));
    let outcomes = vec![None; study.task_count()];
    assert!(
        study
            .report(&outcomes)
            .criteria
            .iter()
            .all(|c| c.is_met.is_none())
    );
}

#[test]
fn each_row_of_all_conditions_has_a_cell_a_column() {
    let study = study(|parameters| {
        parameters.tables.seeds = 1;
        parameters.tables.loops = 5;
    });
    // One run stands for all.
    let outcome = study.run(0, &mut |_| true).unwrap();
    let report = study.report(&vec![Some(&outcome); study.task_count()]);
    assert_eq!(report.tables.len(), 3);
    let verdict = |row: usize| report.tables[0].rows[row].last();
    assert_eq!(
        verdict(0),
        Some(&Cell::Verdict(Verdict::Inconclusive)),
        "five loops"
    );
    assert_eq!(verdict(1), Some(&Cell::Verdict(Verdict::NotComparable)));
    assert_eq!(verdict(5), Some(&Cell::Verdict(Verdict::Fitted)));
    assert_eq!(
        report.larger[0].parameters,
        ["tables.loops=890", "tables.seeds=12"]
    );
    for table in &report.tables {
        for row in &table.rows {
            assert_eq!(row.len(), table.columns.len(), "{}", table.name);
        }
    }
}

#[test]
fn the_outages_of_both_ranges_reproduce_the_published_rates() {
    // A sixth of the loops with six times the seeds has the same mean; `hil-runtime tables`
    // plays the published 890.
    let case = case(|_| {});
    let trajectory = Trajectory::new(&case, 148).unwrap();
    let mean = |channel| {
        let setup = changed(&base(&case), |setup| setup.channel = channel);
        let runs = (0..36).map(|replica| {
            let run = drive(&trajectory, &setup, seed_of(5, replica), &mut |_| true);
            run.unwrap().loss_ratio()
        });
        runs.sum::<f64>() / 36.0
    };
    for channel in [
        Channel::Outages(SHORT_RANGE),
        Channel::Wifi(WifiPreset::ShortRange),
    ] {
        let short = mean(channel);
        assert!((0.005..0.012).contains(&short), "{channel:?}: {short}");
    }
    for channel in [
        Channel::Outages(LONG_RANGE),
        Channel::Wifi(WifiPreset::LongRange),
    ] {
        let long = mean(channel);
        assert!((0.020..0.037).contains(&long), "{channel:?}: {long}");
    }
}

#[test]
fn a_study_names_its_conditions_and_refuses_a_filter_without_any() {
    let named = study(|parameters| {
        parameters.tables.loops = 5;
        parameters.tables.conditions = vec!["range".to_owned()];
    });
    assert_eq!(named.task_count(), 48);
    assert_eq!(named.label(0), "short-range");
    assert_eq!(named.label(23), "long-range");
    assert_eq!(named.label(47), "wifi6-long-range");
    let unknown = case(|parameters| {
        parameters.tables.conditions = vec!["loss".to_owned(), "short range".to_owned()];
    });
    let error = MotionLossStudy::new(&unknown, Vec::new()).unwrap_err();
    let StudyRefusal::Parameter(error) = error else {
        panic!("{error}");
    };
    assert_eq!(error.key, "tables.conditions");
    for said in [
        "\"short range\"",
        "perfect, loss-0.01",
        "short-range",
        "gain-5",
    ] {
        assert!(error.problem.contains(said), "{error}");
    }
}

#[test]
fn names_of_conditions_are_unique_and_the_published_ones_are_judged() {
    let rows = conditions(&base(&case(|_| {})));
    for (index, row) in rows.iter().enumerate() {
        assert!(rows[..index].iter().all(|known| known.name != row.name));
    }
    let is_published = |expected: &Expected| matches!(expected, Expected::Published { .. });
    assert_eq!(
        rows.iter()
            .filter(|row| is_published(&row.expected))
            .count(),
        4
    );
}

#[test]
fn equal_seeds_give_equal_runs_and_unequal_seeds_do_not() {
    let case = case(|_| {});
    let trajectory = Trajectory::new(&case, 30).unwrap();
    let setup = changed(&base(&case), |setup| {
        setup.channel = Channel::Outages(Outages {
            per_hour: 1000.0,
            ..SHORT_RANGE
        });
    });
    let run = |seed| -> Tally { drive(&trajectory, &setup, seed, &mut |_| true).unwrap() };
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
    assert_eq!(drive(&trajectory, &setup, 1, &mut |done| done < 0.5), None);
}

#[test]
fn a_calibration_finds_the_rate_it_is_asked_for_and_says_where_there_is_none() {
    let case = case(|parameters| parameters.tables.loops = 60);
    let batch = into_batch(Calibration::new(&case, 0.03).unwrap());
    // Back after 3 s from outages of 1 s, and pure hold through outages of 0.3 s.
    let tasks = [10, 12];
    let mut outcomes: Vec<_> = (0..batch.task_count()).map(|_| None).collect();
    for task in tasks {
        outcomes[task] = batch.run(task, &mut |_| true);
    }
    let report = batch.report(&outcomes);
    let rows = &report.tables[0].rows;
    let number = |cell: &Cell| match cell {
        Cell::Number { value, .. } => Some(*value),
        _ => None,
    };
    let rate = number(&rows[10][2]).unwrap();
    assert!((20.0..200.0).contains(&rate), "{rate}");
    assert!(number(&rows[12][2]).is_none_or(|rate| rate > 1000.0));
    assert_eq!(rows[0][7], Cell::text("not computed"));
    // Columns 5 and 7: the nearest try's ratio, and the remark that it is far.
    let is_far = (number(&rows[10][5]).unwrap() - 0.03).abs() > 0.01;
    let remark = if is_far { "interpolated" } else { "" };
    assert!(matches!(&rows[10][7], Cell::Text(text) if text.starts_with(remark)));
    assert_eq!(Calibration::new(&case, 0.0).unwrap_err().key, "mlr");
    assert!(case.calibration("mlr", 0.01).unwrap().is_some());
    assert!(case.calibration("age", 0.01).unwrap().is_none());
}

/// Recorded before the drivers of fleet, teleoperation and the generic one became one.
#[test]
fn conditions_of_the_table_keep_their_figures_to_the_bit() {
    let study = study(|parameters| {
        parameters.tables.loops = 60;
        parameters.tables.seeds = 1;
    });
    for expected in PINNED {
        let wanted = |condition: &&Condition| condition.name == expected.condition;
        let condition = study.conditions.iter().find(wanted).unwrap();
        let tally = drive(&study.trajectory, &condition.setup, 11, &mut |_| true).unwrap();
        let found = Pinned {
            condition: expected.condition,
            executed_count: tally.executed_count,
            trip_count: tally.trip_count,
            lost: &tally.lost,
            hold_ratio_bits: tally.hold_ratio.to_bits(),
        };
        assert_eq!(found, expected);
    }
}

/// Figures of one run under a condition.
#[derive(Debug, PartialEq, Eq)]
struct Pinned<'a> {
    condition: &'static str,
    executed_count: u64,
    trip_count: u64,
    lost: &'a [usize],
    hold_ratio_bits: u64,
}

const PINNED: [Pinned<'_>; 6] = [
    Pinned {
        condition: "loss-0.5",
        executed_count: 60,
        trip_count: 0,
        lost: &[],
        hold_ratio_bits: 4_582_575_524_660_966_996,
    },
    Pinned {
        condition: "long-range",
        executed_count: 60,
        trip_count: 1,
        lost: &[],
        hold_ratio_bits: 4_585_742_259_267_998_290,
    },
    Pinned {
        condition: "wifi6-long-range",
        executed_count: 59,
        trip_count: 3,
        lost: &[20],
        hold_ratio_bits: 4_585_484_288_380_158_818,
    },
    Pinned {
        condition: "buffered-coupled-fifo1",
        executed_count: 60,
        trip_count: 0,
        lost: &[],
        hold_ratio_bits: 4_566_995_390_719_744_408,
    },
    Pinned {
        condition: "cycle-4032-free-250",
        executed_count: 60,
        trip_count: 0,
        lost: &[],
        hold_ratio_bits: 0,
    },
    Pinned {
        condition: "external-trigger",
        executed_count: 60,
        trip_count: 0,
        lost: &[],
        hold_ratio_bits: 4_572_824_880_087_506_456,
    },
];
