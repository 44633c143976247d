//! Encodes the datagrams of an egress bridge into buffers set aside. When each is due is decided in
//! the parent module.

use hil_core::time::Instant;

use super::{EgressBridge, HELLO_PERIOD, HELLO_PERIOD_REFUSED, LastTransmit, PeerState, Transmit};
use crate::body::SYNC_BODY_BYTES;
use crate::wire::{HEADER_BYTES, Header, Kind};

impl EgressBridge {
    pub(super) fn transmit_data(&mut self, now: Instant) -> Transmit<'_> {
        let (header, is_last_fragment, datagram) = self.staging.next(now);
        self.counts.datagram_count += 1;
        self.counts.sent_count += u64::from(is_last_fragment);
        self.last_transmit = Some(LastTransmit {
            kind: Kind::Data,
            is_last_fragment,
        });
        Transmit {
            datagram,
            kind: Kind::Data,
            sequence: header.sequence,
            message: Some((header.epoch, header.sequence)),
            is_last_fragment,
        }
    }

    pub(super) fn transmit_hello(&mut self, now: Instant) -> Transmit<'_> {
        let period = match self.state {
            PeerState::Refused(_) => HELLO_PERIOD_REFUSED,
            _ => HELLO_PERIOD,
        };
        self.hello_due = now + period;
        self.round_started_ns.get_or_insert(now.as_ns());
        let sequence = self.hello_sequence;
        self.hello_sequence += 1;
        self.counts.hello_sent_count += 1;
        let hello = self.settings.hello();
        let body_bytes = hello.encode(&mut self.control[HEADER_BYTES..]);
        self.transmit_control(now, Kind::Hello, 0, sequence, body_bytes)
    }

    pub(super) fn transmit_sync(&mut self, now: Instant) -> Transmit<'_> {
        let sequence = self.sync_sequence;
        self.sync_sequence += 1;
        self.counts.sync_sent_count += 1;
        self.exchanges.open(sequence, now.as_ns());
        self.control[HEADER_BYTES..][..SYNC_BODY_BYTES].fill(0);
        self.transmit_control(now, Kind::SyncRequest, 0, sequence, SYNC_BODY_BYTES)
    }

    pub(super) fn transmit_bye(&mut self, now: Instant) -> Transmit<'_> {
        let (epoch, next) = match self.last_message {
            Some((epoch, sequence)) => (epoch, sequence.saturating_add(1)),
            None => (0, 0),
        };
        self.transmit_control(now, Kind::Bye, epoch, next, 0)
    }

    fn transmit_control(
        &mut self,
        now: Instant,
        kind: Kind,
        epoch: u32,
        sequence: u64,
        body_bytes: usize,
    ) -> Transmit<'_> {
        let mut header = Header::new(kind, self.settings.session, self.settings.channel.channel);
        header.type_hash = self.settings.channel.type_hash;
        header.epoch = epoch;
        header.sequence = sequence;
        header.handed_ns = now.as_ns();
        header.total_len = u32::try_from(body_bytes).expect("a body is below 1 KiB");
        header.encode(&mut self.control);
        self.counts.datagram_count += 1;
        self.last_transmit = Some(LastTransmit {
            kind,
            is_last_fragment: true,
        });
        Transmit {
            datagram: &self.control[..HEADER_BYTES + body_bytes],
            kind,
            sequence,
            message: None,
            is_last_fragment: true,
        }
    }
}
