//! How a thread gets at the cable's end of a program, and notices that the program's process has ended or started
//! anew. Neither waits for the other: a program may start before the gateway of its link, and after it.

use std::path::PathBuf;
use std::time::Duration;

use hil_cable::{CableClient, GivenEnd};
use hil_core::time::Instant;
use hil_shm::Domain;

use crate::process::worker::WorkerError;

/// How often it is looked for a server, and whether one is still there.
const LOOK_PERIOD: Duration = Duration::from_millis(5);

/// The connection to the server of one program's cable.
#[derive(Debug)]
pub(super) struct Attachment {
    path: PathBuf,
    client: Option<CableClient>,
    looked: Instant,
}

impl Attachment {
    pub(super) fn new(domain: &Domain, socket: &str) -> Self {
        Self {
            path: socket_path(domain, socket),
            client: None,
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

    /// The cable's end, when its server is there and gives it.
    pub(super) fn ask(&mut self) -> Result<Option<GivenEnd>, WorkerError> {
        if self.client.is_none() {
            self.client = CableClient::at(&self.path).map_err(WorkerError::Socket)?;
        }
        let Some(client) = &self.client else {
            return Ok(None);
        };
        Ok(client.take().unwrap_or_else(|_gone| {
            self.client = None;
            None
        }))
    }

    /// Lets the program begin; false when its process is gone.
    pub(super) fn begin_program(&self) -> bool {
        let begun = self.client.as_ref().map(CableClient::begin_program);
        matches!(begun, Some(Ok(())))
    }

    /// Whether the process of the server has ended. It is looked for a new one from then on.
    pub(super) fn has_ended(&mut self) -> bool {
        let is_open = self.client.as_ref().is_some_and(CableClient::is_open);
        if !is_open {
            self.client = None;
        }
        !is_open
    }
}

/// Where a socket of a cable of the run in `domain` is.
pub(super) fn socket_path(domain: &Domain, socket: &str) -> PathBuf {
    domain.address().root_path().join(socket)
}
