//! UDP with kernel stamps. Sending and receiving have a socket each: transmit stamps that nobody
//! fetched are charged to the *receive* buffer of their socket, so one socket for both goes deaf.
//! It frames, encrypts and retries nothing.

use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::os::fd::{AsFd, BorrowedFd};

use hil_core::time::Instant;
use nix::sys::socket::{setsockopt, sockopt};
use socket2::{Protocol, SockAddr, Socket, Type};

use super::registry::{OpenReceiver, OpenSender, Transport};
use super::socket::{
    self, GrantedOptions, SocketError, SocketSettings, bind, granted_options, local_address, refuse,
};
use super::{
    DatagramReceiver, DatagramSender, Received, ReceiverCounters, SendRefusal, SenderCounters,
    sealed,
};
use hil_net::control::{ControlData, QueueEntry, SCM_WIFI_STATUS};
use hil_net::interface::interface_with_address;
use hil_net::radio::{RETURNED_BYTES, RadioLedger, RadioReport};
use hil_net::reply_stamps::ReplyStamps;
use hil_net::tcp_info::unacknowledged_bytes;
use hil_net::timestamping::{
    MessageReader, Queue, TimestampMode, arm_receive, arm_transmit, drop_count, has_carrier,
    int_option, interface_mtu_bytes, restart_send_count, set_int_option,
};
use hil_net::{TransmitStamp, TxToken};
use hil_protocol::seal::{Initiator, Responder};
use hil_protocol::transport::{Capabilities, Description, IpProtocol};

/// Each datagram by itself.
#[derive(Debug)]
pub struct Udp;

static DESCRIPTION: Description = Description {
    name: "udp",
    label: "UDP",
    capabilities: Capabilities {
        unstamped_because: None,
        has_radio_reports: true,
        cuts_to_path: false,
        sender_port: Some(IpProtocol::Udp),
        receiver_port: Some(IpProtocol::Udp),
        ipv4_header_bytes: 20 + 8,
        ipv6_header_bytes: 40 + 8,
    },
    options: &[],
};

impl Transport for Udp {
    fn description(&self) -> &'static Description {
        &DESCRIPTION
    }

    fn open_sender(
        &self,
        settings: &SocketSettings,
        seal: Option<Initiator>,
    ) -> Result<OpenSender, SocketError> {
        let sender = UdpSender::open_towards(settings, Some(settings.peer), seal.is_some())?;
        let path = sender.path_mtu();
        let mut facts = sender.granted().facts(settings);
        if let Some(configured) = settings.path_mtu_bytes {
            let text = format!("{} bytes, {configured} configured", path.packet_bytes);
            facts.push(("path MTU".to_owned(), text));
        }
        Ok(OpenSender {
            granted: sender.granted(),
            datagram_bytes_max: datagram_bytes_max(settings, path),
            facts,
            connections: None,
            sender: sealed::sender(sender, seal),
        })
    }

    fn open_receiver(
        &self,
        settings: &SocketSettings,
        seal: Option<Responder>,
    ) -> Result<OpenReceiver, SocketError> {
        let receiver = UdpReceiver::open_behind(settings, seal.is_some())?;
        Ok(OpenReceiver {
            facts: receiver.granted().facts(settings),
            receiver: sealed::receiver(receiver, settings.peer, seal),
        })
    }
}

/// What a datagram may carry: as much as the settings say, but no more than the path takes.
fn datagram_bytes_max(settings: &SocketSettings, path: PathMtu) -> usize {
    let headers = DESCRIPTION.capabilities.header_bytes(settings.peer.ip());
    let known = usize::try_from(path.datagram_bytes).unwrap_or(usize::MAX);
    match settings.path_mtu_bytes {
        None => known,
        Some(configured) if path.is_assumed => configured.saturating_sub(headers),
        Some(configured) => configured.saturating_sub(headers).min(known),
    }
}

/// `IPV6_MTU_DISCOVER` of `linux/in6.h`.
const IPV6_MTU_DISCOVER: i32 = 23;
/// `IPV6_MTU` of `linux/in6.h`.
const IPV6_MTU: i32 = 24;
/// Entries of the error queue read in one call at most, so that a flood of reports cannot hold
/// up the sending thread.
const DRAIN_COUNT_MAX: u32 = 256;
/// Reports of the network that one send passes over at most where they are ignored: each call that meets one takes
/// it away and sends nothing, so the datagram is offered again.
const SEND_ATTEMPT_COUNT_MAX: u32 = 8;
/// Pending reports that one receive call passes over at most; each costs one system call.
const RECEIVE_ATTEMPT_COUNT_MAX: u32 = 8;

