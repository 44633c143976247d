//! The ports of a role: typed at run time for any endpoint, at compile time for a program that
//! knows its message. Both speak the same channel. Samples as raw bytes are not here: see
//! [`raw`](super::raw).

use core::fmt::Debug;
use core::mem::MaybeUninit;

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::message::{Envelope, Message, MessageType};
use hil_core::time::Instant;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{ZeroCopySend, ipc};
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::port_factory::publish_subscribe;

use super::ahead::Ahead;
use super::degradation::ConnectionFailures;
use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::raw::{self, ByteReader, RawOutput, SharedEnvelope};
use super::sequence::{InputCounters, OutputSettings, SequenceTracker, Sequencer};
use super::type_info::TypeInfo;
use super::wake;

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
        let output = RawOutput::open_as(domain, channel, message, settings.notifies_readers)?;
        Ok(Self {
            output,
            sequencer: Sequencer::new(settings),
        })
    }

    /// Messages sent since the start; also the next sequence number.
    pub const fn sent_count(&self) -> u64 {
        self.sequencer.sent_count()
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
        let Self { reader, tracker } = self;
        loop {
            let taken = reader.receive(|_, envelope, payload| {
                let is_current = tracker.accept(envelope);
                if is_current {
                    take(envelope, payload);
                }
                is_current
            })?;
            match taken {
                Some(true) => return Ok(true),
                Some(false) => {}
                None => return Ok(false),
            }
        }
    }

    fn next_arrival(&self) -> Option<Instant> {
        None
    }
}

/// A message as iceoryx2 sees it.
#[derive(Debug, Clone, Copy)]
#[repr(transparent)]
pub(crate) struct Shared<M>(M);

// SAFETY: a `Message` is `Pod`: no pointers, no padding, any bit pattern is a value, nothing to
// drop; its name stands for one layout by the contract of `Message::NAME`.
#[allow(unsafe_code, reason = "marks a message as fit for shared memory")]
unsafe impl<M: Message> ZeroCopySend for Shared<M> {
    // SAFETY: nothing is required of the caller; the trait marks the promise made above.
    unsafe fn type_name() -> &'static str {
        M::NAME
    }
}

type TypedService<M> = publish_subscribe::PortFactory<ipc::Service, Shared<M>, SharedEnvelope>;

fn open_typed<M: Message>(domain: &Domain, channel: &str) -> Result<TypedService<M>, ChannelError> {
    let name = raw::service_name(channel)?;
    let wanted = TypeInfo::of(&MessageType::of::<M>());
    retry(domain.open_within(), || {
        domain
            .with_node(|node| node.service_builder(&name))
            .publish_subscribe::<Shared<M>>()
            .user_header::<SharedEnvelope>()
            .open()
            .map_err(|error| raw::open_error(domain, channel, &wanted, error))
    })
}

type TypedLoan<M> = SampleMutUninit<ipc::Service, MaybeUninit<Shared<M>>, SharedEnvelope>;

/// Writes messages of one Rust type, without a role around it.
#[derive(Debug)]
pub struct TypedOutput<M: Message> {
    // Before the publisher: it goes first.
    next: Ahead<TypedLoan<M>>,
    channel: String,
    publisher: Publisher<ipc::Service, Shared<M>, SharedEnvelope>,
    notifier: Option<Notifier<ipc::Service>>,
    sequencer: Sequencer,
    failures: ConnectionFailures,
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
        let service = open_typed::<M>(domain, channel)?;
        let within = domain.open_within();
        let failures = ConnectionFailures::default();
        let publisher = retry(within, || {
            service
                .publisher_builder()
                .max_loaned_samples(1)
                .set_degradation_handler(failures.handler())
                .create()
                .map_err(|error| ChannelError::refused(channel, "become a writer", &error))
        })?;
        let notifier = settings
            .notifies_readers
            .then(|| retry(within, || wake::open_notifier(domain, channel)))
            .transpose()?;
        Ok(Self {
            channel: channel.to_owned(),
            next: Ahead::keep(publisher.loan_uninit()),
            publisher,
            notifier,
            sequencer: Sequencer::new(settings),
            failures,
        })
    }

    /// Attempts to connect to a reader that failed. While it grows, a reader hears nothing.
    pub fn connection_failure_count(&self) -> u64 {
        self.failures.count()
    }

    /// Publishes `message` with the next sequence number. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken; having no reader is not an error.
    pub fn send(&mut self, now: Instant, message: M) -> Result<(), ChannelError> {
        let refused =
            |operation, error: &dyn Debug| ChannelError::refused(&self.channel, operation, error);
        let memory = self
            .next
            .take(|| self.publisher.loan_uninit())
            .map_err(|error| refused("get memory", &error))?;
        let mut sample = memory.write_payload(Shared(message));
        *sample.user_header_mut() = SharedEnvelope(self.sequencer.envelope(now));
        sample.send().map_err(|error| refused("send", &error))?;
        if let Some(notifier) = &self.notifier {
            notifier
                .notify()
                .map_err(|error| refused("wake its readers", &error))?;
        }
        self.next = Ahead::keep(self.publisher.loan_uninit());
        self.sequencer.advance();
        Ok(())
    }
}

/// Reads messages of one Rust type, without a role around it.
#[derive(Debug)]
pub struct TypedInput<M: Message> {
    channel: String,
    subscriber: Subscriber<ipc::Service, Shared<M>, SharedEnvelope>,
    tracker: SequenceTracker,
    failures: ConnectionFailures,
}

impl<M: Message> TypedInput<M> {
    /// Becomes a reader of `channel` with room for `depth` waiting messages; 1 keeps the newest.
    ///
    /// # Errors
    /// As [`ShmInput::open`].
    pub fn open(domain: &Domain, channel: &str, depth: usize) -> Result<Self, ChannelError> {
        let service = open_typed::<M>(domain, channel)?;
        let failures = ConnectionFailures::default();
        let subscriber = retry(domain.open_within(), || {
            service
                .subscriber_builder()
                .buffer_size(depth)
                .set_degradation_handler(failures.handler())
                .create()
                .map_err(|error| ChannelError::refused(channel, "become a reader", &error))
        })?;
        subscriber
            .update_connections()
            .map_err(|error| ChannelError::refused(channel, "connect to its writers", &error))?;
        Ok(Self {
            channel: channel.to_owned(),
            subscriber,
            tracker: SequenceTracker::default(),
            failures,
        })
    }

    /// The oldest waiting message with its envelope; `None` when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(&mut self) -> Result<Option<(Envelope, M)>, ChannelError> {
        loop {
            let sample = self
                .subscriber
                .receive()
                .map_err(|error| ChannelError::refused(&self.channel, "receive", &error))?;
            let Some(sample) = sample else {
                return Ok(None);
            };
            let envelope = sample.user_header().0;
            if self.tracker.accept(&envelope) {
                return Ok(Some((envelope, sample.payload().0)));
            }
        }
    }

    /// What came and what did not.
    pub fn counters(&self) -> InputCounters {
        InputCounters {
            connection_failure_count: self.failures.count(),
            ..self.tracker.counters()
        }
    }
}
