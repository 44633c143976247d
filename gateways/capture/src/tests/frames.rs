//! Frames of every link layer that is read, headers of the ET2000, and what flows are known by.

use super::super::esl::{self, EslHeader};
use super::super::flow::{FlowError, FlowFilter, Unidentified};
use super::super::link::{self, NoDatagram, UdpDatagram};
use super::super::watch::Unread;
use super::{message, udp_frame};
use hil_net::{Direction, link_type};

/// The datagram of a frame that is all there, but for what was cut off behind.
fn udp_datagram(link_type: u16, frame: &[u8]) -> Result<UdpDatagram<'_>, NoDatagram> {
    link::udp_datagram(link_type, frame, frame.len())
}

fn cut_datagram(frame: &[u8]) -> Result<UdpDatagram<'_>, NoDatagram> {
    link::udp_datagram(1, frame, 1514)
}

const fn unread(why: Unread) -> NoDatagram {
    NoDatagram::Unread(why)
}

#[test]
fn the_same_datagram_is_found_behind_every_link_layer() {
    let frame = udp_frame(40_000, 5004, b"payload");
    let bare = &frame[14..];
    let tagged = [&frame[..12], &[0x81, 0, 0xe0, 7], &frame[12..]].concat();
    let twice = [
        &frame[..12],
        &[0x88, 0xa8, 0, 1, 0x81, 0, 0xe0, 7],
        &frame[12..],
    ]
    .concat();
    let cooked = [&[0; 14][..], &[8, 0], bare].concat();
    let cooked_2 = [&[8, 0][..], &[0; 18], bare].concat();
    let padded = [&frame[..], &[0; 30]].concat();
    let addresses = &frame[..12];
    let session = [
        addresses,
        &[0x88, 0x64, 0x11, 0, 0, 7, 0, 37, 0, 0x21],
        bare,
    ]
    .concat();
    let labels = [addresses, &[0x88, 0x47, 0, 1, 0, 64, 0, 2, 1, 64], bare].concat();
    let snap = [addresses, &[0, 43, 0xaa, 0xaa, 3, 0, 0, 0, 8, 0], bare].concat();
    let loopback = |family: [u8; 4]| [&family[..], bare].concat();
    let qos = [
        &[0x88, 0x01][..],
        &[0; 22],
        &[5, 0, 0xaa, 0xaa, 3, 0, 0, 0, 8, 0],
        bare,
    ]
    .concat();
    let relayed = [
        &[0x08, 0x03][..],
        &[0; 28],
        &[0xaa, 0xaa, 3, 0, 0, 0, 8, 0],
        bare,
    ]
    .concat();
    // Time, flags and rate present; flags say a check sequence follows.
    let radiotap = [0, 0, 18, 0, 7, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 0x10, 2];
    let over_air = [&radiotap[..], &qos, &[9; 4]].concat();
    let other_tag = [&frame[..12], &[0x93, 0, 0, 7], &frame[12..]].concat();
    // A label and a control word before the Ethernet frame.
    let pseudowire = [addresses, &[0x88, 0x47, 0, 1, 1, 64, 0, 0, 0, 0], &frame].concat();
    let bare_pseudowire = [addresses, &[0x88, 0x47, 0, 1, 1, 64], &frame].concat();
    // An inner address of a virtual router (RFC 9568), with and without a control word.
    let router = [&[0, 0, 0x5e, 0, 1, 7][..], &frame[6..]].concat();
    let router_pseudowire = [addresses, &[0x88, 0x47, 0, 1, 1, 64], &router].concat();
    let router_behind_word = [addresses, &[0x88, 0x47, 0, 1, 1, 64, 0, 0, 0, 9], &router].concat();
    let ring = [addresses, &[0x89, 0x2f, 0x10, 43, 0, 7], &frame[12..]].concat();
    let redundant = [addresses, &[0xf1, 0xc1, 0, 0, 0, 7], &frame[12..]].concat();
    let within = |protocol: u8, before: &[u8], inner: &[u8]| {
        let mut outer = bare[..20].to_vec();
        outer[3] = u8::try_from(20 + before.len() + inner.len()).unwrap();
        outer[9] = protocol;
        [&outer, before, inner].concat()
    };
    let in_ip = within(4, &[], bare);
    let in_gre = within(47, &[0x20, 0, 0x65, 0x58, 0, 0, 0, 9], &frame);
    let authenticated = within(51, &[&[17, 4, 0, 0][..], &[0; 20]].concat(), &bare[20..]);
    let sealed = within(50, &[0; 8], &bare[20..]);
    // The header of 26 bytes is padded to 28, say the flags.
    let padding_told = [0, 0, 9, 0, 2, 0, 0, 0, 0x20];
    let padded_air = [&padding_told[..], &qos[..26], &[0; 2], &qos[26..]].concat();
    for (link, bytes, vlan) in [
        (link_type::ETHERNET, frame.as_slice(), [0, 0]),
        (link_type::ETHERNET, &tagged, [0, 7]),
        (link_type::ETHERNET, &twice, [1, 7]),
        (link_type::ETHERNET, &other_tag, [0, 7]),
        (link_type::ETHERNET, &pseudowire, [0, 0]),
        (link_type::ETHERNET, &bare_pseudowire, [0, 0]),
        (link_type::ETHERNET, &router_pseudowire, [0, 0]),
        (link_type::ETHERNET, &router_behind_word, [0, 0]),
        (link_type::ETHERNET, &ring, [0, 0]),
        (link_type::ETHERNET, &redundant, [0, 0]),
        (link_type::RAW, &in_ip, [0, 0]),
        (link_type::RAW, &in_gre, [0, 0]),
        (link_type::RAW, &authenticated, [0, 0]),
        (link_type::RADIOTAP, &padded_air, [0, 0]),
        (link_type::ETHERNET, &padded, [0, 0]),
        (link_type::ETHERNET, &session, [0, 0]),
        (link_type::ETHERNET, &labels, [0, 0]),
        (link_type::ETHERNET, &snap, [0, 0]),
        (link_type::LINUX_SLL, &cooked, [0, 0]),
        (link_type::LINUX_SLL2, &cooked_2, [0, 0]),
        (link_type::RAW, bare, [0, 0]),
        (link_type::RAW_12, bare, [0, 0]),
        (link_type::RAW_14, bare, [0, 0]),
        (link_type::IPV4, bare, [0, 0]),
        (link_type::NULL, &loopback([2, 0, 0, 0]), [0, 0]),
        (link_type::NULL, &loopback([0, 0, 0, 2]), [0, 0]),
        (link_type::LOOP, &loopback([0, 0, 0, 2]), [0, 0]),
        (
            link_type::PPP,
            &[&[0xff, 3, 0, 0x21], bare].concat(),
            [0, 0],
        ),
        (link_type::PPP, &[&[0x21][..], bare].concat(), [0, 0]),
        (
            link_type::PPP_SERIAL,
            &[&[0xff, 3, 0, 0x21], bare].concat(),
            [0, 0],
        ),
        (link_type::PPP_ETHER, &session[14..], [0, 0]),
        (link_type::IEEE802_11, &qos, [0, 0]),
        (link_type::IEEE802_11, &relayed, [0, 0]),
        (link_type::RADIOTAP, &over_air, [0, 0]),
    ] {
        let datagram = udp_datagram(link, bytes);
        let datagram = datagram.unwrap_or_else(|why| panic!("link type {link}: {why:?}"));
        assert_eq!(datagram.source.to_string(), "10.77.0.1:40000");
        assert_eq!(datagram.destination.to_string(), "10.77.0.2:5004");
        assert_eq!(
            (datagram.payload, datagram.place.vlans),
            (&b"payload"[..], vlan)
        );
        assert_eq!((datagram.dscp, datagram.is_cut_short()), (46, false));
        let is_longer = usize::from(bytes == authenticated) * 24;
        assert_eq!(
            (datagram.hop_limit, datagram.packet_bytes),
            (64, bare.len() + is_longer)
        );
    }
    let why = Unread::LinkType { link_type: 147 };
    assert_eq!(udp_datagram(147, &frame), Err(unread(why)));
    let sealed = udp_datagram(link_type::RAW, &sealed);
    let ends = NoDatagram::Sealed {
        source: "10.77.0.1".parse().unwrap(),
        destination: "10.77.0.2".parse().unwrap(),
        why: Unread::Encrypted,
    };
    assert_eq!(sealed, Err(ends));
    let mut sealed = qos.clone();
    sealed[1] |= 0x40;
    let sealed = udp_datagram(link_type::IEEE802_11, &sealed);
    assert_eq!(sealed, Err(unread(Unread::Encrypted)));
    let mut several = qos.clone();
    several[24] |= 0x80;
    let several = udp_datagram(link_type::IEEE802_11, &several);
    assert_eq!(several, Err(unread(Unread::Aggregate)));
    let channel = [addresses, &[0x88, 0x47, 0, 1, 1, 64, 0x10, 0, 0, 7], &frame].concat();
    assert_eq!(
        udp_datagram(link_type::ETHERNET, &channel),
        Err(NoDatagram::NotIp)
    );
    let management = [&[0x80, 0][..], &[0; 40]].concat();
    let management = udp_datagram(link_type::IEEE802_11, &management);
    assert_eq!(management, Err(NoDatagram::NotIp));
}

