//! Brings the messages of a run to the clock that its score is kept on, where the clocks of the hosts
//! are aligned. The score then compares what two hosts did, within the bound of the alignment.

use hil_models::time::RemoteInstant;

use super::records::RunRecords;
use crate::registry::MadeCase;
use crate::supervisor::RunResult;
use crate::topology::Topology;

/// Brings every message of the log to the clock that `case` keeps its score on; gives why not, when the
/// clocks are aligned and it cannot be done. The log of hosts with unrelated clocks stays as it was
/// read, which the score then knows.
pub(super) fn apply(
    records: &mut RunRecords,
    (topology, result): (&Topology, &RunResult),
    case: Option<&MadeCase<'_>>,
) -> Option<String> {
    if result.has_one_clock {
        return None;
    }
    records.log_mut().set_clocks_differ();
    let score_clock = case.and_then(|(entry, _)| entry.score_clock);
    let host_of = |channel: &str| {
        let producer = &topology.channel(channel)?.from;
        Some(topology.process(producer)?.host.as_str())
    };
    let here = score_clock.and_then(host_of)?;
    let mut log = core::mem::take(records.log_mut());
    let clocks = records.clocks();
    let convert = |channel: &str, ns: i64| {
        // A message that was published long before the gateways met is one of the score all the same.
        let path = clocks.path(host_of(channel)?, here);
        let (at, bound_ns) = path.localise_beyond(RemoteInstant::from_ns(ns))?;
        Some((at.as_ns(), bound_ns))
    };
    let failed = log.bring_to_one_clock(convert).err();
    let is_aligned =
        |channel: &str| host_of(channel).is_some_and(|from| clocks.path(from, here).is_aligned());
    let why = failed.filter(|channel| is_aligned(channel)).map(|channel| {
        format!(
            "the score takes the hosts' clocks as not aligned: a message of {channel} was published \
             beside a step of a clock"
        )
    });
    *records.log_mut() = log;
    why
}
