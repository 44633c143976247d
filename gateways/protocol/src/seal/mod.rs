//! The seal: every datagram of a secured hop encrypted and authenticated, sans IO. It lies between a
//! bridge and its transport and knows nothing of messages: a bridge meets authentic datagrams only.
//!
//! A sealed datagram is its header as it is, readable and authenticated, the payload encrypted, and a
//! 16-byte tag. Two header fields are the seal's own: flag bit 0 with the key's generation in the flags'
//! high byte, and in the reserved bytes 68..72 the datagram's number under its key, from which the
//! nonce follows. The producer's sequence would not do: it begins anew when the producer does, under a
//! gateway whose key goes on.
//!
//! **Keys.** All of it follows from a secret of the run ([`RunSecret`]), which the supervisors agree on
//! and which is never used twice. The two ends of a flow exchange random salts, `KEY_REQ` from the
//! sender and `KEY_ANS` from the receiver, both under HMAC of the run's secret. From secret, flow and
//! both salts come one key per way ([`keys`]). A gateway that starts again draws another salt, so no
//! key is ever used with a nonce again, and a request that is played back opens nothing: whoever cannot
//! seal under the fresh keys has proven nothing, and the bridge hears of nobody before.
//!
//! **Rotation.** A key serves [`Rotation::datagram_count`] datagrams or [`Rotation::period_ns`], then
//! the sender goes to the next generation, which follows from the last by HKDF. The receiver knows the
//! next key beforehand, so that a forged generation costs it no derivation, and takes the one before for
//! a while by the sender's own clock, which is authentic.
//!
//! **Replays.** A number is taken once within a window of 2048 ([`window`]), looked at after the tag.
//!
//! A stranger gets no answer: the receiver answers `KEY_REQ` alone, with as many bytes, and only if the
//! request is authentic and newer than the last.

pub mod counts;
mod initiator;
pub mod keys;
mod layout;
mod responder;
mod traffic;
pub mod window;

pub use counts::{SealCounts, SealRefusal, SealRefusalCounts};
pub use initiator::{Heard, Initiator, UNANSWERED_MAX};
pub use keys::{Association, RunSecret, SALT_BYTES, Salt, Suite};
pub use layout::KEY_EXCHANGE_BYTES;
pub use responder::{Opened, Responder};
pub use traffic::Rotation;

#[cfg(test)]
mod tests;
