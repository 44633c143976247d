//! Generic netlink messages as bytes (`linux/netlink.h`, `linux/genetlink.h`): what to send and how
//! to read an answer. It opens no socket; whatever the bytes, it does not panic.

/// Bytes of `struct nlmsghdr`: length (4), type (2), flags (2), sequence (4), port (4).
const HEADER_BYTES: usize = 16;
/// Bytes of `struct genlmsghdr`: command (1), version (1), reserved (2).
const GENERIC_BYTES: usize = 4;
/// Bytes of `struct nlattr`: length (2), type (2).
const ATTRIBUTE_BYTES: usize = 4;
/// Messages and attributes start at multiples of this.
const ALIGNMENT_BYTES: usize = 4;
/// The bits of an attribute's type that are its number.
const ATTRIBUTE_NUMBER: u16 = 0x3fff;

/// `NLMSG_ERROR`: a refusal, or with 0 an acknowledgement.
const ERROR: u16 = 2;
/// `NLMSG_DONE`: the end of a dump.
const DONE: u16 = 3;
/// `NLM_F_REQUEST`.
const REQUEST: u16 = 1;
/// `NLM_F_ROOT | NLM_F_MATCH`: everything there is.
const DUMP: u16 = 0x300;

/// The family of generic netlink's own control messages.
pub(crate) const CONTROL_FAMILY: u16 = 16;

/// A request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Request<'a> {
    /// The family it is for.
    pub(crate) family: u16,
    /// The family's command.
    pub(crate) command: u8,
    /// Asks for everything there is.
    pub(crate) is_dump: bool,
    /// Repeated in each answer.
    pub(crate) sequence: u32,
    /// Attributes in order: number and content.
    pub(crate) attributes: &'a [(u16, &'a [u8])],
}

impl Request<'_> {
    /// The bytes to send.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![0; HEADER_BYTES];
        bytes.extend([self.command, 1, 0, 0]);
        bytes.extend(encode_attributes(self.attributes));
        let length = u32::try_from(bytes.len()).expect("requests are short");
        let flags = REQUEST | if self.is_dump { DUMP } else { 0 };
        bytes[..4].copy_from_slice(&length.to_ne_bytes());
        bytes[4..6].copy_from_slice(&self.family.to_ne_bytes());
        bytes[6..8].copy_from_slice(&flags.to_ne_bytes());
        bytes[8..12].copy_from_slice(&self.sequence.to_ne_bytes());
        bytes
    }
}

/// Attributes one after the other, as a message or another attribute holds them: number and content.
///
/// # Panics
/// When one is longer than an attribute can be.
pub fn encode_attributes(attributes: &[(u16, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (number, content) in attributes {
        let length = u16::try_from(ATTRIBUTE_BYTES + content.len())
            .expect("requests carry names and indexes");
        bytes.extend(length.to_ne_bytes());
        bytes.extend(number.to_ne_bytes());
        bytes.extend(*content);
        bytes.resize(bytes.len().next_multiple_of(ALIGNMENT_BYTES), 0);
    }
    bytes
}

/// One message of the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Answer<'a> {
    /// A message of a family.
    Message {
        family: u16,
        command: u8,
        attributes: Attributes<'a>,
    },
    /// The end of a dump that did not fail.
    Done,
    /// The kernel refused, or gave a dump up on the way, with this errno; 0 acknowledges.
    Error(i32),
}

/// The messages in what one receive call returned, each with its sequence number. Ends where the
/// bytes stop making sense.
#[derive(Debug, Clone)]
pub(crate) struct Answers<'a> {
    rest: &'a [u8],
}

impl<'a> Answers<'a> {
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }
}

impl<'a> Iterator for Answers<'a> {
    type Item = (u32, Answer<'a>);

    fn next(&mut self) -> Option<Self::Item> {
        let length = usize::try_from(u32_at(self.rest, 0)?).ok()?;
        let body = self.rest.get(HEADER_BYTES..length)?;
        let kind = u16_at(self.rest, 4)?;
        let sequence = u32_at(self.rest, 8)?;
        let next = length.checked_next_multiple_of(ALIGNMENT_BYTES)?;
        self.rest = self.rest.get(next..).unwrap_or_default();
        let answer = match kind {
            ERROR => Answer::Error(u32_at(body, 0)?.cast_signed().checked_neg()?),
            // A dump fails in here: the kernel ends it with the errno, of a command that the
            // driver does not know just like of one that broke off half way.
            DONE => match u32_at(body, 0).map_or(0, u32::cast_signed) {
                0.. => Answer::Done,
                errno => Answer::Error(errno.checked_neg()?),
            },
            family => Answer::Message {
                family,
                command: *body.first()?,
                attributes: Attributes {
                    rest: body.get(GENERIC_BYTES..)?,
                },
            },
        };
        Some((sequence, answer))
    }
}

/// Attributes one after the other: number and content. Ends where the bytes stop making sense.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attributes<'a> {
    rest: &'a [u8],
}

