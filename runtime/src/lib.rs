//! The runtime: clock, shared memory, threads, processes, files.
pub mod channel;
pub mod report;
pub mod topology;