#[test]
fn a_length_of_zero_reaches_to_the_end_of_the_frame() {
    let frame = udp_frame(40_000, 5004, b"payload");
    let mut offloaded = frame.clone();
    offloaded[16..18].fill(0);
    assert_eq!(udp_datagram(1, &offloaded).unwrap().payload, b"payload");
    offloaded[38..40].fill(0);
    assert_eq!(udp_datagram(1, &offloaded).unwrap().payload, b"payload");
    let cut = link::udp_datagram(1, &offloaded[..45], offloaded.len()).unwrap();
    assert_eq!((cut.payload, cut.payload_bytes), (&b"pay"[..], 7));
    assert!(cut.is_cut_short());

    let mut six = vec![0x60, 0, 0, 0, 0, 0, 17, 64];
    six.extend([0xfd; 32]);
    six.extend(&frame[34..]);
    let jumbo = udp_datagram(link_type::RAW, &six).unwrap();
    assert_eq!(jumbo.payload, b"payload");
}

#[test]
fn cooked_captures_say_which_way_and_on_which_interface() {
    let frame = udp_frame(1, 2, b"payload");
    for (kind, direction) in [
        (0, Direction::Inbound),
        (3, Direction::Inbound),
        (4, Direction::Outbound),
    ] {
        let first = [&[0, kind][..], &[0; 12], &[8, 0], &frame[14..]].concat();
        let place = udp_datagram(link_type::LINUX_SLL, &first).unwrap().place;
        assert_eq!((place.direction, place.interface_number), (direction, None));
        let second = [
            &[8, 0, 0, 0, 0, 0, 0, 9, 0, 1, kind][..],
            &[0; 9],
            &frame[14..],
        ]
        .concat();
        let place = udp_datagram(link_type::LINUX_SLL2, &second).unwrap().place;
        assert_eq!(
            (place.direction, place.interface_number),
            (direction, Some(9))
        );
    }
}

