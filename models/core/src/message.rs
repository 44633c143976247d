//! What a message is, and what every message carries. Datagram layout is not here: see
//! `hil_protocol::wire`.

use core::fmt;

use bytemuck::Pod;

use crate::layout::Field;

/// A fixed-size message without padding, so that its shared-memory layout is its wire layout.
/// Declared by [`message!`](crate::message!).
pub trait Message: Pod + fmt::Debug + Send + 'static {
    /// Name and version, e.g. `hil.EgmCommand.v1`. A changed layout needs a new version.
    const NAME: &'static str;
    /// Its fields, in the order in which they lie in memory.
    const FIELDS: &'static [Field];
}

/// A message's identity at run time: what two hosts compare before they trust bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageType {
    /// [`Message::NAME`].
    pub name: &'static str,
    /// Size of one message.
    pub size_bytes: usize,
    /// Alignment in shared memory.
    pub alignment_bytes: usize,
    /// [`Message::FIELDS`].
    pub fields: &'static [Field],
}

impl MessageType {
    /// The identity of `M`.
    pub const fn of<M: Message>() -> Self {
        Self {
            name: M::NAME,
            size_bytes: size_of::<M>(),
            alignment_bytes: align_of::<M>(),
            fields: M::FIELDS,
        }
    }

    /// See [`type_hash`].
    pub const fn hash(&self) -> u64 {
        type_hash(self.name, self.size_bytes, self.alignment_bytes)
    }
}

impl fmt::Display for MessageType {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        TypeInfo::of(self).fmt(formatter)
    }
}

/// Name, size and alignment of messages as a file or another process states them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeInfo {
    /// See [`Message::NAME`].
    pub name: String,
    /// Size of one message.
    pub size_bytes: usize,
    /// Alignment in shared memory.
    pub alignment_bytes: usize,
}

impl TypeInfo {
    /// The identity of a message type as this program was compiled.
    pub fn of(message: &MessageType) -> Self {
        Self {
            name: message.name.to_owned(),
            size_bytes: message.size_bytes,
            alignment_bytes: message.alignment_bytes,
        }
    }

    /// See [`may_be_shorter`].
    pub fn may_be_shorter(&self) -> bool {
        may_be_shorter(&self.name)
    }
}

impl fmt::Display for TypeInfo {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            size_bytes,
            alignment_bytes,
        } = self;
        write!(
            formatter,
            "{name} ({size_bytes} bytes aligned to {alignment_bytes})"
        )
    }
}

/// True when messages of the type called `name` may be shorter than their type.
pub fn may_be_shorter(name: &str) -> bool {
    name == ETHERNET_FRAME.name
}

/// True when `name` ends in a version: `.v` and digits.
pub const fn has_version(name: &str) -> bool {
    let bytes = name.as_bytes();
    let mut start = bytes.len();
    while start > 0 && bytes[start - 1].is_ascii_digit() {
        start -= 1;
    }
    start < bytes.len() && start > 2 && bytes[start - 1] == b'v' && bytes[start - 2] == b'.'
}

/// 64-bit FNV-1a over name, size and alignment (as little-endian u64): travels in every datagram.
///
/// It guards against a wrong build on one host, not against an adversary.
pub const fn type_hash(name: &str, size_bytes: usize, alignment_bytes: usize) -> u64 {
    let hash = fnv1a(FNV_OFFSET, name.as_bytes());
    let hash = fnv1a(hash, &(size_bytes as u64).to_le_bytes());
    fnv1a(hash, &(alignment_bytes as u64).to_le_bytes())
}

/// Where 64-bit FNV-1a begins.
pub const FNV_OFFSET: u64 = 0xcbf2_9ce4_8422_2325;

/// 64-bit FNV-1a of `bytes`, going on from `hash`.
pub const fn fnv1a(mut hash: u64, bytes: &[u8]) -> u64 {
    let mut index = 0;
    while index < bytes.len() {
        hash = (hash ^ bytes[index] as u64).wrapping_mul(0x0000_0100_0000_01b3);
        index += 1;
    }
    hash
}

crate::message! {
    /// What every message carries beside its payload: one cache line, the user header of the
    /// shared-memory sample.
    #[derive(Eq, Default)]
    pub struct Envelope, 64 bytes {
        /// Counts the producer's messages on this channel from 0.
        pub sequence: u64,
        /// When the producer published, on the *producer's* host clock, nanoseconds.
        pub published_ns: i64,
        /// When a gateway published it on this host, nanoseconds on this host's clock; meaningful
        /// only with [`Envelope::FORWARDED`].
        pub forwarded_ns: i64,
        /// Changes with every start of the producer: a restart is not a loss.
        pub epoch: u32,
        /// [`Envelope::FORWARDED`]; all other bits are zero.
        pub flags: u32,
        /// Bytes of the message where its type allows fewer than [`TypeInfo::size_bytes`], see
        /// [`ETHERNET_FRAME`]; zero otherwise.
        pub length_bytes: u64,
        /// Zero; room to grow without a new layout.
        pub reserved: [u64; 3],
    }
}

/// An Ethernet frame without its check sequence, from the destination address on: up to 1500 bytes of payload
/// behind the header and two VLAN tags. The only messages that may be shorter than their type.
pub const ETHERNET_FRAME: MessageType = MessageType {
    name: "hil.EthernetFrame.v1",
    size_bytes: 1522,
    alignment_bytes: 2,
    fields: &[],
};

impl Envelope {
    /// The sample was published by a gateway, not by the producer itself.
    pub const FORWARDED: u32 = 1;

    /// True when a gateway carried this message here.
    pub const fn is_forwarded(&self) -> bool {
        self.flags & Self::FORWARDED != 0
    }
}

