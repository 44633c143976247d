//! Which stamps and reports a hop's sockets ask for, and which of them a message may wait for: what
//! the topology wants, less what the probe found never to come. It probes nothing itself.

use hil_gateways::transport::probe::{Availability, ProbeReport};
use hil_gateways::transport::timestamping::TimestampMode;

/// What sockets ask for and records wait for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StampPlan {
    /// What to ask of the kernel.
    pub mode: TimestampMode,
    /// The driver stamps departures, or may: a record waits for that stamp. Otherwise the stamp
    /// before the queue is the last word.
    pub is_departure_stamped: bool,
    /// The stack stamps before the queue: a record waits for that stamp where it is the last word.
    pub is_queueing_stamped: bool,
    /// The hop is wireless: ask the radio which datagrams were acknowledged.
    pub asks_radio: bool,
}

impl StampPlan {
    /// As the topology asks, nothing known of the interface.
    pub const fn asked(mode: TimestampMode) -> Self {
        Self {
            mode,
            is_departure_stamped: true,
            is_queueing_stamped: false,
            asks_radio: false,
        }
    }

    /// The plan after sending found `first` in mode `asked`, and `second` with stamps before the
    /// queue asked for as well, where the first was not what it should be.
    pub fn found(asked: TimestampMode, first: &ProbeReport, second: Option<&ProbeReport>) -> Self {
        let plan = Self::asked(asked);
        if asked != TimestampMode::Software || first.tx_software == Availability::Seen {
            return plan;
        }
        let seen = |pick: fn(&ProbeReport) -> Availability| second.map(pick);
        let is_queueing_stamped = seen(|r| r.tx_scheduled) == Some(Availability::Seen);
        // A datagram that was stamped before the queue went to the driver: if then no departure
        // was stamped, and the driver never said it would, none will be. A driver that says so
        // may be late, so its records wait as long as a stamp can take.
        let never = is_queueing_stamped
            && seen(|r| r.tx_software) == Some(Availability::NotOffered)
            && first.tx_software == Availability::NotOffered;
        Self {
            mode: TimestampMode::Scheduled,
            is_departure_stamped: !never,
            is_queueing_stamped,
            asks_radio: false,
        }
    }

    /// The same for a wireless hop, or not.
    #[must_use]
    pub const fn on_radio(mut self, is_wireless: bool) -> Self {
        self.asks_radio = is_wireless;
        self
    }

    pub(super) const fn awaits_software(self) -> bool {
        !matches!(self.mode, TimestampMode::Off)
            && (self.is_departure_stamped || self.is_queueing_stamped)
    }

    pub(super) const fn awaits_hardware(self) -> bool {
        matches!(self.mode, TimestampMode::Hardware)
    }

    pub(super) const fn is_anything_awaited(self) -> bool {
        self.awaits_software() || self.awaits_hardware() || self.asks_radio
    }

    /// True where no stamp later than the one before the queue is to come.
    pub(super) const fn is_before_queue_final(self) -> bool {
        !self.is_departure_stamped
    }

    /// What a reader must know of the transmit stamps; `None` where they are departures.
    pub fn fallback(self) -> Option<&'static str> {
        match (self.mode, self.is_departure_stamped) {
            (TimestampMode::Scheduled, false) => Some(
                "TX stamp before the queue: this driver stamps no departures, so what a datagram \
                 waits in the queue and the driver counts as wire",
            ),
            (TimestampMode::Scheduled, true) if self.is_queueing_stamped => Some(
                "TX stamp of the departure where it comes within 20 ms, else before the queue: \
                 the driver claims departures, the probe saw none",
            ),
            (TimestampMode::Scheduled, true) => Some(
                "TX stamp where one comes within 20 ms: the probe saw none, perhaps because the \
                 peer was not there yet",
            ),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(software: Availability, scheduled: Availability) -> ProbeReport {
        ProbeReport {
            rx_software: Availability::Seen,
            tx_software: software,
            tx_scheduled: scheduled,
            tx_hardware: Availability::NotOffered,
            capabilities: None,
            attempts: 5,
            transmit_attempts: 5,
            newest_refusal: None,
            waited_ns: 0,
            is_caller_realtime: Some(false),
        }
    }

    #[test]
    fn a_radio_without_departures_waits_for_the_stamp_before_the_queue_only() {
        use Availability::{NotOffered, Seen};
        let software = TimestampMode::Software;
        let first = report(NotOffered, NotOffered);
        let second = report(NotOffered, Seen);
        let plan = StampPlan::found(software, &first, Some(&second));
        assert_eq!(plan.mode, TimestampMode::Scheduled);
        assert!(plan.awaits_software() && plan.is_before_queue_final());
        assert!(plan.fallback().unwrap().contains("before the queue"));
    }

    #[test]
    fn a_driver_that_stamps_departures_is_left_alone() {
        use Availability::{NotOffered, Seen};
        let software = TimestampMode::Software;
        let first = report(Seen, NotOffered);
        let plan = StampPlan::found(software, &first, None);
        assert_eq!(plan, StampPlan::asked(software));
        assert_eq!(plan.fallback(), None);
        let off = StampPlan::asked(TimestampMode::Off);
        assert!(!off.is_anything_awaited());
        assert!(off.on_radio(true).is_anything_awaited());
    }

    #[test]
    fn a_claim_or_an_absent_peer_keeps_records_waiting_for_departures() {
        use Availability::{ClaimedButNotSeen, NotOffered, Seen};
        let software = TimestampMode::Software;
        let first = report(ClaimedButNotSeen, NotOffered);
        for scheduled in [Seen, NotOffered] {
            let second = report(ClaimedButNotSeen, scheduled);
            let plan = StampPlan::found(software, &first, Some(&second));
            assert!(plan.awaits_software() && !plan.is_before_queue_final());
            assert!(plan.fallback().is_some());
        }
        // Nothing went out at all, so nothing is known of the driver.
        let silent = report(NotOffered, NotOffered);
        let plan = StampPlan::found(software, &silent, Some(&silent));
        assert!(plan.is_departure_stamped && !plan.is_queueing_stamped);
    }
}
