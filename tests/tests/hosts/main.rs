//! Runs between two hosts, each a network namespace with memory of its own: accounts, kills, cables, clocks, keys,
//! probes. Without the rights for that they say so and are skipped; in CI they fail.

#![allow(
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::print_stdout,
    reason = "tests"
)]

mod chaos;
mod claims;
mod clock_path;
mod clock_run;
mod disturbances;
mod egm_faces;
mod fleet;
mod forged_traffic;
mod full_disk;
mod hardware_stamps;
mod joined_hosts;
mod kills;
mod limits;
mod many_channels;
mod one_pc;
mod own_programs;
mod probe_run;
mod recorded_rows;
mod secured_run;
mod soak;
mod split_run;
mod stranger_words;
mod strangers;
mod tcp_run;
mod teleop_hop;
mod transports;
