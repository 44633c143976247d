//! A channel without its Rust type, for gateways and recorders, and the byte ports under every
//! other port. The only file that uses iceoryx2's hidden interface for foreign types
//! (`CustomPayloadMarker`, `CustomHeaderMarker`, `__internal_*`, the same that its own network
//! link and its C bindings use); the tests beside it say what an upgrade broke.

use core::mem::MaybeUninit;
use core::{fmt, slice};
use std::os::fd::BorrowedFd;

use hil_core::message::{Envelope, TypeInfo};
use iceoryx2::port::LoanError;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{
    FileDescriptorBased, MessagingPattern, PortName, Service, ServiceName, ZeroCopySend, ipc,
};
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::builder::publish_subscribe::{Builder, PublishSubscribeOpenError};
use iceoryx2::service::marker::{CustomHeaderMarker, CustomPayloadMarker};
use iceoryx2::service::port_factory::{PortFactory as _, publish_subscribe};
use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};
use iceoryx2::service::static_config::publish_subscribe::StaticConfig;

use super::capacity::{BORROWED_MAX, check_room, take_room};
use super::degradation::ConnectionFailures;
use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::holder::ChannelSettings;
use super::members;
use super::wake;

/// What every channel's user header is called; changes when the envelope's layout does.
pub const ENVELOPE_TYPE_NAME: &str = "hil.Envelope.v1";

/// The envelope as iceoryx2 sees it.
#[derive(Debug, Clone, Copy, Default)]
#[repr(transparent)]
pub(crate) struct SharedEnvelope(pub(crate) Envelope);

// SAFETY: the envelope is plain old data without padding or pointers, and the name below is bound
// to its layout.
#[allow(unsafe_code, reason = "marks the envelope as fit for shared memory")]
unsafe impl ZeroCopySend for SharedEnvelope {
    // SAFETY: nothing is required of the caller; the trait marks the promise made above.
    unsafe fn type_name() -> &'static str {
        ENVELOPE_TYPE_NAME
    }
}

fn info_of(detail: &TypeDetail) -> TypeInfo {
    TypeInfo {
        name: detail.type_name().to_string(),
        size_bytes: detail.size(),
        alignment_bytes: detail.alignment(),
    }
}

fn detail_of(message: &TypeInfo, channel: &str) -> Result<TypeDetail, ChannelError> {
    if message.size_bytes == 0 || !message.alignment_bytes.is_power_of_two() {
        let reason = format_args!("{message}");
        return Err(ChannelError::refused(
            channel,
            "describe its messages",
            &reason,
        ));
    }
    let (name, size) = (&message.name, message.size_bytes);
    let variant = TypeVariant::FixedSize;
    TypeDetail::__internal_new_from_parts(variant, name, size, message.alignment_bytes)
        .map_err(|error| ChannelError::refused(channel, "name its messages", &error))
}

pub(crate) type ByteService =
    publish_subscribe::PortFactory<ipc::Service, [CustomPayloadMarker], CustomHeaderMarker>;
pub(super) type ReadService =
    publish_subscribe::PortFactory<ipc::Service, [CustomPayloadMarker], SharedEnvelope>;

pub(crate) fn service_name(channel: &str) -> Result<ServiceName, ChannelError> {
    ServiceName::new(channel)
        .map_err(|error| ChannelError::refused(channel, "use its name", &error))
}

fn envelope_detail() -> TypeDetail {
    TypeDetail::new::<SharedEnvelope>(TypeVariant::FixedSize)
}

/// A builder for samples of `message` that is not told their Rust type.
#[allow(
    unsafe_code,
    reason = "the hidden interface for foreign types is unsafe"
)]
fn byte_builder(
    domain: &Domain,
    channel: &str,
    message: &TypeInfo,
) -> Result<Builder<[CustomPayloadMarker], (), ipc::Service>, ChannelError> {
    let detail = detail_of(message, channel)?;
    let name = service_name(channel)?;
    let builder = domain
        .with_node(|node| node.service_builder(&name))
        .publish_subscribe::<[CustomPayloadMarker]>();
    // SAFETY: the detail describes a plain message of non-zero size; all ports below treat the
    // payload as exactly that many bytes.
    Ok(unsafe { builder.__internal_set_payload_type_details(&detail) })
}

