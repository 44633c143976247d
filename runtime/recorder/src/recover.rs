//! What a killed writer or a failed disk left of a recording, as a whole file again. Everything is
//! copied as it is; what could not be read is said in the file and to the caller.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use mcap::records::Record;
use mcap::{Attachment, Channel, Schema};

use crate::facts::{Words, table};
use crate::failure::Failure;
use crate::scan::{Loss, ScanEnd, scan};
use crate::sink::Sink as _;
use crate::writer::{Recording, Stamp, WriteError};
use hil_platform::words::counted_plainly;

/// What was recovered, and what was not.
#[derive(Debug, Default)]
pub(crate) struct Recovered {
    /// Messages in the new file.
    pub(crate) message_count: u64,
    /// Earliest and latest time of them, nanoseconds.
    pub(crate) ends_ns: Option<(u64, u64)>,
    /// Messages whose topic is not known, because its description was lost.
    pub(crate) homeless_count: u64,
    /// How reading ended.
    pub(crate) end: ScanEnd,
}

impl Recovered {
    /// Messages that are known to be lost; `None` when nobody counted them.
    pub(crate) fn lost_count(&self) -> Option<u64> {
        if let Some(counted) = self.end.counted {
            return Some(counted.saturating_sub(self.message_count));
        }
        let counts = self.end.losses.iter().map(|loss| loss.message_count);
        counts
            .sum::<Option<u64>>()
            .map(|lost| lost + self.homeless_count)
    }

    /// Length of what was recovered, seconds.
    pub(crate) fn span_s(&self) -> f64 {
        self.ends_ns
            .map_or(0.0, |(first, last)| (last - first) as f64 * 1e-9)
    }
}

