//! Finds out which stamps really arrive, by sending: drivers claim stamps they never give, and
//! the kernel switches receive stamps on from a worker thread that a spinning real-time thread
//! can starve. It measures no network.

use core::time::Duration;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::os::fd::BorrowedFd;
use std::{io, thread};

use hil_core::time::Instant;
use nix::poll::{PollFd, PollFlags, ppoll};
use thiserror::Error;

use super::socket::{SocketError, SocketSettings};
use super::udp::{UdpReceiver, UdpSender};
use super::{DatagramReceiver, DatagramSender, SendRefusal};
use hil_net::clock_pair::monotonic_now;
use hil_net::interface::interface_with_address;
use hil_net::timestamping::{TimestampCapabilities, TimestampMode};
use hil_net::{TransmitStage, TxToken};

/// How long one probe datagram may take to come back with its stamps.
const STAMP_WAIT: Duration = Duration::from_millis(20);
/// The same for a card's stamp, which the driver fetches from a worker.
const CARD_STAMP_WAIT: Duration = Duration::from_millis(100);
/// Pause after a probe that came without a stamp: time for the kernel's worker.
const RETRY_PAUSE: Duration = Duration::from_millis(2);
/// What a probe datagram contains; no gateway takes it for one of its own.
const PROBE_DATAGRAM: &[u8] = b"hil-runtime stamp probe";
/// The discard port (RFC 863): what is sent there means nothing to anyone.
pub const DISCARD_PORT: u16 = 9;

/// What to probe, and for how long.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProbeSettings {
    /// Which stamps the run will ask for.
    pub timestamps: TimestampMode,
    /// Where to send the transmit probes, so that they leave as the run's datagrams will: the
    /// peer's address with [`DISCARD_PORT`] is polite. `None` probes loopback.
    pub transmit_target: Option<SocketAddr>,
    /// Interface the run is bound to; needs a target. `None` leaves the way to the routes.
    pub interface: Option<String>,
    /// Stamps in a row that count as proof.
    pub proof_count: u32,
    /// Longest time the receive and the transmit half may each take.
    pub bound: Duration,
}

impl ProbeSettings {
    /// Loopback, 20 stamps in a row, two seconds for each half.
    pub const fn loopback(timestamps: TimestampMode) -> Self {
        Self {
            timestamps,
            transmit_target: None,
            interface: None,
            proof_count: 20,
            bound: Duration::from_secs(2),
        }
    }
}

/// Whether a kind of stamp is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Availability {
    /// As many as asked for were seen in a row.
    Seen,
    /// The driver claims it but the probe did not see enough of it.
    ClaimedButNotSeen,
    /// The driver does not claim it, or could not be asked, and the probe did not see it; or the
    /// run does not ask for it.
    NotOffered,
}

/// What the probe found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProbeReport {
    /// Software receive stamps, probed over loopback: the kernel gives them to all interfaces or
    /// to none.
    pub rx_software: Availability,
    /// Software transmit stamps of the driver.
    pub tx_software: Availability,
    /// Transmit stamps before the queueing discipline; asked for in
    /// [`TimestampMode::Scheduled`] only.
    pub tx_scheduled: Availability,
    /// Transmit stamps of the network card; asked for in [`TimestampMode::Hardware`] only.
    pub tx_hardware: Availability,
    /// What the driver of the interface that the transmit probes left by claims; `None` when it
    /// does not answer or the interface is unknown. Hardware receive stamps are known from here
    /// only: they need a peer that sends.
    pub capabilities: Option<TimestampCapabilities>,
    /// Datagrams sent to find the receive stamps.
    pub attempts: u32,
    /// Why transmit probes did not leave, if some did not.
    pub newest_refusal: Option<SendRefusal>,
    /// Time the probe took.
    pub waited_ns: i64,
}

/// Keeps the kernel's receive stamps switched on. Hold it as long as any receiver needs them.
#[derive(Debug)]
#[must_use = "receive stamps may go when the sentinel goes"]
pub struct Sentinel {
    _receiver: UdpReceiver,
}

