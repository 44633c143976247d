//! The report that a run prints: what happened to the robot and why, the network in a table and on one time axis,
//! what to do next, and last the answer. At most fifty lines; `--full` has the rest.

use std::collections::BTreeMap;

use hil_account::ChannelAccount;
use hil_account::network::NetworkMetrics;
use hil_platform::text::{columns, grouped, shell_word, shortened, visible};
use hil_platform::words::counted;

use hil_present::terminal::canvas::{Canvas, INDENT, Style, left, wrapped};
use hil_present::terminal::section;
use hil_present::units::seconds;
use hil_present::{Block, Cell, Event, EventList, Row, Section, Table, Tone, UNAVAILABLE};

use super::answer::AnswerExtent;
use super::{answer, case_lead};
use crate::answer::{Answer, Evidence, Hurt, OCCASIONS_MIN, Unresolved};
use crate::assessment::Assessment;
use crate::network::{ChannelNetwork, NetworkQuantity, Timeline, TimelineRow, TimelineSubject};
use crate::score_event::ExplainedEvent;
use crate::sections::events::{cause, grave_count, gravest_first, robot_head, severity_tone};
use crate::sections::{deadlines, flows, outcome_words, strips};
use crate::simulate::NO_FOLDER;
use crate::summary::{ChannelSummary, Outcome, RunSummary};

/// How much of each kind a page shows.
#[derive(Debug, Clone, Copy)]
struct Extent {
    /// Events of the robot.
    causes: usize,
    channels: usize,
    flows: usize,
    deadlines: usize,
    /// Rows of the robot in the time strip.
    robot_rows: usize,
    answer: AnswerExtent,
}

/// The first whose page has no more than [`LINES_MAX`] rows is taken.
const EXTENTS: [Extent; 4] = [
    Extent {
        causes: 3,
        channels: 6,
        flows: 6,
        deadlines: 6,
        robot_rows: 2,
        answer: AnswerExtent {
            harms: Some(6),
            lines: 5,
        },
    },
    Extent {
        causes: 3,
        channels: 4,
        flows: 4,
        deadlines: 4,
        robot_rows: 1,
        answer: AnswerExtent {
            harms: Some(6),
            lines: 4,
        },
    },
    Extent {
        causes: 2,
        channels: 3,
        flows: 3,
        deadlines: 3,
        robot_rows: 1,
        answer: AnswerExtent {
            harms: Some(4),
            lines: 3,
        },
    },
    Extent {
        causes: 1,
        channels: 2,
        flows: 2,
        deadlines: 2,
        robot_rows: 1,
        answer: AnswerExtent {
            harms: Some(2),
            lines: 2,
        },
    },
];

/// Rows of a page on a terminal, and of these what warnings take beside their text.
const LINES_MAX: usize = 50;
const WARNINGS_FRAME: usize = 3;
/// Columns of a text beside a time.
const EVENT_MARGIN: usize = 16;
/// Columns of a channel's name.
const NAME_WIDTH: usize = 34;
/// Columns of what a command is for.
const NEXT_WIDTH: usize = 24;
/// Channels are alike whose figures differ by less than this share.
const ALIKE_RATIO: f64 = 0.25;

/// The report of a run as text of at most `width_columns` columns (clamped to 80..=120) and 50 rows. Only a command to
/// copy stands on one line however long it is.
pub fn brief(summary: &RunSummary, width_columns: usize, style: Style) -> String {
    let assessment = Assessment::of(summary);
    let answer = Answer::of(summary, &assessment);
    let canvas = || Canvas::new(width_columns, style);
    let commands = next_commands(summary, &answer);
    let has_warnings = !assessment.warnings.is_empty();
    let page = |extent: Extent, commands: &[NextCommand], is_last: bool| {
        let [mut begin, mut between, mut end] = [canvas(), canvas(), canvas()];
        title(&mut begin, summary);
        for one in [
            causes(summary, begin.width(), extent.causes),
            channels(summary, extent.channels),
            flows(summary, extent.flows),
            deadlines(summary, extent.deadlines),
            over_time(summary, extent.robot_rows),
        ] {
            section(&mut begin, &one);
        }
        let folded_rows = next(&mut end, commands);
        answer::answer(&mut end, summary, &assessment, extent.answer);
        let [begin, end] = [begin, end].map(Canvas::finish);
        let rows = begin.lines().count() + end.lines().count() + folded_rows;
        if rows + usize::from(has_warnings) > LINES_MAX && !is_last {
            return None;
        }
        warnings(&mut between, &assessment, LINES_MAX.saturating_sub(rows));
        Some(begin + &between.finish() + &end)
    };
    let [.., least] = EXTENTS;
    let mut extents = EXTENTS.into_iter();
    let mut counts = (0..commands.len()).rev();
    extents
        .find_map(|extent| page(extent, &commands, false))
        .or_else(|| counts.find_map(|count| page(least, &commands[..count], false)))
        .or_else(|| page(least, &[], true))
        .unwrap_or_default()
}

