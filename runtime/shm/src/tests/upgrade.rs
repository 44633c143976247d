//! What `raw.rs` expects of iceoryx2's hidden interface, said so plainly that an upgrade which
//! changes it fails here and not in a gateway.

use hil_core::message::{Envelope, TypeInfo};

use super::super::{ChannelHolder, ChannelSettings, Domain, RawInput, RawOutput};
use super::{assert_nothing_left, root_path};

#[test]
fn iceoryx2_is_the_version_raw_ports_were_written_for() {
    let lock = include_str!("../../../../Cargo.lock");
    let version = lock
        .split("[[package]]")
        .find(|package| package.contains("name = \"iceoryx2\"\n"))
        .and_then(|package| package.split("version = \"").nth(1))
        .and_then(|rest| rest.split('"').next());
    assert_eq!(
        version,
        Some("0.10.0"),
        "read raw.rs against the custom-payload calls of iceoryx2's own link before raising this"
    );
}

#[test]
fn bytes_of_any_size_and_alignment_arrive_whole_and_aligned() {
    let near = Domain::create(&root_path("shapes")).unwrap();
    let far = Domain::open(near.address()).unwrap();
    for (size_bytes, alignment_bytes) in [
        (1, 1),
        (3, 1),
        (8, 8),
        (12, 4),
        (48, 16),
        (64, 64),
        (1000, 8),
        (1 << 20, 8),
    ] {
        let name = format!("shape/{size_bytes}-{alignment_bytes}");
        let message = TypeInfo {
            name: format!("test.Shape{size_bytes}.v1"),
            size_bytes,
            alignment_bytes,
        };
        let settings = ChannelSettings {
            name: name.clone(),
            message: message.clone(),
            depth_max: 2,
            writers_max: 1,
            readers_max: 2,
        };
        let holder = ChannelHolder::create(&near, &settings).unwrap();
        let mut output = RawOutput::open(&near, &name, false).unwrap();
        let mut input = RawInput::open(&far, &name, 2).unwrap();
        assert_eq!((output.message(), input.message()), (&message, &message));
        for sequence in 0..3_u64 {
            let payload: Vec<u8> = (0..size_bytes)
                .map(|index| (index as u64 * 31 + sequence).to_le_bytes()[0])
                .collect();
            let sent = Envelope {
                sequence,
                published_ns: -7,
                forwarded_ns: i64::MIN,
                epoch: u32::MAX,
                flags: Envelope::FORWARDED,
                length_bytes: 0,
                reserved: [1, 2, u64::MAX],
            };
            output.publish(&sent, &payload).unwrap();
            let mut take = |envelope: &Envelope, bytes: &[u8]| {
                assert_eq!(*envelope, sent);
                assert!(bytes == payload, "{name}");
                assert_eq!(bytes.as_ptr().addr() % alignment_bytes, 0, "{name}");
            };
            assert!(input.receive(&mut take).unwrap());
        }
        for wrong in [0, size_bytes - 1, size_bytes + 1] {
            let payload = vec![0; wrong];
            let refused = output.publish(&Envelope::default(), &payload);
            assert!(refused.is_err() == (wrong != size_bytes), "{name}");
        }
        drop((output, input, holder));
    }
    drop(far);
    assert_nothing_left(near);
}

#[test]
fn a_message_without_size_or_with_an_odd_alignment_is_refused() {
    let domain = Domain::create(&root_path("shapeless")).unwrap();
    for (size_bytes, alignment_bytes) in [(0, 1), (8, 3), (8, 0)] {
        let settings = ChannelSettings {
            name: "shapeless".to_owned(),
            message: TypeInfo {
                name: "test.Shapeless.v1".to_owned(),
                size_bytes,
                alignment_bytes,
            },
            depth_max: 1,
            writers_max: 1,
            readers_max: 1,
        };
        assert!(ChannelHolder::create(&domain, &settings).is_err());
    }
    assert_nothing_left(domain);
}
