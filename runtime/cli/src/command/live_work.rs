//! The commands that look at a run while it goes: `channel` and `top`.

use super::{columns_or, exit, interrupted, signals};
use hil_platform::console::Console;
use hil_topology::registry::Registry;
use hil_watch::live::channel;
use hil_watch::live::channel::End;
use hil_watch::live::cli::{ChannelArgs, TopArgs};
use hil_watch::live::top;
use hil_watch::live::top::{TopEnd, TopError};

/// `channel`.
pub(super) fn channel(args: ChannelArgs, registry: &Registry, console: &mut Console) -> u8 {
    let signals = match signals(console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    match channel::run(args, registry, &signals, console) {
        Ok(End::Done) => exit::RAN,
        Ok(End::Interrupted) => interrupted(),
        Err(error) => {
            console.error(&error.to_string());
            if error.is_usage() {
                exit::USAGE
            } else {
                exit::FAILED
            }
        }
    }
}

/// Columns of `top` where there is no terminal: nothing of a process is cut.
const PLAIN_COLUMNS: usize = 132;

/// `top`.
pub(super) fn top(args: &TopArgs, registry: &Registry, console: &mut Console) -> u8 {
    let signals = match signals(console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    match top::run(
        args,
        columns_or(PLAIN_COLUMNS),
        registry,
        (&signals, console),
    ) {
        Ok(TopEnd::Done) => exit::RAN,
        Ok(TopEnd::Interrupted) => interrupted(),
        Err(error) => {
            console.error(&error.to_string());
            match error {
                TopError::Observe(_) => exit::USAGE,
                TopError::Terminal(_) => exit::FAILED,
                TopError::Json(_) => exit::INTERNAL,
            }
        }
    }
}