fn title(canvas: &mut Canvas, summary: &RunSummary) {
    let run = &summary.run;
    let facts = format!(
        "{}{} · {} · seed {} · host {}",
        case_lead(run),
        run.name,
        run.started,
        run.seed,
        run.host
    );
    let facts = shortened(&facts, canvas.width());
    canvas.painted_line(Tone::Strong, &facts);
    if run.outcome != Outcome::Completed {
        let (tone, word) = outcome_words(run.outcome);
        let text = shortened(&format!("{word}: {}", run.exit_reason), 2 * canvas.width());
        canvas.paragraph(0, tone, &text);
    }
}

/// What hurt the robot or might have, the gravest first, each with what the network did before.
fn causes(summary: &RunSummary, width: usize, shown_count: usize) -> Section {
    let all = &summary.score_events;
    let evidence = Evidence::of(summary);
    let grave = gravest_first(&all.events);
    let title = "Robot, and the network before it";
    let (mut section, has_grave) = robot_head(summary, title, grave.len() as u64);
    if !has_grave {
        return section;
    }
    // Two lines each at most.
    let room = 2 * (width - EVENT_MARGIN) - 20;
    let event = |event: &&ExplainedEvent| {
        let relation = if evidence.explains(event) {
            "network before it"
        } else {
            "not explained by the network; about then"
        };
        let cause = format!("{relation}: {}", cause(event, summary.network.as_ref()));
        Event {
            at: event.at_s.map_or_else(|| UNAVAILABLE.to_owned(), seconds),
            severity: event.severity_word(),
            tone: severity_tone(event.severity),
            what: shortened(&event.what, room),
            beside: vec![shortened(&cause, room)],
        }
    };
    let events = grave.iter().take(shown_count).map(event).collect();
    let shown = grave.len().min(shown_count) as u64;
    let note = match grave_count(all).saturating_sub(shown) {
        0 => String::new(),
        hidden => format!("and {} of less weight or later", counted(hidden, "event")),
    };
    section
        .blocks
        .push(Block::Events(EventList { events, note }));
    section
}

/// What a channel's line shows.
#[derive(Debug, Clone, PartialEq)]
struct Line {
    delay: Option<[i64; 3]>,
    published_count: u64,
    /// `None` where it is unknown.
    lost_count: Option<u64>,
    gap_ns: Option<i64>,
}

impl Line {
    fn of(account: &ChannelAccount, network: Option<&NetworkMetrics>) -> Self {
        let delay = account.end_to_end.distribution.measured();
        let delay = delay.map(|one| [one.p50_ns, one.p99_ns, one.max_ns]);
        let on_network = network.and_then(|one| one.delay.measured());
        let on_network = on_network.map(|one| [one.p50.value_ns, one.p99.value_ns, one.max_ns]);
        Self {
            delay: delay.or(on_network),
            published_count: account.published_count,
            lost_count: account.lost_known(),
            gap_ns: account.gaps.longest.map(|gap| gap.length_ns),
        }
    }

    fn loss_ratio(&self) -> Option<f64> {
        Some(self.lost_count? as f64 / self.published_count.max(1) as f64)
    }

    /// Where it stands among channels: one whose loss is unknown before those that lost nothing.
    fn rank(&self) -> f64 {
        self.loss_ratio().unwrap_or(f64::MIN_POSITIVE)
    }

    fn lost_words(&self) -> String {
        let published = grouped(self.published_count);
        match self.lost_count {
            Some(count) => format!("{} of {published}", grouped(count)),
            None => format!("unknown of {published}"),
        }
    }

