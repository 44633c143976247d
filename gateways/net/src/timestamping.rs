//! The kernel side of time stamps: which to ask for, the receive call that brings them, and what
//! an interface claims to offer. The control messages are decoded in a sibling file; whether a
//! claim holds only sending shows.
//!
//! `unsafe` is allowed here because `recvmsg`, two socket options and one `ioctl` have no safe form
//! that does not allocate.

use core::ffi::{c_char, c_int, c_ulong};
use core::mem;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};

use nix::sys::socket::{TimestampingFlag, setsockopt, sockopt};

/// Which stamps to ask the kernel for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TimestampMode {
    /// None.
    Off,
    /// Software stamps when a datagram leaves for the driver and when it arrives.
    #[default]
    Software,
    /// As `Software`, and before the queueing discipline: the only transmit stamp where the
    /// driver gives none, as on Wi-Fi.
    Scheduled,
    /// Software and network card stamps. The card must be set up for it, see
    /// [`super::nic_arming`].
    Hardware,
}

impl TimestampMode {
    /// True where the driver is to stamp what leaves, and not known never to.
    pub const fn stamps_departures(self) -> bool {
        matches!(self, Self::Software | Self::Hardware)
    }

    /// What a receiver asks for. Never transmit stamps: unfetched ones would take the room of
    /// arrivals.
    fn receive_flags(self) -> TimestampingFlag {
        let software = TimestampingFlag::SOF_TIMESTAMPING_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_RX_SOFTWARE;
        match self {
            Self::Off => TimestampingFlag::empty(),
            Self::Software | Self::Scheduled => software,
            Self::Hardware => {
                software
                    | TimestampingFlag::SOF_TIMESTAMPING_RAW_HARDWARE
                    | TimestampingFlag::SOF_TIMESTAMPING_RX_HARDWARE
            }
        }
    }

    /// What a sender asks for: the above for replies, and transmit stamps that carry the number
    /// of the send and no copy of the datagram.
    fn transmit_flags(self) -> TimestampingFlag {
        let bits = TimestampingFlag::from_bits_retain;
        let software = TimestampingFlag::SOF_TIMESTAMPING_TX_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_OPT_ID
            | TimestampingFlag::SOF_TIMESTAMPING_OPT_TSONLY;
        let transmit = match self {
            Self::Off => TimestampingFlag::empty(),
            Self::Software => software,
            Self::Scheduled => software | bits(libc::SOF_TIMESTAMPING_TX_SCHED),
            // Without TX_SWHW a card's stamp suppresses the software stamp.
            Self::Hardware => {
                software
                    | TimestampingFlag::SOF_TIMESTAMPING_TX_HARDWARE
                    | bits(libc::SOF_TIMESTAMPING_OPT_TX_SWHW)
            }
        };
        self.receive_flags() | transmit
    }
}

/// Asks for the stamps of `mode` on a sending socket; its send counter starts at 0 here.
///
/// # Errors
/// What the kernel answered.
pub fn arm_transmit(socket: &impl AsFd, mode: TimestampMode) -> io::Result<()> {
    Ok(setsockopt(
        socket,
        sockopt::Timestamping,
        &mode.transmit_flags(),
    )?)
}

/// Makes the kernel count the next send of an armed socket as 0 again.
///
/// # Errors
/// What the kernel answered.
pub fn restart_send_count(socket: &impl AsFd, mode: TimestampMode) -> io::Result<()> {
    // The count restarts when the option is set anew. Everything else stays on, for the kernel
    // switches receive stamps off and on with a delay.
    let uncounted = mode.transmit_flags() - TimestampingFlag::SOF_TIMESTAMPING_OPT_ID;
    setsockopt(socket, sockopt::Timestamping, &uncounted)?;
    arm_transmit(socket, mode)
}

