//! A case study: the roles of a robot's loop, the channels between them, and how a finished run
//! is scored. It says nothing about hosts, processes or networks; the topology file does.

use core::fmt::Debug;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::component::Role;
use crate::endpoint::{RoleChannels, StatedChannel};
use crate::message::{Message, MessageType, TypeInfo};
use crate::options::Options;
use crate::plot::PlotSeries;
use crate::recorded_run::{RecordedRun, RowSample};
use crate::replay::Replay;
use crate::run_log::RunLog;
use crate::study::{Batch, StudyRefusal};
use crate::text_file::TextFile;

pub use crate::score::{
    EVENT_MESSAGES_MAX, EVENTS_MAX, ErrorSeries, Harm, LiveEvents, MessageRef, Metric, Occasions,
    Score, ScoreEvent, Severity,
};

/// A kind of experiment that a topology file can name in `[case]`.
///
/// To swap only the controller of a shipped case, wrap the case: forward every function and
/// return your own [`Role`] for `"controller"`.
pub trait CaseStudy: Sized + Debug + 'static {
    /// What `[case] name = "…"` says.
    const NAME: &'static str;
    /// One line for `hil-runtime cases`.
    const SUMMARY: &'static str;
    /// The roles, in the order reports list them.
    const ROLES: &'static [&'static str];
    /// The channels between the roles; each role has the ports of its channels' names.
    const CHANNELS: &'static [ChannelSpec];
    /// The channel on whose producer's clock the score is kept: events and errors have their times on
    /// it, and so have stamps that messages carry as payload. Where hosts have clocks of their own and
    /// these are aligned, the log has the stamps of all channels on this clock, with the bound
    /// [`RunLog::clock_bound_ns`]; without it they stay as they were read, and
    /// [`RunLog::has_one_clock`] is false.
    const SCORE_CLOCK: Option<&'static str> = None;
    /// The series that [`CaseStudy::series`] can give, by name.
    const SERIES: &'static [&'static str] = &[];
    /// The figures that [`CaseStudy::calibration`] knows, by name.
    const CALIBRATED_FIGURES: &'static [&'static str] = &[];
    /// What makes a row of recorded runs large enough for [`CaseStudy::study`]; `None` for a case whose tables take none.
    const ROW_SAMPLE: Option<RowSample> = None;
    /// `[case.parameters]`, declared with [`options!`](crate::options!).
    type Parameters: Options + DeserializeOwned + Serialize + Default;

    /// Fills in what the parameters name by file; `read` gives a file's text or says where it is none.
    /// Models open no file themselves.
    ///
    /// # Errors
    /// Names the parameter and what `read` said.
    fn read_files(
        _parameters: &mut Self::Parameters,
        _read: &mut dyn FnMut(&str) -> Result<TextFile, String>,
    ) -> Result<(), ParameterError> {
        Ok(())
    }

    /// Checks the parameters and prepares what the roles share.
    ///
    /// # Errors
    /// Names the parameter, its value and its allowed range.
    fn new(parameters: Self::Parameters, seed: u64) -> Result<Self, ParameterError>;

    /// False when `role` keeps what the others rely on, so that one started anew in the midst of
    /// a run would be wrong about the world: a topology may not ask for its restart then.
    fn may_restart(_parameters: &Self::Parameters, _role: &str) -> bool {
        true
    }

    /// A fresh instance of the role called `name`; `None` if the case has no such role.
    fn role(&self, name: &str) -> Option<Box<dyn Role>>;

    /// What the check of these parameters leaves open or warns of, in words without full stop; nothing by default.
    fn undecided(&self) -> Option<String> {
        None
    }

    /// What the robot did, from the messages of a finished run; by default the mean of each of its errors.
    fn score(&self, log: &RunLog) -> Score {
        Score {
            metrics: self
                .errors(log)
                .iter()
                .map(|error| error.mean(log))
                .collect(),
            ..Score::default()
        }
    }

    /// What finds the robot's events while the run goes; nothing by default.
    fn live_events(&self) -> Option<Box<dyn LiveEvents>> {
        None
    }

    /// The robot's errors over time, to be held against what the network did at the time; none by
    /// default, and then only the events of the score are.
    fn errors(&self, _log: &RunLog) -> Vec<ErrorSeries> {
        Vec::new()
    }

    /// What a plot of the finished run shows, for the run's folder; nothing by default.
    fn series(&self, _log: &RunLog) -> Vec<PlotSeries> {
        Vec::new()
    }

    /// Runs the robot's side again in virtual time, from what it heard in the finished run, and
    /// holds its messages against the recorded ones; `None`, whatever the log, for a case that
    /// cannot.
    fn replay(&self, _log: &RunLog) -> Option<Replay> {
        None
    }

    /// What finds the link parameters under which the figure called `figure` comes out as
    /// `value`; `None` for a case, or a figure, without such a search.
    ///
    /// # Errors
    /// When the value is outside what the figure can take.
    fn calibration(
        &self,
        _figure: &str,
        _value: f64,
    ) -> Result<Option<Box<dyn Batch>>, ParameterError> {
        Ok(None)
    }

    /// The tables this case can compute in virtual time, of the size its parameters ask for, with rows for the
    /// `recorded` runs; `None` for a case without any.
    ///
    /// # Errors
    /// Names the parameter that keeps the tables from being computed, or the run that can be no row of them.
    fn study(
        &self,
        _recorded: Vec<RecordedRun<Self::Parameters>>,
    ) -> Result<Option<Box<dyn Batch>>, StudyRefusal> {
        Ok(None)
    }
}

