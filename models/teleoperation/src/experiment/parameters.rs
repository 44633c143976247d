//! `[case.parameters.tables]` of the teleoperation case and its ranges.

use serde::{Deserialize, Serialize};

use hil_core::case_study::ParameterError;

/// `[case.parameters.tables]`: the size of what `hil-runtime tables` and `calibrate` compute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TableParameters {
    /// Motion loops per run, 5..=2000; the seed paper played 890.
    pub loops: u32,
    /// Runs per condition, each with a seed of its own, 1..=1000.
    pub seeds: u32,
    /// Only conditions whose name contains one of these, each of which must be part of one; empty
    /// for all.
    pub conditions: Vec<String>,
}

impl Default for TableParameters {
    fn default() -> Self {
        Self {
            loops: 890,
            seeds: 12,
            conditions: Vec::new(),
        }
    }
}

impl TableParameters {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        ParameterError::check(
            "tables.loops",
            f64::from(self.loops),
            5.0..=2000.0,
            "5 to 2000",
        )?;
        ParameterError::check(
            "tables.seeds",
            f64::from(self.seeds),
            1.0..=1000.0,
            "1 to 1000",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_outside_their_range_are_refused_by_name() {
        let refused = |change: fn(&mut TableParameters)| {
            let mut parameters = TableParameters::default();
            change(&mut parameters);
            parameters.check().unwrap_err().key
        };
        assert_eq!(refused(|p| p.loops = 4), "tables.loops");
        assert_eq!(refused(|p| p.loops = 2001), "tables.loops");
        assert_eq!(refused(|p| p.seeds = 0), "tables.seeds");
        assert_eq!(TableParameters::default().check(), Ok(()));
    }
}