/// The same with our envelope as the user header, in the form a byte-wise writer needs.
#[allow(
    unsafe_code,
    reason = "the hidden interface for foreign types is unsafe"
)]
fn writing_builder(
    domain: &Domain,
    channel: &str,
    message: &TypeInfo,
) -> Result<Builder<[CustomPayloadMarker], CustomHeaderMarker, ipc::Service>, ChannelError> {
    let builder = byte_builder(domain, channel, message)?.user_header::<CustomHeaderMarker>();
    let detail = envelope_detail();
    // SAFETY: the detail describes `Envelope`, which is what every port of ours writes and reads.
    Ok(unsafe { builder.__internal_set_user_header_type_details(&detail) })
}

/// Creates the sample service; only the launcher does.
pub(crate) fn create_samples(
    domain: &Domain,
    settings: &ChannelSettings,
    nodes_max: usize,
) -> Result<ByteService, ChannelError> {
    writing_builder(domain, &settings.name, &settings.message)?
        .enable_safe_overflow(true)
        .history_size(0)
        .subscriber_max_buffer_size(settings.depth_max)
        .subscriber_max_borrowed_samples(BORROWED_MAX)
        .max_publishers(settings.writers_max)
        .max_subscribers(settings.readers_max)
        .max_nodes(nodes_max)
        .create()
        .map_err(|error| ChannelError::refused(&settings.name, "create the channel", &error))
}

fn open_for_writing(
    domain: &Domain,
    channel: &str,
    message: &TypeInfo,
) -> Result<ByteService, ChannelError> {
    writing_builder(domain, channel, message)?
        .open()
        .map_err(|error| open_error(domain, channel, message, error))
}

pub(super) fn open_for_reading(
    domain: &Domain,
    channel: &str,
    message: &TypeInfo,
) -> Result<ReadService, ChannelError> {
    byte_builder(domain, channel, message)?
        .user_header::<SharedEnvelope>()
        .open()
        .map_err(|error| open_error(domain, channel, message, error))
}

/// What the launcher created the channel with.
fn settings_of(config: &StaticConfig, channel: &str, message: &TypeInfo) -> ChannelSettings {
    ChannelSettings {
        name: channel.to_owned(),
        message: message.clone(),
        depth_max: config.subscriber_max_buffer_size(),
        writers_max: config.max_publishers(),
        readers_max: config.max_subscribers(),
        assembled_max: 0,
    }
}

/// Says which types differ, where that is why the channel did not open.
pub(crate) fn open_error(
    domain: &Domain,
    channel: &str,
    wanted: &TypeInfo,
    error: PublishSubscribeOpenError,
) -> ChannelError {
    if error == PublishSubscribeOpenError::IncompatibleTypes {
        return match discover(domain, channel) {
            Ok(found) => ChannelError::WrongType {
                channel: channel.to_owned(),
                found: found.to_string(),
                wanted: wanted.to_string(),
            },
            Err(foreign) => foreign,
        };
    }
    ChannelError::refused(channel, "open the channel", &error)
}

/// Reads the message type from the channel itself.
pub(super) fn discover(domain: &Domain, channel: &str) -> Result<TypeInfo, ChannelError> {
    const OPERATION: &str = "read its message type";
    let name = service_name(channel)?;
    let details = ipc::Service::details(&name, domain.config(), MessagingPattern::PublishSubscribe)
        .map_err(|error| ChannelError::refused(channel, OPERATION, &error))?
        .ok_or_else(|| {
            let absent = PublishSubscribeOpenError::DoesNotExist;
            ChannelError::refused(channel, OPERATION, &absent)
        })?;
    let types = details
        .static_details
        .publish_subscribe()
        .message_type_details();
    let wanted = envelope_detail();
    if types.user_header != wanted {
        return Err(ChannelError::ForeignHeader {
            channel: channel.to_owned(),
            found: info_of(&types.user_header).to_string(),
            wanted: info_of(&wanted).to_string(),
        });
    }
    if types.payload.variant() != TypeVariant::FixedSize {
        let variant = types.payload.variant();
        return Err(ChannelError::refused(channel, OPERATION, &variant));
    }
    Ok(info_of(&types.payload))
}