#[test]
fn options_fragments_and_extension_headers_are_followed_or_told() {
    let frame = udp_frame(1, 2, b"payload");
    let mut with_options = frame.clone();
    with_options[14] = 0x46;
    with_options[17] += 4;
    with_options.splice(34..34, [1, 1, 1, 0]);
    assert_eq!(udp_datagram(1, &with_options).unwrap().payload, b"payload");

    let mut first = frame.clone();
    first[20] = 0x20;
    assert!(udp_datagram(1, &first).unwrap().is_fragmented());
    let mut later = frame.clone();
    later[21] = 9;
    let Err(NoDatagram::LaterFragment(Some(piece))) = udp_datagram(1, &later) else {
        panic!("{:?}", udp_datagram(1, &later))
    };
    let told = (piece.number, piece.from_bytes, piece.bytes, piece.is_last);
    assert_eq!(told, (1, 72, 15, true));
    let mut other = frame.clone();
    other[23] = 6;
    assert_eq!(udp_datagram(1, &other), Err(NoDatagram::NotUdp));
    let short = cut_datagram(&frame[..44]).unwrap();
    assert!(short.is_cut_short() && short.payload == b"pa");
    assert_eq!(cut_datagram(&frame[..40]), Err(unread(Unread::CutShort)));
    assert_eq!(
        udp_datagram(1, &frame[..40]),
        Err(unread(Unread::Malformed)),
        "all of the frame is there"
    );

    // IPv6 with a hop-by-hop header.
    let mut six = vec![0x6b, 0x80, 0, 0, 0, 8 + 15, 0, 64];
    six.extend([0xfd; 32]);
    six.extend([17, 0, 1, 4, 0, 0, 0, 0]);
    six.extend(&frame[34..]);
    let datagram = udp_datagram(link_type::RAW, &six).unwrap();
    assert_eq!((datagram.payload, datagram.dscp), (&b"payload"[..], 46));
    assert!(datagram.source.is_ipv6());
}

