//! Datagrams in what carries them: tunnels and protocols that are read, those that are not, and frames beside them
//! that hold none. The second point saw all of the stream but number 20.

use super::super::join::{Doubt, JoinMetrics};
use super::super::watch::{ProtocolSpace, Unread};
use super::cases::{BEGIN_US, datagram, doubts, first_point, joins_of, pcap};

const ENDS: [u8; 8] = [192, 0, 2, 1, 192, 0, 2, 2];

/// The frame that carries a datagram, by its number.
type Frames<'a> = &'a dyn Fn(u32) -> Vec<u8>;

fn at_us(n: u32) -> i64 {
    BEGIN_US + 100_000 * i64::from(n) + 1000
}

/// The second point saw these frames instead of the datagrams.
fn carried(link_type: u8, frame: impl Fn(u32) -> Vec<u8>) -> JoinMetrics {
    let numbers = (0..100).filter(|n| *n != 20);
    let packets: Vec<_> = numbers.map(|n| (at_us(n), frame(n))).collect();
    let mut file = pcap(&packets);
    file[20] = link_type;
    joins_of(&first_point(), &file, true).remove(0)
}

fn ethernet(ether_type: u16, inner: &[u8]) -> Vec<u8> {
    let mut frame = datagram(0, 32)[..12].to_vec();
    frame.extend(ether_type.to_be_bytes());
    frame.extend(inner);
    frame
}

fn ip(protocol: u8, inner: &[u8]) -> Vec<u8> {
    let mut packet = vec![0x45, 0];
    packet.extend(u16::try_from(20 + inner.len()).unwrap().to_be_bytes());
    packet.extend([0, 9, 0, 0, 64, protocol, 0, 0]);
    packet.extend(ENDS);
    packet.extend(inner);
    ethernet(0x0800, &packet)
}

fn udp(source_port: u16, port: u16, inner: &[u8]) -> Vec<u8> {
    let length = u16::try_from(8 + inner.len()).unwrap();
    let header = [source_port, port, length, 0].map(u16::to_be_bytes);
    ip(17, &[header.as_flattened(), inner].concat())
}

fn behind(header: &[u8], inner: &[u8]) -> Vec<u8> {
    [header, inner].concat()
}

