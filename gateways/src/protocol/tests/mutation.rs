//! 100 000 mutated datagrams for each decoder: nothing panics, and each one is accepted or refused
//! and counted.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use core::time::Duration;

use hil_models::message::Envelope;
use hil_models::random::RandomStream;
use hil_models::time::Instant;

use super::network::{Lab, egress_settings, ingress_settings};
use crate::protocol::body::HelloStatus;
use crate::protocol::egress::EgressBridge;
use crate::protocol::fragment::{Fragment, Reassembler};
use crate::protocol::ingress::IngressBridge;
use crate::protocol::refusal::{Refusal, RefusalCounts};
use crate::protocol::sequence::Stream;
use crate::protocol::stamps::ArrivalStamps;
use crate::protocol::wire::{Kind, decode};

const CASES: u64 = 100_000;
const NOW_NS: i64 = 50_000_000_000;
const GATEWAY: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 1)), 9);
const STRANGER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 7)), 9);

/// One of `valid`: flips, cuts, lengthens, overwrites and splices; sometimes leaves the datagram alone.
fn mutate(random: &mut RandomStream, valid: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = pick(random, valid).to_vec();
    for _ in 0..random.next_u64() % 4 {
        let length = bytes.len().max(1) as u64;
        let at = usize::try_from(random.next_u64() % length).unwrap();
        let value = random.next_u64().to_le_bytes();
        match random.next_u64() % 7 {
            0 => bytes.truncate(at),
            1 => bytes.extend_from_slice(&value),
            2 | 3 if !bytes.is_empty() => bytes[at] ^= 1 << (value[0] % 8),
            4 if !bytes.is_empty() => {
                let edges = [0, 1, 0x7f, 0x80, 0xff, value[0]];
                bytes[at] = edges[usize::from(value[1] % 6)];
            }
            5 => {
                let end = (at + 8).min(bytes.len());
                bytes[at.min(end)..end].copy_from_slice(&value[..end - at.min(end)]);
            }
            _ => {
                let end = (at + usize::from(value[0])).min(bytes.len());
                bytes.drain(at.min(end)..end);
            }
        }
    }
    bytes
}

/// One valid datagram of every kind, as the bridges themselves make them.
struct Corpus {
    forward: Vec<Vec<u8>>,
    backward: Vec<Vec<u8>>,
}

fn established() -> (EgressBridge, IngressBridge, Corpus) {
    let mut egress = EgressBridge::new(egress_settings(100, 4000)).unwrap();
    let mut ingress = IngressBridge::new(ingress_settings(200, 4000)).unwrap();
    let now = Instant::from_ns(NOW_NS);
    let mut corpus = Corpus {
        forward: Vec::new(),
        backward: Vec::new(),
    };
    let arrival = ArrivalStamps {
        peer: Some(GATEWAY),
        ..ArrivalStamps::application(NOW_NS)
    };
    for length in [0, 8, 64, 4000, 4000] {
        let envelope = Envelope {
            sequence: corpus.forward.len() as u64,
            published_ns: NOW_NS - 5,
            epoch: 1,
            ..Envelope::default()
        };
        let _not_greeted_at_first = egress.on_local(now, &envelope, &Lab::payload(1, length));
        while let Some(transmit) = egress.poll_transmit(now) {
            let (kind, sequence) = (transmit.kind, transmit.sequence);
            corpus.forward.push(transmit.datagram.to_vec());
            egress.on_transmit_stamp(kind, sequence, 900);
        }
        for bytes in &corpus.forward {
            let _repeated = ingress.on_datagram(now, arrival, bytes, &mut |_| {});
            while let Some(reply) = ingress.poll_transmit(now) {
                corpus.backward.push(reply.datagram.to_vec());
            }
        }
        for bytes in &corpus.backward {
            let _repeated = egress.on_datagram(now, arrival, bytes);
        }
    }
    egress.bye();
    corpus
        .forward
        .push(egress.poll_transmit(now).unwrap().datagram.to_vec());
    (egress, ingress, corpus)
}

fn of_kind(corpus: &Corpus, kind: Kind) -> Vec<Vec<u8>> {
    let all = corpus.forward.iter().chain(&corpus.backward);
    all.filter(|bytes| bytes[5] == kind as u8)
        .cloned()
        .collect()
}

