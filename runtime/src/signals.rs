//! Ctrl-C and SIGTERM as a flag the supervisor looks at. A second one ends the program at once.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

/// Exit code of an interrupted run.
pub const EXIT_INTERRUPTED: i32 = 130;
/// Exit code when a second signal ended the program before its report.
const EXIT_DROPPED: i32 = 131;

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
