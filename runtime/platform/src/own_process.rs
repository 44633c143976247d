//! This program as a process: what it inherits, and how it starts itself again.

use std::ffi::{CString, OsString};
use std::os::unix::ffi::OsStringExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::{env, io};

use nix::sys::prctl;
use nix::sys::stat::{Mode, umask};

use crate::{open_files, signals};

/// The file that runs, whatever lies at its path by now: a newer build, or nothing.
pub const RUNNING_FILE: &str = "/proc/self/exe";

/// Undoes what a parent may have left that changes how a run goes: see [`signals::reset_inherited`]; descriptors,
/// which none of this program's own processes has; a mask with which others could write the files of a run.
/// First in `main`.
///
/// # Errors
/// When the kernel refuses.
pub fn begin() -> io::Result<()> {
    signals::reset_inherited()?;
    open_files::withhold()?;
    let inherited = umask(Mode::S_IWOTH);
    umask(inherited | Mode::S_IWOTH);
    // Started as [`RUNNING_FILE`], it would be called `exe` in every list of processes.
    let called = Path::new(&own_name()).file_name().map(Into::into);
    if let Some(name) = called.and_then(|name: OsString| CString::new(name.into_vec()).ok()) {
        prctl::set_name(&name)?;
    }
    Ok(())
}

/// This program once more, by [`RUNNING_FILE`] and under the name that it was started by.
pub fn again() -> Command {
    let mut command = Command::new(RUNNING_FILE);
    command.arg0(own_name());
    command
}

fn own_name() -> OsString {
    let own = env::args_os().next();
    own.unwrap_or_else(|| "hil-runtime".into())
}
