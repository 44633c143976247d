//! What an observer hears of a run, one thing at a time.

use bytemuck::Pod;
use hil_account::{MessageName, RecordEvent};
use hil_core::message::Envelope;
use hil_core::record::{EgressRecord, IngressRecord, PublishedRecord, TakenRecord};
use hil_link::condition::LinkConditionRecord;

use super::feed::WatchedChannel;
use super::follow::Batch;
use hil_rundir::record::RecordKind;

/// Something that happened in a run. Messages and records of one process and kind come in order;
/// otherwise the order is roughly that of time, and what a process wrote comes up to 20 ms later.
#[derive(Debug)]
pub enum Event<'a> {
    /// A message, each once.
    Message {
        /// Its channel.
        channel: &'a WatchedChannel,
        /// Where it was read.
        origin: Origin,
        /// Its number and times.
        envelope: &'a Envelope,
        /// The message as it lies in memory.
        payload: &'a [u8],
    },
    /// What a process noted beside a message.
    Record {
        /// The channel, as record files name it.
        channel: &'a str,
        /// True when the process runs on this host; else it came at the end, from another one.
        is_of_this_host: bool,
        /// What.
        record: Record,
    },
    /// Something could not be read; it is said once.
    Problem(&'a str),
    /// No more messages: all processes have ended, all records have been given out, also those
    /// that other hosts sent at the end.
    Silent,
    /// The supervisor is done; the last event.
    Ended {
        /// The run's account is in its folder. A killed supervisor leaves none.
        has_summary: bool,
    },
}

/// Where a message was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// From the records of its producer, which runs here.
    Records,
    /// From shared memory.
    SharedMemory,
    /// From the records that another host sent at the end of the run: a message that never came
    /// here, or came before anybody looked.
    OtherHost,
}

/// A record of the way of a message, or of an order to a link.
#[derive(Debug, Clone, Copy)]
pub enum Record {
    /// A producer published.
    Published(PublishedRecord),
    /// A consumer took.
    Taken(TakenRecord),
    /// A gateway sent.
    Egress(EgressRecord),
    /// A gateway received.
    Ingress(IngressRecord),
    /// An emulated link was given an order; the channel is `hil/link/<link>/<direction>`.
    LinkCondition(LinkConditionRecord),
}

impl Record {
    /// The message that it is of; `None` of an order to a link.
    pub fn message(&self) -> Option<MessageName> {
        self.of_message().map(|event| event.message())
    }

    /// The record as the account of its channel takes it; `None` of an order to a link.
    pub(crate) const fn of_message(&self) -> Option<RecordEvent> {
        match *self {
            Self::Published(record) => Some(RecordEvent::Published(record)),
            Self::Taken(record) => Some(RecordEvent::Taken(record)),
            Self::Egress(record) => Some(RecordEvent::Egress(record)),
            Self::Ingress(record) => Some(RecordEvent::Ingress(record)),
            Self::LinkCondition(_) => None,
        }
    }

    /// The records of a batch, in order; none of a batch of another kind.
    pub(super) fn each(batch: &Batch<'_>, take: &mut dyn FnMut(Self)) {
        fn all<R: Pod>(batch: &Batch<'_>, of: fn(R) -> Record, take: &mut dyn FnMut(Record)) {
            batch.records().map(of).for_each(take);
        }
        match batch.header.kind {
            RecordKind::Published => all(batch, Self::Published, take),
            RecordKind::Taken => all(batch, Self::Taken, take),
            RecordKind::Egress => all(batch, Self::Egress, take),
            RecordKind::Ingress => all(batch, Self::Ingress, take),
            RecordKind::LinkCondition => all(batch, Self::LinkCondition, take),
            _ => {}
        }
    }
}
