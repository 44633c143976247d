//! What a replay of a finished run came to: the same messages, or where they differ.

use serde::Serialize;

/// The comparison of a replay with its run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Replay {
    /// What was run again and what was compared, one line.
    pub method: String,
    /// Messages that went in.
    pub input_count: u64,
    /// Recorded messages that were compared.
    pub compared_count: u64,
    /// Of these, those the replay gave otherwise, or not at all.
    pub different_count: u64,
    /// The first of them, in words.
    pub first_difference: Option<String>,
    /// Why the replay cannot be trusted, e.g. records that are missing; empty when it can.
    pub gaps: Vec<String>,
}

impl Replay {
    /// True when something was compared, nothing differed and nothing was missing.
    pub fn is_identical(&self) -> bool {
        self.compared_count > 0 && self.different_count == 0 && self.gaps.is_empty()
    }
}
