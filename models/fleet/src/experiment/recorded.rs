//! Recorded runs of a fleet as rows of Tables II and III: which run is a row of which table, and what it counted.

use crate::case::FleetParameters;
use crate::experiment::cells::{Condition, PublishedRow, SCENARIOS, hil_setup, published_rows};
use crate::experiment::costs::Costs;
use crate::experiment::driver::Setup;
use crate::referee::Tally;
use crate::scenario::{Scenario, WorldParameters};
use crate::score::{COLLISION_RATIO, COLLISIONS, CRITICAL_SECTIONS, OUTSIDE, OVERLAPS};
use hil_core::options::{Difference, differences};
use hil_core::recorded_run::{Doubt, RecordedRun};
use hil_core::study::StudyRefusal;
use hil_stats::comparison::Share;
use hil_stats::recorded::{PooledShare, RecordedRow, RunShare};

/// A row of recorded runs.
#[derive(Debug)]
pub(crate) struct FleetRow {
    /// Whose table it is a row of.
    pub(crate) scenario: Scenario,
    /// Its runs.
    pub(crate) row: RecordedRow<FleetParameters>,
    /// What the referee of all its runs counted: sections and collisions.
    pub(crate) tally: Tally,
    /// The same in virtual time over the traces of its runs.
    pub(crate) replay: Option<Box<Self>>,
    /// Near misses, stops and time lost; `None` where the score of a run does not tell.
    pub(crate) costs: Option<Costs>,
    collided: Vec<RunShare>,
}

impl FleetRow {
    /// The rows of `recorded`, beside a table whose cells start from `base`.
    ///
    /// # Errors
    /// Names the run that has no table, or counted no critical sections.
    pub(crate) fn of_runs(
        mut recorded: Vec<RecordedRun<FleetParameters>>,
        base: &Setup,
    ) -> Result<Vec<Self>, StudyRefusal> {
        for run in &mut recorded {
            let scenario = run.parameters.world.scenario;
            if !SCENARIOS.contains(&scenario) {
                let [harbor, warehouse] = SCENARIOS;
                let problem = format!(
                    "its world.scenario {scenario} has no table; {harbor} and {warehouse} have one"
                );
                return Err(run.refused(problem));
            }
            let different = different(&run.parameters, expected(&run.parameters, base));
            if !different.is_empty() {
                run.doubts.push(Doubt::OtherParameters(different));
            }
        }
        let are_alike = |one: &FleetParameters, other: &FleetParameters| {
            let wanted = FleetParameters {
                fleets: one.fleets,
                tables: one.tables.clone(),
                ..other.clone()
            };
            different(one, wanted).is_empty()
        };
        let rows = RecordedRow::of_runs(recorded, are_alike).into_iter();
        rows.map(Self::of).collect()
    }

    fn of(row: RecordedRow<FleetParameters>) -> Result<Self, StudyRefusal> {
        let mut tally = Tally::default();
        let mut costs = Some(Costs::default());
        let collided = row.shares(|run| {
            let share = Share {
                count: run.count(COLLISIONS.name)?,
                of: run.count(CRITICAL_SECTIONS.name)?,
            };
            if share.of == 0 && !row.is_replay() {
                return Err(run.refused("no robot passed a critical section"));
            }
            Ok(RunShare {
                share,
                interval: run.interval(COLLISION_RATIO.name),
            })
        })?;
        for one in &collided {
            tally.section_collisions_count += one.share.count;
            tally.sections_passed_count += one.share.of;
        }
        for run in row.runs() {
            tally.overlaps_count += run.count(OVERLAPS.name)?;
            tally.outside_count += run.count(OUTSIDE.name)?;
            costs = costs.zip(Costs::of_run(run)).map(|(sum, one)| sum + one);
        }
        let replay = row.replayed().map(Self::of).transpose()?;
        Ok(Self {
            scenario: row.first().parameters.world.scenario,
            row,
            tally,
            replay: replay.map(Box::new),
            costs,
            collided,
        })
    }

    /// Collisions per critical section; without a collision as if they scattered by `of_none`.
    pub(crate) fn pooled(&self, of_none: f64) -> PooledShare {
        PooledShare::of(&self.collided, Some(of_none))
    }

