//! The processes a supervisor starts: their shell, and the component process itself. Gateway and
//! adapter are in [`crate::gateway`] and [`crate::face`].

mod component;
pub mod own_program;
pub(crate) mod pulse;
pub(crate) mod recording;
pub mod worker;
