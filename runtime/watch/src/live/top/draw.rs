//! A [`View`] as sections, and these on a page of characters. It asks nobody: equal views give equal pages.

use ansi_to_tui::IntoText;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style as Look};
use ratatui::text::Line;

use super::view::{ChannelRow, ProcessRow, Quantiles, SegmentRow, View};
use hil_core::case_study::Severity;
use hil_platform::text::shortened;
use hil_platform::words::counted;
use hil_present::terminal::canvas::{Canvas, Style, bar, left};
use hil_present::terminal::section;
use hil_present::{Cell, Row, Section, Table, Tone, UNAVAILABLE};

/// Longest bar of the run's progress, columns.
const BAR_COLUMNS: usize = 30;
/// Windows that a sparkline shows.
pub(crate) const HISTORY_COLUMNS: usize = 16;
/// Rows that say which run it is and how far it is.
const HEAD_ROWS: usize = 2;

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

/// The page as plain text, at most `columns` wide.
pub(crate) fn plain(view: &View, columns: usize) -> String {
    let page = page(&sections(view, Detail::All), columns, Style::Plain);
    let rows = page.lines().map(|row| shortened(row, columns) + "\n");
    rows.collect()
}

/// The page in `area` of a terminal; the last row tells of the keys. What does not fit is left out,
/// and the last row but one says so.
pub(crate) fn draw(view: &View, frame: Frame, area: Rect, buffer: &mut Buffer) {
    let columns = usize::from(area.width);
    let rows = usize::from(area.height);
    let Some(body_rows) = rows.checked_sub(1) else {
        return;
    };
    let sections = if frame.shows_help {
        help()
    } else {
        sections(view, frame.detail)
    };
    let text = page(&sections, columns, Style::Coloured);
    let text = text.into_text();
    let mut lines = text.expect("the sequences are our own").lines;
    if lines.len() > body_rows {
        cut(&mut lines, body_rows);
    }
    for (line, y) in lines.iter().take(body_rows).zip(area.y..) {
        buffer.set_line(area.x, y, line, area.width);
    }
    let pause = if frame.is_paused { "PAUSED  " } else { "" };
    let keys = format!("{pause}q end  ↑↓ channel  space pause  ? help");
    let last = area.y + area.height - 1;
    let look = Look::new().add_modifier(Modifier::DIM);
    buffer.set_stringn(area.x, last, keys, columns, look);
}

/// Leaves `rows` of `lines`: the head, the chosen channel and what is around it.
fn cut(lines: &mut Vec<Line<'_>>, rows: usize) {
    let kept_count = rows.saturating_sub(1);
    let hidden_count = lines.len() - kept_count.min(lines.len());
    let is_chosen = |line: &Line<'_>| {
        let mut spans = line.spans.iter();
        spans.any(|span| span.style.add_modifier.contains(Modifier::REVERSED))
    };
    if let Some(chosen) = lines.iter().position(is_chosen)
        && chosen >= kept_count
    {
        let passed_count = chosen + 1 - kept_count;
        let head_count = HEAD_ROWS.min(lines.len());
        let until = (head_count + passed_count).min(lines.len());
        lines.drain(head_count..until);
    }
    lines.truncate(kept_count);
    let text = format!("… {hidden_count} more rows; a higher window shows them");
    lines.push(Line::raw(text));
}

/// Sections with an empty row between them.
fn page(sections: &[Section], columns: usize, style: Style) -> String {
    let mut canvas = Canvas::new(columns, style);
    let sections = sections.iter().filter(|one| !one.is_empty());
    for (index, one) in sections.enumerate() {
        if index > 0 && one.title.is_empty() {
            canvas.blank();
        }
        section(&mut canvas, one);
    }
    let text = canvas.finish();
    text.trim_start_matches('\n').to_owned()
}

fn help() -> Vec<Section> {
    let mut keys = Section::new("keys", "Keys", "");
    for (key, what) in [
        ("q, Esc, Ctrl-C", "end; the run goes on"),
        ("↑ ↓, k j", "choose the channel whose segments are shown"),
        ("space", "hold the figures, and let them go again"),
        ("?", "this page, and back"),
    ] {
        keys.fact(key, Tone::Plain, what);
    }
    let mut figures = Section::new("figures", "Figures", "");
    for text in [
        "Rate, lost and delays are of the last window only, of what this host recorded.",
        "\"–\" stands for what this host cannot know; the run's report may, with the other host's \
         records. Overruns are ticks of a role's timer that passed without it.",
        "The little bars are the 99th percentiles of the delay in the windows before.",
    ] {
        figures.note(Tone::Plain, text);
    }
    vec![keys, figures]
}

