//! The fixed-size records that processes write beside the measured path, one per message and
//! stage; `hil_account::fold` joins them. All times in nanoseconds; [`UNAVAILABLE`] where there was none.

use bytemuck::{Pod, Zeroable};

/// A stamp that was not available; never a made-up zero.
pub const UNAVAILABLE: i64 = i64::MIN;

/// `None` for a stamp that was not available.
pub const fn stamp(ns: i64) -> Option<i64> {
    if ns == UNAVAILABLE { None } else { Some(ns) }
}

/// A producer published a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct PublishedRecord {
    /// Sequence number on the channel.
    pub sequence: u64,
    /// When, on this host's monotonic clock.
    pub published_ns: i64,
    /// The producer's start.
    pub epoch: u32,
    /// Zero.
    pub reserved: u32,
}

/// A consumer took a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct TakenRecord {
    /// Sequence number on the channel.
    pub sequence: u64,
    /// The producer's stamp, on the producer's host clock.
    pub published_ns: i64,
    /// When a gateway published it on this host, or [`UNAVAILABLE`] on a direct channel.
    pub forwarded_ns: i64,
    /// When the consumer took it, on this host's monotonic clock.
    pub taken_ns: i64,
    /// The producer's start.
    pub epoch: u32,
    /// Zero.
    pub reserved: u32,
}

/// A gateway took a message from a local channel and handed it to the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct EgressRecord {
    /// Sequence number on the channel.
    pub sequence: u64,
    /// The producer's stamp, this host's monotonic clock.
    pub published_ns: i64,
    /// When the gateway took it, this host's monotonic clock.
    pub taken_ns: i64,
    /// Just before the send call, this host's monotonic clock.
    pub handed_ns: i64,
    /// Kernel software transmit stamp of the last fragment, this host's *real-time* clock.
    pub tx_software_ns: i64,
    /// Network card's transmit stamp, the card's own clock.
    pub tx_hardware_ns: i64,
    /// Real-time minus monotonic clock, read as a pair next to this message.
    pub realtime_offset_ns: i64,
    /// The producer's start.
    pub epoch: u32,
    /// The gateway's start.
    pub session: u32,
    /// Bits below.
    pub flags: u32,
    /// Datagrams this message took.
    pub fragment_count: u32,
}

impl EgressRecord {
    /// It did not leave this host whole: the kernel refused it, or the gateway had nobody to send
    /// it to.
    pub const REFUSED_BY_KERNEL: u32 = 1;
    /// `tx_software_ns` was taken before the queueing discipline (`SCM_TSTAMP_SCHED`): the driver
    /// stamps no departures, as wireless ones do not.
    pub const STAMPED_BEFORE_QUEUE: u32 = 2;
    /// The radio reported that the peer radio acknowledged the last fragment (`SO_WIFI_STATUS`).
    pub const RADIO_ACKNOWLEDGED: u32 = 4;
    /// The radio reported that the peer radio did not acknowledge the last fragment.
    pub const RADIO_UNACKNOWLEDGED: u32 = 8;
    /// It did not leave because there was no way to the peer: an interface that is down, no route, or the last
    /// report of the network said so.
    pub const UNREACHABLE: u32 = 16;

    /// Whether the kernel refused it, or there was nobody to send it to.
    pub const fn is_refused(&self) -> bool {
        self.flags & Self::REFUSED_BY_KERNEL != 0
    }

    /// Whether it was handed to the kernel, which did not refuse it.
    pub const fn was_handed(&self) -> bool {
        self.handed_ns != UNAVAILABLE && !self.is_refused()
    }
}

/// A gateway received a message from the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct IngressRecord {
    /// Sequence number on the channel.
    pub sequence: u64,
    /// The producer's stamp, the *sending* host's monotonic clock.
    pub published_ns: i64,
    /// Just before the send call, the *sending* host's monotonic clock.
    pub handed_ns: i64,
    /// Network card's receive stamp, the card's own clock.
    pub rx_hardware_ns: i64,
    /// Kernel software receive stamp of the datagram that completed the message, this host's
    /// *real-time* clock.
    pub rx_software_ns: i64,
    /// When the receive call had returned, this host's monotonic clock.
    pub received_ns: i64,
    /// When the gateway published it here, this host's monotonic clock; [`UNAVAILABLE`] when it
    /// was refused, see `flags`.
    pub forwarded_ns: i64,
    /// Real-time minus monotonic clock, read as a pair next to this message.
    pub realtime_offset_ns: i64,
    /// When an emulated link took the datagram that completed the message, this host's monotonic
    /// clock; [`UNAVAILABLE`] on a real link.
    pub emulated_ns: i64,
    /// When the model of that link let it arrive, this host's monotonic clock: `received_ns` is
    /// later by what the host needed to notice. [`UNAVAILABLE`] on a real link.
    pub due_ns: i64,
    /// Number of an earlier message of the same starts, whose transmit stamp came along with this one.
    pub follow_up_sequence: u64,
    /// That stamp, see [`FollowUp`]; [`UNAVAILABLE`] when none came along, and the number then says nothing.
    pub follow_up_ns: i64,
    /// The producer's start.
    pub epoch: u32,
    /// The sending gateway's start.
    pub session: u32,
    /// Bits below.
    pub flags: u32,
    /// Datagrams this message took, or those of them that came.
    pub fragment_count: u32,
}

