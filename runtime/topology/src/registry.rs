//! The case studies this binary knows, by name. It stores one monomorphised constructor per case;
//! nothing is discovered or loaded at run time.

use core::fmt::Debug;
use std::fs;

use hil_core::case_study::{
    CaseStudy, ChannelSpec, ErrorSeries, LiveEvents, ParameterError, Score,
};
use hil_core::component::Role;
use hil_core::plot::PlotSeries;
use hil_core::recorded_run::{RecordedRun, RowSample};
use hil_core::replay::Replay;
use hil_core::run_log::RunLog;
use hil_core::study::{Batch, StudyRefusal};
use hil_core::text_file::TextFile;
use serde_json::Value;

use crate::{KnownCase, KnownCases, ReadParameters, Topology, check_parameters_with};

/// A case whose type is no longer known: what `[case]` resolves to.
pub trait Case: Debug {
    /// A fresh instance of a role; `None` if the case has no such role.
    fn role(&self, name: &str) -> Option<Box<dyn Role>>;

    /// See [`CaseStudy::undecided`].
    fn undecided(&self) -> Option<String>;

    /// See [`CaseStudy::score`].
    fn score(&self, log: &RunLog) -> Score;

    /// See [`CaseStudy::errors`].
    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries>;

    /// See [`CaseStudy::live_events`].
    fn live_events(&self) -> Option<Box<dyn LiveEvents>>;

    /// See [`CaseStudy::series`].
    fn series(&self, log: &RunLog) -> Vec<PlotSeries>;

    /// See [`CaseStudy::replay`].
    fn replay(&self, log: &RunLog) -> Option<Replay>;

    /// See [`CaseStudy::calibration`].
    ///
    /// # Errors
    /// When the value is outside what the figure can take.
    fn calibration(
        &self,
        figure: &str,
        value: f64,
    ) -> Result<Option<Box<dyn Batch>>, ParameterError>;

    /// See [`CaseStudy::study`]. The runs have their parameters as their manifests state them.
    ///
    /// # Errors
    /// Names the parameter that keeps the tables from being computed, or the run that can be no row of them.
    fn study(
        &self,
        recorded: Vec<RecordedRun<Value>>,
    ) -> Result<Option<Box<dyn Batch>>, StudyRefusal>;
}

#[derive(Debug)]
struct Erased<C>(C);

impl<C: CaseStudy> Case for Erased<C> {
    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        self.0.role(name)
    }

    fn undecided(&self) -> Option<String> {
        self.0.undecided()
    }

    fn score(&self, log: &RunLog) -> Score {
        self.0.score(log)
    }

    fn live_events(&self) -> Option<Box<dyn LiveEvents>> {
        self.0.live_events()
    }

    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        self.0.errors(log)
    }

    fn series(&self, log: &RunLog) -> Vec<PlotSeries> {
        self.0.series(log)
    }

    fn replay(&self, log: &RunLog) -> Option<Replay> {
        self.0.replay(log)
    }

    fn calibration(
        &self,
        figure: &str,
        value: f64,
    ) -> Result<Option<Box<dyn Batch>>, ParameterError> {
        self.0.calibration(figure, value)
    }

    fn study(
        &self,
        recorded: Vec<RecordedRun<Value>>,
    ) -> Result<Option<Box<dyn Batch>>, StudyRefusal> {
        let recorded = recorded.into_iter();
        let recorded = recorded.map(|run| run.with_parameters(serde_json::from_value));
        self.0.study(recorded.collect::<Result<_, _>>()?)
    }
}

/// Why a case cannot be made from its parameters.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct CaseError {
    /// Key below `[case.parameters]`, where it is known.
    pub key: Option<String>,
    /// What is wrong with which value.
    pub message: String,
}