/// One channel of a case study: who publishes what to whom, or only to the record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChannelSpec {
    /// Name, also of the shared-memory service, e.g. `egm/right/command`.
    pub name: &'static str,
    /// What it carries.
    pub message: MessageType,
    /// The role that publishes.
    pub from: &'static str,
    /// The role that subscribes; `None` when the messages only go to the run's record, for the
    /// score. Such a channel is in no shared memory and crosses no link.
    pub to: Option<&'static str>,
}

impl ChannelSpec {
    /// The channel `name` carrying `M` from one role to another.
    pub const fn of<M: Message>(name: &'static str, from: &'static str, to: &'static str) -> Self {
        Self {
            name,
            message: MessageType::of::<M>(),
            from,
            to: Some(to),
        }
    }

    /// The channel `name` on which a role tells the record, and nobody else, what only a score
    /// may know: a model's true state, say.
    pub const fn recorded<M: Message>(name: &'static str, from: &'static str) -> Self {
        Self {
            name,
            message: MessageType::of::<M>(),
            from,
            to: None,
        }
    }

    /// True when the messages go to the run's record only.
    pub const fn is_recorded_only(&self) -> bool {
        self.to.is_none()
    }
}

/// What `channels` of the case called `case` state for `role`.
pub fn channels_of(case: &str, channels: &[ChannelSpec], role: &str) -> RoleChannels {
    let stated = |is_end: &dyn Fn(&ChannelSpec) -> bool| {
        let channels = channels.iter().filter(|channel| is_end(channel));
        let stated = channels.map(|channel| StatedChannel {
            name: channel.name.to_owned(),
            message: TypeInfo::of(&channel.message),
        });
        stated.collect()
    };
    RoleChannels {
        role: role.to_owned(),
        stated_by: format!("case {case}"),
        inputs: stated(&|channel| channel.to == Some(role)),
        outputs: stated(&|channel| channel.from == role),
    }
}

/// A parameter that the case cannot work with.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key} {problem}")]
pub struct ParameterError {
    /// Key below `[case.parameters]`; dots lead into tables.
    pub key: String,
    /// What is wrong with it, with its value and what it may be.
    pub problem: String,
}

impl ParameterError {
    /// The parameter `key` has a problem that is more than a number outside its range.
    pub fn new(key: &str, problem: impl Into<String>) -> Self {
        Self {
            key: key.to_owned(),
            problem: problem.into(),
        }
    }

    /// `Ok` when `value` lies in `allowed`; NaN never does.
    ///
    /// # Errors
    /// Names the key, the value and the text `allowed_text`.
    pub fn check(
        key: &str,
        value: f64,
        allowed: core::ops::RangeInclusive<f64>,
        allowed_text: &str,
    ) -> Result<(), Self> {
        if allowed.contains(&value) {
            return Ok(());
        }
        Err(Self::new(key, format!("{value} is outside {allowed_text}")))
    }

    /// The same error, seen from the table that has this one as `table`.
    #[must_use]
    pub fn below(self, table: &str) -> Self {
        Self {
            key: format!("{table}.{}", self.key),
            ..self
        }
    }
}
