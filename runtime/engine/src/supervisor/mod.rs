//! The supervisor: brings the hosts of a run together, starts the processes, watches them, ends
//! everything in order and leaves a complete report, whatever happened. It carries no message.

pub(crate) mod child;
pub(crate) mod clock_path;
pub(crate) mod crew;
pub(crate) mod domains;
mod door;
pub mod elsewhere;
pub(crate) mod exchange;
pub mod frame;
mod gathering;
mod heartbeat;
pub(crate) mod meet;
mod outcome;
pub(crate) mod peer;
pub(crate) mod plan;
mod progress_line;
mod session;
mod teller;

pub use domains::{DomainsError, sweep};
pub use meet::PeerError;
pub use outcome::{RunError, RunOptions};
pub use session::run;