/// Why a word names no case.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CaseNameError {
    /// No case begins like that.
    #[error("no case is called {word:?} or begins with it; there is {known}")]
    Unknown {
        /// The word.
        word: String,
        /// All cases.
        known: String,
    },
    /// Several do.
    #[error("{word:?} may be {matching}; write more of the name")]
    Ambiguous {
        /// The word.
        word: String,
        /// Those that begin with it.
        matching: String,
    },
}

/// One known case study.
#[derive(Debug, Clone, Copy)]
pub struct CaseEntry {
    /// What `[case] name` says.
    pub name: &'static str,
    /// One line for a list.
    pub summary: &'static str,
    /// Its roles.
    pub roles: &'static [&'static str],
    /// Its channels.
    pub channels: &'static [ChannelSpec],
    /// See [`CaseStudy::SCORE_CLOCK`].
    pub score_clock: Option<&'static str>,
    /// The series it can give, by name.
    pub series: &'static [&'static str],
    /// The figures it can be calibrated for, by name.
    pub calibrated_metrics: &'static [&'static str],
    /// See [`CaseStudy::ROW_SAMPLE`].
    pub row_sample: Option<RowSample>,
    make: fn(Value, u64) -> Result<Box<dyn Case>, CaseError>,
    defaults: fn() -> Value,
}

impl CaseEntry {
    /// The case with these parameters.
    ///
    /// # Errors
    /// Names the parameter, its value and its allowed range.
    pub fn make(&self, parameters: Value, seed: u64) -> Result<Box<dyn Case>, CaseError> {
        (self.make)(parameters, seed)
    }

    /// Every parameter with its default.
    pub fn defaults(&self) -> Value {
        (self.defaults)()
    }
}

/// A case with its parameters, and what is known of its kind.
pub type MadeCase<'a> = (&'a CaseEntry, Box<dyn Case>);

/// The cases of a binary.
#[derive(Debug, Clone, Default)]
pub struct Registry {
    entries: Vec<CaseEntry>,
    known: KnownCases,
}

impl Registry {
    /// Adds `C` under its name.
    ///
    /// # Panics
    /// When two cases have one name: a mistake in `main`.
    pub fn add<C: CaseStudy>(&mut self) {
        assert!(
            self.find(C::NAME).is_none(),
            "case {} is registered twice",
            C::NAME
        );
        self.entries.push(CaseEntry {
            name: C::NAME,
            summary: C::SUMMARY,
            roles: C::ROLES,
            channels: C::CHANNELS,
            score_clock: C::SCORE_CLOCK,
            series: C::SERIES,
            calibrated_metrics: C::CALIBRATED_FIGURES,
            row_sample: C::ROW_SAMPLE,
            make: make::<C>,
            defaults: || serde_json::to_value(C::Parameters::default()).unwrap_or(Value::Null),
        });
        let known = KnownCase {
            check_parameters: check_parameters::<C>,
            ..KnownCase::of::<C>()
        };
        self.known = core::mem::take(&mut self.known).with_case(known);
    }

    /// The case called `name`.
    pub fn find(&self, name: &str) -> Option<&CaseEntry> {
        self.entries.iter().find(|entry| entry.name == name)
    }

    /// The case whose name begins with `word`, if only one does; a whole name is always itself.
    ///
    /// # Errors
    /// When none does, or more than one: names those that come into question.
    pub fn find_by_prefix(&self, word: &str) -> Result<&CaseEntry, CaseNameError> {
        if let Some(entry) = self.find(word) {
            return Ok(entry);
        }
        let names = |entries: &[&CaseEntry]| {
            let names: Vec<_> = entries.iter().map(|entry| entry.name).collect();
            names.join(", ")
        };
        let entries = self.entries.iter();
        let matching: Vec<_> = entries
            .filter(|entry| !word.is_empty() && entry.name.starts_with(word))
            .collect();
        match matching.as_slice() {
            [entry] => Ok(entry),
            [] => Err(CaseNameError::Unknown {
                word: word.to_owned(),
                known: names(&self.entries.iter().collect::<Vec<_>>()),
            }),
            several => Err(CaseNameError::Ambiguous {
                word: word.to_owned(),
                matching: names(several),
            }),
        }
    }

