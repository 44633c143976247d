//! Changes of emulated links as gateways wrote them down. It gives no orders.

use std::fs;
use std::path::Path;

use hil_core::time::Instant;
use hil_link::condition::{LinkCondition, LinkConditionRecord, OrderOutcome};

use super::record::file::RecordHeader;
use super::record::{RecordFile, RecordFileError, RecordKind};

/// Size of a record, in the header's form.
#[expect(clippy::cast_possible_truncation, reason = "56 bytes")]
const RECORD_BYTES: u32 = size_of::<LinkConditionRecord>() as u32;

/// Header of the record file of the direction called `channel`.
pub fn condition_header(channel: &str, instance: u32) -> RecordHeader {
    RecordHeader {
        kind: RecordKind::LinkCondition,
        channel: channel.to_owned(),
        record_bytes: RECORD_BYTES,
        instance,
    }
}

/// Every order to the direction called `channel` that is on record in `folder`, in the order of the
/// gateway's count.
///
/// # Errors
/// When the folder or one of its files cannot be read.
pub fn orders_on_record(
    folder: &Path,
    channel: &str,
) -> Result<Vec<LinkConditionRecord>, RecordFileError> {
    let failed = |source| RecordFileError::Io {
        path: folder.to_owned(),
        source,
    };
    let stem = condition_header(channel, 0).file_name("");
    let stem = stem.trim_end_matches(".0.rec");
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        if !entry.file_name().to_string_lossy().starts_with(stem) {
            continue;
        }
        match RecordFile::read(&entry.path()) {
            Ok(file) if file.header.channel == channel => {
                found.extend(file.records::<LinkConditionRecord>());
            }
            // Another channel's, or one that is just being made.
            Ok(_) | Err(RecordFileError::Malformed { offset: 0, .. }) => {}
            Err(error) => return Err(error),
        }
    }
    found.sort_by_key(|record| record.number);
    Ok(found)
}

/// The condition that the last of `orders` left a direction in, and from when on.
pub fn in_force(orders: &[LinkConditionRecord]) -> (LinkCondition, Option<Instant>) {
    let effective = |record: &&LinkConditionRecord| record.outcome() == Some(OrderOutcome::InForce);
    let last = orders.iter().rev().find(effective);
    let condition = last.and_then(LinkConditionRecord::condition);
    (
        condition.unwrap_or(LinkCondition::Topology),
        last.map(|record| Instant::from_ns(record.from_ns)),
    )
}