/// The largest packet the path to the peer is known to take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PathMtu {
    /// Bytes of an IP packet with its header.
    pub packet_bytes: u32,
    /// Bytes of a datagram's content that fit such a packet, without IP options.
    pub datagram_bytes: u32,
    /// The kernel did not say, so this is the size every path must take: 576 bytes for IPv4
    /// (RFC 1122, 3.3.3), 1280 for IPv6 (RFC 8200, 5).
    pub is_assumed: bool,
}

/// The sending socket, connected to the peer; or one that hears anyone and answers whom it is told to: what a foreign
/// protocol needs whose client speaks first and expects answers from the very port it spoke to.
#[derive(Debug)]
pub struct UdpSender {
    socket: Socket,
    peer: SocketAddr,
    /// Whom a socket answers that is connected to nobody.
    answered: Option<SockAddr>,
    reader: MessageReader,
    counters: SenderCounters,
    /// The kernel's drop count at the newest reply, modulo 2^32.
    kernel_drop_count: u32,
    granted: GrantedOptions,
    mode: TimestampMode,
    /// The token of the send that the kernel counts as 0; `None` when its count is unknown.
    first_token: Option<TxToken>,
    /// Where the radio is asked.
    radio: Option<Box<RadioLedger>>,
    /// Reports of the network cost no datagram and decide nothing: on a sealed hop, where nothing is
    /// believed that the seal did not carry, and towards a foreign program.
    ignores_reports: bool,
    /// The interface of the settings, or the one with the socket's address.
    interface: Option<String>,
    /// Of this interface; read once where reports are ignored.
    interface_mtu_bytes: Option<u32>,
}

