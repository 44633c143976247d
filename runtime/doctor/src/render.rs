//! The doctor's report as text: the worst first, what is ok in one line each, the measurement where
//! one was asked for, a summary last. It returns a string; who prints it, and whether the terminal
//! takes colour, is the caller's business.

use core::fmt::Write as _;

use anstyle::{AnsiColor, Style};
use hil_platform::host_facts::Fact;
use hil_platform::realtime::{GrantOutcome, RealtimeGrantItem};
use hil_platform::words::plural;

use super::latency::{LatencyReport, Quantiles, Standing, us_up};
use super::{DoctorReport, Finding, Severity};

/// Columns of a page.
const WIDTH: usize = 100;
/// Columns of the severity.
const LABEL: usize = 11;
/// Columns before the words of `why`, `fix` and `from`.
const INDENT: usize = 14;

const GOOD: Style = AnsiColor::Green.on_default();
const PLAIN: Style = Style::new().dimmed();
const UNKNOWN: Style = AnsiColor::Cyan.on_default();
const CAREFUL: Style = AnsiColor::Yellow.on_default().bold();
const BAD: Style = AnsiColor::Red.on_default().bold();

/// `word` in the colour of its tone.
fn mark(word: &str, tone: Style, has_colour: bool) -> String {
    if has_colour {
        format!("{tone}{word}{tone:#}")
    } else {
        word.to_owned()
    }
}

/// The word for people, of one width, and its tone.
fn label(severity: Severity) -> (&'static str, Style) {
    match severity {
        Severity::Ok => ("ok         ", GOOD),
        Severity::Note => ("note       ", PLAIN),
        Severity::CannotTell => ("cannot tell", UNKNOWN),
        Severity::Warning => ("WARNING    ", CAREFUL),
        Severity::Error => ("ERROR      ", BAD),
    }
}

impl DoctorReport {
    /// The report: the worst findings first, each with why it matters, what to do and where it was
    /// read; then the measurement, where one was asked for; a summary last.
    pub fn to_text(&self, has_colour: bool) -> String {
        let mut text = String::new();
        let facts = &self.host;
        let fact = |label| facts.find(label).map_or_else(String::new, Fact::to_text);
        let [host, kernel, cores] = ["hostname", "kernel", "cores"].map(fact);
        push(&mut text, &format!("{host}: {kernel}, {cores}"));
        let widths = self.findings.iter().map(|one| one.title.chars().count());
        let width = widths.max().unwrap_or(0);
        for severity in Severity::ALL.into_iter().rev() {
            for finding in self.of_severity(severity) {
                push_finding(&mut text, finding, width, has_colour);
            }
        }
        if let Some(latency) = self.latency.as_ref().filter(|one| one.is_thorough) {
            push(&mut text, "");
            push_latency(&mut text, latency, has_colour);
        }
        push(&mut text, "");
        // `1 error, 2 warnings, 3 cannot be told, 0 to note, 9 ok`.
        let counted = |severity, what| {
            let count = self.count(severity);
            format!("{count} {}", plural(count as u64, what))
        };
        let summary = format!(
            "{}, {}, {} cannot be told, {} to note, {} ok; docs/doctor.md explains each by its name",
            counted(Severity::Error, "error"),
            counted(Severity::Warning, "warning"),
            self.count(Severity::CannotTell),
            self.count(Severity::Note),
            self.count(Severity::Ok)
        );
        push(&mut text, &summary);
        text
    }
}

fn push_finding(text: &mut String, finding: &Finding, width: usize, has_colour: bool) {
    let (word, tone) = label(finding.severity);
    let word = mark(word, tone, has_colour);
    let lead = format!("{word}  {:width$}  ", finding.title);
    push_behind(text, &lead, LABEL + 2 + width + 2, &finding.value);
    if finding.severity == Severity::Ok {
        return;
    }
    let mut parts = vec![("why", &finding.why), ("fix", &finding.fix)];
    let name = format!("{} ({})", finding.source, finding.id);
    // What a reader may have to dispute has its source beside it; the JSON has it for all.
    if finding.severity >= Severity::Warning {
        parts.push(("from", &name));
    }
    for (label, words) in parts {
        let label = mark(&format!("{label:4}"), PLAIN, has_colour);
        push_behind(text, &format!("{:INDENT$}{label} ", ""), INDENT + 5, words);
    }
}

