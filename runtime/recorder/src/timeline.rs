//! What a run's folder holds, as steps in order of time. It makes no topic of anything and copies
//! nothing: a step says where in the folder something is.

use std::collections::BTreeMap;

use hil_core::message::Envelope;
use hil_core::record::{FollowUpRecord, IngressRecord};
use hil_rundir::live_run::Stage;
use hil_rundir::record::RecordKind;

use crate::net::{self, MessageId, Noted};
use crate::run::Run;

/// Something of a run's folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum What {
    /// A message of a record file.
    Message { file: usize, index: usize },
    /// What a process noted of a message.
    Record { file: usize, index: usize },
    /// A transmit stamp that came later.
    LateStamp { file: usize, index: usize },
    /// The verdict of a link.
    Decision { trace: usize, index: usize },
    /// An order to a link.
    Condition { file: usize, index: usize },
    /// An event of the score.
    Event { index: usize },
}

/// Something and its place: by time, then the channel, so that the order is the same each time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Step {
    /// On the recording's axis; `None`, before all others, where that is not known.
    pub(crate) at_ns: Option<u64>,
    /// Its channel, or the number behind the last of what is of none.
    pub(crate) channel: usize,
    /// What.
    pub(crate) what: What,
}

impl Step {
    /// True when both are of one channel and one moment.
    pub(crate) fn is_beside(&self, other: &Self) -> bool {
        (self.at_ns, self.channel) == (other.at_ns, other.channel)
    }
}

/// The messages of `run` and what processes noted of each. `place` gives the number of a channel, `at_ns`
/// the time of something on it.
pub(crate) fn noted_steps(
    run: &Run,
    place: impl Fn(&str) -> Option<usize>,
    at_ns: &mut dyn FnMut(usize, &Noted) -> Option<u64>,
) -> Vec<Step> {
    let mut steps = Vec::new();
    for (file, records) in run.files.iter().enumerate() {
        let Some(channel) = place(&records.header.channel) else {
            continue;
        };
        for index in 0..records.record_count() {
            let (noted, what) = if records.header.kind == RecordKind::Message {
                let message = records.message(index);
                let noted = message.map(|(envelope, _)| published(&envelope));
                (noted, What::Message { file, index })
            } else {
                let record = net::record(records, index);
                let noted = record.as_ref().and_then(Noted::of);
                (noted, What::Record { file, index })
            };
            steps.extend(noted.map(|noted| Step {
                at_ns: at_ns(channel, &noted),
                channel,
                what,
            }));
        }
    }
    steps
}

/// A transmit stamp that came later, and when the message that it is about was published, on the clock of
/// its producer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LateStamp {
    /// Where it is.
    pub(crate) what: What,
    /// The publication.
    pub(crate) published_ns: i64,
}

/// The transmit stamps of messages of `channel` that came in later datagrams.
pub(crate) fn late_stamps(run: &Run, channel: &str) -> impl Iterator<Item = LateStamp> {
    let mut late = Vec::new();
    let mut published: BTreeMap<(u32, u64), i64> = BTreeMap::new();
    for (file, records) in run.files_of(channel, RecordKind::FollowUp) {
        if published.is_empty() {
            let arrived = run.files_of(channel, RecordKind::Ingress);
            let arrived = arrived.flat_map(|(_, file)| file.records::<IngressRecord>());
            published = arrived
                .map(|one| ((one.session, one.sequence), one.published_ns))
                .collect();
        }
        for (index, one) in records.records::<FollowUpRecord>().enumerate() {
            let published_ns = published.get(&(one.session, one.sequence));
            late.extend(published_ns.map(|published_ns| LateStamp {
                what: What::LateStamp { file, index },
                published_ns: *published_ns,
            }));
        }
    }
    late.into_iter()
}

/// What a message says of its own publication.
const fn published(envelope: &Envelope) -> Noted {
    Noted {
        stage: Stage::Published,
        message: MessageId {
            epoch: envelope.epoch,
            sequence: envelope.sequence,
        },
        published_ns: envelope.published_ns,
        at_ns: envelope.published_ns,
    }
}
