//! Protobuf written by [`crate::encode`] as messages lie in memory: the same bytes again, with zeros
//! where a field is reserved. The layout is the live channel's, and the file's schema must be the
//! one that this layout gives, so that nothing is read as something else.

use hil_rundir::layout::{LayoutFault, checked_element_bytes};
use hil_rundir::manifest::{FieldDescription, KindDescription};
use prost::encoding::{WireType, decode_key, decode_varint};

use crate::schema::{self, Schema};

/// Why a message cannot be had from what is in the file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DecodeFault {
    /// The bytes end too early, or a number is not one.
    #[error("its bytes are cut short or damaged")]
    Damaged,
    /// A field of another kind than the layout has.
    #[error("field {number} is not of the kind that the layout says")]
    Kind {
        /// Its number.
        number: u32,
    },
    /// A value that its field in memory has no room for.
    #[error("the value of {field} does not fit into its {size_bytes} bytes")]
    Range {
        /// The field.
        field: String,
        /// Size of an element.
        size_bytes: usize,
    },
    /// An array of another length.
    #[error("{field} has {found} elements, where the layout has {expected}")]
    Count {
        /// The field.
        field: String,
        /// In the file.
        found: usize,
        /// In memory.
        expected: usize,
    },
    /// Bytes of another length than the message.
    #[error("it has {found} bytes, where the channel's messages have {expected}")]
    Size {
        /// In the file.
        found: usize,
        /// In memory.
        expected: usize,
    },
}

/// How messages of one channel are made of what a file has.
#[derive(Debug)]
pub(crate) enum Decoder {
    /// Field by field.
    Typed {
        /// The checked layout.
        fields: Vec<FieldDescription>,
        /// Size of a message.
        size_bytes: usize,
    },
    /// From `google.protobuf.BytesValue`.
    Opaque {
        /// Size of a message.
        size_bytes: usize,
    },
}

impl Decoder {
    /// For messages with this layout, and the schema that a file of them has; without fields, the
    /// wrapper of bytes.
    ///
    /// # Errors
    /// When the layout does not describe exactly `size_bytes`.
    pub(crate) fn new(
        message: &str,
        fields: &[FieldDescription],
        size_bytes: usize,
    ) -> Result<(Self, Schema), LayoutFault> {
        if fields.is_empty() {
            return Ok((Self::Opaque { size_bytes }, schema::opaque()));
        }
        let schema = schema::of_layout(message, fields, size_bytes)?;
        let fields = fields.to_vec();
        Ok((Self::Typed { fields, size_bytes }, schema))
    }

    /// The message that `data` says.
    ///
    /// # Errors
    /// When it says none, or one that does not fit the layout.
    pub(crate) fn decode(&self, data: &[u8]) -> Result<Vec<u8>, DecodeFault> {
        match self {
            Self::Typed { fields, size_bytes } => {
                let mut message = vec![0; *size_bytes];
                read_record(fields, data, &mut message)?;
                Ok(message)
            }
            Self::Opaque { size_bytes } => {
                let mut message = Vec::new();
                each_field(data, &mut |number, value| match (number, value) {
                    (1, Wire::Bytes(bytes)) => {
                        message = bytes.to_vec();
                        Ok(())
                    }
                    (number, _) => Err(DecodeFault::Kind { number }),
                })?;
                if message.len() != *size_bytes {
                    return Err(DecodeFault::Size {
                        found: message.len(),
                        expected: *size_bytes,
                    });
                }
                Ok(message)
            }
        }
    }
}

