//! What is known of a transport before anything of it is opened: its name, what it can do and its
//! own keys in a topology. The transports themselves, and the list of them, are in
//! `hil_transport`; whoever plans, checks or reports a run needs only this.

use core::net::IpAddr;

/// A transport as the topology, the doctor and a report see it.
#[derive(Debug, PartialEq, Eq)]
pub struct Description {
    /// The word after `via =`, and in the summary.
    pub name: &'static str,
    /// What a reader calls it.
    pub label: &'static str,
    /// What it can do.
    pub capabilities: Capabilities,
    /// Its own keys of a link; those that every transport has stand in the topology.
    pub options: &'static [TransportOption],
}

/// What a transport can do, and what its sockets take of the host.
#[derive(Debug, PartialEq, Eq)]
pub struct Capabilities {
    /// Why the kernel stamps none of its datagrams; `None` where it does.
    pub unstamped_because: Option<&'static str>,
    /// A radio can say which of its datagrams the peer radio acknowledged.
    pub has_radio_reports: bool,
    /// It cuts what it carries to the size of the path itself, so that no message is too long.
    pub cuts_to_path: bool,
    /// The port a sender binds; `None` where it binds none, or the kernel chooses it.
    pub sender_port: Option<IpProtocol>,
    /// The port a receiver binds.
    pub receiver_port: Option<IpProtocol>,
    /// Bytes of a packet before a datagram, over IPv4.
    pub ipv4_header_bytes: usize,
    /// The same over IPv6.
    pub ipv6_header_bytes: usize,
}

impl Capabilities {
    /// Bytes of a packet before a datagram, between addresses like `address`.
    pub const fn header_bytes(&self, address: IpAddr) -> usize {
        match address {
            IpAddr::V4(_) => self.ipv4_header_bytes,
            IpAddr::V6(_) => self.ipv6_header_bytes,
        }
    }
}

/// A key of a link that only one transport has: an integer.
#[derive(Debug, PartialEq, Eq)]
pub struct TransportOption {
    /// The key in the topology.
    pub key: &'static str,
    /// What it means: whole sentences.
    pub about: &'static str,
    /// What it is when the file does not say.
    pub default: i64,
    /// Smallest allowed.
    pub min: i64,
    /// Largest allowed.
    pub max: i64,
}

hil_core::labelled! {
    /// A protocol whose ports a host gives to one socket at a time.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
    pub enum IpProtocol, word {
        /// Datagrams.
        Udp = "udp",
        /// Connections.
        Tcp = "tcp",
    }
}
