//! The wire of a bench: two network namespaces and a veth cable where the rights for them are
//! there, the loopback where not. Which one it is stands in the output.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};

use hil_tests::lab::{ADDRESSES, Lab};

/// Two hosts that can send each other datagrams.
#[derive(Debug)]
pub struct Network {
    lab: Option<Lab>,
    note: String,
}

impl Network {
    /// The best this machine allows.
    pub fn open() -> Self {
        match Lab::two_hosts() {
            Ok(lab) => Self {
                lab: Some(lab),
                note: "two network namespaces joined by veth".to_owned(),
            },
            Err(reason) => Self {
                lab: None,
                note: format!("loopback (no namespaces: {})", reason.trim()),
            },
        }
    }

    /// The hosts themselves; `None` on the loopback.
    pub fn lab(&self) -> Option<&Lab> {
        self.lab.as_ref()
    }

    /// What the datagrams cross.
    pub fn note(&self) -> &str {
        &self.note
    }

    /// Runs `work` in a thread of which new sockets belong to `host`, 0 or 1.
    ///
    /// # Panics
    /// When the namespace cannot be entered, or `work` panics.
    pub fn on<T: Send>(&self, host: usize, work: impl FnOnce() -> T + Send) -> T {
        match &self.lab {
            Some(lab) => lab.host(host).on_network(work),
            None => work(),
        }
    }

    /// An address of `host` with a port that was free a moment ago.
    ///
    /// # Errors
    /// When the kernel gives no port.
    pub fn free_address(&self, host: usize) -> io::Result<SocketAddr> {
        let address = match &self.lab {
            Some(_) => IpAddr::V4(ADDRESSES[host]),
            None => IpAddr::V4(Ipv4Addr::LOCALHOST),
        };
        self.on(host, || UdpSocket::bind((address, 0))?.local_addr())
    }
}