/// A message of 5000 bytes on a channel of 4000.
fn oversize(corpus: &Corpus) -> Vec<u8> {
    let mut bytes = of_kind(corpus, Kind::Data).remove(0);
    bytes[56..60].copy_from_slice(&5000_u32.to_le_bytes());
    bytes[60..64].copy_from_slice(&[0, 0, 1, 0]);
    bytes.resize(72 + 5000, 0);
    bytes
}

/// A greeting from the receiver's own shared-memory domain.
fn of_shared_domain(corpus: &Corpus) -> Vec<u8> {
    let mut bytes = of_kind(corpus, Kind::Hello).remove(0);
    bytes[72..88].fill(2);
    bytes
}

fn pick<'a>(random: &mut RandomStream, from: &'a [Vec<u8>]) -> &'a [u8] {
    &from[usize::try_from(random.next_u64() % from.len() as u64).unwrap()]
}

#[test]
fn the_corpus_has_every_kind() {
    let (_, _, corpus) = established();
    for kind in [
        Kind::Data,
        Kind::SyncRequest,
        Kind::SyncResponse,
        Kind::Hello,
        Kind::HelloAck,
        Kind::Bye,
    ] {
        let valid = of_kind(&corpus, kind);
        assert!(!valid.is_empty(), "{kind:?}");
        assert!(
            valid
                .iter()
                .all(|bytes| decode(bytes).unwrap().header.kind == kind)
        );
    }
}

#[test]
fn every_decoder_survives_and_accounts_for_mutated_datagrams() {
    let (_, _, corpus) = established();
    for kind in [
        Kind::Data,
        Kind::SyncRequest,
        Kind::SyncResponse,
        Kind::Hello,
        Kind::HelloAck,
        Kind::Bye,
    ] {
        let mut random = RandomStream::new(kind as u64, "decoder mutation");
        let valid = of_kind(&corpus, kind);
        let (mut accepted, mut refused) = (0, RefusalCounts::default());
        for _ in 0..CASES {
            let bytes = mutate(&mut random, &valid);
            match decode(&bytes) {
                Ok(datagram) => {
                    assert!(datagram.header.total_len as usize >= bytes.len() - 72);
                    accepted += 1;
                }
                Err(refusal) => refused.count(refusal),
            }
        }
        assert_eq!(accepted + refused.total(), CASES, "{kind:?}");
        assert!(
            accepted > 0 && refused.total() > CASES / 10,
            "{kind:?} {refused:?}"
        );
    }
}

#[test]
fn reassembly_survives_and_accounts_for_any_fragment_fields() {
    let mut random = RandomStream::new(1, "reassembly mutation");
    let mut reassembler = Reassembler::new(4, 4000, Duration::from_millis(1));
    let storage = vec![7; 5000];
    let (mut stored, mut whole, mut refused) = (0, 0, RefusalCounts::default());
    for case in 0..CASES {
        let mut small = |bound: u64| random.next_u64() % bound;
        let total_len = u32::try_from(small(4100)).unwrap();
        let count = u16::try_from(small(6)).unwrap();
        let piece = usize::from(count).max(1);
        let guess = (total_len as usize).div_ceil(piece);
        let length = if small(10) == 0 {
            small(5000)
        } else {
            guess as u64
        };
        let fragment = Fragment {
            stream: Stream {
                session: 1,
                epoch: u32::try_from(small(2)).unwrap(),
            },
            sequence: small(8),
            total_len: if small(50) == 0 {
                u32::MAX
            } else {
                total_len - total_len % 5
            },
            index: u16::try_from(small(6)).unwrap(),
            count: if small(50) == 0 { u16::MAX } else { count },
            handed_ns: i64::MIN,
            payload: &storage[..usize::try_from(length).unwrap()],
        };
        let now = Instant::from_ns(i64::try_from(case * 1000).unwrap());
        match reassembler.insert(now, &fragment) {
            Ok(None) => stored += 1,
            Ok(Some(assembled)) => {
                assert_eq!(assembled.payload.len(), fragment.total_len as usize);
                whole += 1;
            }
            Err(refusal) => refused.count(refusal),
        }
    }
    assert_eq!(stored + whole + refused.total(), CASES);
    assert!(stored > 0 && whole > 0 && refused.total() > 0);
    let counts = *reassembler.counts();
    let open = reassembler.open_count() as u64;
    assert_eq!(counts.completed_count, whole);
    assert_eq!(
        counts.started_count,
        counts.completed_count + counts.evicted_count + counts.timed_out_count + open
    );
}