/// Asks for the stamps of `mode` on a receiving socket, and how to bring those of replies that ask
/// for one themselves: with their number, counted from 0 here, and no copy.
///
/// # Errors
/// What the kernel answered.
pub fn arm_receive(socket: &impl AsFd, mode: TimestampMode) -> io::Result<()> {
    let mut flags = mode.receive_flags();
    if mode.stamps_departures() {
        flags |= TimestampingFlag::SOF_TIMESTAMPING_OPT_ID
            | TimestampingFlag::SOF_TIMESTAMPING_OPT_TSONLY;
    }
    Ok(setsockopt(socket, sockopt::Timestamping, &flags)?)
}

/// Makes the kernel count the next reply that asks for a stamp as 0 again.
pub(super) fn restart_reply_count(socket: &impl AsFd, mode: TimestampMode) -> io::Result<()> {
    setsockopt(socket, sockopt::Timestamping, &mode.receive_flags())?;
    arm_receive(socket, mode)
}

/// Room for the control messages of one datagram: stamps, drop count, an error report and more
/// take under 200 bytes.
const CONTROL_BYTES: usize = 512;
/// `sizeof(struct sockaddr_storage)`.
const ADDRESS_BYTES: usize = 128;
/// The same, as the kernel takes it.
const ADDRESS_LENGTH: libc::socklen_t = 128;
/// Bytes of an `int`, as the kernel takes it.
const INT_LENGTH: libc::socklen_t = 4;
const _: () = assert!(size_of::<c_int>() == 4);

/// Preallocated buffers of the receive call, aligned as the kernel's structures are.
#[derive(Debug)]
#[repr(C, align(16))]
pub struct MessageReader {
    control: [u8; CONTROL_BYTES],
    address: [u8; ADDRESS_BYTES],
    control_length: usize,
}

/// One datagram or entry of the error queue, as `recvmsg` returned it.
#[derive(Debug, Clone, Copy)]
pub struct Message {
    /// Bytes written to the buffer.
    pub length_bytes: usize,
    /// The sender; `None` when the kernel gave no IP address.
    pub source: Option<SocketAddr>,
    /// The message was longer than the buffer and its end is gone.
    pub is_truncated: bool,
    /// Its control messages found no room, so stamps may be missing.
    pub is_control_truncated: bool,
}

/// Which queue of a socket to read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Queue {
    /// What arrived.
    Arrivals,
    /// The error queue: transmit stamps and reports of the network.
    Errors,
}

impl Default for MessageReader {
    fn default() -> Self {
        Self::new()
    }
}

impl MessageReader {
    /// With empty buffers.
    pub fn new() -> Self {
        Self {
            control: [0; CONTROL_BYTES],
            address: [0; ADDRESS_BYTES],
            control_length: 0,
        }
    }

    /// Takes the next message of `queue`, or `None` when there is none. Never blocks.
    ///
    /// # Errors
    /// What the kernel answered.
    #[allow(
        unsafe_code,
        reason = "no safe receive call takes preallocated control memory"
    )]
    pub fn read(
        &mut self,
        socket: BorrowedFd<'_>,
        buffer: &mut [u8],
        queue: Queue,
    ) -> io::Result<Option<Message>> {
        let flags = match queue {
            Queue::Arrivals => libc::MSG_DONTWAIT,
            Queue::Errors => libc::MSG_DONTWAIT | libc::MSG_ERRQUEUE,
        };
        let mut vector = libc::iovec {
            iov_base: buffer.as_mut_ptr().cast(),
            iov_len: buffer.len(),
        };
        // SAFETY: msghdr is integers and pointers, for which all-zero bytes are valid; it may
        // have private padding, so it cannot be written as a literal.
        let mut header: libc::msghdr = unsafe { mem::zeroed() };
        header.msg_iov = &raw mut vector;
        header.msg_iovlen = 1;
        header.msg_name = self.address.as_mut_ptr().cast();
        header.msg_control = self.control.as_mut_ptr().cast();
        let length_bytes = loop {
            header.msg_namelen = ADDRESS_LENGTH;
            header.msg_controllen = CONTROL_BYTES as _;
            // SAFETY: every pointer in `header` is to a live buffer of the length beside it that
            // nothing else uses during the call; the descriptor is open for the borrow.
            let result = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut header, flags) };
            match usize::try_from(result) {
                Ok(length_bytes) => break length_bytes,
                Err(_) => match io::Error::last_os_error() {
                    error if error.kind() == io::ErrorKind::Interrupted => {}
                    error if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
                    error => return Err(error),
                },
            }
        };
        self.control_length = header.msg_controllen.min(CONTROL_BYTES);
        let address_length = (header.msg_namelen as usize).min(ADDRESS_BYTES);
        Ok(Some(Message {
            length_bytes: length_bytes.min(buffer.len()),
            source: decode_address(&self.address[..address_length]),
            is_truncated: header.msg_flags & libc::MSG_TRUNC != 0,
            is_control_truncated: header.msg_flags & libc::MSG_CTRUNC != 0,
        }))
    }

    /// The control messages of the message read last.
    pub fn control(&self) -> &[u8] {
        &self.control[..self.control_length]
    }
}

