//! The only place that prints. Results go to standard output, everything said on the way to
//! standard error; a progress line is redrawn on a terminal and thinned out elsewhere.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use anstyle::{AnsiColor, Style};

use crate::report::terminal::shortened;

/// Progress lines where they cannot be redrawn.
const PLAIN_PERIOD: Duration = Duration::from_secs(5);

/// Columns of a terminal that does not say how many it has.
const COLUMNS_UNKNOWN: usize = 80;

/// Talks to the person (or journal) that started the run.
#[derive(Debug)]
pub struct Console {
    is_quiet: bool,
    is_terminal: bool,
    has_open_line: bool,
    last_plain: Option<Instant>,
}

impl Console {
    /// A console; a quiet one says only warnings and errors.
    pub fn new(is_quiet: bool) -> Self {
        let is_terminal = io::stderr().is_terminal();
        Self {
            is_quiet,
            is_terminal,
            has_open_line: false,
            last_plain: None,
        }
    }

    /// Says something on the way.
    pub fn say(&mut self, text: &str) {
        if !self.is_quiet {
            self.line(Style::new(), text);
        }
    }

    /// Says something that may spoil the result.
    pub fn warn(&mut self, text: &str) {
        self.line(
            Style::new().fg_color(Some(AnsiColor::Yellow.into())),
            &format!("warning: {text}"),
        );
    }

    /// Says why it cannot go on.
    pub fn error(&mut self, text: &str) {
        self.line(
            Style::new().fg_color(Some(AnsiColor::Red.into())),
            &format!("error: {text}"),
        );
    }

    /// Shows where a long piece of work stands.
    pub fn progress(&mut self, text: &str) {
        if self.is_quiet {
            return;
        }
        if self.is_terminal {
            let text = one_row(text, terminal_columns().unwrap_or(COLUMNS_UNKNOWN));
            // Carriage return, text, erase to the end of the line.
            write_to(&mut io::stderr(), &format!("\r{text}\x1b[K"));
            self.has_open_line = true;
        } else if self
            .last_plain
            .is_none_or(|last| last.elapsed() >= PLAIN_PERIOD)
        {
            self.last_plain = Some(Instant::now());
            write_to(&mut io::stderr(), &format!("{text}\n"));
        }
    }

    /// Takes the progress line away: the work is done.
    pub(crate) fn end_progress(&mut self) {
        if self.has_open_line {
            write_to(&mut io::stderr(), "\r\x1b[K");
            self.has_open_line = false;
        }
    }

    /// Gives a result; colours are dropped where the output cannot show them. False when nobody
    /// reads it any more, which ends what would go on for ever.
    pub fn result(&mut self, text: &str) -> bool {
        self.close_line();
        write_to(&mut anstream::stdout(), text)
    }

    /// Says text that is already laid out, such as an annotated piece of a file.
    pub fn rendered(&mut self, text: &str) {
        self.line(Style::new(), text.trim_end());
    }

    fn line(&mut self, style: Style, text: &str) {
        self.close_line();
        write_to(
            &mut anstream::stderr(),
            &format!("{style}{text}{style:#}\n"),
        );
    }

    fn close_line(&mut self) {
        if self.has_open_line {
            write_to(&mut io::stderr(), "\n");
            self.has_open_line = false;
        }
    }
}

/// At most one row of a terminal: a longer text would wrap and could not be redrawn. The last
/// column stays free, because some terminals wrap once it is written.
fn one_row(text: &str, columns: usize) -> String {
    shortened(text, columns.saturating_sub(1))
}

/// Columns of the terminal behind standard error; `None` when it does not say.
fn terminal_columns() -> Option<usize> {
    let (width, _) = terminal_size::terminal_size_of(io::stderr())?;
    (width.0 > 0).then(|| usize::from(width.0))
}

/// False when the reader left (a closed pipe), which is no reason to fail a run.
fn write_to(out: &mut impl Write, text: &str) -> bool {
    out.write_all(text.as_bytes())
        .and_then(|()| out.flush())
        .is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_progress_line_is_never_longer_than_a_row() {
        let long = "12.0 / 60 s  egm/right/command 3000→2999 | ".repeat(9);
        for columns in [1, 40, 80, 200] {
            assert!(one_row(&long, columns).chars().count() < columns);
        }
        assert_eq!(one_row("12.0 / 60 s", 80), "12.0 / 60 s");
    }
}
