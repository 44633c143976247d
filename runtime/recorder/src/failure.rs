//! Why a command ended without its result.

/// Exit codes, as `--help` lists them; those of `hil-runtime`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    /// All was done.
    Done = 0,
    /// It could not be done, or not all of it.
    Failed = 1,
    /// Wrong arguments, or nothing there that fits them.
    Usage = 2,
    /// The fault is in this program.
    Internal = 70,
    /// A signal came.
    Interrupted = 130,
}

/// What went wrong, in words for the user, and the exit code of it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{words}")]
pub(crate) struct Failure {
    /// The exit code.
    pub(crate) exit: Exit,
    /// The words.
    pub(crate) words: String,
}

#[allow(clippy::needless_pass_by_value, reason = "an error that is given up")]
impl Failure {
    /// The work could not be done.
    pub(crate) fn failed(what: impl ToString) -> Self {
        Self::new(Exit::Failed, what)
    }

    /// What was asked for is not there, or not to be had like this.
    pub(crate) fn usage(what: impl ToString) -> Self {
        Self::new(Exit::Usage, what)
    }

    /// A signal came.
    pub(crate) fn interrupted(what: impl ToString) -> Self {
        Self::new(Exit::Interrupted, what)
    }

    fn new(exit: Exit, what: impl ToString) -> Self {
        let words = what.to_string();
        Self { exit, words }
    }
}
