//! The only place that prints. Results go to standard output, everything said on the way to
//! standard error; a progress line is redrawn on a terminal and thinned out elsewhere. Where the
//! journal listens, each line begins with its priority; where systemd waits for word of a run, progress
//! is the status of its unit.

use std::env;
use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use anstyle::{AnsiColor, Style};
use nix::sys::stat::fstat;

use crate::systemd::ServiceManager;
use crate::text::{clean, shortened, visible, visible_laid_out};

/// Progress lines where they cannot be redrawn.
const PLAIN_PERIOD: Duration = Duration::from_secs(5);
/// The same in the journal, which keeps them.
const JOURNAL_PERIOD: Duration = Duration::from_mins(1);

/// Columns of a terminal that does not say how many it has.
const COLUMNS_UNKNOWN: usize = 80;

/// How a command ended; the program knows the exit codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandEnd {
    /// All is well.
    Done,
    /// Something was damaged, could not be read or written, or a `--fail-if` condition holds.
    Failed,
    /// Nothing could be done with what was asked.
    Refused,
    /// A signal ended it; what was complete by then is shown.
    Interrupted,
}

/// How a line weighs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Weight {
    Error,
    Warning,
    Word,
    Progress,
}

impl Weight {
    /// The journal's number for it (`syslog(3)`).
    const fn priority(self) -> u8 {
        match self {
            Self::Error => 3,
            Self::Warning => 4,
            Self::Word => 6,
            Self::Progress => 7,
        }
    }

    fn style(self) -> Style {
        let colour = match self {
            Self::Error => AnsiColor::Red,
            Self::Warning => AnsiColor::Yellow,
            Self::Word | Self::Progress => return Style::new(),
        };
        Style::new().fg_color(Some(colour.into()))
    }
}

/// Where what is said on the way goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Listener {
    Terminal,
    Journal,
    Other,
}

impl Listener {
    fn find() -> Self {
        if io::stderr().is_terminal() {
            return Self::Terminal;
        }
        let standard_error = fstat(io::stderr()).ok();
        let standard_error = standard_error.map(|file| (file.st_dev, file.st_ino));
        let journal = env::var("JOURNAL_STREAM").ok();
        if is_journal(journal.as_deref(), standard_error) {
            Self::Journal
        } else {
            Self::Other
        }
    }
}

/// Whether the file with this device and inode is the one that the journal reads, which it names in
/// `JOURNAL_STREAM` (`systemd.exec(5)`); a process may inherit the name without the file.
fn is_journal(named: Option<&str>, file: Option<(u64, u64)>) -> bool {
    let Some((device, inode)) = named.and_then(|named| named.split_once(':')) else {
        return false;
    };
    let number = |text: &str| text.parse::<u64>().ok();
    number(device).zip(number(inode)) == file && file.is_some()
}

/// Talks to the person (or journal) that started the run.
#[derive(Debug)]
pub struct Console {
    is_quiet: bool,
    listener: Listener,
    has_open_line: bool,
    /// The progress line that was said last, where it cannot be redrawn.
    last_plain: Option<(Instant, String)>,
    service: Option<ServiceManager>,
    /// A result could not be written, and not because its reader left.
    has_lost_result: bool,
}

impl Console {
    /// A console; a quiet one says only warnings and errors.
    pub fn new(is_quiet: bool) -> Self {
        Self {
            is_quiet,
            listener: Listener::find(),
            has_open_line: false,
            last_plain: None,
            service: None,
            has_lost_result: false,
        }
    }

    /// From now on only warnings and errors are said, or everything.
    pub const fn set_quiet(&mut self, is_quiet: bool) {
        self.is_quiet = is_quiet;
    }

    /// From now on the service manager that started this process hears how it stands, if there is one
    /// that wants to. For the main process of a service only.
    pub fn serve(&mut self) {
        match ServiceManager::of_this_process() {
            Ok(service) => self.service = service,
            Err(error) => self.warn(&format!(
                "systemd cannot be told how the run stands: {error}"
            )),
        }
    }

    /// Tells the service manager that the service is up, and lives.
    pub fn announce_up(&mut self) {
        if let Some(service) = &mut self.service {
            service.up();
            service.alive();
        }
    }

    /// Tells the service manager that it lives.
    pub fn announce_alive(&mut self) {
        if let Some(service) = &mut self.service {
            service.alive();
        }
    }

    /// Tells the service manager that the service is ending.
    pub fn announce_ending(&mut self) {
        let Some(service) = &mut self.service else {
            return;
        };
        let asked = service.stopping();
        service.status("ending the run");
        if let Err(error) = asked {
            self.warn(&format!(
                "systemd cannot be asked for time to end the run: {error}"
            ));
        }
    }

    /// Says something on the way.
    pub fn say(&mut self, text: &str) {
        if !self.is_quiet {
            self.line(Weight::Word, &visible(text));
        }
    }

    /// Says something that may spoil the result.
    pub fn warn(&mut self, text: &str) {
        self.line(Weight::Warning, &format!("warning: {}", visible(text)));
    }

    /// Says why it cannot go on.
    pub fn error(&mut self, text: &str) {
        self.line(Weight::Error, &format!("error: {}", visible(text)));
    }