impl UdpSender {
    /// Opens and connects the socket; sends nothing.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: &SocketSettings) -> Result<Self, SocketError> {
        Self::open_towards(settings, Some(settings.peer), false)
    }

    /// As [`UdpSender::open`]; reports of the network, which anybody can send, are counted and otherwise
    /// ignored.
    ///
    /// # Errors
    /// As [`UdpSender::open`].
    pub fn open_ignoring_reports(settings: &SocketSettings) -> Result<Self, SocketError> {
        Self::open_towards(settings, Some(settings.peer), true)
    }

    /// As [`UdpSender::open_ignoring_reports`], connected to nobody: `settings.peer` is not used.
    ///
    /// # Errors
    /// As [`UdpSender::open`].
    pub fn open_answering(settings: &SocketSettings) -> Result<Self, SocketError> {
        Self::open_towards(settings, None, true)
    }

    /// Sends to `peer` from now on; only a socket that is connected to nobody does.
    pub fn answer_to(&mut self, peer: SocketAddr) {
        self.answered = Some(SockAddr::from(peer));
    }

    fn open_towards(
        settings: &SocketSettings,
        peer: Option<SocketAddr>,
        ignores_reports: bool,
    ) -> Result<Self, SocketError> {
        if let Some(peer) = peer.filter(|peer| peer.is_ipv4() != settings.local.is_ipv4()) {
            return Err(SocketError::Family {
                local: settings.local,
                peer,
            });
        }
        let socket = open_socket(settings, ignores_reports)?;
        let drops = setsockopt(&socket, sockopt::RxqOvfl, &1);
        refuse("SO_RXQ_OVFL", 1, drops.map_err(io::Error::from))?;
        bind(&socket, settings.local)?;
        // Reports of the network go to the error queue, with their reason.
        let reports = if settings.local.is_ipv4() {
            setsockopt(&socket, sockopt::Ipv4RecvErr, &true)
        } else {
            setsockopt(&socket, sockopt::Ipv6RecvErr, &true)
        };
        refuse("IP_RECVERR", true, reports.map_err(io::Error::from))?;
        if let Some(peer) = peer {
            let connected = socket.connect(&SockAddr::from(peer));
            refuse("connect", peer, connected)?;
        }
        // Last, so that the kernel's count of sends starts with ours.
        let armed = arm_transmit(&socket, settings.timestamps);
        refuse(
            "SO_TIMESTAMPING",
            format!("{:?}", settings.timestamps),
            armed,
        )?;
        let mut radio = None;
        if settings.wants_radio_reports {
            let asked = set_int_option(&socket, libc::SOL_SOCKET, SCM_WIFI_STATUS, 1);
            refuse("SO_WIFI_STATUS", 1, asked)?;
            radio = Some(Box::new(RadioLedger::new()));
        }
        let interface = interface_of(settings, &socket);
        let mtu_bytes = interface
            .as_deref()
            .filter(|_| ignores_reports)
            .and_then(|name| interface_mtu_bytes(name).ok());
        Ok(Self {
            radio,
            ignores_reports,
            interface,
            interface_mtu_bytes: mtu_bytes,
            granted: granted_options(&socket, settings)?,
            socket,
            peer: settings.peer,
            answered: None,
            reader: MessageReader::new(),
            counters: SenderCounters::default(),
            kernel_drop_count: 0,
            mode: settings.timestamps,
            first_token: Some(TxToken(0)),
        })
    }

    /// What the kernel granted.
    pub fn granted(&self) -> GrantedOptions {
        self.granted
    }

    /// The address the peer sees as the source.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        local_address(&self.socket)
    }

    /// The largest packet the path is known to take now; it can shrink when the network reports
    /// so, which shows as [`SendRefusal::TooLong`]. Where reports are ignored it is what the interface takes:
    /// the route's figure may come from a report that anybody can forge.
    pub fn path_mtu(&self) -> PathMtu {
        let (level, name, assumed, header_bytes) = if self.peer.is_ipv4() {
            (libc::SOL_IP, libc::IP_MTU, 576, 20 + 8)
        } else {
            (libc::SOL_IPV6, IPV6_MTU, 1280, 40 + 8)
        };
        let known = if self.ignores_reports {
            self.interface_mtu_bytes
        } else {
            let known = int_option(&self.socket, level, name).ok();
            known.and_then(|bytes| u32::try_from(bytes).ok())
        };
        let known = known.filter(|bytes| *bytes > header_bytes);
        let packet_bytes = known.unwrap_or(assumed);
        // The length field of UDP counts its 8 bytes header in 16 bits, that of IPv4 all.
        let longest = if self.peer.is_ipv4() { 65_507 } else { 65_527 };
        PathMtu {
            packet_bytes,
            datagram_bytes: (packet_bytes - header_bytes).min(longest),
            is_assumed: known.is_none(),
        }
    }

    /// The send that the kernel counts as `id`. Should its count run ahead of ours, a stamp of
    /// the future shows it and names no send.
    fn token_of(&self, id: u32) -> Option<TxToken> {
        let token = self.first_token?.0.wrapping_add(id);
        let age = self.counters.next_token().0.wrapping_sub(token);
        (1..=u32::MAX / 2).contains(&age).then_some(TxToken(token))
    }

    /// Makes both counts agree again after a refusal that may or may not have advanced the
    /// kernel's: those of a packet filter or a full queueing discipline come after the count,
    /// all others before. Stamps still pending are given up, as their numbers would now be
    /// taken for later sends.
    fn realign_send_count(&mut self) {
        if self.mode == TimestampMode::Off {
            return;
        }
        while self.next_stamp().is_some() {
            self.counters.stamp_count -= 1;
            self.counters.unmatched_stamp_count += 1;
        }
        let restarted = restart_send_count(&self.socket, self.mode).is_ok();
        self.first_token = restarted.then(|| self.counters.next_token());
    }

    /// Matches a radio's report to its send by the packet it brought back.
    fn absorb_report(&mut self, packet: &[u8], is_acknowledged: bool) {
        let Some(radio) = &mut self.radio else {
            self.counters.undecodable_report_count += 1;
            return;
        };
        let matched = radio.settle(packet, is_acknowledged);
        self.counters.radio_overflow_count = radio.overflow_count;
        let counter = match matched {
            None => &mut self.counters.radio_unmatched_count,
            Some(report) if report.is_acknowledged => &mut self.counters.radio_acknowledged_count,
            Some(_) => &mut self.counters.radio_unacknowledged_count,
        };
        *counter += 1;
    }

    /// Sorts one entry of the error queue; a stamp of one of our sends is handed on.
    fn absorb_entry(&mut self, data: &ControlData) -> Option<TransmitStamp> {
        let entry = data.extended_error.map(|error| error.entry());
        match entry {
            Some(QueueEntry::Stamp { id, stage }) => {
                let Some(token) = self.token_of(id) else {
                    self.counters.unmatched_stamp_count += 1;
                    return None;
                };
                self.counters.stamp_count += 1;
                return Some(TransmitStamp {
                    token,
                    stage,
                    stamps: data.stamps,
                });
            }
            Some(QueueEntry::NetworkReport { .. }) if self.ignores_reports => {
                self.counters.ignored_report_count += 1;
            }
            Some(QueueEntry::NetworkReport { errno }) => {
                self.counters.network_report_count += 1;
                self.counters.newest_report = Some(SendRefusal::from_errno(errno, 0));
            }
            Some(QueueEntry::LocalReport { errno }) => {
                self.counters.local_report_count += 1;
                self.counters.newest_report = Some(SendRefusal::from_errno(errno, 0));
            }
            Some(QueueEntry::Unknown) | None => self.counters.undecodable_report_count += 1,
        }
        None
    }
}

