//! A flow without channels, which is what a clock path is to the protocol: nothing but greetings,
//! clock exchanges and a farewell, in the datagrams there are.

use core::time::Duration;

use hil_core::time::Instant;

use super::golden::bytes;
use crate::channel::FlowIdentity;
use crate::egress::{EgressBridge, EgressEvent, EgressSettings, PeerState};
use crate::ingress::{Disposition, IngressBridge, IngressSettings};
use crate::lab::{InMemory, rtt_ns};
use crate::refusal::Refusal;
use crate::stamps::{ArrivalStamps, StampSource};
use crate::wire::{HEADER_BYTES, Header, Kind};

const PERIOD: Duration = Duration::from_millis(10);
/// Of the asking host's clock against the answering one's.
const OFFSET_NS: i64 = 5_000_000_000;
const DELAY_NS: i64 = 20_000;
const DEPARTURE_NS: i64 = 300;

fn flow() -> FlowIdentity {
    FlowIdentity {
        flow: 65_535,
        name: "clock/a-b".to_owned(),
        channels: Vec::new(),
    }
}

fn pair() -> (EgressBridge, IngressBridge) {
    let egress = EgressBridge::new(EgressSettings {
        flow: flow(),
        session: 0x0403_0201,
        domain: [1; 16],
        clock_id: 11,
        datagram_max_bytes: 576 - 28,
        sync_period: PERIOD,
    });
    let ingress = IngressBridge::new(IngressSettings::new(flow(), 7, [2; 16], 22));
    (egress.unwrap(), ingress.unwrap())
}

fn arrival(received_ns: i64) -> ArrivalStamps {
    ArrivalStamps {
        received_ns,
        received_source: StampSource::KernelSoftware,
        peer: None,
    }
}

#[test]
fn its_greeting_has_these_bytes() {
    let (mut egress, _) = pair();
    let hello = egress.poll_transmit(Instant::from_ns(0x0d)).unwrap();
    // What the digest of no channels is: the offset basis of FNV-1a.
    let hash = "25232284e49cf2cb";
    let ones = "01".repeat(16);
    let expected = format!(
        "48494c47 02 04 0000 01020304 ffff 4800 0000000000000000
         {hash} 0000000000000000 0d00000000000000
         00000000 ffffffff 32000000 0000 0100 00000000 00000000
         {ones} 0b00000000000000 0000
         0000000000000000000000000000 09 636c6f636b2f612d62"
    );
    assert_eq!(hello.datagram, bytes(&expected));
}

#[test]
fn it_exchanges_clocks_every_period_with_all_four_stamps_of_the_kernel() {
    let (mut egress, mut ingress) = pair();
    let mut refined = Vec::new();
    for step in 0..1_000_i64 {
        let now_ns = 1_000_000_000 + step * 1_000_000;
        let now = Instant::from_ns(now_ns + OFFSET_NS);
        while let Some(transmit) = egress.poll_transmit(now) {
            let key = transmit.key;
            assert_ne!(key.kind, Kind::Data);
            let there_ns = now_ns + DEPARTURE_NS + DELAY_NS;
            let taken = ingress.on_datagram(
                Instant::from_ns(there_ns),
                arrival(there_ns),
                transmit.datagram,
                &mut InMemory::default().with(|_, _| panic!("no message")),
            );
            taken.unwrap();
            egress.on_transmit_stamp(key, DEPARTURE_NS);
            let reply = ingress.poll_transmit(Instant::from_ns(there_ns)).unwrap();
            let (kind, sequence) = (reply.kind, reply.sequence);
            let back_ns = there_ns + DEPARTURE_NS + DELAY_NS + OFFSET_NS;
            let heard = egress
                .on_datagram(Instant::from_ns(back_ns), arrival(back_ns), reply.datagram)
                .unwrap();
            ingress.on_transmit_stamp(kind, sequence, DEPARTURE_NS);
            if let EgressEvent::RoundTrip { earlier, .. } = heard {
                refined.extend(earlier);
            }
        }
    }
    assert_eq!(egress.peer_state(), PeerState::Established);
    // A second of them, the last of which waits for the next.
    assert!((98..=100).contains(&refined.len()), "{}", refined.len());
    for one in &refined {
        let sources = [one.t1_source, one.t2_source, one.t3_source, one.t4_source];
        assert_eq!(sources, [StampSource::KernelSoftware; 4]);
        assert_eq!(rtt_ns(one), 2 * DELAY_NS);
        assert_eq!(one.t1_ns - (one.t2_ns - DELAY_NS), OFFSET_NS);
    }
    assert_eq!(egress.refusals().total(), 0);
    assert_eq!(ingress.refusals().total(), 0);
}

#[test]
fn a_message_has_no_room_on_it() {
    let (mut egress, mut ingress) = pair();
    let now = Instant::from_ns(1_000_000);
    let hello = egress.poll_transmit(now).unwrap().datagram;
    let greeted = ingress.on_datagram(
        now,
        arrival(1_000_000),
        hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    assert!(matches!(greeted, Ok(Disposition::Greeted { .. })));
    let mut header = Header::new(Kind::Data, 0x0403_0201, 65_535);
    header.type_hash = flow().digest();
    header.handed_ns = 1_000_000;
    header.total_len = 1;
    let mut datagram = vec![0; HEADER_BYTES + 1];
    header.encode(&mut datagram);
    let refused = ingress.on_datagram(
        now,
        arrival(1_000_000),
        &datagram,
        &mut InMemory::default().with(|_, _| panic!("no message")),
    );
    assert_eq!(refused, Err(Refusal::UnknownChannel));
}
