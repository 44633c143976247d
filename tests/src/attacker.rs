//! A stranger on the wire of a lab: a network namespace of its own, joined to the hosts' bridge, that
//! takes the address of a host, listens to what passes and sends what it likes. It judges nothing.

use std::fs::File;
use std::io::IoSlice;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddrV4, SocketAddrV6, UdpSocket};
use std::os::fd::AsRawFd;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, setns};
use nix::sys::prctl::set_timerslack;
use nix::sys::socket::{
    AddressFamily, MsgFlags, MultiHeaders, SockFlag, SockProtocol, SockType, recv, sendmmsg, socket,
};

use socket2::{Domain, Protocol, SockAddr, Socket, Type};

use crate::child;
use crate::lab::Lab;

/// An address of the hosts' network that is in no topology.
pub const FOREIGN: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 66);

/// No set-up command takes a tenth of this on an overloaded machine.
const SETUP_LIMIT: Duration = Duration::from_secs(20);
/// Ethernet, IPv4 without options and UDP.
const BEFORE_PAYLOAD_BYTES: usize = 14 + 20 + 8;
/// Datagrams of one burst, which one call to the kernel sends; the pace is kept between bursts.
const BURST: usize = 16;
/// It sleeps no shorter than this: about what a sleep takes.
const NAP_MIN: Duration = Duration::from_micros(50);

/// What a bridge does unless told otherwise: five minutes.
const SWITCH_AGEING: u32 = 30_000;

/// The stranger; dropping it takes its namespace away.
#[derive(Debug)]
pub struct Attacker {
    namespace: String,
    /// Where the bridge is.
    first: String,
}

/// What a flood came to.
#[derive(Debug, Clone, Copy, Default)]
pub struct Flood {
    /// Datagrams that left.
    pub sent_count: u64,
    /// How long it took.
    pub took: Duration,
}

impl Flood {
    /// Datagrams in a second.
    pub fn rate(&self) -> f64 {
        self.sent_count as f64 / self.took.as_secs_f64().max(1e-9)
    }
}

impl Attacker {
    /// Puts a bridge between the hosts of `lab` and joins it, with the address `as_host`. It knows the link addresses of both.
    ///
    /// # Panics
    /// When it cannot be built.
    pub fn join(lab: &Lab, as_host: Ipv4Addr) -> Self {
        lab.put_bridge_between();
        let first = lab.host(0).namespace();
        // The name of the lab with another host number, so that the next lab sweeps what a kill leaves.
        let name = &format!("{}2", first.trim_end_matches('0'));
        // From here on dropping it cleans up.
        let attacker = Self {
            namespace: name.clone(),
            first: first.to_owned(),
        };
        let built = [
            format!("netns add {name}"),
            format!("-n {first} link add port9 type veth peer name eth0 netns {name}"),
            format!("-n {first} link set port9 master bridge0 up"),
            // Without ARP it does not tell the hosts where to find the address it took.
            format!("-n {name} link set eth0 arp off"),
            format!("-n {name} address add {as_host}/24 dev eth0"),
            format!("-n {name} link set eth0 up"),
        ]
        .into_iter()
        .try_for_each(|words| ip(&words));
        if let Err(reason) = built {
            panic!("no attacker: {reason}");
        }
        for host in [0, 1].map(|index| lab.host(index)) {
            if host.address() != as_host {
                attacker.know(host.address().into(), &host.hardware_address());
            }
        }
        attacker
    }

