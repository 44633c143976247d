//! What became of the messages offered to an egress bridge. It decides nothing.

use crate::counters::named_counts;

/// Why a message of the local channel was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LocalRefusal {
    /// The peer has not answered a greeting yet.
    #[error("peer has not greeted back yet")]
    PeerNotGreeted,
    /// The network reported the peer unreachable, and it has not greeted back since.
    #[error("peer is down")]
    PeerDown,
    /// The peer refused the channel.
    #[error("peer refused the channel")]
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

/// Counters of an egress bridge. At rest
/// `offered = sent + message_failed + refused_count()`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct EgressCounts {
    /// Messages offered by the local channel.
    pub offered_count: u64,
    /// Messages given to the owner completely, and not reported as failed.
    pub sent_count: u64,
    /// Messages given up because a datagram of theirs could not be sent or the peer went down.
    pub message_failed_count: u64,
    /// Refused: the peer had not greeted back.
    pub refused_not_greeted_count: u64,
    /// Refused: the peer was down.
    pub refused_peer_down_count: u64,
    /// Refused: the peer refuses the channel.
    pub refused_channel_count: u64,
    /// Refused: published by a gateway.
    pub refused_forwarded_count: u64,
    /// Refused: too big.
    pub refused_too_big_count: u64,
    /// Refused: the message before it was still being sent.
    pub refused_pending_count: u64,
    /// Refused: the session had ended.
    pub refused_closed_count: u64,
    /// Datagrams of any kind given to the owner.
    pub datagram_count: u64,
    /// Datagrams of any kind that the owner could not send.
    pub transmit_failed_count: u64,
    /// Transmit stamps that lay before handing over or 4 s after it.
    pub transmit_stamp_implausible_count: u64,
    /// Greetings given.
    pub hello_sent_count: u64,
    /// Clock exchanges asked for.
    pub sync_sent_count: u64,
    /// Clock exchanges that came back.
    pub round_trip_count: u64,
    /// Times the peer was reported unreachable after it was not.
    pub peer_down_count: u64,
    /// Times the peer came back with another session.
    pub peer_restart_count: u64,
    /// Times the peer asked for a greeting during a session.
    pub greet_again_count: u64,
    /// Datagrams received; accepted ones plus the total of the refusals.
    pub reply_count: u64,
    /// Datagrams received and accepted.
    pub reply_accepted_count: u64,
}

named_counts!(EgressCounts {
    offered_count,
    sent_count,
    message_failed_count,
    refused_not_greeted_count,
    refused_peer_down_count,
    refused_channel_count,
    refused_forwarded_count,
    refused_too_big_count,
    refused_pending_count,
    refused_closed_count,
    datagram_count,
    transmit_failed_count,
    transmit_stamp_implausible_count,
    hello_sent_count,
    sync_sent_count,
    round_trip_count,
    peer_down_count,
    peer_restart_count,
    greet_again_count,
    reply_count,
    reply_accepted_count,
});

impl EgressCounts {
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
