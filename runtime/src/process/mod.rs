//! The processes a supervisor starts: what it tells them, what they say, and the component
//! process itself. The gateway process is in [`crate::gateway`].

pub(crate) mod component;
pub mod emulation_room;
pub mod launch;
pub(crate) mod own_program;
pub mod pipe;
pub mod pulse;
pub(crate) mod recording;
pub(crate) mod usage;