    /// Runs `work` in a thread of the stranger's network.
    fn within<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        let path = format!("/run/netns/{}", self.namespace);
        let result = thread::scope(|scope| {
            let entered = scope.spawn(|| {
                let file = File::open(&path).map_err(|error| format!("{path}: {error}"))?;
                setns(file, CloneFlags::CLONE_NEWNET).map_err(|errno| errno.to_string())?;
                Ok::<T, String>(work())
            });
            entered.join()
        });
        match result {
            Ok(Ok(value)) => value,
            Ok(Err(reason)) => panic!("the attacker's network cannot be entered: {reason}"),
            Err(cause) => std::panic::resume_unwind(cause),
        }
    }

    /// Listens until `count` UDP payloads to port `port` have passed, or `limit` is over. Meanwhile the
    /// bridge is a hub, so that the stranger hears everything; afterwards it is a switch again, which does
    /// not have every host look at what it sends to one.
    ///
    /// # Panics
    /// When it cannot listen.
    pub fn overhear(&self, port: u16, count: usize, limit: Duration) -> Vec<Vec<u8>> {
        self.forget_after(0);
        let heard = self.listen(port, count, limit);
        self.forget_after(SWITCH_AGEING);
        heard
    }

    /// After how many hundredths of a second the bridge forgets where an address is.
    fn forget_after(&self, ageing: u32) {
        let first = &self.first;
        let words = format!("-n {first} link set bridge0 type bridge ageing_time {ageing}");
        if let Err(reason) = ip(&words) {
            panic!("the bridge does not change: {reason}");
        }
    }

    fn listen(&self, port: u16, count: usize, limit: Duration) -> Vec<Vec<u8>> {
        let mut heard = Vec::new();
        self.hear(limit, |frame| {
            heard.extend(payload_to(frame, port));
            heard.len() < count
        });
        heard
    }

    /// Hands every frame on the wire to `take` until that says that it is enough, or `limit` is over.
    fn hear(&self, limit: Duration, mut take: impl FnMut(&[u8]) -> bool + Send) {
        self.within(|| {
            let opened = socket(
                AddressFamily::Packet,
                SockType::Raw,
                SockFlag::SOCK_NONBLOCK,
                SockProtocol::EthAll,
            );
            let raw = match opened {
                Ok(raw) => raw,
                Err(errno) => panic!("no packet socket: {errno}"),
            };
            let deadline = Instant::now() + limit;
            let mut frame = [0; 2048];
            while Instant::now() < deadline {
                match recv(raw.as_raw_fd(), &mut frame, MsgFlags::MSG_DONTWAIT) {
                    Ok(length) if !take(&frame[..length]) => return,
                    Ok(_more) => {}
                    Err(_nothing_yet) => thread::sleep(Duration::from_millis(1)),
                }
            }
        });
    }

    /// Sends `datagrams` one after the other and again from the first, from `from` to `to`, for `span` at
    /// `rate` a second or as fast as it goes.
    ///
    /// # Panics
    /// When it has no socket, or nothing to send.
    pub fn flood(
        &self,
        from: SocketAddrV4,
        to: SocketAddrV4,
        span: Duration,
        rate: u32,
        datagrams: &[Vec<u8>],
    ) -> Flood {
        assert!(!datagrams.is_empty(), "nothing to send");
        self.within(|| {
            let opened = UdpSocket::bind(from).and_then(|one| one.connect(to).map(|()| one));
            let socket = match opened {
                Ok(socket) => socket,
                Err(error) => panic!("no socket for the attacker: {error}"),
            };
            let slices: Vec<_> = datagrams.iter().map(|one| [IoSlice::new(one)]).collect();
            let mut bursts = slices.chunks(BURST).cycle();
            let mut headers = MultiHeaders::<()>::preallocate(BURST, None);
            // So that it wakes in time for its next burst and need not send two at once.
            if let Err(errno) = set_timerslack(1) {
                panic!("the attacker's timers stay late: {errno}");
            }
            let began = Instant::now();
            let mut flood = Flood::default();
            let mut number = 0_u64;
            while began.elapsed() < span {
                let burst = bursts.next().unwrap_or_default();
                let flags = MsgFlags::empty();
                let sent = sendmmsg(
                    socket.as_raw_fd(),
                    &mut headers,
                    burst,
                    [None; BURST],
                    [],
                    flags,
                );
                // A refusal that comes back is no reason to stop.
                flood.sent_count += sent.map_or(0, |sent| sent.count() as u64);
                number += burst.len() as u64;
                let due = Duration::from_secs_f64(number as f64 / f64::from(rate));
                let early = due.saturating_sub(began.elapsed());
                if early > NAP_MIN {
                    thread::sleep(early);
                }
            }
            flood.took = began.elapsed();
            flood
        })
    }
}

