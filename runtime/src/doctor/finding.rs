//! One line of the doctor's report. It holds words only; each examiner keeps its own thresholds.

use serde::{Deserialize, Serialize};

use crate::host_facts::Fact;

/// How a finding bears on a measurement. Later is worse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// As it should be.
    Good,
    /// Costs something, or could not be found out; a careful reader wants to know.
    Note,
    /// Spoils a measurement or prevents a run.
    Problem,
}

/// What the doctor found about one thing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Stable identifier for scripts, for example `realtime_throttle`.
    pub id: String,
    /// What was looked at.
    pub title: String,
    /// The judgement.
    pub state: State,
    /// What was seen, with its unit.
    pub value: String,
    /// What it means for a measurement; empty when all is well.
    pub why: String,
    /// What to do about it; empty when all is well.
    pub fix: String,
}

impl Finding {
    pub(crate) fn new(id: &str, title: &str, state: State, value: impl Into<String>) -> Self {
        Self {
            id: id.to_owned(),
            title: title.to_owned(),
            state,
            value: value.into(),
            why: String::new(),
            fix: String::new(),
        }
    }

    pub(crate) fn good(id: &str, title: &str, value: impl Into<String>) -> Self {
        Self::new(id, title, State::Good, value)
    }

    pub(crate) fn note(id: &str, title: &str, value: impl Into<String>) -> Self {
        Self::new(id, title, State::Note, value)
    }

    pub(crate) fn problem(id: &str, title: &str, value: impl Into<String>) -> Self {
        Self::new(id, title, State::Problem, value)
    }

    /// Good when `is_good`, else a note.
    pub(crate) fn note_unless(
        is_good: bool,
        id: &str,
        title: &str,
        value: impl Into<String>,
    ) -> Self {
        Self::new(
            id,
            title,
            if is_good { State::Good } else { State::Note },
            value,
        )
    }

    /// Something the host did not say: a note, never a pass.
    pub(crate) fn unknown(id: &str, title: &str, reason: &str) -> Self {
        let fact: Fact<String> = Fact::Unavailable(reason.to_owned());
        Self::note(id, title, fact.to_text())
            .because("the host does not tell, so this was not checked")
            .fixed_by("look it up by hand if the result depends on it")
    }

    pub(crate) fn because(mut self, why: impl Into<String>) -> Self {
        self.why = why.into();
        self
    }

    pub(crate) fn fixed_by(mut self, fix: impl Into<String>) -> Self {
        self.fix = fix.into();
        self
    }

    /// Drops the explanation of a finding that turned out good.
    pub(crate) fn quiet_when_good(mut self) -> Self {
        if self.state == State::Good {
            self.why.clear();
            self.fix.clear();
        }
        self
    }
}