/// A value as it lies in protobuf.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wire<'a> {
    Number(u64),
    /// Of a `float` or a `double`, as many bytes as it has.
    Real(&'a [u8]),
    Bytes(&'a [u8]),
}

/// Hands each field of `data` with its number to `take`.
fn each_field<'a>(
    mut data: &'a [u8],
    take: &mut dyn FnMut(u32, Wire<'a>) -> Result<(), DecodeFault>,
) -> Result<(), DecodeFault> {
    while !data.is_empty() {
        let (number, kind) = decode_key(&mut data).map_err(|_error| DecodeFault::Damaged)?;
        let value = match kind {
            WireType::Varint => Wire::Number(varint(&mut data)?),
            WireType::ThirtyTwoBit => Wire::Real(split(&mut data, 4)?),
            WireType::SixtyFourBit => Wire::Real(split(&mut data, 8)?),
            WireType::LengthDelimited => {
                let length = varint(&mut data)?;
                let length = usize::try_from(length).map_err(|_error| DecodeFault::Damaged)?;
                Wire::Bytes(split(&mut data, length)?)
            }
            _ => return Err(DecodeFault::Kind { number }),
        };
        take(number, value)?;
    }
    Ok(())
}

fn varint(data: &mut &[u8]) -> Result<u64, DecodeFault> {
    decode_varint(data).map_err(|_error| DecodeFault::Damaged)
}

fn split<'a>(data: &mut &'a [u8], length: usize) -> Result<&'a [u8], DecodeFault> {
    let (bytes, rest) = data.split_at_checked(length).ok_or(DecodeFault::Damaged)?;
    *data = rest;
    Ok(bytes)
}

/// Writes the structure that `data` says into `memory`, which is all zeros and as long as `fields`
/// describe.
fn read_record(
    fields: &[FieldDescription],
    data: &[u8],
    memory: &mut [u8],
) -> Result<(), DecodeFault> {
    let mut counts = vec![0_usize; fields.len()];
    each_field(data, &mut |number, value| {
        let place = usize::try_from(number).unwrap_or(0).checked_sub(1);
        let Some((field, count)) =
            place.and_then(|place| fields.get(place).zip(counts.get_mut(place)))
        else {
            return Err(DecodeFault::Kind { number });
        };
        read_field(number, field, value, count, memory)
    })?;
    for (field, found) in fields.iter().zip(counts) {
        // A single value may be left out when it is zero; an array is there or it is not.
        let expected = field.count.unwrap_or(found.min(1));
        if !field.is_reserved() && found != expected {
            let field = field.name.clone();
            return Err(DecodeFault::Count {
                field,
                found,
                expected,
            });
        }
    }
    Ok(())
}

/// Writes one occurrence of a field behind the `count` elements that were there before.
fn read_field(
    number: u32,
    field: &FieldDescription,
    value: Wire<'_>,
    count: &mut usize,
    memory: &mut [u8],
) -> Result<(), DecodeFault> {
    let size_bytes = checked_element_bytes(&field.kind);
    let expected = field.count.unwrap_or(1);
    let next = |count: &mut usize| {
        let place = *count;
        *count += 1;
        let from = field.offset_bytes + place * size_bytes;
        (place < expected).then(|| from..from + size_bytes)
    };
    let too_many = |found: usize| DecodeFault::Count {
        field: field.name.clone(),
        found,
        expected,
    };
    match (&field.kind, value) {
        (KindDescription::Record { fields, .. }, Wire::Bytes(bytes)) => {
            let place = next(count).ok_or_else(|| too_many(*count))?;
            read_record(fields, bytes, &mut memory[place])
        }
        (KindDescription::Record { .. }, _) => Err(DecodeFault::Kind { number }),
        (kind, Wire::Bytes(mut packed)) if field.count.is_some() => {
            while !packed.is_empty() {
                let value = match kind {
                    KindDescription::F32 | KindDescription::F64 => {
                        Wire::Real(split(&mut packed, size_bytes)?)
                    }
                    _ => Wire::Number(varint(&mut packed)?),
                };
                let place = next(count).ok_or_else(|| too_many(*count))?;
                write_value(number, field, value, &mut memory[place])?;
            }
            Ok(())
        }
        (_, value) => {
            let place = next(count).ok_or_else(|| too_many(*count))?;
            write_value(number, field, value, &mut memory[place])
        }
    }
}

