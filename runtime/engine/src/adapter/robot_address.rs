//! Which address a sensor adapter takes for its robot's. A robot that starts anew may send from another
//! port, so an address that fell silent gives way to another one that speaks the protocol; but whoever was
//! displaced so and speaks again has its place back at once, as it came before. It sends nothing.

use core::time::Duration;
use std::net::{IpAddr, SocketAddr};

use hil_core::time::Instant;

/// An address that was silent for so long is taken to be gone.
const GONE_AFTER: Duration = Duration::from_secs(1);
/// Addresses that are remembered; with more the first stays, and the oldest of the others is forgotten.
const HELD_MAX: usize = 8;

/// Who is the robot.
#[derive(Debug)]
pub(super) struct RobotAddress {
    /// The only address that may be, as the topology says.
    told: Option<IpAddr>,
    /// Addresses that were the robot's, in the order in which they came; the last is.
    held: Vec<SocketAddr>,
    pub(super) change_count: u64,
    /// Datagrams of others.
    pub(super) foreign_count: u64,
}

/// Another address is the robot's now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Change {
    /// The one before, if there was one.
    pub(super) former: Option<SocketAddr>,
}

impl RobotAddress {
    /// `told` is the robot's address as the topology has it.
    pub(super) fn new(told: Option<IpAddr>) -> Self {
        Self {
            told,
            held: Vec::with_capacity(HELD_MAX),
            change_count: 0,
            foreign_count: 0,
        }
    }

    /// The robot's address; `None` while none came.
    pub(super) fn held(&self) -> Option<SocketAddr> {
        self.held.last().copied()
    }

    /// Whether a datagram of `source` may be the robot's, which was last `heard`; counts it if not.
    pub(super) fn may_speak(
        &mut self,
        source: SocketAddr,
        heard: Option<Instant>,
        now: Instant,
    ) -> bool {
        let is_told = self.told.is_none_or(|told| told == source.ip());
        let is_gone = || heard.is_none_or(|at| now.saturating_duration_since(at) > GONE_AFTER);
        let may = is_told && (self.held.is_empty() || self.held.contains(&source) || is_gone());
        self.foreign_count += u64::from(!may);
        may
    }

    /// The robot speaks from `source`, which may; gives what is new about that.
    pub(super) fn hold(&mut self, source: SocketAddr) -> Option<Change> {
        let former = self.held();
        if former == Some(source) {
            return None;
        }
        if let Some(place) = self.held.iter().position(|one| *one == source) {
            // Those that came after it took its place while it was silent.
            self.held.truncate(place + 1);
        } else {
            if self.held.len() == HELD_MAX {
                self.held.remove(1);
            }
            self.held.push(source);
        }
        self.change_count += u64::from(former.is_some());
        Some(Change { former })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    #[test]
    fn a_stranger_in_a_pause_of_the_robot_loses_its_place_when_the_robot_returns() {
        let [robot, stranger]: [SocketAddr; 2] =
            ["10.0.0.2:6510", "10.0.0.9:6510"].map(|text| text.parse().unwrap());
        let mut address = RobotAddress::new(None);
        assert!(address.may_speak(robot, None, at(0)));
        assert_eq!(address.hold(robot), Some(Change { former: None }));
        assert!(!address.may_speak(stranger, Some(at(0)), at(900)));
        assert!(address.may_speak(stranger, Some(at(0)), at(1_100)));
        let former = Some(robot);
        assert_eq!(address.hold(stranger), Some(Change { former }));
        // Though the stranger spoke just now.
        assert!(address.may_speak(robot, Some(at(1_100)), at(1_101)));
        let former = Some(stranger);
        assert_eq!(address.hold(robot), Some(Change { former }));
        assert!(!address.may_speak(stranger, Some(at(1_101)), at(1_102)));
        assert_eq!((address.change_count, address.foreign_count), (2, 2));
    }

    #[test]
    fn with_the_address_of_the_topology_no_other_ever_speaks_and_its_port_may_change() {
        let told: IpAddr = "10.0.0.2".parse().unwrap();
        let mut address = RobotAddress::new(Some(told));
        assert!(!address.may_speak(SocketAddr::from(([10, 0, 0, 9], 6510)), None, at(0)));
        let first = SocketAddr::new(told, 6510);
        assert!(address.may_speak(first, None, at(0)));
        address.hold(first);
        for port in 7_000..7_020 {
            let next = SocketAddr::new(told, port);
            assert!(!address.may_speak(next, Some(at(0)), at(1)));
            assert!(address.may_speak(next, Some(at(0)), at(2_000)));
            assert!(address.hold(next).is_some());
        }
        assert_eq!(address.held.len(), HELD_MAX);
        assert!(address.may_speak(first, Some(at(2_000)), at(2_001)));
    }
}
