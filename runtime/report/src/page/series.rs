//! Series over time, read from CSV and thinned for a page: each step of the axis keeps the smallest
//! and the largest value within it, so that no peak is lost. It reads no file.

use core::ops::Range;

use serde::Serialize;

use hil_rundir::series::{SeriesColumn, SeriesEntry};

/// A table of numbers with named columns.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Series {
    /// The file's name without its ending.
    pub(crate) name: String,
    /// What it shows, from the folder's list; empty when that does not say.
    pub(crate) title: String,
    pub(crate) columns: Vec<SeriesColumn>,
    /// Lines that belong together in a panel.
    pub(crate) panel_lines: Option<usize>,
    /// Rows; each has a value or none per column.
    pub(crate) rows: Vec<Vec<Option<f64>>>,
}

/// Reads RFC 4180 as this program writes it: no quotes, one number or nothing per field.
///
/// # Errors
/// Names the line and the field that is no number, or the line with another number of fields.
pub(crate) fn parse(name: &str, text: &str) -> Result<Series, String> {
    let mut lines = text.lines();
    let header = lines.next().filter(|line| !line.is_empty());
    let header = header.ok_or_else(|| "line 1 names no columns".to_owned())?;
    let columns: Vec<SeriesColumn> = header
        .split(',')
        .map(|name| SeriesColumn {
            name: name.trim().to_owned(),
            ..SeriesColumn::default()
        })
        .collect();
    let mut rows = Vec::new();
    for (index, line) in lines.enumerate() {
        let row = line.split(',').map(|field| match field.trim() {
            "" => Ok(None),
            field => {
                let number = field.parse::<f64>();
                let number = number
                    .map_err(|_error| format!("line {}: {field:?} is not a number", index + 2))?;
                Ok(Some(number).filter(|number| number.is_finite()))
            }
        });
        let row = row.collect::<Result<Vec<_>, String>>()?;
        if row.len() != columns.len() {
            let (line, found, expected) = (index + 2, row.len(), columns.len());
            return Err(format!("line {line}: {found} fields, not {expected}"));
        }
        rows.push(row);
    }
    Ok(Series {
        name: name.to_owned(),
        columns,
        panel_lines: None,
        rows,
        title: String::new(),
    })
}

impl Series {
    /// Puts what the folder's list says of it beside the columns.
    pub(crate) fn describe(&mut self, entry: SeriesEntry) {
        self.title = entry.title;
        self.panel_lines = entry.panel_lines.filter(|lines| *lines > 0);
        for described in entry.columns {
            let column = self
                .columns
                .iter_mut()
                .find(|one| one.name == described.name);
            if let Some(column) = column {
                *column = described;
            }
        }
    }

    /// The place of a column.
    pub(crate) fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|column| column.name == name)
    }

    /// Time and value of a column, where both are.
    pub(crate) fn points(&self, column: usize) -> impl Iterator<Item = (f64, f64)> + '_ {
        let row = move |row: &Vec<Option<f64>>| Some(((*row.first()?)?, (*row.get(column)?)?));
        self.rows.iter().filter_map(row)
    }
}

/// A series thinned to steps of one axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Thinned {
    /// What it is, for a legend.
    pub(crate) name: String,
    /// The channel that it belongs to; empty for the robot's.
    pub(crate) channel: String,
    /// Largest value of each step; `None` where there was none.
    pub(crate) high: Vec<Option<f64>>,
    /// Smallest value of each step; empty where it is the largest throughout.
    pub(crate) low: Vec<Option<f64>>,
}

/// Thins points to `count` steps of `span`.
pub(crate) fn thinned(
    name: &str,
    channel: &str,
    points: impl Iterator<Item = (f64, f64)>,
    span: &Range<f64>,
    count: usize,
) -> Thinned {
    let mut high: Vec<Option<f64>> = vec![None; count];
    let mut low = high.clone();
    let scale = count as f64 / (span.end - span.start).max(f64::MIN_POSITIVE);
    for (at, value) in points {
        let index = step_of((at - span.start) * scale, count);
        let Some(index) = index.filter(|_| value.is_finite()) else {
            continue;
        };
        let value = four_digits(value);
        high[index] = Some(high[index].map_or(value, |old: f64| old.max(value)));
        low[index] = Some(low[index].map_or(value, |old: f64| old.min(value)));
    }
    if low == high {
        low.clear();
    }
    Thinned {
        name: name.to_owned(),
        channel: channel.to_owned(),
        high,
        low,
    }
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "checked to be within 0..count before"
)]
fn step_of(place: f64, count: usize) -> Option<usize> {
    // The end of the axis belongs to its last step.
    let is_within = place >= 0.0 && place <= count as f64 + 1e-9;
    (is_within && count > 0).then(|| (place as usize).min(count - 1))
}

/// Enough for a read-out, and short.
fn four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

/// What the page's cursor reads: panels over one axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Plot {
    /// Axes with the same word move together.
    pub(crate) axis: String,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    pub(crate) panels: Vec<PlotPanel>,
}

/// One panel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PlotPanel {
    pub(crate) title: String,
    /// `s`, `share`, or what the values are in.
    pub(crate) unit: String,
    pub(crate) series: Vec<Thinned>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_gaps_are_read_and_faults_are_named() {
        let series = parse("x", "time_s,a\r\n0,1.5\r\n1,\r\n2,NaN\r\n").unwrap();
        assert_eq!(series.rows[1], [Some(1.0), None]);
        assert_eq!(series.points(1).collect::<Vec<_>>(), [(0.0, 1.5)]);
        for (text, expected) in [
            ("", "line 1 names no columns"),
            ("a,b\n1,x\n", "line 2: \"x\" is not a number"),
            ("a,b\n1,2\n1\n", "line 3: 1 fields, not 2"),
        ] {
            assert_eq!(parse("x", text).unwrap_err(), expected);
        }
        assert!(parse("x", "a,b\n").unwrap().rows.is_empty());
    }

    #[test]
    fn thinning_keeps_every_peak_and_every_gap() {
        let mut values: Vec<f64> = (0..100_000).map(|index| f64::from(index % 7)).collect();
        values[77_777] = 900.0;
        values[12_345] = -900.0;
        let points = values.iter().enumerate();
        let points = points.map(|(index, value)| (index as f64 * 0.001, *value));
        let thin = thinned(
            "a",
            "",
            points.filter(|(at, _)| *at < 90.0),
            &(0.0..100.0),
            300,
        );
        assert_eq!((thin.high.len(), thin.low.len()), (300, 300));
        assert_eq!(thin.high[233], Some(900.0));
        assert_eq!(thin.low[37], Some(-900.0));
        assert_eq!(thin.high[299], None);
        let thin = thinned(
            "a",
            "",
            [(1.0, 2.0), (5.0, 3.0)].into_iter(),
            &(0.0..5.0),
            5,
        );
        assert!(thin.low.is_empty());
        assert_eq!(thin.high, [None, Some(2.0), None, None, Some(3.0)]);
        let none = thinned("a", "", [(9.0, 1.0)].into_iter(), &(0.0..5.0), 2);
        assert_eq!(none.high, [None, None]);
    }
}
