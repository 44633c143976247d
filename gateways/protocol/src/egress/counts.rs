//! What became of the messages offered to an egress bridge. It decides nothing.

use crate::counts;

/// Why a message of the local channel was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LocalRefusal {
    /// The peer has not answered a greeting yet.
    #[error("peer has not greeted back yet")]
    PeerNotGreeted,
    /// The network reported the peer unreachable, and it has not greeted back since.
    #[error("peer is down")]
    PeerDown,
    /// The peer refused the flow.
    #[error("peer refused the flow")]
    ChannelRefused,
    /// A gateway published it: its stamps are of another clock, and sending it on could loop.
    #[error("message was published by a gateway")]
    Forwarded,
    /// Larger than the channel's largest message.
    #[error("message of {size_bytes} bytes is above {size_max_bytes}")]
    TooBig {
        /// Its size.
        size_bytes: usize,
        /// The channel's largest.
        size_max_bytes: usize,
    },
    /// The message before it has not been sent completely.
    #[error("the message before it is still being sent")]
    TransmissionPending,
    /// The farewell was said.
    #[error("session has ended")]
    Closed,
}

counts! {
    /// Counters of one channel of an egress bridge. At rest
    /// `offered = sent + message_failed + refused_count()`, and one more while a long message is under way.
    pub struct EgressChannelCounts {
        /// Messages offered by the local channel.
        offered_count,
        /// Messages given to the owner completely, and not reported as failed.
        sent_count,
        /// Messages given up because a datagram of theirs could not be sent or the peer went down.
        message_failed_count,
        /// Refused: the peer had not greeted back.
        refused_not_greeted_count,
        /// Refused: the peer was down.
        refused_peer_down_count,
        /// Refused: the peer refuses the channel.
        refused_channel_count,
        /// Refused: published by a gateway.
        refused_forwarded_count,
        /// Refused: too big.
        refused_too_big_count,
        /// Refused: the message before it was still being sent.
        refused_pending_count,
        /// Refused: the session had ended.
        refused_closed_count,
        /// Datagrams about it that the owner sent, its farewell among them.
        datagram_count,
    }
}

counts! {
    /// Counters of an egress bridge that are of no one channel.
    pub struct EgressCounts {
        /// Datagrams of any kind given to the owner.
        datagram_count,
        /// Datagrams of any kind that the owner could not send.
        transmit_failed_count,
        /// Transmit stamps that lay before handing over or 4 s after it.
        transmit_stamp_implausible_count,
        /// Greetings given.
        hello_sent_count,
        /// Clock exchanges asked for.
        sync_sent_count,
        /// Clock exchanges that came back.
        round_trip_count,
        /// Pieces of long messages that the peer acknowledged.
        piece_ack_count,
        /// Times that acknowledgements of pieces stayed out and those under way were counted as lost.
        piece_silence_count,
        /// Times the peer was reported unreachable after it was not.
        peer_down_count,
        /// Times the peer came back with another session.
        peer_restart_count,
        /// Times the peer asked for a greeting during a session.
        greet_again_count,
        /// Datagrams received; accepted ones plus the total of the refusals.
        reply_count,
        /// Datagrams received and accepted.
        reply_accepted_count,
    }
}

impl EgressChannelCounts {
    /// Messages of the local channel refused for any reason.
    pub const fn refused_count(&self) -> u64 {
        self.refused_not_greeted_count
            + self.refused_peer_down_count
            + self.refused_channel_count
            + self.refused_forwarded_count
            + self.refused_too_big_count
            + self.refused_pending_count
            + self.refused_closed_count
    }

    pub(super) fn refuse(&mut self, refusal: LocalRefusal) {
        let counter = match refusal {
            LocalRefusal::PeerNotGreeted => &mut self.refused_not_greeted_count,
            LocalRefusal::PeerDown => &mut self.refused_peer_down_count,
            LocalRefusal::ChannelRefused => &mut self.refused_channel_count,
            LocalRefusal::Forwarded => &mut self.refused_forwarded_count,
            LocalRefusal::TooBig { .. } => &mut self.refused_too_big_count,
            LocalRefusal::TransmissionPending => &mut self.refused_pending_count,
            LocalRefusal::Closed => &mut self.refused_closed_count,
        };
        *counter += 1;
    }
}
