//! What keeps strangers out of a run between two hosts: the key file, the encrypted connection of the
//! supervisors, and the secret of one run. How datagrams are sealed with it is in
//! `hil_gateways::protocol::seal`; docs/security.md has the whole of it.

mod channel;
pub mod cli;
pub(crate) mod greeting;
pub mod key_file;
mod protection;
mod run_seal;

use std::fs::File;
use std::io::{self, Read};

pub(crate) use channel::{SecureReader, SecureWriter};
pub(crate) use greeting::TimedStream;
pub use key_file::{KeyFileError, PreSharedKey};
pub use protection::{HopProtection, RunSecurity};
pub use run_seal::RunSeal;
pub(crate) use run_seal::{has_fast_aes, suite_for};

/// `N` bytes that nobody can guess.
///
/// # Errors
/// When the system gives none.
pub(crate) fn random_bytes<const N: usize>() -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes)
}