/// The descriptor that becomes readable when `listener` is notified.
#[allow(unsafe_code, reason = "a descriptor is a bare number to iceoryx2")]
pub(crate) fn descriptor(listener: &Listener<ipc::Service>) -> BorrowedFd<'_> {
    // SAFETY: the number is used only for the borrow made below.
    let raw = unsafe { listener.file_descriptor().native_handle() };
    // SAFETY: the listener owns the descriptor and is borrowed for as long as the result lives.
    unsafe { BorrowedFd::borrow_raw(raw) }
}

type BytePublisher = Publisher<ipc::Service, [CustomPayloadMarker], CustomHeaderMarker>;
type ByteLoan =
    SampleMutUninit<ipc::Service, [MaybeUninit<CustomPayloadMarker>], CustomHeaderMarker>;
type Filled = SampleMut<ipc::Service, [CustomPayloadMarker], CustomHeaderMarker>;

/// Memory for one message, lent by its writer; dropped, it goes back.
struct Lent {
    memory: ByteLoan,
    /// Bytes written to it.
    written_bytes: usize,
}

impl fmt::Debug for Lent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Lent")
            .field("written_bytes", &self.written_bytes)
            .finish_non_exhaustive()
    }
}

impl Lent {
    #[allow(
        unsafe_code,
        reason = "the hidden interface for foreign types is unsafe"
    )]
    fn from(publisher: &BytePublisher) -> Result<Self, LoanError> {
        // SAFETY: one element is what a fixed-size message has.
        let memory = unsafe { publisher.loan_custom_payload(1) }?;
        Ok(Self {
            memory,
            written_bytes: 0,
        })
    }

    /// Writes `bytes` from `offset_bytes` on; false, and nothing is written, when they reach beyond the end.
    #[allow(
        unsafe_code,
        reason = "writes a message whose type is known only at run time"
    )]
    fn write(&mut self, offset_bytes: usize, bytes: &[u8]) -> bool {
        let Some(target) = self.memory.payload_mut().get_mut(offset_bytes..) else {
            return false;
        };
        if target.len() < bytes.len() {
            return false;
        }
        let target = target.as_mut_ptr().cast::<u8>();
        // SAFETY: there is room for so many, checked above, and they do not overlap as the loan is exclusively ours.
        unsafe { target.copy_from_nonoverlapping(bytes.as_ptr(), bytes.len()) };
        self.written_bytes += bytes.len();
        true
    }

    /// The message of the first `length_bytes`; what is behind them is zero.
    #[allow(
        unsafe_code,
        reason = "writes a message whose type is known only at run time"
    )]
    fn finish(mut self, length_bytes: usize, envelope: impl FnOnce() -> Envelope) -> Filled {
        let rest = &mut self.memory.payload_mut()[length_bytes..];
        let is_whole = rest.is_empty();
        // SAFETY: the marker is one byte of plain data, and the pointer is to so many of them.
        unsafe { rest.as_mut_ptr().write_bytes(0, rest.len()) };
        let header: *mut CustomHeaderMarker = self.memory.user_header_mut();
        let mut envelope = envelope();
        envelope.length_bytes = if is_whole { 0 } else { length_bytes as u64 };
        // SAFETY: the service was opened with a user header of the envelope's size and alignment,
        // and the marker reference is iceoryx2's pointer to that memory.
        unsafe { header.cast::<Envelope>().write(envelope) };
        // SAFETY: the header was written just above. Of the payload as many bytes were written as it has;
        // one that was not, because another was written twice, has the value that the file has there.
        unsafe { self.memory.assume_init() }
    }
}

const GET_MEMORY: &str = "get memory";

fn lend(publisher: &BytePublisher, channel: &str) -> Result<Lent, ChannelError> {
    Lent::from(publisher).map_err(|error| ChannelError::refused(channel, GET_MEMORY, &error))
}

/// Publishes bytes with a given envelope: the far end of a gateway.
#[derive(Debug)]
pub struct RawOutput {
    // What is lent stands before the publisher: it goes first.
    /// For the next message: lent once the last one has left rather than while the next one waits, because
    /// iceoryx2 0.10 collects returned chunks and allocates its own bookkeeping with every loan. `None` if
    /// the last attempt failed; the next message asks again.
    next: Option<Lent>,
    /// For messages in pieces, by slot; lent when the first piece comes and then as `next`.
    assembled: Box<[Option<Lent>]>,
    channel: String,
    message: TypeInfo,
    publisher: BytePublisher,
    notifier: Option<Notifier<ipc::Service>>,
    failures: ConnectionFailures,
}