impl UdpSender {
    /// Sends, where reports are ignored past those that are pending.
    fn offer(&self, send: impl Fn(&Socket) -> io::Result<usize>) -> io::Result<usize> {
        let mut result = send(&self.socket);
        if self.ignores_reports {
            for _ in 1..SEND_ATTEMPT_COUNT_MAX {
                if !result.as_ref().is_err_and(may_be_report) {
                    break;
                }
                result = send(&self.socket);
            }
        }
        result
    }

    /// What became of a send of `length_bytes`, which begin with `head`.
    fn note_sent(
        &mut self,
        sent: io::Result<usize>,
        head: &[u8],
        length_bytes: usize,
    ) -> Result<TxToken, SendRefusal> {
        match sent {
            Ok(_) => {
                let token = self.counters.count_sent();
                if let Some(radio) = &mut self.radio {
                    radio.note(head, token);
                }
                Ok(token)
            }
            Err(error) => {
                let refused = SendRefusal::from_io(&error, length_bytes);
                let has_carrier = || {
                    let interface = self.interface.as_deref();
                    interface.is_none_or(|name| has_carrier(name).unwrap_or(true))
                };
                let refusal = refused.at_interface(has_carrier);
                self.counters.count_refusal(refusal);
                match refused {
                    SendRefusal::QueueFull {
                        errno: libc::ENOBUFS,
                    }
                    | SendRefusal::Other { .. } => self.realign_send_count(),
                    _ => {}
                }
                Err(refusal)
            }
        }
    }

    fn count_drops(&mut self, data: &ControlData) {
        if let Some(count) = data.drop_count {
            let new_count = count.wrapping_sub(self.kernel_drop_count);
            self.counters.kernel_drop_count += u64::from(new_count);
            self.kernel_drop_count = count;
        }
    }
}

impl DatagramSender for UdpSender {
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        let flags = libc::MSG_DONTWAIT;
        let sent = self.offer(|socket| match &self.answered {
            None => socket.send_with_flags(datagram, flags),
            Some(to) => socket.send_to_with_flags(datagram, to, flags),
        });
        self.note_sent(sent, datagram, datagram.len())
    }

    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        let parts = [IoSlice::new(head), IoSlice::new(tail)];
        let sent = self.offer(|socket| socket.send_vectored_with_flags(&parts, libc::MSG_DONTWAIT));
        self.note_sent(sent, head, head.len() + tail.len())
    }

    fn queued_bytes(&self) -> usize {
        let queued = unacknowledged_bytes(&self.socket).unwrap_or(0);
        usize::try_from(queued).unwrap_or(usize::MAX)
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        let mut packet = [0; RETURNED_BYTES];
        // Only a radio's reports bring something back.
        let room = if self.radio.is_some() {
            packet.len()
        } else {
            0
        };
        for _ in 0..DRAIN_COUNT_MAX {
            match self
                .reader
                .read(self.socket.as_fd(), &mut packet[..room], Queue::Errors)
            {
                Ok(Some(message)) => {
                    let data = ControlData::decode(self.reader.control());
                    if let Some(is_acknowledged) = data.is_acknowledged {
                        self.absorb_report(&packet[..message.length_bytes], is_acknowledged);
                    } else if let Some(stamp) = self.absorb_entry(&data) {
                        return Some(stamp);
                    }
                }
                Ok(None) => return None,
                Err(_) => {
                    self.counters.undecodable_report_count += 1;
                    return None;
                }
            }
        }
        None
    }

    fn next_radio_report(&mut self) -> Option<RadioReport> {
        self.radio.as_mut()?.take()
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        for _ in 0..RECEIVE_ATTEMPT_COUNT_MAX {
            match self
                .reader
                .read(self.socket.as_fd(), buffer, Queue::Arrivals)
            {
                Ok(Some(message)) => {
                    let data = ControlData::decode(self.reader.control());
                    self.count_drops(&data);
                    self.counters.reply_count += 1;
                    return Ok(Some(Received {
                        length_bytes: message.length_bytes,
                        is_truncated: message.is_truncated,
                        source: message.source.unwrap_or(self.peer),
                        stamps: data.stamps,
                        emulated: None,
                        no_room_count: 0,
                    }));
                }
                Ok(None) => return Ok(None),
                // A report about an earlier datagram, handed to whichever call comes first. It
                // stays in the error queue as well, where it is counted.
                Err(error) if is_broken(&error) => return Err(error),
                Err(_counted) if self.ignores_reports => {}
                Err(error) => {
                    self.counters.newest_report = Some(SendRefusal::from_io(&error, 0));
                }
            }
        }
        Ok(None)
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.socket.as_fd())
    }

    fn counters(&self) -> SenderCounters {
        self.counters
    }
}

