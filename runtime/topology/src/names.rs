//! What the processes are called that carry channels and clocks between hosts, in reports and in
//! record files, and how long a name may be.

use super::clock_path::{ClockPath, end_name};

/// Longest channel name a record file can carry.
pub const CHANNEL_NAME_BYTES_MAX: usize = 96;

/// What the gateway process of `link` on `host` is called, in reports and in record files.
pub fn gateway_name(link: &str, host: &str) -> String {
    format!("gateway-{link}-{host}")
}

/// What the process on `host` is called that records for the programs of the user's there.
pub fn witness_name(host: &str) -> String {
    format!("witness-{host}")
}

/// Name of the process at the end of `path` on `host`.
pub fn clock_process_name(path: &ClockPath<'_>, host: &str) -> String {
    let other = if path.from.name == host {
        &path.to.name
    } else {
        &path.from.name
    };
    end_name(host, other)
}
