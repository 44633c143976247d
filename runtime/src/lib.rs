//! The runtime: clock, shared memory, threads, processes, files. It runs the case studies of
//! `hil_models` as separate processes and carries their channels through `hil_gateways`.
//!
//! A binary is five lines:
//!
//! ```no_run
//! use hil_models::shuttle::Shuttle;
//!
//! fn main() -> std::process::ExitCode {
//!     hil_runtime::Runtime::new().case::<Shuttle>().run()
//! }
//! ```
//!
//! Read in this order:
//!
//! 1. [`topology`]: what runs where; [`supervisor`]: starts, watches and ends it.
//! 2. [`process`], [`gateway`] and [`face`]: what runs inside each started process.
//! 3. [`channel`]: shared memory between them; [`mod@record`]: the notes they keep.
//! 4. [`report`]: from the notes to what a person reads.
//! 5. [`watch`]: looking on while a run goes; [`link`]: changing its emulated links.
//! 6. [`security`]: the key that keeps strangers out of a run between two hosts.
//! 7. [`realtime`], [`clock`], [`wait`], [`host_facts`], [`doctor`]: the machine.

mod analysis;
pub mod card_clock;
mod cases;
pub mod channel;
pub mod cli;
pub mod clock;
pub mod clock_discipline;
mod command;
pub mod compare;
pub mod console;
pub mod doctor;
pub mod documents;
pub mod face;
pub mod gateway;
pub mod host_facts;
pub mod layout;
pub mod link;
pub mod live;
pub mod manifest;
pub mod probe;
pub mod process;
pub mod progress;
pub mod radio;
pub mod realtime;
pub mod record;
pub mod registry;
mod replay;
pub mod report;
pub mod run_folder;
pub mod security;
mod series;
pub mod signals;
mod simulate;
mod study;
pub mod supervisor;
pub mod systemd;
pub mod topology;
pub mod trace;
pub mod wait;
pub mod watch;
pub mod words;

use std::process::ExitCode;

use hil_models::case_study::CaseStudy;

use crate::registry::Registry;

/// A binary in the making: which case studies it knows.
#[derive(Debug, Default)]
pub struct Runtime {
    registry: Registry,
}

impl Runtime {
    /// A runtime that knows no case yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds the case study `C`.
    ///
    /// # Panics
    /// When two cases have one name.
    #[must_use]
    pub fn case<C: CaseStudy>(mut self) -> Self {
        self.registry.add::<C>();
        self
    }

    /// Reads the command line and does what it says.
    pub fn run(self) -> ExitCode {
        command::run(&self.registry)
    }
}
