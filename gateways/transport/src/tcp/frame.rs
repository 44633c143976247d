//! How datagrams lie in a byte stream, and finding them again. It reads no socket: bytes come in
//! whatever portions the caller has.
//!
//! | bytes | meaning |
//! |---|---|
//! | 0..4 | length of the datagram in bytes, unsigned 32-bit, little-endian, at most [`DATAGRAM_BYTES_MAX`] |
//! | 4..4 + length | the datagram, as [`hil_protocol::wire`] lays it out |
//!
//! Frames follow each other without a gap. A length above the maximum means that the reader has
//! lost the beat, or that the other end speaks something else: nothing after it can be trusted.

use thiserror::Error;

/// Bytes before each datagram.
pub const PREFIX_BYTES: usize = 4;
/// Longest datagram: what a gateway's receiving buffer takes.
pub const DATAGRAM_BYTES_MAX: usize = 65_535;
/// The longest frame.
pub(super) const FRAME_BYTES_MAX: usize = PREFIX_BYTES + DATAGRAM_BYTES_MAX;

/// A stream stated a length that no frame has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a frame of {length_bytes} bytes is above {DATAGRAM_BYTES_MAX}")]
pub struct BadLength {
    /// The length it stated.
    pub length_bytes: u32,
}

/// What goes before a datagram; `None` when it is longer than a frame can be.
///
/// ```
/// use hil_transport::tcp::frame::prefix;
///
/// assert_eq!(prefix(64), Some([64, 0, 0, 0]));
/// assert_eq!(prefix(65_536), None);
/// ```
pub fn prefix(datagram_bytes: usize) -> Option<[u8; PREFIX_BYTES]> {
    let length_bytes = u32::try_from(datagram_bytes).ok()?;
    (datagram_bytes <= DATAGRAM_BYTES_MAX).then(|| length_bytes.to_le_bytes())
}

/// Collects portions of a stream until they are frames. Its memory is set aside at the start.
#[derive(Debug)]
pub struct FrameReader {
    /// Two of the longest frames: what is left of one never keeps the next out.
    buffer: Box<[u8]>,
    start: usize,
    end: usize,
}

impl Default for FrameReader {
    fn default() -> Self {
        Self {
            buffer: vec![0; 2 * FRAME_BYTES_MAX].into_boxed_slice(),
            start: 0,
            end: 0,
        }
    }
}

impl FrameReader {
    /// Where the next portion goes; never empty once [`FrameReader::next_datagram`] gave `None`.
    pub fn room(&mut self) -> &mut [u8] {
        if self.start == self.end {
            self.clear();
        } else if self.start > FRAME_BYTES_MAX {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            self.start = 0;
        }
        &mut self.buffer[self.end..]
    }

    /// Says that `count` bytes were written to the beginning of [`FrameReader::room`].
    ///
    /// # Panics
    /// When there was no room for as many.
    pub fn filled(&mut self, count: usize) {
        assert!(
            count <= self.buffer.len() - self.end,
            "no more bytes than there was room for"
        );
        self.end += count;
    }

    /// The next whole datagram; `None` when more of the stream is needed.
    ///
    /// # Errors
    /// [`BadLength`] for good: the reader has to be cleared and the stream closed.
    pub fn next_datagram(&mut self) -> Result<Option<&[u8]>, BadLength> {
        let waiting = &self.buffer[self.start..self.end];
        let Some((prefix, rest)) = waiting.split_first_chunk::<PREFIX_BYTES>() else {
            return Ok(None);
        };
        let length_bytes = u32::from_le_bytes(*prefix);
        let length = usize::try_from(length_bytes)
            .ok()
            .filter(|length| *length <= DATAGRAM_BYTES_MAX)
            .ok_or(BadLength { length_bytes })?;
        if rest.len() < length {
            return Ok(None);
        }
        let begin = self.start + PREFIX_BYTES;
        self.start = begin + length;
        Ok(Some(&self.buffer[begin..begin + length]))
    }

    /// Bytes of a frame that is not whole yet.
    pub fn waiting_bytes(&self) -> usize {
        self.end - self.start
    }

    /// Forgets everything, for a new stream.
    pub fn clear(&mut self) {
        self.start = 0;
        self.end = 0;
    }
}

/// Bytes of whole frames that the kernel has not taken yet, and the rest of one of which it took
/// the beginning: a bounded queue in memory set aside at the start.
#[derive(Debug)]
pub(super) struct Backlog {
    buffer: Box<[u8]>,
    start: usize,
    end: usize,
}

impl Backlog {
    /// Room for `capacity_bytes`, at least one of the longest frames.
    pub(super) fn new(capacity_bytes: usize) -> Self {
        Self {
            buffer: vec![0; capacity_bytes.max(FRAME_BYTES_MAX)].into_boxed_slice(),
            start: 0,
            end: 0,
        }
    }

    pub(super) const fn len_bytes(&self) -> usize {
        self.end - self.start
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.start == self.end
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.buffer[self.start..self.end]
    }

    /// Adds all parts, or nothing when there is no room for all; says whether there was.
    pub(super) fn push(&mut self, parts: [&[u8]; 3]) -> bool {
        let added = parts.iter().map(|part| part.len()).sum::<usize>();
        if self.len_bytes() + added > self.buffer.len() {
            return false;
        }
        if self.end + added > self.buffer.len() {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            self.start = 0;
        }
        for part in parts {
            self.buffer[self.end..self.end + part.len()].copy_from_slice(part);
            self.end += part.len();
        }
        true
    }

    /// The kernel took the first `count` bytes.
    pub(super) fn consume(&mut self, count: usize) {
        self.start = (self.start + count).min(self.end);
        if self.start == self.end {
            self.clear();
        }
    }

    pub(super) fn clear(&mut self) {
        self.start = 0;
        self.end = 0;
    }
}
