//! Where topics and their messages go. What becomes of a run is decided by those who make topics; a
//! file, or a viewer, only has to take them.

use std::collections::BTreeMap;

use crate::schema::Schema;
use crate::writer::Stamp;

/// Takes topics and messages.
pub(crate) trait Sink {
    /// Why it could not.
    type Error;

    /// A new topic; its number.
    ///
    /// # Errors
    /// When there is no room for it.
    fn add_topic(
        &mut self,
        topic: &str,
        schema: &Schema,
        metadata: &BTreeMap<String, String>,
    ) -> Result<u16, Self::Error>;

    /// False while nobody would look at a message of this topic.
    fn wants(&self, _topic: u16) -> bool {
        true
    }

    /// A message of a topic.
    ///
    /// # Errors
    /// When it cannot be taken.
    fn write(&mut self, topic: u16, at: Stamp, data: &[u8]) -> Result<(), Self::Error>;
}

/// A topic that appears with its first message.
#[derive(Debug)]
pub(crate) struct Topic {
    name: String,
    schema: Schema,
    metadata: BTreeMap<String, String>,
    number: Option<u16>,
    /// Room for one message as it is written.
    buffer: Vec<u8>,
}

impl Topic {
    /// A topic of this name, of which nobody has heard yet.
    pub(crate) fn new(name: String, schema: Schema, metadata: &[(&str, &str)]) -> Self {
        let pairs = metadata.iter();
        let pairs = pairs.map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        Self::with_metadata(name, schema, pairs.collect())
    }

    /// The same, as a sink is told of it.
    pub(crate) const fn with_metadata(
        name: String,
        schema: Schema,
        metadata: BTreeMap<String, String>,
    ) -> Self {
        Self {
            name,
            schema,
            metadata,
            number: None,
            buffer: Vec::new(),
        }
    }

    /// The next sink has not heard of it.
    pub(crate) const fn forget(&mut self) {
        self.number = None;
    }

    /// True once a sink has heard of it.
    pub(crate) const fn is_declared(&self) -> bool {
        self.number.is_some()
    }

    /// False while nobody would look at a message of it.
    pub(crate) fn is_wanted<S: Sink>(&self, sink: &S) -> bool {
        self.number.is_none_or(|number| sink.wants(number))
    }

    /// Its number in `sink`, which hears of it now if it has not before.
    pub(crate) fn declare<S: Sink>(&mut self, sink: &mut S) -> Result<u16, S::Error> {
        if let Some(number) = self.number {
            return Ok(number);
        }
        let number = sink.add_topic(&self.name, &self.schema, &self.metadata)?;
        self.number = Some(number);
        Ok(number)
    }

    /// A message of it.
    pub(crate) fn write<S: Sink>(
        &mut self,
        sink: &mut S,
        at: Stamp,
        data: &[u8],
    ) -> Result<(), S::Error> {
        let number = self.declare(sink)?;
        sink.write(number, at, data)
    }

    /// A message of it that `encode` puts into an empty buffer; false, and nothing is written, when that
    /// gives false.
    pub(crate) fn write_with<S: Sink>(
        &mut self,
        sink: &mut S,
        at: Stamp,
        encode: impl FnOnce(&mut Vec<u8>) -> bool,
    ) -> Result<bool, S::Error> {
        self.buffer.clear();
        if !encode(&mut self.buffer) {
            return Ok(false);
        }
        let number = self.declare(sink)?;
        sink.write(number, at, &self.buffer)?;
        Ok(true)
    }

    /// A protobuf message of it.
    pub(crate) fn put<S: Sink>(
        &mut self,
        sink: &mut S,
        at: Stamp,
        message: &impl prost::Message,
    ) -> Result<(), S::Error> {
        self.write_with(sink, at, |buffer| {
            message.encode_raw(buffer);
            true
        })
        .map(drop)
    }
}
