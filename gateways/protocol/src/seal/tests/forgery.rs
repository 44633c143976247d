//! What is not authentic or not new is refused, whatever was done to it.

use hil_core::random::RandomStream;

use super::*;

/// Changes `bytes` in one to three places, cuts it or adds to it.
fn mutate(bytes: &mut Vec<u8>, random: &mut RandomStream) {
    let below = |random: &mut RandomStream, bound: usize| {
        usize::try_from(random.next_u64() % bound as u64).unwrap()
    };
    match random.next_u64() % 8 {
        0 => bytes.truncate(below(random, bytes.len())),
        1 => bytes.extend((0..=below(random, 20)).map(|byte| byte.to_le_bytes()[0])),
        2 => {
            let at = below(random, bytes.len() * 8);
            bytes[at / 8] ^= 1 << (at % 8);
        }
        _ => {
            for _ in 0..=below(random, 3) {
                let at = below(random, bytes.len());
                bytes[at] = random.next_u64().to_le_bytes()[0];
            }
        }
    }
}

#[test]
fn of_100_000_mutated_datagrams_none_is_opened_and_none_disturbs_the_next() {
    for suite in SUITES {
        let mut pair = Pair::agreed(suite, Rotation::default());
        let mut random = RandomStream::new(1, "forgery");
        let mut refused_count = 0;
        for sequence in 0..50_000_u64 {
            let kind = match sequence % 16 {
                0 => Kind::SyncRequest,
                1 => Kind::Bye,
                2 => Kind::Hello,
                _ => Kind::Data,
            };
            let size = usize::try_from(random.next_u64() % 200).unwrap();
            let datagram = plain(kind, sequence, 1_000, &vec![7; size]);
            let good = pair.sealed(&datagram);
            let mut bad = good.clone();
            mutate(&mut bad, &mut random);
            if bad != good {
                assert!(pair.open(bad).is_err());
                refused_count += 1;
            }
            assert_eq!(pair.open(good), Ok(datagram));
        }
        let counts = pair.receiver.counts();
        assert_eq!(counts.refused.total(), refused_count);
        assert_eq!(counts.opened_count, 50_000);
        assert!(counts.refused.get(SealRefusal::BadTag) > 10_000);
    }
}

#[test]
fn mutated_key_exchanges_are_refused_by_both_ends() {
    let mut random = RandomStream::new(2, "exchange");
    let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
    for _ in 0..20_000 {
        let request = pair.sender.request_before(&hello()).unwrap();
        let mut bad = request.to_vec();
        mutate(&mut bad, &mut random);
        if bad != request {
            assert!(pair.receiver.open(&mut bad).is_err());
        }
        let Ok(Opened::Answer(answer)) = pair.receiver.open(&mut { request }) else {
            panic!("the request itself is good");
        };
        let mut bad = answer.to_vec();
        mutate(&mut bad, &mut random);
        if bad != answer {
            assert!(pair.sender.open(&mut bad).is_err());
        }
        assert!(pair.sender.open(&mut { answer }).is_ok());
    }
    assert_eq!(pair.receiver.counts().agreement_count, 1);
    assert_eq!(pair.sender.counts().agreement_count, 1);
}

#[test]
fn random_bytes_are_refused_by_both_ends() {
    let mut random = RandomStream::new(3, "noise");
    let mut pair = Pair::agreed(Suite::ChaCha20Poly1305, Rotation::default());
    for round in 0..100_000_u64 {
        let length = usize::try_from(random.next_u64() % 300).unwrap();
        let mut bytes: Vec<u8> = (0..length)
            .map(|_| random.next_u64().to_le_bytes()[0])
            .collect();
        // Half of them look right at first sight.
        if round % 2 == 0 && length > 20 {
            let header = plain(Kind::Data, round, 0, &[]);
            let like = length.min(header.len());
            bytes[..like].copy_from_slice(&header[..like]);
            bytes[6] = 1;
            bytes[5] = u8::try_from(round % 10).unwrap();
        }
        assert!(pair.receiver.open(&mut bytes.clone()).is_err());
        assert!(pair.sender.open(&mut bytes).is_err());
    }
}

#[test]
fn played_back_in_any_order_each_datagram_is_opened_once() {
    for seed in 0..8 {
        let mut random = RandomStream::new(seed, "replay");
        let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
        let recorded: Vec<Vec<u8>> = (0..1_500)
            .map(|sequence| pair.sealed(&plain(Kind::Data, sequence, 0, &[1; 24])))
            .collect();
        let mut opened = vec![0; recorded.len()];
        for _ in 0..20_000 {
            let index = usize::try_from(random.next_u64() % 1_500).unwrap();
            if pair.open(recorded[index].clone()).is_ok() {
                opened[index] += 1;
            }
        }
        assert!(opened.iter().all(|&count| count <= 1));
        let total: u64 = opened.iter().sum();
        let counts = pair.receiver.counts();
        assert_eq!(counts.opened_count, total);
        assert_eq!(counts.refused.get(SealRefusal::Replayed), 20_000 - total);
    }
}

#[test]
fn a_producer_that_counts_anew_repeats_no_nonce() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
    let one = pair.sealed(&plain(Kind::Data, 4, 1_000, &[0; 32]));
    let other = pair.sealed(&plain(Kind::Data, 4, 1_000, &[0; 32]));
    // Under one nonce equal payloads would give equal ciphers.
    assert_ne!(one[72..104], other[72..104]);
    assert!(pair.open(one).is_ok() && pair.open(other).is_ok());
}

#[test]
fn each_cause_is_told_apart() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
    let good = pair.sealed(&plain(Kind::Data, 0, 0, &[1; 8]));
    let changed = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        bytes
    };
    let cases = [
        (good[..40].to_vec(), SealRefusal::TooShort),
        (good[..3].to_vec(), SealRefusal::TooShort),
        (changed(0, b'X'), SealRefusal::BadMagic),
        (changed(4, 1), SealRefusal::WrongVersion),
        (changed(6, 0), SealRefusal::NotSealed),
        (changed(6, 3), SealRefusal::BadHeader),
        (changed(5, 99), SealRefusal::BadHeader),
        (changed(5, Kind::SyncResponse as u8), SealRefusal::WrongWay),
        (changed(12, 9), SealRefusal::BadTag),
        (changed(8, 9), SealRefusal::ForeignSession),
        (changed(7, 9), SealRefusal::StaleEpoch),
        (changed(7, 1), SealRefusal::BadTag),
        (changed(80, !good[80]), SealRefusal::BadTag),
        (changed(40, 9), SealRefusal::BadTag),
    ];
    for (bytes, cause) in cases {
        assert_eq!(pair.open(bytes), Err(cause));
    }
    assert!(pair.open(good.clone()).is_ok());
    assert_eq!(pair.open(good), Err(SealRefusal::Replayed));
}
