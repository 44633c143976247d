//! The machine under a run: clocks, waiting, real-time settings, facts of the host, the terminal.
//! It knows nothing of topologies and runs.

pub mod clock;
pub mod clock_discipline;
pub mod console;
pub mod documents;
pub mod host_facts;
pub mod progress;
pub mod realtime;
pub mod signals;
pub mod systemd;
pub mod wait;
pub mod words;
