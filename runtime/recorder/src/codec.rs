//! Messages as they lie in memory, written as protobuf by their layout, and read back from it: the same
//! bytes, with zeros where a field is reserved. Schemas are made in [`crate::schema`]; the two agree
//! because both number fields by position.

use hil_rundir::layout::{LayoutFault, checked_element_bytes};
use hil_rundir::manifest::{FieldDescription, KindDescription};
use prost::encoding::{WireType, decode_key, decode_varint, encode_key, encode_varint};

use crate::schema::{self, Schema};

/// How the messages of one channel lie in a file.
#[derive(Debug)]
pub(crate) struct Codec {
    /// The checked layout; without one they are the bytes that they are, in
    /// `google.protobuf.BytesValue`.
    fields: Vec<FieldDescription>,
    size_bytes: usize,
    /// What they look like to a reader.
    pub(crate) schema: Schema,
}

impl Codec {
    /// For messages with this layout.
    ///
    /// # Errors
    /// When the layout does not describe exactly `size_bytes`.
    pub(crate) fn typed(
        message: &str,
        fields: &[FieldDescription],
        size_bytes: usize,
    ) -> Result<Self, LayoutFault> {
        Ok(Self {
            schema: schema::of_layout(message, fields, size_bytes)?,
            fields: fields.to_vec(),
            size_bytes,
        })
    }

    /// For messages whose layout is not known. What is read must have `size_bytes`.
    pub(crate) fn opaque(size_bytes: usize) -> Self {
        Self {
            fields: Vec::new(),
            size_bytes,
            schema: schema::opaque(),
        }
    }

    /// Appends `message` to `out`; false, with nothing appended, when it has another size than its
    /// layout.
    pub(crate) fn encode(&self, message: &[u8], out: &mut Vec<u8>) -> bool {
        if self.fields.is_empty() {
            write_bytes(1, message, out);
            return true;
        }
        let is_fit = message.len() == self.size_bytes;
        if is_fit {
            encode_record(&self.fields, message, out);
        }
        is_fit
    }

    /// The message that `data` says.
    ///
    /// # Errors
    /// Why it says none, or one that does not fit the layout.
    pub(crate) fn decode(&self, data: &[u8]) -> Result<Vec<u8>, String> {
        let expected = self.size_bytes;
        if self.fields.is_empty() {
            let mut message = Vec::new();
            each_field(data, &mut |number, value| match (number, value) {
                (1, Wire::Bytes(bytes)) => {
                    message = bytes.to_vec();
                    Ok(())
                }
                (number, _) => Err(other_kind(number)),
            })?;
            let found = message.len();
            return if found == expected {
                Ok(message)
            } else {
                Err(format!(
                    "it has {found} bytes, where the channel's messages have {expected}"
                ))
            };
        }
        let mut message = vec![0; expected];
        decode_record(&self.fields, data, &mut message)?;
        Ok(message)
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
            let wire_type = match &field.kind {
                KindDescription::F32 => WireType::ThirtyTwoBit,
                KindDescription::F64 => WireType::SixtyFourBit,
                _ => WireType::Varint,
            };
            encode_key(number, wire_type, out);
            write_value(&field.kind, bytes, out);
        }
    }
}

fn write_bytes(number: u32, bytes: &[u8], out: &mut Vec<u8>) {
    encode_key(number, WireType::LengthDelimited, out);
    encode_varint(bytes.len() as u64, out);
    out.extend_from_slice(bytes);
}

const fn is_real(kind: &KindDescription) -> bool {
    matches!(kind, KindDescription::F32 | KindDescription::F64)
}

const fn is_signed(kind: &KindDescription) -> bool {
    use hil_core::layout::FieldKind::{I8, I16, I32, I64};
    matches!(kind, I8 | I16 | I32 | I64)
}

/// One number; `bytes` are as many as its kind has.
fn write_value(kind: &KindDescription, bytes: &[u8], out: &mut Vec<u8>) {
    if is_real(kind) {
        return out.extend_from_slice(bytes);
    }
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    let unsigned = u64::from_le_bytes(wide);
    // Brings the sign of a narrower number to the width of 64 bits, and then small magnitudes to small
    // numbers, as `sint32` and `sint64` want it.
    let unused_bits = 64 - 8 * bytes.len();
    let signed = (unsigned << unused_bits).cast_signed() >> unused_bits;
    let zigzag = ((signed << 1) ^ (signed >> 63)).cast_unsigned();
    encode_varint(if is_signed(kind) { zigzag } else { unsigned }, out);
}

