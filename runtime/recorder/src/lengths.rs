//! Whether the lengths that a record of an MCAP file has in itself lie within it. The crate `mcap`
//! asks for as much memory as a text says it needs, up to 4 GiB, before it looks for it; and it
//! panics on a short attachment. So nothing is handed to it that says more than is there.

use mcap::records::op;

/// What a record is made of, in order; what follows these is not of a length of its own.
#[derive(Debug, Clone, Copy)]
enum Part {
    /// So many bytes.
    Bytes(usize),
    /// A length in four bytes, and as many bytes.
    Text,
    /// A length in four bytes, and in as many bytes pairs of texts.
    TextMap,
    /// A length in four bytes, and in as many bytes pairs of two and eight bytes.
    OffsetMap,
}

/// The parts of records of this kind, as the MCAP specification lists them.
const fn parts(opcode: u8) -> &'static [Part] {
    use Part::{Bytes, OffsetMap, Text, TextMap};
    match opcode {
        op::HEADER => &[Text, Text],
        op::SCHEMA => &[Bytes(2), Text, Text],
        op::CHANNEL => &[Bytes(4), Text, Text, TextMap],
        op::CHUNK => &[Bytes(28), Text],
        op::CHUNK_INDEX => &[Bytes(32), OffsetMap, Bytes(8), Text],
        op::ATTACHMENT => &[Bytes(16), Text, Text, Bytes(8 + 4)],
        op::ATTACHMENT_INDEX => &[Bytes(40), Text, Text],
        op::METADATA => &[Text, TextMap],
        op::METADATA_INDEX => &[Bytes(16), Text],
        _ => &[],
    }
}

/// True when everything that a record of kind `opcode` says of its own lengths lies within `body`.
pub(crate) fn lie_within(opcode: u8, body: &[u8]) -> bool {
    let mut rest = body;
    parts(opcode)
        .iter()
        .all(|part| skip(*part, &mut rest).is_some())
}

fn skip(part: Part, rest: &mut &[u8]) -> Option<()> {
    match part {
        Part::Bytes(count) => *rest = rest.get(count..)?,
        Part::Text => {
            let count = length(rest)?;
            *rest = rest.get(count..)?;
        }
        Part::TextMap => {
            let count = length(rest)?;
            let end = rest.len().checked_sub(count)?;
            while rest.len() > end {
                skip(Part::Text, rest)?;
                skip(Part::Text, rest)?;
            }
        }
        Part::OffsetMap => {
            let count = length(rest)?;
            *rest = rest.get(count.checked_next_multiple_of(2 + 8)?..)?;
        }
    }
    Some(())
}

/// Takes a length off the front.
fn length(rest: &mut &[u8]) -> Option<usize> {
    let (length, after) = rest.split_first_chunk::<4>()?;
    *rest = after;
    usize::try_from(u32::from_le_bytes(*length)).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [u8; 9] = [
        op::HEADER,
        op::SCHEMA,
        op::CHANNEL,
        op::CHUNK,
        op::CHUNK_INDEX,
        op::ATTACHMENT,
        op::ATTACHMENT_INDEX,
        op::METADATA,
        op::METADATA_INDEX,
    ];

    /// The shortest body of a kind whose maps have one entry and whose texts have `text_bytes`.
    fn body(opcode: u8, text_bytes: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        let text = |bytes: &mut Vec<u8>| {
            bytes.extend(u32::try_from(text_bytes).unwrap().to_le_bytes());
            bytes.extend(vec![b'a'; text_bytes]);
        };
        for part in parts(opcode) {
            match part {
                Part::Bytes(count) => bytes.extend(vec![0; *count]),
                Part::Text => text(&mut bytes),
                Part::TextMap => {
                    let count = u32::try_from(2 * (4 + text_bytes)).unwrap();
                    bytes.extend(count.to_le_bytes());
                    text(&mut bytes);
                    text(&mut bytes);
                }
                Part::OffsetMap => {
                    bytes.extend(10_u32.to_le_bytes());
                    bytes.extend([0; 10]);
                }
            }
        }
        bytes
    }

    #[test]
    fn a_record_is_read_when_all_of_it_is_there_and_not_a_byte_less() {
        for opcode in KINDS {
            for text_bytes in [0, 1, 300] {
                let whole = body(opcode, text_bytes);
                assert!(lie_within(opcode, &whole), "{opcode} {text_bytes}");
                for end in 0..whole.len() {
                    assert!(!lie_within(opcode, &whole[..end]), "{opcode} {end}");
                }
            }
        }
    }

    #[test]
    fn a_length_of_four_gigabytes_is_not_believed() {
        for opcode in KINDS {
            let whole = body(opcode, 7);
            let at = whole.windows(4).position(|four| four == [7, 0, 0, 0]);
            let mut said = whole;
            said[at.unwrap()..][..4].fill(0xff);
            assert!(!lie_within(opcode, &said), "{opcode}");
        }
    }
}