#[test]
fn an_ingress_bridge_survives_and_accounts_for_mutated_datagrams() {
    let mut all = RefusalCounts::default();
    for seed in 0..10 {
        let (_, mut ingress, mut corpus) = established();
        corpus
            .forward
            .extend([oversize(&corpus), of_shared_domain(&corpus)]);
        let mut random = RandomStream::new(seed, "ingress mutation");
        let before = ingress.counts().datagram_count;
        for case in 0..CASES / 10 {
            let now_ns = NOW_NS + i64::try_from(case * 100_000).unwrap();
            let source = if random.chance(0.9) {
                &corpus.forward
            } else {
                &corpus.backward
            };
            let bytes = mutate(&mut random, source);
            let arrival = ArrivalStamps {
                peer: Some(if random.chance(0.01) {
                    STRANGER
                } else {
                    GATEWAY
                }),
                ..ArrivalStamps::application(now_ns)
            };
            let now = Instant::from_ns(now_ns);
            let result = ingress.on_datagram(now, arrival, &bytes, &mut |delivery| {
                assert!(delivery.payload.len() <= 4000);
            });
            if let Err(refusal) = result {
                all.count(refusal);
            }
            while let Some(reply) = ingress.poll_transmit(now) {
                assert!(reply.datagram.len() <= bytes.len(), "a reply amplifies");
                decode(reply.datagram).unwrap();
            }
        }
        let counts = *ingress.counts();
        assert_eq!(counts.datagram_count - before, CASES / 10);
        let refused = ingress.refusals().total();
        assert_eq!(
            counts.datagram_count,
            counts.accepted_count() + refused,
            "seed {seed}"
        );
        ingress.finish();
    }
    // The mutations reach far enough to try nearly every refusal.
    let untried: Vec<_> = all
        .iter()
        .filter(|(_, n)| *n == 0)
        .map(|(name, _)| name)
        .collect();
    let expected = [Refusal::SharedDomain, Refusal::Unsolicited].map(Refusal::name);
    assert!(
        untried.iter().all(|name| expected.contains(name)),
        "{untried:?}"
    );
}

#[test]
fn an_egress_bridge_survives_and_accounts_for_mutated_datagrams() {
    for seed in 0..10 {
        let (_, mut ingress, corpus) = established();
        let mut egress = EgressBridge::new(egress_settings(100, 4000)).unwrap();
        let mut random = RandomStream::new(seed, "egress mutation");
        let mut latest = Vec::new();
        let mut statuses = [0_u64; 7];
        for case in 0..CASES / 10 {
            let now_ns = NOW_NS + i64::try_from(case * 100_000).unwrap();
            let now = Instant::from_ns(now_ns);
            let arrival = ArrivalStamps::application(now_ns);
            while let Some(transmit) = egress.poll_transmit(now) {
                let _refused = ingress.on_datagram(now, arrival, transmit.datagram, &mut |_| {});
                while let Some(reply) = ingress.poll_transmit(now) {
                    latest.push(reply.datagram.to_vec());
                }
            }
            let keep_from = latest.len().saturating_sub(4);
            latest.drain(..keep_from);
            let source = match random.next_u64() % 8 {
                0 => &corpus.backward,
                1 => &corpus.forward,
                _ => &latest,
            };
            let mut bytes = mutate(&mut random, source);
            if random.chance(0.02) && bytes.len() > 72 && bytes[5] == Kind::HelloAck as u8 {
                bytes[72] = random.next_u64().to_le_bytes()[0] % 7;
                statuses[usize::from(bytes[72])] += 1;
            }
            let _either_is_counted = egress.on_datagram(now, arrival, &bytes);
            let envelope = Envelope {
                sequence: case,
                published_ns: now_ns,
                ..Envelope::default()
            };
            let _refusals_are_counted = egress.on_local(now, &envelope, &[0; 16]);
        }
        let counts = *egress.counts();
        assert_eq!(counts.reply_count, CASES / 10);
        let refused = egress.refusals().total();
        assert_eq!(
            counts.reply_count,
            counts.reply_accepted_count + refused,
            "seed {seed}"
        );
        assert!(
            counts.reply_accepted_count > 0 && refused > 0,
            "seed {seed}"
        );
        assert!(counts.sent_count > 0);
        assert!(statuses[HelloStatus::GreetAgain as usize] > 0);
    }
}