impl RawOutput {
    /// Becomes the writer of `channel`, whatever it carries. With `notifies_readers` off, sleeping
    /// readers sleep on.
    ///
    /// # Errors
    /// When the channel does not appear in time, already has its writer, or has a user header
    /// that is not our envelope.
    pub fn open(
        domain: &Domain,
        channel: &str,
        notifies_readers: bool,
    ) -> Result<Self, ChannelError> {
        Self::open_assembling(domain, channel, notifies_readers, 0)
    }

    /// As [`RawOutput::open`], with memory for `slot_count` messages that come in pieces, see
    /// [`RawOutput::write_piece`].
    ///
    /// # Errors
    /// As [`RawOutput::open`].
    pub fn open_assembling(
        domain: &Domain,
        channel: &str,
        notifies_readers: bool,
        slot_count: usize,
    ) -> Result<Self, ChannelError> {
        let message = retry(domain.open_within(), || discover(domain, channel))?;
        Self::open_as(domain, channel, message, notifies_readers, slot_count)
    }

    pub(crate) fn open_as(
        domain: &Domain,
        channel: &str,
        message: TypeInfo,
        notifies_readers: bool,
        slot_count: usize,
    ) -> Result<Self, ChannelError> {
        let within = domain.open_within();
        let service = retry(within, || open_for_writing(domain, channel, &message))?;
        let settings = ChannelSettings {
            assembled_max: slot_count,
            ..settings_of(service.static_config(), channel, &message)
        };
        check_room(channel, settings.writer_room())?;
        let failures = ConnectionFailures::default();
        let publisher = retry(within, || {
            service
                .publisher_builder()
                .max_loaned_samples(settings.lent_max())
                .set_degradation_handler(failures.handler())
                .create()
                .map_err(|error| ChannelError::refused(channel, "become a writer", &error))
        })?;
        take_room(
            domain,
            channel,
            publisher.id().value(),
            settings.writer_room(),
        )?;
        let notifier = notifies_readers
            .then(|| retry(within, || wake::open_notifier(domain, channel)))
            .transpose()?;
        Ok(Self {
            channel: channel.to_owned(),
            message,
            next: Lent::from(&publisher).ok(),
            assembled: (0..slot_count).map(|_| None).collect(),
            publisher,
            notifier,
            failures,
        })
    }

    /// Attempts to connect to a reader that failed. While it grows, a reader hears nothing.
    pub fn connection_failure_count(&self) -> u64 {
        self.failures.count()
    }

    /// What the channel carries.
    pub const fn message(&self) -> &TypeInfo {
        &self.message
    }

    /// Publishes `payload` under `envelope` as it is, then wakes the readers.
    ///
    /// # Errors
    /// When the payload is not one message long (longer, where it may be shorter), or the channel is broken.
    pub fn publish(&mut self, envelope: &Envelope, payload: &[u8]) -> Result<(), ChannelError> {
        self.publish_with(payload, || *envelope)
    }

    /// As [`RawOutput::publish`], but asks for the envelope once the payload is in place, so that
    /// a stamp in it is as late as it can be.
    ///
    /// # Errors
    /// As [`RawOutput::publish`].
    pub fn publish_with(
        &mut self,
        payload: &[u8],
        envelope: impl FnOnce() -> Envelope,
    ) -> Result<(), ChannelError> {
        self.check_size(payload.len())?;
        let lent = self.next.take();
        let mut lent = lent.map_or_else(|| lend(&self.publisher, &self.channel), Ok)?;
        if !lent.write(0, payload) {
            return Err(self.wrong_size(payload.len()));
        }
        self.send(lent.finish(payload.len(), envelope))?;
        self.next = Lent::from(&self.publisher).ok();
        Ok(())
    }

