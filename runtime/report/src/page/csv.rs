//! Figures as rows of RFC 4180: one per channel and figure, and one per figure of the score.

use super::data::{Metric, Page, Run};
use crate::terminal::JOINT;

const HEADER: &str = "run,channel,figure,value,unit,low,high,method\r\n";

/// The whole table. A figure that is unavailable has an empty value and the reason as its method.
pub(super) fn text(page: &Page) -> String {
    let mut text = HEADER.to_owned();
    for run in &page.runs {
        for (channel, figure) in rows(run) {
            let number =
                |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
            let unit = if figure.unit == "share" {
                "1"
            } else {
                &figure.unit
            };
            let fields = [
                run.name.clone(),
                channel.to_owned(),
                figure.name.clone(),
                number(figure.value),
                unit.to_owned(),
                number(figure.low),
                number(figure.high),
                figure.method.clone(),
            ];
            text.push_str(&fields.map(|field| quoted(&field)).join(","));
            text.push_str("\r\n");
        }
    }
    text
}

/// Every figure of a run with its channel; the score's have none.
pub(crate) fn rows(run: &Run) -> impl Iterator<Item = (&str, &Metric)> {
    let score = run.score.iter().map(|figure| ("", figure));
    let channels = run.channels.iter().flat_map(|channel| {
        let figures = channel.figures.iter();
        figures.map(|figure| (channel.name.as_str(), figure))
    });
    score.chain(channels)
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
