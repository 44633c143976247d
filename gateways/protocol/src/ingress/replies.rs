//! The replies an ingress bridge owes: at most one of each kind waits, and none is longer than its
//! request. It decides neither what is accepted nor what is refused.

use core::net::SocketAddr;

use hil_core::time::Instant;

use super::{IngressSettings, REFUSAL_REPLY_PERIOD, Reply};
use crate::body::{
    HELLO_ACK_BODY_BYTES, HelloAck, HelloStatus, PIECE_ACK_BODY_BYTES, PieceAck, SYNC_BODY_BYTES,
    SyncResponse,
};
use crate::counts;
use crate::stamps::StampSource;
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

#[derive(Debug, Clone, Copy)]
pub(super) struct AckRequest {
    pub(super) now: Instant,
    pub(super) status: HelloStatus,
    pub(super) session: u32,
    pub(super) flow: u16,
    pub(super) sequence: u64,
    pub(super) answers_handed_ns: i64,
    pub(super) request_bytes: usize,
    pub(super) destination: Option<SocketAddr>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct SyncRequest {
    pub(super) now: Instant,
    pub(super) session: u32,
    pub(super) sequence: u64,
    pub(super) t1_ns: i64,
    pub(super) t2_ns: i64,
    pub(super) t2_source: StampSource,
    pub(super) destination: Option<SocketAddr>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct PieceRequest {
    pub(super) now: Instant,
    pub(super) session: u32,
    pub(super) sequence: u64,
    pub(super) answers_handed_ns: i64,
    pub(super) request_bytes: usize,
    pub(super) destination: Option<SocketAddr>,
}

#[derive(Debug)]
pub(super) struct Replies {
    session: u32,
    domain: [u8; 16],
    clock_id: u64,
    flow: u16,
    digest: u64,
    buffer: [u8; BUFFER_BYTES],
    ack: Option<AckRequest>,
    sync: Option<SyncRequest>,
    piece: Option<PieceRequest>,
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

    pub(super) fn acknowledge(&mut self, request: &AckRequest) {
        if request.request_bytes < HEADER_BYTES + HELLO_ACK_BODY_BYTES {
            self.counts.amplifying_count += 1;
            return;
        }
        if request.status != HelloStatus::Accepted {
            let is_recent = |at: Instant| request.now < at + REFUSAL_REPLY_PERIOD;
            if self.refused_at.is_some_and(is_recent) {
                self.counts.rate_limited_count += 1;
                return;
            }
            self.refused_at = Some(request.now);
        }
        let replaced = self.ack.replace(*request);
        self.counts.replaced_count += u64::from(replaced.is_some());
    }

    /// A request of this kind is as long as its response, so there is nothing to withhold.
    pub(super) fn answer(&mut self, request: &SyncRequest) {
        let replaced = self.sync.replace(*request);
        self.counts.replaced_count += u64::from(replaced.is_some());
    }

    pub(super) fn acknowledge_piece(&mut self, request: &PieceRequest) {
        if request.request_bytes < HEADER_BYTES + PIECE_ACK_BODY_BYTES {
            self.counts.amplifying_count += 1;
            return;
        }
        let replaced = self.piece.replace(*request);
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
        let ack = self.ack.as_ref().map(|request| request.now);
        let sync = self.sync.as_ref().map(|request| request.now);
        let piece = self.piece.as_ref().map(|request| request.now);
        ack.into_iter().chain(sync).chain(piece).min()
    }

    pub(super) fn next(&mut self, now: Instant) -> Option<Reply<'_>> {
        if let Some(request) = self.ack.take() {
            return Some(self.hello_ack(now, &request));
        }
        if let Some(request) = self.sync.take() {
            return Some(self.sync_response(now, &request));
        }
        let request = self.piece.take()?;
        Some(self.piece_ack(now, &request))
    }

    fn hello_ack(&mut self, now: Instant, request: &AckRequest) -> Reply<'_> {
        let body = HelloAck {
            status: request.status,
            session: self.session,
            clock_id: self.clock_id,
            domain: self.domain,
            answers_handed_ns: request.answers_handed_ns,
        };
        let length = body.encode(&mut self.buffer[HEADER_BYTES..]);
        let mut header = Header::new(Kind::HelloAck, request.session, request.flow);
        header.sequence = request.sequence;
        header.handed_ns = now.as_ns();
        self.reply(header, length, request.destination)
    }

    fn sync_response(&mut self, now: Instant, request: &SyncRequest) -> Reply<'_> {
        let body = SyncResponse {
            t1_ns: request.t1_ns,
            t2_ns: request.t2_ns,
            t3_ns: now.as_ns(),
            t2_source: request.t2_source,
        };
        let length = body.encode(&mut self.buffer[HEADER_BYTES..]);
        let mut header = Header::new(Kind::SyncResponse, request.session, self.flow);
        header.sequence = request.sequence;
        header.handed_ns = now.as_ns();
        header.follow_up = self.follow_up.take();
        self.reply(header, length, request.destination)
    }

    fn piece_ack(&mut self, now: Instant, request: &PieceRequest) -> Reply<'_> {
        let body = PieceAck {
            answers_handed_ns: request.answers_handed_ns,
        };
        let length = body.encode(&mut self.buffer[HEADER_BYTES..]);
        let mut header = Header::new(Kind::PieceAck, request.session, self.flow);
        header.sequence = request.sequence;
        header.handed_ns = now.as_ns();
        self.reply(header, length, request.destination)
    }

    fn reply(
        &mut self,
        mut header: Header,
        body_bytes: usize,
        destination: Option<SocketAddr>,
    ) -> Reply<'_> {
        header.type_hash = self.digest;
        header.total_len = u32::try_from(body_bytes).expect("a body is below 1 KiB");
        header.encode(&mut self.buffer);
        self.counts.sent_count += 1;
        Reply {
            datagram: &self.buffer[..HEADER_BYTES + body_bytes],
            kind: header.kind,
            sequence: header.sequence,
            destination,
        }
    }

    pub(super) const fn counts(&self) -> &ReplyCounts {
        &self.counts
    }
}
