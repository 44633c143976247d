//! A comparison as sections, for a terminal and as Markdown. It computes nothing.

use std::path::PathBuf;

use hil_core::interval::{Interval, Spread};
use hil_platform::text::{grouped, shell_words, shortened};
use hil_platform::words::counted;
use hil_present::template::{TemplateError, markdown as document};
use hil_present::terminal::canvas::{Canvas, Style};
use hil_present::terminal::section;
use hil_present::units::{self, JOINT, duration, percent};
use hil_present::{Block, Section, Table, Tone, UNAVAILABLE};
use hil_stats::comparison::Estimate;

use super::conditions::Verdicts;
use super::harms::{ComparedHarm, HarmDifference};
use super::origin::{Difference, Differing};
use super::{ChartKind, ComparedMetric, Comparison, Part, Tested, Verdict};
use crate::answer::{Hurt, Object, OccasionCount, Unresolved, none_means, with_note};
use crate::summary::ScoreMetric;

const COLUMNS: [&str; 6] = ["metric", "base", "new", "new / base", "95 %", "verdict"];
/// Differences and channels that are listed unless every metric is asked for.
const DIFFERENCES_SHOWN: usize = 8;
const CHANNELS_SHOWN: usize = 12;
/// Columns of what the emulated links of a side do.
const LINK_COLUMNS: usize = 130;
/// Repetitions a side that are asked for.
const REPETITIONS_MIN: usize = 3;

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
    text(&sections, comparison, Extent::Brief, width)
}

/// Every metric, and last the answer.
pub(super) fn full(comparison: &Comparison, verdicts: &Verdicts, width: usize) -> String {
    let sections = [
        runs(comparison, Extent::Full),
        metrics(comparison),
        methods(comparison),
        judged(verdicts),
    ];
    text(&sections, comparison, Extent::Full, width)
}

/// What a comparison asks.
const fn question(comparison: &Comparison) -> &'static str {
    match comparison.object {
        Object::Robot => "Was the robot hurt more in the new runs?",
        Object::Programs => "Were the programs hurt more in the new runs?",
    }
}

