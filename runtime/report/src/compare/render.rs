//! A comparison as sections, for a terminal and as Markdown. It computes nothing.

use std::path::PathBuf;

use hil_core::interval::{Interval, Spread};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::template::{TemplateError, markdown as document};
use hil_present::terminal::canvas::{Canvas, Style};
use hil_present::terminal::section;
use hil_present::units::{duration, figure, percent};
use hil_present::{Block, Section, Table, Tone, UNAVAILABLE};
use hil_stats::comparison::Estimate;

use super::conditions::Verdicts;
use super::harms::HarmDifference;
use super::origin::{Difference, Differing};
use super::{ChartKind, ComparedMetric, Comparison, Part, Verdict};
use crate::answer::{Hurt, Object, UnitScale};

const COLUMNS: [&str; 6] = ["metric", "base", "new", "new / base", "95 %", "verdict"];
/// Differences and channels that are listed unless every metric is asked for.
const DIFFERENCES_SHOWN: usize = 8;
const CHANNELS_SHOWN: usize = 12;

/// How much is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Extent {
    Brief,
    Full,
}

/// What differs, the robot, one line a channel, and last the answer.
pub(super) fn brief(comparison: &Comparison, verdicts: &Verdicts, width: usize) -> String {
    let mut end = judged(verdicts);
    end.note(
        Tone::Faint,
        "--full prints every metric with its method; intervals are 95 %.",
    );
    let sections = [
        runs(comparison, Extent::Brief),
        robot(comparison),
        channels(comparison),
        end,
    ];
    text(&sections, comparison, width)
}

/// Every metric, and last the answer.
pub(super) fn full(comparison: &Comparison, verdicts: &Verdicts, width: usize) -> String {
    let sections = [
        runs(comparison, Extent::Full),
        metrics(comparison),
        methods(comparison),
        judged(verdicts),
    ];
    text(&sections, comparison, width)
}

/// What a comparison asks.
const fn question(comparison: &Comparison) -> &'static str {
    match comparison.object {
        Object::Robot => "Was the robot hurt more in the new runs?",
        Object::Programs => "Were the programs hurt more in the new runs?",
    }
}

fn text(sections: &[Section], comparison: &Comparison, width: usize) -> String {
    let mut canvas = Canvas::new(width, Style::Plain);
    for one in sections {
        section(&mut canvas, one);
    }
    canvas.blank();
    canvas.rule(Tone::Faint);
    let hurt = comparison.hurt.words(comparison.object);
    canvas.paragraph(
        0,
        Tone::Strong,
        &format!("{}  {}", question(comparison), hurt),
    );
    section(&mut canvas, &harms(comparison));
    canvas.rule(Tone::Faint);
    canvas.finish()
}

/// As Markdown: the answer first, then every metric.
///
/// # Errors
/// When a template of this program is at fault.
pub(super) fn markdown(
    comparison: &Comparison,
    verdicts: &Verdicts,
) -> Result<String, TemplateError> {
    let mut answer = Section::new("answer", "", "");
    let hurt = comparison.hurt.words(comparison.object);
    answer.note(Tone::Strong, format!("{} {}", question(comparison), hurt));
    answer.blocks.extend(harms(comparison).blocks);
    let sections = [
        answer,
        runs(comparison, Extent::Full),
        metrics(comparison),
        methods(comparison),
        judged(verdicts),
    ];
    document("Comparison of runs", &sections)
}

fn list(section: &mut Section, tone: Tone, items: &[String]) {
    let items = items.to_vec();
    if !items.is_empty() {
        section.blocks.push(Block::List { tone, items });
    }
}

fn folders(runs: &[PathBuf]) -> String {
    let names = runs.iter().map(|run| run.display().to_string());
    names.collect::<Vec<_>>().join(", ")
}