    /// The paper's row for the same network.
    pub(crate) fn published(&self) -> Option<&'static PublishedRow> {
        let network = self.row.first().network.filter(|_| !self.row.is_replay())?;
        let mut rows = published_rows(self.scenario).iter();
        rows.find(|row| row.condition == Condition::HardwareInTheLoop(network))
    }
}

/// What the parameters of a run must be for a row beside the paper's: the published world and missions, robot and coordinator as
/// in the table's rows over a radio. The table is that of the run's scenario; how many fleets share the channels is free.
fn expected(run: &FleetParameters, base: &Setup) -> FleetParameters {
    let setup = hil_setup(base);
    let published = FleetParameters::default();
    FleetParameters {
        world: WorldParameters {
            scenario: run.world.scenario,
            ..published.world
        },
        robot: setup.robot,
        coordinator: setup.coordinator,
        missions: published.missions,
        fleets: run.fleets,
        tables: run.tables.clone(),
    }
}

fn different(found: &FleetParameters, mut wanted: FleetParameters) -> Vec<Difference> {
    differences(&mut found.clone(), &mut wanted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coordinator::parameters::CoordinatorMode;
    use crate::experiment::FleetStudy;
    use crate::robot::TrackerKind;
    use crate::score::{
        MISSION_DELAY, MISSIONS, MISSIONS_BEGUN, NEAR_MISSES, RESETS, RUN_LENGTH, STOPS,
    };
    use hil_core::interval::{Interval, IntervalMethod, Spread};
    use hil_core::recorded_run::{
        DelayBin, LinkOrigin, PublishedNetwork, RecordedCrossing, RecordedLink, RecordedMetric,
        SkippedTicks,
    };
    use hil_core::study::{Cell, Study, StudyReport, Verdict};
    use hil_stats::metric::Label;
    use std::collections::BTreeMap;

    /// A run of so many collisions, true overlaps, overlaps outside every section, and critical sections.
    fn run(
        folder: &str,
        network: Option<PublishedNetwork>,
        scenario: Scenario,
        counts: [u32; 4],
    ) -> RecordedRun<FleetParameters> {
        let mut parameters = FleetParameters::default();
        parameters.world.scenario = scenario;
        parameters.robot.tracker = TrackerKind::LegacyRk4;
        parameters.fleets = 4;
        let names = [COLLISIONS, OVERLAPS, OUTSIDE, CRITICAL_SECTIONS];
        let score = names.iter().zip(counts).map(|(label, count)| {
            let metric = RecordedMetric {
                value: Some(f64::from(count)),
                interval: None,
            };
            (label.name.to_owned(), metric)
        });
        RecordedRun {
            folder: folder.to_owned(),
            name: "fleet-split".to_owned(),
            network,
            row: None,
            link: RecordedLink {
                origin: LinkOrigin::Real,
                about: "UDP".to_owned(),
            },
            seed: 1,
            parameters,
            crossing: RecordedCrossing {
                offered_count: 8_000,
                lost_count: Ok(20),
                delays: Ok(vec![DelayBin {
                    above_ns: 1_000_000,
                    until_ns: 2_000_000,
                    count: 7_980,
                }]),
            },
            score: score.collect(),
            skipped: SkippedTicks::default(),
            probed: None,
            replays: Ok(Vec::new()),
            doubts: Vec::new(),
        }
    }

    fn with_interval(
        mut run: RecordedRun<FleetParameters>,
        ends: [f64; 2],
    ) -> RecordedRun<FleetParameters> {
        let interval = Interval::new(ends[0], ends[1], IntervalMethod::EffectiveShare);
        let metric = RecordedMetric {
            value: None,
            interval: Some(Spread::Known(interval)),
        };
        run.score.insert(COLLISION_RATIO.name.to_owned(), metric);
        run
    }

    /// The report beside cells of which none was run.
    fn report(recorded: Vec<RecordedRun<FleetParameters>>) -> Result<StudyReport, StudyRefusal> {
        let mut parameters = FleetParameters::default();
        parameters.tables.cells = vec!["warehouse, loss 0, 0 ms".to_owned()];
        let study = FleetStudy::new(&parameters, 1, recorded)?;
        Ok(study.report(&vec![None; study.task_count()]))
    }

    fn number(value: f64, decimals: usize) -> Cell {
        Cell::number(Some(value), decimals)
    }

    #[test]
    fn without_runs_the_tables_are_those_of_virtual_time() {
        let report = report(Vec::new()).unwrap();
        let names: Vec<_> = report.tables.iter().map(|one| one.name.as_str()).collect();
        assert_eq!(
            names,
            ["table-2-harbor", "table-3-warehouse", "motion", "costs"]
        );
        let [harbor, ..] = report.tables.as_slice() else {
            panic!("{report:?}");
        };
        let columns: Vec<_> = harbor.columns.iter().map(|column| column.label).collect();
        let expected = [
            "Method",
            "PLR",
            "Delay ms",
            "Copies",
            "CS",
            "Collisions",
            "Per 1000",
            "95 %",
            "Paper: CS",
            "Paper: coll.",
            "Paper",
            "Paper: 95 %",
            "Verdict",
            "Accepted if",
        ];
        assert_eq!(columns, expected);
        assert_eq!((harbor.rows.len(), harbor.notes.len()), (11, 2));
    }

    #[test]
    fn a_labelled_run_is_a_row_below_the_papers_and_is_held_against_it() {
        // 24 of 12 000 are 2 per 1000. The interval is that of 8496 trials, so that the published 0 of 10 819 reach
        // 0.48 per 1000: the difference is at least 2 - hypot(2 - 1.2, 0.48) = 1.07.
        let ethernet = Some(PublishedNetwork::Ethernet);
        let one = run("runs/eth-1", ethernet, Scenario::Harbor, [24, 7, 1, 12_000]);
        let one = with_interval(one, [0.001_2, 0.003_1]);
        let report = report(vec![one]).unwrap();
        let [harbor, warehouse, ..] = report.tables.as_slice() else {
            panic!("{report:?}");
        };
        assert_eq!((harbor.rows.len(), warehouse.rows.len()), (12, 11));
        for row in &harbor.rows {
            assert_eq!(row.len(), harbor.columns.len());
        }
        assert_eq!(harbor.columns[P99].name, "delay_ms_p99");
        assert_eq!(harbor.rows[8][0], Cell::text("HiL, Ethernet"));
        assert_eq!(harbor.rows[8][P99], Cell::Absent);
        let found = &harbor.rows[9];
        let expected = [
            Cell::text("HiL, Ethernet, real link"),
            number(0.002_5, 4),
            number(1.5, 2),
            number(1.99, 2),
            Cell::Absent,
            Cell::Count(12_000),
            Cell::text("24 / 7 / 1"),
            number(2.0, 2),
        ];
        for (found, expected) in found.iter().zip(&expected) {
            match (found, expected) {
                (
                    Cell::Number { value, decimals },
                    Cell::Number {
                        value: wanted,
                        decimals: as_wanted,
                    },
                ) => {
                    assert!((value - wanted).abs() < 1e-9 && decimals == as_wanted);
                }
                _ => assert_eq!(found, expected),
            }
        }
        assert_eq!(found[8], Cell::interval(Some((1.2, 3.1)), 2));
        assert_eq!(found[9..11], [Cell::Count(10_819), Cell::Count(0)]);
        assert_eq!(found[13], Cell::Verdict(Verdict::Differs));
        let note = harbor.notes.last().unwrap();
        assert_eq!(
            note,
            "HiL, Ethernet, real link: runs/eth-1; UDP; interval on the run's effective sample"
        );
        let summary = "These differ: harbor, HiL, Ethernet, real link.";
        assert!(
            report.summary.iter().any(|line| line == summary),
            "{:?}",
            report.summary
        );
    }

    const P99: usize = 3;

    #[test]
    fn runs_of_one_label_and_scenario_are_one_row_with_the_interval_of_their_scatter() {
        // 24 of 10 000, off by 0.4 each way: 0.0278 over one degree of freedom, times (12.7062 / 1.95996)^2 = 1.17.
        let short = Some(PublishedNetwork::ShortRange);
        let runs = [[10, 1, 0, 4_000], [14, 2, 1, 6_000]];
        let mut runs: Vec<_> = runs
            .into_iter()
            .map(|counts| run("runs/wifi", short, Scenario::Warehouse, counts))
            .collect();
        runs[1].parameters.fleets = 2;
        runs.push(run(
            "runs/harbor",
            short,
            Scenario::Harbor,
            [0, 0, 0, 15_489],
        ));
        let report = report(runs).unwrap();
        let row = |table: usize, index: usize| report.tables[table].rows[index].clone();
        let pooled = row(1, 10);
        assert_eq!(pooled[0], Cell::text("HiL, short-range Wi-Fi 6, real link"));
        assert_eq!(pooled[5], Cell::Count(10_000));
        assert_eq!(pooled[6], Cell::text("24 / 3 / 1"));
        // Of 20.5 of 8547: 12.6 and 31.5.
        let Cell::Interval { low, high, .. } = pooled[8] else {
            panic!("{pooled:?}");
        };
        assert!(
            (low - 1.47).abs() < 0.03 && (high - 3.69).abs() < 0.05,
            "{low} {high}"
        );
        assert_eq!(pooled[13], Cell::Verdict(Verdict::Agrees));
        let note = report.tables[1].notes.last().unwrap();
        assert!(
            note.contains("divided by 1.17, the scatter among the runs"),
            "{note}"
        );
        // None of as many as were published with 14 is a difference.
        let harbor = row(0, 10);
        assert_eq!(harbor[6], Cell::text("0 / 0 / 0"));
        assert_eq!(harbor[13], Cell::Verdict(Verdict::Differs));
    }

    #[test]
    fn a_replayed_row_is_followed_by_what_its_traces_did_in_virtual_time() {
        let short = Some(PublishedNetwork::ShortRange);
        let mut one = run("runs/a", short, Scenario::Harbor, [14, 20, 0, 15_489]);
        one = with_interval(one, [0.000_5, 0.001_5]);
        let scores = [[13, 20, 1, 15_500], [60, 70, 0, 15_500]];
        let scores = scores.map(|counts| run("", None, Scenario::Harbor, counts).score);
        let replayed = |scores: &[BTreeMap<String, RecordedMetric>]| {
            let mut one = one.clone();
            one.replays = Ok(scores.to_vec());
            report(vec![one]).unwrap()
        };
        let found = replayed(&scores[..1]);
        let harbor = &found.tables[0];
        let at = harbor
            .rows
            .iter()
            .position(|row| row[0] == Cell::text("Replay, short-range Wi-Fi 6, real link"));
        let [row, replay] = harbor.rows[at.unwrap() - 1..=at.unwrap()]
            .as_array()
            .unwrap();
        assert_eq!(row[0], Cell::text("HiL, short-range Wi-Fi 6, real link"));
        assert_eq!(replay[1..5], [const { Cell::Absent }; 4]);
        assert_eq!(replay[5], Cell::Count(15_500));
        assert_eq!(replay[6], Cell::text("13 / 20 / 1"));
        assert_eq!(replay[9..13], [const { Cell::Absent }; 4]);
        assert_eq!(replay[13], Cell::Verdict(Verdict::Agrees));
        assert!(harbor.notes.iter().any(|note| note.starts_with("Replay: ")));
        let last = found.summary.last().unwrap();
        assert!(last.contains("of 1 rows: agrees 1;"), "{last}");
        let other = replayed(&scores[1..]);
        assert_eq!(
            other.tables[0].rows[at.unwrap()][13],
            Cell::Verdict(Verdict::Differs)
        );
        let last = other.summary.last().unwrap();
        assert!(last.contains("of 1 rows: differs 1;"), "{last}");
    }

    #[test]
    fn a_row_has_the_costs_of_its_runs_where_each_score_tells_them() {
        let short = Some(PublishedNetwork::ShortRange);
        let plain = run("runs/a", short, Scenario::Harbor, [0, 0, 0, 1_000]);
        let costs = |runs| {
            let found = report(runs).unwrap();
            let table = found.tables.iter().find(|table| table.name == "costs");
            table.unwrap().rows.last().unwrap()[1..].to_vec()
        };
        assert_eq!(costs(vec![plain.clone()]), [const { Cell::Absent }; 7]);
        // Four fleets for half an hour.
        let mut told = plain;
        for (label, value) in [
            (MISSIONS_BEGUN, 120.0),
            (MISSIONS, 100.0),
            (RESETS, 1.0),
            (RUN_LENGTH, 1_800.0),
            (MISSION_DELAY, 2.5),
            (STOPS, 300.0),
            (NEAR_MISSES, 5.0),
        ] {
            let metric = RecordedMetric {
                value: Some(value),
                interval: None,
            };
            told.score.insert(label.name.to_owned(), metric);
        }
        // One in which no mission was done counts with its time.
        let mut other = told.clone();
        other.folder = "runs/b".to_owned();
        let mut set = |label: Label, value| {
            let metric = RecordedMetric {
                value,
                interval: None,
            };
            other.score.insert(label.name.to_owned(), metric);
        };
        set(MISSIONS, Some(0.0));
        set(MISSION_DELAY, None);
        let expected = [
            Cell::Count(240),
            Cell::Count(100),
            Cell::Count(2),
            number(25.0, 0),
            number(2.5, 2),
            number(2.5, 2),
            number(5.0, 1),
        ];
        assert_eq!(costs(vec![told, other]), expected);
    }

    #[test]
    fn a_run_without_a_label_stands_last_and_for_itself() {
        let alone = run("runs/lte", None, Scenario::Warehouse, [0, 0, 0, 900]);
        let report = report(vec![alone]).unwrap();
        let table = &report.tables[1];
        let row = table.rows.last().unwrap();
        assert_eq!(row[0], Cell::text("HiL, fleet-split, real link"));
        assert_eq!(row[9..13], [const { Cell::Absent }; 4]);
        assert_eq!(row[13], Cell::Verdict(Verdict::NotComparable));
        assert!(table.notes.last().unwrap().contains("no label"));
    }

    #[test]
    fn a_run_of_other_rules_or_of_another_world_is_not_compared_and_says_why() {
        let ethernet = Some(PublishedNetwork::Ethernet);
        let mut safe = run("runs/safe", ethernet, Scenario::Harbor, [0, 0, 0, 12_000]);
        safe.parameters.coordinator.mode = CoordinatorMode::Safe;
        safe.parameters.world.robots = 14;
        let plain = run("runs/plain", ethernet, Scenario::Harbor, [0, 0, 0, 12_000]);
        let report = report(vec![safe, plain]).unwrap();
        let harbor = &report.tables[0];
        let verdict = |row: usize| harbor.rows[row][13].clone();
        // They are no repetitions of each other, so that each is a row.
        assert_eq!(verdict(9), Cell::Verdict(Verdict::NotComparable));
        assert_eq!(verdict(10), Cell::Verdict(Verdict::Agrees));
        let expected = "runs/safe; UDP; none seen: interval of counts divided by 1.00, the scatter of the table's \
                        cells; not comparable: world.robots is 14, the table has 7; coordinator.mode is safe, \
                        the table has legacy";
        let is_there = |note: &String| note.contains(expected);
        assert!(harbor.notes.iter().any(is_there), "{:?}", harbor.notes);
    }

    #[test]
    fn a_run_that_is_in_no_table_is_refused_by_folder_and_cause() {
        let ethernet = Some(PublishedNetwork::Ethernet);
        let error = |run| report(vec![run]).unwrap_err().to_string();
        assert_eq!(
            error(run("runs/a", ethernet, Scenario::Crossing, [0, 0, 0, 10])),
            "runs/a: its world.scenario crossing has no table; harbor and warehouse have one"
        );
        assert_eq!(
            error(run("runs/a", ethernet, Scenario::Harbor, [0; 4])),
            "runs/a: no robot passed a critical section"
        );
        let mut bare = run("runs/a", ethernet, Scenario::Harbor, [0, 0, 0, 10]);
        bare.score.remove(CRITICAL_SECTIONS.name);
        assert_eq!(
            error(bare),
            "runs/a: its score has no critical_sections_count"
        );
    }
}
