//! Recorded runs of a teleoperated robot as rows of the motion-loss table: what each counted, and what the paper has.

use crate::TeleoperationParameters;
use crate::experiment::conditions::{
    Condition, Expected, LONG_RANGE_LOST, PUBLISHED_LOOPS, SHORT_RANGE_LOST,
};
use crate::score::{LOOPS_EXECUTED, LOOPS_SENT, MOTION_LOSS};
use hil_core::options::{Difference, differences};
use hil_core::recorded_run::{Doubt, PublishedNetwork, RecordedRun};
use hil_core::study::{Cell, StudyRefusal, Verdict};
use hil_stats::comparison::{Judge, Share};
use hil_stats::recorded::{PooledShare, RecordedRow, RunShare};

/// A row of recorded runs.
#[derive(Debug)]
pub(crate) struct MotionLossRow {
    /// Its runs.
    pub(crate) row: RecordedRow<TeleoperationParameters>,
    /// Loops that the robot did not make, of those sent.
    pub(crate) lost: PooledShare,
    /// How it stands to the paper.
    pub(crate) verdict: Verdict,
    /// The same in virtual time over the traces of its runs; its verdict is against them.
    pub(crate) replay: Option<Box<Self>>,
    /// The parameters of the table are the published ones.
    is_fitted: bool,
}

/// Why a row beside a table of other parameters is not compared.
const NOT_FITTED: &str =
    "not comparable: the table's parameters are not those of the published rates";

impl MotionLossRow {
    /// The rows of `recorded` beside a table of `parameters`; those are the published ones where `is_fitted`.
    ///
    /// # Errors
    /// Names the run that counted no motion loops.
    pub(crate) fn of_runs(
        mut recorded: Vec<RecordedRun<TeleoperationParameters>>,
        parameters: &TeleoperationParameters,
        is_fitted: bool,
    ) -> Result<Vec<Self>, StudyRefusal> {
        for run in &mut recorded {
            let different = different(&run.parameters, parameters);
            if !different.is_empty() {
                run.doubts.push(Doubt::OtherParameters(different));
            }
        }
        let rows = RecordedRow::of_runs(recorded, |one, other| different(one, other).is_empty());
        let rows = rows.into_iter();
        let rows = rows.map(|row| Self::of(row, is_fitted));
        let mut rows = rows.collect::<Result<Vec<_>, _>>()?;
        let replay_count = rows.iter().filter(|one| one.replay.is_some()).count();
        let judge = Judge::of_tests(replay_count);
        for one in &mut rows {
            if let Some(replay) = &mut one.replay {
                replay.verdict = replay.row.verdict_of_replay(&replay.lost, &one.lost, judge);
            }
        }
        Ok(rows)
    }

    fn of(
        row: RecordedRow<TeleoperationParameters>,
        is_fitted: bool,
    ) -> Result<Self, StudyRefusal> {
        let lost = row.shares(|run| {
            let [sent, executed] = [run.count(LOOPS_SENT.name)?, run.count(LOOPS_EXECUTED.name)?];
            if sent == 0 && !row.is_replay() {
                return Err(run.refused("no motion loop was sent"));
            }
            Ok(RunShare {
                share: Share {
                    count: sent.saturating_sub(executed),
                    of: sent,
                },
                interval: run.interval(MOTION_LOSS.name),
            })
        })?;
        // How lost loops would come together, runs without any do not tell.
        let lost = PooledShare::of(&lost, None);
        let replay = row.replayed().map(|row| Self::of(row, is_fitted));
        let replay = replay.transpose()?.map(Box::new);
        let network = row.first().network.filter(|_| !row.is_replay());
        let published = network.map(published).filter(|_| is_fitted);
        Ok(Self {
            verdict: row.verdict(&lost, published),
            row,
            lost,
            replay,
            is_fitted,
        })
    }

    /// What a reader must know of it.
    pub(crate) fn note(&self) -> String {
        let note = self.row.note(&self.lost);
        match self.published().filter(|_| !self.is_fitted) {
            Some(_) => format!("{note}; {NOT_FITTED}"),
            None => note,
        }
    }

