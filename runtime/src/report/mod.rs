//! What a run leaves behind for people: the summary that goes into `summary.json` and its
//! rendering for a terminal. It measures nothing and prints nothing; the caller writes the text.

pub(crate) mod alike;
pub mod assessment;
pub mod clock_summary;
pub mod emulation;
pub(crate) mod event_log;
pub mod face;
mod face_warnings;
pub mod link_change;
pub mod network;
pub(crate) mod page;
pub mod radio;
pub(crate) mod replay;
pub mod score_event;
pub mod summary;
pub mod terminal;

#[cfg(test)]
pub(crate) mod sample;
#[cfg(test)]
mod sample_events;
#[cfg(test)]
mod sample_network;
#[cfg(test)]
mod sample_records;
