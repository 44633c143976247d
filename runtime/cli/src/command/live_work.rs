//! The commands that look at a run while it goes: `channel` and `top`.

use super::{Refusal, code_of, columns_or, exit, failed, signals, usage};
use hil_platform::console::Console;
use hil_topology::registry::Registry;
use hil_watch::live::channel;
use hil_watch::live::cli::{ChannelArgs, TopArgs};
use hil_watch::live::top::{self, TopError};

/// `channel`.
pub(super) fn channel(
    args: ChannelArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    match channel::run(args, registry, &signals()?, console) {
        Ok(end) => Ok(code_of(end)),
        Err(error) if error.is_usage() => Err(usage(error)),
        Err(error) => Err(failed(error)),
    }
}

/// Columns of `top` where there is no terminal: nothing of a process is cut.
const PLAIN_COLUMNS: usize = 132;

/// `top`.
pub(super) fn top(
    args: &TopArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let signals = signals()?;
    let columns = columns_or(PLAIN_COLUMNS);
    match top::run(args, columns, registry, &signals, console) {
        Ok(end) => Ok(code_of(end)),
        Err(error) => {
            let code = match error {
                TopError::Observe(_) => exit::USAGE,
                TopError::Terminal(_) => exit::FAILED,
                TopError::Json(_) => exit::INTERNAL,
            };
            Err(Refusal::new(code, error))
        }
    }
}
