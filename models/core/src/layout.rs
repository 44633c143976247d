//! The fields of a message as they lie in memory, for programs that do not know its type: a
//! recorder, a live page, an export. Nothing on the measured path reads this.
//!
//! [`message!`](crate::message!) makes a layout from the declaration of a type.

use serde::{Deserialize, Serialize};

/// Of what kind a field's elements are; all little-endian as on the machines we support. `Name` and
/// `Fields` are how a structure's own are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldKind<Name = &'static str, Fields = &'static [Field]> {
    /// Unsigned.
    U8,
    /// Unsigned.
    U16,
    /// Unsigned.
    U32,
    /// Unsigned.
    U64,
    /// Signed.
    I8,
    /// Signed.
    I16,
    /// Signed.
    I32,
    /// Signed.
    I64,
    /// IEEE 754.
    F32,
    /// IEEE 754.
    F64,
    /// A structure: its name and fields, offsets from its own start.
    Record {
        /// Name of the type.
        name: Name,
        /// Its fields.
        fields: Fields,
    },
}

impl<Name, Fields> FieldKind<Name, Fields> {
    /// The same kind with a structure's name and fields as `keep` keeps them.
    pub fn kept<N, F>(&self, keep: impl FnOnce(&Name, &Fields) -> (N, F)) -> FieldKind<N, F> {
        match self {
            Self::U8 => FieldKind::U8,
            Self::U16 => FieldKind::U16,
            Self::U32 => FieldKind::U32,
            Self::U64 => FieldKind::U64,
            Self::I8 => FieldKind::I8,
            Self::I16 => FieldKind::I16,
            Self::I32 => FieldKind::I32,
            Self::I64 => FieldKind::I64,
            Self::F32 => FieldKind::F32,
            Self::F64 => FieldKind::F64,
            Self::Record { name, fields } => {
                let (name, fields) = keep(name, fields);
                FieldKind::Record { name, fields }
            }
        }
    }
}

impl FieldKind {
    /// Size of one element, bytes.
    pub const fn size_bytes(&self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
            Self::Record { fields, .. } => end_bytes(fields),
        }
    }
}

/// Name of filler that means nothing; whoever shows or sends fields leaves it out.
pub const RESERVED: &str = "reserved";

/// One field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// Name, which ends in the unit.
    pub name: &'static str,
    /// Of what kind its elements are.
    pub kind: FieldKind,
    /// Number of elements; `None` for a single one, which is no array.
    pub count: Option<usize>,
    /// Of its first byte, from the start of the structure.
    pub offset_bytes: usize,
}

impl Field {
    /// The field `name` of `S` at `offset_bytes`, of the type that `get` returns: what
    /// [`message!`](crate::message!) calls.
    pub const fn of<S, V: FieldValue>(
        name: &'static str,
        offset_bytes: usize,
        _get: fn(&S) -> &V,
    ) -> Self {
        Self {
            name,
            kind: V::KIND,
            count: V::COUNT,
            offset_bytes,
        }
    }

    /// Size of all its elements, bytes.
    pub const fn size_bytes(&self) -> usize {
        match self.count {
            Some(count) => self.kind.size_bytes() * count,
            None => self.kind.size_bytes(),
        }
    }
}

/// Where the last field ends; fields are in order of their offsets.
const fn end_bytes(fields: &[Field]) -> usize {
    match fields {
        [.., last] => last.offset_bytes + last.size_bytes(),
        [] => 0,
    }
}

/// True when `fields` cover `size_bytes` from the first to the last without gap or overlap.
pub const fn covers(fields: &[Field], size_bytes: usize) -> bool {
    let (mut index, mut end) = (0, 0);
    while index < fields.len() {
        if fields[index].offset_bytes != end {
            return false;
        }
        end += fields[index].size_bytes();
        index += 1;
    }
    end == size_bytes
}

/// A type that may stand in a message.
pub trait FieldValue {
    /// Of its elements.
    const KIND: FieldKind;
    /// `None` for what is no array.
    const COUNT: Option<usize>;
}

macro_rules! numbers {
    ($($number:ty => $kind:ident),+ $(,)?) => {
        $(impl FieldValue for $number {
            const KIND: FieldKind = FieldKind::$kind;
            const COUNT: Option<usize> = None;
        })+
    };
}

numbers! {
    u8 => U8, u16 => U16, u32 => U32, u64 => U64,
    i8 => I8, i16 => I16, i32 => I32, i64 => I64,
    f32 => F32, f64 => F64,
}

impl<V: FieldValue, const N: usize> FieldValue for [V; N] {
    const KIND: FieldKind = V::KIND;
    const COUNT: Option<usize> = match V::COUNT {
        Some(inner) => Some(N * inner),
        None => Some(N),
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    crate::message! {
        struct Inner { a: u16, b: [u8; 6] }
    }

    crate::message! {
        struct Outer { pair: [Inner; 2], grid: [[f32; 2]; 3], at_ns: i64 }
    }

    #[test]
    fn arrays_of_arrays_are_flat_and_structures_keep_their_fields() {
        let [pair, grid, at] = Outer::LAYOUT else {
            panic!("three fields");
        };
        assert_eq!((pair.count, pair.kind.size_bytes()), (Some(2), 8));
        let FieldKind::Record { name, fields } = pair.kind else {
            panic!("a structure");
        };
        assert_eq!((name, fields.len()), ("Inner", 2));
        assert_eq!(
            (grid.count, grid.kind, grid.offset_bytes),
            (Some(6), FieldKind::F32, 16)
        );
        assert_eq!((at.count, at.offset_bytes), (None, 40));
    }

    #[test]
    fn a_gap_an_overlap_and_a_missing_end_are_noticed() {
        let [first, second, third] = [0, 1, 2].map(|index| Outer::LAYOUT[index]);
        assert!(covers(&[first, second, third], 48));
        assert!(!covers(&[first, second], 48));
        assert!(!covers(&[first, third], 24));
        assert!(!covers(&[second, first, third], 48));
        assert!(covers(&[], 0));
    }
}
