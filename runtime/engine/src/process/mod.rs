//! The processes a supervisor starts: their shell, and the component process itself. Gateway and
//! adapter are in [`crate::gateway`] and [`crate::adapter`].

pub mod again;
mod component;
pub(crate) mod heartbeat;
pub mod host;
pub mod own_program;
pub(crate) mod recording;
pub mod worker;
