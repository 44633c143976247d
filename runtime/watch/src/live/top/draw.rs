//! A [`View`] drawn on a page of characters. It asks nobody: equal views give equal pages.

use core::fmt::Write as _;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::{Color, Modifier, Style};

use super::view::{ChannelRow, ProcessRow, Quantiles, View};
use hil_platform::text::shortened;
use hil_present::units::{JOINT, duration, percent, unsigned_duration};

/// Longest bar of the run's progress, columns.
const BAR_COLUMNS: usize = 30;
/// Windows that a sparkline shows.
pub(crate) const HISTORY_COLUMNS: usize = 16;
/// Rows that say which run it is and how far it is.
const HEAD_ROWS: usize = 2;
/// Narrowest page with the sparkline beside each channel.
const SPARKLINE_FROM: usize = 90;
/// Longest names of processes, channels and segments, columns.
const NAME_COLUMNS: usize = 28;

const TITLE: Style = Style::new().add_modifier(Modifier::BOLD);
const QUIET: Style = Style::new().fg(Color::DarkGray);
const BAD: Style = Style::new().fg(Color::Red);
const CHOSEN: Style = Style::new().add_modifier(Modifier::REVERSED);
const NORMAL: Style = Style::new();

/// What the person at the terminal wants to see.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Detail {
    /// The segments of every channel: a page that nobody can scroll.
    All,
    /// Those of the channel with this place.
    Chosen(usize),
}

/// What is drawn beside the view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Frame {
    /// Whose segments.
    pub(crate) detail: Detail,
    /// The view stands still.
    pub(crate) is_paused: bool,
    /// The keys are explained in place of the view.
    pub(crate) shows_help: bool,
}

/// One row of the page.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Line {
    text: String,
    style: Style,
}

fn line(text: impl AsRef<str>, style: Style) -> Line {
    // No line breaks here, so a blank that forbids it is a blank.
    let text = text.as_ref().replace(JOINT, " ");
    Line { text, style }
}

/// The page as plain text, at most `columns` wide.
pub(crate) fn plain(view: &View, columns: usize) -> String {
    let frame = Frame {
        detail: Detail::All,
        is_paused: false,
        shows_help: false,
    };
    let mut text = String::new();
    for line in body(view, frame, columns) {
        let row = shortened(&line.text, columns);
        writeln!(text, "{}", row.trim_end()).expect("writing to a string cannot fail");
    }
    text
}

/// The page in `area` of a terminal; the last row tells of the keys. What does not fit is left out,
/// and the last row but one says so.
pub(crate) fn draw(view: &View, frame: Frame, area: Rect, buffer: &mut Buffer) {
    let columns = usize::from(area.width);
    let rows = usize::from(area.height);
    let Some(body_rows) = rows.checked_sub(1) else {
        return;
    };
    let mut lines = if frame.shows_help {
        help()
    } else {
        body(view, frame, columns)
    };
    if lines.len() > body_rows {
        cut(&mut lines, body_rows);
    }
    lines.truncate(body_rows);
    for (line, y) in lines.iter().zip(area.y..) {
        buffer.set_stringn(area.x, y, &line.text, columns, line.style);
    }
    let pause = if frame.is_paused { "PAUSED  " } else { "" };
    let keys = format!("{pause}q end  ↑↓ channel  space pause  ? help");
    let last = area.y + area.height - 1;
    buffer.set_stringn(area.x, last, keys, columns, QUIET);
}

/// Leaves `rows` of `lines`: the head, the chosen channel and what is around it.
fn cut(lines: &mut Vec<Line>, rows: usize) {
    let kept_count = rows.saturating_sub(1);
    let hidden_count = lines.len() - kept_count.min(lines.len());
    let chosen = lines.iter().position(|line| line.style == CHOSEN);
    if let Some(chosen) = chosen
        && chosen >= kept_count
    {
        let passed_count = chosen + 1 - kept_count;
        let head_count = HEAD_ROWS.min(lines.len());
        let until = (head_count + passed_count).min(lines.len());
        lines.drain(head_count..until);
    }
    lines.truncate(kept_count);
    let text = format!("… {hidden_count} more rows; a higher window shows them");
    lines.push(line(text, QUIET));
}

fn help() -> Vec<Line> {
    let text = "\
KEYS
  q, Esc, Ctrl-C   end; the run goes on
  ↑ ↓, k j         choose the channel whose segments are shown
  space            hold the figures, and let them go again
  ?                this page, and back

FIGURES
  rate, lost and delays are of the last window only, of what this host recorded.
  \"-\" stands for what this host cannot know; the run's report may, with the other
  host's records. Overruns are ticks of a role's timer that passed without it.
  The little bars are the 99th percentiles of the delay in the windows before.";
    let rows = text.lines().map(|row| {
        let is_title = !row.starts_with(' ') && !row.is_empty();
        line(row, if is_title { TITLE } else { NORMAL })
    });
    rows.collect()
}

