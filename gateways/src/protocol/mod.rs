//! The gateway protocol, sans IO.
