//! The layout of a message as its run wrote it down: whether it can be right, and what its bytes
//! say by it. It knows no case study; layouts are stated in `hil_core::layout`.

use core::fmt::{self, Write as _};

use serde::{Serialize, Serializer};

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

const NEVER_FAILS: &str = "writing to a string cannot fail";

/// What a message, or a part of one, says.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// A number without sign.
    Unsigned(u64),
    /// A number with sign.
    Signed(i64),
    /// A number in four bytes.
    Single(f32),
    /// A number in eight bytes.
    Double(f64),
    /// An array.
    List(Vec<Value>),
    /// A structure: names and values in the order of its layout; what is reserved is left out.
    Record(Vec<(String, Value)>),
}

/// Names and values in order. A number that JSON has no word for is `"NaN"`, `"inf"` or `"-inf"`.
impl Serialize for Value {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Unsigned(value) => serializer.serialize_u64(*value),
            Self::Signed(value) => serializer.serialize_i64(*value),
            Self::Single(value) if value.is_finite() => serializer.serialize_f32(*value),
            Self::Double(value) if value.is_finite() => serializer.serialize_f64(*value),
            Self::Single(_) | Self::Double(_) => serializer.serialize_str(&self.to_string()),
            Self::List(values) => serializer.collect_seq(values),
            Self::Record(fields) => {
                serializer.collect_map(fields.iter().map(|(name, value)| (name, value)))
            }
        }
    }
}

/// On one line: numbers as they read back, arrays in brackets, structures in braces.
impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unsigned(value) => write!(f, "{value}"),
            Self::Signed(value) => write!(f, "{value}"),
            Self::Single(value) => write!(f, "{value}"),
            Self::Double(value) => write!(f, "{value}"),
            Self::List(values) => {
                f.write_char('[')?;
                for (index, value) in values.iter().enumerate() {
                    write!(f, "{}{value}", if index > 0 { ", " } else { "" })?;
                }
                f.write_char(']')
            }
            Self::Record(fields) => {
                f.write_char('{')?;
                for (index, (name, value)) in fields.iter().enumerate() {
                    write!(f, "{}{name}: {value}", if index > 0 { ", " } else { "" })?;
                }
                f.write_char('}')
            }
        }
    }
}

impl Value {
    /// One line per field, those of a structure two columns further in than its name.
    pub fn lines(&self) -> String {
        let mut text = String::new();
        self.write_lines(0, &mut text);
        text
    }

    fn write_lines(&self, indent: usize, text: &mut String) {
        let Self::Record(fields) = self else {
            writeln!(text, "{:indent$}{self}", "").expect(NEVER_FAILS);
            return;
        };
        for (name, value) in fields {
            match value {
                Self::Record(_) => {
                    writeln!(text, "{:indent$}{name}:", "").expect(NEVER_FAILS);
                    value.write_lines(indent + 2, text);
                }
                _ => writeln!(text, "{:indent$}{name}: {value}", "").expect(NEVER_FAILS),
            }
        }
    }
}

/// Why a field cannot be shown.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PathFault {
    /// There is none of that name.
    #[error("{within} has no field {name:?}; it has {known}")]
    NoField {
        /// The structure.
        within: String,
        /// The name asked for.
        name: String,
        /// Those it has.
        known: String,
    },
    /// A number is not a structure.
    #[error("{within} is a number and has no field {name:?}")]
    NoStructure {
        /// What it is.
        within: String,
        /// The name asked for.
        name: String,
    },
    /// An array has numbers for names.
    #[error("{within} has {count} elements, named 0 to {}; there is no {name:?}", count.saturating_sub(1))]
    NoElement {
        /// The array.
        within: String,
        /// The name asked for.
        name: String,
        /// How many it has.
        count: usize,
    },
}

/// A part of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    kind: KindDescription,
    count: Option<usize>,
    offset_bytes: usize,
}

/// Reads the messages of one channel.
#[derive(Debug, Clone)]
pub struct Decoder {
    message: String,
    fields: Vec<FieldDescription>,
    size_bytes: usize,
}

impl Decoder {
    /// For messages called `message` with this layout.
    ///
    /// # Errors
    /// When the layout does not describe exactly `size_bytes`.
    pub fn new(
        message: &str,
        fields: &[FieldDescription],
        size_bytes: usize,
    ) -> Result<Self, LayoutFault> {
        check(fields, size_bytes)?;
        Ok(Self {
            message: message.to_owned(),
            fields: fields.to_vec(),
            size_bytes,
        })
    }

