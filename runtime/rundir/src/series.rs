//! A case's series as files: one CSV file each and a list that says what their columns are. It
//! computes no number and draws no plot.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use hil_core::plot::PlotSeries;
use serde::{Deserialize, Serialize};

/// The file that lists the others.
const LIST: &str = "series.json";

/// A series without its numbers.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeriesEntry {
    /// The file's name without its ending.
    pub name: String,
    /// What it shows, one line.
    pub title: String,
    /// How it was made; one line each.
    pub(crate) notes: Vec<String>,
    /// Rows of its file, below the one that names the columns.
    pub(crate) row_count: usize,
    /// Lines that belong together in a panel of its picture, in the order of the columns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub panel_lines: Option<usize>,
    /// The columns of its file.
    pub columns: Vec<SeriesColumn>,
}

/// One column.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeriesColumn {
    /// Snake-case name with unit suffix, as in the first line of the file.
    pub name: String,
    /// Its unit; `1` for a ratio or a number.
    pub unit: String,
    /// What it is, in words.
    pub label: String,
}

impl SeriesEntry {
    fn of(series: &PlotSeries) -> Self {
        let columns = series.columns.iter().map(|column| SeriesColumn {
            name: column.name.to_owned(),
            unit: column.unit.to_owned(),
            label: column.label.to_owned(),
        });
        Self {
            name: series.name.clone(),
            title: series.title.clone(),
            notes: series.notes.clone(),
            row_count: series.rows().count(),
            panel_lines: series.panel_lines,
            columns: columns.collect(),
        }
    }
}

