//! One line of the doctor's report. It holds words only; each examiner keeps its own thresholds.

use hil_platform::host_facts::Fact;
use serde::{Deserialize, Serialize};

use super::catalogue;

hil_core::labelled! {
    /// How a finding bears on a measurement. Later is worse.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Severity, word {
        /// As it should be.
        Ok = "ok",
        /// Costs something that a careful reader wants to know of.
        Note = "note",
        /// Could not be read; the value says why. Never taken for ok.
        CannotTell = "cannot_tell",
        /// Spoils figures in microseconds, or a run as the topology wants it.
        Warning = "warning",
        /// Prevents a run, or makes its figures wrong.
        Error = "error",
    }
}

impl Severity {
    /// Ok where `is_ok`.
    pub(super) const fn ok_if(is_ok: bool, otherwise: Self) -> Self {
        if is_ok { Self::Ok } else { otherwise }
    }

    /// Ok up to `ok_max`, a note up to `note_max`, a warning above.
    pub(super) fn rising<T: PartialOrd + Copy>(value: T, ok_max: T, note_max: T) -> Self {
        if value > note_max {
            Self::Warning
        } else {
            Self::ok_if(value <= ok_max, Self::Note)
        }
    }
}

/// What the doctor found about one thing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Stable identifier for scripts, for example `realtime_throttle`; of several of a kind with the
    /// name of the one, `radio.wlan0`. `docs/doctor.md` lists them.
    pub id: String,
    /// What was looked at.
    pub title: String,
    /// The judgement.
    pub severity: Severity,
    /// What was seen, with its unit; or why nothing was.
    pub value: String,
    /// Where it was read.
    pub source: String,
    /// What it means for a measurement.
    pub why: String,
    /// What to do about it.
    pub fix: String,
}

impl Finding {
    /// A finding of the catalogue.
    ///
    /// # Panics
    /// When the catalogue has no `id`: a finding that nobody documented.
    pub(super) fn new(id: &str, severity: Severity, value: impl Into<String>) -> Self {
        let entry = catalogue::entry(id).expect("every finding is in the catalogue");
        Self {
            id: id.to_owned(),
            title: entry.title.to_owned(),
            severity,
            value: value.into(),
            source: entry.source.to_owned(),
            why: entry.why.to_owned(),
            fix: entry.fix.to_owned(),
        }
    }

    pub(super) fn ok(id: &str, value: impl Into<String>) -> Self {
        Self::new(id, Severity::Ok, value)
    }

    pub(super) fn note(id: &str, value: impl Into<String>) -> Self {
        Self::new(id, Severity::Note, value)
    }

    pub(super) fn warning(id: &str, value: impl Into<String>) -> Self {
        Self::new(id, Severity::Warning, value)
    }

    pub(super) fn error(id: &str, value: impl Into<String>) -> Self {
        Self::new(id, Severity::Error, value)
    }

    /// Something the host did not say, and why.
    pub(super) fn cannot_tell(id: &str, reason: impl Into<String>) -> Self {
        Self::new(id, Severity::CannotTell, reason)
    }

    /// It is about this one of several.
    pub(super) fn of(mut self, which: &str) -> Self {
        self.id = format!("{}.{which}", self.id);
        self.title = format!("{} {which}", self.title);
        self.source = self.source.replace("{}", which);
        self.fix = self.fix.replace("{}", which);
        self
    }

    /// What it means here, in place of the catalogue's words.
    pub(super) fn because(mut self, why: impl Into<String>) -> Self {
        self.why = why.into();
        self
    }

    /// The cure here, in place of the catalogue's.
    pub(super) fn fixed_by(mut self, fix: impl Into<String>) -> Self {
        self.fix = fix.into();
        self
    }

    /// Where it was read this time.
    pub(super) fn read_from(mut self, source: impl Into<String>) -> Self {
        self.source = source.into();
        self
    }
}

/// A check that ends early with a [`Severity::CannotTell`] where the host gives no answer.
pub(super) type Checked = Result<Finding, Box<Finding>>;

/// The finding of a check, however it ended.
pub(super) fn settled(checked: Checked) -> Finding {
    checked.unwrap_or_else(|unknown| *unknown)
}

/// An answer of the host, or the reason why there is none.
pub(super) trait Answer<T>: Sized {
    /// The answer, or the reason.
    fn known(self) -> Result<T, String>;

    /// The answer, or the finding `id` with the reason.
    fn told(self, id: &str) -> Result<T, Box<Finding>> {
        self.told_as(id, |reason| reason)
    }

    /// As [`Self::told`], with other words around the reason.
    fn told_as(self, id: &str, words: impl Fn(String) -> String) -> Result<T, Box<Finding>> {
        let unknown = |reason| Box::new(Finding::cannot_tell(id, words(reason)));
        self.known().map_err(unknown)
    }
}

impl<T> Answer<T> for Fact<T> {
    fn known(self) -> Result<T, String> {
        match self {
            Self::Available(answer) => Ok(answer),
            Self::Unavailable(reason) => Err(reason),
        }
    }
}

impl<T, E: Into<String>> Answer<T> for Result<T, E> {
    fn known(self) -> Result<T, String> {
        self.map_err(Into::into)
    }
}
