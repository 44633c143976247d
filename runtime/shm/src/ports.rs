//! The ports of a role: typed at run time for any endpoint, at compile time for a program that
//! knows its message. Both speak the same channel. Samples as raw bytes are not here: see
//! [`raw`](super::raw).

use core::marker::PhantomData;

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::message::{Envelope, Message, MessageType, TypeInfo};
use hil_core::time::Instant;

use super::domain::Domain;
use super::error::ChannelError;
use super::raw::{ByteReader, RawOutput};
use super::sequence::{InputCounters, OutputSettings, SequenceTracker, Sequencer};

/// A role's output on a channel.
#[derive(Debug)]
pub struct ShmOutput {
    output: RawOutput,
    sequencer: Sequencer,
}

impl ShmOutput {
    /// Becomes the writer of `channel`.
    ///
    /// # Errors
    /// When the channel does not appear in time, already has its writer, or carries another type.
    pub fn open(
        domain: &Domain,
        channel: &str,
        message: &MessageType,
        settings: OutputSettings,
    ) -> Result<Self, ChannelError> {
        let message = TypeInfo::of(message);
        let output = RawOutput::open_as(domain, channel, message, settings.notifies_readers, 0)?;
        Ok(Self {
            output,
            sequencer: Sequencer::new(settings),
        })
    }

    /// Attempts to connect to a reader that failed. While it grows, a reader hears nothing.
    pub fn connection_failure_count(&self) -> u64 {
        self.output.connection_failure_count()
    }

    /// Publishes `payload` with the next sequence number and gives the envelope it got.
    ///
    /// # Errors
    /// When the payload is not one message long, or the channel is broken.
    pub fn publish(&mut self, now: Instant, payload: &[u8]) -> Result<Envelope, ChannelError> {
        let Self { output, sequencer } = self;
        let mut published = Envelope::default();
        output.publish_with(payload, || {
            published = sequencer.envelope(now);
            published
        })?;
        sequencer.advance();
        Ok(published)
    }
}

impl OutputPort for ShmOutput {
    type Error = ChannelError;

    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), ChannelError> {
        self.publish(now, payload).map(|_envelope| ())
    }
}

/// A role's input from a channel.
#[derive(Debug)]
pub struct ShmInput {
    reader: ByteReader,
    tracker: SequenceTracker,
}

impl ShmInput {
    /// Becomes a reader of `channel` with room for `depth` waiting messages; 1 keeps the newest.
    ///
    /// # Errors
    /// When the channel does not appear in time, has all its readers, allows less depth, or
    /// carries another type.
    pub fn open(
        domain: &Domain,
        channel: &str,
        message: &MessageType,
        depth: usize,
    ) -> Result<Self, ChannelError> {
        Ok(Self {
            reader: ByteReader::open(domain, channel, &TypeInfo::of(message), depth)?,
            tracker: SequenceTracker::default(),
        })
    }

    /// What `take` makes of the oldest waiting message; `None` when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn take<T>(
        &mut self,
        mut take: impl FnMut(&Envelope, &[u8]) -> T,
    ) -> Result<Option<T>, ChannelError> {
        let Self { reader, tracker } = self;
        loop {
            let taken = reader.receive(|envelope, payload| {
                tracker.accept(envelope).then(|| take(envelope, payload))
            })?;
            match taken {
                Some(None) => {}
                Some(taken) => return Ok(taken),
                None => return Ok(None),
            }
        }
    }

    /// What came and what did not.
    pub fn counters(&self) -> InputCounters {
        InputCounters {
            connection_failure_count: self.reader.connection_failure_count(),
            ..self.tracker.counters()
        }
    }
}

impl InputPort for ShmInput {
    type Error = ChannelError;

    fn receive(
        &mut self,
        _now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, ChannelError> {
        Ok(self.take(take)?.is_some())
    }

    fn next_arrival(&self) -> Option<Instant> {
        None
    }
}

/// Writes messages of one Rust type, without a role around it.
#[derive(Debug)]
pub struct TypedOutput<M: Message> {
    output: ShmOutput,
    message: PhantomData<M>,
}

impl<M: Message> TypedOutput<M> {
    /// Becomes the writer of `channel`.
    ///
    /// # Errors
    /// As [`ShmOutput::open`].
    pub fn open(
        domain: &Domain,
        channel: &str,
        settings: OutputSettings,
    ) -> Result<Self, ChannelError> {
        Ok(Self {
            output: ShmOutput::open(domain, channel, &MessageType::of::<M>(), settings)?,
            message: PhantomData,
        })
    }

    /// Attempts to connect to a reader that failed. While it grows, a reader hears nothing.
    pub fn connection_failure_count(&self) -> u64 {
        self.output.connection_failure_count()
    }

    /// Publishes `message` with the next sequence number. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken; having no reader is not an error.
    pub fn send(&mut self, now: Instant, message: M) -> Result<(), ChannelError> {
        self.output.send(now, bytemuck::bytes_of(&message))
    }
}

/// Reads messages of one Rust type, without a role around it.
#[derive(Debug)]
pub struct TypedInput<M: Message> {
    input: ShmInput,
    message: PhantomData<M>,
}

impl<M: Message> TypedInput<M> {
    /// Becomes a reader of `channel` with room for `depth` waiting messages; 1 keeps the newest.
    ///
    /// # Errors
    /// As [`ShmInput::open`].
    pub fn open(domain: &Domain, channel: &str, depth: usize) -> Result<Self, ChannelError> {
        Ok(Self {
            input: ShmInput::open(domain, channel, &MessageType::of::<M>(), depth)?,
            message: PhantomData,
        })
    }

    /// The oldest waiting message with its envelope; `None` when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(&mut self) -> Result<Option<(Envelope, M)>, ChannelError> {
        // The channel carries messages of this type and no others.
        let taken = self.input.take(|envelope, payload| {
            let message = bytemuck::try_pod_read_unaligned(payload).ok();
            message.map(|message| (*envelope, message))
        })?;
        Ok(taken.flatten())
    }

    /// What came and what did not.
    pub fn counters(&self) -> InputCounters {
        self.input.counters()
    }
}
