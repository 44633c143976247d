//! Decides what became of each message. It concludes from records only: the absence of a record
//! means something only where records of its kind are at hand.

use super::fold::RecordsAtHand;
use super::history::MessageHistory;
use super::no_room::NoRoom;
use super::stage::{MessageFate, Side};
use super::{AccountContext, Interruption, PathProcess};
use hil_core::record::{EgressRecord, IngressRecord, stamp};
use hil_core::time::{Instant, RemoteInstant, duration_ns};

/// How a reader of a buffer stands to a message that it has not taken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Reading {
    /// It took a later one, or so many later ones came that this one was pushed out of its buffer.
    Passed,
    /// The message is in its buffer.
    Waiting,
    /// None of these is known.
    #[default]
    Unknown,
}

/// How the two readers on a message's way stand to it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Readings {
    /// The sending gateway.
    pub(super) gateway: Reading,
    /// The consumer.
    pub(super) consumer: Reading,
}

/// What a message became, and the interruption that cost it, by its place in the context.
#[derive(Debug, Clone, Copy)]
pub(super) struct Verdict {
    pub(super) fate: MessageFate,
    pub(super) interruption_index: Option<usize>,
}

/// What messages are judged by, beside their own records.
#[derive(Debug, Clone, Copy)]
pub(super) struct Evidence<'a> {
    context: &'a AccountContext<'a>,
    at_hand: RecordsAtHand,
    /// End of the run on each host's clock, where known.
    producer_end_ns: Option<i64>,
    consumer_end_ns: Option<i64>,
    flight_ns: i64,
    /// True when no record comes any more.
    is_whole: bool,
}

impl<'a> Evidence<'a> {
    /// While records still come.
    pub(super) fn new(context: &'a AccountContext<'a>, at_hand: RecordsAtHand) -> Self {
        let path = context.path;
        let [producer_end_ns, consumer_end_ns] =
            [context.producer_run, context.consumer_run].map(|run| run.map(|run| run.end.as_ns()));
        // A converted end counts from as early as it may have been.
        let to_producer = |ns: i64| {
            let (end, bound_ns) = path.to_remote(Instant::from_ns(ns))?;
            Some(end.as_ns().saturating_sub_unsigned(bound_ns))
        };
        let to_consumer = |ns: i64| {
            let (end, bound_ns) = path.localise(RemoteInstant::from_ns(ns))?;
            Some(end.as_ns().saturating_sub_unsigned(bound_ns))
        };
        Self {
            context,
            at_hand,
            producer_end_ns: producer_end_ns.or_else(|| to_producer(consumer_end_ns?)),
            consumer_end_ns: consumer_end_ns.or_else(|| to_consumer(producer_end_ns?)),
            flight_ns: duration_ns(context.flight_time_max),
            is_whole: false,
        }
    }

    /// The same when no record comes any more.
    pub(super) const fn at_end(mut self) -> Self {
        self.is_whole = true;
        self
    }

    /// True for what was seen so late in the run that it may still have been under way at its end.
    fn is_near(&self, at_ns: Option<i64>, end_ns: Option<i64>) -> bool {
        let ends = at_ns.zip(end_ns);
        ends.is_some_and(|(at_ns, end_ns)| at_ns >= end_ns.saturating_sub(self.flight_ns))
    }

    /// The fate of a message by its own records; `None` while it hangs on records that may still come.
    fn fate(
        &self,
        message: &MessageHistory,
        place: Place,
        readings: Readings,
    ) -> Option<MessageFate> {
        if message.taken.is_some() {
            return Some(MessageFate::Taken);
        }
        if !self.context.path.is_gateway() {
            return self.fate_at_consumer(
                place.producer_ns,
                self.producer_end_ns,
                readings.consumer,
            );
        }
        if let Some(ingress) = message.ingress {
            return match stamp(ingress.forwarded_ns) {
                Some(forwarded_ns) => {
                    let arrived_ns = Some(forwarded_ns);
                    self.fate_at_consumer(arrived_ns, self.consumer_end_ns, readings.consumer)
                }
                None => Some(self.fate_at_reception(message, &ingress, place)),
            };
        }
        if let Some(egress) = message.egress {
            return Some(if egress.is_refused() {
                fate_of_refusal(&egress)
            } else if !self.at_hand.ingress {
                MessageFate::UnknownPeerRecordsUnavailable
            } else if self.is_near(place.producer_ns, self.producer_end_ns) {
                MessageFate::InFlight
            } else if let Some(handed_ns) = stamp(egress.handed_ns) {
                let no_room = NoRoom::fate(self.context.no_room, handed_ns);
                no_room.unwrap_or(MessageFate::LostOnWire)
            } else {
                MessageFate::Unexplained
            });
        }
        if !self.at_hand.egress {
            return Some(MessageFate::UnknownPeerRecordsUnavailable);
        }
        let superseded = MessageFate::SupersededAtInput;
        let (at_ns, end_ns) = (place.producer_ns, self.producer_end_ns);
        self.fate_in_buffer(readings.gateway, superseded, at_ns, end_ns)
    }