    fn published(&self) -> Option<Share> {
        let network = self.row.first().network.filter(|_| !self.row.is_replay());
        network.map(published)
    }

    /// True beside the row of `condition`, which is held against the same published rate.
    pub(crate) fn is_beside(&self, condition: &Condition) -> bool {
        let published = published_of(condition.expected);
        published.is_some() && published == self.published()
    }

    /// Loops sent and lost, loss and delay of the network, and the published rate.
    pub(crate) fn measured(&self) -> Vec<Cell> {
        vec![
            Cell::Count(self.lost.share.of),
            Cell::Count(self.lost.share.count),
            Cell::number(self.row.loss_ratio(), 4),
            Cell::number(self.row.delay_ms(0.5), 2),
            Cell::number(self.row.delay_ms(0.99), 2),
            published_cell(self.published()),
        ]
    }
}

/// Loops lost of those played, as published.
fn published(network: PublishedNetwork) -> Share {
    let lost = match network {
        PublishedNetwork::Ethernet => 0,
        PublishedNetwork::ShortRange => SHORT_RANGE_LOST,
        PublishedNetwork::LongRange => LONG_RANGE_LOST,
    };
    share(lost)
}

fn share(lost: u32) -> Share {
    Share {
        count: u64::from(lost),
        of: u64::from(PUBLISHED_LOOPS),
    }
}

fn published_of(expected: Expected) -> Option<Share> {
    match expected {
        Expected::Ethernet => Some(share(0)),
        Expected::Published { lost, .. } => Some(share(lost)),
        Expected::NothingLost { .. } | Expected::Open => None,
    }
}

/// The cell of what is published of `condition`.
pub(crate) fn published_rate(condition: &Condition) -> Cell {
    published_cell(published_of(condition.expected))
}

fn published_cell(published: Option<Share>) -> Cell {
    let ratio = published.map(|one| one.count as f64 / one.of as f64);
    Cell::number(ratio, 5)
}

