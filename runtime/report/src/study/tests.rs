//! Studies and calibrations of a case of their own.

use super::*;
use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError, Score};
use hil_core::component::Role;
use hil_core::run_log::RunLog;
use hil_core::study::{Cell, Column, Study, Table, Watch, into_batch};
use hil_shuttle::Shuttle;

use hil_topology;

/// Can be calibrated for one figure.
#[derive(Debug)]
struct Tuned {
    gain_per_s: f64,
}

impl CaseStudy for Tuned {
    const NAME: &'static str = "tuned";
    const SUMMARY: &'static str = "can be calibrated";
    const ROLES: &'static [&'static str] = &[];
    const CHANNELS: &'static [ChannelSpec] = &[];
    const CALIBRATED_FIGURES: &'static [&'static str] = &["mlr"];
    type Parameters = Shuttle;

    fn new(parameters: Shuttle, _seed: u64) -> Result<Self, ParameterError> {
        let gain_per_s = parameters.gain_per_s;
        Ok(Self { gain_per_s })
    }

    fn role(&self, _name: &str) -> Option<Box<dyn Role>> {
        None
    }

    fn score(&self, _log: &RunLog) -> Score {
        Score::default()
    }

    fn calibration(
        &self,
        figure: &str,
        value: f64,
    ) -> Result<Option<Box<dyn Batch>>, ParameterError> {
        if figure != "mlr" {
            return Ok(None);
        }
        ParameterError::check(figure, value, 0.0..=1.0, "0 to 1")?;
        let Self { gain_per_s } = self;
        Ok(Some(into_batch(Curve(value * gain_per_s))))
    }
}

/// A curve of four points.
#[derive(Debug)]
struct Curve(f64);

impl Study for Curve {
    type Outcome = f64;

    fn task_count(&self) -> usize {
        4
    }

    fn label(&self, task: usize) -> String {
        format!("point {task}")
    }

    fn run(&self, task: usize, _watch: Watch<'_>) -> Option<f64> {
        Some(self.0 * task as f64)
    }

    fn report(&self, outcomes: &[Option<&f64>]) -> StudyReport {
        let cell = |value: Option<f64>| vec![Cell::number(value, 3)];
        StudyReport {
            tables: vec![Table {
                name: "curve".to_owned(),
                columns: vec![Column::new("outages_per_h", "Outages per hour")],
                rows: outcomes.iter().map(|one| cell(one.copied())).collect(),
                ..Table::default()
            }],
            ..StudyReport::default()
        }
    }
}

fn registry() -> Registry {
    let mut registry = Registry::default();
    registry.add::<Tuned>();
    registry.add::<Shuttle>();
    registry
}

fn calibration(
    case: &str,
    overrides: &[&str],
    figure: &str,
    value: f64,
) -> Result<Box<dyn Batch>, StudyError> {
    let registry = registry();
    let overrides: Vec<_> = overrides.iter().map(|&text| text.to_owned()).collect();
    let topology = hil_topology::case_by_name(case, &overrides, registry.known()).unwrap();
    batch_of(&topology, &registry, Wanted::Calibration { figure, value })
}

#[test]
fn a_calibration_is_computed_and_written_like_tables() {
    let batch = calibration("tuned", &["case.parameters.gain_per_s=2.0"], "mlr", 0.5).unwrap();
    let folder = std::env::temp_dir().join(format!("hil-calibration-{}", std::process::id()));
    let args = BatchArgs {
        jobs: NonZeroUsize::new(2),
        full: false,
        json: true,
        output: Some(folder.clone()),
        quiet: true,
    };
    let signals = Signals::install().unwrap();
    let invocation = Invocation {
        words: vec!["hil-runtime".to_owned()],
        overrides: Vec::new(),
        remarks: Vec::new(),
        columns: 100,
    };
    let mut console = Console::new(true);
    let end = run(batch.as_ref(), &args, &invocation, &signals, &mut console).unwrap();
    assert_eq!(end, CommandEnd::Done);
    let curve = fs::read_to_string(folder.join("curve.csv")).unwrap();
    assert_eq!(curve, "outages_per_h\r\n0\r\n1\r\n2\r\n3\r\n");
    assert!(folder.join("report.json").is_file() && folder.join("report.txt").is_file());
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_cannot_be_calibrated_is_said_with_what_can() {
    let error = |case, figure, value| {
        calibration(case, &[], figure, value)
            .unwrap_err()
            .to_string()
    };
    assert_eq!(error("tuned", "mlr", 1.5), "mlr 1.5 is outside 0 to 1");
    let expected = "case tuned cannot be calibrated for lag; there is mlr";
    assert_eq!(error("tuned", "lag", 0.5), expected);
    let expected = "case shuttle cannot be calibrated for mlr; it has no calibration";
    assert_eq!(error("shuttle", "mlr", 0.5), expected);
    let registry = registry();
    let topology = hil_topology::case_by_name("tuned", &[], registry.known()).unwrap();
    let error = batch_of(&topology, &registry, Wanted::Tables { runs: &[] }).unwrap_err();
    assert_eq!(error.to_string(), "case tuned has no tables");
}