    /// Shows where a long piece of work stands.
    pub fn progress(&mut self, text: &str) {
        if let Some(service) = &mut self.service {
            service.status(&clean(text));
        }
        if self.is_quiet {
            return;
        }
        let period = match self.listener {
            Listener::Journal => JOURNAL_PERIOD,
            Listener::Terminal | Listener::Other => PLAIN_PERIOD,
        };
        if self.listener == Listener::Terminal {
            let text = one_row(text, terminal_columns().unwrap_or(COLUMNS_UNKNOWN));
            // Carriage return, text, erase to the end of the line.
            say_to(&mut io::stderr(), &format!("\r{text}\x1b[K"));
            self.has_open_line = true;
        } else if is_worth_saying(self.last_plain.as_ref(), text, period) {
            self.last_plain = Some((Instant::now(), text.to_owned()));
            self.line(Weight::Progress, &visible(text));
        }
    }

    /// Takes the progress line away: the work is done.
    pub(crate) fn end_progress(&mut self) {
        if self.has_open_line {
            say_to(&mut io::stderr(), "\r\x1b[K");
            self.has_open_line = false;
        }
    }

    /// Gives a result; colours are dropped where the output cannot show them. False when it was not
    /// taken, so that endless output can stop. A reader that left (a closed pipe) is no failure;
    /// any other is told at once and counts in [`Console::exit_code`].
    pub fn result(&mut self, text: &str) -> bool {
        self.close_line();
        let Err(error) = write_to(&mut anstream::stdout(), &visible_laid_out(text)) else {
            return true;
        };
        if error.kind() != io::ErrorKind::BrokenPipe && !self.has_lost_result {
            self.has_lost_result = true;
            self.error(&format!(
                "cannot write the result to standard output: {error}"
            ));
        }
        false
    }

    /// What a program exits with that ended with `code`: 1 in place of 0 when a result could not be
    /// written.
    pub const fn exit_code(&self, code: u8) -> u8 {
        if code == 0 && self.has_lost_result {
            1
        } else {
            code
        }
    }

    /// Says text that is already laid out, such as an annotated piece of a file.
    pub fn rendered(&mut self, text: &str) {
        self.line(Weight::Word, &visible_laid_out(text.trim_end()));
    }

    /// Says faults that are already laid out, such as those of a file.
    pub fn faults(&mut self, text: &str) {
        match self.listener {
            Listener::Journal => self.line(Weight::Error, &visible_laid_out(text.trim_end())),
            // They have colours of their own.
            Listener::Terminal | Listener::Other => self.rendered(text),
        }
    }

    fn line(&mut self, weight: Weight, text: &str) {
        self.close_line();
        if self.listener == Listener::Journal {
            say_to(&mut anstream::stderr(), &for_journal(weight, text));
            return;
        }
        let style = weight.style();
        say_to(
            &mut anstream::stderr(),
            &format!("{style}{text}{style:#}\n"),
        );
    }

    fn close_line(&mut self) {
        if self.has_open_line {
            say_to(&mut io::stderr(), "\n");
            self.has_open_line = false;
        }
    }
}

/// Where a line cannot be redrawn it is said now and then, and not again while it is the same.
fn is_worth_saying(last: Option<&(Instant, String)>, text: &str, period: Duration) -> bool {
    last.is_none_or(|(at, said)| said != text && at.elapsed() >= period)
}

/// The journal takes each line for a message of its own.
fn for_journal(weight: Weight, text: &str) -> String {
    let priority = weight.priority();
    let lines = text.lines().map(|line| format!("<{priority}>{line}\n"));
    lines.collect()
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

fn write_to(out: &mut impl Write, text: &str) -> io::Result<()> {
    out.write_all(text.as_bytes())?;
    out.flush()
}

/// Says `text` on the way. Errors are ignored: it is no result.
fn say_to(out: &mut impl Write, text: &str) {
    let _unwritten = write_to(out, text).is_err();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_in_the_journal_begins_with_its_priority() {
        assert_eq!(for_journal(Weight::Error, "a\nb"), "<3>a\n<3>b\n");
        assert_eq!(for_journal(Weight::Warning, "a"), "<4>a\n");
        assert_eq!(for_journal(Weight::Word, "a\n"), "<6>a\n");
    }

    #[test]
    fn the_journal_is_known_by_the_file_that_it_names() {
        assert!(is_journal(Some("8:1234"), Some((8, 1234))));
        assert!(!is_journal(Some("8:1234"), Some((8, 1235))));
        assert!(!is_journal(Some("journal"), Some((8, 1234))));
        assert!(!is_journal(Some("a:b"), None));
        assert!(!is_journal(None, Some((8, 1234))));
    }

    #[test]
    fn a_progress_line_is_not_said_twice() {
        let said = (Instant::now(), "waiting".to_owned());
        let again = |text, period| is_worth_saying(Some(&said), text, period);
        assert!(is_worth_saying(None, "waiting", PLAIN_PERIOD));
        assert!(!again("waiting", Duration::ZERO));
        assert!(again("12 s", Duration::ZERO));
        assert!(!again("12 s", Duration::MAX));
    }

    #[test]
    fn a_progress_line_is_never_longer_than_a_row() {
        let long = "12.0 / 60 s  egm/right/command 3000→2999 | ".repeat(9);
        for columns in [1, 40, 80, 200] {
            assert!(one_row(&long, columns).chars().count() < columns);
        }
        assert_eq!(one_row("12.0 / 60 s", 80), "12.0 / 60 s");
    }
}