    /// What `bytes` say; `None` when they are not as many as a message has.
    pub fn decode(&self, bytes: &[u8]) -> Option<Value> {
        (bytes.len() == self.size_bytes).then(|| record(&self.fields, bytes))
    }

    /// The field that `path` names: `flags`, `tool.position_m`, `tool.position_m.2`.
    ///
    /// # Errors
    /// When there is no such field, with those there are.
    pub fn select(&self, path: &str) -> Result<Selection, PathFault> {
        let mut here = Selection {
            kind: KindDescription::Record {
                name: self.message.clone(),
                fields: self.fields.clone(),
            },
            count: None,
            offset_bytes: 0,
        };
        let mut within = self.message.clone();
        for name in path.split('.') {
            here = here.part(name, &within)?;
            name.clone_into(&mut within);
        }
        Ok(here)
    }

    /// What the selected part of `bytes` says; `None` as of [`Self::decode`].
    pub fn decode_part(&self, part: &Selection, bytes: &[u8]) -> Option<Value> {
        let is_whole = bytes.len() == self.size_bytes;
        is_whole.then(|| elements(&part.kind, part.count, &bytes[part.offset_bytes..]))
    }
}

impl Selection {
    fn part(&self, name: &str, within: &str) -> Result<Self, PathFault> {
        if let Some(count) = self.count {
            let index = name.parse().ok().filter(|index| *index < count);
            let index: usize = index.ok_or_else(|| PathFault::NoElement {
                within: within.to_owned(),
                name: name.to_owned(),
                count,
            })?;
            return Ok(Self {
                kind: self.kind.clone(),
                count: None,
                offset_bytes: self.offset_bytes + index * checked_element_bytes(&self.kind),
            });
        }
        let KindDescription::Record { fields, .. } = &self.kind else {
            return Err(PathFault::NoStructure {
                within: within.to_owned(),
                name: name.to_owned(),
            });
        };
        let mut known = fields.iter().filter(|field| !field.is_reserved());
        let Some(field) = known.clone().find(|field| field.name == name) else {
            let known: Vec<&str> = known.by_ref().map(|field| field.name.as_str()).collect();
            return Err(PathFault::NoField {
                within: within.to_owned(),
                name: name.to_owned(),
                known: known.join(", "),
            });
        };
        Ok(Self {
            kind: field.kind.clone(),
            count: field.count,
            offset_bytes: self.offset_bytes + field.offset_bytes,
        })
    }
}

fn record(fields: &[FieldDescription], bytes: &[u8]) -> Value {
    let told = fields.iter().filter(|field| !field.is_reserved());
    let values = told.map(|field| {
        let value = elements(&field.kind, field.count, &bytes[field.offset_bytes..]);
        (field.name.clone(), value)
    });
    Value::Record(values.collect())
}

/// What is at the beginning of `bytes`.
fn elements(kind: &KindDescription, count: Option<usize>, bytes: &[u8]) -> Value {
    let size = checked_element_bytes(kind);
    match count {
        None => element(kind, &bytes[..size]),
        Some(count) => {
            let each = bytes[..size * count].chunks_exact(size);
            Value::List(each.map(|bytes| element(kind, bytes)).collect())
        }
    }
}

/// `bytes` are as many as one element has.
fn element(kind: &KindDescription, bytes: &[u8]) -> Value {
    if let KindDescription::Record { fields, .. } = kind {
        return record(fields, bytes);
    }
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    let unsigned = u64::from_le_bytes(wide);
    let [a, b, c, d, ..] = wide;
    // Brings the sign of a narrower number to the width of 64 bits.
    let unused_bits = 64 - 8 * bytes.len();
    match kind {
        KindDescription::F32 => Value::Single(f32::from_le_bytes([a, b, c, d])),
        KindDescription::F64 => Value::Double(f64::from_le_bytes(wide)),
        KindDescription::I8
        | KindDescription::I16
        | KindDescription::I32
        | KindDescription::I64 => {
            Value::Signed((unsigned << unused_bits).cast_signed() >> unused_bits)
        }
        _ => Value::Unsigned(unsigned),
    }
}