/// Declares a message, or without a name a structure that messages contain, from one list of fields.
///
/// It gives the structure a fixed layout without padding, the traits of plain data, the table of its
/// fields ([`Message::FIELDS`]) and, with a name, [`Message`]. The build fails when the name has no
/// version, when the size is not the one stated, when the fields leave a gap, or when a field is no
/// number, array or structure of such. The size may be left out.
///
/// ```
/// use hil_core::layout::FieldKind;
/// use hil_core::message::{Message, MessageType};
///
/// hil_core::message! {
///     /// What the wheels do.
///     pub struct Wheels = "example.Wheels.v1", 24 bytes {
///         /// Left and right.
///         pub speed_mps: [f64; 2],
///         /// Bits.
///         pub flags: u64,
///     }
/// }
/// assert_eq!(MessageType::of::<Wheels>().to_string(), "example.Wheels.v1 (24 bytes aligned to 8)");
/// assert_eq!(Wheels::FIELDS[0].count, Some(2));
/// assert_eq!(Wheels::FIELDS[1].kind, FieldKind::U64);
/// ```
///
/// ```compile_fail
/// hil_core::message! {
///     pub struct Wheels = "example.Wheels.v1", 16 bytes { pub speed_mps: [f64; 3] }
/// }
/// ```
///
/// ```compile_fail
/// hil_core::message! {
///     pub struct Wheels = "example.Wheels" { pub speed_mps: [f64; 3] }
/// }
/// ```
#[macro_export]
macro_rules! message {
    ($(#[$meta:meta])* $vis:vis struct $structure:ident
        $(= $name:literal)? $(, $size:literal bytes)? {
        $($(#[$field_meta:meta])* $field_vis:vis $field:ident: $kind:ty),+ $(,)?
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, $crate::bytemuck::Pod, $crate::bytemuck::Zeroable)]
        #[bytemuck(crate = "hil_core::bytemuck")]
        #[repr(C)]
        $vis struct $structure {
            $($(#[$field_meta])* $field_vis $field: $kind,)+
        }

        impl $structure {
            /// Its fields as they lie in memory.
            #[allow(unreachable_pub, reason = "as visible as its type")]
            pub const LAYOUT: &'static [$crate::layout::Field] = &[$(
                $crate::layout::Field::of(
                    stringify!($field),
                    ::core::mem::offset_of!($structure, $field),
                    |whole: &$structure| &whole.$field,
                ),
            )+];
        }

        impl $crate::layout::FieldValue for $structure {
            const KIND: $crate::layout::FieldKind = $crate::layout::FieldKind::Record {
                name: stringify!($structure),
                fields: $structure::LAYOUT,
            };
            const COUNT: Option<usize> = None;
        }

        const _: () = {
            assert!(
                $crate::layout::covers($structure::LAYOUT, size_of::<$structure>()),
                concat!("the fields of ", stringify!($structure), " do not cover it")
            );
            assert!(
                align_of::<$structure>() <= $crate::message::ALIGNMENT_MAX,
                concat!(stringify!($structure), " needs a larger alignment than messages have")
            );
            $(assert!(
                size_of::<$structure>() == $size,
                concat!(stringify!($structure), " has not the stated size")
            );)?
        };

        $(
            const _: () = assert!(
                $crate::message::has_version($name),
                concat!("the name ", $name, " does not end in a version like .v1")
            );

            impl $crate::message::Message for $structure {
                const NAME: &'static str = $name;
                const FIELDS: &'static [$crate::layout::Field] = Self::LAYOUT;
            }
        )?
    };
}

/// Largest alignment of a message: it follows the [`Envelope`] in shared memory and in record files.
pub const ALIGNMENT_MAX: usize = align_of::<Envelope>();

/// Declares an enum that messages carry as a number, with the way back from the number.
///
/// ```
/// hil_core::numbered! {
///     /// What a door is.
///     pub enum Door: u32 {
///         /// Nobody can pass.
///         Closed = 0,
///         /// Everybody can.
///         Open = 3,
///     }
/// }
/// assert_eq!(Door::from_number(3), Some(Door::Open));
/// assert_eq!(Door::from_number(1), None);
/// ```
#[macro_export]
macro_rules! numbered {
    ($(#[$meta:meta])* $vis:vis enum $name:ident: $number:ident {
        $($(#[$variant_meta:meta])* $variant:ident = $value:literal),+ $(,)?
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr($number)]
        $vis enum $name {
            $($(#[$variant_meta])* $variant = $value,)+
        }

        impl $name {
            /// The one with this number; `None` for an unknown number.
            #[allow(unreachable_pub, reason = "as visible as its type")]
            pub const fn from_number(number: $number) -> Option<Self> {
                match number {
                    $($value => Some(Self::$variant),)+
                    _ => None,
                }
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_version_is_digits_after_a_v() {
        for name in ["a.v1", "hil.EgmCommand.v12"] {
            assert!(has_version(name), "{name}");
        }
        for name in ["", "1", "v1", ".v1", "a.v", "a.1", "a.v1b", "av1"] {
            assert!(!has_version(name), "{name}");
        }
    }

    #[test]
    fn name_size_and_alignment_each_change_the_hash() {
        let base = type_hash("a", 8, 8);
        assert_ne!(base, type_hash("b", 8, 8));
        assert_ne!(base, type_hash("a", 16, 8));
        assert_ne!(base, type_hash("a", 8, 4));
        assert_eq!(type_hash("", 0, 0), type_hash("", 0, 0));
    }

    #[test]
    fn fnv_matches_its_published_vectors() {
        assert_eq!(fnv1a(FNV_OFFSET, b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a(FNV_OFFSET, b"foobar"), 0x8594_4171_f739_67e8);
    }
}
