//! The way of every message over the network, from the same join and judgement as the account's.
//! What the ways amount to is computed in [`crate::network`].

use super::join::Joined;
use super::stage::MessageFate;
use super::{AccountContext, ChannelRecords, each_judged};
use crate::network::{Crossing, PackedPassages, Passage};
use hil_core::record::stamp;
use hil_core::time::RemoteInstant;

/// The passages of a channel, in the order of the producer's starts and sequence numbers. Time grows with
/// the number of records, and memory by about a dozen bytes a message.
pub fn passages(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> PackedPassages {
    let mut found = PackedPassages::default();
    each_judged(records, context, |joined, fate, _| {
        found.push(&passage(joined, fate, context));
    });
    found
}

fn passage(joined: &Joined, fate: MessageFate, context: &AccountContext<'_>) -> Passage {
    let crossing = match fate {
        // What happened behind the receiving gateway is not the network's.
        _ if joined.arrived().is_some() => Crossing::Arrived,
        MessageFate::Taken | MessageFate::SupersededAtConsumer => Crossing::Arrived,
        MessageFate::LostOnWire | MessageFate::Incomplete => Crossing::LostByNetwork,
        MessageFate::InFlight
        | MessageFate::Unexplained
        | MessageFate::UnknownPeerRecordsUnavailable => Crossing::Unknown,
        MessageFate::SupersededAtInput
        | MessageFate::RefusedByKernel
        | MessageFate::RefusedAtIngress
        | MessageFate::Late
        | MessageFate::Duplicate
        | MessageFate::LostInInterruption => Crossing::LostByHost,
    };
    let handed_ns = joined
        .egress
        .and_then(|record| stamp(record.handed_ns))
        .or_else(|| stamp(joined.ingress?.handed_ns));
    let received_ns = joined
        .arrived()
        .and_then(|record| stamp(record.received_ns));
    let sent =
        handed_ns.and_then(|handed_ns| context.path.localise(RemoteInstant::from_ns(handed_ns)));
    let delay = sent.zip(received_ns);
    Passage {
        epoch_rank: joined.key.epoch_rank,
        sequence: joined.key.sequence,
        count: joined.count,
        offered_ns: handed_ns.or_else(|| joined.published_ns()),
        received_ns,
        delay_ns: delay.map(|((sent, _), received_ns)| received_ns.saturating_sub(sent.as_ns())),
        delay_bound_ns: delay.map_or(0, |((_, bound_ns), _)| bound_ns),
        crossing,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ChannelPath;
    use crate::network::Passages as _;
    use crate::synthetic::{Files, HANDED_NS, RECEIVED_NS, at, same_clock};
    use hil_core::time::Alignment;

    #[test]
    fn losses_of_the_host_are_kept_apart_from_those_of_the_network() {
        use Crossing::{Arrived, LostByHost, LostByNetwork};
        use MessageFate as Fate;
        let mut files = Files::default();
        for (sequence, fate) in (0_u64..).zip([
            Fate::Taken,
            Fate::LostOnWire,
            Fate::SupersededAtInput,
            Fate::RefusedByKernel,
            Fate::Late,
            Fate::SupersededAtConsumer,
            Fate::Taken,
        ]) {
            files.write(at(7, sequence), fate);
        }
        let found: Vec<_> = passages(&files.records(), &same_clock(1_000_000_000))
            .each()
            .collect();
        let crossings: Vec<_> = found.iter().map(|one| one.crossing).collect();
        assert_eq!(
            crossings,
            [
                Arrived,
                LostByNetwork,
                LostByHost,
                LostByHost,
                Arrived,
                Arrived,
                Arrived
            ]
        );
        assert_eq!(found[0].delay_ns, Some(RECEIVED_NS - HANDED_NS));
        assert_eq!(found[1].offered_ns, Some(at(7, 1).published_ns + HANDED_NS));
        assert_eq!(found[2].offered_ns, Some(at(7, 2).published_ns));
    }

    #[test]
    fn a_delay_between_hosts_needs_an_alignment_and_carries_its_bound() {
        let files = Files::delivered(3);
        let unaligned = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let found: Vec<_> = passages(&files.records(), &unaligned).each().collect();
        assert!(found.iter().all(|one| one.delay_ns.is_none()));
        assert!(found.iter().all(|one| one.received_ns.is_some()));
        let alignment = Some(Alignment {
            offset_ns: 500,
            bound_ns: 70,
        });
        let aligned = AccountContext::new(ChannelPath::Gateway { alignment });
        let found: Vec<_> = passages(&files.records(), &aligned).each().collect();
        assert_eq!(found[1].delay_ns, Some(RECEIVED_NS - HANDED_NS - 500));
        assert_eq!(found[1].delay_bound_ns, 70);
    }
}
