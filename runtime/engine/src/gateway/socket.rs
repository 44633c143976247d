//! The socket of one channel direction: opened as its launch description says, behind a link model
//! where it has one, with what the kernel granted. It moves no message.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use hil_core::link_model::{Fate, LinkModel, LossCauses, MessageNumber, ReplayTally};
use hil_core::time::{Instant, RemoteInstant};
use hil_net::timestamping::TimestampMode;
use hil_protocol::wire::{self, Kind};
use hil_transport::emulated::{EmulatedReceiver, EmulatedSettings};
use hil_transport::sealed::{SealedReceiver, SealedSender};
use hil_transport::tcp::{
    ConnectionTally, KEEP_ALIVE_COUNT, KEEP_ALIVE_IDLE, KEEP_ALIVE_INTERVAL, TcpReceiver,
    TcpSender, TcpSettings, USER_TIMEOUT,
};
use hil_transport::udp::{GrantedOptions, PathMtu, UdpReceiver, UdpSender, UdpSettings};
use hil_transport::{DatagramReceiver, DatagramSender};

use super::WorkerError;
use super::link_switch::{SwitchHandle, switch};
use super::stamp_plan::StampPlan;
use hil_nic::radio::category;
use hil_platform::clock::MonotonicClock;
use hil_platform::host_facts::{HostFiles, kernel_release};
use hil_rundir::launch::{DirectionLaunch, Side, SocketLaunch, Transport};
use hil_rundir::pipe::RunStart;
use hil_rundir::run_seal::RunSeal;
use hil_topology::Timestamps;

/// IP and UDP headers of a datagram.
const IPV4_HEADERS: usize = 20 + 8;
const IPV6_HEADERS: usize = 40 + 8;

/// A direction's socket and what is known of it.
#[derive(Debug)]
pub(super) struct OpenSocket {
    pub(super) ends: Ends,
    pub(super) facts: Vec<(String, String)>,
    /// How often its connections come and go, where this end tells of it.
    pub(super) tally: Option<Arc<ConnectionTally>>,
    /// What its link model met of the trace that it replays, where it replays one.
    pub(super) replay: Option<ReplayTally>,
    /// Where its link model can be changed, where it has one.
    pub(super) switch: Option<SwitchHandle>,
}

/// Which end of the hop it is.
#[derive(Debug)]
pub(super) enum Ends {
    /// The sending one, and the longest datagram it takes.
    Sender(Box<dyn DatagramSender>, usize),
    Receiver(Box<dyn DatagramReceiver>),
}

impl OpenSocket {
    /// Opens it; call it from a thread of normal priority. `start` is told when the run starts.
    pub(super) fn open(
        launch: &DirectionLaunch,
        plan: StampPlan,
        start: &RunStart,
        seal: Option<&RunSeal>,
    ) -> Result<Self, WorkerError> {
        let settings = udp_settings(launch, plan);
        let mut opened = match launch.socket.transport {
            Transport::Udp => Self::open_udp(&settings, launch, start, seal),
            Transport::Tcp => Self::open_tcp(&settings, launch, seal),
        }?;
        opened.facts.push(security_fact(seal));
        Ok(opened)
    }

    fn open_udp(
        settings: &UdpSettings,
        launch: &DirectionLaunch,
        start: &RunStart,
        seal: Option<&RunSeal>,
    ) -> Result<Self, WorkerError> {
        let mut opened = match launch.side {
            Side::Egress => {
                let sender = UdpSender::open(settings)?;
                let mut facts = socket_facts(settings, sender.granted());
                if settings.wants_radio_reports {
                    facts.push(access_category(sender.granted()));
                }
                let mtu = sender.path_mtu();
                let configured = launch.socket.path_mtu_bytes;
                let text = format!("{} bytes, {configured} configured", mtu.packet_bytes);
                facts.push(("path MTU".to_owned(), text));
                let longest = datagram_bytes_max(launch, mtu);
                let sender = sealed_sender(sender, launch, seal)?;
                Self::new(Ends::Sender(sender, longest), facts)
            }
            Side::Ingress => {
                let receiver = UdpReceiver::open(settings)?;
                let facts = socket_facts(settings, receiver.granted());
                // Below the link model, which must not meet what a stranger sends.
                let receiver = sealed_receiver(receiver, launch, seal)?;
                emulate(receiver, facts, launch, start)?
            }
        };
        if let Some(emulation) = &launch.emulation {
            opened.facts.push((
                "link model behind the socket, part of RX stamp → received by gateway".to_owned(),
                emulation.describe(),
            ));
            if launch.side == Side::Ingress {
                let room = emulation.room(launch.size_bytes)?;
                let fact = ("room of the link model".to_owned(), room.to_string());
                opened.facts.push(fact);
            }
        }
        Ok(opened)
    }

