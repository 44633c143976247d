//! Requests to the kernel's route netlink in the network namespace of this thread, each answered before the
//! next: pairs of interfaces, addresses, routes.

use std::io;
use std::net::IpAddr;
use std::os::fd::{AsRawFd, BorrowedFd};

use netlink_packet_core::{
    NLM_F_ACK, NLM_F_CREATE, NLM_F_EXCL, NLM_F_REQUEST, NetlinkHeader, NetlinkMessage,
    NetlinkPayload,
};
use netlink_packet_route::address::{AddressAttribute, AddressFlags, AddressMessage};
use netlink_packet_route::link::{
    InfoData, InfoKind, InfoVeth, LinkAttribute, LinkFlags, LinkInfo, LinkMessage,
};
use netlink_packet_route::route::{
    RouteAddress, RouteAttribute, RouteHeader, RouteMessage, RouteProtocol, RouteScope, RouteType,
};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use netlink_sys::protocols::NETLINK_ROUTE;
use netlink_sys::{Socket, SocketAddr};

use crate::MTU_BYTES;

/// `lo` of a new namespace.
pub(crate) const LOOPBACK: u32 = 1;
/// Of both ends of the cable, each in a namespace with nothing but `lo`, and what a kernel adds on its own.
pub(crate) const INDEX: u32 = 1000;

/// Addresses that have their first bits in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Network {
    /// One of them.
    pub(crate) address: IpAddr,
    /// How many bits.
    pub(crate) prefix_length: u8,
}

/// One interface of a pair.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairEnd<'a> {
    pub(crate) index: u32,
    pub(crate) name: &'a str,
    /// The kernel draws one where none is given.
    pub(crate) hardware_address: Option<[u8; 6]>,
    /// This thread's where none is given.
    pub(crate) namespace: Option<BorrowedFd<'a>>,
}

/// A conversation with the kernel.
#[derive(Debug)]
pub(crate) struct Netlink(Socket);

impl Netlink {
    pub(crate) fn open() -> io::Result<Self> {
        let socket = Socket::new(NETLINK_ROUTE)?;
        socket.connect(&SocketAddr::new(0, 0))?;
        Ok(Self(socket))
    }

    /// A pair of interfaces, each in its namespace, both down.
    pub(crate) fn make_pair(&self, ends: [PairEnd<'_>; 2]) -> io::Result<()> {
        let [mut near, far] = ends.map(|end| {
            let mut link = LinkMessage::default();
            link.header.index = end.index;
            link.attributes
                .push(LinkAttribute::IfName(end.name.to_owned()));
            link.attributes.push(LinkAttribute::Mtu(MTU_BYTES));
            let hardware_address = end.hardware_address.map(|octets| octets.to_vec());
            link.attributes
                .extend(hardware_address.map(LinkAttribute::Address));
            let there = end.namespace.map(|namespace| namespace.as_raw_fd());
            link.attributes.extend(there.map(LinkAttribute::NetNsFd));
            link
        });
        near.attributes.push(LinkAttribute::LinkInfo(vec![
            LinkInfo::Kind(InfoKind::Veth),
            LinkInfo::Data(InfoData::Veth(InfoVeth::Peer(far))),
        ]));
        self.ask(
            RouteNetlinkMessage::NewLink(near),
            NLM_F_CREATE | NLM_F_EXCL,
        )
    }

    /// Brings an interface here up.
    pub(crate) fn bring_up(&self, index: u32) -> io::Result<()> {
        let mut link = LinkMessage::default();
        link.header.index = index;
        link.header.flags = LinkFlags::Up;
        link.header.change_mask = LinkFlags::Up;
        self.ask(RouteNetlinkMessage::SetLink(link), 0)
    }

    /// An address of an interface here, usable at once, with a route to the network behind it.
    pub(crate) fn give_address(
        &self,
        index: u32,
        address: IpAddr,
        behind: Network,
    ) -> io::Result<()> {
        let mut message = AddressMessage::default();
        message.header.index = index;
        message.header.prefix_len = behind.prefix_length;
        message.header.family = match address {
            IpAddr::V4(_) => AddressFamily::Inet,
            IpAddr::V6(_) => AddressFamily::Inet6,
        };
        message.attributes.push(AddressAttribute::Local(address));
        message
            .attributes
            .push(AddressAttribute::Address(behind.address));
        if address.is_ipv6() {
            message
                .attributes
                .push(AddressAttribute::Flags(AddressFlags::Nodad));
        }
        self.ask(RouteNetlinkMessage::NewAddress(message), NLM_F_CREATE)
    }

    /// A way for IPv4 multicast by an interface here.
    pub(crate) fn route_multicast(&self, index: u32) -> io::Result<()> {
        let mut route = RouteMessage::default();
        route.header = RouteHeader {
            address_family: AddressFamily::Inet,
            destination_prefix_length: 4,
            table: RouteHeader::RT_TABLE_MAIN,
            protocol: RouteProtocol::Boot,
            scope: RouteScope::Link,
            kind: RouteType::Unicast,
            ..RouteHeader::default()
        };
        let multicast = RouteAddress::Inet([224, 0, 0, 0].into());
        route
            .attributes
            .push(RouteAttribute::Destination(multicast));
        route.attributes.push(RouteAttribute::Oif(index));
        self.ask(RouteNetlinkMessage::NewRoute(route), NLM_F_CREATE)
    }

    /// Sends one request and waits for its answer.
    fn ask(&self, request: RouteNetlinkMessage, flags: u16) -> io::Result<()> {
        let mut header = NetlinkHeader::default();
        header.flags = NLM_F_REQUEST | NLM_F_ACK | flags;
        let mut message = NetlinkMessage::new(header, NetlinkPayload::from(request));
        message.finalize();
        let mut bytes = vec![0; message.buffer_len()];
        message.serialize(&mut bytes);
        self.0.send(&bytes, 0)?;
        let (answer, _) = self.0.recv_from_full()?;
        let answer = NetlinkMessage::<RouteNetlinkMessage>::deserialize(&answer);
        match answer.map_err(io::Error::other)?.payload {
            NetlinkPayload::Error(answer) if answer.code.is_some() => Err(answer.to_io()),
            _ => Ok(()),
        }
    }
}
