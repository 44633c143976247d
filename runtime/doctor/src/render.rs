//! The doctor's report as text: the worst first, what is ok in one line each, the measurement where one was asked for,
//! a summary last. It returns a string; who prints it, and whether the terminal takes colour, is the caller's business.

use hil_platform::host_facts::Fact;
use hil_platform::realtime::{GrantOutcome, RealtimeGrantItem};
use hil_platform::text::columns;
use hil_platform::words::plural;
use hil_present::terminal::canvas::{Canvas, INDENT, Style, left};
use hil_present::terminal::section;
use hil_present::{Block, Cell, Section, Table, Tone};

use super::latency::{LatencyReport, Quantiles, Standing, us_up};
use super::{DoctorReport, Finding, Severity};

/// Columns of a page.
const WIDTH: usize = 100;
/// Columns of the severity.
const LABEL: usize = 11;
/// Columns before `why`, `fix` and `from`.
const REASON_INDENT: usize = 14;

/// The word for people, and its tone.
const fn label(severity: Severity) -> (&'static str, Tone) {
    match severity {
        Severity::Ok => ("ok", Tone::Good),
        Severity::Note => ("note", Tone::Faint),
        Severity::CannotTell => ("cannot tell", Tone::Bar),
        Severity::Warning => ("WARNING", Tone::Caution),
        Severity::Error => ("ERROR", Tone::Bad),
    }
}

impl DoctorReport {
    /// The report: the worst findings first, each with why it matters, what to do and where it was
    /// read; then the measurement, where one was asked for; a summary last.
    pub fn to_text(&self, has_colour: bool) -> String {
        let style = if has_colour {
            Style::Coloured
        } else {
            Style::Plain
        };
        let mut canvas = Canvas::new(WIDTH, style);
        let facts = &self.host;
        let fact = |label| facts.find(label).map_or_else(String::new, Fact::to_text);
        let [host, kernel, cores] = ["hostname", "kernel", "cores"].map(fact);
        canvas.line(&format!("{host}: {kernel}, {cores}"));
        let widest = self.findings.iter().map(|one| columns(&one.title)).max();
        for severity in Severity::ALL.into_iter().rev() {
            for one in self.of_severity(severity) {
                finding(&mut canvas, one, widest.unwrap_or(0));
            }
        }
        if let Some(latency) = self.latency.as_ref().filter(|one| one.is_thorough) {
            for one in [wakeups(latency), gaps(latency), surroundings(latency)] {
                section(&mut canvas, &one);
            }
            claims(&mut canvas, latency);
        }
        canvas.blank();
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
        canvas.line(&summary);
        canvas.finish()
    }
}

fn finding(canvas: &mut Canvas, finding: &Finding, width: usize) {
    let (word, tone) = label(finding.severity);
    let word = canvas.paint(tone, &left(word, LABEL));
    let lead = format!("{word}  {}  ", left(&finding.title, width));
    canvas.behind(&lead, LABEL + width + 4, Tone::Plain, &finding.value);
    if finding.severity == Severity::Ok {
        return;
    }
    let mut parts = vec![("why", &finding.why), ("fix", &finding.fix)];
    let name = format!("{} ({})", finding.source, finding.id);
    // What a reader may have to dispute has its source beside it; the JSON has it for all.
    if finding.severity >= Severity::Warning {
        parts.push(("from", &name));
    }
    for (label, words) in parts.into_iter().filter(|(_, words)| !words.is_empty()) {
        canvas.field_at(REASON_INDENT, 5, label, Tone::Plain, words);
    }
}