    /// Writes a piece of the message in `slot`, from `offset_bytes` on, straight into the memory that
    /// [`RawOutput::publish_pieces`] publishes.
    ///
    /// # Errors
    /// When it reaches beyond the message, there is no such slot, or the channel is broken.
    pub fn write_piece(
        &mut self,
        slot: usize,
        offset_bytes: usize,
        piece: &[u8],
    ) -> Result<(), ChannelError> {
        let Some(held) = self.assembled.get_mut(slot) else {
            let error = LoanError::ExceedsMaxLoans;
            return Err(ChannelError::refused(&self.channel, GET_MEMORY, &error));
        };
        let lent = match held {
            Some(lent) => lent,
            None => held.insert(lend(&self.publisher, &self.channel)?),
        };
        if lent.write(offset_bytes, piece) {
            return Ok(());
        }
        Err(self.wrong_size(offset_bytes.saturating_add(piece.len())))
    }

    /// Begins another message in `slot`: what was written there is of none.
    pub fn discard_pieces(&mut self, slot: usize) {
        if let Some(Some(lent)) = self.assembled.get_mut(slot) {
            lent.written_bytes = 0;
        }
    }

    /// Publishes the message in `slot`, whose first `length_bytes` have been written, each once. As
    /// [`RawOutput::publish_with`] otherwise.
    ///
    /// # Errors
    /// As [`RawOutput::publish_with`]; and when another number of bytes was written. They then stay.
    pub fn publish_pieces(
        &mut self,
        slot: usize,
        length_bytes: usize,
        envelope: impl FnOnce() -> Envelope,
    ) -> Result<(), ChannelError> {
        self.check_size(length_bytes)?;
        let is_whole = |lent: &mut Lent| lent.written_bytes == length_bytes;
        let held = self.assembled.get_mut(slot);
        let whole = held.and_then(|held| held.take_if(is_whole));
        let Some(lent) = whole else {
            let lent = self.assembled.get(slot).and_then(Option::as_ref);
            return Err(ChannelError::Incomplete {
                channel: self.channel.clone(),
                written: lent.map_or(0, |lent| lent.written_bytes),
                expected: length_bytes,
            });
        };
        self.send(lent.finish(length_bytes, envelope))?;
        self.assembled[slot] = Lent::from(&self.publisher).ok();
        Ok(())
    }

    fn send(&self, message: Filled) -> Result<(), ChannelError> {
        let refused = |operation, error: &dyn fmt::Debug| {
            ChannelError::refused(&self.channel, operation, error)
        };
        message.send().map_err(|error| refused("send", &error))?;
        if let Some(notifier) = &self.notifier {
            notifier
                .notify()
                .map_err(|error| refused("wake its readers", &error))?;
        }
        Ok(())
    }

    fn check_size(&self, given: usize) -> Result<(), ChannelError> {
        let size_bytes = self.message.size_bytes;
        let is_shorter = self.message.may_be_shorter() && (1..size_bytes).contains(&given);
        if given == size_bytes || is_shorter {
            return Ok(());
        }
        Err(self.wrong_size(given))
    }

    fn wrong_size(&self, given: usize) -> ChannelError {
        ChannelError::WrongSize {
            channel: self.channel.clone(),
            given,
            expected: self.message.size_bytes,
        }
    }
}

/// Reads samples as envelope and bytes.
#[derive(Debug)]
pub(crate) struct ByteReader {
    channel: String,
    /// A message may be shorter than its memory.
    may_be_shorter: bool,
    subscriber: Subscriber<ipc::Service, [CustomPayloadMarker], SharedEnvelope>,
    failures: ConnectionFailures,
}

impl ByteReader {
    pub(crate) fn open(
        domain: &Domain,
        channel: &str,
        message: &TypeInfo,
        depth: usize,
    ) -> Result<Self, ChannelError> {
        let within = domain.open_within();
        let service = retry(within, || open_for_reading(domain, channel, message))?;
        let settings = settings_of(service.static_config(), channel, message);
        check_room(channel, settings.reader_room())?;
        let failures = ConnectionFailures::default();
        let name = if domain.with_node(members::is_observer) {
            members::observer_port_name()
        } else {
            PortName::new_empty()
        };
        let subscriber = retry(within, || {
            service
                .subscriber_builder()
                .name(&name)
                .buffer_size(depth)
                .set_degradation_handler(failures.handler())
                .create()
                .map_err(|error| ChannelError::refused(channel, "become a reader", &error))
        })?;
        subscriber
            .update_connections()
            .map_err(|error| ChannelError::refused(channel, "connect to its writers", &error))?;
        let room = settings.reader_room();
        take_room(domain, channel, subscriber.id().value(), room)?;
        Ok(Self {
            channel: channel.to_owned(),
            may_be_shorter: message.may_be_shorter(),
            subscriber,
            failures,
        })
    }

