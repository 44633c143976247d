//! One end of a ping-pong between two hosts: bare UDP, which is the floor, or the gateways of the
//! product with shared memory at both ends, stepped by the one thread that also plays the
//! application.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use hil_core::endpoint::InputPort;
use hil_core::time::Instant;
use hil_engine::gateway::direction::Direction;
use hil_net::timestamping::TimestampMode;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::DirectionLaunch;
use hil_transport::socket::SocketSettings;
use hil_transport::udp::{UdpReceiver, UdpSender};
use hil_transport::{DatagramReceiver, DatagramSender};
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;

use super::hosts::{Joint, Plan, Ports, SetupError};
use super::network::Network;

/// Longest sleep before a side looks whether its turn is over.
pub const LOOK: Duration = Duration::from_millis(10);

/// One end.
pub trait Side: core::fmt::Debug {
    /// Sends message number `count`, and does what is due afterwards.
    fn send(&mut self, count: u64);

    /// The number of a message that came; `None` when none did, after a bounded wait.
    fn receive(&mut self) -> Option<u64>;

    /// Waits in the kernel.
    fn sleeps(&self) -> bool;

    /// How much of the round trip that ended last the applications at both ends took to put and
    /// take its messages: what is not from one gateway's input to the other's output.
    fn applications_ns(&self) -> u64 {
        0
    }

    /// When the message received last was published by its sender, for ends that know.
    fn published(&self) -> Option<Instant> {
        None
    }

    /// Receive stamps and datagrams so far; `None` where the kernel was not asked for stamps.
    fn stamp_coverage(&self) -> Option<(u64, u64)> {
        None
    }
}

fn since(started: Instant) -> u64 {
    u64::try_from(MonotonicClock::now().ns_since(started)).unwrap_or(0)
}

fn count_of(bytes: &[u8]) -> Option<u64> {
    bytes.first_chunk().map(|head| u64::from_le_bytes(*head))
}

/// A bare UDP echo over the product's own socket types: the least a stamped hop can cost.
#[derive(Debug)]
pub struct EchoSide {
    sender: UdpSender,
    receiver: UdpReceiver,
    plan: Plan,
    /// Transmit stamps still to be read; left unread, they would silence the socket.
    stamps_due: u32,
    message: Vec<u8>,
    buffer: Vec<u8>,
}

impl EchoSide {
    /// Both ends of a pair.
    ///
    /// # Errors
    /// When the kernel refuses a socket or an option.
    pub fn pair(network: &Network, plan: Plan) -> Result<[Self; 2], SetupError> {
        let ports = |host| -> io::Result<[SocketAddr; 2]> {
            Ok([network.free_address(host)?, network.free_address(host)?])
        };
        let addresses = [ports(0)?, ports(1)?];
        let address = |host: usize, port: usize| addresses[host][port];
        let open = |host: usize| -> Result<Self, SetupError> {
            let settings = |own: usize, peer: usize| SocketSettings {
                timestamps: if plan.is_stamped {
                    TimestampMode::Software
                } else {
                    TimestampMode::Off
                },
                ..SocketSettings::new(address(host, own), address(1 - host, peer))
            };
            // Port 0 of each host sends, port 1 receives.
            let (sender, receiver) = network.on(host, || {
                let sender = UdpSender::open(&settings(0, 1));
                (sender, UdpReceiver::open(&settings(1, 0)))
            });
            Ok(Self {
                sender: sender?,
                receiver: receiver?,
                plan,
                stamps_due: 0,
                message: vec![0; plan.size_bytes],
                buffer: vec![0; usize::from(u16::MAX)],
            })
        };
        Ok([open(0)?, open(1)?])
    }

    /// The bare sockets: this end sends with the one and receives with the other.
    pub fn into_sockets(self) -> (UdpSender, UdpReceiver) {
        (self.sender, self.receiver)
    }
}

impl Side for EchoSide {
    fn send(&mut self, count: u64) {
        self.message[..8].copy_from_slice(&count.to_le_bytes());
        if self.sender.send(&self.message).is_err() || !self.plan.is_stamped {
            return;
        }
        self.stamps_due += 1;
        while self.stamps_due > 0 && self.sender.next_stamp().is_some() {
            self.stamps_due -= 1;
        }
    }

    fn receive(&mut self) -> Option<u64> {
        if self.plan.wait != WaitMode::Spin {
            sleep_for(&self.receiver);
        }
        let received = self.receiver.receive(Instant::ZERO, &mut self.buffer);
        let received = received.ok().flatten()?;
        count_of(&self.buffer[..received.length_bytes])
    }

    fn sleeps(&self) -> bool {
        self.plan.wait != WaitMode::Spin
    }

    fn stamp_coverage(&self) -> Option<(u64, u64)> {
        let counters = self.receiver.counters();
        let coverage = (counters.software_stamp_count, counters.received_count);
        self.plan.is_stamped.then_some(coverage)
    }
}

fn sleep_for(receiver: &UdpReceiver) {
    if let Some(descriptor) = receiver.poll_fd() {
        let mut polled = [PollFd::new(descriptor, PollFlags::POLLIN)];
        // A failure shows as a message that does not come.
        ppoll(&mut polled, Some(TimeSpec::from_duration(LOOK)), None).ok();
    }
}

