//! Keys go, and no datagram with them.

use hil_core::random::RandomStream;

use super::*;

const OFTEN: Rotation = Rotation {
    datagram_count: 100,
    period_ns: 1_000_000_000,
    grace_ns: 50_000_000,
};
const STEP_NS: i64 = 1_000_000;

#[test]
fn under_loss_and_reordering_every_datagram_that_arrives_is_opened() {
    for (seed, suite) in (0..).zip(SUITES) {
        let mut random = RandomStream::new(seed, "rotation");
        let mut pair = Pair::agreed(suite, OFTEN);
        let mut under_way: Vec<(u64, Vec<u8>)> = Vec::new();
        let mut arrived_count = 0_u64;
        for sequence in 0..20_000_u64 {
            let handed_ns = i64::try_from(sequence).unwrap() * STEP_NS;
            let datagram = plain(Kind::Data, sequence, handed_ns, &sequence.to_le_bytes());
            let sealed = pair.sealed(&datagram);
            if !random.chance(0.2) {
                // Overtaken by up to 20, which is less than the grace.
                under_way.push((sequence + random.next_u64() % 20, sealed));
            }
            under_way.sort_by_key(|one| one.0);
            let due = under_way.partition_point(|one| one.0 <= sequence);
            for (_, sealed) in under_way.drain(..due) {
                assert!(pair.open(sealed).is_ok());
                arrived_count += 1;
            }
        }
        assert_eq!(pair.sender.counts().rotation_count, 199);
        assert_eq!(pair.receiver.counts().rotation_count, 199);
        assert_eq!(pair.receiver.counts().opened_count, arrived_count);
        assert_eq!(pair.receiver.counts().refused.total(), 0);
    }
}

#[test]
fn a_slow_flow_rotates_by_time() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, OFTEN);
    for sequence in 0..50_u64 {
        let handed_ns = i64::try_from(sequence).unwrap() * 250_000_000;
        let sealed = pair.sealed(&plain(Kind::Data, sequence, handed_ns, &[1]));
        assert!(pair.open(sealed).is_ok());
    }
    assert_eq!(pair.receiver.counts().rotation_count, 12);
}

#[test]
fn an_old_key_is_taken_for_its_grace_and_no_longer() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, OFTEN);
    let mut at = 0;
    let mut seal = |pair: &mut Pair, count: usize| -> Vec<Vec<u8>> {
        let some = (0..count).map(|_| {
            at += STEP_NS;
            pair.sealed(&plain(Kind::Data, 0, at, &[1]))
        });
        some.collect()
    };
    let old = seal(&mut pair, 100);
    let new = seal(&mut pair, 60);
    assert!(pair.open(new[0].clone()).is_ok());
    assert!(pair.open(old[98].clone()).is_ok(), "within the grace");
    assert_eq!(pair.open(old[98].clone()), Err(SealRefusal::Replayed));
    assert!(pair.open(new[59].clone()).is_ok());
    assert_eq!(pair.open(old[99].clone()), Err(SealRefusal::StaleEpoch));
    // Forged generations move nothing.
    for generation in 0..=u8::MAX {
        let mut forged = new[30].clone();
        forged[7] = generation;
        forged[100 - 20] ^= 1;
        assert!(pair.open(forged).is_err());
    }
    assert!(pair.open(new[31].clone()).is_ok());
}

#[test]
fn an_outage_over_many_rotations_is_caught_up_by_the_next_request() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, OFTEN);
    let first = pair.sealed(&plain(Kind::Data, 0, 0, &[1]));
    assert!(pair.open(first).is_ok());
    for sequence in 1..1_050_u64 {
        pair.sealed(&plain(Kind::Data, sequence, 0, &[1]));
    }
    let lost = pair.sealed(&plain(Kind::Data, 1_050, 0, &[1]));
    assert_eq!(pair.open(lost), Err(SealRefusal::StaleEpoch));
    // A recorded request from before does not send it back, nor does a forged one send it anywhere.
    assert_eq!(pair.agree(), Heard::Nothing);
    let sealed = pair.sealed(&plain(Kind::Data, 1_051, 0, &[1]));
    assert!(pair.open(sealed).is_ok());
    assert_eq!(pair.receiver.counts().rotation_count, 10);
}

#[test]
fn the_replies_rotate_by_themselves() {
    let mut pair = Pair::agreed(Suite::ChaCha20Poly1305, OFTEN);
    for sequence in 0..350_u64 {
        let reply = plain(Kind::SyncResponse, sequence, 0, &[2; 80]);
        let mut sealed = vec![0; reply.len() + 16];
        pair.receiver.seal(&reply, &mut sealed).unwrap();
        assert!(matches!(pair.sender.open(&mut sealed), Ok(Heard::Reply(_))));
    }
    assert_eq!(pair.sender.counts().rotation_count, 3);
}