/// Copies what can be read of `from` to a whole file `to`; `look` is asked now and then, with the
/// bytes read so far, whether a signal came.
///
/// # Errors
/// When nothing can be read or written; there is no new file then.
pub(crate) fn recover(
    from: &Path,
    to: &Path,
    look: &mut dyn FnMut(u64) -> Option<&'static str>,
) -> Result<Recovered, Failure> {
    let (recording, mut recovered) = attempt(from, Copy::new(to)?, look)?;
    if recovered.homeless_count == 0 {
        recovered.message_count = recording.finish()?;
        return Ok(recovered);
    }
    drop(recording);
    // What describes some topic was lost where it first stood; it may be there further on.
    let mut copy = Copy::new(to)?;
    let mut described = Vec::new();
    scan(from, &mut |_, record| {
        if matches!(record, Record::Schema { .. } | Record::Channel(_)) {
            described.push(record.into_owned());
        }
        true
    })?;
    for record in described {
        match copy.take(record) {
            Ok(_) | Err(WriteError::Container { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    let (recording, mut recovered) = attempt(from, copy, look)?;
    recovered.message_count = recording.finish()?;
    Ok(recovered)
}

/// One pass over the file, with the topics that `copy` knows already; the new file is not yet complete.
fn attempt(
    from: &Path,
    mut copy: Copy,
    look: &mut dyn FnMut(u64) -> Option<&'static str>,
) -> Result<(Recording, Recovered), Failure> {
    let mut conflicts = Vec::new();
    let end = scan(from, &mut |offset, record| {
        match copy.take(record) {
            Ok(lost) => conflicts.extend(lost.map(|why| Loss::new(offset, 0, why))),
            Err(WriteError::Container { source, .. }) => {
                conflicts.push(Loss::new(offset, 0, source.to_string()));
            }
            Err(error) => copy.stopped = Some(error.into()),
        }
        copy.record_count += 1;
        if copy.record_count % 4096 == 1 && copy.stopped.is_none() {
            copy.stopped = look(offset).map(|signal| {
                Failure::interrupted(format!("ended by {signal}; no file was written"))
            });
        }
        copy.stopped.is_none()
    })?;
    if let Some(stopped) = copy.stopped {
        return Err(stopped);
    }
    let mut recovered = copy.recovered;
    recovered.end = end;
    recovered.end.losses.extend(conflicts);
    let mut recording = copy.recording;
    recording.describe("hil.recovery", words(from, &recovered))?;
    Ok((recording, recovered))
}

/// What the new file says of where it comes from.
fn words(from: &Path, recovered: &Recovered) -> Words {
    let name = from.file_name().unwrap_or_default().to_string_lossy();
    let lost = recovered.lost_count();
    let lost = lost.map_or_else(|| "unknown".to_owned(), |count| count.to_string());
    let mut words = table(&[
        ("recovered_from", &name),
        ("recorder_version", &env!("CARGO_PKG_VERSION")),
        ("lost_message_count", &lost),
        ("message_count_without_topic", &recovered.homeless_count),
    ]);
    for (loss, number) in recovered.end.losses.iter().zip(1..) {
        words.insert(format!("loss_{number:04}"), loss_words(loss));
    }
    words
}

/// One loss as one line.
pub(crate) fn loss_words(loss: &Loss) -> String {
    let count = loss
        .message_count
        .map(|count| format!("; its index names {}", counted_plainly(count, "message")))
        .unwrap_or_default();
    let (offset, size, why) = (loss.offset, loss.size_bytes, &loss.why);
    format!("byte {offset}, {size} bytes: {why}{count}")
}

struct Copy {
    recording: Recording,
    schemas: BTreeMap<u16, Arc<Schema<'static>>>,
    /// Channels that are in the new file.
    channels: BTreeSet<u16>,
    recovered: Recovered,
    stopped: Option<Failure>,
    record_count: u64,
}

impl Copy {
    fn new(to: &Path) -> Result<Self, WriteError> {
        Ok(Self {
            recording: Recording::create(to)?,
            schemas: BTreeMap::new(),
            channels: BTreeSet::new(),
            recovered: Recovered::default(),
            stopped: None,
            record_count: 0,
        })
    }

    /// Copies a record; what of it was lost.
    fn take(&mut self, record: Record<'_>) -> Result<Option<String>, WriteError> {
        match record {
            Record::Schema { header, data } => {
                let schema = Schema {
                    id: header.id,
                    name: header.name,
                    encoding: header.encoding,
                    data: data.into_owned().into(),
                };
                self.schemas.insert(schema.id, Arc::new(schema));
            }
            Record::Channel(channel) => return self.channel(channel),
            Record::Message { header, data } => self.message(header, &data)?,
            Record::Metadata(metadata) => {
                self.recording.describe(&metadata.name, metadata.metadata)?;
            }
            Record::Attachment { header, data, .. } => self.recording.attach(&Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data,
            })?,
            _ => {}
        }
        Ok(None)
    }

    fn channel(&mut self, channel: mcap::records::Channel) -> Result<Option<String>, WriteError> {
        let (id, schema_id) = (channel.id, channel.schema_id);
        let schema = self.schemas.get(&schema_id).cloned();
        let is_lost = schema.is_none() && schema_id != 0;
        let why = is_lost.then(|| {
            let topic = &channel.topic;
            format!("the schema of topic {topic:?} was lost; its messages are kept without")
        });
        if !self.channels.contains(&id) {
            self.recording.copy_topic(&Channel {
                id,
                topic: channel.topic,
                schema,
                message_encoding: channel.message_encoding,
                metadata: channel.metadata,
            })?;
            self.channels.insert(id);
        }
        Ok(why)
    }

    fn message(
        &mut self,
        header: mcap::records::MessageHeader,
        data: &[u8],
    ) -> Result<(), WriteError> {
        if !self.channels.contains(&header.channel_id) {
            self.recovered.homeless_count += 1;
            return Ok(());
        }
        let at = Stamp {
            log_ns: header.log_time,
            publish_ns: header.publish_time,
            sequence: header.sequence,
        };
        self.recording.write(header.channel_id, at, data)?;
        let recovered = &mut self.recovered;
        recovered.message_count += 1;
        let at_ns = header.log_time;
        let (first, last) = recovered.ends_ns.unwrap_or((at_ns, at_ns));
        recovered.ends_ns = Some((first.min(at_ns), last.max(at_ns)));
        Ok(())
    }
}
