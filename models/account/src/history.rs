//! The fate of single messages, for those who ask about them by name: the same judgement as in
//! the account, not summed up.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::join::Joined;
use super::stage::MessageFate;
use super::{AccountContext, ChannelRecords, each_judged};
use hil_core::record::{IngressRecord, stamp};
use hil_core::time::RemoteInstant;

/// What became of one message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageHistory {
    /// Its fate.
    pub fate: MessageFate,
    /// When it was published, on the producer's host clock, nanoseconds.
    pub published_ns: Option<i64>,
    /// Published to taken, nanoseconds; `None` for a message that was not taken, and between
    /// hosts whose clocks are not aligned.
    pub delay_ns: Option<i64>,
    /// How far `delay_ns` may be off because two hosts' clocks are in it; zero on one clock.
    pub delay_bound_ns: Option<u64>,
    /// A later message of the channel came before it.
    pub is_overtaken: bool,
    /// Index of the interruption that cost it, when it was lost in one.
    pub interruption_index: Option<usize>,
}

/// The stories of the `wanted` messages, each given by the producer's start and the sequence
/// number. A message that no record mentions is left out.
pub fn stories(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    wanted: &BTreeSet<(u32, u64)>,
) -> BTreeMap<(u32, u64), MessageHistory> {
    let mut found = BTreeMap::new();
    each_judged(records, context, |joined, fate, interruption_index| {
        let Some(key) = key(joined).filter(|key| wanted.contains(key)) else {
            return;
        };
        let delay = delay(joined, context);
        let story = MessageHistory {
            fate,
            published_ns: joined.published_ns(),
            delay_ns: delay.map(|(delay_ns, _)| delay_ns),
            delay_bound_ns: delay.map(|(_, bound_ns)| bound_ns),
            is_overtaken: joined
                .ingress
                .is_some_and(|ingress| ingress.flags & IngressRecord::REORDERED != 0),
            interruption_index,
        };
        found.insert(key, story);
    });
    found
}

/// Epoch and sequence number; `None` for a run of numbers that no record mentions.
fn key(joined: &Joined) -> Option<(u32, u64)> {
    let epochs = [
        joined.published.map(|record| record.epoch),
        joined.egress.map(|record| record.epoch),
        joined.ingress.map(|record| record.epoch),
        joined.taken.map(|record| record.epoch),
    ];
    let epoch = epochs.into_iter().flatten().next()?;
    Some((epoch, joined.key.sequence))
}

fn delay(joined: &Joined, context: &AccountContext<'_>) -> Option<(i64, u64)> {
    let taken = joined.taken?;
    let (published_ns, taken_ns) = (stamp(taken.published_ns)?, stamp(taken.taken_ns)?);
    let remote = RemoteInstant::from_ns(published_ns);
    let (published, bound_ns) = context.path.localise(remote)?;
    Some((taken_ns.saturating_sub(published.as_ns()), bound_ns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Files, TAKEN_NS, at, same_clock};
    use crate::{ChannelPath, Interruption, PathProcess, account};
    use hil_core::time::Instant;

    #[test]
    fn each_story_has_the_fate_that_the_account_counts() {
        use MessageFate as Fate;
        let fates = [
            Fate::Taken,
            Fate::LostOnWire,
            Fate::SupersededAtInput,
            Fate::RefusedByKernel,
            Fate::Late,
            Fate::SupersededAtConsumer,
            Fate::Taken,
        ];
        let mut files = Files::default();
        for (sequence, fate) in (0_u64..).zip(fates) {
            files.write(at(7, sequence), fate);
        }
        files.ingress.last_mut().unwrap().flags = IngressRecord::REORDERED;
        let context = same_clock(1_000_000_000);
        let wanted: BTreeSet<(u32, u64)> = (0..9).map(|sequence| (7, sequence)).collect();
        let found = stories(&files.records(), &context, &wanted);
        let found_fates: Vec<_> = found.values().map(|story| story.fate).collect();
        assert_eq!(found_fates, fates);
        assert_eq!(found[&(7, 6)].delay_ns, Some(TAKEN_NS));
        assert_eq!(found[&(7, 1)].delay_ns, None);
        assert_eq!(found[&(7, 1)].published_ns, Some(at(7, 1).published_ns));
        assert!(found[&(7, 6)].is_overtaken && !found[&(7, 0)].is_overtaken);
        let account = account(&files.records(), &context);
        assert_eq!(account.fates.of(Fate::LostOnWire), 1);
    }

    #[test]
    fn a_message_of_another_start_or_without_record_is_not_there() {
        let files = Files::delivered(3);
        let context = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let wanted = BTreeSet::from([(7, 2), (7, 3), (8, 2)]);
        let found = stories(&files.records(), &context, &wanted);
        assert_eq!(found.keys().copied().collect::<Vec<_>>(), [(7, 2)]);
        assert_eq!(found[&(7, 2)].delay_ns, None, "clocks are not aligned");
    }

    #[test]
    fn a_message_lost_in_an_interruption_names_it() {
        let mut files = Files::delivered(10);
        files.write(at(7, 10), MessageFate::LostOnWire);
        let down = |from_ns, until_ns| Interruption {
            process: "gateway".to_owned(),
            place: PathProcess::ReceivingGateway,
            from: Instant::from_ns(from_ns),
            until: Instant::from_ns(until_ns),
            cause: "killed by signal 9".to_owned(),
        };
        let published_ns = at(7, 10).published_ns;
        let interruptions = [
            down(900_000_000, 950_000_000),
            down(published_ns, published_ns + 5_000_000),
        ];
        let context = same_clock(1_000_000_000).with_interruptions(&interruptions);
        let wanted = BTreeSet::from([(7, 9), (7, 10)]);
        let found = stories(&files.records(), &context, &wanted);
        assert_eq!(found[&(7, 10)].interruption_index, Some(1));
        assert_eq!(found[&(7, 9)].interruption_index, None);
    }
}