impl Attacker {
    /// Answers for the address `host` on the network from now on, at the link address `hardware`, and says so to all.
    ///
    /// # Panics
    /// When it cannot.
    pub fn claim(&self, host: Ipv4Addr, hardware: &str) {
        let name = &self.namespace;
        let claimed = [
            format!("netns exec {name} sysctl -qw net.ipv4.conf.eth0.arp_notify=1"),
            format!("-n {name} link set eth0 arp on"),
            format!("-n {name} address replace {host}/24 dev eth0"),
            format!("-n {name} link set eth0 address {hardware}"),
        ]
        .into_iter()
        .try_for_each(|words| ip(&words));
        if let Err(reason) = claimed {
            panic!("{host} is not claimed: {reason}");
        }
    }

    /// Who sends datagrams to `port`.
    ///
    /// # Panics
    /// When none is heard within `limit`.
    pub fn overhear_sender(&self, port: u16, limit: Duration) -> SocketAddrV4 {
        let mut sender = None;
        self.forget_after(0);
        self.hear(limit, |frame| {
            sender = payload_to(frame, port).map(|_| {
                let ip = Ipv4Addr::new(frame[26], frame[27], frame[28], frame[29]);
                SocketAddrV4::new(ip, u16::from_be_bytes([frame[34], frame[35]]))
            });
            sender.is_none()
        });
        self.forget_after(SWITCH_AGEING);
        sender.unwrap_or_else(|| panic!("nobody is heard to send to port {port}"))
    }

    /// Forges resets in the peer's name, each exactly at the place in the stream that `victim` expects next, of
    /// the TCP connection that it is heard to have with `port` at one end, until a new one is begun or `limit` is
    /// over. Gives how many it sent.
    ///
    /// # Panics
    /// When it has no socket, or nothing of the connection is heard.
    pub fn reset(&self, port: u16, victim: Ipv4Addr, limit: Duration) -> u64 {
        let raw = self.within(|| {
            // Of the protocol 255 the headers are ours as well.
            match Socket::new(Domain::IPV4, Type::RAW, Some(Protocol::from(255))) {
                Ok(raw) => raw,
                Err(error) => panic!("no raw socket for the attacker: {error}"),
            }
        });
        let to = SockAddr::from(SocketAddrV4::new(victim, 0));
        let mut sent_count = 0;
        self.forget_after(0);
        self.hear(limit, |frame| {
            let Some(segment) = Segment::in_frame(frame, port) else {
                return true;
            };
            if segment.flags & TCP_SYN != 0 {
                return sent_count == 0;
            }
            if segment.flags & TCP_RST == 0 {
                sent_count += u64::from(raw.send_to(&segment.reset(victim), &to).is_ok());
            }
            true
        });
        self.forget_after(SWITCH_AGEING);
        assert!(sent_count > 0, "no connection heard");
        sent_count
    }

    /// From now on it knows that `host` has the link address `hardware`.
    ///
    /// # Panics
    /// When it cannot.
    pub fn know(&self, host: IpAddr, hardware: &str) {
        if let Err(reason) = ip(&neighbour(&self.namespace, host, hardware)) {
            panic!("{reason}");
        }
    }

    /// Takes the address `own` of IPv6 as well.
    ///
    /// # Panics
    /// When it cannot.
    pub fn add_address(&self, own: Ipv6Addr) {
        let words = format!("-n {} address add {own}/64 dev eth0 nodad", self.namespace);
        if let Err(reason) = ip(&words) {
            panic!("{reason}");
        }
    }

