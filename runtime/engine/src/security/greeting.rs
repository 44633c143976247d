//! The handshake that opens a supervisors' connection: Noise `NNpsk0` (revision 34), so that each
//! connection has keys of its own that nobody can compute later, the key file's holder included, and
//! neither end goes on with one that does not hold the key. Nothing here waits longer than told.
//!
//! ```text
//! connecting end -> HILK 1 1 length  e, names of both ends      152 bytes or more
//! listening end  -> HILK 1 2 length  e, ee                       56 bytes
//!                or HILK 1 3 length  why not                      9 bytes
//! ```
//!
//! The last is not sealed: anybody can say it, so it is a hint and ends no waiting.
//!
//! A first message that was recorded and is played back gets the second, which is shorter, and nothing
//! more: the next must be sealed by keys that the recording does not give.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use snow::{Builder, HandshakeState};

use super::channel::{SecureReader, SecureWriter};
use super::key_file::PreSharedKey;

const PATTERN: &str = "Noise_NNpsk0_25519_ChaChaPoly_SHA256";
const PROLOGUE: &[u8] = b"hil-runtime control v1";
/// What a secured connection begins with; no plain frame does.
pub(crate) const MAGIC: [u8; 4] = *b"HILK";
const VERSION: u8 = 1;
const FIRST: u8 = 1;
const SECOND: u8 = 2;
const REFUSAL: u8 = 3;
const HEAD_BYTES: usize = 8;
/// Longest handshake message.
const MESSAGE_BYTES_MAX: usize = 512;
/// Names are padded to this, so that the answer is always shorter than the question.
const NAMES_BYTES_MIN: usize = 96;

/// Why a handshake came to nothing.
#[derive(Debug, thiserror::Error)]
pub(crate) enum GreetingError {
    /// The connection ended, was too slow, or spoke something else.
    #[error("{0}")]
    Connection(#[from] io::Error),
    /// The other end refuses, and why.
    #[error("refused without proof of the key: {0:?}")]
    Refused(Why),
}

/// Why one end turns the other away before either has proven the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Why {
    /// It holds another key, or none.
    AnotherKey,
    /// This end works without a key.
    PlainHere,
}

impl Why {
    const fn code(self) -> u8 {
        match self {
            Self::AnotherKey => 1,
            Self::PlainHere => 2,
        }
    }

    const fn of(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::AnotherKey),
            2 => Some(Self::PlainHere),
            _ => None,
        }
    }
}

/// Both halves of a connection that proved the key.
pub(crate) struct Secured {
    pub(crate) reader: SecureReader,
    pub(crate) writer: SecureWriter,
}

/// A connection that is read until a deadline, however slowly its bytes come.
#[derive(Debug)]
pub(crate) struct TimedStream {
    stream: TcpStream,
    deadline: Option<Instant>,
    /// Read already, to be read again, and how many of them.
    again: ([u8; 4], usize),
}

impl TimedStream {
    pub(crate) fn new(stream: TcpStream, deadline: Instant) -> Self {
        Self {
            stream,
            deadline: Some(deadline),
            again: ([0; 4], 0),
        }
    }

    /// From now on a read fails when no byte comes for `limit`.
    pub(crate) fn wait_at_most(&mut self, limit: Duration) -> io::Result<()> {
        self.deadline = None;
        self.stream.set_read_timeout(Some(limit))
    }

    /// Has the next four bytes read again.
    pub(crate) fn put_back(&mut self, bytes: [u8; 4]) {
        self.again = (bytes, bytes.len());
    }

    pub(crate) fn try_clone(&self) -> io::Result<TcpStream> {
        self.stream.try_clone()
    }
}

impl Read for TimedStream {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let (bytes, left) = &mut self.again;
        if *left > 0 {
            let count = out.len().min(*left);
            let from = bytes.len() - *left;
            out[..count].copy_from_slice(&bytes[from..from + count]);
            *left -= count;
            return Ok(count);
        }
        if let Some(deadline) = self.deadline {
            let left = deadline.saturating_duration_since(Instant::now());
            if left < Duration::from_millis(1) {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.stream.set_read_timeout(Some(left))?;
        }
        self.stream.read(out)
    }
}

/// Opens a connection that this end made: `own` asks for `other`.
pub(crate) fn ask(
    mut stream: TimedStream,
    key: &PreSharedKey,
    own: &str,
    other: &str,
) -> Result<Secured, GreetingError> {
    let mut noise = builder(key)?.build_initiator().map_err(io::Error::other)?;
    let mut message = [0; MESSAGE_BYTES_MAX];
    let names = names(own, other)?;
    let length = noise
        .write_message(&names, &mut message)
        .map_err(io::Error::other)?;
    send(&stream.stream, FIRST, &message[..length])?;
    let mut head = [0; HEAD_BYTES];
    stream.read_exact(&mut head)?;
    let (kind, length) = parse(head)?;
    let body = &mut message[..length];
    stream.read_exact(body)?;
    match (kind, &*body) {
        (SECOND, body) => {
            let mut nothing = [0; MESSAGE_BYTES_MAX];
            let read = noise.read_message(body, &mut nothing);
            read.map_err(|_forged| invalid("the answer was not sealed with the key"))?;
            secure(stream, noise)
        }
        (REFUSAL, [code]) => {
            let why = Why::of(*code).ok_or_else(|| invalid("an unknown refusal"))?;
            Err(GreetingError::Refused(why))
        }
        _ => Err(invalid("no answer to a handshake").into()),
    }
}

