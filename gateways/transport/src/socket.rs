//! Setting up the socket of a transport: the settings, what the kernel granted of them and what it
//! refused. It moves no datagram.

use core::fmt::Display;
use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, SocketAddr};

use nix::sys::socket::{setsockopt, sockopt};
use socket2::{Domain, Protocol, SockAddr, Socket, Type};
use thiserror::Error;

use hil_net::timestamping::TimestampMode;

/// Largest buffer to ask for: the kernel doubles the value in an `int`.
const BUFFER_BYTES_MAX: usize = 0x3fff_ffff;

/// How to set up either end of a transport. Everything optional stays at the kernel's default when `None`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SocketSettings {
    /// Where this socket is: where a receiver listens, what a sender's datagrams come from. Port
    /// 0 lets the kernel choose. Sender and receiver of one channel need a port each.
    pub local: SocketAddr,
    /// Where the peer's receiver listens: the sender is connected to it and hears replies of it
    /// alone. A receiver uses it for the seal.
    pub peer: SocketAddr,
    /// Interface to bind both sockets to (`SO_BINDTODEVICE`).
    pub interface: Option<String>,
    /// Differentiated services code point of outgoing datagrams, 0..=63 (RFC 2474).
    pub dscp: Option<u8>,
    /// Priority in the queueing discipline (`SO_PRIORITY`); above 6 needs `CAP_NET_ADMIN`.
    pub priority: Option<u32>,
    /// Send buffer in bytes (`SO_SNDBUF`).
    pub send_buffer_bytes: Option<usize>,
    /// Receive buffer in bytes (`SO_RCVBUF`).
    pub receive_buffer_bytes: Option<usize>,
    /// Which stamps to ask for.
    pub timestamps: TimestampMode,
    /// Ask the radio which datagrams the peer radio acknowledged (`SO_WIFI_STATUS`). An interface
    /// that is not wireless reports nothing.
    pub wants_radio_reports: bool,
    /// Largest IP packet that the path is said to take.
    pub path_mtu_bytes: Option<usize>,
    /// The transport's own options, by their keys in a topology.
    pub options: BTreeMap<String, i64>,
}

impl SocketSettings {
    /// The kernel's defaults and software stamps.
    pub const fn new(local: SocketAddr, peer: SocketAddr) -> Self {
        Self {
            local,
            peer,
            interface: None,
            dscp: None,
            priority: None,
            send_buffer_bytes: None,
            receive_buffer_bytes: None,
            timestamps: TimestampMode::Software,
            wants_radio_reports: false,
            path_mtu_bytes: None,
            options: BTreeMap::new(),
        }
    }
}

/// Why a socket could not be set up.
#[derive(Debug, Error)]
pub enum SocketError {
    /// A code point of more than six bits.
    #[error("dscp {dscp} is outside 0 to 63")]
    Dscp {
        /// The value.
        dscp: u8,
    },
    /// A buffer larger than the kernel can account.
    #[error("{option} of {bytes} bytes is above {BUFFER_BYTES_MAX}")]
    Buffer {
        /// The socket option.
        option: &'static str,
        /// The value.
        bytes: usize,
    },
    /// One address is IPv4 and the other IPv6.
    #[error("local address {local} and peer address {peer} are of different IP versions")]
    Family {
        /// The local address.
        local: SocketAddr,
        /// The peer's address.
        peer: SocketAddr,
    },
    /// The kernel refused a step of the set-up.
    #[error("{option} = {value} was refused: {source}")]
    Refused {
        /// The socket option or call.
        option: &'static str,
        /// What it was to be.
        value: String,
        /// What the kernel answered.
        source: io::Error,
    },
}

/// What the kernel granted of the settings of one socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GrantedOptions {
    /// `SO_SNDBUF` in bytes as the kernel accounts it: twice the request when granted in full.
    pub send_buffer_bytes: usize,
    /// `SO_RCVBUF` in bytes as the kernel accounts it: twice the request when granted in full.
    pub receive_buffer_bytes: usize,
    /// `SO_PRIORITY`.
    pub priority: u32,
    /// Differentiated services code point.
    pub dscp: u8,
}

impl GrantedOptions {
    /// The socket and what it was granted, for the user to read.
    pub fn facts(&self, settings: &SocketSettings) -> Vec<(String, String)> {
        let ends = format!("{} to or from {}", settings.local, settings.peer);
        let mut facts = vec![
            ("socket".to_owned(), ends),
            (
                "send buffer granted".to_owned(),
                format!("{} bytes", self.send_buffer_bytes),
            ),
            (
                "receive buffer granted".to_owned(),
                format!("{} bytes", self.receive_buffer_bytes),
            ),
        ];
        let shortfalls = self.shortfalls(settings).into_iter();
        facts.extend(shortfalls.map(|text| ("socket option".to_owned(), text)));
        facts
    }

