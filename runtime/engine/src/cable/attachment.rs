//! How a thread gets at the cable's end of a program, and notices that the program's process has ended or started
//! anew. Neither waits for the other: a program may start before the gateway of its link, and after it.

use std::path::PathBuf;
use std::time::Duration;

use hil_cable::{GivenEnd, Knock};
use hil_core::time::Instant;
use hil_shm::Domain;

use crate::process::worker::WorkerError;

/// How often it is looked for a door, and whether one is still there.
const LOOK_PERIOD: Duration = Duration::from_millis(5);

/// The door of one program.
#[derive(Debug)]
pub(super) struct Attachment {
    path: PathBuf,
    knock: Option<Knock>,
    looked: Instant,
}

impl Attachment {
    pub(super) fn new(domain: &Domain, door: &str) -> Self {
        Self {
            path: door_path(domain, door),
            knock: None,
            looked: Instant::ZERO,
        }
    }

    /// When it wants to be looked at next.
    pub(super) fn next_look(&self) -> Instant {
        self.looked + LOOK_PERIOD
    }

    /// True now and then.
    pub(super) fn is_due(&mut self, now: Instant) -> bool {
        let is_due = now >= self.next_look();
        if is_due {
            self.looked = now;
        }
        is_due
    }

    /// The cable's end, when its door is there and open.
    pub(super) fn ask(&mut self) -> Result<Option<GivenEnd>, WorkerError> {
        if self.knock.is_none() {
            self.knock = Knock::at(&self.path).map_err(WorkerError::Socket)?;
        }
        let Some(knock) = &self.knock else {
            return Ok(None);
        };
        Ok(knock.take().unwrap_or_else(|_gone| {
            self.knock = None;
            None
        }))
    }

    /// Lets the program begin; false when its process is gone.
    pub(super) fn begin_program(&self) -> bool {
        let begun = self.knock.as_ref().map(Knock::begin_program);
        matches!(begun, Some(Ok(())))
    }

    /// Whether the process behind the door has ended. It is looked for a new one from then on.
    pub(super) fn has_ended(&mut self) -> bool {
        let is_open = self.knock.as_ref().is_some_and(Knock::is_open);
        if !is_open {
            self.knock = None;
        }
        !is_open
    }
}

/// Where a door of the run in `domain` is.
pub(super) fn door_path(domain: &Domain, door: &str) -> PathBuf {
    domain.address().root_path().join(door)
}