    /// Of a message that was received and not forwarded.
    fn fate_at_reception(
        &self,
        message: &MessageHistory,
        ingress: &IngressRecord,
        place: Place,
    ) -> MessageFate {
        if ingress.flags & IngressRecord::INCOMPLETE != 0 {
            // Only pieces came: because the sender stopped in the middle of it, because the run ended,
            // or because the others got lost.
            if let Some(egress) = message.egress.filter(EgressRecord::is_refused) {
                fate_of_refusal(&egress)
            } else if self.is_near(place.producer_ns, self.producer_end_ns) {
                MessageFate::InFlight
            } else {
                let no_room = message
                    .handed_ns()
                    .and_then(|handed_ns| NoRoom::fate(self.context.no_room, handed_ns));
                no_room.unwrap_or(MessageFate::Incomplete)
            }
        } else if ingress.flags & IngressRecord::LATE != 0 {
            MessageFate::Late
        } else if ingress.flags & IngressRecord::DUPLICATE != 0 {
            MessageFate::Duplicate
        } else {
            MessageFate::RefusedAtIngress
        }
    }

    fn fate_at_consumer(
        &self,
        at_ns: Option<i64>,
        end_ns: Option<i64>,
        reading: Reading,
    ) -> Option<MessageFate> {
        if !self.at_hand.taken {
            return Some(MessageFate::UnknownPeerRecordsUnavailable);
        }
        let fate = self.fate_in_buffer(reading, MessageFate::SupersededAtConsumer, at_ns, end_ns);
        match fate {
            Some(MessageFate::SupersededAtConsumer | MessageFate::Unexplained)
                if self.context.has_witness =>
            {
                Some(MessageFate::UnknownPeerRecordsUnavailable)
            }
            fate => fate,
        }
    }

    /// True for what was published before the run began, by a program that did not wait for it.
    pub(super) fn is_before_run(&self, message: &MessageHistory) -> bool {
        let run = self.context.producer_run;
        let published_ns = message.published_ns();
        run.is_some_and(|run| published_ns.is_some_and(|at_ns| at_ns < run.start.as_ns()))
    }

    /// True for what a witness took while the consumer was away, or after its end.
    pub(super) fn is_for_nobody(&self, message: &MessageHistory) -> bool {
        let taken = message.taken.filter(|_| self.context.has_witness);
        let mut interruptions = self.context.interruptions.iter();
        taken.is_some_and(|taken| {
            let taken_at = Instant::from_ns(taken.taken_ns);
            let is_over = self
                .context
                .consumer_run
                .is_some_and(|run| taken_at > run.end);
            is_over
                || interruptions.any(|one| {
                    one.place == PathProcess::Consumer && (one.from..one.until).contains(&taken_at)
                })
        })
    }

    /// Of a message that was put before a reader at `at_ns` and not taken.
    fn fate_in_buffer(
        &self,
        reading: Reading,
        superseded: MessageFate,
        at_ns: Option<i64>,
        end_ns: Option<i64>,
    ) -> Option<MessageFate> {
        match reading {
            Reading::Passed => Some(superseded),
            Reading::Waiting | Reading::Unknown if !self.is_whole => None,
            // It is where it was put, however long ago: its reader took nothing any more.
            Reading::Waiting => Some(MessageFate::InFlight),
            Reading::Unknown if self.is_near(at_ns, end_ns) => Some(MessageFate::InFlight),
            Reading::Unknown => Some(MessageFate::Unexplained),
        }
    }

    /// True when the message could have been in or before the interrupted process.
    fn is_within_reach(&self, message: &MessageHistory, interruption: &Interruption) -> bool {
        if !self.context.path.is_gateway() {
            return true;
        }
        let never_left =
            self.at_hand.egress && message.egress.is_none() && message.ingress.is_none();
        let is_forwarded = message
            .ingress
            .is_some_and(|ingress| stamp(ingress.forwarded_ns).is_some());
        match interruption.place {
            PathProcess::Producer => message.egress.is_none() && message.ingress.is_none(),
            PathProcess::SendingGateway => message.arrived().is_none(),
            PathProcess::ReceivingGateway => !never_left,
            PathProcess::Consumer => is_forwarded || (!self.at_hand.ingress && !never_left),
        }
    }
}

/// Judges messages in key order.
#[derive(Debug, Default)]
pub(super) struct Judge {
    /// Where the previous message of known place was, for those without any.
    previous: Place,
}

