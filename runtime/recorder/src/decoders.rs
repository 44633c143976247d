//! What the recorder reads that others sent or wrote, for tests from outside the crate: the head of
//! a request, a file, a message in one. The program itself calls the modules behind this one.

use hil_rundir::layout::LayoutFault;
use hil_rundir::manifest::FieldDescription;
use mcap::records::Record;

use crate::codec::Codec;
use crate::scan::{Limits, scan_from};
use crate::serve::judge_head;

/// What becomes of a connection by what it has sent so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// The head is not whole yet.
    Partial,
    /// It is refused, and why.
    Refused(String),
    /// It may pass, to the host that it names.
    Admitted {
        /// The field `Host`, with its port.
        host: String,
    },
}

/// Judges the head of a request as the socket of a machine called `machine` does that nobody else's
/// pages were allowed to; our own page is at `page_port`.
pub fn request(bytes: &[u8], machine: &str, page_port: u16) -> Request {
    match judge_head(bytes, machine, page_port) {
        None => Request::Partial,
        Some(Ok(host)) => Request::Admitted { host },
        Some(Err(refusal)) => Request::Refused(refusal.words()),
    }
}

/// What a file was found to hold.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recording {
    /// Records that are whole, and of these the messages.
    pub record_count: u64,
    /// Messages.
    pub message_count: u64,
    /// Bytes of these messages, without their heads.
    pub message_bytes: usize,
    /// What was lost: where it begins, and its size, bytes.
    pub losses: Vec<(u64, u64)>,
    /// The footer and what follows it are there.
    pub is_complete: bool,
}

/// Reads an MCAP file, whatever is damaged in it; `None` when it is none. No record may be larger
/// than `record_bytes_max`, compressed or not.
///
/// # Panics
/// Never: memory is read without an error.
pub fn recording(bytes: &[u8], record_bytes_max: usize) -> Option<Recording> {
    let limits = Limits {
        size_bytes: bytes.len() as u64,
        record_bytes_max,
    };
    let mut found = Recording::default();
    let end = scan_from(bytes, limits, &mut |_, record| {
        found.record_count += 1;
        if let Record::Message { data, .. } = &record {
            found.message_count += 1;
            found.message_bytes += data.len();
        }
        true
    });
    let end = end.expect("memory is read without an error")?;
    let losses = end.losses.iter();
    Some(Recording {
        losses: losses.map(|loss| (loss.offset, loss.size_bytes)).collect(),
        is_complete: end.is_complete,
        ..found
    })
}

/// How messages of one layout are written into a file, and read from it to be played.
#[derive(Debug)]
pub struct RecordedMessages(Codec);

impl RecordedMessages {
    /// For messages with these fields in memory.
    ///
    /// # Errors
    /// When they do not describe exactly `size_bytes`, or have no form in a file.
    pub fn new(fields: &[FieldDescription], size_bytes: usize) -> Result<Self, LayoutFault> {
        Ok(Self(Codec::typed("input.Message.v1", fields, size_bytes)?))
    }

    /// The message as it lies in memory that a file has as `data`.
    ///
    /// # Errors
    /// Why there is none, in words.
    pub fn read(&self, data: &[u8]) -> Result<Vec<u8>, String> {
        self.0.decode(data)
    }

    /// What a file has for `message`; `None` when it has another size than the layout.
    pub fn write(&self, message: &[u8]) -> Option<Vec<u8>> {
        let mut data = Vec::new();
        self.0.encode(message, &mut data).then_some(data)
    }
}