    /// The case of `topology` with its parameters; `None` when it names none that is known.
    ///
    /// # Errors
    /// Names the parameter, its value and its allowed range.
    pub fn make_case(&self, topology: &Topology) -> Result<Option<MadeCase<'_>>, CaseError> {
        let Some((case, entry)) = topology
            .case()
            .and_then(|case| Some((case, self.find(&case.name)?)))
        else {
            return Ok(None);
        };
        let parameters = serde_json::to_value(&case.parameters).map_err(|error| CaseError {
            key: None,
            message: error.to_string(),
        })?;
        let made = entry.make(parameters, topology.run().seed)?;
        Ok(Some((entry, made)))
    }

    /// The cases as the topology reader needs them.
    pub fn known(&self) -> &KnownCases {
        &self.known
    }

    /// All cases, in the order they were added.
    pub fn entries(&self) -> &[CaseEntry] {
        &self.entries
    }
}

fn make<C: CaseStudy>(parameters: Value, seed: u64) -> Result<Box<dyn Case>, CaseError> {
    let mut parameters: C::Parameters =
        serde_json::from_value(parameters).map_err(|error| CaseError {
            key: None,
            message: error.to_string(),
        })?;
    let named = |error: ParameterError| CaseError {
        key: Some(error.key.clone()),
        message: error.to_string(),
    };
    C::read_files(&mut parameters, &mut read_text).map_err(named)?;
    let case = C::new(parameters, seed).map_err(named)?;
    Ok(Box::new(Erased(case)))
}

/// Checks parameters as the topology reader does, with the files that they name.
fn check_parameters<C: CaseStudy>(
    read: ReadParameters<'_>,
    seed: u64,
) -> Result<Option<toml::Table>, ParameterError> {
    check_parameters_with::<C>(read, seed, &mut |parameters| {
        C::read_files(parameters, &mut read_text)
    })
}

/// Reads a file that a parameter names, relative to the working directory.
pub(crate) fn read_text(path: &str) -> Result<TextFile, String> {
    let bytes = fs::read(path).map_err(|error| error.to_string())?;
    TextFile::decode(&bytes).map_err(|fault| fault.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_fleet::Fleet;
    use hil_shuttle::Shuttle;
    use hil_teleoperation::Teleoperation;
    use serde_json::json;

    #[test]
    fn a_wrong_parameter_is_named_with_its_range() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let entry = registry.find("shuttle").unwrap();
        let error = entry.make(json!({ "gain_per_s": 101.0 }), 0).unwrap_err();
        assert_eq!(error.key.as_deref(), Some("gain_per_s"));
        assert_eq!(error.message, "gain_per_s 101 is outside 0 to 100");
        let error = entry.make(json!({ "gain": 1.0 }), 0).unwrap_err();
        assert!(error.message.contains("unknown field `gain`"), "{error}");
        assert!(entry.make(entry.defaults(), 0).is_ok());
    }

    #[test]
    fn a_case_is_found_by_as_much_of_its_name_as_no_other_has() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        registry.add::<Fleet>();
        registry.add::<Teleoperation>();
        let found = |word| registry.find_by_prefix(word).map(|entry| entry.name);
        assert_eq!(found("teleop"), Ok("teleoperation"));
        assert_eq!(found("shuttle"), Ok("shuttle"));
        assert_eq!(found("f"), Ok("fleet"));
        let error = found("teleoperations").unwrap_err().to_string();
        let expected = "no case is called \"teleoperations\" or begins with it; there is shuttle, \
                        fleet, teleoperation";
        assert_eq!(error, expected);
        assert!(matches!(found(""), Err(CaseNameError::Unknown { .. })));
        registry.entries[1].name = "shuffle";
        let error = registry.find_by_prefix("shu").unwrap_err().to_string();
        let expected = "\"shu\" may be shuttle, shuffle; write more of the name";
        assert_eq!(error, expected);
    }
}