    fn is_alike(&self, other: &Self) -> bool {
        let near =
            |one: f64, other: f64| (one - other).abs() <= ALIKE_RATIO * one.abs().max(other.abs());
        let are_near = |one: Option<f64>, other: Option<f64>| match (one, other) {
            (Some(one), Some(other)) => near(one, other),
            (None, None) => true,
            _ => false,
        };
        let delay = |line: &Self| line.delay.map(|all| all[1] as f64);
        are_near(delay(self), delay(other)) && are_near(self.loss_ratio(), other.loss_ratio())
    }

    /// The worse of both in everything.
    fn worse(&self, other: &Self) -> Self {
        Self {
            delay: match (self.delay, other.delay) {
                (Some(one), Some(two)) => {
                    Some(core::array::from_fn(|index| one[index].max(two[index])))
                }
                (one, two) => one.or(two),
            },
            published_count: self.published_count + other.published_count,
            lost_count: self
                .lost_count
                .zip(other.lost_count)
                .map(|(one, two)| one + two),
            gap_ns: self.gap_ns.max(other.gap_ns),
        }
    }
}

/// Channels whose names differ in one part only, and whose figures are alike.
#[derive(Debug)]
struct Group<'a> {
    names: Vec<&'a str>,
    line: Line,
}

impl Group<'_> {
    /// `egm/{right,left}/command`, or the first and how many more.
    fn name(&self, width: usize) -> String {
        let [first, rest @ ..] = self.names.as_slice() else {
            return String::new();
        };
        if rest.is_empty() {
            return shortened(first, width);
        }
        let index = differing_part(first, rest[0]).unwrap_or(0);
        let of = |name: &str| name.split('/').nth(index).unwrap_or_default().to_owned();
        let all: Vec<String> = self.names.iter().map(|name| of(name)).collect();
        let mut shown: Vec<String> = first.split('/').map(str::to_owned).collect();
        shown[index] = format!("{{{}}}", all.join(","));
        let whole = shown.join("/");
        if whole.chars().count() <= width {
            return whole;
        }
        shortened(&format!("{first} and {} alike", rest.len()), width)
    }
}

/// Which part of two names differs; `None` unless it is exactly one.
fn differing_part(one: &str, other: &str) -> Option<usize> {
    if one.split('/').count() != other.split('/').count() {
        return None;
    }
    let pairs = one.split('/').zip(other.split('/')).enumerate();
    let mut differing = pairs.filter(|(_, (one, other))| one != other);
    let (index, _) = differing.next()?;
    differing.next().is_none().then_some(index)
}

fn groups<'a>(channels: &[&'a ChannelSummary], network: &[ChannelNetwork]) -> Vec<Group<'a>> {
    let mut found: Vec<Group<'_>> = Vec::new();
    for channel in channels {
        let Some(account) = &channel.account else {
            continue;
        };
        let figures = network.iter().find(|one| one.channel == channel.name);
        let line = Line::of(account, figures.map(|one| &one.figures));
        let alike = found.iter_mut().find(|group| {
            let part = differing_part(group.names[0], &channel.name);
            let is_same_part = group
                .names
                .get(1)
                .is_none_or(|second| differing_part(group.names[0], second) == part);
            part.is_some() && is_same_part && group.line.is_alike(&line)
        });
        match alike {
            Some(group) => {
                group.names.push(&channel.name);
                group.line = group.line.worse(&line);
            }
            None => found.push(Group {
                names: vec![&channel.name],
                line,
            }),
        }
    }
    found
}