/// A value as it lies in protobuf.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wire<'a> {
    Number(u64),
    /// Of a `float` or a `double`, as many bytes as it has.
    Real(&'a [u8]),
    Bytes(&'a [u8]),
}

fn other_kind(number: u32) -> String {
    format!("field {number} is not of the kind that the layout says")
}

fn damaged() -> String {
    "its bytes are cut short or damaged".to_owned()
}

/// Hands each field of `data` with its number to `take`.
fn each_field<'a>(
    mut data: &'a [u8],
    take: &mut dyn FnMut(u32, Wire<'a>) -> Result<(), String>,
) -> Result<(), String> {
    while !data.is_empty() {
        let (number, kind) = decode_key(&mut data).map_err(|_error| damaged())?;
        let value = match kind {
            WireType::Varint => Wire::Number(varint(&mut data)?),
            WireType::ThirtyTwoBit => Wire::Real(split(&mut data, 4)?),
            WireType::SixtyFourBit => Wire::Real(split(&mut data, 8)?),
            WireType::LengthDelimited => {
                let length = usize::try_from(varint(&mut data)?).map_err(|_error| damaged())?;
                Wire::Bytes(split(&mut data, length)?)
            }
            _ => return Err(other_kind(number)),
        };
        take(number, value)?;
    }
    Ok(())
}

fn varint(data: &mut &[u8]) -> Result<u64, String> {
    decode_varint(data).map_err(|_error| damaged())
}

fn split<'a>(data: &mut &'a [u8], length: usize) -> Result<&'a [u8], String> {
    data.split_off(..length).ok_or_else(damaged)
}

/// Writes the structure that `data` says into `memory`, which is all zeros and as long as `fields`
/// describe.
fn decode_record(
    fields: &[FieldDescription],
    data: &[u8],
    memory: &mut [u8],
) -> Result<(), String> {
    let mut counts = vec![0_usize; fields.len()];
    let miscounted = |field: &FieldDescription, found: usize, expected: usize| {
        let name = &field.name;
        format!("{name} has {found} elements, where the layout has {expected}")
    };
    each_field(data, &mut |number, value| {
        let place = usize::try_from(number).unwrap_or(0).checked_sub(1);
        let known = place.and_then(|place| fields.get(place).zip(counts.get_mut(place)));
        let (field, count) = known.ok_or_else(|| other_kind(number))?;
        let element = checked_element_bytes(&field.kind);
        let mut put = |value| {
            let (place, expected) = (*count, field.count.unwrap_or(1));
            *count += 1;
            if place >= expected {
                return Err(miscounted(field, *count, expected));
            }
            let from = field.offset_bytes + place * element;
            decode_value(number, field, value, &mut memory[from..from + element])
        };
        let is_record = matches!(field.kind, KindDescription::Record { .. });
        match value {
            Wire::Bytes(mut packed) if field.count.is_some() && !is_record => {
                while !packed.is_empty() {
                    put(if is_real(&field.kind) {
                        Wire::Real(split(&mut packed, element)?)
                    } else {
                        Wire::Number(varint(&mut packed)?)
                    })?;
                }
                Ok(())
            }
            value => put(value),
        }
    })?;
    for (field, found) in fields.iter().zip(counts) {
        // A single value may be left out when it is zero; an array is there or it is not.
        let expected = field.count.unwrap_or(found.min(1));
        if !field.is_reserved() && found != expected {
            return Err(miscounted(field, found, expected));
        }
    }
    Ok(())
}