/// `struct sockaddr_in` or `sockaddr_in6` from its bytes.
fn decode_address(bytes: &[u8]) -> Option<SocketAddr> {
    let family = u16::from_ne_bytes(*bytes.first_chunk()?);
    let port = u16::from_be_bytes(*bytes.get(2..)?.first_chunk()?);
    match c_int::from(family) {
        libc::AF_INET => {
            let octets: [u8; 4] = *bytes.get(4..)?.first_chunk()?;
            Some(SocketAddrV4::new(Ipv4Addr::from(octets), port).into())
        }
        libc::AF_INET6 => {
            let flow = u32::from_be_bytes(*bytes.get(4..)?.first_chunk()?);
            let octets: [u8; 16] = *bytes.get(8..)?.first_chunk()?;
            let scope = u32::from_ne_bytes(*bytes.get(24..)?.first_chunk()?);
            Some(SocketAddrV6::new(Ipv6Addr::from(octets), port, flow, scope).into())
        }
        _ => None,
    }
}

/// Sets a socket option with an `int` value.
///
/// # Errors
/// What the kernel answered.
#[allow(unsafe_code, reason = "no crate wraps IP_MTU_DISCOVER")]
pub fn set_int_option(
    socket: &impl AsFd,
    level: c_int,
    name: c_int,
    value: c_int,
) -> io::Result<()> {
    let length = INT_LENGTH;
    let pointer = (&raw const value).cast();
    let descriptor = socket.as_fd().as_raw_fd();
    // SAFETY: the kernel reads `length` bytes at `pointer`, which is a live int of that size.
    let result = unsafe { libc::setsockopt(descriptor, level, name, pointer, length) };
    if result == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

/// Reads a socket option with an `int` value.
///
/// # Errors
/// What the kernel answered.
pub fn int_option(socket: &impl AsFd, level: c_int, name: c_int) -> io::Result<c_int> {
    let [value] = int_options(socket, level, name)?;
    Ok(value)
}

/// Datagrams that the kernel dropped because the receive buffer was full, modulo 2^32 (`SO_MEMINFO`, since
/// Linux 4.12): what `SO_RXQ_OVFL` will say with the next one.
///
/// # Errors
/// What the kernel answered.
pub fn drop_count(socket: &impl AsFd) -> io::Result<u32> {
    let counts = int_options(socket, libc::SOL_SOCKET, libc::SO_MEMINFO)?;
    let counts: [c_int; libc::SK_MEMINFO_DROPS as usize + 1] = counts;
    Ok(counts[libc::SK_MEMINFO_DROPS as usize].cast_unsigned())
}

#[allow(unsafe_code, reason = "no crate wraps IPV6_MTU and SO_MEMINFO")]
fn int_options<const N: usize>(
    socket: &impl AsFd,
    level: c_int,
    name: c_int,
) -> io::Result<[c_int; N]> {
    let mut values = [0; N];
    let mut length = libc::socklen_t::try_from(size_of_val(&values)).unwrap_or(0);
    let pointer = values.as_mut_ptr().cast();
    let descriptor = socket.as_fd().as_raw_fd();
    // SAFETY: the kernel writes at most `length` bytes at `pointer`, live ints of that size.
    let result = unsafe { libc::getsockopt(descriptor, level, name, pointer, &raw mut length) };
    if result == 0 {
        Ok(values)
    } else {
        Err(io::Error::last_os_error())
    }
}

/// What an interface claims to stamp (`ETHTOOL_GET_TS_INFO`). Several drivers claim what they
/// never do, so a claim is a reason to probe, not a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "four independent claims of one driver"
)]
pub struct TimestampCapabilities {
    /// Software transmit stamps.
    pub tx_software: bool,
    /// Software receive stamps.
    pub rx_software: bool,
    /// Hardware transmit stamps.
    pub tx_hardware: bool,
    /// Hardware receive stamps.
    pub rx_hardware: bool,
    /// Index of the card's clock (`/dev/ptpN`); `None` when it has none.
    pub phc_index: Option<u32>,
}