/// The runs, and whether they may be compared.
fn runs(comparison: &Comparison, extent: Extent) -> Section {
    let mut section = Section::new("runs", "Runs", "");
    section.fact("base", Tone::Plain, folders(&comparison.base));
    section.fact("new", Tone::Plain, folders(&comparison.new));
    if comparison.differences.is_empty() {
        let same = comparison.same.join(", ");
        section.note(
            Tone::Plain,
            format!("The runs are comparable: same {same}."),
        );
    } else {
        section.note(Tone::Caution, "The runs differ in more than their metrics:");
        let all = comparison.differences.iter();
        let mut items = Vec::new();
        for one in all {
            items.push(one.to_string());
            if extent == Extent::Full {
                items.extend(one.following.iter().map(Difference::to_string));
            }
        }
        if extent == Extent::Brief && items.len() > DIFFERENCES_SHOWN {
            let hidden = counted((items.len() - DIFFERENCES_SHOWN) as u64, "more difference");
            items.truncate(DIFFERENCES_SHOWN);
            items.push(format!("{hidden} with --full"));
        }
        list(&mut section, Tone::Caution, &items);
    }
    if !comparison.cautions.is_empty() {
        section.note(Tone::Caution, "Read with care:");
        list(&mut section, Tone::Caution, &comparison.cautions);
    }
    section
}

/// What hurt the robot on both sides, by what, whether that is valid, and what it leaves open.
fn harms(comparison: &Comparison) -> Section {
    let mut section = Section::new("harms", "", "");
    for one in &comparison.harms {
        section.note(Tone::Strong, &one.base.what);
        section.fact("base", Tone::Plain, one.base.words());
        section.fact("new", Tone::Plain, one.new.words());
        let is_none = one.base.count == Some(0) && one.new.count == Some(0);
        if let Some(difference) = one.difference.as_ref().filter(|_| !is_none) {
            section.fact("new less base", Tone::Plain, difference_words(difference));
        }
    }
    if let Some(words) = &comparison.first_harm {
        section.fact("first harm", Tone::Plain, words);
    }
    for one in &comparison.measurements {
        let words = match one.runs.as_slice() {
            _ if comparison.measurements.len() == 1 => one.words.clone(),
            runs => format!("{}: {}", folders(runs), one.words),
        };
        let tone = match one.is_valid {
            Some(false) => Tone::Bad,
            _ => Tone::Plain,
        };
        section.fact("measurement", tone, words);
    }
    for (index, words) in left_open(comparison).into_iter().enumerate() {
        let label = if index == 0 { "left open" } else { "" };
        section.fact(label, Tone::Plain, words);
    }
    section
}

fn difference_words(of: &HarmDifference) -> String {
    let value = more_words(of, of.value);
    match of.interval {
        Spread::Known(Interval { low, high, .. }) => {
            let [low, high] = [low, high].map(|end| more_words(of, end));
            format!("{value} [{low}, {high}]")
        }
        Spread::Unknown(why) => format!("{value} [{why}]"),
    }
}

fn more_words(of: &HarmDifference, value: f64) -> String {
    if of.is_share {
        format!("{:+.2} pp", 100.0 * value)
    } else {
        format!("{:+.1} per hour", 3600.0 * value)
    }
}

/// What the runs do not tell.
fn left_open(comparison: &Comparison) -> Vec<String> {
    let mut open = Vec::new();
    if comparison.hurt == Hurt::No {
        for one in &comparison.harms {
            let of = one.difference.as_ref();
            let ends = of.and_then(|of| Some((of, of.interval.known()?)));
            if let Some((of, Interval { high, .. })) = ends.filter(|(_, one)| one.high > 0.0) {
                let most = more_words(of, high);
                open.push(format!("{}: up to {most} would not show", one.base.what));
            }
        }
    }
    if comparison.base.len().min(comparison.new.len()) == 1 {
        open.push("how much runs differ by themselves: one run on a side".to_owned());
    }
    let differing = differing(&comparison.differences);
    if differing.len() > 1 {
        let differing = differing.into_iter().map(ToString::to_string);
        let differing = differing.collect::<Vec<_>>().join(", ");
        open.push(format!(
            "which of these made the difference: the runs differ in {differing}"
        ));
    }
    open
}

/// What may have made a difference: no name of a topology, and not the kinds of links where their keys are told.
fn differing(differences: &[Difference]) -> Vec<&Differing> {
    let whats = || differences.iter().map(|one| &one.what);
    let is_of_link =
        |what: &Differing| matches!(what, Differing::Key(key) if key.starts_with("links."));
    let has_links = whats().any(is_of_link);
    let found = whats().filter(|what| match what {
        Differing::Key(key) => key != "name",
        Differing::Links => !has_links,
        _ => true,
    });
    found.collect()
}

/// Conditions that were asked for.
fn judged(verdicts: &Verdicts) -> Section {
    let mut section = Section::new("conditions", "", "");
    for line in verdicts.lines() {
        section.note(Tone::Plain, line);
    }
    section
}

