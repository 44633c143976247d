//! The supervisors' connection once both ends have proven the key: records of a length and bytes sealed
//! by the handshake's keys. Who may get this far is decided in `greeting.rs`.

use core::fmt;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use snow::StatelessTransportState;
use zeroize::Zeroizing;

use super::greeting::TimedStream;

/// Plain bytes of one record at most.
const PLAIN_BYTES_MAX: usize = 16_384;
const TAG_BYTES: usize = 16;
const SEALED_BYTES_MAX: usize = PLAIN_BYTES_MAX + TAG_BYTES;

/// Seals what is written.
pub(crate) struct SecureWriter {
    stream: TcpStream,
    keys: Arc<StatelessTransportState>,
    number: u64,
    plain: Zeroizing<Vec<u8>>,
}

impl SecureWriter {
    pub(super) fn new(stream: TcpStream, keys: Arc<StatelessTransportState>) -> Self {
        Self {
            stream,
            keys,
            number: 0,
            plain: Zeroizing::new(Vec::with_capacity(PLAIN_BYTES_MAX)),
        }
    }

    /// The connection, for its time-outs and its end.
    pub(crate) fn stream(&self) -> &TcpStream {
        &self.stream
    }

    fn send_record(&mut self) -> io::Result<()> {
        if self.plain.is_empty() {
            return Ok(());
        }
        let mut record = vec![0; 2 + self.plain.len() + TAG_BYTES];
        let sealed = self
            .keys
            .write_message(self.number, &self.plain, &mut record[2..])
            .map_err(io::Error::other)?;
        let length = u16::try_from(sealed).expect("SEALED_BYTES_MAX fits 16 bits");
        record[..2].copy_from_slice(&length.to_le_bytes());
        self.number += 1;
        self.plain.clear();
        self.stream.write_all(&record)
    }
}

impl Write for SecureWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.plain.len() == PLAIN_BYTES_MAX {
            self.send_record()?;
        }
        let room = PLAIN_BYTES_MAX - self.plain.len();
        let taken = &bytes[..bytes.len().min(room)];
        self.plain.extend_from_slice(taken);
        Ok(taken.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.send_record()?;
        self.stream.flush()
    }
}

impl fmt::Debug for SecureWriter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SecureWriter")
            .field("stream", &self.stream)
            .field("number", &self.number)
            .finish_non_exhaustive()
    }
}

/// Opens what is read.
pub(crate) struct SecureReader {
    stream: TimedStream,
    keys: Arc<StatelessTransportState>,
    number: u64,
    sealed: Box<[u8]>,
    plain: Zeroizing<Vec<u8>>,
    /// Up to here `plain` has been handed out.
    taken: usize,
    length: usize,
}

impl SecureReader {
    pub(super) fn new(stream: TimedStream, keys: Arc<StatelessTransportState>) -> Self {
        Self {
            stream,
            keys,
            number: 0,
            sealed: vec![0; SEALED_BYTES_MAX].into_boxed_slice(),
            plain: Zeroizing::new(vec![0; SEALED_BYTES_MAX]),
            taken: 0,
            length: 0,
        }
    }

    /// As that of [`TimedStream`].
    pub(crate) fn wait_at_most(&mut self, limit: Duration) -> io::Result<()> {
        self.stream.wait_at_most(limit)
    }

    /// Reads the next record; false at the end of the connection.
    fn next_record(&mut self) -> io::Result<bool> {
        let mut length = [0; 2];
        if self.stream.read(&mut length[..1])? == 0 {
            return Ok(false);
        }
        self.stream.read_exact(&mut length[1..])?;
        let length = usize::from(u16::from_le_bytes(length));
        let invalid = |text: &str| io::Error::new(io::ErrorKind::InvalidData, text);
        if !(TAG_BYTES..=SEALED_BYTES_MAX).contains(&length) {
            return Err(invalid("a record of impossible length"));
        }
        let sealed = &mut self.sealed[..length];
        self.stream.read_exact(sealed)?;
        self.length = self
            .keys
            .read_message(self.number, sealed, &mut self.plain)
            .map_err(|_forged| invalid("a record that the other end did not seal"))?;
        self.number += 1;
        self.taken = 0;
        Ok(true)
    }
}

impl Read for SecureReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while self.taken == self.length {
            if !self.next_record()? {
                return Ok(0);
            }
        }
        let count = out.len().min(self.length - self.taken);
        out[..count].copy_from_slice(&self.plain[self.taken..self.taken + count]);
        self.taken += count;
        Ok(count)
    }
}

impl fmt::Debug for SecureReader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SecureReader")
            .field("number", &self.number)
            .finish_non_exhaustive()
    }
}
