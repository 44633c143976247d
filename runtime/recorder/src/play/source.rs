//! The messages of some topics of an MCAP file, as they lay in memory, in the order of their times.

use std::collections::BTreeMap;
use std::path::Path;

use hil_platform::words::counted_plainly;
use hil_rundir::manifest::ChannelDescription;
use mcap::records::Record;

use crate::codec::Codec;
use crate::failure::Failure;
use crate::scan::{ScanEnd, Visit, scan};
use crate::schema::Schema;
use crate::topics::topic_of;

/// One recorded message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Recorded {
    /// Publication after that of the first message of all, nanoseconds.
    pub(crate) after_ns: u64,
    /// Which of the channels played.
    pub(crate) channel: usize,
    /// The message as it lies in memory.
    pub(crate) payload: Vec<u8>,
}

/// What is to be played.
#[derive(Debug)]
pub(crate) struct Material {
    /// In the order of their times.
    pub(crate) messages: Vec<Recorded>,
    /// Losses of a damaged file, in words.
    pub(crate) losses: Vec<String>,
}

struct Wanted {
    topic: String,
    channel: String,
    codec: Codec,
}

/// A topic of the file.
struct Known {
    topic: String,
    metadata: BTreeMap<String, String>,
    /// Which of the wanted it is.
    place: Option<usize>,
    /// Its messages so far.
    count: u64,
}

/// A file that cannot be read is the wrong argument here.
fn scanned(path: &Path, visit: &mut Visit<'_>) -> Result<ScanEnd, Failure> {
    scan(path, visit).map_err(Failure::usage)
}

/// The channels of a run whose messages a file has, with their number, in words.
pub(crate) fn known_channels(path: &Path) -> Result<String, Failure> {
    let mut reading = Reading::default();
    scanned(path, &mut |_, record| reading.visit(record).is_ok())?;
    // What is made of messages names their channel, and no message.
    let known = reading.topics.into_values();
    let known = known.filter(|one| one.metadata.contains_key("message"));
    let known = known.filter_map(|one| {
        let count = counted_plainly(one.count, "message");
        Some(format!("{} ({count})", one.metadata.get("channel")?))
    });
    let known: Vec<String> = known.collect();
    Ok(if known.is_empty() {
        "no channel of a run".to_owned()
    } else {
        known.join(", ")
    })
}

/// Reads the messages of `channels`, whose layouts are those of the run they go into.
pub(crate) fn read(path: &Path, channels: &[&ChannelDescription]) -> Result<Material, Failure> {
    let wanted = channels.iter().map(|channel| {
        let codec = if channel.fields.is_empty() {
            Codec::opaque(channel.size_bytes)
        } else {
            Codec::typed(&channel.message, &channel.fields, channel.size_bytes)
                .map_err(|fault| Failure::usage(format!("channel {}: {fault}", channel.name)))?
        };
        Ok(Wanted {
            topic: topic_of(&channel.name),
            channel: channel.name.clone(),
            codec,
        })
    });
    let mut reading = Reading {
        wanted: wanted.collect::<Result<_, Failure>>()?,
        ..Reading::default()
    };
    let file = path.display();
    let mut fault = None;
    let end = scanned(path, &mut |_, record| {
        fault = reading.visit(record).err();
        fault.is_none()
    })?;
    if let Some(fault) = fault {
        let words = format!("{file}: {fault}");
        return Err(Failure { words, ..fault });
    }
    let known = reading.topics.into_values().map(|one| one.topic);
    let known: Vec<String> = known.collect();
    let mut wanted = reading.wanted.iter();
    if let Some(absent) = wanted.find(|one| !known.contains(&one.topic)) {
        let (topic, known) = (&absent.topic, known.join(", "));
        return Err(Failure::usage(format!(
            "{file}: no topic {topic}; it has {known}"
        )));
    }
    let mut timed = reading.messages;
    timed.sort_by_key(|one| one.after_ns);
    let Some(first_ns) = timed.first().map(|one| one.after_ns) else {
        let topics: Vec<String> = reading.wanted.into_iter().map(|one| one.topic).collect();
        let topics = topics.join(", ");
        return Err(Failure::usage(format!("{file}: no message on {topics}")));
    };
    for one in &mut timed {
        one.after_ns -= first_ns;
    }
    Ok(Material {
        messages: timed,
        losses: end.losses.into_iter().map(|loss| loss.why).collect(),
    })
}

#[derive(Default)]
struct Reading {
    wanted: Vec<Wanted>,
    schemas: BTreeMap<u16, Schema>,
    /// By the file's number.
    topics: BTreeMap<u16, Known>,
    /// With their times on the recording's axis.
    messages: Vec<Recorded>,
}

impl Reading {
    fn visit(&mut self, record: Record<'_>) -> Result<(), Failure> {
        match record {
            Record::Schema { header, data } => {
                let (name, data) = (header.name, data.into_owned());
                self.schemas.insert(header.id, Schema { name, data });
            }
            Record::Channel(channel) => {
                let mut all = self.wanted.iter();
                let place = all.position(|one| one.topic == channel.topic);
                if let Some(place) = place {
                    self.check(&self.wanted[place], channel.schema_id)?;
                }
                self.topics.entry(channel.id).or_insert(Known {
                    topic: channel.topic,
                    metadata: channel.metadata,
                    place,
                    count: 0,
                });
            }
            Record::Message { header, data } => {
                let Some(known) = self.topics.get_mut(&header.channel_id) else {
                    return Ok(());
                };
                known.count += 1;
                let Some(place) = known.place else {
                    return Ok(());
                };
                let payload = self.wanted[place].codec.decode(&data).map_err(|fault| {
                    let Known { topic, count, .. } = known;
                    Failure::failed(format!("message {count} of topic {topic}: {fault}"))
                })?;
                self.messages.push(Recorded {
                    after_ns: header.publish_time,
                    channel: place,
                    payload,
                });
            }
            _ => {}
        }
        Ok(())
    }

    /// The file's schema must be the one that the live channel's layout gives.
    fn check(&self, wanted: &Wanted, schema_id: u16) -> Result<(), Failure> {
        let schema = self.schemas.get(&schema_id);
        if schema == Some(&wanted.codec.schema) {
            return Ok(());
        }
        let found = schema.map_or("an unknown schema", |schema| schema.name.as_str());
        let (channel, name) = (&wanted.channel, &wanted.codec.schema.name);
        let fields = if found == name {
            " with other fields"
        } else {
            ""
        };
        Err(Failure::usage(format!(
            "its messages of {channel} are {found}, and that channel of the run carries \
             {name}{fields}"
        )))
    }
}
