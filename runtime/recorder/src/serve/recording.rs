//! Recording what is shown: the recorder at work in a thread of its own, so that neither waits for the
//! other. What it writes is what `hil-recorder record` writes.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_runtime::console::Console;

use crate::priority::Priority;
use crate::record::{RecordError, Recorded, Request, record};
use crate::scene::Scenery;
use crate::split::Split;

/// What a kill may lose at most.
const FLUSH: Duration = Duration::from_secs(1);

/// A run that is being recorded.
#[derive(Debug)]
pub(super) struct Recording {
    /// The file, or the folder that it is written into.
    pub(super) path: PathBuf,
    thread: Option<JoinHandle<Result<Recorded, RecordError>>>,
    stop: Arc<AtomicBool>,
}

impl Recording {
    /// Records the run called `run` into `path`, from its first message on.
    pub(super) fn begin(run: &str, path: &Path) -> Self {
        let request = Request {
            run: Some(run.to_owned()),
            output: path.to_owned(),
            waits: false,
            below: None,
            from_now: false,
            split: Split::default(),
            flush: FLUSH,
            force: false,
            priority: Priority::Idle,
            scenery: Scenery::Drawn,
        };
        let stop = Arc::new(AtomicBool::new(false));
        let is_stopped = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            record(&request, &mut |_| {
                is_stopped.load(Ordering::Relaxed).then_some("the server")
            })
        });
        Self {
            path: path.to_owned(),
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
        match thread.join() {
            Err(_) => console.error(&format!(
                "{path}: the recorder failed; its file is not whole"
            )),
            Ok(Err(error)) => console.error(&format!("nothing is recorded: {error}")),
            Ok(Ok(recorded)) => {
                for words in &recorded.words {
                    console.warn(words);
                }
                let files = recorded.paths.iter().map(|path| path.display().to_string());
                console.say(&format!(
                    "{}: {} messages of the run; missed {}",
                    files.collect::<Vec<_>>().join(", "),
                    recorded.message_count,
                    recorded.missed.values().sum::<u64>()
                ));
            }
        }
    }
}
