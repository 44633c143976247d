//! Shared by the benches: who measured where, in which order, and what is printed. What is
//! measured is in `benches/*.rs`.
//!
//! A bench interleaves its cases round by round in one run, because neighbours on the machine
//! change by the minute; every round begins and ends with a *floor*, the fastest thing the
//! machine can do of that kind, and rounds whose floor jumps are rejected and counted. Figures
//! are quantiles and paired ratios, never a bare mean.
#![forbid(unsafe_code)]

pub mod adapter;
pub mod cable;
pub mod gateway;
mod host;
mod quantiles;
mod report;
mod rounds;
pub mod turns;

pub use host::{HostFacts, on_cpu, pin_to_cpu};
pub use quantiles::{PairedRatio, Quantiles, TypicalRatio};
pub use report::{json_line, table};
pub use rounds::{Case, Comparison, FLOOR_JUMP_RATIO_MAX, Row, compare};
