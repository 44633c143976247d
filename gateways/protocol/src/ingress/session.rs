//! Which sending gateway may talk: the session that greeted, where from, and what its clock can
//! plausibly say. It does not count messages.

use core::net::SocketAddr;
use core::time::Duration;

use hil_core::time::{Instant, duration_ns};

use crate::refusal::Refusal;
use crate::stamps::ArrivalStamps;
use crate::wire::Header;

const RETIRED_LENGTH: usize = 8;
/// A session heard within this time is not replaced by a greeting from another host.
pub(super) const TAKEOVER_SILENCE: Duration = Duration::from_secs(2);
/// A message may wait this long between its producer and its gateway.
pub(super) const PUBLISHED_AGE_MAX: Duration = Duration::from_hours(1);
/// A sender's stamps may drift this far from where the last greeting or exchange put its clock,
/// network delay included.
pub(super) const STAMP_DRIFT_MAX: Duration = Duration::from_mins(1);

#[derive(Debug, Clone, Copy)]
pub(super) struct Session {
    pub(super) id: u32,
    pub(super) last_heard: Instant,
    pub(super) has_left: bool,
    /// Latest hand-over accepted, by the sender's clock.
    handed_ns_max: i64,
    peer: Option<SocketAddr>,
    /// The sender's clock minus this host's at the last greeting or exchange, delay included.
    offset_ns: i64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Greeting {
    /// The session was not known.
    pub(super) is_new: bool,
    /// It replaced another.
    pub(super) is_restart: bool,
}

#[derive(Debug)]
pub(super) struct Sessions {
    current: Option<Session>,
    /// Sessions that are over, and their latest hand-over.
    retired: [Option<(u32, i64)>; RETIRED_LENGTH],
    retired_next: usize,
}

impl Sessions {
    pub(super) const fn new() -> Self {
        Self {
            current: None,
            retired: [None; RETIRED_LENGTH],
            retired_next: 0,
        }
    }

    pub(super) const fn current(&self) -> Option<&Session> {
        self.current.as_ref()
    }

    /// Opens or confirms the session of an acceptable greeting.
    pub(super) fn greet(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        header: &Header,
    ) -> Result<Greeting, Refusal> {
        if self.is_over(header) {
            return Err(Refusal::Stale);
        }
        if self
            .current
            .is_some_and(|current| current.holds_off(now, arrival))
        {
            return Err(Refusal::ForeignSource);
        }
        let replaced = self.current.filter(|current| current.id != header.session);
        let confirmed = self.current.filter(|current| current.id == header.session);
        if let Some(session) = replaced {
            self.retire(session);
        }
        self.current = Some(Session {
            id: header.session,
            last_heard: now,
            has_left: false,
            handed_ns_max: confirmed.map_or(header.handed_ns, |current| {
                current.handed_ns_max.max(header.handed_ns)
            }),
            peer: arrival.peer,
            offset_ns: offset_ns(arrival, header),
        });
        Ok(Greeting {
            is_new: confirmed.is_none(),
            is_restart: replaced.is_some(),
        })
    }

    /// Whether a datagram of the session may be looked at.
    pub(super) fn check(&self, arrival: ArrivalStamps, header: &Header) -> Result<(), Refusal> {
        let Some(current) = &self.current else {
            return Err(Refusal::UnknownSession);
        };
        if current.id != header.session {
            return Err(if self.is_over(header) {
                Refusal::Stale
            } else {
                Refusal::UnknownSession
            });
        }
        match (current.peer, arrival.peer) {
            (Some(bound), Some(from)) if bound != from => Err(Refusal::ForeignSource),
            _ => Ok(()),
        }
    }

    /// Whether a message's stamps agree with each other and with the sender's clock.
    pub(super) fn check_stamps(
        &self,
        arrival: ArrivalStamps,
        header: &Header,
    ) -> Result<(), Refusal> {
        let current = self.current.as_ref().ok_or(Refusal::UnknownSession)?;
        let waited = header.handed_ns.saturating_sub(header.published_ns);
        let is_published_plausible = header.published_ns == i64::MIN
            || (header.published_ns >= 0 && (0..=duration_ns(PUBLISHED_AGE_MAX)).contains(&waited));
        let drift = offset_ns(arrival, header).saturating_sub(current.offset_ns);
        let is_handed_plausible = header.handed_ns >= 0
            && drift.unsigned_abs() <= duration_ns(STAMP_DRIFT_MAX).unsigned_abs();
        if is_published_plausible && is_handed_plausible {
            Ok(())
        } else {
            Err(Refusal::ImplausibleStamp)
        }
    }

    /// Notes where the sender's clock stands; a host that was suspended recovers here.
    pub(super) fn anchor(&mut self, arrival: ArrivalStamps, header: &Header) {
        if let Some(current) = &mut self.current
            && header.handed_ns >= 0
        {
            current.offset_ns = offset_ns(arrival, header);
        }
    }

    pub(super) fn heard(&mut self, now: Instant, handed_ns: i64, has_left: bool) {
        if let Some(current) = &mut self.current {
            current.last_heard = now;
            // A message that the farewell overtook does not mean that the sender is back.
            current.has_left = has_left || (current.has_left && handed_ns <= current.handed_ns_max);
            current.handed_ns_max = current.handed_ns_max.max(handed_ns);
        }
    }

    /// True for a datagram sent before its session was replaced. One sent afterwards shows that
    /// the session lives, and that replacing it was a mistake.
    fn is_over(&self, header: &Header) -> bool {
        let mut retired = self.retired.iter().flatten();
        retired.any(|&(id, handed_ns)| id == header.session && header.handed_ns <= handed_ns)
    }

    fn retire(&mut self, session: Session) {
        let known = |entry: &Option<(u32, i64)>| entry.is_some_and(|(id, _)| id == session.id);
        let index = self.retired.iter().position(known).unwrap_or_else(|| {
            let next = self.retired_next;
            self.retired_next = (next + 1) % RETIRED_LENGTH;
            next
        });
        self.retired[index] = Some((session.id, session.handed_ns_max));
    }
}

impl Session {
    /// True while a live session of another host keeps a greeting out. Another port of the same
    /// host is the same gateway started again.
    fn holds_off(&self, now: Instant, arrival: ArrivalStamps) -> bool {
        let (Some(bound), Some(from)) = (self.peer, arrival.peer) else {
            return false;
        };
        bound.ip() != from.ip() && !self.has_left && now < self.last_heard + TAKEOVER_SILENCE
    }
}

fn offset_ns(arrival: ArrivalStamps, header: &Header) -> i64 {
    header.handed_ns.saturating_sub(arrival.received_ns)
}
