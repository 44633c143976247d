//! A child process that cannot outlive its test: killed on drop, waited for with a limit, its
//! output collected while it runs. It kills the one process it started, by its identifier.

use std::fmt;
use std::io::{self, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How often a waiting test looks.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// How long output may trail the end of a process, for example from a grandchild.
const TRAILING_OUTPUT_MAX: Duration = Duration::from_secs(2);

/// A running child with its output.
#[derive(Debug)]
pub struct ChildGuard {
    child: Child,
    label: String,
    stdout: Collector,
    stderr: Collector,
}

/// How a child ended and what it said.
#[derive(Debug, Clone)]
pub struct Finished {
    /// The exit code or the signal.
    pub status: ExitStatus,
    /// All of its standard output.
    pub stdout: String,
    /// All of its standard error.
    pub stderr: String,
}

impl Finished {
    /// Checks that the exit code is zero.
    ///
    /// # Panics
    /// With the whole output when it is not.
    pub fn assert_success(&self) {
        self.assert_code(0);
    }

    /// Checks that the exit code is `code`.
    ///
    /// # Panics
    /// With the whole output when it is not.
    pub fn assert_code(&self, code: i32) {
        assert_eq!(
            self.status.code(),
            Some(code),
            "ended with {}\n--- stdout\n{}\n--- stderr\n{}",
            self.status,
            self.stdout,
            self.stderr
        );
    }
}

/// A child that did not do in time what was waited for.
#[derive(Debug, Clone)]
pub struct TimedOut {
    /// What was waited for, and how long.
    pub waited_for: String,
    /// Its standard output so far.
    pub stdout: String,
    /// Its standard error so far.
    pub stderr: String,
}

impl fmt::Display for TimedOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{}\n--- stdout so far\n{}\n--- stderr so far\n{}",
            self.waited_for, self.stdout, self.stderr
        )
    }
}

impl std::error::Error for TimedOut {}

