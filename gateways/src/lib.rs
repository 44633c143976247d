//! The network hop: local channel -> [`protocol`] -> [`transport`], and back; and [`capture`], which
//! looks at the wire without taking part.
pub mod capture;
pub mod protocol;
pub mod transport;