/// Why nothing could be probed.
#[derive(Debug, Error)]
pub enum ProbeError {
    /// An interface cannot be probed without sending through it.
    #[error("interface {interface} is to be probed but no transmit target is given")]
    NoTarget {
        /// Its name.
        interface: String,
    },
    /// A probe socket could not be set up.
    #[error("probe socket: {0}")]
    Socket(#[from] SocketError),
    /// Waiting or reading failed.
    #[error("probe of kernel stamps: {0}")]
    Io(#[from] io::Error),
}

/// Switches receive stamps on and sends until they arrive or the bound has passed, then does the
/// same for transmit stamps. Call it from a normal thread before the real-time threads start,
/// and keep the [`Sentinel`].
///
/// # Errors
/// When the probe itself failed. Missing stamps are a finding, not an error.
pub fn arm_and_probe(settings: &ProbeSettings) -> Result<(ProbeReport, Sentinel), ProbeError> {
    if let (Some(interface), None) = (&settings.interface, settings.transmit_target) {
        let interface = interface.clone();
        return Err(ProbeError::NoTarget { interface });
    }
    let start = monotonic_now()?;
    let (mut receiver, mut sender) = open_loopback(settings.timestamps)?;
    let (is_rx_seen, attempts) = probe_receive(settings, &mut sender, &mut receiver)?;

    if let Some(target) = settings.transmit_target {
        sender = open_towards(settings, target)?;
    }
    let seen = probe_transmit(settings, &mut sender)?;
    let capabilities = capabilities_of(settings, &sender);

    let mode = settings.timestamps;
    let is_armed = mode != TimestampMode::Off;
    let claims = |claim: fn(&TimestampCapabilities) -> bool| {
        is_armed && capabilities.as_ref().is_some_and(claim)
    };
    let judge = |is_seen, is_claimed| match (is_seen, is_claimed) {
        (true, _) => Availability::Seen,
        (false, true) => Availability::ClaimedButNotSeen,
        (false, false) => Availability::NotOffered,
    };
    let claims_tx_hardware = mode == TimestampMode::Hardware && claims(|c| c.tx_hardware);
    // The stack itself takes this stamp, whatever the driver.
    let claims_scheduled = mode == TimestampMode::Scheduled;
    let report = ProbeReport {
        // So does it with receive stamps.
        rx_software: judge(is_rx_seen, is_armed),
        tx_software: judge(seen.software, claims(|c| c.tx_software)),
        tx_scheduled: judge(seen.scheduled, claims_scheduled),
        tx_hardware: judge(seen.hardware, claims_tx_hardware),
        capabilities,
        attempts,
        newest_refusal: seen.newest_refusal,
        waited_ns: monotonic_now()?.ns_since(start),
    };
    let sentinel = Sentinel {
        _receiver: receiver,
    };
    Ok((report, sentinel))
}

/// A pair over loopback: IPv4, or IPv6 on a host without it.
fn open_loopback(mode: TimestampMode) -> Result<(UdpReceiver, UdpSender), ProbeError> {
    let open = |address: SocketAddr| -> Result<_, ProbeError> {
        let mut settings = SocketSettings::new(address, address);
        settings.timestamps = mode;
        let receiver = UdpReceiver::open(&settings)?;
        settings.peer = receiver.local_address()?;
        Ok((receiver, UdpSender::open(&settings)?))
    };
    open((Ipv4Addr::LOCALHOST, 0).into()).or_else(|first| {
        // The first error is the one to fix.
        open((Ipv6Addr::LOCALHOST, 0).into()).map_err(|_second| first)
    })
}

/// A sender that leaves by the interface of the run.
fn open_towards(settings: &ProbeSettings, target: SocketAddr) -> Result<UdpSender, ProbeError> {
    let unspecified = match target {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let mut udp = SocketSettings::new(unspecified, target);
    udp.interface.clone_from(&settings.interface);
    udp.timestamps = settings.timestamps;
    Ok(UdpSender::open(&udp)?)
}

/// The claims of the interface that `sender` leaves by.
fn capabilities_of(settings: &ProbeSettings, sender: &UdpSender) -> Option<TimestampCapabilities> {
    if let Some(interface) = &settings.interface {
        return TimestampCapabilities::query(interface).ok();
    }
    let own_address = sender.local_address().ok()?.ip();
    let interface = interface_with_address(own_address).ok()??;
    TimestampCapabilities::query(&interface).ok()
}

/// Sends to ourselves until enough datagrams in a row came with a stamp.
fn probe_receive(
    settings: &ProbeSettings,
    sender: &mut UdpSender,
    receiver: &mut UdpReceiver,
) -> Result<(bool, u32), ProbeError> {
    let end = monotonic_now()? + settings.bound;
    let (mut attempts, mut stamped_in_row) = (0, 0);
    let mut buffer = [0; PROBE_DATAGRAM.len()];
    while settings.timestamps != TimestampMode::Off && monotonic_now()? < end {
        attempts += 1;
        // A refusal shows as a datagram that does not come.
        sender.send(PROBE_DATAGRAM).ok();
        wait(receiver.poll_fd(), PollFlags::POLLIN, STAMP_WAIT)?;
        let mut is_stamped = false;
        while let Some(received) = receiver.receive(Instant::ZERO, &mut buffer)? {
            is_stamped = received.stamps.software_ns.is_some();
        }
        stamped_in_row = if is_stamped { stamped_in_row + 1 } else { 0 };
        if stamped_in_row >= settings.proof_count {
            return Ok((true, attempts));
        }
        if !is_stamped {
            pause();
        }
    }
    Ok((false, attempts))
}

/// Stamps seen so far, and which kinds are proved.
#[derive(Debug, Default)]
struct TransmitFinding {
    software: bool,
    scheduled: bool,
    hardware: bool,
    newest_refusal: Option<SendRefusal>,
}

/// Sends until every kind of transmit stamp the mode asks for is proved, or the bound passes.
fn probe_transmit(
    settings: &ProbeSettings,
    sender: &mut UdpSender,
) -> Result<TransmitFinding, ProbeError> {
    let mut finding = TransmitFinding::default();
    let mode = settings.timestamps;
    if mode == TimestampMode::Off {
        return Ok(finding);
    }
    // What the receive half left behind.
    while sender.next_stamp().is_some() {}
    let end = monotonic_now()? + settings.bound;
    let mut in_row = [0_u32; 3];
    loop {
        let seen = match sender.send(PROBE_DATAGRAM) {
            Ok(token) => collect_stamps(sender, token, mode)?,
            Err(refusal) => {
                finding.newest_refusal = Some(refusal);
                pause();
                [false; 3]
            }
        };
        for (count, is_seen) in in_row.iter_mut().zip(seen) {
            *count = if is_seen { *count + 1 } else { 0 };
        }
        let proved = in_row.map(|count| count >= settings.proof_count);
        finding.software |= proved[0];
        finding.scheduled |= proved[1];
        finding.hardware |= proved[2];
        let is_done = finding.software
            && (finding.scheduled || mode != TimestampMode::Scheduled)
            && (finding.hardware || mode != TimestampMode::Hardware);
        if is_done || monotonic_now()? >= end {
            return Ok(finding);
        }
    }
}

/// Which kinds of stamp (software, scheduled, hardware) the send `token` got in time.
fn collect_stamps(
    sender: &mut UdpSender,
    token: TxToken,
    mode: TimestampMode,
) -> Result<[bool; 3], ProbeError> {
    let wanted = [
        true,
        mode == TimestampMode::Scheduled,
        mode == TimestampMode::Hardware,
    ];
    let mut seen = [false; 3];
    let patience = if mode == TimestampMode::Hardware {
        CARD_STAMP_WAIT
    } else {
        STAMP_WAIT
    };
    let end = monotonic_now()? + patience;
    loop {
        while let Some(stamp) = sender.next_stamp() {
            if stamp.token != token {
                continue;
            }
            let has_software = stamp.stamps.software_ns.is_some();
            seen[0] |= has_software && stamp.stage == TransmitStage::Sent;
            seen[1] |= has_software && stamp.stage == TransmitStage::Scheduled;
            seen[2] |= stamp.stamps.hardware_ns.is_some();
        }
        let left = end.saturating_duration_since(monotonic_now()?);
        if wanted.iter().zip(seen).all(|(w, s)| s || !w) || left.is_zero() {
            return Ok(seen);
        }
        // Pending entries show as POLLERR, which is always waited for.
        wait(sender.poll_fd(), PollFlags::empty(), left)?;
    }
}

/// Gives the kernel's worker time to run.
#[allow(
    clippy::disallowed_methods,
    reason = "a probe runs before any loop, in a normal thread that is meant to step aside"
)]
fn pause() {
    thread::sleep(RETRY_PAUSE);
}

/// Waits until the descriptor is ready or the time has passed.
fn wait(descriptor: Option<BorrowedFd<'_>>, flags: PollFlags, bound: Duration) -> io::Result<()> {
    let mut descriptors = descriptor.map(|fd| PollFd::new(fd, flags));
    let descriptors = descriptors.as_mut_slice();
    let bound = nix::sys::time::TimeSpec::from_duration(bound);
    match ppoll(descriptors, Some(bound), None) {
        Ok(_) | Err(nix::errno::Errno::EINTR) => Ok(()),
        Err(errno) => Err(errno.into()),
    }
}

#[cfg(test)]
mod tests {
    use hil_core::time::duration_ns;

