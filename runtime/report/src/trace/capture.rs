//! The traces a run leaves: one file for each channel that crossed a link, drawn up from the
//! records after the run. A trace that cannot be written costs the run nothing but that file.

use std::fmt::Display;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use hil_link::spec::Way;
use hil_trace::from_records::{TraceChannel, each_traced, link_trace};
use hil_trace::wire::TraceEncoder;
use hil_trace::{TraceArrival, TraceDirection, TraceHeader, TraceRecord, UNAVAILABLE_NS};

use crate::analysis::link_changes;
use crate::analysis::records::RunRecords;
use crate::summary::{Fact, RunSummary};
use hil_rundir::file_fault::FileFault;
use hil_rundir::run_result::RunResult;
use hil_topology::trace_source::file_name;
use hil_topology::{Crossing, Via};

/// What a trace of clocks without a relation says of them.
pub(crate) const NOT_ALIGNED: &str = "clocks not aligned";

/// Why there is no trace of a channel.
enum TraceFault {
    File(FileFault),
    Other(String),
}

impl From<FileFault> for TraceFault {
    fn from(fault: FileFault) -> Self {
        Self::File(fault)
    }
}

fn other(error: impl Display) -> TraceFault {
    TraceFault::Other(error.to_string())
}

/// Writes the traces of a finished run and says so in its summary; gives the files that could not be
/// written.
pub(crate) fn write(summary: &mut RunSummary, records: &RunRecords<'_>) -> Vec<FileFault> {
    let folder = records.result.folder.traces();
    let mut unwritten = Vec::new();
    let mut written_count = 0;
    for crossing in records.topology.crossings() {
        match write_one(records, &crossing, &folder) {
            Ok(is_written) => written_count += usize::from(is_written),
            Err(TraceFault::File(fault)) => unwritten.push(fault),
            Err(TraceFault::Other(why)) => {
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
    unwritten
}

/// False when nothing was recorded of the channel.
fn write_one(
    records: &RunRecords<'_>,
    crossing: &Crossing<'_>,
    folder: &Path,
) -> Result<bool, TraceFault> {
    let channel = crossing.channel;
    let traced = TraceChannel {
        size_bytes: u32::try_from(channel.message.size_bytes).unwrap_or(u32::MAX),
        is_emulated: matches!(crossing.link.via, Via::Emulated(..)),
    };
    records.consult(channel, |files, context| {
        let mut seen = Seen::default();
        each_traced(files, context, traced, |record| seen.note(&record)).map_err(other)?;
        if seen.count == 0 {
            return Ok(false);
        }
        let change_count = link_changes::in_force_on(records, crossing).count();
        let header = TraceHeader {
            link_change_count: u16::try_from(change_count).unwrap_or(u16::MAX),
            ..header(records.result, crossing, seen.has_delay)
        };
        fs::create_dir_all(folder).map_err(|error| FileFault::new(folder, &error))?;
        let path = folder.join(file_name(&channel.name));
        let mut file = TraceFile::create(&path, &header, seen.count)?;
        if seen.is_out_of_order {
            // Only where two starts of a producer overlap; sorting needs all of them at once.
            let found = link_trace(files, context, traced).map_err(other)?;
            for record in &found {
                file.add(record);
            }
        } else {
            each_traced(files, context, traced, |record| file.add(&record)).map_err(other)?;
        }
        file.finish()?;
        Ok(true)
    })
}

/// What must be known of a trace before it is written.
#[derive(Default)]
struct Seen {
    count: usize,
    has_delay: bool,
    is_out_of_order: bool,
    last_ns: Option<i64>,
}

impl Seen {
    fn note(&mut self, record: &TraceRecord) {
        let is_earlier = |last_ns: i64| record.published_ns < last_ns;
        self.is_out_of_order |= self.last_ns.is_some_and(is_earlier);
        self.has_delay |= record.delay().is_some();
        self.count += 1;
        self.last_ns = Some(record.published_ns);
    }
}

/// A trace under way to its file, which is not left half written.
struct TraceFile<'a> {
    path: &'a Path,
    encoder: TraceEncoder,
    file: BufWriter<File>,
    fault: Option<TraceFault>,
}

impl<'a> TraceFile<'a> {
    fn create(path: &'a Path, header: &TraceHeader, count: usize) -> Result<Self, TraceFault> {
        let (encoder, bytes) = TraceEncoder::new(header, count).map_err(other)?;
        let failed = |error: io::Error| FileFault::new(path, &error);
        let mut trace = Self {
            path,
            encoder,
            file: BufWriter::new(File::create(path).map_err(failed)?),
            fault: None,
        };
        trace.write(&bytes);
        Ok(trace)
    }

    /// Writes the next record, unless one before could not be written.
    fn add(&mut self, record: &TraceRecord) {
        if self.fault.is_some() {
            return;
        }
        match self.encoder.record(record) {
            Ok(bytes) => self.write(&bytes),
            Err(error) => self.fault = Some(other(error)),
        }
    }

    fn write(&mut self, bytes: &[u8]) {
        if let Err(error) = self.file.write_all(bytes) {
            self.fault = Some(FileFault::new(self.path, &error).into());
        }
    }

    fn finish(mut self) -> Result<(), TraceFault> {
        if self.fault.is_none()
            && let Err(error) = self.file.flush()
        {
            self.fault = Some(FileFault::new(self.path, &error).into());
        }
        let Some(fault) = self.fault else {
            return Ok(());
        };
        // The error that is told is the first one.
        let _left = fs::remove_file(self.path).is_err();
        Err(fault)
    }
}

fn header(result: &RunResult, crossing: &Crossing<'_>, has_delay: bool) -> TraceHeader {
    let span = result.spans.get(&crossing.from_host.name);
    let clock = if result.has_one_clock {
        "one clock"
    } else if has_delay {
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
            Way::Forward => TraceDirection::Forward,
            Way::Backward => TraceDirection::Backward,
        },
        arrival: TraceArrival::Received,
        link_change_count: 0,
        origin_ns: span.map_or(UNAVAILABLE_NS, |(start, _)| start.as_ns()),
        duration_ns: span.map_or(UNAVAILABLE_NS, |(start, end)| end.ns_since(*start)),
    }
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