/// `ETHTOOL_GET_TS_INFO` of `linux/ethtool.h`.
const ETHTOOL_GET_TS_INFO: u32 = 0x41;

/// `struct ethtool_ts_info` of `linux/ethtool.h`.
#[derive(Debug, Default)]
#[repr(C)]
struct EthtoolTimestampInfo {
    command: u32,
    timestamping: u32,
    phc_index: i32,
    transmit_types: u32,
    transmit_reserved: [u32; 3],
    receive_filters: u32,
    receive_reserved: [u32; 3],
}

impl TimestampCapabilities {
    /// Asks the driver of `interface`.
    ///
    /// # Errors
    /// When there is no such interface or its driver does not answer (`EOPNOTSUPP`).
    #[allow(unsafe_code, reason = "no crate wraps ETHTOOL_GET_TS_INFO")]
    pub fn query(interface: &str) -> io::Result<Self> {
        let mut info = EthtoolTimestampInfo {
            command: ETHTOOL_GET_TS_INFO,
            ..Default::default()
        };
        let data = (&raw mut info).cast();
        // SAFETY: SIOCETHTOOL with this command reads and writes one `ethtool_ts_info`, which
        // `info` is.
        unsafe { device_request(interface, libc::SIOCETHTOOL, data) }?;
        Ok(Self::from_bits(info.timestamping, info.phc_index))
    }

    /// The claims in the kernel's bits.
    fn from_bits(timestamping: u32, phc_index: i32) -> Self {
        let claims = |bits: u32| timestamping & bits == bits;
        let raw = libc::SOF_TIMESTAMPING_RAW_HARDWARE;
        Self {
            tx_software: claims(libc::SOF_TIMESTAMPING_TX_SOFTWARE),
            rx_software: claims(libc::SOF_TIMESTAMPING_RX_SOFTWARE),
            tx_hardware: claims(libc::SOF_TIMESTAMPING_TX_HARDWARE | raw),
            rx_hardware: claims(libc::SOF_TIMESTAMPING_RX_HARDWARE | raw),
            phc_index: u32::try_from(phc_index).ok(),
        }
    }
}

/// How a network card is set up to stamp (`struct hwtstamp_config` of `linux/net_tstamp.h`), in the
/// kernel's own numbers so that it can be put back as it was. This is a setting of the card, shared
/// by all its users such as a PTP daemon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HardwareStamping {
    /// `HWTSTAMP_FLAG_*`: 1 where a bonded interface answers for the card that is active.
    pub flags: i32,
    /// How it stamps what leaves, one of `HWTSTAMP_TX_*`: 0 not, 1 on, 2 and 3 on with one-step PTP
    /// messages.
    pub transmit_type: i32,
    /// Which arrivals it stamps: 0 none, 1 all, else one of `HWTSTAMP_FILTER_*`.
    pub receive_filter: i32,
}

impl HardwareStamping {
    /// Everything off (`HWTSTAMP_TX_OFF`, `HWTSTAMP_FILTER_NONE`).
    pub const OFF: Self = Self {
        flags: 0,
        transmit_type: libc::HWTSTAMP_TX_OFF.cast_signed(),
        receive_filter: libc::HWTSTAMP_FILTER_NONE.cast_signed(),
    };

