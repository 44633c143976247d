//! What a link did to every message of a channel, from its joined records: the substance of a
//! [`Trace`](super::Trace). It judges as the account does and writes no file.

use super::{TraceFate, TraceRecord, UNAVAILABLE_NS, UNBOUNDED_NS};
use hil_account::{AccountContext, ChannelRecords, MessageFate, MessageHistory, each_history};
use hil_core::record::{IngressRecord, stamp};
use hil_core::time::RemoteInstant;

/// Most messages of one trace: a damaged number must not make a file without end.
pub const TRACE_MESSAGES_MAX: u64 = 1 << 24;

/// What is known of a channel whose messages are traced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceChannel {
    /// Size of one message.
    pub size_bytes: u32,
    /// True when a link model, not a network, decided their fates.
    pub is_emulated: bool,
}

/// The records cannot become a trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the records tell of {count} messages or more, a trace holds at most {TRACE_MESSAGES_MAX}")]
pub struct TooManyMessages {
    /// Messages.
    pub count: u64,
}

/// One trace record for each published message, in the order of publication, from the start of the
/// run on the producer's host clock.
///
/// A message departs when it was handed to the kernel; one that never was, when its gateway took it,
/// else when it was published. It arrives when the receiving gateway's receive call had returned.
/// Its delay is the difference on the consumer's host clock, with the bound of that conversion.
///
/// # Errors
/// When there are more than [`TRACE_MESSAGES_MAX`].
pub fn link_trace(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    channel: TraceChannel,
) -> Result<Vec<TraceRecord>, TooManyMessages> {
    let mut found = Vec::new();
    each_traced(records, context, channel, |record| found.push(record))?;
    // Two starts of a producer may overlap; the order of publication is that of the link.
    found.sort_by_key(|record| record.published_ns);
    Ok(found)
}

/// Hands the records of [`link_trace`] to `take`, in the order of the producer's starts and numbers: that of
/// publication, unless two starts of a producer overlap.
///
/// # Errors
/// When there are more than [`TRACE_MESSAGES_MAX`]; those up to there were handed out.
pub fn each_traced(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    channel: TraceChannel,
    mut take: impl FnMut(TraceRecord),
) -> Result<(), TooManyMessages> {
    let origin_ns = context.producer_run.map(|run| run.start.as_ns());
    let mut tracer = Tracer {
        context,
        channel,
        origin_ns,
        last_published_ns: 0,
    };
    let mut count = 0_u64;
    each_history(records, context, |message| {
        count = count.saturating_add(message.count);
        if count > TRACE_MESSAGES_MAX {
            return;
        }
        for step in 0..message.count {
            let mut record = tracer.record(message);
            record.sequence = message.key.sequence + step;
            take(record);
        }
    });
    if count > TRACE_MESSAGES_MAX {
        return Err(TooManyMessages { count });
    }
    Ok(())
}

struct Tracer<'a> {
    context: &'a AccountContext<'a>,
    channel: TraceChannel,
    origin_ns: Option<i64>,
    last_published_ns: i64,
}

