//! What a run leaves behind for people: the summary that goes into `summary.json` and its
//! rendering for a terminal. It measures nothing and prints nothing; the caller writes the text.
#![forbid(unsafe_code)]

pub mod adapter;
pub mod adapter_metrics;
mod adapter_warnings;
pub mod analysis;
pub mod answer;
pub mod assessment;
mod burst_classes;
pub mod clock_summary;
pub mod compare;
pub mod emulation;
pub(crate) mod event_log;
pub mod link_change;
pub mod network;
pub mod nic_metrics;
mod own_programs;
pub mod page;
pub mod radio;
pub mod replay;
pub mod score_event;
mod sections;
pub mod simulate;
pub mod study;
pub mod summary;
pub mod terminal;
pub mod trace;
pub mod trace_counts;

pub use sections::quantile_table;

#[cfg(test)]
mod tests;