/// A sender's kernel transmit stamp of an earlier message, for a receiver that cannot read the sender's
/// records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FollowUp {
    /// The earlier message's number, of the same epoch.
    pub sequence: u64,
    /// Kernel transmit stamp minus handing over, both on the sending host.
    pub handed_to_tx_ns: i64,
}

impl IngressRecord {
    /// The transmit stamp that came along.
    pub fn follow_up(&self) -> Option<FollowUp> {
        Some(FollowUp {
            sequence: self.follow_up_sequence,
            handed_to_tx_ns: stamp(self.follow_up_ns)?,
        })
    }

    /// The record with the transmit stamp that came along.
    #[must_use]
    pub fn with_follow_up(self, follow_up: Option<FollowUp>) -> Self {
        Self {
            follow_up_sequence: follow_up.map_or(0, |one| one.sequence),
            follow_up_ns: follow_up.map_or(UNAVAILABLE, |one| one.handed_to_tx_ns),
            ..self
        }
    }

    /// It came after a message with a higher sequence number.
    pub const REORDERED: u32 = 1;
    /// Seen before; not published again.
    pub const DUPLICATE: u32 = 2;
    /// Older than the sequence window; not published.
    pub const LATE: u32 = 4;
    /// Of its pieces only so many as `fragment_count` came; not published.
    pub const INCOMPLETE: u32 = 8;
}

/// A clock exchange of a sending gateway with its peer (four stamps, as in NTP, RFC 5905 section
/// 8). An exchange appears again when a better stamp of it came later; the last one counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct RoundTripRecord {
    /// Number of the request.
    pub sequence: u64,
    /// Request left, this host's monotonic clock.
    pub t1_ns: i64,
    /// Request arrived, the *peer's* monotonic clock.
    pub t2_ns: i64,
    /// Response left, the *peer's* monotonic clock.
    pub t3_ns: i64,
    /// Response arrived, this host's monotonic clock.
    pub t4_ns: i64,
    /// The sending gateway's start.
    pub session: u32,
    /// Kind of t1, t2, t3 and t4: 0 application, 1 kernel software, 2 network card.
    pub sources: [u8; 4],
}

impl RoundTripRecord {
    /// Time under way, both directions together: `(t4 - t1) - (t3 - t2)`.
    pub const fn rtt_ns(&self) -> i64 {
        let whole = self.t4_ns.saturating_sub(self.t1_ns);
        whole.saturating_sub(self.t3_ns.saturating_sub(self.t2_ns))
    }
}

/// A receiving gateway's host had no room for datagrams of a flow: its socket's buffer was full, or the emulated
/// link held as many as it may. They came between two messages of the flow that it did receive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct NoRoomRecord {
    /// When the message before was handed to the kernel, the *sending* host's monotonic clock;
    /// [`UNAVAILABLE`] where there was none.
    pub after_ns: i64,
    /// When the message behind was, on the same clock; [`UNAVAILABLE`] where none came any more.
    pub before_ns: i64,
    /// When that was noticed, this host's monotonic clock.
    pub noticed_ns: i64,
    /// How many datagrams, of whatever kind and sender.
    pub datagram_count: u64,
}

/// A program behind an inlet sent an Ethernet frame, which is the message of the same epoch and sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct FrameRecord {
    /// Sequence number on the channel.
    pub sequence: u64,
    /// The inlet's start.
    pub epoch: u32,
    /// Bytes of the frame, without its check sequence.
    pub length_bytes: u16,
    /// Bytes of `head` that are of the frame.
    pub head_bytes: u16,
    /// The frame's beginning: enough for a VLAN tag, IPv6 and the ports.
    pub head: [u8; 64],
}

impl FrameRecord {
    /// Of the frame of a message.
    pub fn new(sequence: u64, epoch: u32, frame: &[u8]) -> Self {
        let mut head = [0; 64];
        let kept = frame.len().min(head.len());
        head[..kept].copy_from_slice(&frame[..kept]);
        let narrow = |length: usize| u16::try_from(length).unwrap_or(u16::MAX);
        Self {
            sequence,
            epoch,
            length_bytes: narrow(frame.len()),
            head_bytes: narrow(kept),
            head,
        }
    }
}
