//! A run as it goes: the supervisor, and what runs inside each process that it starts. It reads no
//! report and draws nothing.
#![forbid(unsafe_code)]

pub mod adapter;
mod cable;
pub mod gateway;
pub mod process;
pub mod security;
pub mod supervisor;
mod witness;
