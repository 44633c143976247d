//! Ports that note what passes: they wrap the shared-memory ports of a component and write the
//! producer's and consumer's records of the latency account.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_models::endpoint::{InputPort, OutputPort};
use hil_models::measure::record::{PublishedRecord, TakenRecord, UNAVAILABLE};
use hil_models::message::Envelope;
use hil_models::time::Instant;

use crate::channel::{ChannelError, ShmInput, ShmOutput};
use crate::clock::MonotonicClock;
use crate::record::RecordSink;
use crate::wait::WaitStrategy;

/// A consumer's port.
#[derive(Debug)]
pub(crate) struct RecordedInput {
    pub(crate) port: ShmInput,
    pub(crate) sink: RecordSink,
    pub(crate) taken: Arc<AtomicU64>,
    pub(crate) wait: WaitStrategy,
}

impl InputPort for RecordedInput {
    type Error = ChannelError;

    fn receive(
        &mut self,
        now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, ChannelError> {
        let Self {
            port,
            sink,
            taken,
            wait,
        } = self;
        port.receive(now, &mut |envelope, payload| {
            let taken_at = MonotonicClock::now();
            wait.on_arrival(taken_at);
            sink.push(&TakenRecord {
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                forwarded_ns: forwarded_ns(envelope),
                taken_ns: taken_at.as_ns(),
                epoch: envelope.epoch,
                reserved: 0,
            });
            taken.fetch_add(1, Ordering::Relaxed);
            take(envelope, payload);
        })
    }

    fn next_arrival(&self) -> Option<Instant> {
        None
    }
}

fn forwarded_ns(envelope: &Envelope) -> i64 {
    if envelope.is_forwarded() {
        envelope.forwarded_ns
    } else {
        UNAVAILABLE
    }
}

/// A producer's port.
#[derive(Debug)]
pub(crate) struct RecordedOutput {
    pub(crate) port: ShmOutput,
    pub(crate) sink: RecordSink,
    pub(crate) messages: RecordSink,
    pub(crate) published: Arc<AtomicU64>,
}

impl OutputPort for RecordedOutput {
    type Error = ChannelError;

    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), ChannelError> {
        let envelope = self.port.publish(now, payload)?;
        self.sink.push(&PublishedRecord {
            sequence: envelope.sequence,
            published_ns: envelope.published_ns,
            epoch: envelope.epoch,
            reserved: 0,
        });
        self.messages.push_message(&envelope, payload);
        self.published.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}
