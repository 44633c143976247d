//! One process the supervisor started: its pipes, its log, its death. When to start, restart or
//! stop it is decided in `process_group.rs`.

use std::fmt;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read as _, Seek as _, SeekFrom, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::SyncSender;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::signal::{Signal, kill, killpg};
use nix::sys::wait::{Id, WaitPidFlag, WaitStatus, waitid};
use nix::unistd::{Pid, getpgrp};
use rustix::process::{PidfdFlags, pidfd_open};
use zeroize::Zeroizing;

use hil_platform::{open_files, systemd};
use hil_rundir::pipe::{FromProcess, ToProcess};

/// Longest line of a process that is kept: the report of a gateway with tens of thousands of channels.
const LINE_BYTES_MAX: usize = 1 << 28;

/// How long the kernel may take to end a process that was killed.
const KILL_PATIENCE: Duration = Duration::from_secs(5);

/// A word from a process.
#[derive(Debug)]
pub(crate) struct Word {
    /// Which process.
    pub(crate) index: usize,
    /// Which start of it.
    pub(crate) instance: u32,
    pub(crate) said: FromProcess,
}

/// How a process ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ProcessEnd {
    /// As its status says.
    Exited(ExitStatus),
    /// It is gone, or a kill has no effect on it, and the kernel does not tell how it ended.
    Lost,
}

impl ProcessEnd {
    /// Its exit code, if it had one.
    pub(crate) fn code(self) -> Option<i32> {
        match self {
            Self::Exited(status) => status.code(),
            Self::Lost => None,
        }
    }

    /// The signal that killed it.
    pub(crate) fn signal(self) -> Option<i32> {
        match self {
            Self::Exited(status) => status.signal(),
            Self::Lost => None,
        }
    }
}

impl fmt::Display for ProcessEnd {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self, self.code(), self.signal()) {
            (Self::Lost, ..) => {
                formatter.write_str("was lost: the kernel does not tell how it ended")
            }
            (_, Some(0), _) => formatter.write_str("ended"),
            (_, Some(code), _) => write!(formatter, "ended with exit code {code}"),
            (_, None, Some(number)) => {
                let name = Signal::try_from(number).map_or("an unknown signal", Signal::as_str);
                write!(formatter, "was killed by {name}")
            }
            (_, None, None) => formatter.write_str("ended for an unknown reason"),
        }
    }
}

/// A running (or finished) child process.
#[derive(Debug)]
pub(crate) struct Child {
    process: std::process::Child,
    /// The process itself: its number may be another's once somebody has reaped it.
    pidfd: OwnedFd,
    words: Option<JoinHandle<()>>,
    stdin: Option<ChildStdin>,
    end: Option<ProcessEnd>,
    is_foreign: bool,
    /// It is in the group of this process, not in one of its own.
    shares_group: bool,
}

impl Child {
    /// Its process id.
    pub(crate) fn id(&self) -> u32 {
        self.process.id()
    }

    /// Starts a process that speaks the pipe protocol; its words arrive at `words` marked with
    /// `index` and `instance`. Standard error goes to `log`.
    ///
    /// # Errors
    /// When the program cannot be started or the log cannot be written.
    pub(crate) fn spawn_speaking(
        command: Command,
        log: &Path,
        index: usize,
        instance: u32,
        words: SyncSender<Word>,
    ) -> io::Result<Self> {
        let mut command = prepared(command, log)?;
        let (mut process, pidfd) = started(command.stdin(Stdio::piped()).stdout(Stdio::piped()))?;
        let output = process
            .stdout
            .take()
            .expect("standard output was piped just above");
        let stdin = process.stdin.take();
        // If no thread is to be had, it is ended when this is dropped.
        let mut child = Self {
            process,
            pidfd,
            words: None,
            stdin,
            end: None,
            is_foreign: false,
            shares_group: false,
        };
        let words = thread::Builder::new()
            .name(format!("words {index}"))
            .spawn(move || {
                let mut output = BufReader::new(output);
                while let Ok(Some(line)) = next_line(&mut output, LINE_BYTES_MAX) {
                    let said = serde_json::from_slice(&line).unwrap_or_else(|_not_ours| {
                        let text = String::from_utf8_lossy(&line);
                        FromProcess::Warning(format!("said: {text}"))
                    });
                    let word = Word {
                        index,
                        instance,
                        said,
                    };
                    if words.send(word).is_err() {
                        return;
                    }
                }
            })?;
        child.words = Some(words);
        Ok(child)
    }

