//! Counts connections iceoryx2 could not make. By itself it only logs them, and the channel then
//! delivers nothing without an error: typically the other process runs as another Unix user.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};

/// Shared with the handler of one port.
#[derive(Debug, Default)]
pub(crate) struct ConnectionFailures(Arc<AtomicU64>);

impl ConnectionFailures {
    /// What the port calls when it cannot connect or finds a connection corrupted. It carries on:
    /// one process that died half-way must not take its healthy partners with it.
    pub(crate) fn handler(
        &self,
    ) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + 'static {
        let count = Arc::clone(&self.0);
        move |_, _| {
            count.fetch_add(1, Ordering::Relaxed);
            DegradationAction::Ignore
        }
    }

    pub(crate) fn count(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