/// What a program writes that knows nothing of all this: blocking sockets of the standard
/// library, without stamps.
#[derive(Debug)]
pub struct PlainSide {
    socket: UdpSocket,
    message: Vec<u8>,
    buffer: Vec<u8>,
}

impl PlainSide {
    /// Both ends of a pair.
    ///
    /// # Errors
    /// When the kernel refuses a socket.
    pub fn pair(network: &Network, size_bytes: usize) -> Result<[Self; 2], SetupError> {
        let addresses = [network.free_address(0)?, network.free_address(1)?];
        let open = |host: usize| -> io::Result<Self> {
            let socket = network.on(host, || UdpSocket::bind(addresses[host]))?;
            socket.connect(addresses[1 - host])?;
            socket.set_read_timeout(Some(LOOK))?;
            Ok(Self {
                socket,
                message: vec![0; size_bytes],
                buffer: vec![0; usize::from(u16::MAX)],
            })
        };
        Ok([open(0)?, open(1)?])
    }
}

impl Side for PlainSide {
    fn send(&mut self, count: u64) {
        self.message[..8].copy_from_slice(&count.to_le_bytes());
        // A refused datagram shows as a lost one.
        self.socket.send(&self.message).ok();
    }

    fn receive(&mut self) -> Option<u64> {
        let length = self.socket.recv(&mut self.buffer).ok()?;
        count_of(&self.buffer[..length])
    }

    fn sleeps(&self) -> bool {
        true
    }
}

/// An application and both directions of its gateway in one thread.
#[derive(Debug)]
pub struct GatewaySide {
    ports: Ports,
    plan: Plan,
    /// The way to the other host.
    egress: (DirectionLaunch, Direction),
    /// The way from the other host.
    ingress: (DirectionLaunch, Direction),
    message: Vec<u8>,
    published: Option<Instant>,
    put_ns: u64,
    take_ns: u64,
    /// What the answering end noted of its application.
    far_application_ns: Arc<AtomicU64>,
}

impl GatewaySide {
    /// Connects everything; call it in the thread that will use it. Both ends of a pair get the
    /// same `far_application_ns`.
    ///
    /// # Errors
    /// When a channel cannot be opened.
    pub fn connect(joint: Joint, far_application_ns: Arc<AtomicU64>) -> Result<Self, SetupError> {
        let (plan, host, address) = (joint.plan, joint.host, joint.address.clone());
        // The application opens first, so that the gateway finds its reader.
        let ports = Ports::open(&address, &plan, host, false)?;
        let [egress, ingress] = joint.split();
        Ok(Self {
            ports,
            plan,
            egress: egress.connect()?,
            ingress: ingress.connect()?,
            message: vec![0; plan.size_bytes],
            published: None,
            put_ns: 0,
            take_ns: 0,
            far_application_ns,
        })
    }

    /// Both directions with their launch descriptions.
    pub fn directions(&mut self) -> [(&DirectionLaunch, &mut Direction); 2] {
        let Self {
            egress, ingress, ..
        } = self;
        [(&egress.0, &mut egress.1), (&ingress.0, &mut ingress.1)]
    }

    /// The receiving direction's counter; `None` when it counts no such thing.
    fn counter(&self, name: &str) -> Option<u64> {
        let counters = self.ingress.1.report(&self.ingress.0).counters;
        let found = counters.into_iter().find(|known| known.label() == name);
        found.map(|known| known.count)
    }
}

impl Side for GatewaySide {
    fn send(&mut self, count: u64) {
        self.message[..8].copy_from_slice(&count.to_le_bytes());
        let started = MonotonicClock::now();
        // A failure shows as a message that does not come.
        self.ports.output.publish(started, &self.message).ok();
        self.put_ns = since(started);
        if self.ingress.0.flow.ends_with("out") {
            self.far_application_ns
                .store(self.take_ns + self.put_ns, Ordering::Relaxed);
        }
        // The second step finds no message and looks after replies and appointments, as the
        // direction's own loop would now.
        while matches!(self.egress.1.step(), Ok(true)) {}
    }

    fn receive(&mut self) -> Option<u64> {
        if self.plan.wait != WaitMode::Spin {
            self.ingress.1.rest().ok()?;
        }
        if !self.ingress.1.step().ok()? {
            return None;
        }
        let started = MonotonicClock::now();
        let mut count = None;
        let mut published = None;
        self.ports
            .input
            .receive(Instant::ZERO, &mut |envelope, payload| {
                count = count_of(payload);
                published = Some(Instant::from_ns(envelope.published_ns));
            })
            .ok()?;
        self.published = published;
        self.take_ns = since(started);
        count
    }

    fn applications_ns(&self) -> u64 {
        self.put_ns + self.take_ns + self.far_application_ns.load(Ordering::Relaxed)
    }

    fn sleeps(&self) -> bool {
        self.plan.wait != WaitMode::Spin
    }

    fn published(&self) -> Option<Instant> {
        self.published
    }

    fn stamp_coverage(&self) -> Option<(u64, u64)> {
        let coverage = self
            .counter("socket: software_stamp_count")
            .zip(self.counter("socket: received_count"));
        coverage.filter(|_| self.plan.is_stamped)
    }
}