impl<'a> Attributes<'a> {
    /// Those inside the content of an attribute.
    pub const fn nested(content: &'a [u8]) -> Self {
        Self { rest: content }
    }

    /// The content of the first with this number.
    pub fn find(self, number: u16) -> Option<&'a [u8]> {
        self.into_iter()
            .find_map(|(one, content)| (one == number).then_some(content))
    }
}

impl<'a> IntoIterator for Attributes<'a> {
    type Item = (u16, &'a [u8]);
    type IntoIter = AttributeIter<'a>;

    fn into_iter(self) -> AttributeIter<'a> {
        AttributeIter(self)
    }
}

/// Goes through [`Attributes`].
#[derive(Debug, Clone)]
pub struct AttributeIter<'a>(Attributes<'a>);

impl<'a> Iterator for AttributeIter<'a> {
    type Item = (u16, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let rest = &mut self.0.rest;
        let length = usize::from(u16_at(rest, 0)?);
        let content = rest.get(ATTRIBUTE_BYTES..length)?;
        let number = u16_at(rest, 2)? & ATTRIBUTE_NUMBER;
        let next = length.next_multiple_of(ALIGNMENT_BYTES);
        *rest = rest.get(next..).unwrap_or_default();
        Some((number, content))
    }
}

pub(crate) fn u16_at(bytes: &[u8], offset: usize) -> Option<u16> {
    Some(u16::from_ne_bytes(*bytes.get(offset..)?.first_chunk()?))
}

/// The number at `offset` of `bytes`, in the order of this host.
pub fn u32_at(bytes: &[u8], offset: usize) -> Option<u32> {
    Some(u32::from_ne_bytes(*bytes.get(offset..)?.first_chunk()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_laid_out_as_the_kernel_reads_it() {
        let request = Request {
            family: CONTROL_FAMILY,
            command: 3,
            is_dump: false,
            sequence: 7,
            attributes: &[(2, b"nl80211\0"), (3, &[1])],
        };
        let mut expected = vec![40, 0, 0, 0, 16, 0, 1, 0, 7, 0, 0, 0, 0, 0, 0, 0, 3, 1, 0, 0];
        expected.extend([12, 0, 2, 0]);
        expected.extend(b"nl80211\0");
        expected.extend([5, 0, 3, 0, 1, 0, 0, 0]);
        assert_eq!(request.encode(), expected);
    }

    #[test]
    fn refusals_and_the_end_of_a_dump_are_told_apart() {
        let mut bytes = vec![20, 0, 0, 0, 2, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0];
        bytes.extend((-19_i32).to_ne_bytes());
        bytes.extend([20, 0, 0, 0, 3, 0, 2, 0, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        let answers: Vec<_> = Answers::new(&bytes).collect();
        assert_eq!(answers, [(9, Answer::Error(19)), (9, Answer::Done)]);
    }

    #[test]
    fn a_dump_that_failed_is_a_refusal_and_not_an_empty_list() {
        let mut bytes = vec![20, 0, 0, 0, 3, 0, 2, 0, 9, 0, 0, 0, 0, 0, 0, 0];
        bytes.extend((-libc::EOPNOTSUPP).to_ne_bytes());
        let answers: Vec<_> = Answers::new(&bytes).collect();
        assert_eq!(answers, [(9, Answer::Error(libc::EOPNOTSUPP))]);
        // Without content there is nothing that failed.
        let bare = [16, 0, 0, 0, 3, 0, 2, 0, 9, 0, 0, 0, 0, 0, 0, 0];
        let answers: Vec<_> = Answers::new(&bare).collect();
        assert_eq!(answers, [(9, Answer::Done)]);
        // No errno is the negation of this.
        bytes[16..].copy_from_slice(&i32::MIN.to_ne_bytes());
        assert_eq!(Answers::new(&bytes).count(), 0);
    }

    #[test]
    fn a_length_that_cannot_be_ends_the_list() {
        for length in [0_u32, 15, 21, u32::MAX] {
            let mut bytes = vec![0; 20];
            bytes[..4].copy_from_slice(&length.to_ne_bytes());
            assert_eq!(Answers::new(&bytes).count(), 0, "{length}");
        }
        let attributes = Attributes::nested(&[3, 0, 1, 0]);
        assert_eq!(attributes.into_iter().count(), 0);
    }
}