    /// A socket without a connection to tell of or a link model behind it.
    const fn new(ends: Ends, facts: Vec<(String, String)>) -> Self {
        Self {
            ends,
            facts,
            tally: None,
            replay: None,
            switch: None,
        }
    }

    fn open_tcp(
        common: &UdpSettings,
        launch: &DirectionLaunch,
        seal: Option<&RunSeal>,
    ) -> Result<Self, WorkerError> {
        let settings = TcpSettings {
            interface: common.interface.clone(),
            dscp: common.dscp,
            priority: common.priority,
            send_buffer_bytes: common.send_buffer_bytes,
            receive_buffer_bytes: common.receive_buffer_bytes,
            path_mtu_bytes: Some(launch.socket.path_mtu_bytes),
            ..TcpSettings::new(common.local, common.peer, MonotonicClock::now)
        };
        let (ends, granted, tally) = match launch.side {
            Side::Egress => {
                let sender = TcpSender::open(settings)?;
                let (granted, longest) = (sender.granted(), sender.datagram_bytes_max());
                let tally = Some(sender.tally());
                let sender = sealed_sender(sender, launch, seal)?;
                (Ends::Sender(sender, longest), granted, tally)
            }
            Side::Ingress => {
                let receiver = TcpReceiver::open(settings)?;
                let granted = receiver.granted();
                let receiver = sealed_receiver(receiver, launch, seal)?;
                (Ends::Receiver(receiver), granted, None)
            }
        };
        let mut facts = socket_facts(common, granted);
        let options = format!(
            "no delay; keep-alive after {} s, then {KEEP_ALIVE_COUNT} times every {} s; user \
             time-out {} s",
            KEEP_ALIVE_IDLE.as_secs(),
            KEEP_ALIVE_INTERVAL.as_secs(),
            USER_TIMEOUT.as_secs()
        );
        facts.push(("TCP".to_owned(), options));
        Ok(Self {
            tally,
            ..Self::new(ends, facts)
        })
    }
}

fn sealed_sender(
    sender: impl DatagramSender + 'static,
    launch: &DirectionLaunch,
    seal: Option<&RunSeal>,
) -> Result<Box<dyn DatagramSender>, WorkerError> {
    let Some(seal) = seal else {
        return Ok(Box::new(sender));
    };
    let initiator = seal.initiator(launch).map_err(WorkerError::Session)?;
    Ok(Box::new(SealedSender::new(sender, initiator)))
}

fn sealed_receiver(
    receiver: impl DatagramReceiver + 'static,
    launch: &DirectionLaunch,
    seal: Option<&RunSeal>,
) -> Result<Box<dyn DatagramReceiver>, WorkerError> {
    let Some(seal) = seal else {
        return Ok(Box::new(receiver));
    };
    let responder = seal.responder(launch).map_err(WorkerError::Session)?;
    Ok(Box::new(SealedReceiver::new(
        receiver,
        responder,
        launch.peer,
    )))
}

fn security_fact(seal: Option<&RunSeal>) -> (String, String) {
    let text = match seal {
        Some(seal) => format!("sealed, {}", seal.suite().label()),
        None => "plain".to_owned(),
    };
    ("security".to_owned(), text)
}

fn udp_settings(launch: &DirectionLaunch, plan: StampPlan) -> UdpSettings {
    let socket = &launch.socket;
    UdpSettings {
        local: launch.local,
        peer: launch.peer,
        interface: socket.interface.clone(),
        // 0 is the kernel's default; setting it would only reset the priority.
        dscp: (socket.dscp > 0).then_some(socket.dscp),
        priority: socket.priority,
        send_buffer_bytes: Some(socket.send_buffer_bytes),
        receive_buffer_bytes: Some(socket.receive_buffer_bytes),
        timestamps: plan.mode,
        wants_radio_reports: plan.asks_radio,
    }
}

/// The kernel stamps to ask for: none of a stream, whose bytes have no stamp of their own.
pub(super) const fn stamps_of(socket: &SocketLaunch) -> TimestampMode {
    match socket.transport {
        Transport::Tcp => TimestampMode::Off,
        Transport::Udp => timestamp_mode(socket.timestamps),
    }
}

/// What a topology's word asks of the kernel.
pub(crate) const fn timestamp_mode(asked: Timestamps) -> TimestampMode {
    match asked {
        Timestamps::Off => TimestampMode::Off,
        Timestamps::Software => TimestampMode::Software,
        Timestamps::Hardware => TimestampMode::Hardware,
    }
}

/// Where this direction stands when stations contend for the air.
fn access_category(granted: GrantedOptions) -> (String, String) {
    let release = kernel_release(&HostFiles::of_this_host());
    let text = category::describe(granted.priority, granted.dscp, &release.to_text());
    ("access category".to_owned(), text)
}

