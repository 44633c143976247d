//! A user's own program as a process of the run: found before the run begins, and bound to its
//! supervisor, so that it cannot outlive it.

use std::os::unix::process::{CommandExt, parent_id};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, io};

use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::Signal;
use nix::unistd::{AccessFlags, access};

/// Why the own program could not be started.
#[derive(Debug, thiserror::Error)]
pub enum OwnProgramError {
    /// Its supervisor is gone.
    #[error("the supervisor ended before {0} began")]
    Orphaned(String),
    /// Its end cannot be bound to the supervisor's.
    #[error("cannot bind {program} to its supervisor: {source}")]
    Bind {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// The program cannot be executed.
    #[error("cannot execute {program}: {source}")]
    Execute {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
}

/// Replaces this process by `program`, which the kernel will kill when the supervisor ends.
/// Returns only when it fails.
///
/// # Errors
/// When the supervisor is gone or the program cannot be executed.
pub fn become_program(supervisor: u32, program: &[String]) -> Result<(), OwnProgramError> {
    let name = program.first().cloned().unwrap_or_default();
    set_pdeathsig(Signal::SIGKILL).map_err(|errno| OwnProgramError::Bind {
        program: name.clone(),
        source: errno.into(),
    })?;
    // The supervisor may have ended before the line above.
    if parent_id() != supervisor {
        return Err(OwnProgramError::Orphaned(name));
    }
    let source = Command::new(&name).args(&program[1..]).exec();
    Err(OwnProgramError::Execute {
        program: name,
        source,
    })
}

/// Where `program` is, as the shell would find it.
///
/// # Errors
/// When no executable file of that name is on the search path.
pub fn find(program: &str) -> Result<PathBuf, io::Error> {
    let is_executable = |path: &Path| path.is_file() && access(path, AccessFlags::X_OK).is_ok();
    let not_found = || io::Error::new(io::ErrorKind::NotFound, "no such executable file");
    if program.contains('/') {
        let path = PathBuf::from(program);
        return if is_executable(&path) {
            Ok(path)
        } else {
            Err(not_found())
        };
    }
    let search_path = env::var_os("PATH").unwrap_or_default();
    let found = env::split_paths(&search_path).map(|folder| folder.join(program));
    found
        .into_iter()
        .find(|path| is_executable(path))
        .ok_or_else(not_found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_found_like_the_shell_does_and_a_missing_one_is_not() {
        assert!(find("sh").is_ok());
        assert!(find("/bin/sh").is_ok());
        assert!(find("hil-no-such-program").is_err());
        assert!(find("/proc/self/status").is_err());
    }

    #[test]
    fn an_orphan_does_not_start() {
        let error = become_program(u32::MAX, &["true".to_owned()]).unwrap_err();
        assert!(matches!(error, OwnProgramError::Orphaned(_)));
    }
}
