//! The runtime: clock, shared memory, threads, processes, files.
pub mod channel;
pub mod clock;
pub mod doctor;
pub mod host_facts;
pub mod realtime;
pub mod report;
pub mod topology;
