//! The socket of one way of a link: opened as its launch description says, behind the link models of its
//! channels where they have any, with what the kernel granted. It moves no message.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use hil_core::link_model::{Fate, LinkModel, LossCauses, MessageNumber, ReplayTally};
use hil_core::time::{Instant, RemoteInstant};
use hil_net::timestamping::TimestampMode;
use hil_protocol::wire::{self, Header, Kind};
use hil_transport::emulated::{EmulatedReceiver, EmulatedSettings, Offer};
use hil_transport::registry::{self, Transport};
use hil_transport::socket::{GrantedOptions, SocketSettings};
use hil_transport::{ConnectionTally, DatagramReceiver, DatagramSender};

use super::WorkerError;
use super::link_switch::{OwnLink, SwitchHandle, switch};
use super::stamp_plan::StampPlan;
use hil_nic::radio::category;
use hil_platform::clock::MonotonicClock;
use hil_platform::host_facts::{HostFiles, kernel_release};
use hil_rundir::launch::{DirectionLaunch, Side, SocketLaunch};
use hil_rundir::pipe::RunStart;
use hil_rundir::run_seal::RunSeal;
use hil_topology::Timestamps;
use hil_topology::emulation_room::EmulationRoom;

/// A direction's socket and what is known of it.
#[derive(Debug)]
pub(super) struct OpenSocket {
    pub(super) ends: SocketEnd,
    pub(super) facts: Vec<(String, String)>,
    /// How often its connections come and go, where this end tells of it.
    pub(super) tally: Option<Arc<ConnectionTally>>,
    /// What the link model of each channel met of the trace that it replays, where it replays one.
    pub(super) replays: Vec<Option<ReplayTally>>,
    /// Where its link models can be changed, where it has any.
    pub(super) switch: Option<SwitchHandle>,
}

/// Which end of the hop it is.
#[derive(Debug)]
pub(super) enum SocketEnd {
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
        let transport = transport_of(&launch.socket)?;
        let settings = socket_settings(launch, plan);
        let mut opened = match launch.side {
            Side::Egress => {
                let seal = seal.map(|seal| seal.initiator(launch)).transpose();
                let seal = seal.map_err(WorkerError::Session)?;
                let mut end = transport.open_sender(&settings, seal)?;
                if plan.asks_radio {
                    end.facts.push(access_category(end.granted));
                }
                let ends = SocketEnd::Sender(end.sender, end.datagram_bytes_max);
                Self {
                    tally: end.connections,
                    ..Self::new(ends, end.facts)
                }
            }
            Side::Ingress => {
                let seal = seal.map(|seal| seal.responder(launch)).transpose();
                let seal = seal.map_err(WorkerError::Session)?;
                let end = transport.open_receiver(&settings, seal)?;
                // Above the seal: the link model must not meet what a stranger sends.
                emulate(end.receiver, end.facts, launch, start)?
            }
        };
        opened.facts.extend(model_facts(launch));
        if launch.side == Side::Ingress
            && let Some(room) = room_of(launch)?
        {
            let fact = ("room of the link model".to_owned(), room.to_string());
            opened.facts.push(fact);
        }
        opened.facts.push(security_fact(seal));
        Ok(opened)
    }

    /// A socket without a connection to tell of or a link model behind it.
    const fn new(ends: SocketEnd, facts: Vec<(String, String)>) -> Self {
        Self {
            ends,
            facts,
            tally: None,
            replays: Vec::new(),
            switch: None,
        }
    }
}

/// The transport that a hop is carried by.
pub(super) fn transport_of(socket: &SocketLaunch) -> Result<&'static dyn Transport, WorkerError> {
    let name = &socket.transport;
    registry::named(name).ok_or_else(|| WorkerError::UnknownTransport(name.clone()))
}

fn security_fact(seal: Option<&RunSeal>) -> (String, String) {
    let text = match seal {
        Some(seal) => format!("sealed, {}", seal.suite().label()),
        None => "plain".to_owned(),
    };
    ("security".to_owned(), text)
}

