//! The messages of a run alone, for who asks for nothing else of its records.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use hil_core::run_log::{Logged, RunLog};

use super::AnalysisError;
use super::records::each_file;
use hil_rundir::record::{RecordFile, RecordKind};

/// The messages of a run, without the rest of its records.
#[derive(Debug, Default)]
pub(crate) struct MessageRecords {
    /// The messages.
    pub(crate) log: RunLog,
    /// Channels whose messages someone recorded, be it none.
    pub(crate) files: BTreeSet<String>,
    /// What could not be read.
    pub(crate) problems: Vec<String>,
}

impl MessageRecords {
    /// Reads them from a records folder; `reach` hears the share that is read.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub(crate) fn read(folder: &Path, reach: &dyn Fn(f64)) -> Result<Self, AnalysisError> {
        let mut records = Self::default();
        let wanted = |name: &str| name.contains(".message.");
        let problems = each_file(folder, &wanted, reach, &mut |path| {
            let file = RecordFile::read(path)?;
            if file.header.kind != RecordKind::Message {
                return Ok(());
            }
            let channel = &file.header.channel;
            records.files.insert(channel.clone());
            file.append_messages(&mut records.log);
            if file.truncated_bytes > 0 {
                let problem = format!("{channel}: a record file ends in half a message");
                records.problems.push(problem);
            }
            Ok(())
        })?;
        records.problems.extend(problems);
        Ok(records)
    }
}

/// Sequence numbers below the highest of each start of a producer that are not among its
/// recorded messages.
pub(crate) fn missing_count(messages: Logged<'_>) -> u64 {
    let mut next_of_epoch: BTreeMap<u32, u64> = BTreeMap::new();
    for message in messages {
        let next = next_of_epoch.entry(message.envelope.epoch).or_default();
        *next = (*next).max(message.envelope.sequence.saturating_add(1));
    }
    let given = next_of_epoch.values();
    let given_count = given.fold(0_u64, |sum, count| sum.saturating_add(*count));
    given_count.saturating_sub(messages.len() as u64)
}