/// The run, what its links do, its channels, its robot, its processes and hosts, and its clocks.
fn sections(view: &View, detail: Detail) -> Vec<Section> {
    let mut problems = Section::new("problems", "", "");
    for problem in &view.problems {
        problems.note(Tone::Bad, format!("! {problem}"));
    }
    vec![
        head(view),
        links(view),
        channels(view, detail),
        robot(view),
        processes(view),
        elsewhere(view),
        clocks(view),
        problems,
    ]
}

fn head(view: &View) -> Section {
    let run = &view.run;
    let hosts = run.hosts_here.join(", ");
    let title = format!("{}  {}  on {hosts}", run.name, run.state);
    let mut section = Section::new("run", title, "");
    let time = |seconds: f64| format!("{seconds:.1} s");
    let seen = if run.elapsed_s.is_some() {
        "; the figures are the last ones from while it ran"
    } else {
        ""
    };
    let text = match (run.elapsed_s, run.duration_s, view.progress_ratio()) {
        _ if view.is_over() => format!("over{seen}"),
        (Some(elapsed_s), Some(duration_s), Some(ratio)) => {
            let bar = left(&bar(0.0, ratio, BAR_COLUMNS), BAR_COLUMNS);
            let rest = time((duration_s - elapsed_s).max(0.0));
            let (whole, of) = (time(elapsed_s), time(duration_s));
            // A blank that a line may break at would end the bar.
            let bar = bar.replace(' ', "·");
            format!("{bar} {whole} of {of}, {rest} left")
        }
        (Some(elapsed_s), ..) => format!("{} so far", time(elapsed_s)),
        _ => "not begun".to_owned(),
    };
    section.note(Tone::Plain, text);
    section
}

/// A section of one table; nothing without rows.
fn tabled(id: &str, table: Table) -> Section {
    let mut section = Section::new(id, "", "");
    if !table.rows.is_empty() {
        section.table(table);
    }
    section
}

fn links(view: &View) -> Section {
    let loss = format!("loss, {}", window(view));
    let mut table = Table::new("", &["LINKS", "via", "state", &loss, "condition"]);
    for one in &view.links {
        table.push([
            one.name.as_str().into(),
            one.via.as_str().into(),
            one.state.label().into(),
            Cell::share(one.loss_ratio),
            one.condition.as_deref().map_or(Cell::Missing, Cell::from),
        ]);
    }
    tabled("links", table)
}

/// How far the figures reach back.
fn window(view: &View) -> String {
    format!("{} s", view.run.window_s)
}

fn channels(view: &View, detail: Detail) -> Section {
    let [rate, lost] = ["Hz", "lost"].map(|what| format!("{what}, {}", window(view)));
    let columns = [
        "CHANNELS",
        &rate,
        &lost,
        "p50",
        "p99",
        "± clocks",
        "via",
        "p99 before",
    ];
    let mut table = Table::new("", &columns).ranked("p99 before", 1);
    for (index, one) in view.channels.iter().enumerate() {
        let is_chosen = detail == Detail::Chosen(index);
        let tone = match one.lost_count {
            _ if is_chosen => Tone::Chosen,
            Some(1..) => Tone::Bad,
            _ => Tone::Plain,
        };
        let [p50, p99] = quantiles(one.delay);
        let bound_ns = one.bound_ns.map(|ns| i64::try_from(ns).unwrap_or(i64::MAX));
        let history = one.history_ns.iter();
        let history = history.map(|ns| ns.map(|ns| ns as f64)).collect();
        let cells = vec![
            one.name.as_str().into(),
            Cell::number(one.rate_hz, 1),
            Cell::count(one.lost_count),
            p50,
            p99,
            Cell::duration(bound_ns),
            one.via.as_str().into(),
            Cell::Spark(history),
        ];
        let bar = None;
        table.rows.push(Row { cells, tone, bar });
        if is_chosen || detail == Detail::All {
            table.rows.extend(segments(one));
        }
    }
    tabled("channels", table)
}

/// The parts of a channel's way below it, or why there is no delay.
fn segments(channel: &ChannelRow) -> impl Iterator<Item = Row> {
    let why = channel.why_no_delay.iter().map(|why| {
        let text = format!("delay {UNAVAILABLE}: {why}");
        vec![Cell::from(""), text.into()]
    });
    let segment = |one: &SegmentRow| {
        let [p50, p99] = quantiles(one.time);
        let name = format!("  {}", one.name).into();
        let nothing = || Cell::from("");
        let rest = [nothing(), nothing(), nothing()];
        let mut cells = vec![name, nothing(), nothing(), p50, p99];
        cells.extend(rest);
        cells
    };
    let rows = why.chain(channel.segments.iter().map(segment));
    rows.map(|cells| Row {
        cells,
        tone: Tone::Faint,
        bar: None,
    })
}

