//! The stages of a message's way through one channel, in order. A segment is named by its two
//! ends, so no name hides what it contains.

use serde::{Deserialize, Serialize};

use super::network::Crossing;

hil_core::labelled! {
    /// A moment in the life of a message.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Stage, label {
        /// The producer published it.
        Published = "published",
        /// The sending gateway took it from the local channel.
        TakenByGateway = "taken by gateway",
        /// Just before the send call of its last fragment.
        HandedToKernel = "handed to kernel",
        /// Kernel software transmit stamp.
        TxSoftware = "TX stamp",
        /// Network card's transmit stamp, on the card's own clock.
        TxHardware = "TX stamp (hardware)",
        /// Network card's receive stamp, on the card's own clock.
        RxHardware = "RX stamp (hardware)",
        /// Kernel software receive stamp.
        RxSoftware = "RX stamp",
        /// The receiving gateway's receive call had returned.
        Received = "received by gateway",
        /// The receiving gateway published it on its host.
        Forwarded = "forwarded",
        /// The consumer took it.
        Taken = "taken by consumer",
    }
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

hil_core::labelled! {
    /// What became of a published message. Exactly one applies.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum MessageFate, label {
        /// The consumer took it.
        Taken = "taken by the consumer",
        /// The sending gateway never took it although it took a later one: a newer message had
        /// pushed it out of the channel.
        SupersededAtInput = "superseded at the gateway's input",
        /// The send call failed: the peer was absent or the kernel refused.
        RefusedByKernel = "refused by the kernel or peer absent",
        /// Not sent for want of a way to the peer: an interface was down or there was no route.
        NetworkUnreachable = "network unreachable (interface down or no route)",
        /// Handed to the kernel, never received.
        LostOnWire = "lost on the wire",
        /// Handed to the kernel in pieces, of which only some were received.
        Incomplete = "incomplete: pieces lost on the wire",
        /// It came to the receiving host, which had no room for it: where its number is missing, the host counts as
        /// many datagrams without room as are missing.
        LostByHarness = "lost by this program or its host (no room on the receiving host)",
        /// The same, but the host counts more or fewer than are missing there.
        LostOnWireOrByHarness = "lost on the wire or by this program or its host",
        /// Received and not forwarded, for no recorded reason.
        RefusedAtIngress = "refused by the receiving gateway",
        /// Received after the sequence window had moved on.
        Late = "too late for the receiving gateway",
        /// Received only as a duplicate of a message that was never forwarded.
        Duplicate = "received only as a duplicate",
        /// Published to the consumer, which never took it although it took a later one.
        SupersededAtConsumer = "superseded at the consumer",
        /// Still on its way when the run ended.
        InFlight = "in flight at the end of the run",
        /// Not taken because a process on its way was down; see the interruptions.
        LostInInterruption = "lost during an interruption",
        /// None of the above, with complete records: a finding.
        Unexplained = "unexplained",
        /// The other host's records are not at hand, so nobody can say.
        UnknownPeerRecordsUnavailable = "unknown (peer records unavailable)",
    }
}

impl MessageFate {
    /// What the network did to a message of this fate, as far as the fate alone tells.
    pub const fn crossing(self) -> Crossing {
        match self {
            Self::Taken | Self::SupersededAtConsumer => Crossing::Arrived,
            Self::LostOnWire | Self::Incomplete => Crossing::LostByNetwork,
            Self::NetworkUnreachable => Crossing::Unreachable,
            Self::LostOnWireOrByHarness => Crossing::Doubtful,
            Self::InFlight | Self::Unexplained | Self::UnknownPeerRecordsUnavailable => {
                Crossing::Unknown
            }
            Self::LostByHarness
            | Self::SupersededAtInput
            | Self::RefusedByKernel
            | Self::RefusedAtIngress
            | Self::Late
            | Self::Duplicate
            | Self::LostInInterruption => Crossing::LostByHost,
        }
    }

    /// True when the network lost the message for certain, or had no way for it.
    pub const fn is_loss_by_network(self) -> bool {
        matches!(
            self.crossing(),
            Crossing::LostByNetwork | Crossing::Unreachable
        )
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
