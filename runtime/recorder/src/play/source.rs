//! The messages of some topics of an MCAP file, as they lay in memory, in the order of their times.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use hil_platform::words::counted_plainly;
use hil_rundir::layout::LayoutFault;
use hil_rundir::manifest::ChannelDescription;
use mcap::records::Record;

use crate::decode::{DecodeFault, Decoder};
use crate::scan::{ScanError, scan};
use crate::schema::Schema;
use crate::topics::topic_of;

/// Why a file cannot be played into a channel.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SourceError {
    /// The file.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// Not in it.
    #[error("{}: no topic {topic}; it has {known}", path.display())]
    NoTopic {
        /// The file.
        path: PathBuf,
        /// The topic of the channel.
        topic: String,
        /// The topics it has.
        known: String,
    },
    /// The layout of the live channel.
    #[error("channel {channel}: {fault}")]
    Layout {
        /// The channel.
        channel: String,
        /// What is wrong with its layout.
        fault: LayoutFault,
    },
    /// Another message, or the same with another layout.
    #[error(
        "{}: its messages of {channel} are {found}, and that channel of the run carries {wanted}",
        path.display()
    )]
    OtherMessage {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// What the file has.
        found: String,
        /// What the channel carries.
        wanted: String,
    },
    /// One of its messages.
    #[error("{}: message {place} of topic {topic}: {fault}", path.display())]
    Message {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Its place on the topic, from 1.
        place: u64,
        /// What is wrong with it.
        fault: DecodeFault,
    },
    /// Nothing on its topics.
    #[error("{}: no message on {topics}", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// The topics.
        topics: String,
    },
}

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
    decoder: Decoder,
    schema: Schema,
    count: u64,
}

/// The channels of a run whose messages a file has, with their number, in words.
pub(crate) fn known_channels(path: &Path) -> Result<String, SourceError> {
    let mut channels: BTreeMap<u16, (String, u64)> = BTreeMap::new();
    scan(path, &mut |_, record| {
        match record {
            Record::Channel(topic) => {
                // What is made of messages names their channel, and no message.
                let is_own = topic.metadata.contains_key("message");
                let channel = topic.metadata.get("channel").filter(|_| is_own);
                if let Some(channel) = channel {
                    let known = channels.entry(topic.id);
                    known.or_insert_with(|| (channel.clone(), 0));
                }
            }
            Record::Message { header, .. } => {
                if let Some((_, count)) = channels.get_mut(&header.channel_id) {
                    *count += 1;
                }
            }
            _ => {}
        }
        true
    })?;
    let known = channels.into_values();
    let known: Vec<String> = known
        .map(|(channel, count)| format!("{channel} ({})", counted_plainly(count, "message")))
        .collect();
    Ok(if known.is_empty() {
        "no channel of a run".to_owned()
    } else {
        known.join(", ")
    })
}

/// Reads the messages of `channels`, whose layouts are those of the run they go into.
pub(crate) fn read(path: &Path, channels: &[&ChannelDescription]) -> Result<Material, SourceError> {
    let mut reading = Reading::new(path, channels)?;
    let mut fault = None;
    let end = scan(path, &mut |_, record| {
        fault = reading.visit(record).err();
        fault.is_none()
    })?;
    if let Some(fault) = fault {
        return Err(fault);
    }
    let known: Vec<String> = reading
        .topics
        .into_values()
        .map(|(topic, _)| topic)
        .collect();
    if let Some(absent) = reading
        .wanted
        .iter()
        .find(|one| !known.contains(&one.topic))
    {
        return Err(SourceError::NoTopic {
            path: path.to_owned(),
            topic: absent.topic.clone(),
            known: known.join(", "),
        });
    }
    let mut timed = reading.messages;
    timed.sort_by_key(|(at_ns, _)| *at_ns);
    let Some(first_ns) = timed.first().map(|(at_ns, _)| *at_ns) else {
        let topics = reading.wanted.iter().map(|one| one.topic.as_str());
        return Err(SourceError::Empty {
            path: path.to_owned(),
            topics: topics.collect::<Vec<_>>().join(", "),
        });
    };
    let messages = timed.into_iter().map(|(at_ns, recorded)| Recorded {
        after_ns: at_ns - first_ns,
        ..recorded
    });
    Ok(Material {
        messages: messages.collect(),
        losses: end.losses.into_iter().map(|loss| loss.why).collect(),
    })
}

struct Reading<'a> {
    path: &'a Path,
    wanted: Vec<Wanted>,
    schemas: BTreeMap<u16, (String, Vec<u8>)>,
    /// By the file's number: its topic, and which of the wanted it is.
    topics: BTreeMap<u16, (String, Option<usize>)>,
    messages: Vec<(u64, Recorded)>,
}

impl<'a> Reading<'a> {
    fn new(path: &'a Path, channels: &[&ChannelDescription]) -> Result<Self, SourceError> {
        let wanted = channels.iter().map(|channel| {
            let made = Decoder::new(&channel.message, &channel.fields, channel.size_bytes);
            let (decoder, schema) = made.map_err(|fault| SourceError::Layout {
                channel: channel.name.clone(),
                fault,
            })?;
            Ok(Wanted {
                topic: topic_of(&channel.name),
                channel: channel.name.clone(),
                decoder,
                schema,
                count: 0,
            })
        });
        Ok(Self {
            path,
            wanted: wanted.collect::<Result<_, SourceError>>()?,
            schemas: BTreeMap::new(),
            topics: BTreeMap::new(),
            messages: Vec::new(),
        })
    }

    fn visit(&mut self, record: Record<'_>) -> Result<(), SourceError> {
        match record {
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name, data.to_vec()));
            }
            Record::Channel(channel) => {
                let mut all = self.wanted.iter();
                let place = all.position(|one| one.topic == channel.topic);
                if let Some(place) = place {
                    self.check(&self.wanted[place], channel.schema_id)?;
                }
                self.topics.insert(channel.id, (channel.topic, place));
            }
            Record::Message { header, data } => {
                let Some((_, Some(place))) = self.topics.get(&header.channel_id) else {
                    return Ok(());
                };
                let wanted = &mut self.wanted[*place];
                wanted.count += 1;
                let payload = wanted.decoder.decode(&data);
                let recorded = Recorded {
                    after_ns: 0,
                    channel: *place,
                    payload: payload.map_err(|fault| SourceError::Message {
                        path: self.path.to_owned(),
                        topic: wanted.topic.clone(),
                        place: wanted.count,
                        fault,
                    })?,
                };
                self.messages.push((header.publish_time, recorded));
            }
            _ => {}
        }
        Ok(())
    }

    /// The file's schema must be the one that the live channel's layout gives.
    fn check(&self, wanted: &Wanted, schema_id: u16) -> Result<(), SourceError> {
        let schema = self.schemas.get(&schema_id);
        let name = schema.map_or("an unknown schema", |(name, _)| name.as_str());
        if schema
            .is_some_and(|(name, data)| *name == wanted.schema.name && *data == wanted.schema.data)
        {
            return Ok(());
        }
        let laid_out = if name == wanted.schema.name {
            " with other fields"
        } else {
            ""
        };
        Err(SourceError::OtherMessage {
            path: self.path.to_owned(),
            channel: wanted.channel.clone(),
            found: name.to_owned(),
            wanted: format!("{}{laid_out}", wanted.schema.name),
        })
    }
}
