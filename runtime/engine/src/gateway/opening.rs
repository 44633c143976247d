//! The sockets of a gateway, opened when there is a way for them. A gateway that starts with the run says at
//! once what is wrong with its path; one that comes back while the run goes on waits for a path that is away,
//! as one that never left would. It moves no datagram.

use std::io;
use std::thread;
use std::time::Duration;

use hil_core::time::Instant;
use hil_protocol::SettingsError;
use hil_transport::socket::SocketError;

use super::arming::{self, Arming};
use super::direction::egress_bridge;
use super::socket::{Ends, OpenSocket};
use super::stamp_plan::StampPlan;
use super::{GatewayError, Surroundings};
use hil_platform::clock::MonotonicClock;
use hil_rundir::launch::{DirectionLaunch, GatewayLaunch};
use hil_rundir::pipe::{FromProcess, Orders, say};
use hil_rundir::run_seal::RunSeal;

/// How often a path that is away is looked for.
const RETRY_PERIOD: Duration = Duration::from_millis(50);

/// Every direction's socket, and what is known of the stamps of their interface.
pub(super) struct OpenSockets {
    pub(super) armed: Arming,
    /// In the order of the launch's directions.
    pub(super) sockets: Vec<(OpenSocket, StampPlan)>,
}

/// Opens the sockets of `launch`; call it from a thread of normal priority. `None` when told to stop before
/// there was a path.
///
/// # Errors
/// When a socket cannot be opened, and at the start of a run also when there is no path.
pub(super) fn open_sockets(
    launch: &GatewayLaunch,
    orders: &Orders,
    seal: Option<&RunSeal>,
    around: &Surroundings,
) -> Result<Option<OpenSockets>, GatewayError> {
    let mut away = Away::default();
    loop {
        match try_open(launch, orders, seal, around) {
            Ok(mut opened) => {
                opened.armed.facts.extend(away.fact());
                return Ok(Some(opened));
            }
            Err(error) if launch.instance > 0 && is_away(&error) => away.note(&error),
            Err(error) => return Err(error),
        }
        if orders.is_stopping() {
            return Ok(None);
        }
        thread::sleep(RETRY_PERIOD);
    }
}

fn try_open(
    launch: &GatewayLaunch,
    orders: &Orders,
    seal: Option<&RunSeal>,
    around: &Surroundings,
) -> Result<OpenSockets, GatewayError> {
    let armed = arming::arm(launch);
    let open = |direction: &DirectionLaunch| {
        let plan = armed.plan(direction);
        let socket = OpenSocket::open(direction, &orders.run_start(), plan, seal)?;
        if let Ends::Sender(_, longest) = &socket.ends {
            // A path may be too narrow for the gateways' own exchanges; the thread would only end.
            egress_bridge(*longest, direction, around)?;
        }
        Ok((socket, plan))
    };
    let sockets = launch.directions.iter().map(open);
    let sockets = sockets.collect::<Result<_, GatewayError>>()?;
    Ok(OpenSockets { armed, sockets })
}

/// Whether `error` is the path's, which may come back: no route, no interface that is up, no address, or a
/// path too narrow for now.
fn is_away(error: &GatewayError) -> bool {
    match error {
        GatewayError::Open(SocketError::Refused { source, .. }) => matches!(
            source.kind(),
            io::ErrorKind::NetworkUnreachable
                | io::ErrorKind::HostUnreachable
                | io::ErrorKind::NetworkDown
                | io::ErrorKind::AddrNotAvailable
        ),
        GatewayError::Settings(error) => matches!(
            error,
            SettingsError::DatagramTooSmall { .. } | SettingsError::TooManyFragments { .. }
        ),
        _ => false,
    }
}

/// A path that is not there.
#[derive(Debug, Default)]
struct Away {
    attempt_count: u64,
    since: Option<Instant>,
}

impl Away {
    /// Counts an attempt in vain; the first is told at once.
    fn note(&mut self, error: &GatewayError) {
        self.attempt_count += 1;
        if self.since.is_none() {
            self.since = Some(MonotonicClock::now());
            let text = format!("{error}: waiting for the link");
            say(&FromProcess::Warning(text));
        }
    }

    /// How long it was away, for the report.
    fn fact(&self) -> Option<(String, String)> {
        let waited = MonotonicClock::now().saturating_duration_since(self.since?);
        let (seconds, count) = (waited.as_secs_f64(), self.attempt_count);
        let text = format!("{seconds:.3} s before this start, {count} attempts in vain");
        Some(("waited for the link".to_owned(), text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_that_is_away_is_waited_for_and_a_wrong_setting_is_not() {
        let refused = |errno: i32| {
            GatewayError::Open(SocketError::Refused {
                option: "connect",
                value: String::new(),
                source: io::Error::from_raw_os_error(errno),
            })
        };
        let away = [
            libc::ENETUNREACH,
            libc::EHOSTUNREACH,
            libc::ENETDOWN,
            libc::EADDRNOTAVAIL,
        ];
        assert!(away.into_iter().all(|errno| is_away(&refused(errno))));
        let wrong = [libc::ENODEV, libc::EADDRINUSE, libc::EPERM, libc::EINVAL];
        assert!(!wrong.into_iter().any(|errno| is_away(&refused(errno))));
        let narrow = SettingsError::DatagramTooSmall {
            value: 72,
            bound: 132,
        };
        assert!(is_away(&narrow.into()));
        assert!(!is_away(&SettingsError::Zero { key: "sync_period" }.into()));
    }

    #[test]
    fn how_long_a_path_was_away_is_told_and_one_that_was_there_is_not() {
        let mut away = Away::default();
        assert_eq!(away.fact(), None);
        away.note(&GatewayError::SecretMissing);
        away.note(&GatewayError::SecretMissing);
        let (label, text) = away.fact().unwrap();
        assert_eq!(label, "waited for the link");
        assert!(text.ends_with("2 attempts in vain"), "{text}");
    }
}
