//! The datagram format, held to written-out bytes in both directions.

use crate::body::{Hello, HelloAck, HelloStatus, PieceAck, SyncResponse};
use crate::refusal::Refusal;
use crate::stamps::StampSource;
use crate::wire::{Body, FLAG_AUTHENTICATED, FollowUpField, HEADER_BYTES, Header, Kind, decode};

/// Hexadecimal digits to bytes; blanks and line ends are skipped.
pub(super) fn bytes(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text
        .chars()
        .filter(|c| !c.is_whitespace())
        .map(|c| u8::try_from(c.to_digit(16).unwrap()).unwrap())
        .collect();
    digits
        .chunks(2)
        .map(|pair| pair[0] << 4 | pair[1])
        .collect()
}

fn header(kind: Kind) -> Header {
    Header {
        kind,
        session: 0x0403_0201,
        channel: 0x0605,
        sequence: 0x0e0d_0c0b_0a09_0807,
        type_hash: 0x1615_1413_1211_100f,
        published_ns: 0,
        handed_ns: 0x0000_1211_100f_0e0d,
        follow_up: None,
        total_len: 0,
        fragment_index: 0,
        fragment_count: 1,
        epoch: 0,
    }
}

/// Encoding gives `expected`, and decoding `expected` gives the same header and body.
fn check(mut header: Header, body: Body<'_>, expected: &str) {
    let expected = bytes(expected);
    let mut buffer = vec![0xee; 1024];
    let length = match body {
        Body::Data(payload) => {
            buffer[HEADER_BYTES..][..payload.len()].copy_from_slice(payload);
            payload.len()
        }
        Body::SyncRequest => {
            buffer[HEADER_BYTES..][..40].fill(0);
            40
        }
        Body::SyncResponse(response) => response.encode(&mut buffer[HEADER_BYTES..]),
        Body::Hello(hello) => hello.encode(&mut buffer[HEADER_BYTES..]),
        Body::HelloAck(ack) => ack.encode(&mut buffer[HEADER_BYTES..]),
        Body::PieceAck(ack) => ack.encode(&mut buffer[HEADER_BYTES..]),
        Body::Bye => 0,
    };
    if header.kind != Kind::Data {
        header.total_len = u32::try_from(length).unwrap();
    }
    header.encode(&mut buffer);
    buffer.truncate(HEADER_BYTES + length);
    assert_eq!(buffer, expected);
    let decoded = decode(&expected).unwrap();
    assert_eq!(decoded.header, header);
    assert_eq!(decoded.body, body);
}

#[test]
fn a_data_fragment_has_these_bytes() {
    let header = Header {
        published_ns: 0x0000_0a09_0807_0605,
        follow_up: Some(FollowUpField {
            sequence_low: 0x2423_2221,
            handed_to_tx_ns: 0x2827_2625,
        }),
        total_len: 7,
        fragment_index: 1,
        fragment_count: 2,
        epoch: 0x3433_3231,
        ..header(Kind::Data)
    };
    check(
        header,
        Body::Data(&[0xaa, 0xbb, 0xcc]),
        "48494c47 02 01 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 05060708090a0000 0d0e0f1011120000
         21222324 25262728 07000000 0100 0200 31323334 00000000
         aabbcc",
    );
}

#[test]
fn a_sync_request_has_these_bytes() {
    let zeros = "00".repeat(40);
    check(
        header(Kind::SyncRequest),
        Body::SyncRequest,
        &format!(
            "48494c47 02 02 0000 01020304 0506 4800 0708090a0b0c0d0e
             0f10111213141516 0000000000000000 0d0e0f1011120000
             00000000 ffffffff 28000000 0000 0100 00000000 00000000 {zeros}"
        ),
    );
}

#[test]
fn a_sync_response_has_these_bytes() {
    let response = SyncResponse {
        t1_ns: 0x0102_0304_0506_0708,
        t2_ns: 0x1112_1314_1516_1718,
        t3_ns: 0x2122_2324_2526_2728,
        t2_source: StampSource::KernelSoftware,
    };
    check(
        header(Kind::SyncResponse),
        Body::SyncResponse(response),
        "48494c47 02 03 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 0000000000000000 0d0e0f1011120000
         00000000 ffffffff 28000000 0000 0100 00000000 00000000
         0807060504030201 1817161514131211 2827262524232221 01 000000000000000000000000000000",
    );
}

#[test]
fn a_piece_ack_has_these_bytes() {
    let ack = PieceAck {
        answers_handed_ns: 0x0102_0304_0506_0708,
    };
    check(
        header(Kind::PieceAck),
        Body::PieceAck(ack),
        "48494c47 02 09 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 0000000000000000 0d0e0f1011120000
         00000000 ffffffff 08000000 0000 0100 00000000 00000000
         0807060504030201",
    );
}