/// How late threads woke up, and how they ran, said once where they agree.
fn wakeups(report: &LatencyReport) -> Section {
    let period_ms = report.period_ns as f64 / 1e6;
    let duration_s = report.duration_ns as f64 / 1e9;
    let ended = if report.is_interrupted {
        ", INTERRUPTED: this is what there was so far"
    } else {
        ""
    };
    let aside = format!("absolute sleeps of {period_ms} ms for {duration_s} s{ended}");
    let mut section = Section::new("wake-ups", "Wake-ups", aside);
    let mut table = quantile_table(["count", "skipped", "preempted"]);
    for one in report.measured_wakeups() {
        let counts = [
            Cell::Count(one.count),
            Cell::Count(one.skipped_count),
            Cell::count(one.preempted_count),
        ];
        let cells = core::iter::once(place(one.cpu)).chain(counts);
        table.push(cells.chain(quantile_cells(one.lateness)));
    }
    section.table(table);
    let mut seen: Vec<&RealtimeGrantItem> = Vec::new();
    for item in report.wakeups.iter().flat_map(|one| &one.scheduling.items) {
        if !seen.contains(&item) {
            seen.push(item);
        }
    }
    let is_granted = |item: &&RealtimeGrantItem| item.outcome == GrantOutcome::Granted;
    let (granted, refused): (Vec<_>, Vec<_>) = seen.into_iter().partition(is_granted);
    let granted: Vec<String> = granted.into_iter().map(ToString::to_string).collect();
    if !granted.is_empty() {
        section.note(Tone::Plain, granted.join(", "));
    }
    for item in refused {
        section.note(Tone::Caution, item.to_string());
    }
    section
}

/// When a busy poller lost its CPU.
fn gaps(report: &LatencyReport) -> Section {
    let ns = report.gaps.iter().map(|one| one.measured_ns).max();
    let s = ns.unwrap_or(0) as f64 / 1e9;
    let aside = format!("over 10 us of a busy poller, {s:.1} s per CPU, one after the other");
    let mut section = Section::new("gaps", "Gaps", aside);
    if report.gaps.is_empty() {
        return section;
    }
    let mut table = quantile_table(["gaps/s", "ms/s lost", "as throttle"]);
    for one in report.measured_gaps() {
        let counts = [
            format!("{:.0}", one.per_second()).into(),
            format!("{:.1}", one.lost_ms_per_s()).into(),
            Cell::count(one.throttle_like_count),
        ];
        let cells = core::iter::once(place(one.cpu)).chain(counts);
        table.push(cells.chain(quantile_cells(one.length)));
    }
    section.table(table);
    section
}

/// What else went on.
fn surroundings(report: &LatencyReport) -> Section {
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
    let mut section = Section::new("meanwhile", "Meanwhile", "");
    section.note(
        Tone::Plain,
        format!("{load}; {ticks}; virtual machine: {machine}"),
    );
    section
}

fn claims(canvas: &mut Canvas, report: &LatencyReport) {
    canvas.heading("What this host supports, as it is now", "");
    let widest = report.claims.iter().map(|one| columns(&one.claim)).max();
    let width = widest.unwrap_or(0);
    let mut rules: Vec<String> = Vec::new();
    for claim in &report.claims {
        let (word, tone) = match claim.standing {
            Standing::Supportable => ("yes", Tone::Good),
            Standing::NotSupportable => ("no", Tone::Bad),
            Standing::NotMeasured => ("?", Tone::Bar),
        };
        let word = canvas.paint(tone, &left(word, 3));
        let lead = format!("{:INDENT$}{word}  {}  ", "", left(&claim.claim, width));
        canvas.behind(&lead, INDENT + 3 + width + 4, Tone::Plain, &claim.why);
        if !rules.contains(&claim.rule) {
            rules.push(claim.rule.clone());
        }
    }
    let mut section = Section::new("rules", "Rules", "in the order of the lines");
    let tone = Tone::Plain;
    section.blocks.push(Block::List { tone, items: rules });
    self::section(canvas, &section);
}

/// A row a CPU: three columns, then quantiles in microseconds.
fn quantile_table(columns: [&str; 3]) -> Table {
    let [first, second, third] = columns;
    let columns = ["", first, second, third, "p50", "p99", "p99.9", "max us"];
    Table::new("", &columns)
}

/// As the claims round, so that a figure is the same in both.
fn quantile_cells(found: Option<Quantiles>) -> [Cell; 4] {
    let cells = |of: Quantiles| [of.p50_ns, of.p99_ns, of.p999_ns, of.max_ns];
    let us = |ns: i64| Cell::Count(us_up(ns).unsigned_abs());
    found.map_or([const { Cell::Missing }; 4], |of| cells(of).map(us))
}

fn place(cpu: Option<usize>) -> Cell {
    cpu.map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"))
        .into()
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
}
