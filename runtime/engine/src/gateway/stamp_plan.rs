//! Which stamps and reports a hop's sockets ask for, and which of them a message may wait for: what
//! the topology wants, less what the probe found never to come. It probes nothing itself.

use hil_net::timestamping::TimestampMode;
use hil_transport::probe::{Availability, ProbeReport};

/// Whether a card's stamps of what is sent are to come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NicStamps {
    /// Nobody asked for them.
    NotAsked,
    /// They come, or nothing is known yet.
    Expected,
    /// The driver claims them; none came, but nothing proves that a datagram left either.
    Unproved,
    /// They were asked for and do not come.
    Missing,
}

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
    /// What the card is known to do.
    pub card: NicStamps,
}

impl StampPlan {
    /// As the topology asks, nothing known of the interface.
    pub const fn asked(mode: TimestampMode) -> Self {
        Self {
            mode,
            is_departure_stamped: true,
            is_queueing_stamped: false,
            asks_radio: false,
            card: match mode {
                TimestampMode::Hardware => NicStamps::Expected,
                _ => NicStamps::NotAsked,
            },
        }
    }

    /// The plan after sending found `first` in mode `asked`, and `second` with stamps before the
    /// queue asked for as well, where the first was not what it should be.
    pub fn found(asked: TimestampMode, first: &ProbeReport, second: Option<&ProbeReport>) -> Self {
        match asked {
            TimestampMode::Off | TimestampMode::Scheduled => Self::asked(asked),
            TimestampMode::Software => Self::without_nic(first, second),
            TimestampMode::Hardware => Self::with_nic(first, second),
        }
    }

    /// True where a second probe has to find out what the first left open.
    pub(super) fn needs_second_probe(asked: TimestampMode, first: &ProbeReport) -> bool {
        let is_nic_silent = first.tx_hardware != Availability::Seen;
        let is_missed = first.tx_software != Availability::Seen;
        match asked {
            TimestampMode::Off | TimestampMode::Scheduled => false,
            TimestampMode::Software => is_missed,
            TimestampMode::Hardware => is_missed && is_nic_silent,
        }
    }

    fn with_nic(first: &ProbeReport, second: Option<&ProbeReport>) -> Self {
        let asked = Self::asked(TimestampMode::Hardware);
        match nic_stamps(first, second) {
            NicStamps::Missing => Self {
                card: NicStamps::Missing,
                ..Self::without_nic(first, second)
            },
            NicStamps::Unproved => Self {
                card: NicStamps::Unproved,
                ..asked
            },
            // The card's stamps prove that the datagrams left: a driver that does not claim to
            // stamp departures itself and did not will not.
            NicStamps::NotAsked | NicStamps::Expected => Self {
                is_departure_stamped: first.tx_software != Availability::NotOffered,
                ..asked
            },
        }
    }

