//! The radio of a wireless hop: what the kernel knows of the association, sampled beside the data
//! and never on the measured path.
//!
//! - `netlink`, `nl80211`: the messages, as bytes.
//! - `socket`: asking and listening.
//! - [`category`]: which access category a mark leads to.

pub mod category;
mod netlink;
#[allow(dead_code, reason = "the sampler of the next step reads them")]
mod nl80211;
#[allow(dead_code, reason = "the sampler of the next step asks")]
pub(crate) mod socket;
