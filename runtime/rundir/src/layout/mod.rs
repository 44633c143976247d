//! The layout of a message as its run wrote it down: whether it can be right, and what its bytes
//! say by it. It knows no case study; layouts are stated in `hil_core::layout`.

mod value;

pub use value::{Decoder, PathFault, Selection, Value, hex};

use crate::manifest::{FieldDescription, KindDescription};

/// Deepest nesting of structures: no message of ours has more than two.
const DEPTH_MAX: usize = 8;
/// Largest message: a bound on what a damaged manifest may ask for.
const MESSAGE_BYTES_MAX: usize = 1 << 26;
/// Most fields of one structure: the highest number below the range that protobuf keeps for itself.
const FIELD_COUNT_MAX: usize = 18_999;

/// Why a layout cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutFault {
    /// Nobody stated the fields.
    #[error("its fields are not known")]
    Unknown,
    /// The fields do not cover the message.
    #[error("field {field} begins at byte {found}, where the one before it ends at {expected}")]
    Gap {
        /// Which.
        field: String,
        /// Where it begins.
        found: usize,
        /// Where it should.
        expected: usize,
    },
    /// The fields end elsewhere than the message.
    #[error("its fields end at byte {found}, and it has {expected} bytes")]
    End {
        /// Where they end.
        found: usize,
        /// Size of the message.
        expected: usize,
    },
    /// Nested too deeply, too long, or too many fields.
    #[error("it is nested more than {DEPTH_MAX} deep, or too large")]
    TooLarge,
}

/// Checks that `fields` describe exactly `size_bytes`.
///
/// # Errors
/// When they do not.
pub fn check(fields: &[FieldDescription], size_bytes: usize) -> Result<(), LayoutFault> {
    if fields.is_empty() {
        return Err(LayoutFault::Unknown);
    }
    let end = end_bytes(fields, 0)?;
    if end != size_bytes {
        return Err(LayoutFault::End {
            found: end,
            expected: size_bytes,
        });
    }
    Ok(())
}

/// Size of one element of a checked layout, bytes.
pub fn checked_element_bytes(kind: &KindDescription) -> usize {
    element_bytes(kind, 0).unwrap_or(0)
}

/// Size of one element, bytes.
fn element_bytes(kind: &KindDescription, depth: usize) -> Result<usize, LayoutFault> {
    Ok(match kind {
        KindDescription::U8 | KindDescription::I8 => 1,
        KindDescription::U16 | KindDescription::I16 => 2,
        KindDescription::U32 | KindDescription::I32 | KindDescription::F32 => 4,
        KindDescription::U64 | KindDescription::I64 | KindDescription::F64 => 8,
        // A structure without fields could be there any number of times in no bytes at all.
        KindDescription::Record { fields, .. } if fields.is_empty() => {
            return Err(LayoutFault::Unknown);
        }
        KindDescription::Record { fields, .. } => end_bytes(fields, depth + 1)?,
    })
}

/// Where the last of `fields` ends, when they follow each other without gap.
fn end_bytes(fields: &[FieldDescription], depth: usize) -> Result<usize, LayoutFault> {
    if depth > DEPTH_MAX || fields.len() > FIELD_COUNT_MAX {
        return Err(LayoutFault::TooLarge);
    }
    let mut end = 0_usize;
    for field in fields {
        if field.offset_bytes != end {
            return Err(LayoutFault::Gap {
                field: field.name.clone(),
                found: field.offset_bytes,
                expected: end,
            });
        }
        let element = element_bytes(&field.kind, depth)?;
        let size = element.checked_mul(field.count.unwrap_or(1));
        end = size
            .and_then(|size| end.checked_add(size))
            .filter(|end| *end <= MESSAGE_BYTES_MAX)
            .ok_or(LayoutFault::TooLarge)?;
    }
    Ok(end)
}
