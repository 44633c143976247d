//! The text a bench prints: one JSON line per case for machines, one table for people. It returns
//! strings and prints nothing.

use core::fmt::Write as _;

use serde_json::{Value, json};

use crate::quantiles::PairedRatio;
use crate::rounds::{Comparison, Row};

/// One line of JSON about `row`, with its ratios to `reference` and the floor it stood on.
pub fn json_line(bench: &str, comparison: &Comparison, row: &Row, reference: &Row) -> String {
    let ratio = |ratio: Option<PairedRatio>| ratio.map_or(Value::Null, |ratio| ratio.to_json());
    json!({
        "bench": bench,
        "case": row.name,
        "quantiles": row.quantiles.map(|quantiles| quantiles.to_json()),
        "reference": reference.name,
        "p50_ratio": ratio(row.p50_ratio_to(reference)),
        "p99_ratio": ratio(row.p99_ratio_to(reference)),
        "floor_p50_ns": row.floor_p50_ns,
        "rounds_kept": comparison.kept_count,
        "rounds_rejected": comparison.rejected_count,
    })
    .to_string()
}

/// All rows for people, in microseconds, each with its paired ratio to the reference its index
/// names and to the floor.
pub fn table(comparison: &Comparison, references: &[usize]) -> String {
    let mut text = format!(
        "{:<38} {:>9} {:>9} {:>9} {:>10} {:>8} {:>22}\n",
        "case (microseconds)", "p50", "p99", "p99.9", "max", "x floor", "x reference (quartiles)"
    );
    let mut line = |row: &Row, ratio: Option<PairedRatio>| {
        let Some(quantiles) = row.quantiles else {
            writeln!(text, "{:<38} no round was kept", row.name)
                .expect("writing to a string cannot fail");
            return;
        };
        let us = |ns: u64| ns as f64 * 1e-3;
        let floor = row.floor_p50_ns.map_or(f64::NAN, |floor| floor as f64);
        let ratio = ratio.map_or_else(String::new, |ratio| {
            let PairedRatio {
                median,
                lower_quartile,
                upper_quartile,
            } = ratio;
            format!("{median:.2} ({lower_quartile:.2}..{upper_quartile:.2})")
        });
        writeln!(
            text,
            "{:<38} {:>9.2} {:>9.2} {:>9.2} {:>10.1} {:>8.1} {:>22}",
            row.name,
            us(quantiles.p50_ns),
            us(quantiles.p99_ns),
            us(quantiles.p99_9_ns),
            us(quantiles.max_ns),
            quantiles.p50_ns as f64 / floor,
            ratio
        )
        .expect("writing to a string cannot fail");
    };
    line(&comparison.floor, None);
    for (row, reference) in comparison.rows.iter().zip(references) {
        let reference = &comparison.rows[*reference];
        let ratio = (reference.name != row.name).then(|| row.p50_ratio_to(reference));
        line(row, ratio.flatten());
    }
    let Comparison {
        kept_count,
        rejected_count,
        ..
    } = comparison;
    writeln!(
        text,
        "{kept_count} rounds kept, {rejected_count} rejected for a jumping floor"
    )
    .expect("writing to a string cannot fail");
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rounds::{Case, compare};

    #[test]
    fn both_forms_name_the_case_and_its_ratio() {
        let (mut a, mut b) = (|| vec![1_000], || vec![1_100]);
        let mut cases = [
            Case {
                name: "reference",
                round: &mut a,
            },
            Case {
                name: "ours",
                round: &mut b,
            },
        ];
        let outcome = compare(3, &mut || vec![500], &mut cases);
        let text = table(&outcome, &[0, 0]);
        assert!(
            text.contains("ours") && text.contains("1.10 (1.10..1.10)"),
            "{text}"
        );
        let line = json_line("demo", &outcome, &outcome.rows[1], &outcome.rows[0]);
        let value: Value = serde_json::from_str(&line).unwrap();
        assert_eq!(value["quantiles"]["p50_ns"], 1_100);
        assert_eq!(value["rounds_kept"], 3);
        assert!(!line.contains('\n'));
    }
}
