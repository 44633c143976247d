//! Decides what became of each message. It concludes from records only: the absence of a record
//! means something only in a file that is at hand.

use super::join::{Join, Joined, Key};
use super::metrics::{Gap, InterruptionMetrics};
use super::stage::{MessageFate, Side};
use super::{AccountContext, ChannelPath, ChannelRecords, Interruption, PathProcess, RunSpan};
use hil_core::record::{EgressRecord, IngressRecord, stamp};
use hil_core::time::{Instant, RemoteInstant, duration_ns};

/// Judges messages in key order.
#[derive(Debug)]
pub(super) struct Judge<'a> {
    files: ChannelRecords<'a>,
    is_gateway: bool,
    path: ChannelPath<'a>,
    last_egress: Option<Key>,
    last_taken: Option<Key>,
    producer_end_ns: Option<i64>,
    consumer_end_ns: Option<i64>,
    flight_ns: i64,
    interruptions: &'a [Interruption],
    lost_counts: Vec<u64>,
    /// The interruption that cost the message judged last, by its place in the context.
    pub(super) last_hit: Option<usize>,
    /// Where the previous message of known place was, for those without any.
    previous_producer_ns: Option<i64>,
    previous_consumer_ns: Option<i64>,
}

impl<'a> Judge<'a> {
    pub(super) fn new(
        records: &ChannelRecords<'a>,
        context: &AccountContext<'a>,
        join: &Join<'_>,
    ) -> Self {
        let path = context.path;
        let end = |run: Option<RunSpan>| run.map(|run| run.end.as_ns());
        let (producer_end, consumer_end) = (end(context.producer_run), end(context.consumer_run));
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
            files: *records,
            is_gateway: context.path.is_gateway(),
            path,
            last_egress: join.last_egress,
            last_taken: join.last_taken,
            producer_end_ns: producer_end.or_else(|| to_producer(consumer_end?)),
            consumer_end_ns: consumer_end.or_else(|| to_consumer(producer_end?)),
            flight_ns: duration_ns(context.flight_time_max),
            interruptions: context.interruptions,
            lost_counts: vec![0; context.interruptions.len()],
            last_hit: None,
            previous_producer_ns: None,
            previous_consumer_ns: None,
        }
    }

    /// The fate of one message; remembers what its interruption cost.
    pub(super) fn judge(&mut self, joined: &Joined) -> MessageFate {
        let place = Place::of(joined);
        let fate = self.fate(joined, place);
        self.previous_producer_ns = place.producer_ns.or(self.previous_producer_ns);
        self.previous_consumer_ns = place.consumer_ns.or(self.previous_consumer_ns);
        fate
    }

    /// What each interruption cost, with the silence it caused.
    pub(super) fn interruptions(&self, gaps: &[Option<Gap>]) -> Vec<InterruptionMetrics> {
        let costs = self.lost_counts.iter().zip(gaps);
        self.interruptions
            .iter()
            .zip(costs)
            .map(|(interruption, (lost_count, gap))| InterruptionMetrics {
                process: interruption.process.clone(),
                cause: interruption.cause.clone(),
                length_ns: interruption.until.ns_since(interruption.from),
                lost_count: *lost_count,
                gap: *gap,
            })
            .collect()
    }

    fn fate(&mut self, joined: &Joined, place: Place) -> MessageFate {
        self.last_hit = None;
        if joined.taken.is_some() {
            return MessageFate::Taken;
        }
        let fate = if self.is_gateway {
            self.fate_over_gateway(joined, place)
        } else {
            self.fate_at_consumer(joined, place.producer_ns, self.producer_end_ns)
        };
        let hit = (0..self.interruptions.len()).find(|index| {
            let interruption = &self.interruptions[*index];
            self.is_within_reach(joined, interruption) && self.is_hit(fate, place, interruption)
        });
        self.last_hit = hit;
        match hit {
            Some(index) => {
                self.lost_counts[index] = self.lost_counts[index].saturating_add(joined.count);
                MessageFate::LostInInterruption
            }
            None => fate,
        }
    }

    fn fate_over_gateway(&self, joined: &Joined, place: Place) -> MessageFate {
        if let Some(ingress) = joined.ingress {
            return self.fate_after_reception(joined, &ingress, place);
        }
        if let Some(egress) = joined.egress {
            if is_refused(&egress) {
                return MessageFate::RefusedByKernel;
            }
            if self.files.ingress.is_none() {
                return MessageFate::UnknownPeerRecordsUnavailable;
            }
            if self.is_near(place.producer_ns, self.producer_end_ns) {
                return MessageFate::InFlight;
            }
            return match stamp(egress.handed_ns) {
                Some(_) => MessageFate::LostOnWire,
                None => MessageFate::Unexplained,
            };
        }
        if self.files.egress.is_none() {
            return MessageFate::UnknownPeerRecordsUnavailable;
        }
        if self.last_egress.is_some_and(|last| joined.key < last) {
            return MessageFate::SupersededAtInput;
        }
        self.in_flight_or_unexplained(place.producer_ns, self.producer_end_ns)
    }

    fn fate_after_reception(
        &self,
        joined: &Joined,
        ingress: &IngressRecord,
        place: Place,
    ) -> MessageFate {
        if let Some(forwarded_ns) = stamp(ingress.forwarded_ns) {
            return self.fate_at_consumer(joined, Some(forwarded_ns), self.consumer_end_ns);
        }
        if ingress.flags & IngressRecord::INCOMPLETE != 0 {
            self.fate_of_pieces(joined, place)
        } else if ingress.flags & IngressRecord::LATE != 0 {
            MessageFate::Late
        } else if ingress.flags & IngressRecord::DUPLICATE != 0 {
            MessageFate::Duplicate
        } else {
            MessageFate::RefusedAtIngress
        }
    }

    /// Only pieces came: because the sender stopped in the middle of it, because the run ended, or
    /// because the others got lost.
    fn fate_of_pieces(&self, joined: &Joined, place: Place) -> MessageFate {
        if joined.egress.as_ref().is_some_and(is_refused) {
            MessageFate::RefusedByKernel
        } else if self.is_near(place.producer_ns, self.producer_end_ns) {
            MessageFate::InFlight
        } else {
            MessageFate::Incomplete
        }
    }

    fn fate_at_consumer(
        &self,
        joined: &Joined,
        arrived_ns: Option<i64>,
        end_ns: Option<i64>,
    ) -> MessageFate {
        if self.files.taken.is_none() {
            return MessageFate::UnknownPeerRecordsUnavailable;
        }
        if self.last_taken.is_some_and(|last| joined.key < last) {
            return MessageFate::SupersededAtConsumer;
        }
        self.in_flight_or_unexplained(arrived_ns, end_ns)
    }

    fn in_flight_or_unexplained(&self, at_ns: Option<i64>, end_ns: Option<i64>) -> MessageFate {
        if self.is_near(at_ns, end_ns) {
            MessageFate::InFlight
        } else {
            MessageFate::Unexplained
        }
    }

    fn is_near(&self, at_ns: Option<i64>, end_ns: Option<i64>) -> bool {
        let Some((at_ns, end_ns)) = at_ns.zip(end_ns) else {
            return false;
        };
        at_ns >= end_ns.saturating_sub(self.flight_ns)
    }

    /// True when the message could have been in or before the interrupted process.
    fn is_within_reach(&self, joined: &Joined, interruption: &Interruption) -> bool {
        if !self.is_gateway {
            return true;
        }
        let never_left =
            self.files.egress.is_some() && joined.egress.is_none() && joined.ingress.is_none();
        let is_forwarded = joined
            .ingress
            .is_some_and(|ingress| stamp(ingress.forwarded_ns).is_some());
        match interruption.place {
            PathProcess::Producer => joined.egress.is_none() && joined.ingress.is_none(),
            PathProcess::SendingGateway => joined.arrived().is_none(),
            PathProcess::ReceivingGateway => !never_left,
            PathProcess::Consumer => is_forwarded || (self.files.ingress.is_none() && !never_left),
        }
    }

    /// True when the message was last seen while the process was down, or shortly before and
    /// nothing recorded says that it got lost otherwise.
    fn is_hit(&self, fate: MessageFate, place: Place, interruption: &Interruption) -> bool {
        let (seen_ns, bound_ns, is_exact) = match self.position(place, interruption.place.side()) {
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
            | MessageFate::Unexplained
            | MessageFate::InFlight
            | MessageFate::UnknownPeerRecordsUnavailable => true,
            MessageFate::SupersededAtInput => interruption.place == PathProcess::SendingGateway,
            MessageFate::SupersededAtConsumer => interruption.place == PathProcess::Consumer,
            // Its record says otherwise, but if it was somewhat later, its cause is the same.
            _ => !is_exact,
        };
        may_have_been_inside && (from_ns.saturating_sub(self.flight_ns)..from_ns).contains(&seen_ns)
    }

    /// When the message was last seen, on the clock of one host.
    fn position(&self, place: Place, side: Side) -> Position {
        let (exact_ns, previous_ns) = match side {
            Side::Producer => (place.producer_ns, self.previous_producer_ns),
            Side::Consumer => (place.consumer_ns, self.previous_consumer_ns),
        };
        let localised = || {
            let remote = RemoteInstant::from_ns(place.producer_ns?);
            self.path
                .localise(remote)
                .filter(|_| side == Side::Consumer)
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

/// True when the sending gateway noted that it could not send the whole message.
const fn is_refused(egress: &EgressRecord) -> bool {
    egress.flags & EgressRecord::REFUSED_BY_KERNEL != 0
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
#[derive(Debug, Clone, Copy)]
struct Place {
    producer_ns: Option<i64>,
    consumer_ns: Option<i64>,
}

impl Place {
    fn of(joined: &Joined) -> Self {
        let published = joined
            .published
            .and_then(|record| stamp(record.published_ns));
        let egress = joined.egress.and_then(|record| {
            stamp(record.handed_ns)
                .or(stamp(record.taken_ns))
                .or(stamp(record.published_ns))
        });
        let sender = joined
            .ingress
            .and_then(|record| stamp(record.handed_ns).or(stamp(record.published_ns)));
        let arrived = joined
            .ingress
            .and_then(|record| stamp(record.forwarded_ns).or(stamp(record.received_ns)));
        let origin = joined.taken.and_then(|record| stamp(record.published_ns));
        let taken = joined.taken.and_then(|record| stamp(record.taken_ns));
        Self {
            producer_ns: egress.or(sender).or(published).or(origin),
            consumer_ns: taken.or(arrived),
        }
    }
}