#[test]
fn a_hello_has_these_bytes() {
    let hello = Hello {
        domain: core::array::from_fn(|index| u8::try_from(index).unwrap() + 0xa0),
        clock_id: 0xb8b7_b6b5_b4b3_b2b1,
        channel_count: 0xc2c1,
        flow_name: "link/hop/forward",
    };
    check(
        header(Kind::Hello),
        Body::Hello(hello),
        "48494c47 02 04 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 0000000000000000 0d0e0f1011120000
         00000000 ffffffff 39000000 0000 0100 00000000 00000000
         a0a1a2a3a4a5a6a7a8a9aaabacadaeaf b1b2b3b4b5b6b7b8 c1c2
         0000000000000000000000000000 10 6c696e6b2f686f702f666f7277617264",
    );
}

#[test]
fn a_hello_ack_has_these_bytes() {
    let ack = HelloAck {
        status: HelloStatus::SharedDomain,
        session: 0x6463_6261,
        clock_id: 0xb8b7_b6b5_b4b3_b2b1,
        domain: core::array::from_fn(|index| u8::try_from(index).unwrap() + 0xa0),
        answers_handed_ns: 0x7877_7675_7473_7271,
    };
    check(
        header(Kind::HelloAck),
        Body::HelloAck(ack),
        "48494c47 02 05 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 0000000000000000 0d0e0f1011120000
         00000000 ffffffff 28000000 0000 0100 00000000 00000000
         02 000000 61626364 b1b2b3b4b5b6b7b8 a0a1a2a3a4a5a6a7a8a9aaabacadaeaf
         7172737475767778",
    );
}

#[test]
fn a_bye_has_these_bytes() {
    let header = Header {
        epoch: 0x3433_3231,
        ..header(Kind::Bye)
    };
    check(
        header,
        Body::Bye,
        "48494c47 02 06 0000 01020304 0506 4800 0708090a0b0c0d0e
         0f10111213141516 0000000000000000 0d0e0f1011120000
         00000000 ffffffff 00000000 0000 0100 31323334 00000000",
    );
}

fn data(payload: &[u8]) -> Vec<u8> {
    let mut datagram = vec![0; HEADER_BYTES];
    let mut header = header(Kind::Data);
    header.total_len = u32::try_from(payload.len()).unwrap();
    header.encode(&mut datagram);
    datagram.extend_from_slice(payload);
    datagram
}

#[test]
fn each_broken_field_has_its_own_refusal() {
    let valid = data(&[1, 2, 3]);
    assert!(decode(&valid).is_ok());
    let table: [(usize, u8, Refusal); 11] = [
        (0, b'X', Refusal::BadMagic),
        (4, 1, Refusal::UnsupportedVersion),
        (5, 0, Refusal::UnknownKind),
        (5, 7, Refusal::UnexpectedKind),
        (5, 10, Refusal::UnknownKind),
        (6, 2, Refusal::UnknownFlags),
        (7, 1, Refusal::UnknownFlags),
        (14, 71, Refusal::BadHeaderLength),
        (56, 4, Refusal::LengthMismatch),
        (60, 1, Refusal::FragmentInconsistent),
        (68, 1, Refusal::ReservedNotZero),
    ];
    for (offset, value, expected) in table {
        let mut broken = valid.clone();
        broken[offset] = value;
        assert_eq!(decode(&broken), Err(expected), "byte {offset} = {value}");
    }
    for length in 0..HEADER_BYTES {
        let expected = Err(Refusal::TooShort);
        assert_eq!(decode(&valid[..length]), expected, "{length} bytes");
    }
    for length in HEADER_BYTES..valid.len() {
        assert_eq!(decode(&valid[..length]), Err(Refusal::LengthMismatch));
    }
}

#[test]
fn an_authenticated_datagram_is_refused_while_no_key_is_configured() {
    let mut datagram = data(&[1, 2, 3]);
    datagram[6..8].copy_from_slice(&FLAG_AUTHENTICATED.to_le_bytes());
    datagram.extend_from_slice(&[0; 16]);
    assert_eq!(decode(&datagram), Err(Refusal::AuthenticationNotConfigured));
}

#[test]
fn a_follow_up_names_its_sequence_across_a_wrap_of_the_low_half() {
    let field = FollowUpField {
        sequence_low: 0xffff_fffe,
        handed_to_tx_ns: 1,
    };
    assert_eq!(field.sequence(0x1_0000_0001), Some(0xffff_fffe));
    assert_eq!(field.sequence(3), None);
}