fn robot(view: &View) -> Section {
    let Some(robot) = &view.robot else {
        return Section::new("robot", "", "");
    };
    let mut table = Table::new("", &["ROBOT", "at", "what"]);
    for one in &robot.recent {
        let (tone, word) = match one.severity {
            Severity::Notice => (Tone::Plain, "notice"),
            Severity::Hazard => (Tone::Caution, "hazard"),
            Severity::Incident => (Tone::Bad, "incident"),
        };
        let at = one
            .at_s
            .map_or(Cell::Missing, |at_s| format!("{at_s:.1} s").into());
        let cells = vec![word.into(), at, one.what.as_str().into()];
        let bar = None;
        table.rows.push(Row { cells, tone, bar });
    }
    let mut section = tabled("robot", table);
    let hidden_count = robot.event_count - robot.recent.len() as u64;
    let text = match (robot.event_count, robot.is_behind) {
        (_, true) => "ROBOT  the run so far is still being read".to_owned(),
        (0, false) => "ROBOT  no event".to_owned(),
        _ if hidden_count > 0 => format!(
            "and {} before or of less weight",
            counted(hidden_count, "event")
        ),
        _ => return section,
    };
    section.note(Tone::Faint, text);
    section
}

fn processes(view: &View) -> Section {
    let columns = [
        "PROCESSES",
        "pid",
        "cpu",
        "on cpus",
        "sched",
        "overruns",
        "restarts",
        "state",
    ];
    let mut table = Table::new("", &columns);
    for one in &view.processes {
        let text = |text: Option<String>| text.map_or(Cell::Missing, Cell::Text);
        let cells = vec![
            one.name.as_str().into(),
            text(one.pid.map(|pid| pid.to_string())),
            Cell::share(one.cpu_ratio),
            text(one.cpus.clone()),
            text(one.scheduling.clone()),
            Cell::count(one.overrun_count),
            Cell::Count(u64::from(one.restart_count)),
            state_of(one).into(),
        ];
        let tone = if one.state.is_alive() {
            Tone::Plain
        } else {
            Tone::Bad
        };
        let bar = None;
        table.rows.push(Row { cells, tone, bar });
    }
    tabled("processes", table)
}

fn state_of(process: &ProcessRow) -> String {
    let label = process.kind.label(process.role.as_deref());
    format!("{} ({label} on {})", process.state, process.host)
}

/// Whether other hosts keep up: what passed without their processes is no delay of the network.
fn elsewhere(view: &View) -> Section {
    let mut section = Section::new("elsewhere", "", "");
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
        let (tone, text) = match (one.hearing.is_heard, each.as_str()) {
            (true, "") => (Tone::Plain, "no overruns".to_owned()),
            (true, each) => (Tone::Bad, format!("overruns {each}")),
            (false, each) => {
                let silence = one.hearing.silent_s.map_or_else(
                    || "not heard yet".to_owned(),
                    |silent_s| format!("not heard for {silent_s:.0} s"),
                );
                let last = if each.is_empty() { "" } else { "; last told: " };
                let text = format!("overruns {UNAVAILABLE}, {silence}{last}{each}");
                (Tone::Bad, text)
            }
        };
        section.fact(&one.hearing.host, tone, text);
    }
    section
}

fn clocks(view: &View) -> Section {
    let mut table = Table::new("", &["CLOCKS", "offset", "±", "rung"]);
    for one in &view.clocks {
        let count = one
            .exchange_count
            .map_or_else(String::new, |count| format!(", {count} in half a minute"));
        let bound_ns = one.bound_ns.map(|ns| i64::try_from(ns).unwrap_or(i64::MAX));
        table.push([
            format!("{} → {}", one.from, one.to).into(),
            Cell::duration(one.offset_ns),
            Cell::duration(bound_ns),
            format!("{}{count}", one.rung).into(),
        ]);
    }
    tabled("clocks", table)
}

fn quantiles(time: Option<Quantiles>) -> [Cell; 2] {
    let each = time.map(|time| [time.p50_ns, time.p99_ns]);
    each.map_or([Cell::Missing, Cell::Missing], |both| {
        both.map(Cell::Duration)
    })
}

#[cfg(test)]
#[path = "draw_tests.rs"]
mod tests;