    /// Starts a user's own command; both its outputs go to `log`.
    ///
    /// # Errors
    /// When the program cannot be started or the log cannot be written.
    pub(crate) fn spawn_foreign(command: Command, log: &Path) -> io::Result<Self> {
        let mut command = prepared(command, log)?;
        command.stdout(File::options().append(true).open(log)?);
        Self::foreign(command.stdin(Stdio::null()), false)
    }

    /// Starts a user's own command in the group of this process, which is told to end as a whole.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub(crate) fn spawn_beside(command: &mut Command) -> io::Result<Self> {
        Self::foreign(command, true)
    }

    /// Starts a command in the group that it was given, with the outputs that it was given.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub(crate) fn spawn_apart(command: &mut Command) -> io::Result<Self> {
        Self::foreign(command, false)
    }

    fn foreign(command: &mut Command, shares_group: bool) -> io::Result<Self> {
        let (process, pidfd) = started(command)?;
        Ok(Self {
            process,
            pidfd,
            words: None,
            stdin: None,
            end: None,
            is_foreign: true,
            shares_group,
        })
    }

    /// How it ended, once it has; does not wait.
    pub(crate) fn poll_end(&mut self) -> Option<ProcessEnd> {
        if self.end.is_none() {
            self.end = match self.look() {
                Ok(WaitStatus::StillAlive) | Err(Errno::EINTR) => None,
                Ok(_ended) => {
                    // Children of its own must not outlive it. Its number still belongs to it, because
                    // it has not been reaped yet, so no stranger can be hit.
                    self.signal_group(Signal::SIGKILL);
                    let status = self.process.try_wait().ok().flatten();
                    Some(status.map_or(ProcessEnd::Lost, ProcessEnd::Exited))
                }
                Err(_not_ours_any_more) => Some(ProcessEnd::Lost),
            };
        }
        self.end
    }

    /// Whether it has ended, without reaping it; an error once somebody else has.
    fn look(&self) -> nix::Result<WaitStatus> {
        let flags = WaitPidFlag::WEXITED | WaitPidFlag::WNOHANG | WaitPidFlag::WNOWAIT;
        waitid(Id::PIDFd(self.pidfd.as_fd()), flags)
    }

    /// True once everything the process said has been handed on. Comes soon after its end, as
    /// nobody holds the other end of its output then.
    pub(crate) fn has_said_all(&self) -> bool {
        self.words.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Gives an order. A foreign command gets SIGTERM for [`ToProcess::Stop`] and nothing for
    /// [`ToProcess::Start`].
    pub(crate) fn order(&mut self, order: &ToProcess) {
        if self.is_foreign {
            if *order == ToProcess::Stop {
                self.signal(Signal::SIGTERM);
            }
            return;
        }
        let mut line = serde_json::to_string(order).expect("an order always serialises");
        line.push('\n');
        // It may be the run's secret.
        let line = Zeroizing::new(line);
        if let Some(stdin) = &mut self.stdin {
            // A process that is gone is noticed by poll_end.
            let _gone = stdin
                .write_all(line.as_bytes())
                .and_then(|()| stdin.flush())
                .is_err();
        }
    }

    /// Waits until it ends or `deadline`; then kills it. True when it ended by itself.
    pub(crate) fn end(&mut self, deadline: Instant) -> bool {
        if self.ends_by(deadline) {
            return true;
        }
        self.signal(Signal::SIGKILL);
        if !self.ends_by(Instant::now() + KILL_PATIENCE) {
            self.end = Some(ProcessEnd::Lost);
        }
        false
    }

    fn ends_by(&mut self, deadline: Instant) -> bool {
        while self.poll_end().is_none() {
            if Instant::now() >= deadline {
                return false;
            }
            thread::sleep(Duration::from_millis(2));
        }
        true
    }

    /// Signals its group, as long as the group's number is its own for certain.
    pub(crate) fn signal(&self, signal: Signal) {
        if self.end.is_none() && self.look().is_ok() {
            self.signal_group(signal);
        }
    }

    fn signal_group(&self, signal: Signal) {
        if let Ok(id) = i32::try_from(self.process.id()) {
            let own = Pid::from_raw(id);
            let sent = match (self.shares_group, signal) {
                (true, Signal::SIGKILL) => kill(own, signal),
                (true, _) => killpg(getpgrp(), signal),
                (false, _) => killpg(own, signal),
            };
            // The group may have ended already.
            let _gone = sent.is_err();
        }
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        if self.end.is_none() {
            self.end(Instant::now());
        }
    }
}