fn socket_facts(settings: &UdpSettings, granted: GrantedOptions) -> Vec<(String, String)> {
    let fact = |label: &str, text: String| (label.to_owned(), text);
    let mut facts = vec![
        fact(
            "socket",
            format!("{} to or from {}", settings.local, settings.peer),
        ),
        fact(
            "send buffer granted",
            format!("{} bytes", granted.send_buffer_bytes),
        ),
        fact(
            "receive buffer granted",
            format!("{} bytes", granted.receive_buffer_bytes),
        ),
    ];
    let shortfalls = granted.shortfalls(settings);
    facts.extend(
        shortfalls
            .into_iter()
            .map(|text| fact("socket option", text)),
    );
    facts
}

/// The longest datagram of the channel: as long as a message needs, with room for the greetings and
/// clock exchanges that share its socket, and no longer than the path takes.
fn held_bytes_max(launch: &DirectionLaunch) -> usize {
    let message = launch.size_bytes + wire::HEADER_BYTES + wire::TAG_BYTES;
    message.max(512).min(launch.socket.path_mtu_bytes)
}

/// Puts the receiver behind the launch's link model, if it has one. Greetings and clock exchanges
/// pass freely: the model stands for what happens to the robot's messages.
fn emulate(
    receiver: Box<dyn DatagramReceiver>,
    facts: Vec<(String, String)>,
    launch: &DirectionLaunch,
    start: &RunStart,
) -> Result<OpenSocket, WorkerError> {
    let Some(emulation) = &launch.emulation else {
        return Ok(OpenSocket::new(Ends::Receiver(receiver), facts));
    };
    let link = SinceStart {
        link: emulation.model(&launch.channel)?,
        start: start.clone(),
    };
    let room = emulation.room(launch.size_bytes)?;
    let replay = link.replay_tally();
    let (link, switch) = switch(link, &launch.channel, emulation, room);
    let settings = EmulatedSettings {
        capacity_count: room.capacity_count,
        datagram_bytes_max: held_bytes_max(launch),
        clock: Some(MonotonicClock::now),
        number_of: Some(message_number),
    };
    let is_exempt =
        |bytes: &[u8]| wire::decode(bytes).is_ok_and(|datagram| datagram.header.kind != Kind::Data);
    let receiver = EmulatedReceiver::new(receiver, Box::new(link), is_exempt, settings);
    Ok(OpenSocket {
        replay,
        switch: Some(switch),
        ..OpenSocket::new(Ends::Receiver(Box::new(receiver)), facts)
    })
}

/// Which message of its channel a datagram carries, or a part of.
fn message_number(bytes: &[u8]) -> Option<MessageNumber> {
    let header = wire::decode(bytes).ok()?.header;
    (header.kind == Kind::Data).then_some(MessageNumber {
        start: header.epoch,
        sequence: header.sequence,
        // The smallest integer stands for a message without a stamp.
        published: (header.published_ns != i64::MIN)
            .then(|| RemoteInstant::from_ns(header.published_ns)),
    })
}

/// A link on a clock that reads zero when the run starts, as it does in virtual time; before the
/// start it stands still. A gateway that is started again thus goes on where it was.
#[derive(Debug)]
struct SinceStart<L> {
    link: L,
    start: RunStart,
}

impl<L: LinkModel> SinceStart<L> {
    /// Asks the link on its own clock.
    fn ask(&mut self, now: Instant, offer: impl FnOnce(&mut L, Instant) -> Fate) -> Fate {
        let elapsed = self
            .start
            .get()
            .map_or(Duration::ZERO, |start| now.saturating_duration_since(start));
        let offered = Instant::ZERO + elapsed;
        match offer(&mut self.link, offered) {
            Fate::Delivered(at) => Fate::Delivered(now + at.saturating_duration_since(offered)),
            Fate::Duplicated { first, second } => Fate::Duplicated {
                first: now + first.saturating_duration_since(offered),
                second: now + second.saturating_duration_since(offered),
            },
            Fate::Lost => Fate::Lost,
        }
    }
}

impl<L: LinkModel> LinkModel for SinceStart<L> {
    fn loss_causes(&self) -> Option<LossCauses> {
        self.link.loss_causes()
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        self.link.replay_tally()
    }

    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        self.ask(now, |link, at| link.offer(at, length_bytes))
    }

    fn offer_numbered(
        &mut self,
        now: Instant,
        length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        self.ask(now, |link, at| {
            link.offer_numbered(at, length_bytes, message)
        })
    }
}

/// What a datagram may carry: as much as the topology says, but no more than the path takes.
fn datagram_bytes_max(launch: &DirectionLaunch, path: PathMtu) -> usize {
    let headers = match launch.peer.ip() {
        IpAddr::V4(_) => IPV4_HEADERS,
        IpAddr::V6(_) => IPV6_HEADERS,
    };
    let configured = launch.socket.path_mtu_bytes.saturating_sub(headers);
    if path.is_assumed {
        return configured;
    }
    configured.min(usize::try_from(path.datagram_bytes).unwrap_or(configured))
}

#[cfg(test)]
#[path = "socket_tests.rs"]
mod tests;
