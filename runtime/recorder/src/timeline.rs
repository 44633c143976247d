//! What a run's folder holds, as steps in order of time. It makes no topic of anything and copies
//! nothing: a step says where in the folder something is.

use std::collections::BTreeMap;

use hil_core::message::Envelope;
use hil_core::record::IngressRecord;
use hil_rundir::live_run::Stage;
use hil_rundir::record::RecordKind;
use hil_rundir::record::file::RecordHeader;
use hil_watch::Record;

use crate::net::{self, MessageId, Noted};
use crate::run::Run;

/// Something of a run's folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum What {
    /// A message of a record file.
    Message { file: usize, index: usize },
    /// What a process noted of a message.
    Record { file: usize, index: usize },
    /// A transmit stamp that came with a later message, in the record of that.
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
/// the time of something on it; a transmit stamp that came later has that of its message's arrival.
pub(crate) fn noted_steps(
    run: &Run,
    place: impl Fn(&str) -> Option<usize>,
    at_ns: &mut dyn FnMut(usize, &Noted) -> Option<u64>,
) -> Vec<Step> {
    let mut steps = Vec::new();
    for (file, records) in run.files.iter().enumerate() {
        let RecordHeader {
            channel: name,
            kind,
            ..
        } = &records.header;
        let Some(channel) = place(name) else {
            continue;
        };
        let arrivals = if *kind == RecordKind::Ingress {
            arrivals(run, name)
        } else {
            BTreeMap::new()
        };
        for index in 0..records.record_count() {
            let with_late = records.record::<IngressRecord>(index);
            let with_late = with_late.filter(|_| *kind == RecordKind::Ingress);
            let late = with_late.and_then(|one| Some((Arrival::of(&one), one.follow_up()?)));
            let stamped = late.and_then(|(with, late)| {
                arrivals.get(&Arrival {
                    sequence: late.sequence,
                    ..with
                })
            });
            steps.extend(stamped.map(|noted| Step {
                at_ns: at_ns(channel, noted),
                channel,
                what: What::LateStamp { file, index },
            }));
            let (noted, what) = if *kind == RecordKind::Message {
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

/// The arrival of a message, as the receiving gateway names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Arrival {
    session: u32,
    epoch: u32,
    sequence: u64,
}

impl Arrival {
    const fn of(record: &IngressRecord) -> Self {
        Self {
            session: record.session,
            epoch: record.epoch,
            sequence: record.sequence,
        }
    }
}

/// What the receiving gateway noted of each message of `channel`.
fn arrivals(run: &Run, channel: &str) -> BTreeMap<Arrival, Noted> {
    let files = run.files_of(channel, RecordKind::Ingress);
    let records = files.flat_map(|(_, file)| file.records::<IngressRecord>());
    let noted = records.filter_map(|one| {
        let noted = Noted::of(&Record::Ingress(one))?;
        Some((Arrival::of(&one), noted))
    });
    noted.collect()
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
