//! A run as a row of the seed paper's tables: Tables II and III for the fleet, the motion loss rates of
//! section III.C for teleoperation. With an interval, which the paper's have not.

use crate::network::NetworkReport;
use crate::summary::ScoreMetric;
use hil_core::interval::Spread;
use hil_present::units::{JOINT, duration_s, figure, ns_s};
use hil_present::{Table, UNAVAILABLE};

/// The table; `None` for a case that the paper has no table of. The case is known by its figures.
pub(super) fn table(
    case: &str,
    score: &[ScoreMetric],
    network: Option<&NetworkReport>,
    link: &str,
) -> Option<Table> {
    let find = |name: &str| score.iter().find(|one| one.name == name);
    if let Some(ratio) = find("collision_ratio") {
        let counts = ["critical_sections_count", "section_collisions_count"].map(find);
        return Some(fleet(ratio, counts, network, link));
    }
    let ratio = find("motion_loss_ratio").filter(|_| case != "fleet")?;
    let counts = ["motion_loops_sent_count", "motion_loops_executed_count"].map(find);
    Some(teleoperation(ratio, counts, link))
}

fn value(metric: Option<&ScoreMetric>, scale: f64) -> String {
    let value = metric.and_then(|one| one.value);
    value.map_or_else(|| UNAVAILABLE.to_owned(), |value| figure(value * scale))
}

fn interval(metric: &ScoreMetric, scale: f64) -> String {
    match metric.interval {
        None => UNAVAILABLE.to_owned(),
        Some(Spread::Known(one)) => {
            format!(
                "{} to {}",
                figure(one.low * scale),
                figure(one.high * scale)
            )
        }
        Some(Spread::Unknown(why)) => why.to_string(),
    }
}

/// Least to most of the channels' values.
fn span(values: impl Iterator<Item = f64>, words: fn(f64) -> String) -> String {
    let mut ends: Option<(f64, f64)> = None;
    for value in values {
        let (low, high) = ends.unwrap_or((value, value));
        ends = Some((low.min(value), high.max(value)));
    }
    match ends.map(|(low, high)| (words(low), words(high))) {
        None => UNAVAILABLE.to_owned(),
        Some((low, high)) if low == high => low,
        Some((low, high)) => format!("{low} to {high}"),
    }
}

fn fleet(
    ratio: &ScoreMetric,
    [sections, collisions]: [Option<&ScoreMetric>; 2],
    network: Option<&NetworkReport>,
    link: &str,
) -> Table {
    let columns = [
        "Simulation method",
        "PLR",
        "Delay",
        "Total CS counts",
        "Collision counts",
        "P(collision), ‰",
        "95 %, ‰",
    ];
    let mut table = Table::new("As in Tables II and III of the seed paper", &columns);
    let channels = || network.iter().flat_map(|report| &report.channels);
    let losses = channels().filter_map(|one| Some(one.figures.loss.measured()?.ratio));
    let delays =
        channels().filter_map(|one| Some(ns_s(one.figures.delay.measured()?.p50.value_ns)));
    table.push(
        [
            link.to_owned(),
            span(losses, figure),
            span(delays, duration_s),
            value(sections, 1.0),
            value(collisions, 1.0),
            value(Some(ratio), 1000.0),
            interval(ratio, 1000.0),
        ]
        .map(Into::into),
    );
    table.note = format!(
        "PLR and delay (median) as measured, least to most of the channels. {}. The paper gives no \
         intervals, and how many critical sections there are depends on how overlaps are merged: see \
         docs/published-tables.md.",
        capitalised(&ratio.method)
    );
    table
}

fn teleoperation(
    ratio: &ScoreMetric,
    [sent, executed]: [Option<&ScoreMetric>; 2],
    link: &str,
) -> Table {
    let columns = [
        "Network",
        "Loops sent, N_S",
        "Loops executed, N_a",
        "MLR",
        "95 %",
    ];
    let mut table = Table::new(
        "Motion loss rate, as in section III.C of the seed paper",
        &columns,
    );
    table.push(
        [
            link.to_owned(),
            value(sent, 1.0),
            value(executed, 1.0),
            value(Some(ratio), 1.0),
            interval(ratio, 1.0),
        ]
        .map(Into::into),
    );
    table.note = format!(
        "MLR{JOINT}={JOINT}(N_S − N_a){JOINT}/{JOINT}N_S. {}. The paper's: 0 over Ethernet, 0.008 and \
         0.03 over Wi-Fi 6 at short and long range, of 890 loops each.",
        capitalised(&ratio.method)
    );
    table
}

fn capitalised(words: &str) -> String {
    let mut letters = words.chars();
    let first = letters.next().map(char::to_uppercase);
    first.into_iter().flatten().chain(letters).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::interval::{Interval, IntervalMethod};

    fn metric(name: &str, value: Option<f64>, interval: Option<(f64, f64)>) -> ScoreMetric {
        ScoreMetric {
            name: name.to_owned(),
            label: name.to_owned(),
            value,
            interval: interval
                .map(|(low, high)| Spread::Known(Interval::new(low, high, IntervalMethod::Exact))),
            unit: "1".to_owned(),
            method: "interval of Clopper and Pearson".to_owned(),
        }
    }

    #[test]
    fn the_row_of_a_fleet_is_per_mille_with_its_interval() {
        let score = [
            metric("critical_sections_count", Some(10_018.0), None),
            metric("section_collisions_count", Some(5.0), None),
            metric(
                "collision_ratio",
                Some(5.0 / 10_018.0),
                Some((0.000_162, 0.001_164)),
            ),
        ];
        let table = table("fleet", &score, None, "UDP").unwrap();
        let expected = [
            "UDP",
            "unavailable",
            "unavailable",
            "10018",
            "5",
            "0.4991",
            "0.1620 to 1.164",
        ];
        let texts = table.rows[0].cells.iter().map(hil_present::Cell::text);
        assert_eq!(texts.collect::<Vec<_>>(), expected);
        assert!(table.note.contains("Interval of Clopper and Pearson"));
    }

    #[test]
    fn a_rate_that_there_is_none_of_is_no_zero() {
        let score = [metric("motion_loss_ratio", None, None)];
        let table = table("teleoperation", &score, None, "UDP").unwrap();
        assert!(
            table.rows[0].cells[1..]
                .iter()
                .all(|cell| cell.text() == UNAVAILABLE),
            "{table:?}"
        );
        assert!(super::table("shuttle", &[], None, "").is_none());
    }
}
