//! Metrics, or a table, as rows of RFC 4180.

use crate::model::{Cell, Metric, Section, Table};
use crate::units::JOINT;

/// The first line of every table.
pub const HEADER: &str = "run,channel,figure,value,unit,low,high,method\r\n";

/// A row for every metric of the sections of `run`. One that has no value has an empty value and the reason
/// as its method.
pub fn rows(run: &str, sections: &[Section]) -> String {
    let all = sections.iter().flat_map(Section::metrics);
    all.map(|(subject, metric)| row(run, subject, metric))
        .collect()
}

fn row(run: &str, subject: &str, metric: &Metric) -> String {
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    let unit = if metric.unit == "share" {
        "1"
    } else {
        &metric.unit
    };
    let why = match metric.interval.as_str() {
        why if metric.low.is_none() && !why.is_empty() => format!("no interval: {why}"),
        _ => String::new(),
    };
    let method = [metric.method.as_str(), why.as_str()];
    let method = method.into_iter().filter(|one| !one.is_empty());
    let method = method.collect::<Vec<_>>().join("; ");
    let fields = [
        run.to_owned(),
        subject.to_owned(),
        metric.name.clone(),
        number(metric.value),
        unit.to_owned(),
        number(metric.low),
        number(metric.high),
        method,
    ];
    fields.map(|field| quoted(&field)).join(",") + "\r\n"
}

/// A table: a line of its columns' keys, then its rows with numbers at full precision, a range as two columns.
pub fn table(table: &Table) -> String {
    let is_range = |index: usize| {
        let mut cells = table.rows.iter().filter_map(|row| row.cells.get(index));
        cells.any(|cell| matches!(cell, Cell::Range { .. }))
    };
    let ranges: Vec<bool> = (0..table.columns.len()).map(is_range).collect();
    let head = table.columns.iter().zip(&ranges);
    let head = head.flat_map(|(column, is_range)| match (&column.key, is_range) {
        (key, true) => vec![format!("{key}_low"), format!("{key}_high")],
        (key, false) => vec![key.clone()],
    });
    let mut text = head.collect::<Vec<_>>().join(",") + "\r\n";
    for row in &table.rows {
        let fields = row.cells.iter().zip(&ranges);
        let fields = fields.flat_map(|(cell, is_range)| match (cell, cell.for_program()) {
            (Cell::Range { low, high, .. }, _) => vec![low.to_string(), high.to_string()],
            (Cell::Missing, _) if *is_range => vec![String::new(), String::new()],
            (Cell::Missing, _) => vec![String::new()],
            (_, Some((value, _))) => vec![value.to_string()],
            (cell, None) => vec![quoted(&cell.text())],
        });
        text += &(fields.collect::<Vec<_>>().join(",") + "\r\n");
    }
    text
}

fn quoted(field: &str) -> String {
    let field = field.replace(JOINT, " ");
    // A spreadsheet would take these for formulas.
    let is_formula = field.starts_with(['=', '@', '+']);
    let field = if is_formula {
        format!("'{field}")
    } else {
        field
    };
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_a_table_keep_their_precision_and_quote_their_commas() {
        let mut sample = Table::new("", &["row", "count", "ratio"]);
        let range = Cell::Range {
            low: 0.125,
            high: 0.5,
            decimals: 2,
        };
        sample.push(["a, \"b\"".into(), Cell::Count(7), range]);
        sample.push(["c".into(), Cell::Missing, Cell::Missing]);
        let expected = "row,count,ratio_low,ratio_high\r\n\"a, \"\"b\"\"\",7,0.125,0.5\r\nc,,,\r\n";
        assert_eq!(table(&sample), expected);
    }

    #[test]
    fn a_field_stays_one_field() {
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
        assert_eq!(quoted("1 ms"), "1 ms");
        assert_eq!(quoted("=1+1"), "'=1+1");
        assert_eq!(quoted("-1.5"), "-1.5");
    }
}
