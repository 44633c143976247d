//! Encodes the datagrams of an egress bridge into buffers set aside. When each is due is decided in
//! the parent module.

use hil_core::time::Instant;

use super::{
    BARE_AFTER, EgressBridge, Farewell, HELLO_PERIOD, HELLO_PERIOD_REFUSED, LastTransmit,
    PeerState, Transmit, TransmitKey,
};
use crate::body::SYNC_BODY_BYTES;
use crate::egress::staging::Piece;
use crate::wire::{HEADER_BYTES, Header, Kind, TAG_BYTES};

impl EgressBridge {
    pub(super) fn transmit_data(&mut self, now: Instant) -> Transmit<'_> {
        let Piece {
            channel,
            header,
            is_last: is_last_fragment,
            datagram,
        } = self.staging.next(now);
        self.counts.datagram_count += 1;
        let counts = &mut self.channels[channel].counts;
        counts.datagram_count += 1;
        counts.sent_count += u64::from(is_last_fragment);
        let key = TransmitKey {
            kind: Kind::Data,
            channel: Some(channel),
            epoch: Some(header.epoch),
            sequence: header.sequence,
        };
        self.last_transmit = Some(LastTransmit {
            key,
            is_last_fragment,
        });
        Transmit {
            datagram,
            key,
            is_last_fragment,
        }
    }

    pub(super) fn transmit_hello(&mut self, now: Instant) -> Transmit<'_> {
        let period = match self.state {
            PeerState::Refused(_) => HELLO_PERIOD_REFUSED,
            _ => HELLO_PERIOD,
        };
        self.round_started_ns.get_or_insert(now.as_ns());
        let sequence = self.hello_sequence;
        self.hello_sequence += 1;
        self.counts.hello_sent_count += 1;
        let (length, has_bare) = self.path.next_length(now.as_ns());
        self.hello_due = now + if has_bare { BARE_AFTER } else { period };
        let padded_bytes = length - HEADER_BYTES - TAG_BYTES;
        let hello = self.settings.hello();
        let own_bytes = hello.encode(&mut self.control[HEADER_BYTES..]);
        let body_bytes = own_bytes.max(padded_bytes);
        self.control[HEADER_BYTES + own_bytes..HEADER_BYTES + body_bytes].fill(0);
        let mut header = self.flow_header(Kind::Hello);
        header.sequence = sequence;
        self.transmit_control(now, header, body_bytes)
    }

    pub(super) fn transmit_sync(&mut self, now: Instant) -> Transmit<'_> {
        let sequence = self.sync_sequence;
        self.sync_sequence += 1;
        self.counts.sync_sent_count += 1;
        self.exchanges.open(sequence, now.as_ns());
        self.control[HEADER_BYTES..][..SYNC_BODY_BYTES].fill(0);
        let mut header = self.flow_header(Kind::SyncRequest);
        header.sequence = sequence;
        self.transmit_control(now, header, SYNC_BODY_BYTES)
    }

    /// The farewell of the next channel from `from` on that carried a message; once there is none, that
    /// of the flow.
    pub(super) fn transmit_bye(&mut self, now: Instant, from: usize) -> Transmit<'_> {
        let mut rest = self.channels.iter().enumerate().skip(from);
        let next = rest.find_map(|(index, channel)| Some((index, channel.last_message?)));
        let Some((index, (epoch, sequence))) = next else {
            self.farewell = Farewell::Said;
            let header = self.flow_header(Kind::Bye);
            return self.transmit_control(now, header, 0);
        };
        self.farewell = Farewell::Due { from: index + 1 };
        self.channels[index].counts.datagram_count += 1;
        let identity = &self.settings.flow.channels[index];
        let mut header = Header::new(Kind::Bye, self.settings.session, identity.channel);
        header.type_hash = identity.type_hash;
        header.epoch = epoch;
        header.sequence = sequence.saturating_add(1);
        self.transmit_control(now, header, 0)
    }

    /// Of a datagram that is about no channel.
    const fn flow_header(&self, kind: Kind) -> Header {
        let mut header = Header::new(kind, self.settings.session, self.settings.flow.flow);
        header.type_hash = self.digest;
        header
    }

    fn transmit_control(
        &mut self,
        now: Instant,
        mut header: Header,
        body_bytes: usize,
    ) -> Transmit<'_> {
        header.handed_ns = now.as_ns();
        header.total_len = u32::try_from(body_bytes).expect("a body is below 64 KiB");
        header.encode(&mut self.control);
        self.counts.datagram_count += 1;
        let key = TransmitKey {
            kind: header.kind,
            channel: None,
            epoch: None,
            sequence: header.sequence,
        };
        self.last_transmit = Some(LastTransmit {
            key,
            is_last_fragment: true,
        });
        Transmit {
            datagram: &self.control[..HEADER_BYTES + body_bytes],
            key,
            is_last_fragment: true,
        }
    }
}
