//! The command line of the runtime's program: what each command is called and what it does.
#![forbid(unsafe_code)]

pub mod arguments;
pub mod cases;
pub mod command;

use std::process::ExitCode;

use hil_core::case_study::CaseStudy;

use hil_topology::registry::Registry;

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
