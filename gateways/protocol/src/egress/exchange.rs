//! Four-stamp clock exchanges in flight at the requester. It estimates nothing: it pairs requests
//! with responses and hands out the four stamps.

use crate::body::SyncResponse;
use crate::refusal::Refusal;
use crate::stamps::{ArrivalStamps, StampSource};
use crate::wire::FollowUpField;

/// Exchanges remembered; at the 100 Hz of a clock path a response may take 0.64 s.
const LENGTH: usize = 64;
/// Stamps of different kinds on one host are converted with an error; beyond this a response that
/// was held longer than the whole exchange took is nonsense.
const HOLD_SLACK_NS: i64 = 1_000_000;

/// The four stamps of one clock exchange (IEEE 1588 and RFC 5905 number them alike).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoundTrip {
    /// Number of the request.
    pub sequence: u64,
    /// Request left, requester's monotonic clock.
    pub t1_ns: i64,
    /// Request arrived, responder's monotonic clock.
    pub t2_ns: i64,
    /// Response left, responder's monotonic clock.
    pub t3_ns: i64,
    /// Response arrived, requester's monotonic clock.
    pub t4_ns: i64,
    /// Kind of t1.
    pub t1_source: StampSource,
    /// Kind of t2.
    pub t2_source: StampSource,
    /// Kind of t3.
    pub t3_source: StampSource,
    /// Kind of t4.
    pub t4_source: StampSource,
}

#[derive(Debug, Clone, Copy)]
struct Exchange {
    sequence: u64,
    handed_ns: i64,
    handed_to_tx_ns: Option<i64>,
    /// With t1 as handed; refined when given out.
    answer: Option<RoundTrip>,
}

#[derive(Debug)]
pub(super) struct Exchanges {
    slots: [Option<Exchange>; LENGTH],
}

impl Exchanges {
    pub(super) const fn new() -> Self {
        Self {
            slots: [None; LENGTH],
        }
    }

    pub(super) fn open(&mut self, sequence: u64, handed_ns: i64) {
        self.slots[slot_of(sequence)] = Some(Exchange {
            sequence,
            handed_ns,
            handed_to_tx_ns: None,
            answer: None,
        });
    }

    pub(super) fn set_transmit_stamp(&mut self, sequence: u64, handed_to_tx_ns: i64) {
        if let Some(exchange) = self.find(sequence) {
            exchange.handed_to_tx_ns = Some(handed_to_tx_ns);
        }
    }

    pub(super) fn close(
        &mut self,
        sequence: u64,
        response: &SyncResponse,
        arrival: ArrivalStamps,
    ) -> Result<RoundTrip, Refusal> {
        let exchange = self.find(sequence).ok_or(Refusal::Unsolicited)?;
        if exchange.answer.is_some() {
            return Err(Refusal::Unsolicited);
        }
        let whole = arrival.received_ns.saturating_sub(exchange.handed_ns);
        let held = response.t3_ns.saturating_sub(response.t2_ns);
        let is_plausible = response.t1_ns == exchange.handed_ns
            && response.t2_ns >= 0
            && whole >= 0
            && (-HOLD_SLACK_NS..=whole.saturating_add(HOLD_SLACK_NS)).contains(&held);
        if !is_plausible {
            return Err(Refusal::ImplausibleStamp);
        }
        exchange.answer = Some(RoundTrip {
            sequence,
            t1_ns: exchange.handed_ns,
            t2_ns: response.t2_ns,
            t3_ns: response.t3_ns,
            t4_ns: arrival.received_ns,
            t1_source: StampSource::Application,
            t2_source: response.t2_source,
            t3_source: StampSource::Application,
            t4_source: arrival.received_source,
        });
        exchange.refined().ok_or(Refusal::Unsolicited)
    }

    /// The earlier exchange that `field`, found on the response to `carried_by`, completes; each
    /// is given once.
    pub(super) fn refine(&mut self, carried_by: u64, field: FollowUpField) -> Option<RoundTrip> {
        let exchange = self.find(field.sequence(carried_by)?)?;
        let answer = exchange.answer.as_mut()?;
        if answer.t3_source != StampSource::Application {
            return None;
        }
        answer.t3_ns = answer.t3_ns.saturating_add(field.handed_to_tx_ns.into());
        answer.t3_source = StampSource::KernelSoftware;
        exchange.refined()
    }

    fn find(&mut self, sequence: u64) -> Option<&mut Exchange> {
        let slot = self.slots[slot_of(sequence)].as_mut();
        slot.filter(|exchange| exchange.sequence == sequence)
    }
}

impl Exchange {
    fn refined(&self) -> Option<RoundTrip> {
        let mut round_trip = self.answer?;
        if let Some(delta) = self.handed_to_tx_ns {
            round_trip.t1_ns = round_trip.t1_ns.saturating_add(delta);
            round_trip.t1_source = StampSource::KernelSoftware;
        }
        Some(round_trip)
    }
}

fn slot_of(sequence: u64) -> usize {
    usize::try_from(sequence % LENGTH as u64).expect("a slot is below 64")
}
