//! Ctrl-C and SIGTERM as a flag the supervisor looks at, and the signal state that a process inherits. A
//! second signal ends the program at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;
use std::{io, process, ptr, thread};

use nix::sys::signal::{SigSet, Signal};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

use crate::console::Console;

/// Exit code of an interrupted run.
pub const EXIT_INTERRUPTED: i32 = 130;
/// Exit code when a second signal ended the program before its report.
const EXIT_DROPPED: i32 = 131;

/// How often a watch looks for a signal.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Undoes what a parent may have left that keeps a program from seeing its children end or from being
/// stopped: an ignored SIGCHLD, with which the kernel tells nobody how a child ended and gives its number
/// away, and blocked signals. First in `main`, before there are threads.
///
/// # Errors
/// When the kernel refuses.
#[allow(unsafe_code, reason = "the disposition of a signal has no safe setter")]
pub fn reset_inherited() -> io::Result<()> {
    // SAFETY: SIG_DFL installs no handler, so no code of this program can run in one.
    let before = unsafe { libc::signal(libc::SIGCHLD, libc::SIG_DFL) };
    if before == libc::SIG_ERR {
        return Err(io::Error::last_os_error());
    }
    Ok(SigSet::empty().thread_set_mask()?)
}

#[allow(unsafe_code, reason = "the disposition of a signal has no safe getter")]
fn is_ignored(signal: i32) -> io::Result<bool> {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: without a new action the call only writes the present one to `action`, which has room for it.
    let result = unsafe { libc::sigaction(signal, ptr::null(), action.as_mut_ptr()) };
    if result != 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the call succeeded, so the kernel's answer is in place.
    let action = unsafe { action.assume_init() };
    Ok(action.sa_sigaction == libc::SIG_IGN)
}

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
    /// Takes over SIGINT, SIGTERM and SIGHUP. SIGINT and SIGHUP stay ignored where this process was started
    /// with them ignored, as by `nohup` or in the background of a script.
    ///
    /// # Errors
    /// When the system refuses a handler.
    ///
    /// # Panics
    /// Never: signal numbers are positive.
    pub fn install() -> io::Result<Self> {
        let which = Arc::new(AtomicUsize::new(0));
        // One for all: the second signal ends the program, of whatever kind either is.
        let armed = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            if signal != SIGTERM && is_ignored(signal)? {
                continue;
            }
            // Order matters: the first signal finds the flag unset and then sets it.
            flag::register_conditional_shutdown(signal, EXIT_DROPPED, Arc::clone(&armed))?;
            flag::register(signal, Arc::clone(&armed))?;
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

    /// The signal that came.
    pub fn received_signal(&self) -> Option<Signal> {
        let number = i32::try_from(self.which.load(Ordering::Acquire)).ok()?;
        Signal::try_from(number).ok()
    }

    /// The signal that came, in words.
    pub fn received(&self) -> Option<&'static str> {
        self.received_signal().map(|signal| match signal {
            Signal::SIGINT => "Ctrl-C (SIGINT)",
            other => other.as_str(),
        })
    }
}