    /// The card stamps what leaves: all types but `HWTSTAMP_TX_OFF` do.
    pub const fn is_transmit_on(&self) -> bool {
        self.transmit_type != Self::OFF.transmit_type
    }

    /// This setting with transmit stamps: a type that gives them, such as one-step PTP, stays.
    #[must_use]
    pub const fn with_transmit(self) -> Self {
        if self.is_transmit_on() {
            return self;
        }
        Self {
            transmit_type: libc::HWTSTAMP_TX_ON.cast_signed(),
            ..self
        }
    }

    /// How the card behind `interface` is set up now (`SIOCGHWTSTAMP`).
    ///
    /// # Errors
    /// `EOPNOTSUPP` when it cannot stamp, as on loopback, veth and virtio, or does not say.
    pub fn query(interface: &str) -> io::Result<Self> {
        Self::OFF.exchange(interface, libc::SIOCGHWTSTAMP)
    }

    /// Sets the card up (`SIOCSHWTSTAMP`) and says what it settled for. Needs `CAP_NET_ADMIN` and
    /// changes the card for all its users; [`super::nic_arming`] also puts it back.
    ///
    /// # Errors
    /// `EOPNOTSUPP` when it cannot stamp, `ERANGE` when it does not have that filter, `EPERM`.
    pub fn set(interface: &str, wanted: Self) -> io::Result<Self> {
        wanted.exchange(interface, libc::SIOCSHWTSTAMP)
    }

    #[allow(unsafe_code, reason = "no crate wraps SIOCGHWTSTAMP and SIOCSHWTSTAMP")]
    fn exchange(self, interface: &str, request: c_ulong) -> io::Result<Self> {
        let mut config = libc::hwtstamp_config {
            flags: self.flags,
            tx_type: self.transmit_type,
            rx_filter: self.receive_filter,
        };
        let data = (&raw mut config).cast();
        // SAFETY: both requests read and write one `hwtstamp_config`, which `config` is.
        unsafe { device_request(interface, request, data) }?;
        Ok(Self {
            flags: config.flags,
            transmit_type: config.tx_type,
            receive_filter: config.rx_filter,
        })
    }
}

/// The largest packet that `interface` takes, bytes (`SIOCGIFMTU`): what no report of the network changes.
///
/// # Errors
/// When there is no such interface.
#[allow(unsafe_code, reason = "no crate wraps SIOCGIFMTU")]
pub fn interface_mtu_bytes(interface: &str) -> io::Result<u32> {
    // SAFETY: the request reads the name only and writes the number into the message.
    let message = unsafe { device_request(interface, libc::SIOCGIFMTU, core::ptr::null_mut()) }?;
    // SAFETY: after this request the union holds the number.
    let mtu_bytes = unsafe { message.ifr_ifru.ifru_mtu };
    u32::try_from(mtu_bytes).map_err(io::Error::other)
}

/// `ETHTOOL_GLINK` of `linux/ethtool.h`.
const ETHTOOL_GLINK: u32 = 0x0a;

/// `struct ethtool_value` of `linux/ethtool.h`.
#[derive(Debug)]
#[repr(C)]
pub(super) struct EthtoolValue {
    pub(super) command: u32,
    pub(super) value: u32,
}

/// True while `interface` is up and has a carrier (`ETHTOOL_GLINK`), as the driver knows it now.
///
/// # Errors
/// When there is no such interface or its driver does not say (`EOPNOTSUPP`).
#[allow(unsafe_code, reason = "no crate wraps ETHTOOL_GLINK")]
pub fn has_carrier(interface: &str) -> io::Result<bool> {
    let mut link = EthtoolValue {
        command: ETHTOOL_GLINK,
        value: 0,
    };
    let data = (&raw mut link).cast();
    // SAFETY: SIOCETHTOOL with this command reads and writes one `ethtool_value`, which `link` is.
    unsafe { device_request(interface, libc::SIOCETHTOOL, data) }?;
    Ok(link.value != 0)
}

