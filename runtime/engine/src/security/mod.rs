//! What keeps strangers out of a run between two hosts: the key file, the encrypted connection of the
//! supervisors, and the secret of one run. How datagrams are sealed with it is in
//! `hil_protocol::seal`; docs/security.md has the whole of it.

mod channel;
pub mod cli;
pub(crate) mod greeting;
pub mod key_file;

pub(crate) use channel::{SecureReader, SecureWriter};
pub use key_file::{KeyFileError, PreSharedKey};
