//! What a message is, and what every message carries. Datagram layout is not here: see
//! `hil_protocol::wire`.

use core::fmt::Debug;

use bytemuck::{Pod, Zeroable};

use crate::layout::Field;

/// A fixed-size message without padding, so that its shared-memory layout is its wire layout.
///
/// ```
/// use bytemuck::{Pod, Zeroable};
/// use hil_core::message::Message;
///
/// #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
/// #[repr(C)]
/// struct Wheels { speed_mps: [f64; 2] }
/// impl Message for Wheels { const NAME: &'static str = "example.Wheels.v1"; }
/// assert_eq!(hil_core::message::MessageType::of::<Wheels>().size_bytes, 16);
/// ```
pub trait Message: Pod + Debug + Send + 'static {
    /// Name and version, e.g. `hil.EgmCommand.v1`. A changed layout needs a new version.
    const NAME: &'static str;
    /// Its fields, by [`layout!`](crate::layout!); empty where nobody stated them, and who records
    /// such messages keeps their bytes.
    const FIELDS: &'static [Field] = &[];
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

/// What every message carries beside its payload: one cache line, the user header of the
/// shared-memory sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Envelope {
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
    /// Zero; room to grow without a new layout.
    pub reserved: [u64; 4],
}

impl Envelope {
    /// The sample was published by a gateway, not by the producer itself.
    pub const FORWARDED: u32 = 1;

    /// True when a gateway carried this message here.
    pub const fn is_forwarded(&self) -> bool {
        self.flags & Self::FORWARDED != 0
    }
}

const _: () = assert!(size_of::<Envelope>() == 64);

/// Declares a structure of plain numbers whose fields can be read without its type; with a name
/// it is a [`Message`]. The build fails unless the fields cover it, see
/// [`layout!`](crate::layout!).
///
/// ```
/// use bytemuck::{Pod, Zeroable};
/// use hil_core::layout::FieldKind;
/// use hil_core::message::Message;
///
/// hil_core::message! {
///     /// What the wheels do.
///     #[derive(Debug, Clone, Copy, Pod, Zeroable)]
///     #[repr(C)]
///     pub struct Wheels = "example.Wheels.v1" {
///         /// Left and right.
///         pub speed_mps: [f64; 2],
///         /// Bits.
///         pub flags: u64,
///     }
/// }
/// assert_eq!(Wheels::NAME, "example.Wheels.v1");
/// assert_eq!(Wheels::FIELDS[1].kind, FieldKind::U64);
/// ```
#[macro_export]
macro_rules! message {
    ($(#[$meta:meta])* $vis:vis struct $structure:ident $(= $name:literal)? {
        $($(#[$field_meta:meta])* $field_vis:vis $field:ident: $kind:ty),+ $(,)?
    }) => {
        $(#[$meta])*
        $vis struct $structure {
            $($(#[$field_meta])* $field_vis $field: $kind,)+
        }

        $crate::layout!($structure { $($field),+ });

        $(impl $crate::message::Message for $structure {
            const NAME: &'static str = $name;
            const FIELDS: &'static [$crate::layout::Field] = Self::LAYOUT;
        })?
    };
}

/// The messages one side of a component takes or gives: one [`Message`] type, or an enum made
/// by [`message_set!`](crate::message_set) with one variant per port.
pub trait MessageSet: Debug + Copy + 'static {
    /// The message type of each port, in port order.
    const PORTS: &'static [MessageType];

    /// Reads the message that arrived on `port`; `None` for an unknown port or a wrong size.
    fn from_bytes(port: usize, bytes: &[u8]) -> Option<Self>;

    /// The port this message belongs to.
    fn port(&self) -> usize;

    /// The payload as it lies in shared memory.
    fn as_bytes(&self) -> &[u8];
}

impl<M: Message> MessageSet for M {
    const PORTS: &'static [MessageType] = &[MessageType::of::<M>()];

    fn from_bytes(port: usize, bytes: &[u8]) -> Option<Self> {
        (port == 0)
            .then(|| bytemuck::try_pod_read_unaligned(bytes).ok())
            .flatten()
    }

    fn port(&self) -> usize {
        0
    }

    fn as_bytes(&self) -> &[u8] {
        bytemuck::bytes_of(self)
    }
}

/// Defines an enum of messages, one port per variant in the order written.
///
/// ```
/// use hil_core::message::{Message, MessageSet};
/// # use bytemuck::{Pod, Zeroable};
///
/// #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
/// #[repr(C)]
/// pub struct Speed { mps: f64 }
/// impl Message for Speed { const NAME: &'static str = "example.Speed.v1"; }
///
/// #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
/// #[repr(C)]
/// pub struct Position { m: f64 }
/// impl Message for Position { const NAME: &'static str = "example.Position.v1"; }
///
/// hil_core::message_set! {
///     /// Everything an observer hears.
///     pub enum Heard { Speed(Speed), Position(Position) }
/// }
/// assert_eq!(Heard::PORTS.len(), 2);
/// ```
#[macro_export]
macro_rules! message_set {
    ($(#[$meta:meta])* $vis:vis enum $name:ident { $($variant:ident($message:ty)),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        $vis enum $name {
            $(
                #[doc = concat!("A [`", stringify!($message), "`].")]
                $variant($message),
            )+
        }

        impl $crate::message::MessageSet for $name {
            const PORTS: &'static [$crate::message::MessageType] =
                &[$($crate::message::MessageType::of::<$message>()),+];

            fn from_bytes(port: usize, bytes: &[u8]) -> Option<Self> {
                let mut index = 0;
                $(
                    if index == port {
                        return <$message as $crate::message::MessageSet>::from_bytes(0, bytes)
                            .map(Self::$variant);
                    }
                    index += 1;
                )+
                // Read once more so that the last increment is not an unused assignment.
                debug_assert!(index == Self::PORTS.len());
                None
            }

            fn port(&self) -> usize {
                let mut index = 0;
                $(
                    if matches!(self, Self::$variant(_)) {
                        return index;
                    }
                    index += 1;
                )+
                index
            }

            fn as_bytes(&self) -> &[u8] {
                match self {
                    $(Self::$variant(message) =>
                        $crate::message::MessageSet::as_bytes(message),)+
                }
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
    #[repr(C)]
    struct Small {
        value: u32,
    }

    impl Message for Small {
        const NAME: &'static str = "test.Small.v1";
    }

    #[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
    #[repr(C)]
    struct Large {
        value: [f64; 3],
    }

    impl Message for Large {
        const NAME: &'static str = "test.Large.v1";
    }

    message_set! {
        /// Both.
        enum Both { Small(Small), Large(Large) }
    }

    #[test]
    fn a_set_finds_the_variant_by_port_and_refuses_a_wrong_size() {
        let large = Both::Large(Large {
            value: [1.0, 2.0, 3.0],
        });
        assert_eq!(large.port(), 1);
        assert_eq!(Both::from_bytes(1, large.as_bytes()), Some(large));
        assert_eq!(Both::from_bytes(0, large.as_bytes()), None);
        assert_eq!(Both::from_bytes(2, large.as_bytes()), None);
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