fn socket_settings(launch: &DirectionLaunch, plan: StampPlan) -> SocketSettings {
    let socket = &launch.socket;
    let common = &socket.common;
    SocketSettings {
        interface: socket.interface.clone(),
        // 0 is the kernel's default; setting it would only reset the priority.
        dscp: (common.dscp > 0).then_some(common.dscp),
        priority: common.socket_priority,
        send_buffer_bytes: Some(common.send_buffer_bytes),
        receive_buffer_bytes: Some(common.receive_buffer_bytes),
        timestamps: plan.mode,
        wants_radio_reports: plan.asks_radio,
        path_mtu_bytes: Some(common.path_mtu_bytes),
        options: socket.options.clone(),
        ..SocketSettings::new(launch.local, launch.peer)
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

/// The longest datagram of any channel: as long as a message needs, with room for the greetings and
/// clock exchanges that share its socket, and no longer than the path takes.
fn held_bytes_max(launch: &DirectionLaunch) -> usize {
    let messages = launch.channels.iter().map(|one| one.size_bytes);
    let longest = messages.max().unwrap_or(0) + wire::HEADER_BYTES + wire::TAG_BYTES;
    longest.max(512).min(launch.socket.common.path_mtu_bytes)
}

/// What the channels meet, once where all of them meet the same.
fn model_facts(launch: &DirectionLaunch) -> Vec<(String, String)> {
    const LABEL: &str = "link model behind the socket, part of RX stamp → received by gateway";
    let mut channels_of: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for one in &launch.channels {
        if let Some(emulation) = &one.emulation {
            let channels = channels_of.entry(emulation.describe()).or_default();
            channels.push(&one.channel);
        }
    }
    let is_one = channels_of.len() == 1;
    let facts = channels_of.into_iter().map(|(model, channels)| {
        let label = if is_one {
            LABEL.to_owned()
        } else {
            format!("{LABEL}, of {}", channels.join(", "))
        };
        (label, model)
    });
    facts.collect()
}

/// Room for what the link models of all channels hold together; `None` without a model.
fn room_of(launch: &DirectionLaunch) -> Result<Option<EmulationRoom>, WorkerError> {
    let mut whole: Option<EmulationRoom> = None;
    for one in &launch.channels {
        if let Some(emulation) = &one.emulation {
            let room = emulation.room(one.size_bytes)?;
            whole = Some(whole.map_or(room, |before| before.and(room)));
        }
    }
    Ok(whole)
}

/// Puts the receiver behind the link models of its channels, if they have any. Greetings and clock
/// exchanges pass freely: the models stand for what happens to the robot's messages.
fn emulate(
    receiver: Box<dyn DatagramReceiver>,
    facts: Vec<(String, String)>,
    launch: &DirectionLaunch,
    start: &RunStart,
) -> Result<OpenSocket, WorkerError> {
    let Some(room) = room_of(launch)? else {
        return Ok(OpenSocket::new(SocketEnd::Receiver(receiver), facts));
    };
    let mut links = Vec::new();
    let mut replays = Vec::new();
    for one in &launch.channels {
        let Some(emulation) = &one.emulation else {
            replays.push(None);
            continue;
        };
        let link = SinceStart {
            link: emulation.model(&one.channel)?,
            start: start.clone(),
        };
        replays.push(link.replay_tally());
        links.push(OwnLink {
            number: one.channel_id,
            channel: one.channel.clone(),
            room: emulation.room(one.size_bytes)?,
            emulation: emulation.clone(),
            link: Box::new(link),
        });
    }
    let channel_max = links.iter().map(|one| one.number).max().unwrap_or(0);
    let (links, switch) = switch(links);
    let settings = EmulatedSettings {
        capacity_count: room.capacity_count,
        datagram_bytes_max: held_bytes_max(launch),
        clock: Some(MonotonicClock::now),
    };
    let receiver =
        EmulatedReceiver::new(receiver, Box::new(links), offer_of, channel_max, settings);
    Ok(OpenSocket {
        replays,
        switch,
        ..OpenSocket::new(SocketEnd::Receiver(Box::new(receiver)), facts)
    })
}

/// Which message of which channel a datagram carries, or a part of; `None` for one that carries none.
fn offer_of(bytes: &[u8]) -> Option<Offer> {
    let decoded = wire::decode(bytes);
    let Ok(datagram) = decoded else {
        // A bridge refuses it; until then it is a datagram like another.
        return Header::read(bytes).ok().map(|(header, _)| Offer {
            channel: header.channel,
            message: None,
        });
    };
    let header = datagram.header;
    (header.kind == Kind::Data).then_some(Offer {
        channel: header.channel,
        message: Some(MessageNumber {
            start: header.epoch,
            sequence: header.sequence,
            // The smallest integer stands for a message without a stamp.
            published: (header.published_ns != i64::MIN)
                .then(|| RemoteInstant::from_ns(header.published_ns)),
        }),
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

#[cfg(test)]
#[path = "socket_tests.rs"]
mod tests;