    /// Sends whole IPv4 packets, from whatever address they say, one after the other and again from the first, for
    /// `span` at `rate` a second. The kernel fills in the length and the checksum of the header.
    ///
    /// # Panics
    /// When it has no socket.
    pub fn send_repeatedly(&self, packets: &[Vec<u8>], span: Duration, rate: u32) -> Flood {
        let to = packets.iter().map(|packet| {
            let address: [u8; 4] = [packet[16], packet[17], packet[18], packet[19]];
            SockAddr::from(SocketAddrV4::new(address.into(), 0))
        });
        let packets: Vec<_> = packets.iter().cloned().zip(to).collect();
        // Of the protocol 255 the headers are ours as well.
        self.send_all((Domain::IPV4, Protocol::from(255)), &packets, span, rate)
    }

    /// Sends messages of ICMP for IPv6, of every type but neighbour advertisements, as reports on what was sent by `protocol`
    /// from the first of each pair of ends to the second, to the first, for `span` at `rate` a second.
    ///
    /// # Panics
    /// When it has no socket.
    pub fn forge_reports_v6(
        &self,
        protocol: Quoted,
        quoted: &[[SocketAddrV6; 2]],
        span: Duration,
        rate: u32,
    ) -> Flood {
        let kinds = (0..=255_u8).filter(|kind| *kind != NEIGHBOUR_ADVERTISEMENT);
        let kinds = kinds.flat_map(|kind| [0, 1, 4].map(|code| (kind, code)));
        let words = kinds.flat_map(|kind| {
            quoted.iter().map(move |ends| {
                let to = SocketAddrV6::new(*ends[0].ip(), 0, 0, 0);
                (report_v6(kind, protocol, *ends), SockAddr::from(to))
            })
        });
        let words: Vec<_> = words.collect();
        self.send_all((Domain::IPV6, Protocol::ICMPV6), &words, span, rate)
    }

    /// Says to `to` that the address `host` is at the link address `hardware` (RFC 4861, section 4.4), which replaces
    /// the one that is known.
    ///
    /// # Panics
    /// When it has no socket.
    pub fn claim_v6(&self, to: Ipv6Addr, host: Ipv6Addr, hardware: &str) {
        let bytes = hardware
            .split(':')
            .map(|byte| u8::from_str_radix(byte, 16).expect("a link address"));
        let mut word = vec![NEIGHBOUR_ADVERTISEMENT, 0, 0, 0, OVERRIDE, 0, 0, 0];
        word.extend(host.octets());
        // Target link-layer address, in units of eight bytes.
        word.extend([2, 1]);
        word.extend(bytes);
        let to = SockAddr::from(SocketAddrV6::new(to, 0, 0, 0));
        let span = Duration::from_millis(200);
        self.send_all((Domain::IPV6, Protocol::ICMPV6), &[(word, to)], span, 20);
    }

    /// Sends `to` forged reports of the network (ICMP) on datagrams from `quoted[0]` to `quoted[1]`, one kind
    /// after the other, for `span` at `rate` a second.
    ///
    /// # Panics
    /// When it has no socket.
    pub fn forge_reports(
        &self,
        to: Ipv4Addr,
        quoted: [SocketAddrV4; 2],
        span: Duration,
        rate: u32,
    ) -> Flood {
        let to = SockAddr::from(SocketAddrV4::new(to, 0));
        let words = REPORTS.map(|kind| (report(kind, Quoted::Udp, quoted), to.clone()));
        self.send_all((Domain::IPV4, Protocol::ICMPV4), &words, span, rate)
    }

