//! The doctor's report as a text table. It returns a string; who prints it, and whether the
//! terminal takes colour, is the caller's business.

use std::fmt::Write;

use anstyle::{AnsiColor, Style};

use super::{DoctorReport, Finding, State};

const WIDTH: usize = 96;

impl DoctorReport {
    /// The report as a table: one line per finding, followed by why it matters and what to do.
    pub fn to_text(&self, has_colour: bool) -> String {
        let mut text = String::new();
        let title_width = self
            .findings
            .iter()
            .map(|f| f.title.chars().count())
            .max()
            .unwrap_or(0);
        for finding in &self.findings {
            push_finding(&mut text, finding, title_width, has_colour);
        }
        let count = |state| self.findings.iter().filter(|f| f.state == state).count();
        push_line(
            &mut text,
            &format!(
                "{} good, {} to note, {} problems",
                count(State::Good),
                count(State::Note),
                count(State::Problem)
            ),
        );
        text
    }
}

fn push_finding(text: &mut String, finding: &Finding, title_width: usize, has_colour: bool) {
    let (word, style) = match finding.state {
        State::Good => ("good   ", AnsiColor::Green.on_default()),
        State::Note => ("note   ", AnsiColor::Yellow.on_default()),
        State::Problem => ("PROBLEM", AnsiColor::Red.on_default().bold()),
    };
    let word = paint(word, style, has_colour);
    push_line(
        text,
        &format!("{word}  {:title_width$}  {}", finding.title, finding.value),
    );
    for (label, words) in [("why", &finding.why), ("fix", &finding.fix)] {
        if words.is_empty() {
            continue;
        }
        let label = paint(label, Style::new().dimmed(), has_colour);
        for (index, line) in wrap(words, WIDTH - 14).iter().enumerate() {
            let lead = if index == 0 { label.as_str() } else { "   " };
            push_line(text, &format!("         {lead}  {line}"));
        }
    }
}

fn push_line(text: &mut String, line: &str) {
    writeln!(text, "{}", line.trim_end()).expect("a string takes every write");
}

fn paint(word: &str, style: Style, has_colour: bool) -> String {
    if has_colour {
        format!("{style}{word}{style:#}")
    } else {
        word.to_owned()
    }
}

/// Words broken into lines of at most `width` characters; a longer word keeps a line to itself.
fn wrap(words: &str, width: usize) -> Vec<String> {
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
    use crate::host_facts::HostFacts;

    fn report() -> DoctorReport {
        DoctorReport {
            host: HostFacts::default(),
            wakeup: None,
            findings: vec![
                Finding::good("a", "Short", "1 us"),
                Finding::problem("b", "A longer title", "2 ms")
                    .because("it is late")
                    .fixed_by("be early"),
            ],
        }
    }

    #[test]
    fn the_plain_table_is_aligned_and_explained() {
        let expected = "\
good     Short           1 us
PROBLEM  A longer title  2 ms
         why  it is late
         fix  be early
1 good, 0 to note, 1 problems
";
        assert_eq!(report().to_text(false), expected);
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
        assert_eq!(wrap("one two three four", 9), ["one two", "three", "four"]);
        assert_eq!(wrap("unbreakable-word x", 5), ["unbreakable-word", "x"]);
    }
}
