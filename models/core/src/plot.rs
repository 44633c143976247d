//! What a plot shows: columns of numbers with names, units and a word on how they came about. It
//! draws nothing and writes no file.

/// A table of numbers, one row per moment or thing, ready to be plotted.
#[derive(Debug, Clone, PartialEq)]
pub struct PlotSeries {
    /// Short name without blanks: the file it is written to.
    pub name: String,
    /// What it shows, one line.
    pub title: String,
    /// How it was made; one line each.
    pub notes: Vec<String>,
    /// Its columns.
    pub columns: Vec<PlotColumn>,
    /// Row after row, each with one number per column; NaN where there is none.
    pub values: Vec<f64>,
}

/// One column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlotColumn {
    /// Snake-case name with unit suffix.
    pub name: &'static str,
    /// What it is, in words.
    pub label: &'static str,
    /// Its unit; `1` for a ratio or a number.
    pub unit: &'static str,
}

impl PlotSeries {
    /// The rows.
    ///
    /// # Panics
    /// When there are no columns.
    pub fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.values.chunks_exact(self.columns.len())
    }
}