/// Every metric.
fn metrics(comparison: &Comparison) -> Section {
    let mut section = Section::new("metrics", "Metrics", "intervals are 95 %");
    let is_of_one = |one: &ComparedMetric, other: &ComparedMetric| one.channel == other.channel;
    for figures in comparison.figures.chunk_by(is_of_one) {
        let title = figures[0].channel.as_deref().unwrap_or("scores");
        let mut table = Table::new(title, &COLUMNS);
        table.has_long_names = true;
        for one in figures {
            table.push(cells(one).map(Into::into));
        }
        section.table(table);
    }
    section
}

fn cells(one: &ComparedMetric) -> [String; 6] {
    let name = match one.part {
        None => one.metric.clone(),
        Some(part) => format!("{part} {}", one.metric),
    };
    let (change, interval) = match one.kind {
        ChartKind::Delay => (
            one.ratio.map(|ratio| format!("{ratio:.3}x")),
            one.ratio_interval
                .map(|Interval { low, high, .. }| format!("{low:.3}x to {high:.3}x")),
        ),
        ChartKind::Loss => (
            one.difference.map(points),
            one.difference_interval
                .map(|Interval { low, high, .. }| format!("{} to {}", points(low), points(high))),
        ),
        ChartKind::Count | ChartKind::Score => (
            one.difference.map(signed),
            one.difference_interval
                .map(|Interval { low, high, .. }| format!("{} to {}", signed(low), signed(high))),
        ),
    };
    let or_none = |text: Option<String>| text.unwrap_or_else(|| UNAVAILABLE.to_owned());
    [
        name,
        value(one, one.base),
        value(one, one.new),
        or_none(change),
        or_none(interval),
        one.verdict.words().to_owned(),
    ]
}

fn points(share: f64) -> String {
    format!("{:+.3} pp", share * 100.0)
}

fn signed(value: f64) -> String {
    let text = figure(value);
    if value > 0.0 {
        format!("+{text}")
    } else {
        text
    }
}

#[expect(clippy::cast_possible_truncation, reason = "nanoseconds of a delay")]
fn value(one: &ComparedMetric, estimate: Option<Estimate>) -> String {
    let Some(Estimate { value, .. }) = estimate else {
        return UNAVAILABLE.to_owned();
    };
    match (one.kind, one.unit.as_str()) {
        (ChartKind::Delay, _) => duration(value as i64),
        (ChartKind::Loss, _) => percent(value),
        (ChartKind::Count | ChartKind::Score, "1") => figure(value),
        (ChartKind::Count | ChartKind::Score, unit) => format!("{} {unit}", figure(value)),
    }
}

/// Each method once, with what it was used for.
fn methods(comparison: &Comparison) -> Section {
    let mut found: Vec<(&str, Vec<&str>)> = Vec::new();
    for one in &comparison.figures {
        let whom = match one.kind {
            ChartKind::Delay if matches!(one.part, Some(Part::Segment { .. })) => "segments",
            ChartKind::Delay | ChartKind::Loss | ChartKind::Count => one.metric.as_str(),
            ChartKind::Score => "scores",
        };
        match found.iter_mut().find(|known| known.0 == one.method) {
            Some((_, known)) if known.contains(&whom) => {}
            Some((_, known)) => known.push(whom),
            None => found.push((&one.method, vec![whom])),
        }
    }
    let mut section = Section::new("methods", "Methods", "");
    for (method, whom) in found {
        section.fact(whom.join(", "), Tone::Plain, method);
    }
    section
}

/// The scores that differ, and those to see first.
fn robot(comparison: &Comparison) -> Section {
    let mut section = Section::new("robot", "Robot", "");
    let scores = || {
        let all = comparison.figures.iter();
        all.filter(|one| one.kind == ChartKind::Score && one.base.is_some() && one.new.is_some())
    };
    let is_shown = |one: &&ComparedMetric| {
        let differs = matches!(one.verdict, Verdict::Lower | Verdict::Higher);
        differs || comparison.headline.contains(&one.metric)
    };
    let mut table = Table::new("", &["score", "base", "new", "difference"]);
    for one in scores().filter(is_shown) {
        let scale = UnitScale::of(&one.unit);
        let [base, new] = [one.base, one.new]
            .map(|side| side.map_or_else(String::new, |side| scale.words(side.value)));
        let mut verdict = one.verdict.words().to_owned();
        if base == new && one.verdict != Verdict::NoDifferenceShown {
            verdict.push_str(", by less than the digits shown");
        }
        table.push([one.label.clone(), base, new, verdict].map(Into::into));
    }
    let hidden = scores().count() - table.rows.len();
    if hidden > 0 {
        let hidden = counted(hidden as u64, "other score");
        table.note = format!("{hidden}: no difference shown");
    }
    if !table.rows.is_empty() || hidden > 0 {
        section.table(table);
    }
    section
}