    pub(crate) fn connection_failure_count(&self) -> u64 {
        self.failures.count()
    }

    fn sample(
        &self,
    ) -> Result<Option<Sample<ipc::Service, [CustomPayloadMarker], SharedEnvelope>>, ChannelError>
    {
        let received = self.subscriber.receive();
        received.map_err(|error| ChannelError::refused(&self.channel, "receive", &error))
    }

    /// Hands the oldest waiting sample to `take`; `None` when none waits.
    #[allow(
        unsafe_code,
        reason = "reads a message whose type is known only at run time"
    )]
    pub(crate) fn receive<T>(
        &mut self,
        take: impl FnOnce(&Envelope, &[u8]) -> T,
    ) -> Result<Option<T>, ChannelError> {
        let sample = self.sample()?;
        Ok(sample.map(|sample| {
            let payload = sample.payload();
            // SAFETY: the marker is one byte of plain data, so the slice is that many bytes; the
            // writer wrote them in full before it sent, and they stay while the sample is held.
            let payload = unsafe { slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) };
            let envelope = &sample.user_header().0;
            let length = usize::try_from(envelope.length_bytes).unwrap_or(0);
            let is_shorter = self.may_be_shorter && (1..payload.len()).contains(&length);
            let payload = if is_shorter {
                &payload[..length]
            } else {
                payload
            };
            take(envelope, payload)
        }))
    }
}

/// A message that its reader keeps for a while: its memory is not given to its writer again meanwhile.
pub struct HeldMessage(Sample<ipc::Service, [CustomPayloadMarker], SharedEnvelope>);

impl HeldMessage {
    /// Its envelope.
    pub fn envelope(&self) -> Envelope {
        self.0.user_header().0
    }

    /// Its bytes.
    #[allow(
        unsafe_code,
        reason = "reads a message whose type is known only at run time"
    )]
    pub fn payload(&self) -> &[u8] {
        let payload = self.0.payload();
        // SAFETY: as in `ByteReader::receive`; the sample is held as long as this lives.
        unsafe { slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) }
    }
}

impl fmt::Debug for HeldMessage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("HeldMessage")
            .field(&self.envelope())
            .finish()
    }
}

/// Takes bytes and envelope off a channel it learns the type of: the near end of a gateway.
#[derive(Debug)]
pub struct RawInput {
    message: TypeInfo,
    reader: ByteReader,
}

impl RawInput {
    /// Becomes a reader of `channel`, whatever it carries, with room for `depth` waiting samples.
    ///
    /// # Errors
    /// When the channel does not appear in time, has all its readers, allows less depth, or has a
    /// user header that is not our envelope.
    pub fn open(domain: &Domain, channel: &str, depth: usize) -> Result<Self, ChannelError> {
        let message = retry(domain.open_within(), || discover(domain, channel))?;
        Ok(Self {
            reader: ByteReader::open(domain, channel, &message, depth)?,
            message,
        })
    }

    /// What the channel carries.
    pub const fn message(&self) -> &TypeInfo {
        &self.message
    }

    /// Attempts to connect to a writer that failed. While it grows, a writer is not heard.
    pub fn connection_failure_count(&self) -> u64 {
        self.reader.connection_failure_count()
    }

    /// The oldest waiting message, to be kept; `None` when none waits. One may be kept while others are
    /// received. As [`RawInput::receive`] otherwise.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn hold(&mut self) -> Result<Option<HeldMessage>, ChannelError> {
        Ok(self.reader.sample()?.map(HeldMessage))
    }

    /// Hands the oldest waiting sample to `take`; false when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(
        &mut self,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, ChannelError> {
        let taken = self
            .reader
            .receive(|envelope, payload| take(envelope, payload))?;
        Ok(taken.is_some())
    }
}