fn body(view: &View, frame: Frame, columns: usize) -> Vec<Line> {
    let mut lines = head(view);
    processes(view, &mut lines);
    elsewhere(view, &mut lines);
    channels(view, frame, columns, &mut lines);
    links(view, &mut lines);
    clocks(view, &mut lines);
    for problem in &view.problems {
        lines.push(line(format!("! {problem}"), BAD));
    }
    lines
}

fn head(view: &View) -> Vec<Line> {
    let run = &view.run;
    let mut lines = vec![line(
        format!(
            "{}  {}  on {}",
            run.name,
            run.state,
            run.hosts_here.join(", ")
        ),
        TITLE,
    )];
    let time = |seconds: f64| format!("{seconds:.1} s");
    let seen = if run.elapsed_s.is_some() {
        "; the figures are the last ones from while it ran"
    } else {
        ""
    };
    let text = match (run.elapsed_s, run.duration_s, view.progress_ratio()) {
        _ if view.is_over() => format!("over{seen}"),
        (Some(elapsed_s), Some(duration_s), Some(ratio)) => {
            let left = time((duration_s - elapsed_s).max(0.0));
            let (whole, of) = (time(elapsed_s), time(duration_s));
            format!("{} {whole} of {of}, {left} left", bar(ratio))
        }
        (Some(elapsed_s), ..) => format!("{} so far", time(elapsed_s)),
        _ => "not begun".to_owned(),
    };
    lines.push(line(text, NORMAL));
    lines
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a ratio of 0 to 1 of a few columns"
)]
fn bar(ratio: f64) -> String {
    let full = (ratio * BAR_COLUMNS as f64).floor() as usize;
    let rest = BAR_COLUMNS - full.min(BAR_COLUMNS);
    format!(
        "[{}{}]",
        "█".repeat(full.min(BAR_COLUMNS)),
        "·".repeat(rest)
    )
}

fn title(text: String, lines: &mut Vec<Line>) {
    lines.push(line(String::new(), NORMAL));
    lines.push(line(text, TITLE));
}

fn processes(view: &View, lines: &mut Vec<Line>) {
    let name_columns = width(view.processes.iter().map(|one| one.name.as_str()), 9);
    title(
        format!(
            "{:name_columns$} {:>7} {:>6} {:>8} {:>9} {:>8} {:>8}  state",
            "PROCESSES", "pid", "cpu", "on cpus", "sched", "overruns", "restarts"
        ),
        lines,
    );
    for one in &view.processes {
        let cpu = one.cpu_ratio.map(|ratio| format!("{:.1}%", 100.0 * ratio));
        let text = format!(
            "{:name_columns$} {:>7} {:>6} {:>8} {:>9} {:>8} {:>8}  {}",
            shortened(&one.name, name_columns),
            known(one.pid.map(|pid| pid.to_string())),
            known(cpu),
            known(one.cpus.clone()),
            known(one.scheduling.clone()),
            known(one.overrun_count.map(|count| count.to_string())),
            one.restart_count,
            state_of(one),
        );
        let style = if one.state.is_alive() { NORMAL } else { BAD };
        lines.push(line(text, style));
    }
}

/// Whether other hosts keep up: what passed without their processes is no delay of the network.
fn elsewhere(view: &View, lines: &mut Vec<Line>) {
    for one in &view.elsewhere {
        let mut each: Vec<String> = one
            .overruns
            .iter()
            .map(|(process, count)| format!("{process} {count}"))
            .collect();
        if one.hearing.left_out_count > 0 {
            each.push(format!("{} more", one.hearing.left_out_count));
        }
        let each = each.join(", ");
        let host = &one.hearing.host;
        let (text, style) = match (one.hearing.is_heard, each.as_str()) {
            (true, "") => (format!("{host}: no overruns"), NORMAL),
            (true, each) => (format!("{host}: overruns {each}"), BAD),
            (false, each) => {
                let silence = one.hearing.silent_s.map_or_else(
                    || "not heard yet".to_owned(),
                    |silent_s| format!("not heard for {silent_s:.0} s"),
                );
                let last = if each.is_empty() { "" } else { "; last told: " };
                let text = format!("{host}: overruns unavailable, {silence}{last}{each}");
                (text, BAD)
            }
        };
        lines.push(line(text, style));
    }
}

fn state_of(process: &ProcessRow) -> String {
    let label = process.kind.label(process.role.as_deref());
    format!("{} ({label} on {})", process.state, process.host)
}