    fn send_all(
        &self,
        (domain, protocol): (Domain, Protocol),
        words: &[(Vec<u8>, SockAddr)],
        span: Duration,
        rate: u32,
    ) -> Flood {
        self.within(|| {
            let opened = Socket::new(domain, Type::RAW, Some(protocol));
            let socket = match opened {
                Ok(socket) => socket,
                Err(error) => panic!("no raw socket for the attacker: {error}"),
            };
            if domain == Domain::IPV6
                && let Err(error) = socket.set_unicast_hops_v6(HOPS_OF_NEIGHBOURS)
            {
                panic!("the attacker's hop limit: {error}");
            }
            let began = Instant::now();
            let mut flood = Flood::default();
            for (number, (bytes, to)) in words.iter().cycle().enumerate() {
                if began.elapsed() >= span {
                    break;
                }
                flood.sent_count += u64::from(socket.send_to(bytes, to).is_ok());
                let due = Duration::from_secs_f64(number as f64 / f64::from(rate));
                thread::sleep(due.saturating_sub(began.elapsed()));
            }
            flood.took = began.elapsed();
            flood
        })
    }
}

/// A type of ICMP for IPv6, and its flag that what is known is to be replaced (RFC 4861).
const NEIGHBOUR_ADVERTISEMENT: u8 = 136;
const OVERRIDE: u8 = 0x20;
/// Without it no host believes a word of neighbour discovery.
const HOPS_OF_NEIGHBOURS: u32 = 255;

/// A message of ICMP for IPv6 (RFC 4443), as a report on what was sent by `protocol` from `quoted[0]` to `quoted[1]`. The
/// kernel fills in the checksum.
fn report_v6((kind, code): (u8, u8), protocol: Quoted, quoted: [SocketAddrV6; 2]) -> Vec<u8> {
    let (number, last) = protocol.wire();
    // Too long for the next hop of 1280 bytes, which is as short as any may be; else unused.
    let mut bytes = vec![kind, code, 0, 0, 0, 0, 5, 0];
    bytes.extend([0x60, 0, 0, 0, 0, 108, number, 64]);
    bytes.extend(quoted[0].ip().octets());
    bytes.extend(quoted[1].ip().octets());
    bytes.extend(quoted[0].port().to_be_bytes());
    bytes.extend(quoted[1].port().to_be_bytes());
    bytes.extend(last);
    bytes
}

/// The header of an IPv4 packet of `protocol`; the kernel fills in the length and the checksum.
fn header_v4(from: Ipv4Addr, to: Ipv4Addr, protocol: u8) -> Vec<u8> {
    let mut bytes = vec![0x45, 0, 0, 0, 0, 0, 0x40, 0, 64, protocol, 0, 0];
    bytes.extend(from.octets());
    bytes.extend(to.octets());
    bytes
}

/// A whole IPv4 packet of UDP, without a checksum.
///
/// # Panics
/// When the payload is longer than a packet.
pub fn datagram_v4(from: SocketAddrV4, to: SocketAddrV4, payload: &[u8]) -> Vec<u8> {
    let mut bytes = header_v4(*from.ip(), *to.ip(), 17);
    let length = u16::try_from(8 + payload.len()).expect("a short payload");
    bytes.extend(from.port().to_be_bytes());
    bytes.extend(to.port().to_be_bytes());
    bytes.extend(length.to_be_bytes());
    bytes.extend([0, 0]);
    bytes.extend(payload);
    bytes
}

/// The protocol of what a report of the network quotes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quoted {
    /// A datagram.
    Udp,
    /// A segment, with a sequence number that is a guess.
    Tcp,
}

impl Quoted {
    /// The number of the protocol, and what its header has behind the ports.
    const fn wire(self) -> (u8, [u8; 4]) {
        match self {
            Self::Udp => (17, [0, 108, 0, 0]),
            Self::Tcp => (6, [0, 0, 0, 1]),
        }
    }
}

/// A whole IPv4 packet with an ICMP message of `kind`, from the address quoted last, as a report on what was sent by
/// `protocol` from `quoted[0]` to `quoted[1]`.
pub fn report_v4(kind: u8, protocol: Quoted, quoted: [SocketAddrV4; 2]) -> Vec<u8> {
    let codes = REPORTS.iter().find(|known| known.0 == kind);
    let kind = codes.copied().unwrap_or((kind, 0, 0));
    [
        header_v4(*quoted[1].ip(), *quoted[0].ip(), 1),
        report(kind, protocol, quoted),
    ]
    .concat()
}