/// Loss of both sides, and how often as long the delays are; those that lose most first.
fn channels(comparison: &Comparison) -> Section {
    let mut section = Section::new("channels", "Channels", "");
    let mut names: Vec<&str> = Vec::new();
    for one in &comparison.figures {
        if let Some(channel) = &one.channel
            && !names.contains(&channel.as_str())
        {
            names.push(channel);
        }
    }
    let metric = |channel: &str, part: Option<Part>, metric: &str| {
        let mut all = comparison.figures.iter();
        all.find(|one| {
            one.channel.as_deref() == Some(channel) && one.part == part && one.metric == metric
        })
    };
    let share_lost = |channel: &str| {
        let new = metric(channel, None, "loss").and_then(|one| one.new);
        new.map_or(0.0, |one| one.value)
    };
    names.sort_by(|one, other| share_lost(other).total_cmp(&share_lost(one)));
    if names.is_empty() {
        return section;
    }
    let is_shown = |metric: &str| {
        let all = comparison.figures.iter();
        let mut sides = all
            .filter(|one| one.metric == metric)
            .flat_map(|one| [one.base, one.new]);
        sides.any(|side| side.is_some_and(|side| side.value > 0.0))
    };
    // Few networks reorder or copy anything.
    let seldom: Vec<&str> = ["reordered", "duplicated"]
        .into_iter()
        .filter(|one| is_shown(one))
        .collect();
    let mut columns = vec!["channel", "lost"];
    columns.extend(&seldom);
    columns.extend(["p50, new / base", "p99, new / base"]);
    let mut table = Table::new("", &columns);
    for name in names.iter().take(CHANNELS_SHOWN) {
        let share = |share: &str| {
            metric(name, None, share).map_or_else(String::new, |one| {
                let [base, new] = [one.base, one.new].map(|side| value(one, side));
                with_verdict(format!("{base} → {new}"), one.verdict)
            })
        };
        let ratio = |quantile: &str| {
            let one = metric(name, Some(Part::EndToEnd), quantile);
            let known = one.and_then(|one| Some((one.ratio?, one.verdict)));
            known.map_or_else(String::new, |(ratio, verdict)| {
                with_verdict(format!("{ratio:.2}"), verdict)
            })
        };
        let mut cells = vec![(*name).to_owned(), share("loss")];
        cells.extend(seldom.iter().map(|one| share(one)));
        cells.extend(["p50", "p99"].map(ratio));
        table.push(cells.into_iter().map(Into::into));
    }
    let hidden = names.len().saturating_sub(CHANNELS_SHOWN) as u64;
    if hidden > 0 {
        let hidden = grouped(hidden);
        table.note = format!("and {hidden} more that lose no larger share");
    }
    section.table(table);
    section
}

fn with_verdict(text: String, verdict: Verdict) -> String {
    match verdict {
        Verdict::NotTested | Verdict::NoDifferenceShown => text,
        verdict => format!("{text}, {}", verdict.words()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_makes_no_difference_and_links_make_one_where_no_key_of_theirs_does() {
        let of = |whats: &[Differing]| -> Vec<Difference> {
            let of = |what: &Differing| Difference {
                what: what.clone(),
                base: "none".to_owned(),
                new: "x".to_owned(),
                following: Vec::new(),
            };
            whats.iter().map(of).collect()
        };
        let key = |key: &str| Differing::Key(key.to_owned());
        let [kind, gain] = [key("links.hop.via"), key("case.parameters.gain")];
        let found = of(&[kind.clone(), gain.clone(), key("name"), Differing::Links]);
        assert_eq!(differing(&found), [&kind, &gain]);
        assert_eq!(differing(&of(&[Differing::Links])), [&Differing::Links]);
    }
}
