//! Shared-memory channels.