fn text(sections: &[Section], comparison: &Comparison, extent: Extent, width: usize) -> String {
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
    section(&mut canvas, &harms(comparison, extent));
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
    answer.blocks.extend(harms(comparison, Extent::Full).blocks);
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
fn harms(comparison: &Comparison, extent: Extent) -> Section {
    let mut section = Section::new("harms", "", "");
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
    section.fact("sample", Tone::Plain, sample(comparison));
    if let Some(words) = &comparison.gravest_harm {
        section.fact("gravest harm", Tone::Plain, words);
    }
    let is_none = |one: &ComparedHarm| one.base.count == Some(0) && one.new.count == Some(0);
    let is_folded = |one: &&ComparedHarm| extent == Extent::Brief && is_none(one);
    let (none, seen): (Vec<_>, Vec<_>) = comparison.harms.iter().partition(is_folded);
    for one in seen {
        let (what, base, new) = (&one.base.what, one.base.words(), one.new.words());
        let difference = one.difference.as_ref().filter(|_| !is_none(one));
        let difference = difference.map(difference_words);
        if extent == Extent::Full {
            section.note(Tone::Strong, with_note(what.clone(), &one.base.note));
            section.fact("base", Tone::Plain, base);
            section.fact("new", Tone::Plain, new);
            if let Some(words) = difference {
                section.fact("new less base", Tone::Plain, words);
            }
            continue;
        }
        let mut words = format!("{what}: {base} → {new}");
        if let Some(difference) = difference {
            words = format!("{words}, by {difference}");
        }
        section.fact("harm", Tone::Plain, words);
    }
    if !none.is_empty() {
        let names: Vec<&str> = none.iter().map(|one| one.base.what.as_str()).collect();
        section.fact("on neither side", Tone::Plain, names.join("; "));
    }
    if comparison.hurt == Hurt::No {
        let unhurt = comparison.harms.iter().map(|one| &one.new);
        let unhurt = unhurt.filter(|one| one.count == Some(0));
        let occasions = unhurt.filter_map(|one| one.occasions.as_ref());
        let mut means: Vec<String> = occasions
            .map(|OccasionCount { what, count }| none_means(what, *count))
            .collect();
        means.sort();
        means.dedup();
        for words in means {
            section.fact("NO means", Tone::Plain, words);
        }
    }
    for (index, words) in left_open(comparison).into_iter().enumerate() {
        let label = if index == 0 { "left open" } else { "" };
        section.fact(label, Tone::Plain, words);
    }
    links(&mut section, comparison, extent);
    resolve(&mut section, comparison);
    section
}

/// Over what the runs went.
fn links(section: &mut Section, comparison: &Comparison, extent: Extent) {
    let (base, new) = (&comparison.base_tested, &comparison.new_tested);
    let whole = |of: &Tested| match of.links.as_slice() {
        [] => "none".to_owned(),
        all => all.join(" or "),
    };
    let cut = |of: &Tested| shortened(&whole(of), LINK_COLUMNS);
    // Where the cut would make them alike they are not cut.
    let is_cut = extent == Extent::Brief && (base.links == new.links || cut(base) != cut(new));
    let links = |of: &Tested| if is_cut { cut(of) } else { whole(of) };
    if base.links == new.links {
        section.fact("link", Tone::Plain, links(base));
    } else {
        section.fact("link of the base", Tone::Plain, links(base));
        section.fact("link of the new", Tone::Plain, links(new));
    }
}

/// How long the runs were.
fn sample(comparison: &Comparison) -> String {
    let of_side = |runs: &[PathBuf], of: &Tested| {
        let length = format!("{:.1}{JOINT}s", of.duration_s);
        match runs.len() as u64 {
            1 => format!("1 run of {length}"),
            count => format!("{} of {length} together", counted(count, "run")),
        }
    };
    format!(
        "base {}, new {}",
        of_side(&comparison.base, &comparison.base_tested),
        of_side(&comparison.new, &comparison.new_tested)
    )
}

/// What would make an answer of a sample that is too small.
fn resolve(section: &mut Section, comparison: &Comparison) {
    let Hurt::NotResolvable {
        because:
            Unresolved::SampleTooSmall { .. } | Unresolved::NoInterval { .. } | Unresolved::WithinChance,
    } = &comparison.hurt
    else {
        return;
    };
    let words = if comparison.base.len().min(comparison.new.len()) < REPETITIONS_MIN {
        format!(
            "repeat the runs of both sides, each with a seed of its own, until there are \
             {REPETITIONS_MIN} a side or more:"
        )
    } else {
        "more repetitions on both sides, each with a seed of its own:".to_owned()
    };
    section.fact("to resolve it", Tone::Plain, words);
    let folders = |runs: &[PathBuf]| {
        let names = runs.iter().map(|run| run.display().to_string());
        shell_words(&names.collect::<Vec<_>>())
    };
    section.blocks.push(Block::Command {
        text: format!(
            "hil-runtime compare --base {} MORE-BASE-RUNS --new {} MORE-NEW-RUNS",
            folders(&comparison.base),
            folders(&comparison.new)
        ),
    });
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
    let mut section = Section::new(
        "metrics",
        "Metrics",
        "intervals are 95 %; loss of the messages of known fate",
    );
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
        ChartKind::Count | ChartKind::Score => {
            let signed = |value| signed(one, value);
            (
                one.difference.map(signed),
                one.difference_interval.map(|Interval { low, high, .. }| {
                    format!("{} to {}", signed(low), signed(high))
                }),
            )
        }
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

/// The unit in which a score or a count is shown.
fn shown_unit(one: &ComparedMetric) -> &str {
    ScoreMetric::shown_unit(&one.metric, &one.unit)
}

fn signed(one: &ComparedMetric, value: f64) -> String {
    let text = match shown_unit(one) {
        "share" => return points(value),
        unit => units::value(value, unit),
    };
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
    match one.kind {
        ChartKind::Delay => duration(value as i64),
        ChartKind::Loss => percent(value),
        ChartKind::Count | ChartKind::Score => units::value(value, shown_unit(one)),
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
        all.filter(|one| one.kind == ChartKind::Score)
    };
    // Where runs are repeated, one that changed and has no interval may have changed by chance or not: a reader must see it.
    // Of one run a side nearly all are so.
    let are_repeated = comparison.base.len() > 1 && comparison.new.len() > 1;
    let is_shown = |one: &&ComparedMetric| {
        let differs = match one.verdict {
            Verdict::Lower | Verdict::Higher => true,
            Verdict::NotTested => {
                are_repeated && one.difference.is_some_and(|more| more.abs() > 0.0)
            }
            _ => false,
        };
        let has_both = one.base.is_some() && one.new.is_some();
        has_both && (differs || comparison.headline.contains(&one.metric))
    };
    let mut table = Table::new("", &["score", "base", "new", "difference"]);
    for one in scores().filter(is_shown) {
        let [base, new] = [one.base, one.new].map(|side| value(one, side));
        let mut verdict = one.verdict.words().to_owned();
        if base == new && one.verdict != Verdict::NoDifferenceShown {
            verdict.push_str(", by less than the digits shown");
        }
        table.push([one.label.clone(), base, new, verdict].map(Into::into));
    }
    let hidden = scores().filter(|one| !is_shown(one));
    table.note = hidden_words(hidden);
    if !table.rows.is_empty() || !table.note.is_empty() {
        section.table(table);
    }
    section
}

/// How many scores are not listed, by why; empty without any.
fn hidden_words<'a>(hidden: impl Iterator<Item = &'a ComparedMetric>) -> String {
    let mut counts = [
        (0, "with no difference shown"),
        (0, "not tested (no interval)"),
        (0, "unavailable on one side"),
    ];
    for one in hidden {
        let index = match one.verdict {
            _ if one.base.is_none() && one.new.is_none() => continue,
            _ if one.base.is_none() || one.new.is_none() => 2,
            Verdict::NotTested => 1,
            _ => 0,
        };
        counts[index].0 += 1;
    }
    let told = counts.iter().filter(|(count, _)| *count > 0);
    let told: Vec<String> = told.map(|(count, why)| format!("{count} {why}")).collect();
    if told.is_empty() {
        String::new()
    } else {
        format!("other scores: {}", told.join(", "))
    }
}

/// Loss of both sides, and how often as long the delays are; those that differ first, then those that lose most.
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
    let has_verdict = |channel: &str| {
        let whole = ["loss", "reordered", "duplicated"].map(|one| metric(channel, None, one));
        let delays = ["p50", "p99"].map(|one| metric(channel, Some(Part::EndToEnd), one));
        let mut all = whole.into_iter().chain(delays).flatten();
        all.any(|one| is_verdict(one.verdict))
    };
    names.sort_by(|one, other| {
        let by_verdict = has_verdict(other).cmp(&has_verdict(one));
        by_verdict.then(share_lost(other).total_cmp(&share_lost(one)))
    });
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
    let mut columns = vec!["channel", "lost, of known fate"];
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
        table.note = format!("and {hidden} more with --full");
    }
    section.table(table);
    section
}