#[test]
fn the_et2000_header_is_found_at_either_end_with_port_and_stamp() {
    let frame = udp_frame(1, 2, b"payload");
    for (port, bit) in (0..esl::PORT_COUNT).zip(esl::FLAG_BITS) {
        let header = EslHeader {
            flags: bit | esl::STAMP_ENABLED,
            stamp_ns: 0x0102_0304_0506_0708,
        };
        let bytes = header.encode();
        assert_eq!(bytes[8], 0x08, "the lowest byte comes first");
        for whole in [[&bytes[..], &frame].concat(), [&frame[..], &bytes].concat()] {
            let (found, inner) = esl::split(&whole).unwrap();
            assert_eq!((found, inner), (header, frame.as_slice()));
            assert_eq!((found.port(), found.port_count()), (Some(port), 1));
            assert!(!found.is_damaged());
        }
    }
    assert_eq!(esl::split(&frame), None);
    let several = EslHeader {
        flags: 0x00c0 | esl::CRC_ERROR,
        stamp_ns: 0,
    };
    assert_eq!((several.port(), several.port_count()), (Some(0), 2));
    assert!(several.is_damaged());
}

#[test]
fn flows_are_written_as_they_are_read_and_nonsense_is_refused_by_name() {
    for text in [
        "hil",
        "hil:port=4800",
        "egm:port=6510",
        "udp:sport=1,dport=65535,src=10.0.0.1,dst=10.0.0.2,id=2+2",
        "udp:dst=fd00::1,id=0+8le",
        "udp:port=9",
    ] {
        let flow: FlowFilter = text.parse().unwrap();
        assert_eq!(flow.to_string(), text);
    }
    let refusal = |text: &str| text.parse::<FlowFilter>().unwrap_err();
    assert_eq!(refusal("tcp"), FlowError::Kind("tcp".to_owned()));
    assert_eq!(refusal("udp"), FlowError::Everything("udp".to_owned()));
    assert_eq!(
        refusal("hil:id=1+1"),
        FlowError::Condition("id=1+1".to_owned())
    );
    assert_eq!(refusal("udp:src=10.0.0.1,dst=::1"), FlowError::Families);
    for (text, key) in [
        ("udp:dport=5004,dport=5005", "dport"),
        ("udp:dport=1,id=0+4,id=2+2", "id"),
        ("hil:src=::1,src=::1", "src"),
    ] {
        assert_eq!(refusal(text), FlowError::Repeated(key.to_owned()));
    }
    for text in [
        "udp:port=0",
        "udp:port=65536",
        "udp:src=10.0.0",
        "udp:port=1,id=3+9",
    ] {
        assert!(matches!(refusal(text), FlowError::Value { .. }), "{text}");
    }
}

#[test]
fn a_datagram_is_known_by_what_its_flow_says() {
    let flow = |text: &str| text.parse::<FlowFilter>().unwrap();
    let identify = |text: &str, payload: &[u8]| {
        let frame = udp_frame(7000, 2, payload);
        flow(text).identify(&udp_datagram(1, &frame).unwrap())
    };
    let own = identify("hil", &message(77)).unwrap();
    assert_eq!(own.number.unwrap().number, 77);
    assert_eq!(own.own.unwrap().channel, 3);
    assert_ne!(own.key, identify("hil", &message(78)).unwrap().key);
    assert_eq!(identify("hil", b"HILG"), Err(Unidentified::Foreign));

    let rtp = [0x80, 0, 0x12, 0x34, 9];
    let by_number = identify("udp:port=7000,id=2+2", &rtp).unwrap();
    assert_eq!(by_number.number.unwrap().number, 0x1234);
    let swapped = identify("udp:port=7000,id=2+2le", &rtp).unwrap();
    assert_eq!(swapped.number.unwrap().number, 0x3412);
    assert_eq!(
        identify("udp:port=7000,id=4+2", &rtp),
        Err(Unidentified::Foreign)
    );
    let whole = identify("udp:port=7000", &rtp).unwrap();
    assert_eq!(whole.number, None);

    // A header with seqno 5, tm 2 and type 3 (correction); and bytes that are no message.
    let egm = [10, 6, 8, 5, 16, 2, 24, 3];
    let found = identify("egm:port=7000", &egm).unwrap();
    assert_eq!(found.number.unwrap().number, 5);
    assert_eq!(
        identify("egm:port=7000", &[0xff; 9]),
        Err(Unidentified::Foreign)
    );

    let frame = udp_frame(7000, 2, &message(1));
    let cut = cut_datagram(&frame[..60]).unwrap();
    assert_eq!(flow("hil").identify(&cut), Err(Unidentified::CutShort));
    assert_eq!(
        flow("udp:port=7000").identify(&cut),
        Err(Unidentified::CutShort)
    );
}