/// One line a channel, alike ones together, those that lost most first.
fn channels(summary: &RunSummary, shown_count: usize) -> Section {
    // Virtual time knows what the link model did, and no other stage.
    let aside = if summary.run.is_virtual {
        "delay of the link model; lost of those published; gap: none while one was due"
    } else {
        "publication to consumer, delay and loss; gap: none while one was due"
    };
    let mut section = Section::new("channels", "Channels", aside);
    let has_crossed = summary.channels.iter().any(|one| one.link.is_crossing());
    let shown: Vec<&ChannelSummary> = summary
        .channels
        .iter()
        .filter(|one| one.link.is_crossing() || !has_crossed)
        .collect();
    let network = summary.network.as_ref();
    let network = network.map_or(&[][..], |report| &report.channels);
    let mut groups = groups(&shown, network);
    if groups.is_empty() {
        return section;
    }
    groups.sort_by(|one, other| other.line.rank().total_cmp(&one.line.rank()));
    let mut table = Table::new(
        "",
        &["channel", "p50", "p99", "max", "lost", "%", "longest gap"],
    );
    for group in groups.iter().take(shown_count) {
        let line = &group.line;
        let delay = |index: usize| Cell::duration(line.delay.map(|all| all[index]));
        table.rows.push(Row {
            cells: vec![
                group.name(NAME_WIDTH).into(),
                delay(0),
                delay(1),
                delay(2),
                line.lost_words().into(),
                // No rate of a few.
                Cell::share(
                    line.loss_ratio()
                        .filter(|_| line.published_count >= OCCASIONS_MIN),
                ),
                Cell::duration(line.gap_ns),
            ],
            tone: if line.lost_count == Some(0) {
                Tone::Plain
            } else {
                Tone::Caution
            },
            bar: None,
        });
    }
    let hidden = groups.iter().skip(shown_count);
    let hidden: usize = hidden.map(|group| group.names.len()).sum();
    let mut notes = Vec::new();
    if groups.iter().any(|group| group.line.lost_count.is_none()) {
        notes.push("unknown: records that would tell are not at hand".to_owned());
    }
    if hidden > 0 {
        let hidden = counted(hidden as u64, "channel");
        notes.push(format!("and {hidden} that lost no larger share"));
    }
    table.note = notes.join("; ");
    section.table(table);
    section
}

/// The network above, the robot below, on one axis.
fn over_time(summary: &RunSummary, robot_row_count: usize) -> Section {
    let aside = "largest value a column, own scale a row, · unknown";
    let Some(report) = &summary.network else {
        return Section::new("over-time", "", aside);
    };
    let mut section = Section::new("over-time", report.timeline.title(), aside);
    let mut rows = Vec::new();
    for quantity in [NetworkQuantity::Loss, NetworkQuantity::Delay] {
        rows.extend(worst_of(&report.timeline.rows, quantity));
    }
    let robot = report.timeline.rows.iter();
    let robot = robot.filter(|row| matches!(row.subject, TimelineSubject::Robot { .. }));
    rows.extend(robot.take(robot_row_count).cloned());
    let step_s = report.timeline.step_s;
    let strips = strips(&Timeline { step_s, rows }, &summary.link_changes);
    section.blocks.extend(strips.map(Block::Strips));
    section
}

fn larger(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.max(other)),
        (one, other) => one.or(other),
    }
}

/// The worst channel in each step.
fn worst_of(rows: &[TimelineRow], quantity: NetworkQuantity) -> Option<TimelineRow> {
    let of_channels: BTreeMap<&str, &TimelineRow> = rows
        .iter()
        .filter_map(|row| match &row.subject {
            TimelineSubject::Channel {
                channel,
                quantity: found,
            } if *found == quantity => Some((channel.as_str(), row)),
            _ => None,
        })
        .collect();
    let first = of_channels.values().next()?;
    let mut worst = TimelineRow {
        subject: TimelineSubject::Channel {
            channel: "worst channel".to_owned(),
            quantity,
        },
        ..(*first).clone()
    };
    for row in of_channels.values().skip(1) {
        for (known, value) in worst.values.iter_mut().zip(&row.values) {
            *known = larger(*known, *value);
        }
        worst.bound = larger(worst.bound, row.bound);
    }
    Some(worst)
}

/// As many as there is room for, in `room` lines; none of them cut short.
fn warnings(canvas: &mut Canvas, assessment: &Assessment, room: usize) {
    let all = &assessment.warnings;
    if all.is_empty() {
        return;
    }
    if room < WARNINGS_FRAME {
        let text = format!("{} with --full", counted(all.len() as u64, "warning"));
        canvas.painted_line(Tone::Caution, &text);
        return;
    }
    let mut left = room - WARNINGS_FRAME;
    let mut shown = Vec::new();
    for warning in all {
        let rows = wrapped(warning, canvas.width() - INDENT).len();
        if rows > left {
            break;
        }
        left -= rows;
        shown.push(warning);
    }
    canvas.heading("Warnings", "");
    for warning in &shown {
        canvas.paragraph(INDENT, Tone::Caution, warning);
    }
    let hidden = (all.len() - shown.len()) as u64;
    if hidden > 0 {
        let text = format!("{} with --full", counted(hidden, "further warning"));
        canvas.paragraph(INDENT, Tone::Faint, &text);
    }
}

/// A command to copy.
#[derive(Debug)]
struct NextCommand {
    /// What it is for.
    what: &'static str,
    /// As a shell takes it.
    command: String,
}