/// Whether the figure differs for certain.
const fn is_verdict(verdict: Verdict) -> bool {
    !matches!(verdict, Verdict::NotTested | Verdict::NoDifferenceShown)
}

fn with_verdict(text: String, verdict: Verdict) -> String {
    if is_verdict(verdict) {
        format!("{text}, {}", verdict.words())
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use hil_present::terminal::render;

    use super::*;
    use crate::compare::ComparedRun;
    use crate::tests::sample::full;

    fn run(loop_count: f64) -> ComparedRun {
        let mut summary = full();
        summary.score[1].value = Some(loop_count);
        summary.score[1].interval = None;
        let idle = ScoreMetric {
            name: "idle".to_owned(),
            label: "idle".to_owned(),
            value: Some(2.0),
            ..summary.score[1].clone()
        };
        summary.score.push(idle);
        ComparedRun {
            folder: PathBuf::from("run"),
            topology: serde_json::Value::Null,
            summary,
        }
    }

    #[test]
    fn a_score_that_changed_without_an_interval_is_listed_and_the_others_counted_by_why() {
        let mut comparison = Comparison::of(&[run(4.0)], &[run(6.0)]);
        let text = render(&[robot(&comparison)], 100, Style::Plain);
        assert!(!text.contains("motion loops"), "{text}");
        assert!(text.contains("2 not tested (no interval)"), "{text}");
        comparison.base.push(PathBuf::from("another"));
        comparison.new.push(PathBuf::from("another"));
        let text = render(&[robot(&comparison)], 100, Style::Plain);
        let changed = text.lines().find(|line| line.contains("motion loops"));
        assert!(
            changed.is_some_and(|line| line.contains("not tested")),
            "{text}"
        );
        let hidden = "other scores: 1 with no difference shown, 1 not tested (no interval)";
        assert!(text.contains(hidden), "{text}");
        assert!(!text.contains("idle"), "{text}");
        // As the score of a run has it.
        let all = render(&[metrics(&comparison)], 100, Style::Plain);
        assert!(all.contains("0.1223 °") && !all.contains("rad "), "{all}");
    }

    #[test]
    fn a_channel_that_differs_stands_before_those_that_lose_more() {
        let mut comparison = Comparison::of(&[run(4.0)], &[run(4.0)]);
        let is_loss = |one: &&ComparedMetric| one.metric == "loss" && one.new.is_some();
        let loss = comparison.figures.iter().find(is_loss).unwrap().clone();
        let of = |name: String, share: f64, verdict| ComparedMetric {
            channel: Some(name),
            new: Some(Estimate {
                value: share,
                interval: None,
            }),
            verdict,
            ..loss.clone()
        };
        comparison.figures = (0..14)
            .map(|index| of(format!("lossy/{index}"), 0.5, Verdict::NotTested))
            .collect();
        let differs = of("arm/command".to_owned(), 0.01, Verdict::LosesMore);
        comparison.figures.push(differs);
        let text = render(&[channels(&comparison)], 100, Style::Plain);
        let first = text
            .lines()
            .find(|line| line.contains('/') && !line.contains("new /"));
        assert!(
            first.is_some_and(|line| line.contains("arm/command")),
            "{text}"
        );
        assert!(text.contains("and 3 more with --full"), "{text}");
    }

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