/// The receiving socket, open to anyone.
#[derive(Debug)]
pub struct UdpReceiver {
    socket: Socket,
    reader: MessageReader,
    counters: ReceiverCounters,
    /// The kernel's drop count at the newest datagram, modulo 2^32.
    kernel_drop_count: u32,
    granted: GrantedOptions,
    /// The code point arrivals should have.
    dscp: Option<u8>,
    stamps: ReplyStamps,
}

impl UdpReceiver {
    /// Opens and binds the socket.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: &SocketSettings) -> Result<Self, SocketError> {
        Self::open_behind(settings, false)
    }

    /// As [`UdpReceiver::open`], behind a seal or not.
    fn open_behind(settings: &SocketSettings, is_sealed: bool) -> Result<Self, SocketError> {
        let socket = open_socket(settings, is_sealed)?;
        // Before the socket can receive, so that no datagram comes without.
        let armed = arm_receive(&socket, settings.timestamps);
        refuse(
            "SO_TIMESTAMPING",
            format!("{:?}", settings.timestamps),
            armed,
        )?;
        let drops = setsockopt(&socket, sockopt::RxqOvfl, &1);
        refuse("SO_RXQ_OVFL", 1, drops.map_err(io::Error::from))?;
        if settings.dscp.is_some() {
            let (option, level, name) = if settings.local.is_ipv4() {
                ("IP_RECVTOS", libc::SOL_IP, libc::IP_RECVTOS)
            } else {
                ("IPV6_RECVTCLASS", libc::SOL_IPV6, libc::IPV6_RECVTCLASS)
            };
            refuse(option, 1, set_int_option(&socket, level, name, 1))?;
        }
        bind(&socket, settings.local)?;
        Ok(Self {
            granted: granted_options(&socket, settings)?,
            socket,
            reader: MessageReader::new(),
            counters: ReceiverCounters::default(),
            kernel_drop_count: 0,
            dscp: settings.dscp,
            stamps: ReplyStamps::new(settings.timestamps),
        })
    }

    /// What the kernel granted.
    pub fn granted(&self) -> GrantedOptions {
        self.granted
    }

    /// Where it listens, with the port the kernel chose.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        local_address(&self.socket)
    }

    fn count_reply(&mut self, sent: io::Result<usize>, length: usize) -> Result<(), SendRefusal> {
        match sent {
            Ok(_) => {
                self.counters.reply_count += 1;
                Ok(())
            }
            Err(error) => {
                self.counters.reply_refused_count += 1;
                Err(SendRefusal::from_io(&error, length))
            }
        }
    }
}