/// Goes on with a connection that came and began with [`MAGIC`], which has been read. `is_awaited` is
/// told who came and whom they look for; what it says comes back with the connection, so that the other
/// end hears under the key that it is not awaited.
pub(crate) fn answer(
    mut stream: TimedStream,
    key: &PreSharedKey,
    is_awaited: impl FnOnce(&str, &str) -> bool,
) -> Result<(Secured, bool), GreetingError> {
    let mut noise = builder(key)?.build_responder().map_err(io::Error::other)?;
    let mut head = [0; HEAD_BYTES];
    head[..4].copy_from_slice(&MAGIC);
    stream.read_exact(&mut head[4..])?;
    let (kind, length) = parse(head)?;
    if kind != FIRST {
        return Err(invalid("a handshake that begins in its middle").into());
    }
    let mut message = [0; MESSAGE_BYTES_MAX];
    stream.read_exact(&mut message[..length])?;
    let mut names = [0; MESSAGE_BYTES_MAX];
    let Ok(names_bytes) = noise.read_message(&message[..length], &mut names) else {
        send(&stream.stream, REFUSAL, &[Why::AnotherKey.code()])?;
        return Err(GreetingError::Refused(Why::AnotherKey));
    };
    let said = split_names(&names[..names_bytes]);
    let is_awaited = said.is_some_and(|(theirs, ours)| is_awaited(theirs, ours));
    let length = noise
        .write_message(&[], &mut message)
        .map_err(io::Error::other)?;
    send(&stream.stream, SECOND, &message[..length])?;
    Ok((secure(stream, noise)?, is_awaited))
}

/// Turns a secured connection away where none is wanted; [`MAGIC`] has been read.
pub(crate) fn turn_away(stream: &TimedStream) -> io::Result<()> {
    send(&stream.stream, REFUSAL, &[Why::PlainHere.code()])
}

fn builder(key: &PreSharedKey) -> io::Result<Builder<'_>> {
    let pattern = PATTERN.parse().map_err(io::Error::other)?;
    Builder::new(pattern)
        .psk(0, key.expose())
        .and_then(|builder| builder.prologue(PROLOGUE))
        .map_err(io::Error::other)
}

fn secure(stream: TimedStream, noise: HandshakeState) -> Result<Secured, GreetingError> {
    let keys = noise.into_stateless_transport_mode();
    let keys = Arc::new(keys.map_err(io::Error::other)?);
    let writer = SecureWriter::new(stream.try_clone()?, Arc::clone(&keys));
    Ok(Secured {
        reader: SecureReader::new(stream, keys),
        writer,
    })
}

fn send(mut stream: &TcpStream, kind: u8, body: &[u8]) -> io::Result<()> {
    let length = u16::try_from(body.len()).expect("MESSAGE_BYTES_MAX fits 16 bits");
    let [low, high] = length.to_le_bytes();
    let [a, b, c, d] = MAGIC;
    let mut message = vec![a, b, c, d, VERSION, kind, low, high];
    message.extend_from_slice(body);
    stream.write_all(&message)
}

fn parse(head: [u8; HEAD_BYTES]) -> io::Result<(u8, usize)> {
    let [a, b, c, d, version, kind, low, high] = head;
    let length = usize::from(u16::from_le_bytes([low, high]));
    if [a, b, c, d] != MAGIC || version != VERSION || length > MESSAGE_BYTES_MAX {
        return Err(invalid("no handshake of this version"));
    }
    Ok((kind, length))
}

fn names(own: &str, other: &str) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    for name in [own, other] {
        let length = u8::try_from(name.len()).map_err(io::Error::other)?;
        bytes.push(length);
        bytes.extend_from_slice(name.as_bytes());
    }
    bytes.resize(bytes.len().max(NAMES_BYTES_MIN), 0);
    Ok(bytes)
}

fn split_names(bytes: &[u8]) -> Option<(&str, &str)> {
    let take = |bytes: &'_ [u8]| -> Option<usize> { bytes.first().copied().map(usize::from) };
    let first = take(bytes)?;
    let own = bytes.get(1..1 + first)?;
    let rest = bytes.get(1 + first..)?;
    let second = take(rest)?;
    let other = rest.get(1..1 + second)?;
    Some((
        core::str::from_utf8(own).ok()?,
        core::str::from_utf8(other).ok()?,
    ))
}

fn invalid(text: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, text)
}

#[cfg(test)]
#[path = "greeting_tests.rs"]
mod tests;