/// `bytes` as two digits each, for messages whose layout nobody stated.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect(NEVER_FAILS);
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use hil_arm::egm::messages::EgmFeedback;
    use hil_core::message::Message;
    use hil_fleet::messages::State;

    use crate::manifest::describe_fields;

    fn decoder<M: Message>() -> Decoder {
        let fields = describe_fields(M::FIELDS);
        Decoder::new(M::NAME, &fields, size_of::<M>()).unwrap()
    }

    #[test]
    fn every_kind_of_number_reads_as_what_was_written() {
        let mut feedback = EgmFeedback::zeroed();
        feedback.cycle_index = u64::MAX;
        feedback.reference_age_ns = -7;
        feedback.measured_rad[2] = f64::NAN;
        feedback.tool.position_m = [0.25, -0.5, 1e-9];
        feedback.flags = 0x8000_0001;
        let decoder = decoder::<EgmFeedback>();
        let bytes = bytemuck::bytes_of(&feedback);
        let value = decoder.decode(bytes).unwrap();
        let json = serde_json::to_string(&value).unwrap();
        assert!(
            json.starts_with("{\"cycle_index\":18446744073709551615,"),
            "{json}"
        );
        for part in [
            "\"reference_age_ns\":-7",
            "\"measured_rad\":[0.0,0.0,\"NaN\",0.0,",
            "\"tool\":{\"position_m\":[0.25,-0.5,1e-9],",
            "\"flags\":2147483649",
        ] {
            assert!(json.contains(part), "no {part} in {json}");
        }
        let lines = value.lines();
        assert!(
            lines.contains("\ntool:\n  position_m: [0.25, -0.5, 0.000000001]\n"),
            "{lines}"
        );
        assert_eq!(decoder.decode(&bytes[1..]), None);
    }

    #[test]
    fn signs_of_narrow_numbers_are_kept() {
        for (kind, bytes, expected) in [
            (KindDescription::I8, &[0xff][..], Value::Signed(-1)),
            (KindDescription::I16, &[0xfe, 0xff], Value::Signed(-2)),
            (KindDescription::I32, &[1, 0, 0, 0], Value::Signed(1)),
            (KindDescription::U16, &[0xff, 0xff], Value::Unsigned(65_535)),
            (
                KindDescription::F32,
                &[0, 0, 0xc0, 0x3f],
                Value::Single(1.5),
            ),
        ] {
            assert_eq!(element(&kind, bytes), expected, "{kind:?}");
        }
    }

    #[test]
    fn a_field_is_named_by_its_path_and_a_wrong_one_is_told_what_there_is() {
        let mut feedback = EgmFeedback::zeroed();
        feedback.tool.position_m = [0.25, -0.5, 3.0];
        let decoder = decoder::<EgmFeedback>();
        let at = |path: &str| {
            let part = decoder.select(path).map_err(|fault| fault.to_string())?;
            Ok(decoder
                .decode_part(&part, bytemuck::bytes_of(&feedback))
                .unwrap()
                .to_string())
        };
        let wrong = |text: &str| Err::<String, _>(text.to_owned());
        assert_eq!(at("tool.position_m.2"), Ok("3".to_owned()));
        assert_eq!(at("tool.position_m"), Ok("[0.25, -0.5, 3]".to_owned()));
        assert_eq!(
            at("tool.speed"),
            wrong("tool has no field \"speed\"; it has position_m, quaternion_wxyz")
        );
        assert_eq!(
            at("tool.position_m.3"),
            wrong("position_m has 3 elements, named 0 to 2; there is no \"3\"")
        );
        assert_eq!(
            at("flags.x"),
            wrong("flags is a number and has no field \"x\"")
        );
    }

    #[test]
    fn what_is_reserved_is_left_out() {
        let value = decoder::<State>().decode(&[0; size_of::<State>()]).unwrap();
        assert!(!value.to_string().contains("reserved"));
        assert!(decoder::<State>().select("reserved").is_err());
    }

    #[test]
    fn a_layout_that_does_not_cover_its_message_is_refused() {
        let fields = describe_fields(EgmFeedback::FIELDS);
        let fault = Decoder::new("a.B.v1", &fields, 217).unwrap_err();
        assert_eq!(
            fault.to_string(),
            "its fields end at byte 216, and it has 217 bytes"
        );
        assert!(Decoder::new("a.B.v1", &[], 8).is_err());
    }

    #[test]
    fn bytes_are_two_digits_each() {
        assert_eq!(hex(&[0, 15, 255]), "000fff");
    }
}
