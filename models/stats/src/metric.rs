//! Metrics of a score by their label. It computes none of them.

use super::series::Estimate;
use hil_core::score::Metric;

/// What a metric is called.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Label {
    /// Its name in files.
    pub name: &'static str,
    /// Its name in tables.
    pub text: &'static str,
    /// Its unit; `1` for counts and ratios.
    pub unit: &'static str,
    /// What a reader holds it against; see [`Metric::note`].
    pub note: &'static str,
}

/// The label of a metric.
pub const fn label(name: &'static str, text: &'static str, unit: &'static str) -> Label {
    Label {
        name,
        text,
        unit,
        note: "",
    }
}

impl Label {
    /// The same with what a reader holds it against.
    #[must_use]
    pub const fn held_against(mut self, note: &'static str) -> Self {
        self.note = note;
        self
    }

    /// The metric with this value.
    pub fn known(self, value: f64, method: impl Into<String>) -> Metric {
        Metric {
            name: self.name,
            label: self.text,
            value: Some(value),
            interval: None,
            unit: self.unit,
            method: method.into(),
            note: self.note,
        }
    }

    /// The metric without a value.
    pub fn unavailable(self, why: impl Into<String>) -> Metric {
        Metric {
            value: None,
            ..self.known(0.0, why)
        }
    }

    /// The metric with this value; `missing` says why there is no finite one.
    pub fn measured(self, value: Option<f64>, method: impl Into<String>, missing: &str) -> Metric {
        match value.filter(|value| value.is_finite()) {
            Some(value) => self.known(value, method),
            None => self.unavailable(missing),
        }
    }

    /// The metric with this value and its interval.
    pub fn estimated(
        self,
        estimate: Option<Estimate>,
        method: impl Into<String>,
        missing: &str,
    ) -> Metric {
        Metric {
            interval: estimate.map(|known| known.interval),
            ..self.measured(estimate.map(|known| known.value), method, missing)
        }
    }

    /// The metric with this count; without one nothing was recorded.
    pub fn count(self, count: impl Into<Option<u64>>, method: impl Into<String>) -> Metric {
        let value = count.into().map(|count| count as f64);
        self.measured(value, method, "nothing was recorded")
    }
}
