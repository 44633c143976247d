//! The network hop: local channel -> [`protocol`] -> [`transport`], and back.
pub mod protocol;
pub mod transport;
