//! What lets those look on who are not this user on this machine: a random number in the address that is
//! printed, and who has a connection.

use std::fmt;
use std::io;

use hil_platform::random::random_bytes;
use hil_platform::socket_table::user_of_connection;
use nix::unistd::Uid;
use subtle::ConstantTimeEq as _;
use tokio::net::TcpStream;

/// As many bits as a key has.
const BYTES: usize = 16;

/// Who has it may look on.
pub(crate) struct Token(String);

impl Token {
    /// A new one, which nobody can guess.
    ///
    /// # Errors
    /// When the kernel has no random numbers.
    pub(crate) fn draw() -> io::Result<Self> {
        Ok(Self(format!(
            "{:032x}",
            u128::from_ne_bytes(random_bytes::<BYTES>()?)
        )))
    }

    /// Whether it is `told`; how much of it is right takes no time to find.
    pub(crate) fn is(&self, told: &str) -> bool {
        self.0.as_bytes().ct_eq(told.as_bytes()).into()
    }
}

/// As an address has it behind its path.
impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "?token={}", self.0)
    }
}

/// Not what it is.
impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token")
    }
}

/// Whether the other end of `stream` is a process of this user on this machine. Root as another user is not:
/// its proxies hand on what others send.
pub(super) fn is_own(stream: &TcpStream) -> bool {
    let ends = stream
        .peer_addr()
        .and_then(|peer| Ok((peer, stream.local_addr()?)));
    let user = ends.and_then(|(peer, here)| user_of_connection(peer, here));
    // Where the kernel does not say, there is the token.
    user.ok().flatten() == Some(Uid::effective().as_raw())
}