/// Why a series could not be written.
#[derive(Debug, thiserror::Error)]
pub enum SeriesError {
    /// Its name is no file name.
    #[error("series {name:?} cannot be a file: a name has letters, digits, - and _ only")]
    Name {
        /// The name.
        name: String,
    },
    /// Two series share a name.
    #[error("two series are called {name}")]
    Twice {
        /// The name.
        name: String,
    },
    /// Its values do not fill whole rows.
    #[error("series {name} has {value_count} values for {column_count} columns")]
    Shape {
        /// Its name.
        name: String,
        /// Values in all.
        value_count: usize,
        /// Columns.
        column_count: usize,
    },
    /// A file could not be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

/// Writes `series` to `folder`, which is made if it is not there, and gives their names; each is
/// dropped once it is written. Without any series nothing is made.
///
/// # Errors
/// For the first series that is not fit to be a table, before anything is written, or the first
/// file that cannot be written.
pub fn write(folder: &Path, series: Vec<PlotSeries>) -> Result<Vec<String>, SeriesError> {
    let mut names = BTreeSet::new();
    for one in &series {
        check(one)?;
        if !names.insert(one.name.as_str()) {
            let name = one.name.clone();
            return Err(SeriesError::Twice { name });
        }
    }
    if series.is_empty() {
        return Ok(Vec::new());
    }
    fs::create_dir_all(folder).map_err(at(folder))?;
    let mut entries = Vec::new();
    for one in series {
        entries.push(SeriesEntry::of(&one));
        let file = folder.join(format!("{}.csv", one.name));
        if let Err(error) = write_table(&file, &one) {
            // Half a table would pass for a short one; the error that is told is the first one.
            let _left = fs::remove_file(&file).is_err();
            return Err(at(&file)(error));
        }
    }
    let path = folder.join(LIST);
    let text = serde_json::to_string_pretty(&entries).map_err(|error| at(&path)(error.into()))?;
    fs::write(&path, text + "\n").map_err(at(&path))?;
    Ok(entries.into_iter().map(|entry| entry.name).collect())
}

/// The list of the series in `folder`, in the order of the case; none where there is no list.
///
/// # Errors
/// When there is one that cannot be read.
pub fn list(folder: &Path) -> io::Result<Vec<SeriesEntry>> {
    match fs::read_to_string(folder.join(LIST)) {
        Ok(text) => Ok(serde_json::from_str(&text)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error),
    }
}

fn at(path: &Path) -> impl Fn(io::Error) -> SeriesError + use<> {
    let path = path.to_owned();
    move |source| SeriesError::Write {
        path: path.clone(),
        source,
    }
}

fn check(series: &PlotSeries) -> Result<(), SeriesError> {
    let is_fit = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    if series.name.is_empty() || !series.name.bytes().all(is_fit) {
        let name = series.name.clone();
        return Err(SeriesError::Name { name });
    }
    let (value_count, column_count) = (series.values.len(), series.columns.len());
    if column_count == 0 || !value_count.is_multiple_of(column_count) {
        return Err(SeriesError::Shape {
            name: series.name.clone(),
            value_count,
            column_count,
        });
    }
    Ok(())
}

fn write_table(path: &Path, series: &PlotSeries) -> io::Result<()> {
    let mut out = BufWriter::new(File::create(path)?);
    let names: Vec<_> = series.columns.iter().map(|column| column.name).collect();
    write!(out, "{}\r\n", names.join(","))?;
    for row in series.rows() {
        for (index, value) in row.iter().enumerate() {
            if index > 0 {
                out.write_all(b",")?;
            }
            if value.is_finite() {
                write!(out, "{value}")?;
            }
        }
        out.write_all(b"\r\n")?;
    }
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::plot::PlotColumn;

    fn series(name: &str, values: Vec<f64>) -> PlotSeries {
        let column = |name, label, unit| PlotColumn { name, label, unit };
        PlotSeries {
            name: name.to_owned(),
            title: "Tool position over time".to_owned(),
            notes: vec!["right arm, every cycle".to_owned()],
            panel_lines: None,
            columns: vec![
                column("time_s", "time since the start of the run", "s"),
                column("tool_y_m", "|y| of the tool", "m"),
            ],
            values,
        }
    }

    fn folder(name: &str) -> PathBuf {
        std::env::temp_dir().join(format!("hil-series-{name}-{}", std::process::id()))
    }

    #[test]
    fn a_series_becomes_a_table_and_an_entry_of_the_list() {
        let folder = folder("table");
        let third = 1.0 / 3.0;
        let values = vec![0.0, 1e-9, 0.004, f64::NAN, third, -2.5];
        let written = write(&folder, vec![series("tool", values)]).unwrap();
        assert_eq!(written, ["tool"]);
        let text = fs::read_to_string(folder.join("tool.csv")).unwrap();
        assert_eq!(
            text,
            "time_s,tool_y_m\r\n0,0.000000001\r\n0.004,\r\n0.3333333333333333,-2.5\r\n"
        );
        let last = text.lines().nth(3).unwrap().split(',').next().unwrap();
        assert_eq!(last.parse::<f64>().unwrap().to_bits(), third.to_bits());
        let entries = list(&folder).unwrap();
        assert_eq!(entries.len(), 1);
        assert_eq!(entries[0].title, "Tool position over time");
        assert_eq!(entries[0].row_count, 3);
        assert_eq!(entries[0].notes, ["right arm, every cycle"]);
        let column = &entries[0].columns[1];
        assert_eq!(
            (column.name.as_str(), column.unit.as_str()),
            ("tool_y_m", "m")
        );
        assert_eq!(column.label, "|y| of the tool");
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn what_is_no_table_is_refused_before_anything_is_written() {
        let folder = folder("refused");
        let good = || series("tool", vec![0.0, 1.0]);
        for (bad, expected) in [
            (
                series("../tool", vec![]),
                "series \"../tool\" cannot be a file: a name has letters, digits, - and _ only",
            ),
            (good(), "two series are called tool"),
            (
                series("odd", vec![0.0; 3]),
                "series odd has 3 values for 2 columns",
            ),
        ] {
            let error = write(&folder, vec![good(), bad]).unwrap_err();
            assert_eq!(error.to_string(), expected);
        }
        assert!(!folder.exists());
        assert!(write(&folder, Vec::new()).unwrap().is_empty());
        assert!(!folder.exists());
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let folder = folder("taken");
        fs::create_dir_all(folder.join("tool.csv")).unwrap();
        let error = write(&folder, vec![series("tool", vec![])]).unwrap_err();
        assert!(error.to_string().contains("tool.csv"), "{error}");
        fs::remove_dir_all(folder).unwrap();
    }
}
