//! The network hop: local channel -> [`protocol`] -> [`transport`] -> [`net`], and back; and [`capture`],
//! which looks at the wire without taking part.
pub mod capture;
pub mod net;
pub mod protocol;
pub mod transport;