/// Three commands with this run's paths, the one that makes a better answer first.
fn next_commands(summary: &RunSummary, answer: &Answer) -> Vec<NextCommand> {
    let run = &summary.run;
    let mut commands = Vec::new();
    let mut push = |what, command| commands.push(NextCommand { what, command });
    match &answer.hurt {
        Hurt::NotResolvable {
            because: Unresolved::SampleTooSmall { count, .. },
        } => {
            let factor = OCCASIONS_MIN.div_ceil((*count).max(1)) as f64 * 1.2;
            let length_s = (run.duration_s * factor).ceil();
            push(
                "a sample large enough",
                format!(
                    "{} --set 'run.duration=\"{length_s} s\"'",
                    without_duration(&run.repeat_command)
                ),
            );
        }
        Hurt::NotResolvable {
            because: Unresolved::InvalidMeasurement,
        } => push("what hinders this host", "hil-runtime doctor".to_owned()),
        Hurt::NotResolvable {
            because: Unresolved::ClocksDiffer,
        } => push("what aligns the clocks", "hil-runtime doctor".to_owned()),
        _ => {}
    }
    if run.folder == NO_FOLDER {
        let command = format!("{} -o FOLDER", run.repeat_command);
        push("to keep this run", command);
    } else {
        let folder = shell_word(&run.folder);
        push(
            "as a page",
            format!("hil-runtime report {folder} -o report.html"),
        );
        push(
            "every figure",
            format!("hil-runtime report {folder} --full"),
        );
        push(
            "against a clean run",
            format!("hil-runtime compare CLEAN-RUN {folder}"),
        );
    }
    commands.truncate(3);
    commands
}

/// Draws the commands; how many rows of a terminal they take beside their lines.
fn next(canvas: &mut Canvas, commands: &[NextCommand]) -> usize {
    if commands.is_empty() {
        return 0;
    }
    canvas.heading("Next", "");
    let mut folded_rows = 0;
    for NextCommand { what, command } in commands {
        let lead = format!("{:INDENT$}{}", "", left(what, NEXT_WIDTH));
        let command = visible(command);
        if columns(&lead) + columns(&command) <= canvas.width() {
            let lead = canvas.paint(Tone::Faint, &lead);
            canvas.line(&format!("{lead}{command}"));
        } else {
            canvas.painted_line(Tone::Faint, lead.trim_end());
            canvas.line(&command);
            folded_rows += (columns(&command).max(1) - 1) / canvas.width();
        }
    }
    folded_rows
}

/// A command without the lengths that it was given, with quotes or without.
fn without_duration(command: &str) -> String {
    const BEGIN: &str = " --set run.duration=";
    let mut left = command.replace(" --set 'run.duration=", &format!("{BEGIN}'"));
    while let Some((before, rest)) = left.split_once(BEGIN) {
        let rest = match rest.strip_prefix('\'') {
            Some(quoted) => quoted.split_once('\'').map_or("", |(_, rest)| rest),
            None => rest.find(' ').map_or("", |end| &rest[end..]),
        };
        left = before.to_owned() + rest;
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_length_that_was_given_is_taken_out_however_it_was_written() {
        for given in [
            "run.duration=6s",
            "'run.duration=\"6 s\"'",
            "'run.duration=6 s' --set run.duration=7s",
        ] {
            let command = format!("hil-runtime --topology a.toml --set {given} --set run.seed=3");
            assert_eq!(
                without_duration(&command),
                "hil-runtime --topology a.toml --set run.seed=3"
            );
        }
        assert_eq!(
            without_duration("hil-runtime --set run.duration=6s"),
            "hil-runtime"
        );
    }

    #[test]
    fn the_bound_of_the_worst_channel_is_the_largest() {
        let row = |channel: &str, values: [f64; 2], bound| TimelineRow {
            subject: TimelineSubject::Channel {
                channel: channel.to_owned(),
                quantity: NetworkQuantity::Delay,
            },
            unit: "s".to_owned(),
            values: values.map(Some).into(),
            bound,
        };
        let rows = [
            row("a", [1e-3, 5e-3], Some(1e-6)),
            row("b", [2e-3, 4e-3], Some(40e-6)),
            row("c", [0.0, 0.0], None),
        ];
        let worst = worst_of(&rows, NetworkQuantity::Delay).unwrap();
        assert_eq!(worst.values, [2e-3, 5e-3].map(Some));
        assert_eq!(worst.bound, Some(40e-6));
    }
}