/// The measurement: what was measured and how, the figures side by side, what else went on, what may
/// be claimed.
fn push_latency(text: &mut String, report: &LatencyReport, has_colour: bool) {
    let period_ms = report.period_ns as f64 / 1e6;
    let duration_s = report.duration_ns as f64 / 1e9;
    let ended = if report.is_interrupted {
        ", INTERRUPTED: this is what there was so far"
    } else {
        ""
    };
    let head = format!("Wake-ups: absolute sleeps of {period_ms} ms for {duration_s} s{ended}");
    push(text, &head);
    push_row(text, "", &["count", "skipped", "preempted"], &QUANTILES);
    for one in report.measured_wakeups() {
        let counts = [
            Some(one.count),
            Some(one.skipped_count),
            one.preempted_count,
        ];
        let cells = counts.map(or_dash);
        push_row(text, &place(one.cpu), &cells, &quantile_cells(one.lateness));
    }
    push_scheduling(text, report);
    if !report.gaps.is_empty() {
        let ns = report.gaps.iter().map(|one| one.measured_ns).max();
        let s = ns.unwrap_or(0) as f64 / 1e9;
        let head =
            format!("Gaps over 10 us of a busy poller, {s:.1} s per CPU, one after the other");
        push(text, "");
        push(text, &head);
        push_row(
            text,
            "",
            &["gaps/s", "ms/s lost", "as throttle"],
            &QUANTILES,
        );
        for one in report.measured_gaps() {
            let (rate, lost) = (one.per_second(), one.lost_ms_per_s());
            let throttled = or_dash(one.throttle_like_count);
            let cells = [format!("{rate:.0}"), format!("{lost:.1}"), throttled];
            push_row(text, &place(one.cpu), &cells, &quantile_cells(one.length));
        }
    }
    push_surroundings(text, report);
    push_claims(text, report, has_colour);
}

/// How the threads ran, said once where they agree.
fn push_scheduling(text: &mut String, report: &LatencyReport) {
    let mut seen: Vec<&RealtimeGrantItem> = Vec::new();
    for item in report.wakeups.iter().flat_map(|one| &one.scheduling.items) {
        if !seen.contains(&item) {
            seen.push(item);
        }
    }
    let is_granted = |item: &&RealtimeGrantItem| item.outcome == GrantOutcome::Granted;
    let (granted, refused): (Vec<_>, Vec<_>) = seen.into_iter().partition(is_granted);
    let granted: Vec<String> = granted.into_iter().map(ToString::to_string).collect();
    push_behind(text, "  ", 2, &granted.join(", "));
    for item in refused {
        push_behind(text, "  ", 2, &item.to_string());
    }
}

fn push_surroundings(text: &mut String, report: &LatencyReport) {
    let around = &report.surroundings;
    let load = match (&around.load_before, &around.load_after) {
        (Fact::Available(before), Fact::Available(after)) => {
            let minute = |load: &str| load.split(' ').next().unwrap_or_default().to_owned();
            format!("load {} to {}", minute(before), minute(after))
        }
        (Fact::Unavailable(reason), _) | (_, Fact::Unavailable(reason)) => {
            format!("load unavailable ({reason})")
        }
    };
    let ticks = match &around.ticks {
        Fact::Available(ticks) => {
            let share = |part: u64| 100.0 * part as f64 / ticks.total.max(1) as f64;
            let (busy, steal) = (100.0 - share(ticks.idle), share(ticks.steal));
            format!("CPUs {busy:.0} % busy, this measurement included, steal {steal:.1} %")
        }
        Fact::Unavailable(reason) => format!("steal time unavailable ({reason})"),
    };
    let machine = around.virtual_machine.to_text();
    let line = format!("Meanwhile: {load}; {ticks}; virtual machine: {machine}");
    push(text, "");
    push(text, &line);
}

