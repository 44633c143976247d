//! What the programs put on the wire of one machine and what links make of it: codecs, captures, emulated links,
//! traces, and programs of others.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::print_stdout,
    reason = "tests"
)]

mod bypass;
mod cable_stress;
mod dissector;
mod egm_clients;
mod foreign_programs;
mod joined_programs;
mod live_links;
mod long_messages;
mod outage_run;
mod trace_live;
mod trace_replay;
mod wake_ups;
