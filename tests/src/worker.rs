//! A worker process of the product, started by its launch file as a supervisor would, without one.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::binary::hil_runtime_binary;
use crate::trial::wait_until;

/// The process with its order pipe, and what it said; killed when dropped.
#[derive(Debug)]
pub struct Worker {
    process: Child,
    words: Arc<Mutex<String>>,
    readers: Vec<JoinHandle<()>>,
}

impl Worker {
    /// Starts it.
    ///
    /// # Panics
    /// When it does not start.
    pub fn start(launch: &Path) -> Self {
        Self::adopt(Self::command(launch).spawn().expect("a worker starts"))
    }

    /// What starts it, for whoever wants to do so elsewhere.
    pub fn command(launch: &Path) -> Command {
        let mut command = Command::new(hil_runtime_binary());
        command.arg("worker").arg("--launch").arg(launch);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        command.stderr(Stdio::piped());
        command
    }

    /// Listens to `process`, which [`Worker::command`] started.
    ///
    /// # Panics
    /// When its pipes are not there.
    pub fn adopt(mut process: Child) -> Self {
        let words = Arc::new(Mutex::new(String::new()));
        let out: Box<dyn Read + Send> = Box::new(process.stdout.take().expect("piped"));
        let errors: Box<dyn Read + Send> = Box::new(process.stderr.take().expect("piped"));
        let readers = [out, errors].map(|pipe| {
            let words = Arc::clone(&words);
            thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    let mut words = words.lock().unwrap_or_else(PoisonError::into_inner);
                    words.push_str(&line);
                    words.push('\n');
                }
            })
        });
        Self {
            process,
            words,
            readers: readers.into(),
        }
    }

    /// Its number.
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// True while it has not ended.
    pub fn is_running(&mut self) -> bool {
        matches!(self.process.try_wait(), Ok(None))
    }

    /// Everything it said so far.
    pub fn words(&self) -> String {
        let words = self.words.lock().unwrap_or_else(PoisonError::into_inner);
        words.clone()
    }

    /// Waits until it is ready.
    ///
    /// # Panics
    /// When it is not within `limit`, or ends.
    pub fn wait_until_ready(&mut self, limit: Duration) {
        wait_until(limit, "a worker to be ready", || {
            let words = self.words();
            assert!(self.is_running(), "{words}");
            words.lines().any(|line| line == "\"ready\"")
        });
    }

    /// Tells it to stop, waits for its end, and gives its exit code and its words.
    ///
    /// # Panics
    /// When it does not end within `limit`.
    pub fn end(mut self, limit: Duration) -> (Option<i32>, String) {
        if let Some(mut orders) = self.process.stdin.take() {
            // One that has ended is gone already.
            let _gone = orders.write_all(b"\"stop\"\n").is_err();
        }
        wait_until(limit, "the end of a worker", || !self.is_running());
        for reader in self.readers.drain(..) {
            reader.join().expect("a reader does not panic");
        }
        let code = self.process.wait().ok().and_then(|end| end.code());
        (code, self.words())
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // Both fail only if it has ended.
        drop(self.process.kill());
        drop(self.process.wait());
    }
}
