//! What an ingress bridge says about a datagram and a message. It keeps no state of its own.

use hil_core::message::Envelope;
use hil_core::time::{Instant, RemoteInstant};

use super::destination::{Destination, Payload};
use crate::counts;
use crate::sequence::{Order, Stream};
use crate::wire::{FollowUpField, Header};
use hil_core::record::FollowUp;

/// Who a message is and when it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageInfo {
    /// Index of its channel in the flow.
    pub channel: usize,
    /// The sending gateway's start.
    pub session: u32,
    /// The producer's start.
    pub epoch: u32,
    /// The producer's number.
    pub sequence: u64,
    /// The producer's stamp; `RemoteInstant::from_ns(i64::MIN)` when it had none.
    pub published: RemoteInstant,
    /// When the sending gateway handed its first datagram to the kernel.
    pub handed: RemoteInstant,
    /// Datagrams it took.
    pub fragment_count: u16,
}

impl MessageInfo {
    /// Of the message that a datagram carries, or a piece of.
    pub(crate) const fn of(channel: usize, header: &Header) -> Self {
        Self {
            channel,
            session: header.session,
            epoch: header.epoch,
            sequence: header.sequence,
            published: RemoteInstant::from_ns(header.published_ns),
            handed: RemoteInstant::from_ns(header.handed_ns),
            fragment_count: header.fragment_count,
        }
    }

    /// The envelope under which a gateway publishes the message on this host at `forwarded`.
    pub fn envelope(&self, forwarded: Instant) -> Envelope {
        Envelope {
            sequence: self.sequence,
            published_ns: self.published.as_ns(),
            forwarded_ns: forwarded.as_ns(),
            epoch: self.epoch,
            flags: Envelope::FORWARDED,
            ..Envelope::default()
        }
    }
}

/// A message of which some pieces did not come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Incomplete {
    /// Who it is; `fragment_count` is of the pieces that came.
    pub message: MessageInfo,
    /// When the last of them came.
    pub heard_at: Instant,
}

/// What a message for the local channel is, beside its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Delivery {
    /// Who it is.
    pub message: MessageInfo,
    /// [`Order::InOrder`] or [`Order::Reordered`].
    pub order: Order,
    /// A stamp of an earlier message that came along.
    pub follow_up: Option<FollowUp>,
}

/// What became of an accepted datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposition {
    /// Its message was delivered.
    Delivered(MessageInfo),
    /// A copy of a message that was received: not delivered.
    Duplicate(MessageInfo),
    /// Its message is too old to judge: not delivered.
    Late(MessageInfo),
    /// A piece of a message that is not whole yet.
    FragmentStored,
    /// A greeting was accepted.
    Greeted {
        /// An earlier session was replaced.
        is_restart: bool,
    },
    /// A clock exchange will be answered.
    SyncRequested,
    /// The sender says that the session, or one of its channels, ends.
    Farewell,
}

impl Disposition {
    /// The message of which the datagram was the only or the last piece.
    pub const fn message(&self) -> Option<&MessageInfo> {
        match self {
            Self::Delivered(message) | Self::Duplicate(message) | Self::Late(message) => {
                Some(message)
            }
            Self::FragmentStored | Self::Greeted { .. } | Self::SyncRequested | Self::Farewell => {
                None
            }
        }
    }
}

counts! {
    /// Counters of an ingress bridge that are of no one channel.
    pub struct IngressCounts {
        /// Datagrams received.
        datagram_count,
        /// Datagrams accepted that carried a message or a piece of one.
        message_datagram_count,
        /// Greetings accepted.
        hello_count,
        /// Clock exchanges taken.
        sync_count,
        /// Farewells.
        bye_count,
        /// Sessions that replaced an earlier one; not a disposition of its own.
        session_restart_count,
    }
}

counts! {
    /// Counters of one channel of an ingress bridge, one per [`Disposition`] of a message.
    pub struct IngressChannelCounts {
        /// Messages delivered.
        delivered_count,
        /// Copies.
        duplicate_count,
        /// Messages too old to judge.
        late_count,
        /// Pieces stored.
        fragment_count,
        /// Datagrams that named the channel in a known session; those above and what was refused.
        datagram_count,
    }
}

impl IngressCounts {
    /// Datagrams accepted.
    pub const fn accepted_count(&self) -> u64 {
        self.message_datagram_count + self.hello_count + self.sync_count + self.bye_count
    }

    pub(super) fn count(&mut self, disposition: &Disposition) {
        let counter = match disposition {
            Disposition::Delivered(_)
            | Disposition::Duplicate(_)
            | Disposition::Late(_)
            | Disposition::FragmentStored => &mut self.message_datagram_count,
            Disposition::Greeted { .. } => &mut self.hello_count,
            Disposition::SyncRequested => &mut self.sync_count,
            Disposition::Farewell => &mut self.bye_count,
        };
        *counter += 1;
    }
}

impl IngressChannelCounts {
    pub(super) fn count(&mut self, disposition: &Disposition) {
        let counter = match disposition {
            Disposition::Delivered(_) => &mut self.delivered_count,
            Disposition::Duplicate(_) => &mut self.duplicate_count,
            Disposition::Late(_) => &mut self.late_count,
            Disposition::FragmentStored => &mut self.fragment_count,
            Disposition::Greeted { .. } | Disposition::SyncRequested | Disposition::Farewell => {
                return;
            }
        };
        *counter += 1;
    }
}

impl Delivery {
    /// Hands the message over unless it was received before or is too old to judge.
    pub(super) fn dispose(
        &self,
        payload: Payload<'_>,
        destination: &mut dyn Destination,
    ) -> Disposition {
        let message = self.message;
        match self.order {
            Order::Duplicate => Disposition::Duplicate(message),
            Order::Late => Disposition::Late(message),
            Order::InOrder { .. } | Order::Reordered => {
                destination.deliver(self, payload);
                Disposition::Delivered(message)
            }
        }
    }
}

pub(super) fn stream_of(header: &Header) -> Stream {
    Stream {
        session: header.session,
        epoch: header.epoch,
    }
}

pub(super) fn delivery_of(header: &Header, message: MessageInfo, order: Order) -> Delivery {
    let resolve = |field: FollowUpField| {
        Some(FollowUp {
            sequence: field.sequence(header.sequence)?,
            handed_to_tx_ns: field.handed_to_tx_ns.into(),
        })
    };
    Delivery {
        message,
        order,
        follow_up: header.follow_up.and_then(resolve),
    }
}
