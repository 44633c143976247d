//! Recording what is shown: the recorder at work in a thread of its own, so that neither waits for the
//! other. What it writes is what `hil-recorder record` writes.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use hil_platform::console::Console;

use crate::cli::RecordOptions;
use crate::failure::Failure;
use crate::record::{Recorded, record};
use crate::split::another;

/// A run that is being recorded.
#[derive(Debug)]
pub(super) struct Recording {
    /// The file, or the folder that it is written into.
    pub(super) path: PathBuf,
    /// No file came of it.
    pub(super) has_failed: bool,
    thread: Option<JoinHandle<Result<Recorded, Failure>>>,
    stop: Arc<AtomicBool>,
}

impl Recording {
    /// Records the run in `folder`, the `number`th that this server records, from its first message on,
    /// to `target`. Its name would not do: two runs may bear one.
    pub(super) fn begin(folder: &Path, target: &RecordOptions, number: usize) -> Self {
        let path = another(&target.output, number);
        let options = RecordOptions {
            folder: Some(folder.to_owned()),
            output: path.clone(),
            ..target.clone()
        };
        let stop = Arc::new(AtomicBool::new(false));
        let is_stopped = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            record(&options, &mut |_| {
                is_stopped.load(Ordering::Relaxed).then_some("the server")
            })
        });
        Self {
            path,
            has_failed: false,
            thread: Some(thread),
            stop,
        }
    }

    /// Says what came of it, once it is done.
    pub(super) fn look(&mut self, console: &mut Console) {
        if self.thread.as_ref().is_some_and(JoinHandle::is_finished) {
            self.report(console);
        }
    }

    /// Completes the file and says what came of it.
    pub(super) fn end(&mut self, console: &mut Console) {
        self.stop.store(true, Ordering::Relaxed);
        self.report(console);
    }

    fn report(&mut self, console: &mut Console) {
        let Some(thread) = self.thread.take() else {
            return;
        };
        let path = self.path.display();
        let joined = thread.join();
        self.has_failed = !matches!(joined, Ok(Ok(_)));
        match joined {
            Err(_) => console.error(&format!(
                "{path}: the recorder failed; its file is not whole"
            )),
            Ok(Err(error)) => console.error(&format!("nothing is recorded: {error}")),
            Ok(Ok(recorded)) => {
                for words in &recorded.words {
                    console.warn(words);
                }
                console.say(&format!(
                    "{}; missed {}",
                    recorded.files(),
                    recorded.missed.values().sum::<u64>()
                ));
            }
        }
    }
}