/// In what two runs, or a run and the table, differ but for the size of the tables.
fn different(found: &TeleoperationParameters, wanted: &TeleoperationParameters) -> Vec<Difference> {
    let mut found = TeleoperationParameters {
        tables: wanted.tables.clone(),
        ..found.clone()
    };
    differences(&mut found, &mut wanted.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Teleoperation;
    use crate::experiment::MotionLossStudy;
    use hil_core::case_study::CaseStudy as _;
    use hil_core::interval::{Interval, IntervalMethod, Spread};
    use hil_core::recorded_run::{
        DelayBin, LinkOrigin, RecordedCrossing, RecordedLink, RecordedMetric, SkippedTicks,
    };
    use hil_core::study::{Study as _, StudyReport};

    /// A run of so many loops, of which so many were executed.
    fn run(
        folder: &str,
        network: Option<PublishedNetwork>,
        [sent, executed]: [u32; 2],
        interval: Option<[f64; 2]>,
    ) -> RecordedRun<TeleoperationParameters> {
        let of = |count: u32| RecordedMetric {
            value: Some(f64::from(count)),
            interval: None,
        };
        let interval = interval
            .map(|[low, high]| Interval::new(low, high, IntervalMethod::EffectiveShare))
            .map(Spread::Known);
        let ratio = RecordedMetric {
            value: None,
            interval,
        };
        let score = [
            (LOOPS_SENT, of(sent)),
            (LOOPS_EXECUTED, of(executed)),
            (MOTION_LOSS, ratio),
        ];
        RecordedRun {
            folder: folder.to_owned(),
            name: "teleop-split".to_owned(),
            network,
            row: None,
            link: RecordedLink {
                origin: LinkOrigin::Real,
                about: "UDP and TCP".to_owned(),
            },
            seed: 1,
            parameters: TeleoperationParameters::default(),
            crossing: RecordedCrossing {
                offered_count: 10_000,
                lost_count: Ok(300),
                delays: Ok(vec![DelayBin {
                    above_ns: 2_000_000,
                    until_ns: 4_000_000,
                    count: 9_700,
                }]),
            },
            score: score
                .map(|(label, metric)| (label.name.to_owned(), metric))
                .into(),
            skipped: SkippedTicks::default(),
            probed: None,
            replays: Ok(Vec::new()),
            doubts: Vec::new(),
        }
    }

    /// The report beside conditions of which none was run.
    fn report(
        conditions: &str,
        recorded: Vec<RecordedRun<TeleoperationParameters>>,
    ) -> Result<StudyReport, StudyRefusal> {
        let mut parameters = TeleoperationParameters::default();
        parameters.tables.conditions = vec![conditions.to_owned()];
        let case = Teleoperation::new(parameters, 1).unwrap();
        let study = MotionLossStudy::new(&case, recorded)?;
        Ok(study.report(&vec![None; study.task_count()]))
    }

    fn rows(report: &StudyReport) -> Vec<String> {
        let rows = report.tables[0].rows.iter();
        let name = |row: &Vec<Cell>| match &row[0] {
            Cell::Text(name) => name.clone(),
            other => panic!("{other:?}"),
        };
        rows.map(name).collect()
    }

    #[test]
    fn without_runs_the_table_has_the_columns_of_virtual_time() {
        let report = report("range", Vec::new()).unwrap();
        let columns = report.tables[0].columns.iter();
        let columns: Vec<_> = columns.map(|column| column.label).collect();
        let expected = [
            "Condition",
            "MLR",
            "sd",
            "95 % of runs",
            "Trips/h",
            "Held",
            "Verdict",
        ];
        assert_eq!(columns, expected);
        assert_eq!(report.tables[0].notes.len(), 2);
    }

    #[test]
    fn a_replayed_row_is_followed_by_what_its_traces_did_in_virtual_time() {
        let short = Some(PublishedNetwork::ShortRange);
        let mut one = run("runs/a", short, [890, 883], Some([0.002, 0.014]));
        one.replays = Ok(vec![run("", None, [890, 882], None).score; 4]);
        let found = report("range", vec![one]).unwrap();
        let rows = rows(&found);
        let at = rows
            .iter()
            .position(|name| name == "Replay, short-range Wi-Fi 6, real link");
        let at = at.unwrap();
        assert_eq!(rows[at - 1], "HiL, short-range Wi-Fi 6, real link");
        let replay = &found.tables[0].rows[at];
        assert_eq!(replay[6..8], [Cell::Count(3560), Cell::Count(32)]);
        assert_eq!(replay[8..12], [const { Cell::Absent }; 4]);
        assert_eq!(replay.last(), Some(&Cell::Verdict(Verdict::Agrees)));
        let last = found.summary.last().unwrap();
        assert!(last.contains("of 1 rows: agrees 1;"), "{last}");
    }

    #[test]
    fn rows_stand_beside_those_of_the_same_published_rate() {
        let long = Some(PublishedNetwork::LongRange);
        let short = Some(PublishedNetwork::ShortRange);
        let recorded = vec![
            run("runs/long", long, [890, 862], Some([0.02, 0.045])),
            run("runs/own", None, [890, 890], None),
            run("runs/short", short, [890, 850], Some([0.03, 0.062])),
            run(
                "runs/eth",
                Some(PublishedNetwork::Ethernet),
                [890, 890],
                None,
            ),
        ];
        let report = report("range", recorded).unwrap();
        assert_eq!(
            rows(&report),
            [
                "short-range",
                "long-range",
                "wifi6-short-range",
                "HiL, short-range Wi-Fi 6, real link",
                "wifi6-long-range",
                "HiL, long-range Wi-Fi 6, real link",
                "HiL, teleop-split, real link",
                "HiL, Ethernet, real link",
            ]
        );
        let table = &report.tables[0];
        for row in &table.rows {
            assert_eq!(row.len(), table.columns.len());
        }
        let number = |value: f64, decimals| Cell::number(Some(value), decimals);
        // The published rate stands beside the conditions too.
        let of_lost = |lost: f64| number(lost / 890.0, 5);
        assert_eq!(table.rows[0][11], of_lost(7.0));
        // 28 of 890 against 27.
        let found = &table.rows[5];
        assert_eq!(found[1], of_lost(28.0));
        assert_eq!(found[3], Cell::interval(Some((0.02, 0.045)), 5));
        let expected = [
            Cell::Count(890),
            Cell::Count(28),
            number(0.03, 4),
            number(3.0, 2),
        ];
        assert_eq!(found[6..10], expected);
        assert_eq!(found[11], of_lost(27.0));
        let verdicts = table.rows.iter().map(|row| row.last().cloned().unwrap());
        let verdicts: Vec<_> = verdicts.collect();
        assert_eq!(verdicts[5], Cell::Verdict(Verdict::Agrees));
        // 0.045 with 0.030 to 0.062, against 0.008: by more than hypot(0.015, 0.011).
        assert_eq!(verdicts[3], Cell::Verdict(Verdict::Differs));
        assert_eq!(verdicts[6], Cell::Verdict(Verdict::NotComparable));
        assert_eq!(verdicts[7], Cell::Verdict(Verdict::Agrees));
        let summary = "of 4 rows: agrees 2, differs 1, inconclusive 0, fitted 0, not comparable 1";
        assert!(report.summary[0].contains(summary), "{:?}", report.summary);
    }

    #[test]
    fn repetitions_are_one_row_and_more_executed_than_sent_is_none_lost() {
        let short = Some(PublishedNetwork::ShortRange);
        let recorded = vec![
            run("runs/1", short, [445, 442], None),
            run("runs/2", short, [445, 440], None),
            run("runs/3", short, [445, 446], None),
        ];
        let report = report("perfect", recorded).unwrap();
        let name = "HiL, short-range Wi-Fi 6, real link";
        assert_eq!(rows(&report), ["perfect", name]);
        let table = &report.tables[0];
        assert_eq!(table.rows[1][6..8], [Cell::Count(1335), Cell::Count(8)]);
        let note = table.notes.last().unwrap();
        assert!(
            note.contains("runs/1, runs/2, runs/3; UDP and TCP; interval of counts"),
            "{note}"
        );
    }

    #[test]
    fn a_labelled_row_beside_a_table_that_is_not_fitted_says_so() {
        let short = Some(PublishedNetwork::ShortRange);
        let parameters = TeleoperationParameters {
            motion_period_s: 2.0,
            ..TeleoperationParameters::default()
        };
        let note = |network| {
            let mut run = run("runs/a", network, [890, 883], Some([0.003, 0.014]));
            run.parameters = parameters.clone();
            let rows = MotionLossRow::of_runs(vec![run], &parameters, false).unwrap();
            assert_eq!(rows[0].verdict, Verdict::NotComparable);
            rows[0].note()
        };
        assert!(note(short).ends_with(NOT_FITTED), "{}", note(short));
        assert!(note(None).ends_with("no label says for which network it stands"));
    }

    #[test]
    fn another_motion_or_robot_is_not_compared_and_a_run_without_loops_is_refused() {
        let short = Some(PublishedNetwork::ShortRange);
        let mut other = run("runs/a", short, [890, 883], Some([0.003, 0.014]));
        other.parameters.motion_period_s = 2.0;
        other.parameters.tables.seeds = 3;
        let report_of = |run| report("perfect", vec![run]);
        let found = report_of(other).unwrap();
        let table = &found.tables[0];
        assert_eq!(
            table.rows[1].last(),
            Some(&Cell::Verdict(Verdict::NotComparable))
        );
        let note = table.notes.last().unwrap();
        let expected = "not comparable: motion_period_s is 2, the table has 4.033";
        assert!(note.ends_with(expected), "{note}");
        let error = |run| report_of(run).unwrap_err().to_string();
        let idle = run("runs/a", short, [0, 0], None);
        assert_eq!(error(idle), "runs/a: no motion loop was sent");
        let mut bare = run("runs/a", short, [890, 883], None);
        bare.score.clear();
        assert_eq!(
            error(bare),
            "runs/a: its score has no motion_loops_sent_count"
        );
    }
}
