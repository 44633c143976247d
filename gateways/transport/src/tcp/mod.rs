//! TCP: one connection each way of a link, from the sending gateway to the receiving one; the
//! replies come back on it. The protocol above is the one of the other transports, datagram by
//! datagram ([`frame`] has the layout); order and exactly-once delivery hold per connection.
//!
//! - A peer that is not there is a state: the sender tries again, first after 20 ms, then after
//!   twice as long each time up to 250 ms. What was under way when a connection ended is
//!   lost, and the sequence accounting counts it.
//! - Nothing blocks. What the kernel does not take waits in a bounded buffer; a message that finds
//!   no room there is refused and counted.
//! - A newer connection takes the place of the present one once it has delivered a datagram: under the
//!   seal an authentic one. Until then it costs the channel nothing, and few of them are kept.
//! - Every message leaves at once (`TCP_NODELAY`), and what it then waits for is measured: see
//!   `metrics`.
//! - There are no kernel stamps. The kernel stamps bytes of a stream, not messages: segments are
//!   joined and cut on the way, and a joined one keeps only the newer of two stamps.

pub mod frame;
mod metrics;
mod receiver;
mod sender;
mod socket;
mod stall;
mod stream;

#[cfg(test)]
mod tests;

use hil_core::time::Instant;
use hil_net::clock_pair::monotonic_now;
use hil_protocol::seal::{Initiator, Responder};
use hil_protocol::transport::{Capabilities, Description, IpProtocol};

pub use receiver::TcpReceiver;
pub use sender::TcpSender;

use crate::registry::{OpenReceiver, OpenSender, Transport};
use crate::sealed;
use crate::socket::{GrantedOptions, SocketError, SocketSettings};
use socket::{KEEP_ALIVE_COUNT, KEEP_ALIVE_IDLE, KEEP_ALIVE_INTERVAL, USER_TIMEOUT};

/// One connection each way of a link.
#[derive(Debug)]
pub struct Tcp;

static DESCRIPTION: Description = Description {
    name: "tcp",
    label: "TCP",
    capabilities: Capabilities {
        unstamped_because: Some("the kernel stamps bytes of a stream, not messages"),
        has_radio_reports: false,
        cuts_to_path: true,
        // The kernel chooses it.
        sender_port: None,
        receiver_port: Some(IpProtocol::Tcp),
        ipv4_header_bytes: 20 + 20,
        ipv6_header_bytes: 40 + 20,
    },
    options: &[],
};

impl Transport for Tcp {
    fn description(&self) -> &'static Description {
        &DESCRIPTION
    }

    fn open_sender(
        &self,
        settings: &SocketSettings,
        seal: Option<Initiator>,
    ) -> Result<OpenSender, SocketError> {
        let sender = TcpSender::open(settings.clone())?;
        Ok(OpenSender {
            granted: sender.granted(),
            datagram_bytes_max: frame::DATAGRAM_BYTES_MAX,
            facts: facts(settings, sender.granted()),
            connections: Some(sender.tally()),
            sender: sealed::sender(sender, seal),
        })
    }

    fn open_receiver(
        &self,
        settings: &SocketSettings,
        seal: Option<Responder>,
    ) -> Result<OpenReceiver, SocketError> {
        let receiver = TcpReceiver::open(settings.clone(), seal.is_some())?;
        Ok(OpenReceiver {
            facts: facts(settings, receiver.granted()),
            receiver: sealed::receiver(receiver, settings.peer, seal),
        })
    }
}

fn facts(settings: &SocketSettings, granted: GrantedOptions) -> Vec<(String, String)> {
    let mut facts = granted.facts(settings);
    let options = format!(
        "no delay; keep-alive after {} s, then {KEEP_ALIVE_COUNT} times every {} s; user time-out \
         {} s",
        KEEP_ALIVE_IDLE.as_secs(),
        KEEP_ALIVE_INTERVAL.as_secs(),
        USER_TIMEOUT.as_secs()
    );
    facts.push(("TCP".to_owned(), options));
    facts
}

/// The monotonic clock: how long a byte waits counts from when it was sent.
fn now() -> Instant {
    monotonic_now().expect("every Linux has a monotonic clock")
}
