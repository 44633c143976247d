//! What can be wrong with a trace, and where it is wrong. It reads nothing.

use super::wire::{HEADER_BYTES, RECORD_BYTES, RECORD_COUNT_MAX, VERSION};

/// Why a trace cannot be written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// A name does not fit.
    #[error("the name of the {what} has {length} bytes, at most {limit}")]
    NameTooLong {
        /// Which name.
        what: &'static str,
        /// Its length.
        length: usize,
        /// Bytes there are for it.
        limit: usize,
    },
    /// A name has a zero in it, where it would end.
    #[error("the name of the {what} has a NUL in it, where its file would end it")]
    NameWithNul {
        /// Which name.
        what: &'static str,
    },
    /// The fields of a record say together what nobody can read.
    #[error("record {index}: {what}")]
    Record {
        /// Its place, from 0.
        index: u32,
        /// What is wrong.
        what: FaultKind,
    },
    /// A record was published before its predecessor.
    #[error("record {index} was published before the one before it")]
    OutOfOrder {
        /// Its place, from 0.
        index: usize,
    },
    /// There are too many.
    #[error("{count} records, at most {RECORD_COUNT_MAX}")]
    TooMany {
        /// How many.
        count: usize,
    },
}

/// What is wrong with the bytes of a trace, and where. What stands before is whole.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("byte {offset}: {what}")]
pub struct TraceFault {
    /// Offset in the file.
    pub offset: u64,
    /// What is wrong there.
    pub what: FaultKind,
}

/// A kind of damage.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FaultKind {
    /// Not a trace.
    #[error("not a trace: it begins with {found:02x?}, not with \"HILTRACE\"")]
    Foreign {
        /// What it begins with.
        found: Vec<u8>,
    },
    /// Another version of the format.
    #[error("version {found} of the format, this program reads {VERSION}")]
    Version {
        /// The version.
        found: u32,
    },
    /// The sizes in the header are not those of this version.
    #[error(
        "header of {header} bytes and records of {record}, expected {HEADER_BYTES} and {RECORD_BYTES}"
    )]
    Sizes {
        /// Bytes of the header.
        header: u32,
        /// Bytes of a record.
        record: u32,
    },
    /// The check sum does not fit.
    #[error("the check sum of the {part} is {found:08x}, its bytes have {computed:08x}")]
    CheckSum {
        /// Header or record.
        part: &'static str,
        /// What the file says.
        found: u32,
        /// What its bytes give.
        computed: u32,
    },
    /// A field holds what it may not.
    #[error("{field} is {value}, allowed are {allowed}")]
    Field {
        /// Its name.
        field: &'static str,
        /// Its value.
        value: u64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A name is no text.
    #[error("the name of the {what} is not UTF-8")]
    Text {
        /// Which name.
        what: &'static str,
    },
    /// A record stands where another should.
    #[error("record {found} where record {expected} should be")]
    Place {
        /// The number it has.
        found: u32,
        /// The number its place has.
        expected: u32,
    },
    /// A record is earlier than the one before.
    #[error("published at {published_ns} ns, before the record before it at {before_ns} ns")]
    Order {
        /// Its instant.
        published_ns: i64,
        /// The one before.
        before_ns: i64,
    },
    /// The bytes end too early.
    #[error("ends after {found} of {expected} {unit}")]
    Truncated {
        /// What is there.
        found: u64,
        /// What should be.
        expected: u64,
        /// Bytes of the header, or records.
        unit: &'static str,
    },
    /// The bytes go on after the last record.
    #[error("{count} bytes after the last record")]
    Trailing {
        /// How many.
        count: u64,
    },
}
