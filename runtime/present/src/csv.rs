//! Metrics as rows of RFC 4180.

use crate::model::{Metric, Section};
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
    let fields = [
        run.to_owned(),
        subject.to_owned(),
        metric.name.clone(),
        number(metric.value),
        unit.to_owned(),
        number(metric.low),
        number(metric.high),
        metric.method.clone(),
    ];
    fields.map(|field| quoted(&field)).join(",") + "\r\n"
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
    fn a_field_stays_one_field() {
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
        assert_eq!(quoted("1 ms"), "1 ms");
        assert_eq!(quoted("=1+1"), "'=1+1");
        assert_eq!(quoted("-1.5"), "-1.5");
    }
}
