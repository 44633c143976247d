//! What a plot shows: columns of numbers with names, units and a word on how they came about. It
//! draws nothing and writes no file.

use core::fmt::Write;

/// A table of numbers, one row per moment or thing, ready to be plotted.
#[derive(Debug, Clone, PartialEq)]
pub struct PlotSeries {
    /// Short name without blanks: the file it is written to.
    pub name: String,
    /// What it shows, one line.
    pub title: String,
    /// How it was made; one line each.
    pub notes: Vec<String>,
    /// Lines that belong together in a panel of its picture, in the order of the columns; `None`: as many as a panel takes.
    pub panel_lines: Option<usize>,
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

/// `text`, e.g. the name of a channel, as a part of a file's name and of an identifier. Different texts differ: a
/// slash is a hyphen, and what is neither letter nor digit an underscore with itself or its bytes.
pub fn name_part(text: &str) -> String {
    let mut name = String::with_capacity(text.len());
    for byte in text.bytes() {
        match byte {
            b'/' => name.push('-'),
            b'-' | b'_' => name.extend(['_', char::from(byte)]),
            _ if byte.is_ascii_alphanumeric() => name.push(char::from(byte)),
            _ => {
                let _infallible = write!(name, "_{byte:02x}");
            }
        }
    }
    name
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_differ_have_files_that_differ() {
        let names = [
            "a/b", "a-b", "a.b", "a_b", "a2eb", "a_-b", "a/-b", "a-/b", "a//b", "a__b", "aµb",
        ];
        let parts = names.map(name_part);
        assert_eq!(parts[..4], ["a-b", "a_-b", "a_2eb", "a__b"]);
        let different: std::collections::BTreeSet<_> = parts.iter().collect();
        assert_eq!(different.len(), names.len(), "{parts:?}");
        assert_eq!(name_part("egm/right/command"), "egm-right-command");
    }
}