/// One `ioctl` to a network interface; gives what the kernel made of the message.
///
/// # Safety
/// `data` points to the live structure that `request` reads and writes, or the request takes none.
#[allow(unsafe_code, reason = "the kernel follows the pointer it is given")]
pub(super) unsafe fn device_request(
    interface: &str,
    request: c_ulong,
    data: *mut c_char,
) -> io::Result<libc::ifreq> {
    let mut name: [c_char; libc::IFNAMSIZ] = [0; libc::IFNAMSIZ];
    // One byte stays zero as the end of the name.
    if interface.len() >= name.len() || interface.is_empty() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    for (place, byte) in name.iter_mut().zip(interface.bytes()) {
        *place = c_char::from_ne_bytes([byte]);
    }
    let mut message = libc::ifreq {
        ifr_name: name,
        ifr_ifru: libc::__c_anonymous_ifr_ifru { ifru_data: data },
    };
    let socket = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::DGRAM, None)?;
    // SAFETY: `message` is a live ifreq whose data pointer fits the request, by the contract of
    // this function.
    let result = unsafe { libc::ioctl(socket.as_raw_fd(), request as _, &raw mut message) };
    if result >= 0 {
        Ok(message)
    } else {
        Err(io::Error::last_os_error())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_both_families_are_read_and_others_are_not() {
        let mut bytes = u16::try_from(libc::AF_INET).unwrap().to_ne_bytes().to_vec();
        bytes.extend([0x1f, 0x90, 127, 0, 0, 1, 0, 0]);
        assert_eq!(decode_address(&bytes), "127.0.0.1:8080".parse().ok());
        let mut bytes = u16::try_from(libc::AF_INET6)
            .unwrap()
            .to_ne_bytes()
            .to_vec();
        bytes.extend([0x1f, 0x90, 0, 0, 0, 0]);
        bytes.extend(Ipv6Addr::LOCALHOST.octets());
        bytes.extend(0_u32.to_ne_bytes());
        assert_eq!(decode_address(&bytes), "[::1]:8080".parse().ok());
        for length in 0..bytes.len() {
            assert_eq!(decode_address(&bytes[..length]), None);
        }
        assert_eq!(decode_address(&[9; 28]), None);
    }

    #[test]
    fn hardware_is_claimed_only_together_with_its_report() {
        let bits = libc::SOF_TIMESTAMPING_TX_HARDWARE | libc::SOF_TIMESTAMPING_TX_SOFTWARE;
        let claims = TimestampCapabilities::from_bits(bits, -1);
        assert!(claims.tx_software && !claims.tx_hardware && !claims.rx_software);
        assert_eq!(claims.phc_index, None);
        let raw = libc::SOF_TIMESTAMPING_RAW_HARDWARE;
        let claims = TimestampCapabilities::from_bits(bits | raw, 3);
        assert!(claims.tx_hardware && !claims.rx_hardware);
        assert_eq!(claims.phc_index, Some(3));
    }

    #[test]
    fn loopback_claims_software_stamps_and_refuses_hardware() {
        let claims = TimestampCapabilities::query("lo").unwrap();
        assert!(claims.tx_software && claims.rx_software);
        assert!(!claims.tx_hardware && !claims.rx_hardware);
        let refusal = HardwareStamping::query("lo").unwrap_err();
        assert_eq!(refusal.raw_os_error(), Some(libc::EOPNOTSUPP));
        assert!(HardwareStamping::set("lo", HardwareStamping::OFF).is_err());
    }

    #[test]
    fn loopback_takes_packets_of_64_kib() {
        assert_eq!(interface_mtu_bytes("lo").unwrap(), 65_536);
    }

    #[test]
    fn an_impossible_interface_name_is_an_error() {
        for name in ["", "no-such-device", "a-name-longer-than-the-kernel-allows"] {
            assert!(interface_mtu_bytes(name).is_err(), "{name}");
            assert!(TimestampCapabilities::query(name).is_err(), "{name}");
        }
    }
}
