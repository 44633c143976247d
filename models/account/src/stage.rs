//! The stages of a message's way through one channel, in order. A segment is named by its two
//! ends, so no name hides what it contains.

use core::fmt;

use serde::{Deserialize, Serialize};

/// A moment in the life of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// The producer published it.
    Published,
    /// The sending gateway took it from the local channel.
    TakenByGateway,
    /// Just before the send call of its last fragment.
    HandedToKernel,
    /// Kernel software transmit stamp.
    TxSoftware,
    /// Network card's transmit stamp, on the card's own clock.
    TxHardware,
    /// Network card's receive stamp, on the card's own clock.
    RxHardware,
    /// Kernel software receive stamp.
    RxSoftware,
    /// The receiving gateway's receive call had returned.
    Received,
    /// The receiving gateway published it on its host.
    Forwarded,
    /// The consumer took it.
    Taken,
}

/// Which host a stage happens on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The producer's host.
    Producer,
    /// The consumer's host.
    Consumer,
}

impl Stage {
    /// The stages on host clocks that a gateway's channel adds up, in order. Hardware stamps are
    /// on clocks of their own and stand beside this chain.
    pub const CHAIN: [Self; 8] = [
        Self::Published,
        Self::TakenByGateway,
        Self::HandedToKernel,
        Self::TxSoftware,
        Self::RxSoftware,
        Self::Received,
        Self::Forwarded,
        Self::Taken,
    ];

    /// The words a report prints.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Published => "published",
            Self::TakenByGateway => "taken by gateway",
            Self::HandedToKernel => "handed to kernel",
            Self::TxSoftware => "TX stamp",
            Self::TxHardware => "TX stamp (hardware)",
            Self::RxHardware => "RX stamp (hardware)",
            Self::RxSoftware => "RX stamp",
            Self::Received => "received by gateway",
            Self::Forwarded => "forwarded",
            Self::Taken => "taken by consumer",
        }
    }

    /// The host it happens on.
    pub const fn side(self) -> Side {
        match self {
            Self::Published
            | Self::TakenByGateway
            | Self::HandedToKernel
            | Self::TxSoftware
            | Self::TxHardware => Side::Producer,
            _ => Side::Consumer,
        }
    }

    pub(super) const fn index(self) -> usize {
        self as usize
    }

    /// One more than the largest [`Stage::index`].
    pub(super) const COUNT: usize = Self::Taken.index() + 1;
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// What became of a published message. Exactly one applies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MessageFate {
    /// The consumer took it.
    Taken,
    /// The sending gateway never took it although it took a later one: a newer message had
    /// pushed it out of the channel.
    SupersededAtInput,
    /// The send call failed: the peer was absent or the kernel refused.
    RefusedByKernel,
    /// Not sent for want of a way to the peer: an interface was down or there was no route.
    NetworkUnreachable,
    /// Handed to the kernel, never received.
    LostOnWire,
    /// Handed to the kernel in pieces, of which only some were received.
    Incomplete,
    /// It came to the receiving host, which had no room for it: where its number is missing, the host counts as
    /// many datagrams without room as are missing.
    LostByHarness,
    /// The same, but the host counts more or fewer than are missing there.
    LostOnWireOrByHarness,
    /// Received and not forwarded, for no recorded reason.
    RefusedAtIngress,
    /// Received after the sequence window had moved on.
    Late,
    /// Received only as a duplicate of a message that was never forwarded.
    Duplicate,
    /// Published to the consumer, which never took it although it took a later one.
    SupersededAtConsumer,
    /// Still on its way when the run ended.
    InFlight,
    /// Not taken because a process on its way was down; see the interruptions.
    LostInInterruption,
    /// None of the above, with complete records: a finding.
    Unexplained,
    /// The other host's records are not at hand, so nobody can say.
    UnknownPeerRecordsUnavailable,
}

impl MessageFate {
    /// Every fate, in the order of a message's way.
    pub const ALL: [Self; 16] = [
        Self::Taken,
        Self::SupersededAtInput,
        Self::RefusedByKernel,
        Self::NetworkUnreachable,
        Self::LostOnWire,
        Self::Incomplete,
        Self::LostByHarness,
        Self::LostOnWireOrByHarness,
        Self::RefusedAtIngress,
        Self::Late,
        Self::Duplicate,
        Self::SupersededAtConsumer,
        Self::InFlight,
        Self::LostInInterruption,
        Self::Unexplained,
        Self::UnknownPeerRecordsUnavailable,
    ];

    /// The words a report prints.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Taken => "taken by the consumer",
            Self::SupersededAtInput => "superseded at the gateway's input",
            Self::RefusedByKernel => "refused by the kernel or peer absent",
            Self::NetworkUnreachable => "network unreachable (interface down or no route)",
            Self::LostOnWire => "lost on the wire",
            Self::Incomplete => "incomplete: pieces lost on the wire",
            Self::LostByHarness => "lost by the harness (no room on the receiving host)",
            Self::LostOnWireOrByHarness => "lost on the wire or by the harness",
            Self::RefusedAtIngress => "refused by the receiving gateway",
            Self::Late => "too late for the receiving gateway",
            Self::Duplicate => "received only as a duplicate",
            Self::SupersededAtConsumer => "superseded at the consumer",
            Self::InFlight => "in flight at the end of the run",
            Self::LostInInterruption => "lost during an interruption",
            Self::Unexplained => "unexplained",
            Self::UnknownPeerRecordsUnavailable => "unknown (peer records unavailable)",
        }
    }

    /// True when the message vanished, as opposed to having been taken, replaced by a newer
    /// one, still travelling, or unknown.
    pub const fn is_loss(self) -> bool {
        matches!(
            self,
            Self::RefusedByKernel
                | Self::NetworkUnreachable
                | Self::LostOnWire
                | Self::Incomplete
                | Self::LostByHarness
                | Self::LostOnWireOrByHarness
                | Self::RefusedAtIngress
                | Self::Late
                | Self::Duplicate
                | Self::LostInInterruption
                | Self::Unexplained
        )
    }
}

impl fmt::Display for MessageFate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}
