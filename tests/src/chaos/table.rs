//! What was tried over many episodes, and how the runs ended.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::episode::Report;
use super::plan::Kind;

/// The table of `reports`.
pub fn table(reports: &[Report]) -> String {
    let mut text = String::new();
    let mut line = |words: std::fmt::Arguments<'_>| {
        let _infallible = writeln!(text, "{words}");
    };
    line(format_args!(
        "{:20} {:>10} {:>10} {:>10}",
        "injection", "times", "episodes", "violated"
    ));
    for (kind, _) in Kind::ALL {
        let with = reports.iter().filter(|report| report.plan.has(kind, None));
        let injections = reports.iter().flat_map(|report| &report.plan.injections);
        let times = injections
            .filter(|injection| injection.kind == kind)
            .count();
        let violated = with.clone().filter(|report| !report.violations.is_empty());
        line(format_args!(
            "{:20} {times:>10} {:>10} {:>10}",
            kind.label(),
            with.clone().count(),
            violated.count()
        ));
    }
    let mut ends: BTreeMap<String, usize> = BTreeMap::new();
    for report in reports {
        let both = format!("{} / {}", report.ends[0], report.ends[1]);
        *ends.entry(both).or_default() += 1;
    }
    line(format_args!("\nends on control-pc / robot-pc"));
    for (both, count) in ends {
        line(format_args!("{count:>6}  {both}"));
    }
    let counted = reports.iter().filter_map(|report| report.messages);
    let (published, taken) = counted.fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    let violated = reports
        .iter()
        .filter(|one| !one.violations.is_empty())
        .count();
    line(format_args!(
        "\n{} episodes, {violated} violated; {published} messages published, {taken} taken",
        reports.len()
    ));
    text
}