    use super::*;

    #[test]
    fn loopback_gives_software_stamps_and_no_others() {
        let settings = ProbeSettings::loopback(TimestampMode::Software);
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.rx_software, Availability::Seen, "{report:?}");
        assert_eq!(report.tx_software, Availability::Seen, "{report:?}");
        assert_eq!(report.tx_hardware, Availability::NotOffered);
        assert_eq!(report.tx_scheduled, Availability::NotOffered);
        assert!(report.attempts >= settings.proof_count);
        assert_eq!(report.newest_refusal, None);
    }

    #[test]
    fn scheduled_stamps_are_proved_when_asked_for() {
        let settings = ProbeSettings::loopback(TimestampMode::Scheduled);
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.tx_scheduled, Availability::Seen, "{report:?}");
    }

    #[test]
    fn hardware_stamps_that_are_not_there_end_at_the_bound() {
        let mut settings = ProbeSettings::loopback(TimestampMode::Hardware);
        settings.bound = Duration::from_millis(300);
        settings.proof_count = 3;
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.tx_software, Availability::Seen, "{report:?}");
        assert_eq!(report.tx_hardware, Availability::NotOffered);
        assert!(report.waited_ns >= duration_ns(settings.bound));
    }

    #[test]
    fn a_run_without_stamps_probes_nothing() {
        let settings = ProbeSettings::loopback(TimestampMode::Off);
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.attempts, 0);
        assert_eq!(report.rx_software, Availability::NotOffered);
    }

    #[test]
    fn a_claim_that_was_not_seen_in_time_is_called_that() {
        let mut settings = ProbeSettings::loopback(TimestampMode::Software);
        settings.bound = Duration::ZERO;
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.rx_software, Availability::ClaimedButNotSeen);
        assert_eq!(report.tx_software, Availability::ClaimedButNotSeen);
    }

    #[test]
    fn an_interface_without_a_target_is_an_error_not_a_probe_of_loopback() {
        let mut settings = ProbeSettings::loopback(TimestampMode::Software);
        settings.interface = Some("lo".into());
        let error = arm_and_probe(&settings).unwrap_err();
        assert!(matches!(error, ProbeError::NoTarget { .. }), "{error}");
    }
}
