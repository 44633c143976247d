//! A run that never was, its rendered reports, and what follows from its figures.

mod answers;
pub(crate) mod sample;
pub(crate) mod sample_events;
mod sample_network;
mod sample_records;
