//! Link models: what a network does to a message, as a pure function of time and a seeded
//! stream. They carry no bytes; virtual time and `via = "emulated"` ask them for each message.
#![forbid(unsafe_code)]

mod chain;
#[cfg(test)]
mod chain_tests;
pub mod condition;
pub mod delay;
pub mod impaired;
mod laws;
pub mod loss;
pub mod outages;
pub mod rate;
pub mod reordering;
pub mod spec;
pub mod wifi;
