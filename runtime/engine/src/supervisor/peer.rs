//! One connected peer: another host's supervisor. How hosts find each other is in `meet.rs`, and how what they
//! say outlives a connection in `conversation.rs`.

use std::io::{self, BufReader, BufWriter, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use zeroize::Zeroizing;

use super::conversation::{Conversation, Cut};
use super::frame::{Frame, PeerHello, PeerMessage, write_message};
use super::reconnect::Reconnect;
use crate::security::greeting::{Secured, TimedStream};
use crate::security::{SecureReader, SecureWriter};

/// Something a peer said, or that it left.
#[derive(Debug)]
pub(crate) enum PeerEvent {
    /// A frame.
    Frame(Frame),
    /// The conversation ended, and why.
    Closed(String),
}

/// The receiving half of a connection.
#[derive(Debug)]
pub(super) enum ControlReader {
    Plain(BufReader<TimedStream>),
    Secured(Box<SecureReader>),
}

impl ControlReader {
    /// From now on a read fails when no byte comes for `limit`.
    pub(super) fn wait_at_most(&mut self, limit: Duration) -> io::Result<()> {
        match self {
            Self::Plain(reader) => reader.get_mut().wait_at_most(limit),
            Self::Secured(reader) => reader.wait_at_most(limit),
        }
    }
}

impl Read for ControlReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(reader) => reader.read(out),
            Self::Secured(reader) => reader.read(out),
        }
    }
}

/// The sending half of a connection.
#[derive(Debug)]
pub(super) enum ControlWriter {
    Plain(BufWriter<TcpStream>),
    Secured(SecureWriter),
}

impl ControlWriter {
    pub(super) fn stream(&self) -> &TcpStream {
        match self {
            Self::Plain(writer) => writer.get_ref(),
            Self::Secured(writer) => writer.stream(),
        }
    }
}

impl Write for ControlWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(writer) => writer.write(bytes),
            Self::Secured(writer) => writer.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(writer) => writer.flush(),
            Self::Secured(writer) => writer.flush(),
        }
    }
}

/// Both halves.
#[derive(Debug)]
pub(super) struct ControlHalves {
    pub(super) reader: ControlReader,
    pub(super) writer: ControlWriter,
}

impl ControlHalves {
    /// Of a connection that is not secured.
    pub(super) fn plain(stream: TimedStream) -> io::Result<Self> {
        let writer = BufWriter::new(stream.try_clone()?);
        Ok(Self {
            reader: ControlReader::Plain(BufReader::new(stream)),
            writer: ControlWriter::Plain(writer),
        })
    }
}

impl From<Secured> for ControlHalves {
    fn from(secured: Secured) -> Self {
        Self {
            reader: ControlReader::Secured(Box::new(secured.reader)),
            writer: ControlWriter::Secured(secured.writer),
        }
    }
}

/// The sending half: a flush ends a frame.
#[derive(Debug)]
struct PeerWriter {
    conversation: Arc<Conversation>,
    frame: Zeroizing<Vec<u8>>,
}

impl Write for PeerWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.frame.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.conversation.send(core::mem::take(&mut self.frame))
    }
}

/// One connected peer.
#[derive(Debug)]
pub(crate) struct Peer {
    /// What it said of itself.
    pub(crate) hello: PeerHello,
    writer: PeerWriter,
    heard: Instant,
    /// False once something could not be said to it.
    is_open: bool,
    /// It said that its components have stopped; what it says next belongs to the exchange of
    /// records and must not be read before.
    pub(crate) is_quiet: bool,
}

impl Peer {
    /// Listens to the connection, and to what `reconnect` finds after it, in threads of its own.
    pub(super) fn new(ends: ControlHalves, reconnect: Reconnect) -> io::Result<Self> {
        let hello = reconnect.theirs.clone();
        Ok(Self {
            hello,
            writer: PeerWriter {
                conversation: Conversation::begin(ends, reconnect)?,
                frame: Zeroizing::default(),
            },
            heard: Instant::now(),
            is_open: true,
            is_quiet: false,
        })
    }

    /// Says `message`; a peer that is gone is noticed by [`Peer::receive`].
    pub(crate) fn say(&mut self, message: &PeerMessage) {
        self.is_open = self.is_open && write_message(&mut self.writer, message).is_ok();
    }

    /// The next thing the peer said, waiting up to `timeout`.
    pub(crate) fn receive(&mut self, timeout: Duration) -> Option<PeerEvent> {
        let event = self.writer.conversation.receive(timeout)?;
        self.heard = Instant::now();
        Some(event)
    }

    /// How long nothing has been heard.
    pub(crate) fn silence(&self) -> Duration {
        self.heard.elapsed()
    }

    /// Times without a connection since the last call that are over.
    pub(super) fn take_cuts(&mut self) -> Vec<Cut> {
        self.writer.conversation.take_cuts()
    }

    /// Ends the conversation: whoever waits for it, here or there, notices at once.
    pub(crate) fn hang_up(&mut self) {
        self.is_open = false;
        self.writer.conversation.leave();
    }

    /// The conversation, to receive while what is sent is written to [`Peer::writer`].
    pub(super) fn conversation(&self) -> Arc<Conversation> {
        Arc::clone(&self.writer.conversation)
    }

    /// What frames are written to, so that a thread can send while another receives.
    pub(crate) fn writer(&mut self) -> &mut (impl Write + Send + use<>) {
        &mut self.writer
    }
}

impl Drop for Peer {
    /// Ends the conversation, so that the threads and the other end notice.
    fn drop(&mut self) {
        self.writer.conversation.leave_in_order();
    }
}
