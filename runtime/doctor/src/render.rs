//! The doctor's report as text: the worst first, what is ok in one line each, a summary last. It
//! returns a string; who prints it, and whether the terminal takes colour, is the caller's business.

use core::fmt::Write as _;

use anstyle::{AnsiColor, Style};

use super::{DoctorReport, Finding, Severity};

const WIDTH: usize = 100;
/// Columns of the severity.
const LABEL: usize = 11;
/// Columns before the words of `why`, `fix` and `from`.
const INDENT: usize = 14;

/// How a word is coloured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Tone {
    Good,
    Plain,
    Unknown,
    Careful,
    Bad,
}

/// `word` in the colour of its tone.
pub(super) fn mark(word: &str, tone: Tone, has_colour: bool) -> String {
    let style = match tone {
        Tone::Good => AnsiColor::Green.on_default(),
        Tone::Plain => Style::new().dimmed(),
        Tone::Unknown => AnsiColor::Cyan.on_default(),
        Tone::Careful => AnsiColor::Yellow.on_default().bold(),
        Tone::Bad => AnsiColor::Red.on_default().bold(),
    };
    if has_colour {
        format!("{style}{word}{style:#}")
    } else {
        word.to_owned()
    }
}

/// The word for people, of one width, and its tone.
fn label(severity: Severity) -> (&'static str, Tone) {
    match severity {
        Severity::Ok => ("ok         ", Tone::Good),
        Severity::Note => ("note       ", Tone::Plain),
        Severity::CannotTell => ("cannot tell", Tone::Unknown),
        Severity::Warning => ("WARNING    ", Tone::Careful),
        Severity::Error => ("ERROR      ", Tone::Bad),
    }
}

impl DoctorReport {
    /// The report: the worst findings first, each with why it matters, what to do and where it was
    /// read; then the measurement, where one was asked for; a summary last.
    pub fn to_text(&self, has_colour: bool) -> String {
        let mut text = String::new();
        let fact = |label: &str| {
            let found = self.host.find(label);
            found.map_or_else(String::new, hil_platform::host_facts::Fact::to_text)
        };
        push(
            &mut text,
            &format!(
                "{}: {}, {}",
                fact("hostname"),
                fact("kernel"),
                fact("cores")
            ),
        );
        let widths = self.findings.iter().map(|one| one.title.chars().count());
        let width = widths.max().unwrap_or(0);
        for severity in Severity::ALL.into_iter().rev() {
            let own = self.findings.iter().filter(|one| one.severity == severity);
            for finding in own {
                push_finding(&mut text, finding, width, has_colour);
            }
        }
        if let Some(latency) = self.latency.as_ref().filter(|one| one.is_thorough) {
            push(&mut text, "");
            text.push_str(&latency.to_text(has_colour));
        }
        push(&mut text, "");
        push(&mut text, &self.summary());
        text
    }

    /// `1 error, 2 warnings, 3 cannot be told, 0 to note, 9 ok`.
    fn summary(&self) -> String {
        let count = |severity| self.count(severity);
        let plural = |number: usize| if number == 1 { "" } else { "s" };
        let (errors, warnings) = (count(Severity::Error), count(Severity::Warning));
        format!(
            "{errors} error{}, {warnings} warning{}, {} cannot be told, {} to note, {} ok; docs/doctor.md \
             explains each by its name",
            plural(errors),
            plural(warnings),
            count(Severity::CannotTell),
            count(Severity::Note),
            count(Severity::Ok)
        )
    }
}

fn push_finding(text: &mut String, finding: &Finding, width: usize, has_colour: bool) {
    let (word, tone) = label(finding.severity);
    let word = mark(word, tone, has_colour);
    let lead = format!("{:width$}  ", finding.title);
    let room = WIDTH.saturating_sub(LABEL + 2 + width + 2).max(30);
    for (index, line) in wrapped(&finding.value, room).iter().enumerate() {
        if index == 0 {
            push(text, &format!("{word}  {lead}{line}"));
        } else {
            push(text, &format!("{:LABEL$}  {:width$}  {line}", "", ""));
        }
    }
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
        let label = mark(&format!("{label:4}"), Tone::Plain, has_colour);
        for (index, line) in wrapped(words, WIDTH - INDENT - 5).iter().enumerate() {
            let lead = if index == 0 { label.as_str() } else { "    " };
            push(text, &format!("{:INDENT$}{lead} {line}", ""));
        }
    }
}

fn push(text: &mut String, line: &str) {
    writeln!(text, "{}", line.trim_end()).expect("a string takes every write");
}

/// Words broken into lines of at most `width` characters; a longer word keeps a line to itself.
pub(super) fn wrapped(words: &str, width: usize) -> Vec<String> {
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
