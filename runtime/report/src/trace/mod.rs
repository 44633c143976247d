//! Link traces as files: written when a run is over, replayed by a link, shown and converted by
//! `hil-runtime trace`. What a trace is and what is computed from it is in `hil_trace`.

pub(crate) mod capture;
pub mod cli;
mod open;
mod plots;
pub mod work;