impl DatagramReceiver for UdpReceiver {
    fn receive(&mut self, _now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        for _ in 0..RECEIVE_ATTEMPT_COUNT_MAX {
            let read = self
                .reader
                .read(self.socket.as_fd(), buffer, Queue::Arrivals)?;
            let Some(message) = read else { return Ok(None) };
            let data = ControlData::decode(self.reader.control());
            if let Some(count) = data.drop_count {
                let new_count = count.wrapping_sub(self.kernel_drop_count);
                self.counters.kernel_drop_count += u64::from(new_count);
                self.kernel_drop_count = count;
            }
            let Some(source) = message.source else {
                self.counters.sourceless_count += 1;
                continue;
            };
            let received = Received {
                length_bytes: message.length_bytes,
                is_truncated: message.is_truncated,
                source,
                stamps: data.stamps,
                emulated: None,
                no_room_count: self.counters.kernel_drop_count,
            };
            let is_damaged = data.is_damaged || message.is_control_truncated;
            self.counters.damaged_control_count += u64::from(is_damaged);
            self.counters.count_mark(self.dscp, data.traffic_class);
            self.counters.count_received(&received);
            return Ok(Some(received));
        }
        Ok(None)
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        let address = SockAddr::from(to);
        let flags = libc::MSG_DONTWAIT;
        let sent = self.socket.send_to_with_flags(datagram, &address, flags);
        self.count_reply(sent, datagram.len())
    }

    fn reply_stamped(
        &mut self,
        now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> Result<(), SendRefusal> {
        if !self.stamps.are_asked_for() {
            return self.reply(datagram, to);
        }
        // What is left of the reply before must not be taken for this one's, nor pile up.
        self.take_reply_stamp(now);
        let sent = self.stamps.send(&self.socket, now, datagram, to);
        self.count_reply(sent, datagram.len())
    }

    fn take_reply_stamp(&mut self, now: Instant) -> Option<i64> {
        if !self.stamps.is_look_due(now) {
            return None;
        }
        let taken = self.stamps.take(&self.socket, &mut self.reader, now);
        self.counters.reply_stamp_count = self.stamps.stamp_count;
        self.counters.reply_stamp_missing_count = self.stamps.missing_count;
        taken
    }

    fn next_due(&self) -> Option<Instant> {
        None
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.socket.as_fd())
    }

    fn counters(&self) -> ReceiverCounters {
        let mut counters = self.counters;
        // Where the kernel does not tell, it is as of the newest datagram.
        if let Ok(count) = drop_count(&self.socket) {
            counters.kernel_drop_count += u64::from(count.wrapping_sub(self.kernel_drop_count));
        }
        counters
    }
}

/// A socket with everything set that both directions share.
fn open_socket(settings: &SocketSettings, ignores_reports: bool) -> Result<Socket, SocketError> {
    let socket = socket::open(settings, Type::DGRAM, Protocol::UDP, DESCRIPTION.label)?;
    // A datagram too long for the path is refused instead of sent in pieces, of which the loss
    // of one would look like the loss of all. What reports of the network say of the path is ignored
    // with them. The values for IPv6 are those of their IPv4 twins.
    let discover = if ignores_reports {
        libc::IP_PMTUDISC_PROBE
    } else {
        libc::IP_PMTUDISC_DO
    };
    let (option, level, name) = if settings.local.is_ipv4() {
        ("IP_MTU_DISCOVER", libc::SOL_IP, libc::IP_MTU_DISCOVER)
    } else {
        ("IPV6_MTU_DISCOVER", libc::SOL_IPV6, IPV6_MTU_DISCOVER)
    };
    let set = set_int_option(&socket, level, name, discover);
    refuse(option, discover, set)?;
    Ok(socket)
}

/// The interface of the settings, or the one with the address of `socket`; `None` when none is known.
fn interface_of(settings: &SocketSettings, socket: &Socket) -> Option<String> {
    let named = settings.interface.clone();
    named.or_else(|| {
        let address = local_address(socket).ok()?.ip();
        interface_with_address(address).ok().flatten()
    })
}

/// True for what a report of the network (ICMP of either version) becomes; some of them the call itself may answer
/// as well, and then answers so again.
fn may_be_report(error: &io::Error) -> bool {
    let reports = [
        libc::ECONNREFUSED,
        libc::EHOSTUNREACH,
        libc::ENETUNREACH,
        libc::EHOSTDOWN,
        libc::ENONET,
        libc::EACCES,
        libc::EPROTO,
        libc::ENOPROTOOPT,
        libc::EOPNOTSUPP,
        libc::EMSGSIZE,
    ];
    let errno = error.raw_os_error();
    errno.is_some_and(|errno| reports.contains(&errno))
}

/// True for errors of the call itself; every other one is a report of the network.
fn is_broken(error: &io::Error) -> bool {
    let ours = [
        libc::EBADF,
        libc::EFAULT,
        libc::EINVAL,
        libc::ENOTSOCK,
        libc::ENOMEM,
    ];
    error
        .raw_os_error()
        .is_none_or(|errno| ours.contains(&errno))
}