    fn without_nic(first: &ProbeReport, second: Option<&ProbeReport>) -> Self {
        let plan = Self::asked(TimestampMode::Software);
        if first.tx_software == Availability::Seen {
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
            ..plan
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

    /// What a reader must know of the transmit stamps; `None` where they are what was asked for.
    pub fn fallback(self) -> Option<String> {
        let kernel = self.kernel_fallback();
        match self.card {
            NicStamps::NotAsked | NicStamps::Expected => kernel.map(str::to_owned),
            NicStamps::Unproved => Some(
                "hardware stamps: claimed by the driver, none seen, and nothing shows that a probe \
                 left, perhaps because the peer was not there yet: each record waits for its \
                 stamps for up to 200 ms"
                    .to_owned(),
            ),
            NicStamps::Missing => {
                let instead = kernel.unwrap_or("TX stamp of the departure by the kernel instead");
                Some(format!(
                    "hardware stamps were asked for and do not come, so no record waits for them; \
                     {instead}"
                ))
            }
        }
    }

    fn kernel_fallback(self) -> Option<&'static str> {
        match (self.mode, self.is_departure_stamped) {
            (TimestampMode::Hardware, false) => Some(
                "TX stamp of the card only: this driver stamps no departures in software, so no \
                 record waits for that",
            ),
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

/// What two probes say of the card. A driver that claims its stamps and gave none within the whole
/// bound of the probe, though datagrams left, gives none: often its card is not armed.
fn nic_stamps(first: &ProbeReport, second: Option<&ProbeReport>) -> NicStamps {
    let is_departure_seen = |report: &ProbeReport| report.tx_software == Availability::Seen;
    // Where only the second probe saw departures, the first came before the peer did.
    let passed_second = |second: &ProbeReport| {
        second.tx_scheduled == Availability::Seen && !is_departure_seen(second)
    };
    match first.tx_hardware {
        Availability::Seen => NicStamps::Expected,
        Availability::NotOffered => NicStamps::Missing,
        Availability::ClaimedButNotSeen => {
            if is_departure_seen(first) || second.is_some_and(passed_second) {
                NicStamps::Missing
            } else {
                NicStamps::Unproved
            }
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
            newest_refusal: None,
            waited_ns: 0,
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

    fn with_hardware(hardware: Availability, software: Availability) -> ProbeReport {
        ProbeReport {
            tx_hardware: hardware,
            ..report(software, Availability::NotOffered)
        }
    }

    #[test]
    fn a_nic_that_stamps_is_recorded_beside_the_kernel() {
        use Availability::{NotOffered, Seen};
        let hardware = TimestampMode::Hardware;
        let first = with_hardware(Seen, Seen);
        assert!(!StampPlan::needs_second_probe(hardware, &first));
        let plan = StampPlan::found(hardware, &first, None);
        assert_eq!(plan, StampPlan::asked(hardware));
        assert!(plan.awaits_software() && plan.awaits_hardware());
        assert_eq!(plan.fallback(), None);
        // A driver without stamps of its own keeps nobody waiting for them.
        let first = with_hardware(Seen, NotOffered);
        assert!(!StampPlan::needs_second_probe(hardware, &first));
        let plan = StampPlan::found(hardware, &first, None);
        assert!(!plan.awaits_software() && plan.awaits_hardware());
        assert!(plan.fallback().unwrap().contains("of the card only"));
    }

    #[test]
    fn a_nic_that_offers_no_stamps_is_planned_for_as_in_software() {
        use Availability::{NotOffered, Seen};
        let hardware = TimestampMode::Hardware;
        let wired = with_hardware(NotOffered, Seen);
        assert!(!StampPlan::needs_second_probe(hardware, &wired));
        let plan = StampPlan::found(hardware, &wired, None);
        assert_eq!(plan.mode, TimestampMode::Software);
        assert!(plan.awaits_software() && !plan.awaits_hardware());
        let text = plan.fallback().unwrap();
        assert!(text.starts_with("hardware stamps were asked for and do not come"));
        assert!(text.contains("of the departure by the kernel"), "{text}");

        let radio = with_hardware(NotOffered, NotOffered);
        assert!(StampPlan::needs_second_probe(hardware, &radio));
        let second = report(NotOffered, Seen);
        let plan = StampPlan::found(hardware, &radio, Some(&second));
        assert_eq!(plan.mode, TimestampMode::Scheduled);
        assert!(plan.awaits_software() && plan.is_before_queue_final());
        assert!(!plan.awaits_hardware());
        let text = plan.fallback().unwrap();
        assert!(text.starts_with("hardware stamps were asked for and do not come"));
        assert!(text.contains("before the queue"), "{text}");
    }

    #[test]
    fn a_claim_of_the_nic_counts_only_while_nothing_is_known_to_have_left() {
        use Availability::{ClaimedButNotSeen, NotOffered, Seen};
        let hardware = TimestampMode::Hardware;
        let found = |software, second: Option<&ProbeReport>| {
            let first = with_hardware(ClaimedButNotSeen, software);
            StampPlan::found(hardware, &first, second)
        };
        // The kernel saw departures, the card stamped none.
        let plan = found(Seen, None);
        assert_eq!(
            (plan.mode, plan.card),
            (TimestampMode::Software, NicStamps::Missing)
        );
        // Datagrams passed the queue, and nobody stamped a departure.
        let plan = found(NotOffered, Some(&report(NotOffered, Seen)));
        assert_eq!(
            (plan.mode, plan.card),
            (TimestampMode::Scheduled, NicStamps::Missing)
        );
        assert!(!plan.awaits_hardware());
        // No peer at all, or only when the second probe began: the card may be good.
        let late = report(Seen, Seen);
        for second in [
            None,
            Some(&report(ClaimedButNotSeen, NotOffered)),
            Some(&late),
        ] {
            let plan = found(ClaimedButNotSeen, second);
            assert_eq!((plan.mode, plan.card), (hardware, NicStamps::Unproved));
            assert!(plan.awaits_hardware() && plan.awaits_software());
            assert!(plan.fallback().unwrap().contains("none seen"));
        }
    }
}
