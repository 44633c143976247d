//! Random numbers of the system.

use std::io;

/// `N` bytes that nobody can guess, from the kernel itself and not from a file that may not be there.
///
/// # Errors
/// When the system gives none.
pub fn random_bytes<const N: usize>() -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes)?;
    Ok(bytes)
}