fn channels(view: &View, frame: Frame, columns: usize, lines: &mut Vec<Line>) {
    let names = view.channels.iter().map(|one| one.name.as_str());
    let name_columns = width(names, 8);
    let has_sparkline = columns >= SPARKLINE_FROM;
    let spark = if has_sparkline { "  p99 before" } else { "" };
    title(
        format!(
            "{:name_columns$} {:>9} {:>7} {:>9} {:>9} {:>9}  {:14}{spark}",
            "CHANNELS", "rate", "lost", "p50", "p99", "bound", "via"
        ),
        lines,
    );
    for (index, one) in view.channels.iter().enumerate() {
        let [p50, p99] = quantiles(one.delay);
        let spark = if has_sparkline {
            format!("  {}", sparkline(&one.history_ns))
        } else {
            String::new()
        };
        let text = format!(
            "{:name_columns$} {:>9} {:>7} {p50:>9} {p99:>9} {:>9}  {:14}{spark}",
            shortened(&one.name, name_columns),
            known(one.rate_hz.map(rate)),
            known(one.lost_count.map(|count| count.to_string())),
            known(one.bound_ns.map(bound)),
            shortened(&one.via, 14),
        );
        let is_chosen = frame.detail == Detail::Chosen(index);
        let has_losses = one.lost_count.is_some_and(|count| count > 0);
        let style = if has_losses { BAD } else { NORMAL };
        lines.push(line(text, if is_chosen { CHOSEN } else { style }));
        if is_chosen || frame.detail == Detail::All {
            segments(one, lines);
        }
    }
}

fn segments(channel: &ChannelRow, lines: &mut Vec<Line>) {
    if let Some(why) = &channel.why_no_delay {
        lines.push(line(format!("    delay unavailable: {why}"), QUIET));
    }
    for segment in &channel.segments {
        let [p50, p99] = quantiles(segment.time);
        let text = format!("    {:40} {p50:>9} {p99:>9}", segment.name);
        lines.push(line(text, QUIET));
    }
}

fn links(view: &View, lines: &mut Vec<Line>) {
    if view.links.is_empty() {
        return;
    }
    let name_columns = width(view.links.iter().map(|one| one.name.as_str()), 8);
    title(
        format!(
            "{:name_columns$} {:13} {:8} {:>8}  condition",
            "LINKS", "via", "state", "loss"
        ),
        lines,
    );
    for one in &view.links {
        let text = format!(
            "{:name_columns$} {:13} {:8} {:>8}  {}",
            shortened(&one.name, name_columns),
            one.via,
            one.state.label(),
            known(one.loss_ratio.map(percent)),
            one.condition.as_deref().unwrap_or("-"),
        );
        lines.push(line(text, NORMAL));
    }
}

fn clocks(view: &View, lines: &mut Vec<Line>) {
    if view.clocks.is_empty() {
        return;
    }
    let pair = |from: &str, to: &str| format!("{from} → {to}");
    let pairs: Vec<String> = view
        .clocks
        .iter()
        .map(|one| pair(&one.from, &one.to))
        .collect();
    let name_columns = width(pairs.iter().map(String::as_str), 8);
    title(
        format!(
            "{:name_columns$} {:>12} {:>9}  rung",
            "CLOCKS", "offset", "bound"
        ),
        lines,
    );
    for (one, pair) in view.clocks.iter().zip(pairs) {
        let count = one
            .exchange_count
            .map_or_else(String::new, |count| format!(", {count} in half a minute"));
        let text = format!(
            "{:name_columns$} {:>12} {:>9}  {}{count}",
            shortened(&pair, name_columns),
            known(one.offset_ns.map(duration)),
            known(one.bound_ns.map(bound)),
            one.rung,
        );
        lines.push(line(text, NORMAL));
    }
}

/// Columns of the longest name, within bounds.
fn width<'a>(names: impl Iterator<Item = &'a str>, least: usize) -> usize {
    let longest = names.map(|name| name.chars().count()).max();
    longest.unwrap_or(0).clamp(least, NAME_COLUMNS)
}

fn known(value: Option<String>) -> String {
    value.unwrap_or_else(|| "-".to_owned())
}

fn quantiles(time: Option<Quantiles>) -> [String; 2] {
    [
        known(time.map(|time| duration(time.p50_ns))),
        known(time.map(|time| duration(time.p99_ns))),
    ]
}

fn rate(rate_hz: f64) -> String {
    format!("{rate_hz:.1} Hz")
}

fn bound(bound_ns: u64) -> String {
    let text = unsigned_duration(bound_ns);
    if bound_ns == 0 {
        text
    } else {
        format!("±{text}")
    }
}

/// A column per window, as high as its figure against the highest one shown; a blank where there
/// was none.
fn sparkline(history_ns: &[Option<i64>]) -> String {
    const STEPS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let shown = &history_ns[history_ns.len().saturating_sub(HISTORY_COLUMNS)..];
    let highest = shown.iter().flatten().copied().max().unwrap_or(0).max(1);
    let column = |value: &Option<i64>| {
        let Some(value) = value else {
            return ' ';
        };
        let value = i128::from((*value).clamp(0, highest));
        let step = value * 8 / i128::from(highest);
        STEPS[usize::try_from(step).unwrap_or(0).min(7)]
    };
    shown.iter().map(column).collect()
}

#[cfg(test)]
#[path = "draw_tests.rs"]
mod tests;