/// Writes one value into `memory`, which has its size.
fn decode_value(
    number: u32,
    field: &FieldDescription,
    value: Wire<'_>,
    memory: &mut [u8],
) -> Result<(), String> {
    let size_bytes = memory.len();
    match (&field.kind, value) {
        (KindDescription::Record { fields, .. }, Wire::Bytes(bytes)) => {
            decode_record(fields, bytes, memory)
        }
        (kind, Wire::Real(bytes)) if is_real(kind) && bytes.len() == size_bytes => {
            memory.copy_from_slice(bytes);
            Ok(())
        }
        (kind, Wire::Number(wide))
            if !is_real(kind) && !matches!(kind, KindDescription::Record { .. }) =>
        {
            let unused_bits = 64 - 8 * size_bytes;
            let (value, is_fit) = if is_signed(kind) {
                let signed = (wide >> 1).cast_signed() ^ -(wide & 1).cast_signed();
                let narrow = (signed << unused_bits) >> unused_bits;
                (signed.cast_unsigned(), narrow == signed)
            } else {
                (wide, (wide << unused_bits) >> unused_bits == wide)
            };
            if !is_fit {
                let name = &field.name;
                return Err(format!(
                    "the value of {name} does not fit into its {size_bytes} bytes"
                ));
            }
            memory.copy_from_slice(&value.to_le_bytes()[..size_bytes]);
            Ok(())
        }
        _ => Err(other_kind(number)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use hil_arm::egm::messages::{EgmArrival, EgmCommand, EgmFeedback};
    use hil_core::message::Message;
    use hil_core::random::RandomStream;
    use hil_fleet::messages::State;
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

    fn codec<M: Message>() -> Codec {
        let fields = describe_fields(M::FIELDS);
        Codec::typed(M::NAME, &fields, size_of::<M>()).unwrap()
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
        assert!(codec::<EgmFeedback>().encode(bytemuck::bytes_of(&feedback), &mut out));
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
        let arrival = codec::<EgmArrival>();
        assert!(!arrival.encode(&[0; 159], &mut out) && out.is_empty());
        assert!(arrival.encode(&[0; 160], &mut out));
        assert!(Codec::opaque(7).encode(&[], &mut out));
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

    /// Zeros where a field is reserved, as writers have it.
    fn without_reserved(fields: &[FieldDescription], bytes: &mut [u8]) {
        for field in fields {
            let size = checked_element_bytes(&field.kind);
            let all = size * field.count.unwrap_or(1);
            let bytes = &mut bytes[field.offset_bytes..field.offset_bytes + all];
            if field.is_reserved() {
                bytes.fill(0);
            } else if let KindDescription::Record { fields, .. } = &field.kind {
                for one in bytes.chunks_exact_mut(size) {
                    without_reserved(fields, one);
                }
            }
        }
    }

    fn any_bytes_come_back<M: Message>() {
        let codec = codec::<M>();
        let fields = describe_fields(M::FIELDS);
        let mut random = RandomStream::new(5, M::NAME);
        for _ in 0..500 {
            let mut message = vec![0; size_of::<M>()];
            for byte in &mut message {
                *byte = random.next_u64().to_le_bytes()[0];
            }
            without_reserved(&fields, &mut message);
            let mut out = Vec::new();
            assert!(codec.encode(&message, &mut out));
            assert_eq!(codec.decode(&out).unwrap(), message);
        }
    }

    #[test]
    fn any_message_comes_back_byte_for_byte() {
        any_bytes_come_back::<EgmCommand>();
        any_bytes_come_back::<EgmFeedback>();
        any_bytes_come_back::<EgmArrival>();
        any_bytes_come_back::<State>();
    }

    #[test]
    fn a_message_without_fields_comes_back_from_its_wrapper() {
        let codec = Codec::opaque(3);
        assert_eq!(codec.schema.name, "google.protobuf.BytesValue");
        let mut out = Vec::new();
        assert!(codec.encode(&[1, 2, 3], &mut out));
        assert_eq!(codec.decode(&out), Ok(vec![1, 2, 3]));
        let fault = codec.decode(&out[..out.len() - 1]);
        assert_eq!(fault, Err(damaged()));
        let size = "it has 0 bytes, where the channel's messages have 3";
        assert_eq!(codec.decode(&[]), Err(size.to_owned()));
    }

    #[test]
    fn what_is_cut_in_its_first_half_is_no_message() {
        let codec = codec::<EgmFeedback>();
        let mut whole = Vec::new();
        assert!(codec.encode(&[7; size_of::<EgmFeedback>()], &mut whole));
        // A single zero may be left out of protobuf, so an end between the last fields is no fault.
        for length in 0..whole.len() / 2 {
            assert!(codec.decode(&whole[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn a_value_that_has_no_room_is_refused() {
        let field = |kind| FieldDescription {
            name: "a".to_owned(),
            kind,
            count: None,
            offset_bytes: 0,
        };
        // Field 1, a varint of 300.
        let data = [0x08, 0xac, 0x02];
        let narrow = Codec::typed("x", &[field(KindDescription::U8)], 1).unwrap();
        let wide = Codec::typed("x", &[field(KindDescription::U16)], 2).unwrap();
        assert_eq!(wide.decode(&data), Ok(vec![0x2c, 0x01]));
        let range = "the value of a does not fit into its 1 bytes";
        assert_eq!(narrow.decode(&data), Err(range.to_owned()));
    }
}