/// Writes one number into `memory`, which has its size.
fn write_value(
    number: u32,
    field: &FieldDescription,
    value: Wire<'_>,
    memory: &mut [u8],
) -> Result<(), DecodeFault> {
    let size_bytes = memory.len();
    let range = || DecodeFault::Range {
        field: field.name.clone(),
        size_bytes,
    };
    let wide = match (&field.kind, value) {
        (KindDescription::F32 | KindDescription::F64, Wire::Real(bytes)) => {
            if bytes.len() != size_bytes {
                return Err(DecodeFault::Kind { number });
            }
            memory.copy_from_slice(bytes);
            return Ok(());
        }
        (
            KindDescription::I8
            | KindDescription::I16
            | KindDescription::I32
            | KindDescription::I64,
            Wire::Number(zigzag),
        ) => {
            let signed = (zigzag >> 1).cast_signed() ^ -(zigzag & 1).cast_signed();
            let unused_bits = 64 - 8 * size_bytes;
            if (signed << unused_bits) >> unused_bits != signed {
                return Err(range());
            }
            signed.cast_unsigned()
        }
        (
            KindDescription::U8
            | KindDescription::U16
            | KindDescription::U32
            | KindDescription::U64,
            Wire::Number(unsigned),
        ) => {
            let unused_bits = 64 - 8 * size_bytes;
            if (unsigned << unused_bits) >> unused_bits != unsigned {
                return Err(range());
            }
            unsigned
        }
        _ => return Err(DecodeFault::Kind { number }),
    };
    memory.copy_from_slice(&wide.to_le_bytes()[..size_bytes]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encode::Encoder;
    use hil_arm::egm::messages::{EgmArrival, EgmCommand, EgmFeedback};
    use hil_core::message::Message;
    use hil_core::random::RandomStream;
    use hil_fleet::messages::State;
    use hil_rundir::manifest::describe_fields;

    fn pair<M: Message>() -> (Encoder, Decoder) {
        let fields = describe_fields(M::FIELDS);
        let (encoder, written) = Encoder::typed(M::NAME, &fields, size_of::<M>()).unwrap();
        let (decoder, read) = Decoder::new(M::NAME, &fields, size_of::<M>()).unwrap();
        assert_eq!(written, read);
        (encoder, decoder)
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
        let (encoder, decoder) = pair::<M>();
        let fields = describe_fields(M::FIELDS);
        let mut random = RandomStream::new(5, M::NAME);
        for _ in 0..500 {
            let mut message = vec![0; size_of::<M>()];
            for byte in &mut message {
                *byte = random.next_u64().to_le_bytes()[0];
            }
            without_reserved(&fields, &mut message);
            let mut out = Vec::new();
            assert!(encoder.encode(&message, &mut out));
            assert_eq!(decoder.decode(&out).unwrap(), message);
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
        let (decoder, schema) = Decoder::new("x", &[], 3).unwrap();
        assert_eq!(schema.name, "google.protobuf.BytesValue");
        let mut out = Vec::new();
        assert!(Encoder::Opaque.encode(&[1, 2, 3], &mut out));
        assert_eq!(decoder.decode(&out), Ok(vec![1, 2, 3]));
        let fault = decoder.decode(&out[..out.len() - 1]);
        assert_eq!(fault, Err(DecodeFault::Damaged));
        assert!(matches!(
            decoder.decode(&[]),
            Err(DecodeFault::Size { found: 0, .. })
        ));
    }

    #[test]
    fn what_is_cut_in_its_first_half_is_no_message() {
        let (encoder, decoder) = pair::<EgmFeedback>();
        let mut whole = Vec::new();
        assert!(encoder.encode(&[7; size_of::<EgmFeedback>()], &mut whole));
        // A single zero may be left out of protobuf, so an end between the last fields is no fault.
        for length in 0..whole.len() / 2 {
            assert!(decoder.decode(&whole[..length]).is_err(), "{length}");
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
        let (narrow, _) = Decoder::new("x", &[field(KindDescription::U8)], 1).unwrap();
        let (wide, _) = Decoder::new("x", &[field(KindDescription::U16)], 2).unwrap();
        assert_eq!(wide.decode(&data), Ok(vec![0x2c, 0x01]));
        assert!(matches!(
            narrow.decode(&data),
            Err(DecodeFault::Range { size_bytes: 1, .. })
        ));
    }
}
