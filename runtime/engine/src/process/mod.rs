//! The processes a supervisor starts: what it tells them, what they say, and the component
//! process itself. The gateway process is in [`crate::gateway`].

pub mod component;
pub mod own_program;
pub mod pulse;
pub(crate) mod recording;
pub(crate) mod usage;
