//! The radio of a wireless hop: what the kernel knows of the association, sampled beside the data
//! and never on the measured path.
//!
//! - `netlink`, `nl80211`: the messages, as bytes; `conversation`: question and answer.
//! - `socket`: asking and listening; `sampler`: doing so ten times a second.
//! - [`record`]: what is written down.
//! - [`category`]: which access category a mark leads to.

pub mod category;
pub(crate) mod conversation;
pub(crate) mod netlink;
pub(crate) mod nl80211;
pub mod record;
pub(crate) mod sampler;
pub(crate) mod socket;
