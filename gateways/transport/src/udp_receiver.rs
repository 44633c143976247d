//! The receiving UDP socket, which also sends replies. It frames, encrypts and retries nothing;
//! sending messages takes the other socket, [`super::udp::UdpSender`].

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, BorrowedFd};

use hil_core::time::Instant;
use nix::sys::socket::{setsockopt, sockopt};
use socket2::{SockAddr, Socket};

use super::udp::RECEIVE_ATTEMPT_COUNT_MAX;
use super::udp_socket::{
    GrantedOptions, UdpError, UdpSettings, bind, granted_options, local_address, open_socket,
    refuse,
};
use super::{DatagramReceiver, Received, ReceiverCounters, SendRefusal};
use hil_net::control::ControlData;
use hil_net::reply_stamps::ReplyStamps;
use hil_net::timestamping::{MessageReader, Queue, arm_receive, set_int_option};

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
    pub fn open(settings: &UdpSettings) -> Result<Self, UdpError> {
        let socket = open_socket(settings)?;
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
        self.counters
    }
}
