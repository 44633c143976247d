//! Network cards with their clocks, and radios: what this host's interfaces are asked and told beside
//! the messages. It carries no message itself.
#![forbid(unsafe_code)]

pub mod nic_clock;
pub mod radio;