/// A group of its own keeps the terminal's Ctrl-C away from the child, so that the supervisor
/// ends it in order. To systemd the supervisor speaks alone.
fn prepared(mut command: Command, log: &Path) -> io::Result<Command> {
    let log = File::options().create(true).append(true).open(log)?;
    command.stderr(log).process_group(0);
    for variable in systemd::VARIABLES {
        command.env_remove(variable);
    }
    Ok(command)
}

/// Starts it, with a descriptor of the process itself. It gets no other descriptor of this process.
fn started(command: &mut Command) -> io::Result<(std::process::Child, OwnedFd)> {
    open_files::withhold()?;
    let mut process = command.spawn()?;
    match pidfd_open(
        rustix::process::Pid::from_child(&process),
        PidfdFlags::empty(),
    ) {
        Ok(pidfd) => Ok((process, pidfd)),
        Err(errno) => {
            // It may have ended by itself; waiting afterwards is what matters.
            let _already_ended = process.kill().is_err();
            let _reaped = process.wait().is_ok();
            Err(errno.into())
        }
    }
}

/// The next line without its end, at most `bytes_max` of it: the rest of a longer one is left out. `None` at
/// the end.
///
/// # Errors
/// When reading fails.
fn next_line(input: &mut impl BufRead, bytes_max: usize) -> io::Result<Option<Vec<u8>>> {
    let mut line = Vec::new();
    let mut has_begun = false;
    loop {
        let bytes = match input.fill_buf() {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            other => other?,
        };
        if bytes.is_empty() {
            return Ok(has_begun.then_some(line));
        }
        has_begun = true;
        let end = bytes.iter().position(|byte| *byte == b'\n');
        let length = end.unwrap_or(bytes.len());
        let room = bytes_max - line.len();
        line.extend_from_slice(&bytes[..length.min(room)]);
        input.consume(end.map_or(length, |end| end + 1));
        if end.is_some() {
            return Ok(Some(line));
        }
    }
}