/// A whole IPv4 packet that begins a connection.
pub fn syn_v4(from: SocketAddrV4, to: SocketAddrV4) -> Vec<u8> {
    let segment = tcp(from, to, 1, TCP_SYN, &[]);
    [header_v4(*from.ip(), *to.ip(), 6), segment].concat()
}

/// A whole IPv4 packet that ends a connection whose receiver expects `sequence` next, and no other.
pub fn reset_v4(from: SocketAddrV4, to: SocketAddrV4, sequence: u32) -> Vec<u8> {
    let segment = tcp(from, to, sequence, TCP_RST, &[]);
    [header_v4(*from.ip(), *to.ip(), 6), segment].concat()
}

/// A whole IPv4 packet that brings `content` to a connection, as if its receiver expected `sequence` next.
///
/// # Panics
/// When the content is longer than a packet.
pub fn segment_v4(from: SocketAddrV4, to: SocketAddrV4, sequence: u32, content: &[u8]) -> Vec<u8> {
    let segment = tcp(from, to, sequence, TCP_ACK, content);
    [header_v4(*from.ip(), *to.ip(), 6), segment].concat()
}

/// A TCP segment with `content`.
///
/// # Panics
/// When the content is longer than a packet.
fn tcp(from: SocketAddrV4, to: SocketAddrV4, sequence: u32, flags: u8, content: &[u8]) -> Vec<u8> {
    let mut tcp = Vec::new();
    tcp.extend(from.port().to_be_bytes());
    tcp.extend(to.port().to_be_bytes());
    tcp.extend(sequence.to_be_bytes());
    tcp.extend([0, 0, 0, 0, 5 << 4, flags, 4, 0, 0, 0, 0, 0]);
    tcp.extend(content);
    let ends = [from.ip().octets(), to.ip().octets()].concat();
    let length = u16::try_from(tcp.len()).expect("a short segment");
    let [high, low] = length.to_be_bytes();
    let padding = vec![0; tcp.len() % 2];
    let sum = checksum(&[ends.as_slice(), &[0, 6, high, low], &tcp, &padding].concat());
    tcp[16..18].copy_from_slice(&sum);
    tcp
}

/// Type, code and the last four bytes of an ICMP header: network, host, protocol and port unreachable,
/// a packet too long for the next hop of 100 bytes, forbidden by a filter, time exceeded, a bad parameter.
const REPORTS: [(u8, u8, u32); 8] = [
    (3, 0, 0),
    (3, 1, 0),
    (3, 2, 0),
    (3, 3, 0),
    (3, 4, 100),
    (3, 13, 0),
    (11, 0, 0),
    (12, 0, 0),
];

/// An ICMP message (RFC 792) on what was sent from `quoted[0]` to `quoted[1]`.
fn report(
    (kind, code, rest): (u8, u8, u32),
    protocol: Quoted,
    quoted: [SocketAddrV4; 2],
) -> Vec<u8> {
    let mut bytes = vec![kind, code, 0, 0];
    bytes.extend(rest.to_be_bytes());
    // The header of the IPv4 packet, and the first eight bytes behind it.
    let (number, last) = protocol.wire();
    bytes.extend([0x45, 0, 0, 128, 0, 0, 0x40, 0, 64, number, 0, 0]);
    bytes.extend(quoted[0].ip().octets());
    bytes.extend(quoted[1].ip().octets());
    bytes.extend(quoted[0].port().to_be_bytes());
    bytes.extend(quoted[1].port().to_be_bytes());
    bytes.extend(last);
    let sum = checksum(&bytes);
    bytes[2..4].copy_from_slice(&sum);
    bytes
}