impl Judge {
    /// The verdict on one message; `None` while it hangs on records that may still come. Where
    /// `must_judge`, a message that may still be taken is in flight.
    pub(super) fn judge(
        &mut self,
        message: &MessageHistory,
        evidence: &Evidence<'_>,
        readings: Readings,
        must_judge: bool,
    ) -> Option<Verdict> {
        let place = Place::of(message);
        let in_flight = must_judge.then_some(MessageFate::InFlight);
        let fate = evidence.fate(message, place, readings).or(in_flight)?;
        let mut interruptions = evidence.context.interruptions.iter();
        let is_cause = |one: &Interruption| {
            evidence.is_within_reach(message, one) && self.is_hit(fate, place, one, evidence)
        };
        let hit = match fate {
            MessageFate::Taken => None,
            _ => interruptions.position(is_cause),
        };
        self.previous.producer_ns = place.producer_ns.or(self.previous.producer_ns);
        self.previous.consumer_ns = place.consumer_ns.or(self.previous.consumer_ns);
        Some(Verdict {
            fate: hit.map_or(fate, |_| MessageFate::LostInInterruption),
            interruption_index: hit,
        })
    }

    /// True when the message was last seen while the process was down, or shortly before and
    /// nothing recorded says that it got lost otherwise.
    fn is_hit(
        &self,
        fate: MessageFate,
        place: Place,
        interruption: &Interruption,
        evidence: &Evidence<'_>,
    ) -> bool {
        let side = interruption.place.side();
        let (seen_ns, bound_ns, is_exact) = match self.position(place, side, evidence) {
            Position::Exact(seen_ns) => (seen_ns, 0, true),
            Position::Within(seen_ns, bound_ns) => (seen_ns, bound_ns, true),
            Position::After(seen_ns) => (seen_ns, 0, false),
            Position::Unknown => return false,
        };
        let from_ns = interruption.from.as_ns().saturating_sub_unsigned(bound_ns);
        let until_ns = interruption.until.as_ns().saturating_add_unsigned(bound_ns);
        if (from_ns..=until_ns).contains(&seen_ns) {
            return true;
        }
        let may_have_been_inside = match fate {
            MessageFate::LostOnWire
            | MessageFate::Incomplete
            | MessageFate::LostOnWireOrByHarness
            | MessageFate::Unexplained
            | MessageFate::InFlight
            | MessageFate::UnknownPeerRecordsUnavailable => true,
            MessageFate::SupersededAtInput => interruption.place == PathProcess::SendingGateway,
            MessageFate::SupersededAtConsumer => interruption.place == PathProcess::Consumer,
            // Its record says otherwise, but if it was somewhat later, its cause is the same.
            _ => !is_exact,
        };
        may_have_been_inside
            && (from_ns.saturating_sub(evidence.flight_ns)..from_ns).contains(&seen_ns)
    }

    /// When the message was last seen, on the clock of one host.
    fn position(&self, place: Place, side: Side, evidence: &Evidence<'_>) -> Position {
        let (exact_ns, previous_ns) = match side {
            Side::Producer => (place.producer_ns, self.previous.producer_ns),
            Side::Consumer => (place.consumer_ns, self.previous.consumer_ns),
        };
        let localised = || {
            let remote = RemoteInstant::from_ns(place.producer_ns?);
            let path = evidence.context.path;
            path.localise(remote).filter(|_| side == Side::Consumer)
        };
        if let Some(exact_ns) = exact_ns {
            return Position::Exact(exact_ns);
        }
        match (localised(), previous_ns) {
            (Some((seen, bound_ns)), _) => Position::Within(seen.as_ns(), bound_ns),
            (None, Some(previous_ns)) => Position::After(previous_ns),
            (None, None) => Position::Unknown,
        }
    }
}

const fn fate_of_refusal(egress: &EgressRecord) -> MessageFate {
    if egress.flags & EgressRecord::UNREACHABLE != 0 {
        MessageFate::NetworkUnreachable
    } else {
        MessageFate::RefusedByKernel
    }
}

/// What is known about when a message was last seen.
#[derive(Debug, Clone, Copy)]
enum Position {
    Exact(i64),
    /// By another host's clock, within so many nanoseconds.
    Within(i64, u64),
    /// Only that it followed a message seen then.
    After(i64),
    Unknown,
}

/// The last instants at which a message was seen on each host.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
    producer_ns: Option<i64>,
    consumer_ns: Option<i64>,
}

impl Place {
    fn of(message: &MessageHistory) -> Self {
        let published = message
            .published
            .and_then(|record| stamp(record.published_ns));
        let egress = message.egress.and_then(|record| {
            stamp(record.handed_ns)
                .or(stamp(record.taken_ns))
                .or(stamp(record.published_ns))
        });
        let sender = message
            .ingress
            .and_then(|record| stamp(record.handed_ns).or(stamp(record.published_ns)));
        let arrived = message
            .ingress
            .and_then(|record| stamp(record.forwarded_ns).or(stamp(record.received_ns)));
        let origin = message.taken.and_then(|record| stamp(record.published_ns));
        let taken = message.taken.and_then(|record| stamp(record.taken_ns));
        Self {
            producer_ns: egress.or(sender).or(published).or(origin),
            consumer_ns: taken.or(arrived),
        }
    }
}
