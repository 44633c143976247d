//! The replies an ingress bridge owes: at most one of each kind waits, and none is longer than its
//! request. It decides neither what is accepted nor what is refused.

use hil_core::time::Instant;

use super::{IngressSettings, REFUSAL_REPLY_PERIOD, Reply, Request};
use crate::body::{
    HELLO_ACK_BODY_BYTES, HelloAck, HelloStatus, PIECE_ACK_BODY_BYTES, PieceAck, SYNC_BODY_BYTES,
    SyncResponse,
};
use crate::counts;
use crate::stamps::ArrivalStamps;
use crate::wire::{FollowUpField, HEADER_BYTES, Header, Kind};

const BUFFER_BYTES: usize = HEADER_BYTES + HELLO_ACK_BODY_BYTES;
const _: () = assert!(SYNC_BODY_BYTES == HELLO_ACK_BODY_BYTES);

counts! {
    /// What became of the replies.
    pub struct ReplyCounts {
        /// Replies given to the owner.
        sent_count,
        /// Replies that a later one of their kind replaced before they were polled.
        replaced_count,
        /// Replies withheld because the last one of their kind was too recent.
        rate_limited_count,
        /// Replies withheld because they would have been longer than their request.
        amplifying_count,
    }
}

/// What a reply repeats of its request.
#[derive(Debug, Clone, Copy)]
struct Owed {
    now: Instant,
    arrival: ArrivalStamps,
    session: u32,
    sequence: u64,
    handed_ns: i64,
}

impl Owed {
    const fn to(request: Request<'_>) -> Self {
        Self {
            now: request.now,
            arrival: request.arrival,
            session: request.header.session,
            sequence: request.header.sequence,
            handed_ns: request.header.handed_ns,
        }
    }
}

#[derive(Debug)]
pub(super) struct Replies {
    session: u32,
    domain: [u8; 16],
    clock_id: u64,
    flow: u16,
    digest: u64,
    buffer: [u8; BUFFER_BYTES],
    ack: Option<(HelloStatus, Owed)>,
    sync: Option<Owed>,
    piece: Option<Owed>,
    follow_up: Option<FollowUpField>,
    refused_at: Option<Instant>,
    counts: ReplyCounts,
}

impl Replies {
    pub(super) fn new(settings: &IngressSettings) -> Self {
        Self {
            session: settings.session,
            domain: settings.domain,
            clock_id: settings.clock_id,
            flow: settings.flow.flow,
            digest: settings.flow.digest(),
            buffer: [0; BUFFER_BYTES],
            ack: None,
            sync: None,
            piece: None,
            follow_up: None,
            refused_at: None,
            counts: ReplyCounts::default(),
        }
    }

    pub(super) fn acknowledge(&mut self, request: Request<'_>, status: HelloStatus) {
        if request.length_bytes < HEADER_BYTES + HELLO_ACK_BODY_BYTES {
            self.counts.amplifying_count += 1;
            return;
        }
        if status != HelloStatus::Accepted {
            let is_recent = |at: Instant| request.now < at + REFUSAL_REPLY_PERIOD;
            if self.refused_at.is_some_and(is_recent) {
                self.counts.rate_limited_count += 1;
                return;
            }
            self.refused_at = Some(request.now);
        }
        let replaced = self.ack.replace((status, Owed::to(request)));
        self.counts.replaced_count += u64::from(replaced.is_some());
    }

    /// A request of this kind is as long as its response, so there is nothing to withhold.
    pub(super) fn answer(&mut self, request: Request<'_>) {
        let replaced = self.sync.replace(Owed::to(request));
        self.counts.replaced_count += u64::from(replaced.is_some());
    }

    pub(super) fn acknowledge_piece(&mut self, request: Request<'_>) {
        if request.length_bytes < HEADER_BYTES + PIECE_ACK_BODY_BYTES {
            self.counts.amplifying_count += 1;
            return;
        }
        let replaced = self.piece.replace(Owed::to(request));
        self.counts.replaced_count += u64::from(replaced.is_some());
    }

    pub(super) fn set_transmit_stamp(&mut self, sequence: u64, handed_to_tx_ns: i64) {
        // u32::MAX stands for none on the wire.
        let delta = u32::try_from(handed_to_tx_ns).ok();
        let delta = delta.filter(|&delta| delta != u32::MAX);
        self.follow_up = delta.map(|delta| FollowUpField::new(sequence, delta));
    }

    pub(super) fn forget_transmit_stamp(&mut self) {
        self.follow_up = None;
    }

    pub(super) fn waiting_since(&self) -> Option<Instant> {
        let ack = self.ack.map(|(_, owed)| owed);
        let all = [ack, self.sync, self.piece].into_iter().flatten();
        all.map(|owed| owed.now).min()
    }

    pub(super) fn next(&mut self, now: Instant) -> Option<Reply<'_>> {
        let body = &mut self.buffer[HEADER_BYTES..];
        let (kind, owed, body_bytes) = if let Some((status, owed)) = self.ack.take() {
            let ack = HelloAck {
                status,
                session: self.session,
                clock_id: self.clock_id,
                domain: self.domain,
                answers_handed_ns: owed.handed_ns,
            };
            (Kind::HelloAck, owed, ack.encode(body))
        } else if let Some(owed) = self.sync.take() {
            let response = SyncResponse {
                t1_ns: owed.handed_ns,
                t2_ns: owed.arrival.received_ns,
                t3_ns: now.as_ns(),
                t2_source: owed.arrival.received_source,
            };
            (Kind::SyncResponse, owed, response.encode(body))
        } else {
            let owed = self.piece.take()?;
            let ack = PieceAck {
                answers_handed_ns: owed.handed_ns,
            };
            (Kind::PieceAck, owed, ack.encode(body))
        };
        let mut header = Header::new(kind, owed.session, self.flow);
        header.sequence = owed.sequence;
        header.handed_ns = now.as_ns();
        header.type_hash = self.digest;
        header.total_len = u32::try_from(body_bytes).expect("a body is below 1 KiB");
        if kind == Kind::SyncResponse {
            header.follow_up = self.follow_up.take();
        }
        header.encode(&mut self.buffer);
        self.counts.sent_count += 1;
        Some(Reply {
            datagram: &self.buffer[..HEADER_BYTES + body_bytes],
            kind,
            sequence: owed.sequence,
            destination: owed.arrival.peer,
        })
    }

    pub(super) const fn counts(&self) -> &ReplyCounts {
        &self.counts
    }
}
