//! The end of work that looks for signals only now and then: it gets a moment to end by itself, then the
//! program ends without it and takes along what it had begun to write.

use std::fs;
use std::path::PathBuf;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use hil_platform::console::Console;
use hil_platform::signals::{EXIT_INTERRUPTED, Signals};

/// How often it looks for a signal.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// How long the work may take to end by itself.
const GRACE: Duration = Duration::from_millis(400);

/// Watches over work until it is dropped.
#[derive(Debug)]
pub(crate) struct Ending {
    is_over: Arc<AtomicBool>,
}

impl Ending {
    /// From now on a signal ends the program soon; `partial` is what the work writes until it is whole.
    pub(crate) fn watch(signals: &Signals, partial: PathBuf) -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let (signals, over) = (signals.clone(), Arc::clone(&is_over));
        thread::spawn(move || {
            while !over.load(Ordering::Acquire) {
                let Some(signal) = signals.received() else {
                    thread::sleep(LOOK_PERIOD);
                    continue;
                };
                thread::sleep(GRACE);
                if over.load(Ordering::Acquire) {
                    return;
                }
                let mut console = Console::new(true);
                match fs::remove_file(&partial) {
                    Err(error) if partial.exists() => console.error(&format!(
                        "ended by {signal}; what was written so far is in {}: {error}",
                        partial.display()
                    )),
                    _ => console.error(&format!("ended by {signal}; no file was written")),
                }
                process::exit(EXIT_INTERRUPTED);
            }
        });
        Self { is_over }
    }
}

impl Drop for Ending {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Release);
    }
}