impl ChildGuard {
    /// Starts `command` with its output collected and its input closed.
    ///
    /// # Errors
    /// When the program cannot be started; the error names it.
    pub fn spawn(command: &mut Command) -> io::Result<Self> {
        let label = command.get_program().to_string_lossy().into_owned();
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|error| io::Error::new(error.kind(), format!("{label}: {error}")))?;
        let stdout = Collector::start(child.stdout.take());
        let stderr = Collector::start(child.stderr.take());
        Ok(Self {
            child,
            label,
            stdout,
            stderr,
        })
    }

    /// The process identifier.
    ///
    /// # Panics
    /// Never: Linux identifiers stay below 2^22.
    pub fn pid(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.child.id()).expect("Linux identifiers fit in 31 bits"))
    }

    /// Sends a signal to this process only.
    ///
    /// # Errors
    /// The kernel's, for example when it has been waited for already.
    pub fn signal(&self, signal: Signal) -> nix::Result<()> {
        kill(self.pid(), signal)
    }

    /// Whether it has not ended yet.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// What it wrote to standard output so far.
    pub fn stdout_so_far(&self) -> String {
        self.stdout.text()
    }

    /// What it wrote to standard error so far.
    pub fn stderr_so_far(&self) -> String {
        self.stderr.text()
    }

    /// Waits until `words` occur in its standard output or standard error.
    ///
    /// # Errors
    /// [`TimedOut`] after `limit`, or as soon as it ended without having written them.
    pub fn wait_for_output(&mut self, words: &str, limit: Duration) -> Result<(), TimedOut> {
        let deadline = Instant::now() + limit;
        loop {
            let is_over = !self.is_running();
            if is_over {
                self.finish_collecting();
            }
            if self.stdout.text().contains(words) || self.stderr.text().contains(words) {
                return Ok(());
            }
            if is_over || Instant::now() >= deadline {
                let how = if is_over { "ended" } else { "went on" };
                return Err(self.timed_out(&format!("{how} without writing `{words}`"), limit));
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// [`TimedOut`] after `limit`; it then goes on running until the guard is dropped.
    pub fn wait_within(&mut self, limit: Duration) -> Result<Finished, TimedOut> {
        let deadline = Instant::now() + limit;
        loop {
            if let Ok(Some(status)) = self.child.try_wait() {
                self.finish_collecting();
                let (stdout, stderr) = (self.stdout.text(), self.stderr.text());
                return Ok(Finished {
                    status,
                    stdout,
                    stderr,
                });
            }
            if Instant::now() >= deadline {
                return Err(self.timed_out("did not end", limit));
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    fn timed_out(&self, what: &str, limit: Duration) -> TimedOut {
        TimedOut {
            waited_for: format!("{} {what} (limit {limit:?})", self.label),
            stdout: self.stdout.text(),
            stderr: self.stderr.text(),
        }
    }

    fn finish_collecting(&mut self) {
        let deadline = Instant::now() + TRAILING_OUTPUT_MAX;
        for collector in [&mut self.stdout, &mut self.stderr] {
            collector.finish_by(deadline);
        }
    }
}

impl Drop for ChildGuard {
    fn drop(&mut self) {
        if self.is_running() {
            // Both fail only if it ended in between.
            drop(self.child.kill());
            drop(self.child.wait());
        }
    }
}

/// Runs `command` to its end.
///
/// # Errors
/// When it cannot be started, runs beyond `limit`, or ends with another code than zero; in words.
pub fn run(command: &mut Command, limit: Duration) -> Result<Finished, String> {
    let shown = format!("{command:?}");
    let mut child = ChildGuard::spawn(command).map_err(|error| error.to_string())?;
    let finished = child
        .wait_within(limit)
        .map_err(|late| format!("{shown}: {late}"))?;
    if finished.status.success() {
        return Ok(finished);
    }
    Err(format!(
        "{shown} ended with {}: {}",
        finished.status,
        finished.stderr.trim()
    ))
}

/// Reads a pipe to its end in a thread.
#[derive(Debug)]
struct Collector {
    bytes: Arc<Mutex<Vec<u8>>>,
    reader: Option<JoinHandle<()>>,
}

impl Collector {
    fn start(pipe: Option<impl Read + Send + 'static>) -> Self {
        let bytes = Arc::new(Mutex::new(Vec::new()));
        let shared = Arc::clone(&bytes);
        let reader = pipe.map(|mut pipe| {
            thread::spawn(move || {
                let mut chunk = [0_u8; 4096];
                while let Ok(length @ 1..) = pipe.read(&mut chunk) {
                    lock(&shared).extend_from_slice(&chunk[..length]);
                }
            })
        });
        Self { bytes, reader }
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&lock(&self.bytes)).into_owned()
    }

    /// Waits for the end of the pipe, but not beyond `deadline`: a grandchild may hold it open.
    fn finish_by(&mut self, deadline: Instant) {
        while self
            .reader
            .as_ref()
            .is_some_and(|reader| !reader.is_finished())
        {
            if Instant::now() >= deadline {
                return;
            }
            thread::sleep(POLL_INTERVAL);
        }
        self.reader = None;
    }
}

fn lock(bytes: &Mutex<Vec<u8>>) -> std::sync::MutexGuard<'_, Vec<u8>> {
    // A reader that panicked has still left whole chunks behind.
    bytes
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const LONG: Duration = Duration::from_secs(30);

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn output_and_exit_code_are_collected() {
        let mut child = ChildGuard::spawn(&mut shell("echo out; echo err >&2; exit 3")).unwrap();
        let finished = child.wait_within(LONG).unwrap();
        assert_eq!(finished.status.code(), Some(3));
        assert_eq!(
            (finished.stdout.as_str(), finished.stderr.as_str()),
            ("out\n", "err\n")
        );
    }

    #[test]
    fn output_larger_than_a_pipe_does_not_block_the_child() {
        let script = "head -c 300000 /dev/zero | tr '\\0' x";
        let finished = run(&mut shell(script), LONG).unwrap();
        assert_eq!(finished.stdout.len(), 300_000);
    }

    #[test]
    fn a_dropped_child_is_gone() {
        let child = ChildGuard::spawn(&mut shell("exec sleep 1000")).unwrap();
        let process = format!("/proc/{}", child.pid());
        assert!(Path::new(&process).exists());
        drop(child);
        assert!(!Path::new(&process).exists());
    }

    #[test]
    fn a_late_child_is_reported_with_its_output() {
        let mut child = ChildGuard::spawn(&mut shell("echo early; exec sleep 1000")).unwrap();
        child.wait_for_output("early", LONG).unwrap();
        let late = child.wait_within(Duration::from_millis(20)).unwrap_err();
        assert!(late.to_string().contains("early"), "{late}");
        child.signal(Signal::SIGTERM).unwrap();
        assert!(!child.wait_within(LONG).unwrap().status.success());
    }

    #[test]
    fn waiting_for_words_ends_with_the_child() {
        let mut child = ChildGuard::spawn(&mut shell("echo something else")).unwrap();
        let late = child.wait_for_output("ready", LONG).unwrap_err();
        assert!(
            late.waited_for.contains("ended without writing `ready`"),
            "{late}"
        );
    }

    #[test]
    fn a_program_that_does_not_exist_names_itself() {
        let error = ChildGuard::spawn(&mut Command::new("/no/such/program")).unwrap_err();
        assert!(error.to_string().contains("/no/such/program"), "{error}");
    }
}
