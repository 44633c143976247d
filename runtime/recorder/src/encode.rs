//! Messages as they lie in memory, written as protobuf by their layout. Schemas are made in
//! [`crate::schema`]; the two agree because both number fields by position.

use hil_rundir::layout::{LayoutFault, checked_element_bytes};
use hil_rundir::manifest::{FieldDescription, KindDescription};
use prost::encoding::{WireType, encode_key, encode_varint};

use crate::schema::{self, Schema};

/// How the messages of one channel are written.
#[derive(Debug)]
pub(crate) enum Encoder {
    /// Field by field.
    Typed {
        /// The checked layout.
        fields: Vec<FieldDescription>,
        /// Size of a message.
        size_bytes: usize,
    },
    /// As the bytes they are.
    Opaque,
}

impl Encoder {
    /// The way of writing messages with this layout, and their schema.
    ///
    /// # Errors
    /// When the layout does not describe exactly `size_bytes`.
    pub(crate) fn typed(
        message: &str,
        fields: &[FieldDescription],
        size_bytes: usize,
    ) -> Result<(Self, Schema), LayoutFault> {
        let schema = schema::of_layout(message, fields, size_bytes)?;
        let fields = fields.to_vec();
        Ok((Self::Typed { fields, size_bytes }, schema))
    }

    /// Appends `message` to `out`; false, with nothing appended, when it has another size.
    pub(crate) fn encode(&self, message: &[u8], out: &mut Vec<u8>) -> bool {
        match self {
            Self::Typed { fields, size_bytes } => {
                if message.len() != *size_bytes {
                    return false;
                }
                encode_record(fields, message, out);
            }
            Self::Opaque => write_bytes(1, message, out),
        }
        true
    }
}

/// `message` has at least the bytes that `fields` describe.
fn encode_record(fields: &[FieldDescription], message: &[u8], out: &mut Vec<u8>) {
    for (field, number) in fields.iter().zip(1..) {
        if field.is_reserved() {
            continue;
        }
        let element = checked_element_bytes(&field.kind);
        let count = field.count.unwrap_or(1);
        let bytes = &message[field.offset_bytes..field.offset_bytes + element * count];
        if let KindDescription::Record { fields, .. } = &field.kind {
            for one in bytes.chunks_exact(element) {
                let mut inner = Vec::new();
                encode_record(fields, one, &mut inner);
                write_bytes(number, &inner, out);
            }
        } else if field.count.is_some() {
            let mut packed = Vec::with_capacity(bytes.len());
            for value in bytes.chunks_exact(element) {
                write_value(&field.kind, value, &mut packed);
            }
            write_bytes(number, &packed, out);
        } else {
            encode_key(number, wire_type(&field.kind), out);
            write_value(&field.kind, bytes, out);
        }
    }
}

fn write_bytes(number: u32, bytes: &[u8], out: &mut Vec<u8>) {
    encode_key(number, WireType::LengthDelimited, out);
    encode_varint(bytes.len() as u64, out);
    out.extend_from_slice(bytes);
}

fn wire_type(kind: &KindDescription) -> WireType {
    match kind {
        KindDescription::F32 => WireType::ThirtyTwoBit,
        KindDescription::F64 => WireType::SixtyFourBit,
        KindDescription::Record { .. } => WireType::LengthDelimited,
        _ => WireType::Varint,
    }
}

/// One number; `bytes` are as many as its kind has.
fn write_value(kind: &KindDescription, bytes: &[u8], out: &mut Vec<u8>) {
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    let unsigned = u64::from_le_bytes(wide);
    // Brings the sign of a narrower number to the width of 64 bits.
    let unused_bits = 64 - 8 * bytes.len();
    let signed = (unsigned << unused_bits).cast_signed() >> unused_bits;
    match kind {
        KindDescription::F32 | KindDescription::F64 => out.extend_from_slice(bytes),
        KindDescription::I8
        | KindDescription::I16
        | KindDescription::I32
        | KindDescription::I64 => encode_varint(zigzag(signed), out),
        _ => encode_varint(unsigned, out),
    }
}

/// Small magnitudes to small numbers, as `sint32` and `sint64` want it.
const fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)).cast_unsigned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use hil_arm::egm::messages::{EgmArrival, EgmFeedback};
    use hil_core::message::Message;
    use hil_rundir::manifest::describe_fields;
    use prost::Message as _;

    #[derive(prost::Message)]
    struct PoseProto {
        #[prost(double, repeated, tag = "1")]
        position_m: Vec<f64>,
        #[prost(double, repeated, tag = "2")]
        quaternion_wxyz: Vec<f64>,
    }

    #[derive(prost::Message)]
    struct FeedbackProto {
        #[prost(uint64, tag = "1")]
        cycle_index: u64,
        #[prost(sint64, tag = "3")]
        reference_age_ns: i64,
        #[prost(double, repeated, tag = "4")]
        measured_rad: Vec<f64>,
        #[prost(message, tag = "6")]
        tool: Option<PoseProto>,
        #[prost(uint32, tag = "12")]
        flags: u32,
    }

    fn encoder<M: Message>() -> Encoder {
        let fields = describe_fields(M::FIELDS);
        Encoder::typed(M::NAME, &fields, size_of::<M>()).unwrap().0
    }

    #[test]
    fn another_implementation_reads_every_value_back() {
        let mut feedback = EgmFeedback::zeroed();
        feedback.cycle_index = u64::MAX;
        feedback.reference_age_ns = -7;
        feedback.measured_rad = [0.1, -0.2, 0.3, f64::NAN, f64::INFINITY, -0.0, 1e300];
        feedback.tool.quaternion_wxyz = [1.0, 2.0, 3.0, 4.0];
        feedback.flags = 0x8000_0001;
        let mut out = Vec::new();
        assert!(encoder::<EgmFeedback>().encode(bytemuck::bytes_of(&feedback), &mut out));
        let back = FeedbackProto::decode(out.as_slice()).unwrap();
        assert_eq!((back.cycle_index, back.reference_age_ns), (u64::MAX, -7));
        let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&back.measured_rad), bits(&feedback.measured_rad));
        assert_eq!(back.tool.unwrap().quaternion_wxyz, [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(back.flags, 0x8000_0001);
    }

    #[test]
    fn a_message_of_another_size_is_refused() {
        let mut out = Vec::new();
        let encoder = encoder::<EgmArrival>();
        assert!(!encoder.encode(&[0; 159], &mut out) && out.is_empty());
        assert!(encoder.encode(&[0; 160], &mut out));
        assert!(Encoder::Opaque.encode(&[], &mut out));
    }

    #[test]
    fn signs_of_narrow_numbers_are_kept() {
        for (kind, bytes, expected) in [
            (KindDescription::I8, &[0xff_u8][..], 1_u64),
            (KindDescription::I16, &[0xfe, 0xff], 3),
            (KindDescription::I32, &[1, 0, 0, 0], 2),
            (KindDescription::U16, &[0xff, 0xff], 0xffff),
        ] {
            let (mut out, mut wanted) = (Vec::new(), Vec::new());
            write_value(&kind, bytes, &mut out);
            encode_varint(expected, &mut wanted);
            assert_eq!(out, wanted, "{kind:?}");
        }
    }
}