impl Tracer<'_> {
    fn record(&mut self, message: &MessageHistory) -> TraceRecord {
        let published = message.published_ns();
        // A run without a known start begins with its first message.
        let origin_ns = *self.origin_ns.get_or_insert(published.unwrap_or(0));
        let since_start = |ns: i64| ns.saturating_sub(origin_ns);
        let published_ns = published.map_or(self.last_published_ns, since_start);
        self.last_published_ns = published_ns;
        let size_bytes = self.channel.size_bytes;
        let mut record = TraceRecord::published(published_ns, message.key.sequence, size_bytes);
        record.start = u16::try_from(message.key.epoch_rank).unwrap_or(u16::MAX);
        record.fate = trace_fate(message);
        let departure = departure_ns(message);
        record.departure_ns = departure.map_or(published_ns, since_start);
        let flags = [
            (published.is_none(), TraceRecord::INSTANT_ASSUMED),
            (self.channel.is_emulated, TraceRecord::EMULATED),
            (
                message.fate == MessageFate::RefusedByKernel,
                TraceRecord::REFUSED,
            ),
            (
                message.interruption_index.is_some(),
                TraceRecord::INTERRUPTED,
            ),
        ];
        for (is_set, flag) in flags {
            record.flags |= if is_set { flag } else { 0 };
        }
        let (Some(ingress), Some(departure_ns)) = (message.arrived(), departure) else {
            return record;
        };
        if message.is_overtaken() {
            record.flags |= TraceRecord::REORDERED;
        }
        let second = message.copies.second_received_ns;
        let second = second.filter(|_| ingress.flags & IngressRecord::DUPLICATE == 0);
        self.put_delays(&mut record, departure_ns, ingress.received_ns, second);
        record
    }

    /// Delays on the consumer's host clock, with the bound of the conversion.
    fn put_delays(
        &self,
        record: &mut TraceRecord,
        departure_ns: i64,
        arrival_ns: i64,
        second_ns: Option<i64>,
    ) {
        let remote = RemoteInstant::from_ns(departure_ns);
        let localised = self.context.path.localise(remote);
        let (Some((departure, bound_ns)), Some(arrival_ns)) = (localised, stamp(arrival_ns)) else {
            record.delay_ns = UNAVAILABLE_NS;
            record.bound_ns = UNBOUNDED_NS;
            return;
        };
        let since_departure = |ns: i64| ns.saturating_sub(departure.as_ns());
        let delay_ns = since_departure(arrival_ns);
        record.delay_ns = delay_ns;
        record.bound_ns = bound_ns;
        let second_ns = second_ns.and_then(stamp);
        record.second_delay_ns = second_ns.map_or(UNAVAILABLE_NS, since_departure);
    }
}

/// When it was handed to the link, on the producer's host clock.
fn departure_ns(message: &MessageHistory) -> Option<i64> {
    let taken_ns = || message.egress.and_then(|record| stamp(record.taken_ns));
    let handed_ns = message.handed_ns().or_else(taken_ns);
    handed_ns.or_else(|| message.published_ns())
}