#[test]
fn datagrams_in_tunnels_that_are_read_are_the_stream() {
    let bare = |n: u32| datagram(n, 32)[14..].to_vec();
    let whole = |n: u32| datagram(n, 32);
    let network_id = [8, 0, 0, 0, 0, 0, 7, 0];
    let frames: [(&str, Frames<'_>); 13] = [
        ("VXLAN", &|n| udp(9, 4789, &behind(&network_id, &whole(n)))),
        ("VXLAN of Linux", &|n| {
            udp(9, 8472, &behind(&network_id, &whole(n)))
        }),
        // One word of options.
        ("Geneve", &|n| {
            let header = [1, 0, 0x65, 0x58, 0, 0, 7, 0, 0, 1, 2, 0];
            udp(9, 6081, &behind(&header, &whole(n)))
        }),
        ("Geneve, bare", &|n| {
            udp(9, 6081, &behind(&[0, 0, 8, 0, 0, 0, 7, 0], &bare(n)))
        }),
        ("GTP-U", &|n| {
            udp(
                2152,
                2152,
                &behind(&[0x30, 255, 0, 60, 0, 0, 0, 1], &bare(n)),
            )
        }),
        // A number and a container of a PDU session, as on N3.
        ("GTP-U, 5G", &|n| {
            let header = [0x36, 255, 0, 68, 0, 0, 0, 1, 0, 9, 0, 0x85, 1, 0x10, 1, 0];
            udp(2152, 2152, &behind(&header, &bare(n)))
        }),
        ("MPLS in UDP", &|n| {
            udp(9, 6635, &behind(&[0, 6, 65, 64], &bare(n)))
        }),
        ("MPLS in IP", &|n| {
            ip(137, &behind(&[0, 6, 65, 64], &bare(n)))
        }),
        ("Ethernet in IP", &|n| {
            ip(97, &behind(&[0x30, 0], &whole(n)))
        }),
        ("Ethernet by segment routing", &|n| ip(143, &whole(n))),
        ("ERSPAN", &|n| {
            let header = [0x10, 0, 0x88, 0xbe, 0, 0, 0, 1, 0x10, 7, 0, 1, 0, 0, 0, 0];
            ip(47, &behind(&header, &whole(n)))
        }),
        ("backbone", &|n| {
            ethernet(0x88e7, &behind(&[0, 0, 0, 7], &whole(n)))
        }),
        ("LLC of RFC 948", &|n| {
            let inner = behind(&[6, 6, 3], &bare(n));
            ethernet(u16::try_from(inner.len()).unwrap(), &inner)
        }),
    ];
    for (name, frame) in frames {
        let figures = carried(1, frame);
        let told = (figures.loss.count(), figures.matched_count);
        assert_eq!(told, (Some(1), 99), "{name}: {figures:#?}");
    }
    // Every other one through a tunnel.
    let half = carried(1, |n| match n % 2 {
        0 => whole(n),
        _ => udp(9, 4789, &behind(&network_id, &whole(n))),
    });
    assert_eq!((half.loss.count(), half.matched_count), (Some(1), 99));
}

#[test]
fn datagrams_in_what_is_not_read_make_loss_unavailable_by_name() {
    use ProtocolSpace::{AddressFamily, EtherType, Ip, Llc, Ppp, Snap};
    let bare = |n: u32| datagram(n, 32)[14..].to_vec();
    let whole = |n: u32| datagram(n, 32);
    let protocol = |space, number| Unread::Protocol { space, number };
    let frames: [(u8, Unread, Frames<'_>); 16] = [
        (1, Unread::Encrypted, &|n| {
            udp(4500, 4500, &behind(&[0, 0, 0x12, 0x34], &whole(n)))
        }),
        (1, Unread::Encrypted, &|n| {
            udp(51820, 9, &behind(&[4, 0, 0, 0], &whole(n)))
        }),
        (1, Unread::Tunnel { port: 1701 }, &|n| {
            udp(1701, 1701, &behind(&[0, 2, 0, 1, 0, 1, 0, 0x21], &bare(n)))
        }),
        (1, protocol(EtherType, 0xdada), &|n| {
            ethernet(0xdada, &whole(n)[6..])
        }),
        (1, protocol(EtherType, 0x8909), &|n| {
            ethernet(0x8909, &behind(&[1, 1, 0, 1, 0, 7, 8, 0], &bare(n)))
        }),
        (1, protocol(EtherType, 0x22f3), &|n| {
            ethernet(0x22f3, &whole(n))
        }),
        (1, protocol(EtherType, 0x22eb), &|n| {
            ip(
                47,
                &behind(&[0x10, 0, 0x22, 0xeb], &[&[0; 16], &whole(n)[..]].concat()),
            )
        }),
        (1, protocol(Ip, 115), &|n| {
            ip(115, &behind(&[0, 0, 0, 7], &whole(n)))
        }),
        (1, protocol(Ip, 108), &|n| ip(108, &bare(n))),
        (1, protocol(Llc, 0x9a), &|n| {
            ethernet(60, &behind(&[0x9a, 0x9a, 3], &bare(n)))
        }),
        (1, protocol(Snap, 0x80c2), &|n| {
            let inner = behind(&[0xaa, 0xaa, 3, 0, 0x80, 0xc2, 0, 7], &whole(n));
            ethernet(u16::try_from(inner.len()).unwrap(), &inner)
        }),
        (9, protocol(Ppp, 0x3d), &|n| {
            behind(&[0xff, 3, 0, 0x3d, 0xc0, 0, 0, 0, 0, 0x21], &bare(n))
        }),
        (9, protocol(Ppp, 5), &|n| behind(&[0xff, 3, 0, 5], &bare(n))),
        (9, protocol(Ppp, 0x67), &|n| behind(&[0x67], &bare(n))),
        (9, Unread::Encrypted, &|n| behind(&[0, 0xfb], &bare(n))),
        (0, protocol(AddressFamily, 99), &|n| {
            behind(&[99, 0, 0, 0], &bare(n))
        }),
    ];
    for (link_type, why, frame) in frames {
        let figures = carried(link_type, frame);
        assert_eq!(doubts(&figures), [(Doubt::Unread(why), 99)], "{why:?}");
    }
}

#[test]
fn frames_that_hold_no_datagram_hide_no_loss() {
    let llc = |inner: &[u8]| ethernet(u16::try_from(inner.len()).unwrap(), inner);
    let snap = |rest: &[u8]| llc(&[&[0xaa, 0xaa, 3][..], rest].concat());
    let mut beside = vec![
        // Spanning tree, IS-IS, IPX, exchange of identities; CDP and per-VLAN spanning trees.
        llc(&[0x42, 0x42, 3, 0, 0, 0, 0, 0]),
        llc(&[0xfe, 0xfe, 3, 0x83, 0, 0]),
        llc(&[0xff, 0xff, 0, 34]),
        llc(&[0, 1, 0xaf, 0x81, 1, 0]),
        snap(&[0, 0, 0x0c, 0x20, 0, 2, 0xb4]),
        snap(&[0, 0, 0x0c, 1, 0x0b, 0, 0]),
        snap(&[0, 0, 0, 0x81, 0x37, 0, 0]),
        // mDNS, DHCP, and a client whose own port is of no tunnel; a NAT kept open, and IPsec's key exchange.
        udp(5353, 5353, &[0; 40]),
        udp(68, 67, &[0; 240]),
        udp(40_000, 53, &[0; 30]),
        udp(4500, 4500, &[0xff]),
        udp(4500, 4500, &[0; 60]),
        // What keeps a GRE tunnel and a GTP path alive.
        ip(47, &[0, 0, 0, 0]),
        udp(2152, 2152, &[0x32, 1, 0, 4, 0, 0, 0, 0, 0, 1, 0, 0]),
    ];
    // ARP, LLDP, PTP, EAPOL, LACP, flow control, PROFINET, EtherCAT, GOOSE, sampled values, PRP, CFM, IEEE 1905, loop test.
    let ether_types = [
        0x0806, 0x88cc, 0x88f7, 0x888e, 0x8809, 0x8808, 0x8892, 0x88a4, 0x88b8, 0x88ba, 0x88fb,
        0x8902, 0x893a, 0x9000,
    ];
    beside.extend(ether_types.map(|kind| ethernet(kind, &[1; 46])));
    // ICMP, IGMP, TCP, EIGRP, OSPF, PIM, VRRP, SCTP.
    beside.extend([1, 2, 6, 88, 89, 103, 112, 132].map(|protocol| ip(protocol, &[1; 40])));
    // ICMPv6 and its listeners behind a hop-by-hop header, IPv6 without a next header.
    for (next, rest) in [(58, [1; 8]), (0, [58, 0, 5, 2, 0, 0, 1, 0]), (59, [0; 8])] {
        let mut packet = vec![0x60, 0, 0, 0, 0, 8, next, 1];
        packet.extend([0xfe; 32]);
        packet.extend(rest);
        beside.push(ethernet(0x86dd, &packet));
    }
    let mut packets = Vec::new();
    for n in (0..100).filter(|n| *n != 20) {
        packets.push((at_us(n), datagram(n, 32)));
        let frame = &beside[n as usize % beside.len()];
        packets.push((at_us(n) + 7, frame.clone()));
    }
    let figures = &joins_of(&first_point(), &pcap(&packets), true)[0];
    let told = (
        figures.loss.count(),
        figures.edge_count,
        figures.matched_count,
    );
    assert_eq!(told, (Some(1), 0, 99), "{figures:#?}");
    // Cooked: a CAN bus and IPX beside it; and the control of PPP.
    let cooked = |kind: u16, inner: &[u8]| {
        let mut frame = vec![0; 14];
        frame.extend(kind.to_be_bytes());
        frame.extend(inner);
        frame
    };
    for (link_type, is_cooked) in [(113, true), (9, false)] {
        let mut packets = Vec::new();
        for n in (0..100).filter(|n| *n != 20) {
            let bare = &datagram(n, 32)[14..];
            if is_cooked {
                packets.push((at_us(n), cooked(0x0800, bare)));
                packets.push((
                    at_us(n) + 7,
                    cooked([0x000c, 0x0001][n as usize % 2], &[9; 16]),
                ));
            } else {
                packets.push((at_us(n), behind(&[0xff, 3, 0, 0x21], bare)));
                let control = [
                    [0xc0, 0x21],
                    [0xc2, 0x23],
                    [0x80, 0x57],
                    [0, 0x2b],
                    [0, 0x2d],
                ];
                let frame = behind(&[0xff, 3], &control[n as usize % control.len()]);
                packets.push((at_us(n) + 7, behind(&frame, &[1; 8])));
            }
        }
        let mut file = pcap(&packets);
        file[20] = link_type;
        let figures = &joins_of(&first_point(), &file, true)[0];
        assert_eq!(figures.loss.count(), Some(1), "{link_type}: {figures:#?}");
    }
}

#[test]
fn a_tunnel_that_is_followed_itself_is_not_looked_into() {
    let outer = |n: u32| {
        let mut frame = datagram(n, 32);
        frame[36..38].copy_from_slice(&4789_u16.to_be_bytes());
        frame
    };
    let packets = |from_us: i64| {
        let packet = |n: u32| (from_us + 100_000 * i64::from(n), outer(n));
        pcap(&(0..50).map(packet).collect::<Vec<_>>())
    };
    let files = [packets(BEGIN_US), packets(BEGIN_US + 1000)];
    let joins = super::cases::joins_by("udp:dport=4789,id=0+4", &files[0], &files[1], true);
    assert_eq!(joins[0].matched_count, 50);
}