/// The last line that a process said on its standard error and that does not have `known` in it, if there is one: as
/// much of it as fits a line of a report.
pub(crate) fn last_line(log: &Path, known: Option<&str>) -> Option<String> {
    const TAIL_BYTES: u64 = 4096;
    const LINE_CHARS: usize = 200;
    let mut file = File::open(log).ok()?;
    let size_bytes = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(size_bytes.saturating_sub(TAIL_BYTES)))
        .ok()?;
    let mut bytes = Vec::new();
    file.take(TAIL_BYTES).read_to_end(&mut bytes).ok()?;
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().map(str::trim);
    let is_news = |line: &&str| !line.is_empty() && known.is_none_or(|known| !line.contains(known));
    let last = lines.rev().find(is_news)?;
    let plain = last.chars().filter(|one| !one.is_control());
    Some(plain.take(LINE_CHARS).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::sync_channel;
    use std::{env, fs};

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn words_arrive_marked_and_other_output_is_kept_as_a_warning() {
        let log = env::temp_dir().join(format!("hil-child-{}.log", std::process::id()));
        let (sender, words) = sync_channel(8);
        let mut child =
            Child::spawn_speaking(shell("echo '\"ready\"'; echo hello"), &log, 3, 1, sender)
                .unwrap();
        assert!(child.end(Instant::now() + Duration::from_secs(10)));
        let word = words.recv().unwrap();
        assert_eq!((word.index, word.instance), (3, 1));
        assert_eq!(word.said, FromProcess::Ready);
        let said = words.recv().unwrap().said;
        assert_eq!(said, FromProcess::Warning("said: hello".to_owned()));
        fs::remove_file(log).unwrap();
    }

    #[test]
    fn of_a_line_that_is_too_long_the_beginning_is_kept() {
        let mut input = BufReader::with_capacity(3, &b"0123456789\n\nabcd\nend"[..]);
        let mut lines = Vec::new();
        while let Some(line) = next_line(&mut input, 4).unwrap() {
            lines.push(String::from_utf8(line).unwrap());
        }
        assert_eq!(lines, ["0123", "", "abcd", "end"]);
    }

    #[test]
    fn the_last_line_that_was_said_is_found_whatever_it_is() {
        let log = env::temp_dir().join(format!("hil-last-{}.log", std::process::id()));
        assert_eq!(last_line(&log, None), None);
        for (said, expected) in [
            ("", None),
            ("\n \n", None),
            (
                "one\ntwo: no license file\n\n",
                Some("two: no license file"),
            ),
            ("\u{1b}[31mred\n", Some("[31mred")),
        ] {
            fs::write(&log, said).unwrap();
            assert_eq!(last_line(&log, None).as_deref(), expected, "{said:?}");
        }
        fs::write(&log, "no such device\nerror: ./robot ended\n").unwrap();
        let last = last_line(&log, Some("./robot ended"));
        assert_eq!(last.as_deref(), Some("no such device"));
        fs::write(&log, [vec![0xff; 10_000], b"end".to_vec()].concat()).unwrap();
        assert_eq!(
            last_line(&log, None).map(|line| line.chars().count()),
            Some(200)
        );
        fs::remove_file(log).unwrap();
    }

    #[test]
    fn a_child_that_somebody_else_has_reaped_is_lost_and_gets_no_signal() {
        let log = env::temp_dir().join(format!("hil-lost-{}.log", std::process::id()));
        let mut child = Child::spawn_foreign(shell("exit 3"), &log).unwrap();
        child.process.wait().unwrap();
        // Its number may be another's from here on.
        assert!(child.look().is_err());
        child.signal(Signal::SIGKILL);
        assert_eq!(child.poll_end(), Some(ProcessEnd::Lost));
        assert!(child.end(Instant::now()));
        fs::remove_file(log).unwrap();
    }

    #[test]
    fn a_child_that_does_not_stop_is_killed_and_its_end_is_told() {
        let log = env::temp_dir().join(format!("hil-kill-{}.log", std::process::id()));
        let script = "trap '' TERM; echo deaf; sleep 60";
        let mut child = Child::spawn_foreign(shell(script), &log).unwrap();
        let deadline = Instant::now() + Duration::from_secs(10);
        // Asked before it has set its trap it would stop.
        while !fs::read_to_string(&log).unwrap().contains("deaf") {
            assert!(Instant::now() < deadline, "the script did not begin");
            thread::sleep(Duration::from_millis(2));
        }
        child.order(&ToProcess::Stop);
        assert!(!child.end(Instant::now() + Duration::from_millis(50)));
        assert_eq!(
            child.poll_end().unwrap().to_string(),
            "was killed by SIGKILL"
        );
        fs::remove_file(log).unwrap();
    }
}
