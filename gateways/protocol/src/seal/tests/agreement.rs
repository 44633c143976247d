//! Who gets keys, and what starting again does.

use super::*;

#[test]
fn what_one_end_seals_the_other_opens_and_the_payload_is_not_to_be_seen() {
    for suite in SUITES {
        let mut pair = Pair::agreed(suite, Rotation::default());
        let kinds = [Kind::Hello, Kind::Data, Kind::SyncRequest, Kind::Bye];
        for (number, kind) in kinds.into_iter().enumerate() {
            let datagram = plain(kind, number as u64, 5_000, b"the quick brown fox");
            let sealed = pair.sealed(&datagram);
            assert_eq!(sealed[..6], datagram[..6], "the header stays readable");
            assert_eq!(sealed[8..68], datagram[8..68]);
            assert!(!sealed.windows(5).any(|part| part == b"quick"));
            assert_eq!(pair.open(sealed), Ok(datagram));
        }
        let reply = plain(Kind::HelloAck, 0, 6_000, &[4; 40]);
        let mut sealed = vec![0; reply.len() + 16];
        let length = pair.receiver.seal(&reply, &mut sealed).unwrap();
        assert_eq!(pair.sender.open(&mut sealed), Ok(Heard::Reply(length - 16)));
        assert_eq!(sealed[..reply.len()], reply);
        assert_eq!(pair.sender.counts().sealed_count, 4);
        assert_eq!(pair.receiver.counts().opened_count, 4);
        assert_eq!(pair.receiver.counts().refused.total(), 0);
    }
}

#[test]
fn nothing_is_sealed_before_there_are_keys_and_a_greeting_asks_for_them() {
    let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
    let mut out = [0; 256];
    assert_eq!(pair.sender.seal(&hello(), &mut out), None);
    let data = plain(Kind::Data, 0, 0, &[0; 8]);
    assert_eq!(pair.sender.request_before(&data), None);
    assert_eq!(
        pair.sender.request_before(&hello()).map(|one| one.len()),
        Some(KEY_EXCHANGE_BYTES)
    );
}

#[test]
fn another_secret_or_flow_gets_no_answer_and_no_keys() {
    let base = association(Suite::Aes256Gcm);
    let others = [
        Association {
            secret: RunSecret::new(&mut [8; 32]),
            ..base.clone()
        },
        Association {
            flow_name: "link/hop/forwarD".to_owned(),
            ..base.clone()
        },
    ];
    for other in others {
        let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
        pair.sender = Initiator::new(&other, [1; 16], Rotation::default());
        let mut request = pair.sender.request_before(&hello()).unwrap();
        assert_eq!(pair.receiver.open(&mut request), Err(SealRefusal::BadTag));
    }
    let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
    let elsewhere = Association { flow: 4, ..base };
    pair.sender = Initiator::new(&elsewhere, [1; 16], Rotation::default());
    let mut request = pair.sender.request_before(&hello()).unwrap();
    let refused = pair.receiver.open(&mut request);
    assert_eq!(refused, Err(SealRefusal::ForeignFlow));
}

#[test]
fn a_request_is_answered_once_and_asking_again_changes_nothing() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
    let first = pair.sealed(&plain(Kind::Data, 0, 0, b"a"));
    let mut request = pair.sender.request_before(&hello()).unwrap();
    let mut again = request;
    let Ok(Opened::Answer(mut answer)) = pair.receiver.open(&mut request) else {
        panic!("answered");
    };
    assert_eq!(pair.receiver.open(&mut again), Err(SealRefusal::Replayed));
    let mut late = answer;
    assert_eq!(pair.sender.open(&mut answer), Ok(Heard::Nothing));
    assert_eq!(pair.sender.open(&mut late), Err(SealRefusal::Unsolicited));
    assert!(pair.open(first).is_ok(), "the keys are the same");
}

