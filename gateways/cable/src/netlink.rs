//! Requests to the kernel's route netlink in the network namespace of this thread, each answered before the
//! next: the pair of interfaces, addresses, routes.

use std::fs::File;
use std::io;
use std::net::IpAddr;
use std::os::fd::AsRawFd;

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

use crate::{INTERFACE, Inside, MTU_BYTES};

/// `lo` of a new namespace.
pub(crate) const LOOPBACK: u32 = 1;
/// Of both ends of the cable, each in a namespace with nothing but `lo`, and what a kernel adds on its own.
pub(crate) const INDEX: u32 = 1000;

/// A conversation with the kernel.
#[derive(Debug)]
pub(crate) struct Netlink(Socket);

impl Netlink {
    pub(crate) fn open() -> io::Result<Self> {
        let socket = Socket::new(NETLINK_ROUTE)?;
        socket.connect(&SocketAddr::new(0, 0))?;
        Ok(Self(socket))
    }

    /// The program's interface here, and the cable's end in the namespace `there`, both down.
    pub(crate) fn make_cable(&self, inside: &Inside, there: &File) -> io::Result<()> {
        let end = |name: &str| {
            let mut end = LinkMessage::default();
            end.header.index = INDEX;
            end.attributes.push(LinkAttribute::IfName(name.to_owned()));
            end.attributes.push(LinkAttribute::Mtu(MTU_BYTES));
            end
        };
        let mut far = end("cable");
        far.attributes
            .push(LinkAttribute::NetNsFd(there.as_raw_fd()));
        let mut near = end(INTERFACE);
        near.attributes
            .push(LinkAttribute::Address(inside.hardware_address().to_vec()));
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

    /// The program's address, usable at once, and for IPv4 a way for multicast.
    pub(crate) fn give_address(&self, inside: &Inside) -> io::Result<()> {
        let mut message = AddressMessage::default();
        message.header.index = INDEX;
        message.header.prefix_len = inside.prefix_length();
        message.header.family = match inside.address {
            IpAddr::V4(_) => AddressFamily::Inet,
            IpAddr::V6(_) => AddressFamily::Inet6,
        };
        message
            .attributes
            .push(AddressAttribute::Local(inside.address));
        message
            .attributes
            .push(AddressAttribute::Address(inside.address));
        if inside.address.is_ipv6() {
            message
                .attributes
                .push(AddressAttribute::Flags(AddressFlags::Nodad));
        }
        self.ask(RouteNetlinkMessage::NewAddress(message), NLM_F_CREATE)?;
        if inside.address.is_ipv6() {
            return Ok(());
        }
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
        route.attributes.push(RouteAttribute::Oif(INDEX));
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