    /// One line per setting that the kernel granted less of than asked, for the user to read.
    pub fn shortfalls(&self, settings: &SocketSettings) -> Vec<String> {
        let buffer = |name: &str, requested: Option<usize>, granted: usize| {
            let doubled = requested?.saturating_mul(2);
            (granted < doubled).then(|| {
                format!("{name}: asked for {doubled} bytes with overhead, granted {granted}")
            })
        };
        let (send, receive) = (settings.send_buffer_bytes, settings.receive_buffer_bytes);
        let priority = settings.priority.filter(|asked| *asked != self.priority);
        let dscp = settings.dscp.filter(|asked| *asked != self.dscp);
        [
            buffer("SO_SNDBUF", send, self.send_buffer_bytes),
            buffer("SO_RCVBUF", receive, self.receive_buffer_bytes),
            priority.map(|p| format!("SO_PRIORITY: asked for {p}, granted {}", self.priority)),
            dscp.map(|d| format!("dscp: asked for {d}, granted {}", self.dscp)),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Names the option and its value in a refusal.
pub(crate) fn refuse<T>(
    option: &'static str,
    value: impl Display,
    result: io::Result<T>,
) -> Result<T, SocketError> {
    result.map_err(|source| SocketError::Refused {
        option,
        value: value.to_string(),
        source,
    })
}

/// A non-blocking IP socket with what every transport sets before it binds, connects or listens. The
/// receive buffer is among it: it decides the window scale of TCP, which the first packet settles.
pub(crate) fn open(
    settings: &SocketSettings,
    kind: Type,
    protocol: Protocol,
    label: &'static str,
) -> Result<Socket, SocketError> {
    let domain = Domain::for_address(settings.local);
    let socket = refuse("socket", label, Socket::new(domain, kind, Some(protocol)))?;
    refuse("O_NONBLOCK", true, socket.set_nonblocking(true))?;
    if let Some(interface) = &settings.interface {
        let bound = socket.bind_device(Some(interface.as_bytes()));
        refuse("SO_BINDTODEVICE", interface, bound)?;
    }
    set_buffers(&socket, settings)?;
    mark(&socket, settings)?;
    Ok(socket)
}

/// Sizes the buffers. Beyond `net.core.wmem_max` and `rmem_max` that takes `CAP_NET_ADMIN`; what
/// remains short without it is reported by [`GrantedOptions`].
fn set_buffers(socket: &Socket, settings: &SocketSettings) -> Result<(), SocketError> {
    if let Some(bytes) = settings.send_buffer_bytes {
        let doubled = doubled_buffer("SO_SNDBUF", bytes)?;
        refuse("SO_SNDBUF", bytes, socket.set_send_buffer_size(bytes))?;
        if refuse("SO_SNDBUF", "read", socket.send_buffer_size())? < doubled {
            setsockopt(socket, sockopt::SndBufForce, &bytes).ok();
        }
    }
    if let Some(bytes) = settings.receive_buffer_bytes {
        let doubled = doubled_buffer("SO_RCVBUF", bytes)?;
        refuse("SO_RCVBUF", bytes, socket.set_recv_buffer_size(bytes))?;
        if refuse("SO_RCVBUF", "read", socket.recv_buffer_size())? < doubled {
            setsockopt(socket, sockopt::RcvBufForce, &bytes).ok();
        }
    }
    Ok(())
}

/// What the kernel accounts for a buffer of `bytes` when it grants all of it.
fn doubled_buffer(option: &'static str, bytes: usize) -> Result<usize, SocketError> {
    if bytes > BUFFER_BYTES_MAX {
        return Err(SocketError::Buffer { option, bytes });
    }
    Ok(2 * bytes)
}

/// Code point first: `IP_TOS` resets `SO_PRIORITY`.
pub(crate) fn mark(socket: &Socket, settings: &SocketSettings) -> Result<(), SocketError> {
    if let Some(dscp) = settings.dscp {
        if dscp > 63 {
            return Err(SocketError::Dscp { dscp });
        }
        let class = u32::from(dscp) << 2;
        if settings.local.is_ipv4() {
            refuse("IP_TOS", class, socket.set_tos_v4(class))?;
        } else {
            refuse("IPV6_TCLASS", class, socket.set_tclass_v6(class))?;
        }
    }
    if let Some(priority) = settings.priority {
        refuse("SO_PRIORITY", priority, socket.set_priority(priority))?;
    }
    Ok(())
}

pub(crate) fn bind(socket: &Socket, address: SocketAddr) -> Result<(), SocketError> {
    refuse("bind", address, socket.bind(&SockAddr::from(address)))
}

pub(crate) fn granted_options(
    socket: &Socket,
    settings: &SocketSettings,
) -> Result<GrantedOptions, SocketError> {
    let class = match settings.local.ip() {
        IpAddr::V4(_) => socket.tos_v4(),
        IpAddr::V6(_) => socket.tclass_v6(),
    };
    let class = refuse("traffic class", "read", class)?;
    Ok(GrantedOptions {
        send_buffer_bytes: refuse("SO_SNDBUF", "read", socket.send_buffer_size())?,
        receive_buffer_bytes: refuse("SO_RCVBUF", "read", socket.recv_buffer_size())?,
        priority: refuse("SO_PRIORITY", "read", socket.priority())?,
        dscp: u8::try_from((class >> 2) & 63).expect("masked to six bits"),
    })
}

pub(crate) fn local_address(socket: &Socket) -> io::Result<SocketAddr> {
    let address = socket.local_addr()?.as_socket();
    address.ok_or_else(|| io::Error::from(io::ErrorKind::AddrNotAvailable))
}
