//! Recording: fixed-size records go through a bounded ring to a file, off the measured path.
//! What the records mean is in `hil_core::record`; nothing here computes a figure.

pub mod file;
mod growing;
pub mod ring;
pub mod stored;

pub use file::{RecordFile, RecordFileError, RecordKind};
pub use growing::GROWING_FILE_BYTES;
pub use ring::{RecordSink, Recorder, SharedSink};