fn push_claims(text: &mut String, report: &LatencyReport, has_colour: bool) {
    push(text, "");
    push(text, "What this host supports, as it is now");
    let widths = report.claims.iter().map(|one| one.claim.chars().count());
    let width = widths.max().unwrap_or(0);
    let mut rules: Vec<&str> = Vec::new();
    for claim in &report.claims {
        let (word, tone) = match claim.standing {
            Standing::Supportable => ("yes", GOOD),
            Standing::NotSupportable => ("no ", BAD),
            Standing::NotMeasured => ("?  ", UNKNOWN),
        };
        let word = mark(word, tone, has_colour);
        let lead = format!("  {word}  {:width$}  ", claim.claim);
        push_behind(text, &lead, 7 + width + 2, &claim.why);
        if !rules.contains(&claim.rule.as_str()) {
            rules.push(&claim.rule);
        }
    }
    push(text, "  Rules, in the order of the lines:");
    for rule in rules {
        push_behind(text, "  - ", 4, rule);
    }
}

const QUANTILES: [&str; 4] = ["p50", "p99", "p99.9", "max us"];

/// As the claims round, so that a figure is the same in both.
fn quantile_cells(figures: Option<Quantiles>) -> [String; 4] {
    let cells = |of: Quantiles| [of.p50_ns, of.p99_ns, of.p999_ns, of.max_ns].map(Some);
    let cells = figures.map_or([None; 4], cells);
    cells.map(|ns| or_dash(ns.map(us_up)))
}

fn or_dash(figure: Option<impl ToString>) -> String {
    figure.map_or("-".to_owned(), |figure| figure.to_string())
}

fn place(cpu: Option<usize>) -> String {
    cpu.map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"))
}

fn push_row<C: AsRef<str>, Q: AsRef<str>>(
    text: &mut String,
    name: &str,
    cells: &[C; 3],
    quantiles: &[Q; 4],
) {
    let mut line = format!("  {name:18}");
    let cells = cells.iter().map(AsRef::as_ref);
    for cell in cells.chain(quantiles.iter().map(AsRef::as_ref)) {
        write!(line, "{cell:>12}").expect("a string takes every write");
    }
    push(text, &line);
}

fn push(text: &mut String, line: &str) {
    writeln!(text, "{}", line.trim_end()).expect("a string takes every write");
}

/// Wrapped words behind `lead`, which takes `indent` columns; further lines leave these blank.
fn push_behind(text: &mut String, lead: &str, indent: usize, words: &str) {
    let room = WIDTH.saturating_sub(indent).max(30);
    for (index, line) in wrapped(words, room).iter().enumerate() {
        if index == 0 {
            push(text, &format!("{lead}{line}"));
        } else {
            push(text, &format!("{:indent$}{line}", ""));
        }
    }
}

/// Words broken into lines of at most `width` characters; a longer word keeps a line to itself.
fn wrapped(words: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in words.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report() -> DoctorReport {
        let mut late = Finding::error("wakeup_latency", "p50 2 ms")
            .because("it is late")
            .fixed_by("be early")
            .read_from("measured");
        late.title = "A longer title".to_owned();
        let mut fine = Finding::ok("load", "1 us");
        fine.title = "Short".to_owned();
        DoctorReport::of(vec![fine, late])
    }

    #[test]
    fn the_worst_comes_first_explained_and_the_rest_is_short() {
        let expected = "ERROR        A longer title  p50 2 ms\n\
            \x20             why  it is late\n\
            \x20             fix  be early\n\
            \x20             from measured (wakeup_latency)\n\
            ok           Short           1 us\n\n\
            1 error, 0 warnings, 0 cannot be told, 0 to note, 1 ok; docs/doctor.md explains each by its \
            name\n";
        let text = report().to_text(false);
        let (_, text) = text.split_once('\n').unwrap();
        assert_eq!(text, expected);
    }

    #[test]
    fn colour_adds_escapes_and_nothing_else() {
        let coloured = report().to_text(true);
        assert!(coloured.contains("\u{1b}["));
        let mut plain = String::new();
        let mut is_escape = false;
        for character in coloured.chars() {
            match character {
                '\u{1b}' => is_escape = true,
                'm' if is_escape => is_escape = false,
                _ if is_escape => {}
                _ => plain.push(character),
            }
        }
        assert_eq!(plain, report().to_text(false));
    }

    #[test]
    fn long_explanations_are_wrapped_at_words() {
        assert_eq!(
            wrapped("one two three four", 9),
            ["one two", "three", "four"]
        );
        assert_eq!(wrapped("", 9), Vec::<String>::new());
        assert_eq!(
            wrapped("extraordinarily long", 5),
            ["extraordinarily", "long"]
        );
    }
}
