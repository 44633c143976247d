//! Link models: what a network does to a message, as a pure function of time and a seeded
//! stream. They carry no bytes; virtual time and `via = "emulated"` ask them for each message.
#![forbid(unsafe_code)]

pub mod bernoulli;
pub mod chain;
#[cfg(test)]
mod chain_tests;
pub mod condition;
pub mod delay;
pub mod impaired;
pub mod in_series;
pub mod loss;
pub mod outages;
pub mod rate;
pub mod reordering;
pub mod spec;
pub mod switched;
pub mod trace;
mod trace_offers;
mod trace_ticks;
pub mod wifi;
