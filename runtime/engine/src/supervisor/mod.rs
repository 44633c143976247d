//! The supervisor: brings the hosts of a run together, starts the processes, watches them, ends
//! everything in order and leaves a complete report, whatever happened. It carries no message.

pub(crate) mod child;
mod claims;
pub(crate) mod clock_path;
mod control_listener;
mod conversation;
pub(crate) mod domains;
pub(crate) mod exchange;
pub mod frame;
mod heartbeat;
pub(crate) mod meet;
pub(crate) mod needs;
mod neighbours;
mod outcome;
mod output_log;
pub(crate) mod peer;
pub mod peer_status;
pub(crate) mod plan;
pub(crate) mod process_group;
mod progress_line;
mod reconnect;
mod rendezvous;
mod session;
mod status_publisher;
mod strangers;

pub(crate) use child::Child;
pub use claims::{ClaimError, Claims};
pub use domains::{DomainsError, sweep};
pub use meet::PeerError;
pub use needs::{HostTooSmall, Shortfall, check_host};
pub use outcome::{RunError, RunOptions};
pub use session::run;