/// The checksum of IP, TCP and ICMP (RFC 1071) of an even number of bytes.
fn checksum(bytes: &[u8]) -> [u8; 2] {
    let words = bytes.chunks_exact(2);
    let mut sum: u32 = words
        .map(|pair| u32::from(u16::from_be_bytes([pair[0], pair[1]])))
        .sum();
    while sum > 0xffff {
        sum = (sum & 0xffff) + (sum >> 16);
    }
    let [_, _, high, low] = (!sum).to_be_bytes();
    [high, low]
}

const TCP_SYN: u8 = 2;
const TCP_RST: u8 = 4;
const TCP_ACK: u8 = 16;

/// What a stranger needs of a TCP segment that it heard.
struct Segment {
    from: SocketAddrV4,
    to: SocketAddrV4,
    /// The next byte that the receiver expects after it.
    next: u32,
    /// The next byte that the sender expects.
    acknowledged: u32,
    flags: u8,
}

impl Segment {
    /// The segment of an Ethernet frame of IPv4 with `port` at one end.
    fn in_frame(frame: &[u8], port: u16) -> Option<Self> {
        let packet = frame.get(14..).filter(|_| frame[12..14] == [8, 0])?;
        let is_tcp = *packet.get(9)? == 6;
        let (from, to) = (packet.get(12..16)?, packet.get(16..20)?);
        let tcp = packet
            .get(usize::from(packet[0] & 15) * 4..)
            .filter(|_| is_tcp)?;
        let head: &[u8; 20] = tcp.first_chunk()?;
        let whole = u32::from(u16::from_be_bytes([packet[2], packet[3]]));
        let heads = u32::from(packet[0] & 15) * 4 + u32::from(head[12] >> 4) * 4;
        let number =
            |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let end = |ip: &[u8], port: [u8; 2]| {
            let ip = Ipv4Addr::new(ip[0], ip[1], ip[2], ip[3]);
            SocketAddrV4::new(ip, u16::from_be_bytes(port))
        };
        let segment = Self {
            from: end(from, [head[0], head[1]]),
            to: end(to, [head[2], head[3]]),
            next: number(4).wrapping_add(whole.saturating_sub(heads)),
            acknowledged: number(8),
            flags: head[13],
        };
        [segment.from, segment.to]
            .iter()
            .any(|end| end.port() == port)
            .then_some(segment)
    }

    /// An IPv4 packet with a reset to `victim`, one of both ends, where it expects the next byte. The kernel fills in
    /// the length and the checksum of its header.
    fn reset(&self, victim: Ipv4Addr) -> Vec<u8> {
        let (from, to, next) = if *self.from.ip() == victim {
            (self.to, self.from, self.acknowledged)
        } else {
            (self.from, self.to, self.next)
        };
        reset_v4(from, to, next)
    }
}

impl Drop for Attacker {
    fn drop(&mut self) {
        let mut command = Command::new("ip");
        command.args(["netns", "delete", &self.namespace]);
        drop(child::run(&mut command, SETUP_LIMIT));
    }
}

/// Words of `ip` that have the namespace `name` know that `host` has the link address `hardware`.
fn neighbour(name: &str, host: IpAddr, hardware: &str) -> String {
    format!("-n {name} neigh replace {host} lladdr {hardware} dev eth0")
}

fn ip(words: &str) -> Result<(), String> {
    let mut command = Command::new("ip");
    child::run(command.args(words.split(' ')), SETUP_LIMIT).map(drop)
}

/// The payload of an IPv4 UDP frame to `port`.
fn payload_to(frame: &[u8], port: u16) -> Option<Vec<u8>> {
    let is_ours = frame.len() > BEFORE_PAYLOAD_BYTES
        && frame[12..15] == [0x08, 0x00, 0x45]
        && frame[23] == 17
        && frame[36..38] == port.to_be_bytes();
    is_ours.then(|| frame[BEFORE_PAYLOAD_BYTES..].to_vec())
}
