//! The traces a run leaves: one file for each channel that crossed a link, drawn up from the
//! records after the run. A trace that cannot be written costs the run nothing but that file.

use std::fs;
use std::path::Path;

use hil_models::measure::account::TraceChannel;
use hil_models::trace::wire;
use hil_models::trace::{
    Trace, TraceArrival, TraceDirection, TraceHeader, TraceRecord, UNAVAILABLE_NS,
};

use crate::analysis::link_changes;
use crate::analysis::records::RunRecords;
use crate::report::summary::{Fact, RunSummary};
use crate::supervisor::RunResult;
use crate::topology::{Crossing, Direction, Topology, Via};

/// What a trace of clocks without a relation says of them.
pub(crate) const NOT_ALIGNED: &str = "clocks not aligned";
/// What follows the name of a link that was changed while the run went on, before how often.
pub(super) const CHANGED_BY_HAND: &str = " (changed by hand";

/// The file of `channel` in a folder of traces.
pub(crate) fn file_name(channel: &str) -> String {
    format!("{}.trace", channel.replace('/', "."))
}

/// Writes the traces of a finished run and says so in its summary.
pub(crate) fn write(
    summary: &mut RunSummary,
    (topology, result): (&Topology, &RunResult),
    records: &RunRecords,
) {
    let folder = result.folder.traces();
    let mut written_count = 0;
    for crossing in topology.crossings() {
        match write_one((topology, result), records, &crossing, &folder) {
            Ok(is_written) => written_count += usize::from(is_written),
            Err(why) => {
                let channel = &crossing.channel.name;
                let text = format!("no link trace of {channel}: {why}");
                summary.warnings.push(text);
            }
        }
    }
    if written_count > 0 {
        let what = format!(
            "what the link did to each message of {written_count} channels; hil-runtime trace info"
        );
        summary.run.files.push(Fact::new("traces/", what));
    }
}

/// False when nothing was recorded of the channel.
fn write_one(
    run: (&Topology, &RunResult),
    records: &RunRecords,
    crossing: &Crossing<'_>,
    folder: &Path,
) -> Result<bool, String> {
    let channel = crossing.channel;
    let traced = TraceChannel {
        size_bytes: u32::try_from(channel.message.size_bytes).unwrap_or(u32::MAX),
        is_emulated: matches!(crossing.link.via, Via::Emulated(..)),
    };
    let found = records.link_trace(run, channel, traced);
    let found = found.map_err(|error| error.to_string())?;
    if found.is_empty() {
        return Ok(false);
    }
    let trace = Trace {
        header: TraceHeader {
            link: link_words(run.0, crossing, records),
            ..header(run.1, crossing, &found)
        },
        records: found,
    };
    let bytes = wire::encode(&trace).map_err(|error| error.to_string())?;
    fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let path = folder.join(file_name(&channel.name));
    fs::write(&path, bytes).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(true)
}

fn header(result: &RunResult, crossing: &Crossing<'_>, records: &[TraceRecord]) -> TraceHeader {
    let span = result.spans.get(&crossing.from_host.name);
    let clock = if result.has_one_clock {
        "one clock"
    } else if records.iter().any(|record| record.delay().is_some()) {
        "two clocks, aligned within the bound of each record"
    } else {
        NOT_ALIGNED
    };
    TraceHeader {
        run: cut(&result.folder.name(), TraceHeader::RUN_BYTES),
        channel: cut(&crossing.channel.name, TraceHeader::CHANNEL_BYTES),
        link: cut(&crossing.link.name, TraceHeader::LINK_BYTES),
        clock: cut(clock, TraceHeader::CLOCK_BYTES),
        direction: match crossing.direction {
            Direction::Forward => TraceDirection::Forward,
            Direction::Backward => TraceDirection::Backward,
        },
        arrival: TraceArrival::Received,
        origin_ns: span.map_or(UNAVAILABLE_NS, |(start, _)| start.as_ns()),
        duration_ns: span.map_or(UNAVAILABLE_NS, |(start, end)| end.ns_since(*start)),
    }
}

/// The link, and how often it was changed while the run went on: its model alone does not explain the
/// trace then.
fn link_words(topology: &Topology, crossing: &Crossing<'_>, records: &RunRecords) -> String {
    let name = &crossing.link.name;
    let count = link_changes::in_force_on(topology, records, crossing).count();
    let words = match count {
        0 => return cut(name, TraceHeader::LINK_BYTES),
        1 => format!("{CHANGED_BY_HAND} once)"),
        count => format!("{CHANGED_BY_HAND} {count} times)"),
    };
    let room = TraceHeader::LINK_BYTES - words.len();
    cut(name, room) + &words
}

/// As much of a name as fits, at the border of a character.
fn cut(name: &str, bytes_max: usize) -> String {
    let mut end = name.len().min(bytes_max);
    while !name.is_char_boundary(end) {
        end -= 1;
    }
    name[..end].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_cut_between_characters() {
        assert_eq!(cut("hop", 64), "hop");
        assert_eq!(cut("aµb", 2), "a");
        assert_eq!(cut("aµb", 3), "aµ");
        assert_eq!(file_name("egm/right/command"), "egm.right.command.trace");
    }
}
