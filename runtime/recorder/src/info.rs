//! What a recording holds, whole or broken: topics with counts and rates, times, what it says of
//! itself. It changes nothing.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use hil_runtime::platform::words::counted_plainly;
use hil_runtime::rundir::run_folder::utc_text;
use mcap::records::Record;
use serde::Serialize;
use std::time::{Duration, UNIX_EPOCH};

use crate::recover::loss_words;
use crate::scan::{ScanError, scan};

/// Below this a time is of a clock that began with the host, not of the calendar.
const CALENDAR_FROM_NS: u64 = 1_000_000_000 * 60 * 60 * 24 * 365 * 20;
/// Longest value that is printed whole; `--json` has the rest.
const VALUE_CHARS_MAX: usize = 100;

/// One topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Topic {
    #[serde(rename = "topic")]
    pub(crate) name: String,
    pub(crate) schema: String,
    pub(crate) encoding: String,
    pub(crate) message_count: u64,
    pub(crate) first_ns: Option<u64>,
    pub(crate) last_ns: Option<u64>,
}

/// A file beside the messages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Attached {
    pub(crate) name: String,
    pub(crate) size_bytes: u64,
}

/// A recording.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Info {
    pub(crate) size_bytes: u64,
    pub(crate) is_complete: bool,
    pub(crate) message_count: u64,
    pub(crate) topics: Vec<Topic>,
    pub(crate) metadata: BTreeMap<String, BTreeMap<String, String>>,
    pub(crate) attachments: Vec<Attached>,
    /// What could not be read, one line each.
    pub(crate) losses: Vec<String>,
}

/// Reads the file at `path` from front to back; `look` as in [`crate::recover::recover`]. `None`
/// when a signal came.
///
/// # Errors
/// When it cannot be read, or is no MCAP file.
pub(crate) fn info(
    path: &Path,
    look: &mut dyn FnMut(u64) -> Option<&'static str>,
) -> Result<Result<Info, &'static str>, ScanError> {
    let mut info = Info::default();
    let mut schemas: BTreeMap<u16, String> = BTreeMap::new();
    let mut topics: BTreeMap<u16, Topic> = BTreeMap::new();
    let mut stopped = None;
    let mut record_count = 0_u64;
    let end = scan(path, &mut |offset, record| {
        match record {
            Record::Schema { header, .. } => {
                schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                topics.entry(channel.id).or_insert_with(|| Topic {
                    schema: schemas.get(&channel.schema_id).cloned().unwrap_or_default(),
                    name: channel.topic,
                    encoding: channel.message_encoding,
                    message_count: 0,
                    first_ns: None,
                    last_ns: None,
                });
            }
            Record::Message { header, .. } => {
                info.message_count += 1;
                if let Some(topic) = topics.get_mut(&header.channel_id) {
                    let at_ns = header.log_time;
                    topic.message_count += 1;
                    topic.first_ns = Some(topic.first_ns.map_or(at_ns, |one| one.min(at_ns)));
                    topic.last_ns = topic.last_ns.max(Some(at_ns));
                }
            }
            Record::Metadata(metadata) => {
                info.metadata.insert(metadata.name, metadata.metadata);
            }
            Record::Attachment { header, data, .. } => info.attachments.push(Attached {
                name: header.name,
                size_bytes: data.len() as u64,
            }),
            _ => {}
        }
        record_count += 1;
        if record_count % 4096 == 1 {
            stopped = look(offset);
        }
        stopped.is_none()
    })?;
    if let Some(signal) = stopped {
        return Ok(Err(signal));
    }
    info.size_bytes = end.size_bytes;
    info.is_complete = end.is_complete;
    info.losses = end.losses.iter().map(loss_words).collect();
    info.topics = topics.into_values().collect();
    info.topics.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(Ok(info))
}

impl Info {
    /// The words for a person.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        let first = self.topics.iter().filter_map(|topic| topic.first_ns).min();
        let last = self.topics.iter().filter_map(|topic| topic.last_ns).max();
        let state = if self.is_complete && self.losses.is_empty() {
            "whole"
        } else {
            "NOT WHOLE; `hil-recorder recover` makes a whole file of what is there"
        };
        let mut line = |words: String| {
            text.push_str(words.trim_end());
            text.push('\n');
        };
        line(format!("{} bytes, {state}", self.size_bytes));
        let count = counted_plainly(self.message_count, "message");
        line(match first.zip(last) {
            Some((first, last)) => format!(
                "{count} in {:.3} s from {}",
                seconds(first, last),
                instant(first)
            ),
            None => count,
        });
        for loss in &self.losses {
            line(format!("lost: {loss}"));
        }
        let widths = [
            self.topics.iter().map(|one| one.name.chars().count()).max(),
            self.topics
                .iter()
                .map(|one| one.schema.chars().count())
                .max(),
        ];
        let [wide, schema_wide] = widths.map(Option::unwrap_or_default);
        line("\nmessages      rate/s  topic".to_owned());
        for one in &self.topics {
            let rate = rate(one).map_or_else(|| "-".to_owned(), |rate| format!("{rate:.1}"));
            let (count, topic, schema) = (one.message_count, shown(&one.name), &one.schema);
            line(format!(
                "{count:>8}  {rate:>10}  {topic:<wide$}  {schema:<schema_wide$}"
            ));
        }
        for (name, words) in &self.metadata {
            line(format!("\n{name}"));
            for (key, value) in words {
                line(format!("  {}: {}", shown(key), shortened(&shown(value))));
            }
        }
        if !self.attachments.is_empty() {
            line("\nattachments".to_owned());
        }
        for one in &self.attachments {
            line(format!("  {} ({} bytes)", shown(&one.name), one.size_bytes));
        }
        text
    }
}

fn seconds(from_ns: u64, to_ns: u64) -> f64 {
    to_ns.saturating_sub(from_ns) as f64 * 1e-9
}

fn rate(topic: &Topic) -> Option<f64> {
    let span_s = seconds(topic.first_ns?, topic.last_ns?);
    let step_count = topic.message_count.checked_sub(1)?;
    (span_s > 0.0).then(|| step_count as f64 / span_s)
}

fn instant(ns: u64) -> String {
    if ns < CALENDAR_FROM_NS {
        return format!("{:.3} s of a monotonic clock", ns as f64 * 1e-9);
    }
    utc_text(UNIX_EPOCH + Duration::from_nanos(ns))
}

/// Text of a file as it may go to a terminal: no control characters.
fn shown(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { '\u{fffd}' } else { c })
        .collect()
}

fn shortened(text: &str) -> String {
    let mut short: String = text.chars().take(VALUE_CHARS_MAX).collect();
    let left_out = text.chars().count().saturating_sub(VALUE_CHARS_MAX);
    if left_out > 0 {
        // Writing to a text cannot fail.
        let _is_written = write!(short, "... ({left_out} more characters)").is_ok();
    }
    short
}