/// Whether the link delivered it; what the consumer made of it is not the link's business.
fn trace_fate(message: &MessageHistory) -> TraceFate {
    if let Some(ingress) = message.arrived() {
        return match stamp(ingress.forwarded_ns) {
            Some(_) => TraceFate::Delivered,
            None => TraceFate::LostAfterLink,
        };
    }
    match message.fate {
        MessageFate::Taken | MessageFate::SupersededAtConsumer => TraceFate::Delivered,
        MessageFate::SupersededAtInput | MessageFate::RefusedByKernel => TraceFate::LostBeforeLink,
        MessageFate::NetworkUnreachable | MessageFate::LostOnWire | MessageFate::Incomplete => {
            TraceFate::LostInNetwork
        }
        MessageFate::LostByHarness
        | MessageFate::RefusedAtIngress
        | MessageFate::Late
        | MessageFate::Duplicate => TraceFate::LostAfterLink,
        MessageFate::LostInInterruption => match message.egress {
            Some(_) => TraceFate::LostInNetwork,
            None => TraceFate::LostBeforeLink,
        },
        MessageFate::LostOnWireOrByHarness
        | MessageFate::InFlight
        | MessageFate::Unexplained
        | MessageFate::UnknownPeerRecordsUnavailable => TraceFate::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{decode, encode};
    use crate::{Trace, TraceHeader};
    use hil_account::synthetic::{Files, at, same_clock};
    use hil_account::{ChannelPath, account};

    const CHANNEL: TraceChannel = TraceChannel {
        size_bytes: 16,
        is_emulated: true,
    };

    #[test]
    fn every_published_message_has_one_record_with_the_fate_of_the_account() {
        use MessageFate as Fate;
        let fates = [
            (Fate::Taken, TraceFate::Delivered),
            (Fate::LostOnWire, TraceFate::LostInNetwork),
            (Fate::SupersededAtInput, TraceFate::LostBeforeLink),
            (Fate::RefusedByKernel, TraceFate::LostBeforeLink),
            (Fate::Late, TraceFate::LostAfterLink),
            (Fate::SupersededAtConsumer, TraceFate::Delivered),
            (Fate::Incomplete, TraceFate::LostInNetwork),
            (Fate::Taken, TraceFate::Delivered),
        ];
        let mut files = Files::default();
        for (sequence, (fate, _)) in (0_u64..).zip(fates) {
            files.write(at(7, sequence), fate);
        }
        files.ingress.last_mut().unwrap().flags = IngressRecord::REORDERED;
        let context = same_clock(1_000_000_000);
        let traced = link_trace(&files.records(), &context, CHANNEL).unwrap();
        let found: Vec<_> = traced.iter().map(|record| record.fate).collect();
        assert_eq!(found, fates.map(|(_, fate)| fate));
        let account = account(&files.records(), &context);
        assert_eq!(traced.len() as u64, account.published_count);
        assert!(traced[7].has(TraceRecord::REORDERED) && !traced[0].has(TraceRecord::REORDERED));
        assert!(traced[3].has(TraceRecord::REFUSED) && traced[0].has(TraceRecord::EMULATED));
        let ingress = files.ingress[0];
        assert_eq!(
            traced[0].delay_ns,
            ingress.received_ns - files.egress[0].handed_ns
        );
        assert_eq!((traced[0].bound_ns, traced[1].delay()), (0, None));
        assert!(traced[4].delay().is_some(), "it did arrive, too late");
        assert_eq!(traced[6].delay(), None, "only pieces of it arrived");
    }

    #[test]
    fn a_trace_with_an_incomplete_message_is_written_and_read_again() {
        let mut files = Files::delivered(3);
        files.write(at(7, 3), MessageFate::Incomplete);
        files.write(at(7, 4), MessageFate::Taken);
        let context = same_clock(1_000_000_000);
        let records = link_trace(&files.records(), &context, CHANNEL).unwrap();
        let found = (records[3].fate, records[3].delay(), records[3].bound_ns);
        assert_eq!(found, (TraceFate::LostInNetwork, None, UNBOUNDED_NS));
        let header = TraceHeader::new("arm/command");
        let trace = Trace { header, records };
        let decoded = decode(&encode(&trace).unwrap()).unwrap();
        assert_eq!((decoded.trace, decoded.fault), (trace, None));
    }

    #[test]
    fn unaligned_clocks_leave_the_losses_and_no_delay() {
        let mut files = Files::delivered(5);
        files.write(at(7, 5), MessageFate::LostOnWire);
        files.write(at(7, 6), MessageFate::Taken);
        let context = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let traced = link_trace(&files.records(), &context, CHANNEL).unwrap();
        assert_eq!(traced.len(), 7);
        assert!(traced.iter().all(|record| record.delay().is_none()));
        assert_eq!(traced[5].fate, TraceFate::LostInNetwork);
        assert_eq!(traced[6].fate, TraceFate::Delivered);
        assert_eq!(
            traced[0].published_ns, 0,
            "it begins with its first message"
        );
    }

    #[test]
    fn a_second_copy_is_noted_with_its_message() {
        let mut files = Files::delivered(2);
        let mut copy = files.ingress[1];
        copy.flags = IngressRecord::DUPLICATE;
        copy.received_ns += 700;
        files.ingress.push(copy);
        let context = same_clock(1_000_000_000);
        let traced = link_trace(&files.records(), &context, CHANNEL).unwrap();
        assert_eq!(traced[0].second_delay(), None);
        let expected = traced[1].delay_ns + 700;
        assert_eq!(traced[1].second_delay(), Some(expected));
    }

    #[test]
    fn a_damaged_number_makes_no_endless_trace() {
        let mut files = Files::delivered(2);
        files.published.last_mut().unwrap().sequence = u64::MAX - 1;
        let context = same_clock(1_000_000_000);
        let refused = link_trace(&files.records(), &context, CHANNEL).unwrap_err();
        assert!(refused.count > TRACE_MESSAGES_MAX);
    }
}
