//! Ctrl-C and SIGTERM as a flag the supervisor looks at. A second one ends the program at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;
use std::{io, process, thread};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

use crate::console::Console;

/// Exit code of an interrupted run.
pub const EXIT_INTERRUPTED: i32 = 130;
/// Exit code when a second signal ended the program before its report.
const EXIT_DROPPED: i32 = 131;

/// How often a watch looks for a signal.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// While it lives a signal ends the program; see [`Signals::end_program_unless_over`].
#[derive(Debug)]
pub struct EndWatch {
    is_over: Arc<AtomicBool>,
}

impl Drop for EndWatch {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Release);
    }
}

/// The user's wish to end.
#[derive(Debug, Clone)]
pub struct Signals {
    which: Arc<AtomicUsize>,
}

impl Signals {
    /// Takes over SIGINT, SIGTERM and SIGHUP.
    ///
    /// # Errors
    /// When the system refuses a handler.
    ///
    /// # Panics
    /// Never: signal numbers are positive.
    pub fn install() -> io::Result<Self> {
        let which = Arc::new(AtomicUsize::new(0));
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            let armed = Arc::new(AtomicBool::new(false));
            // Order matters: the first signal finds the flag unset and then sets it.
            flag::register_conditional_shutdown(signal, EXIT_DROPPED, Arc::clone(&armed))?;
            flag::register(signal, armed)?;
            let number = usize::try_from(signal).expect("signal numbers are positive");
            flag::register_usize(signal, Arc::clone(&which), number)?;
        }
        Ok(Self { which })
    }

    /// From now until the watch is dropped a signal ends the program with
    /// [`EXIT_INTERRUPTED`] and a line with the reason: for work that does not look at signals.
    pub fn end_program_unless_over(&self, why: &'static str) -> EndWatch {
        self.end_program_after(Duration::ZERO, move |signal| {
            format!("ended by {signal}: {why}")
        })
    }

    /// As [`Self::end_program_unless_over`], `grace` after the signal and with the line that `last` makes of
    /// it: for work that looks at signals only now and then.
    pub fn end_program_after(
        &self,
        grace: Duration,
        last: impl FnOnce(&str) -> String + Send + 'static,
    ) -> EndWatch {
        let is_over = Arc::new(AtomicBool::new(false));
        let (signals, over) = (self.clone(), Arc::clone(&is_over));
        thread::spawn(move || {
            while !over.load(Ordering::Acquire) {
                let Some(signal) = signals.received() else {
                    thread::sleep(LOOK_PERIOD);
                    continue;
                };
                thread::sleep(grace);
                if !over.load(Ordering::Acquire) {
                    Console::new(true).error(&last(signal));
                    process::exit(EXIT_INTERRUPTED);
                }
            }
        });
        EndWatch { is_over }
    }

    /// The signal that came, in words.
    pub fn received(&self) -> Option<&'static str> {
        match i32::try_from(self.which.load(Ordering::Acquire)) {
            Ok(SIGINT) => Some("Ctrl-C (SIGINT)"),
            Ok(SIGTERM) => Some("SIGTERM"),
            Ok(SIGHUP) => Some("SIGHUP"),
            _ => None,
        }
    }
}