#[test]
fn a_receiver_that_started_again_takes_nothing_from_before_and_gets_new_keys() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
    let recorded = pair.sealed(&plain(Kind::Data, 7, 0, b"a"));
    pair.receiver = Responder::new(
        &association(Suite::Aes256Gcm),
        &[3; 32],
        Rotation::default(),
    );
    let refused = pair.open(recorded.clone());
    assert_eq!(refused, Err(SealRefusal::ForeignSession));
    // Clock exchanges stay unanswered until keys are asked for again.
    let sync = plain(Kind::SyncRequest, 1, 2_000, &[0; 80]);
    let asked = (0..10)
        .filter_map(|_| pair.sender.request_before(&sync))
        .last();
    let Ok(Opened::Answer(mut answer)) = pair.receiver.open(&mut asked.unwrap()) else {
        panic!("answered");
    };
    assert_eq!(pair.sender.open(&mut answer), Ok(Heard::Keys));
    assert_eq!(pair.open(recorded), Err(SealRefusal::BadTag));
    let fresh = pair.sealed(&plain(Kind::Data, 8, 0, b"b"));
    assert!(pair.open(fresh).is_ok());
}

#[test]
fn answers_of_an_earlier_start_of_the_receiver_are_not_taken_up_again() {
    let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
    let mut requests: Vec<_> = (0..3)
        .map(|_| pair.sender.request_before(&hello()).unwrap())
        .collect();
    let mut answers = Vec::new();
    let mut later = Responder::new(
        &association(Suite::Aes256Gcm),
        &[3; 32],
        Rotation::default(),
    );
    let (first, second) = requests.split_at_mut(1);
    for (receiver, request) in [
        (&mut pair.receiver, &mut first[0]),
        (&mut later, &mut second[0]),
    ] {
        let Ok(Opened::Answer(answer)) = receiver.open(request) else {
            panic!("answered");
        };
        answers.push(answer);
    }
    // The first receiver's answer to the third request is held back on the way.
    let Ok(Opened::Answer(mut held)) = pair.receiver.open(&mut second[1]) else {
        panic!("answered");
    };
    assert_eq!(pair.sender.open(&mut answers[0]), Ok(Heard::Keys));
    assert_eq!(pair.sender.open(&mut answers[1]), Ok(Heard::Keys));
    assert_eq!(pair.sender.open(&mut held), Err(SealRefusal::Unsolicited));
    assert_eq!(pair.sender.counts().agreement_count, 2);
}

#[test]
fn recorded_requests_of_earlier_starts_displace_no_proven_keys() {
    let mut pair = Pair::agreed(Suite::Aes256Gcm, Rotation::default());
    let first = pair.sealed(&plain(Kind::Data, 0, 0, b"a"));
    assert!(pair.open(first).is_ok());
    for start in 0..40_u8 {
        let mut other = Initiator::new(
            &association(Suite::Aes256Gcm),
            [start + 2; 16],
            Rotation::default(),
        );
        let mut greeting = hello();
        greeting[8] = start + 100;
        let mut request = other.request_before(&greeting).unwrap();
        assert!(matches!(
            pair.receiver.open(&mut request),
            Ok(Opened::Answer(_))
        ));
        let datagram = pair.sealed(&plain(Kind::Data, u64::from(start) + 1, 0, b"a"));
        assert!(
            pair.open(datagram).is_ok(),
            "after {start} recorded requests"
        );
    }
}

#[test]
fn an_answer_is_no_longer_than_its_request_and_strangers_get_none() {
    let mut pair = Pair::strangers(Suite::Aes256Gcm, Rotation::default());
    let mut request = pair.sender.request_before(&hello()).unwrap();
    let forged = {
        let mut forged = request;
        forged[80] ^= 1;
        forged
    };
    assert_eq!(
        pair.receiver.open(&mut { forged }),
        Err(SealRefusal::BadTag)
    );
    match pair.receiver.open(&mut request) {
        Ok(Opened::Answer(answer)) => assert!(answer.len() <= request.len()),
        other => panic!("{other:?}"),
    }
}
