//! Ports that note what passes: they wrap the shared-memory ports of a component and write the
//! producer's and consumer's records of the latency account.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::message::Envelope;
use hil_core::record::{PublishedRecord, TakenRecord, UNAVAILABLE};
use hil_core::time::Instant;

use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WaitStrategy;
use hil_rundir::record::RecordSink;
use hil_shm::{ChannelError, OutputSettings, Sequencer, ShmInput, ShmOutput};

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
            sink.push(&taken_record(envelope, taken_at));
            taken.fetch_add(1, Ordering::Relaxed);
            take(envelope, payload);
        })
    }

    fn next_arrival(&self) -> Option<Instant> {
        None
    }
}

/// What a producer notes of a message.
pub(crate) fn published_record(envelope: &Envelope) -> PublishedRecord {
    PublishedRecord {
        sequence: envelope.sequence,
        published_ns: envelope.published_ns,
        epoch: envelope.epoch,
        reserved: 0,
    }
}

/// What a consumer that took a message `at` that time notes of it.
pub(crate) fn taken_record(envelope: &Envelope, at: Instant) -> TakenRecord {
    TakenRecord {
        sequence: envelope.sequence,
        published_ns: envelope.published_ns,
        forwarded_ns: if envelope.is_forwarded() {
            envelope.forwarded_ns
        } else {
            UNAVAILABLE
        },
        taken_ns: at.as_ns(),
        epoch: envelope.epoch,
        reserved: 0,
    }
}

/// The settings of a producer that starts now: producers of one channel never start twice within a
/// microsecond on one host.
pub(crate) fn output_settings() -> OutputSettings {
    let epoch = u32::try_from(MonotonicClock::now().as_ns() / 1000 % i64::from(u32::MAX))
        .expect("the remainder is below u32::MAX");
    OutputSettings {
        epoch,
        ..OutputSettings::default()
    }
}

/// A producer's port.
#[derive(Debug)]
pub(crate) struct RecordedOutput {
    pub(crate) destination: Destination,
    pub(crate) messages: RecordSink,
    /// Messages given so far.
    pub(crate) given: Arc<AtomicU64>,
}

/// Where a producer's messages go, beside the record of the messages themselves.
#[derive(Debug)]
pub(crate) enum Destination {
    /// To a consumer; the sink keeps the producer's side of the account.
    Channel {
        port: Box<ShmOutput>,
        sink: RecordSink,
    },
    /// Nowhere.
    Record(Sequencer),
}

impl RecordedOutput {
    /// Attempts to connect to a reader that failed.
    pub(crate) fn connection_failure_count(&self) -> u64 {
        match &self.destination {
            Destination::Channel { port, .. } => port.connection_failure_count(),
            Destination::Record(_) => 0,
        }
    }
}

impl OutputPort for RecordedOutput {
    type Error = ChannelError;

    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), ChannelError> {
        let envelope = match &mut self.destination {
            Destination::Channel { port, sink } => {
                let envelope = port.publish(now, payload)?;
                sink.push(&published_record(&envelope));
                envelope
            }
            Destination::Record(sequencer) => {
                let envelope = sequencer.envelope(now);
                sequencer.advance();
                envelope
            }
        };
        self.messages.push_message(&envelope, payload);
        self.given.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::run_log::RunLog;
    use hil_rundir::record::{RecordFile, RecordKind, Recorder};
    use std::{env, fs, process};

    #[test]
    fn an_output_without_consumer_leaves_its_messages_in_the_record_and_nowhere_else() {
        let folder = env::temp_dir().join(format!("hil-recorded-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let mut recorder = Recorder::new(&folder, "robots", 0);
        let size = size_of::<Envelope>() + 8;
        let messages = recorder
            .sink(RecordKind::Message, "fleet/truth", size, 100)
            .unwrap();
        let settings = OutputSettings {
            epoch: 3,
            stamp: None,
            notifies_readers: false,
        };
        let mut output = RecordedOutput {
            destination: Destination::Record(Sequencer::new(settings)),
            messages,
            given: Arc::default(),
        };
        for value in 0..5_u8 {
            let now = Instant::from_ns(i64::from(value) * 10);
            output.send(now, &[value; 8]).unwrap();
        }
        assert_eq!(output.given.load(Ordering::Relaxed), 5);
        assert_eq!(output.connection_failure_count(), 0);
        recorder.start().unwrap();
        assert_eq!(recorder.finish().dropped_count, 0);

        let file = RecordFile::read(&folder.join("fleet.truth.message.robots.0.rec")).unwrap();
        let mut log = RunLog::default();
        file.append_messages(&mut log);
        let logged = log.raw("fleet/truth").held().unwrap();
        let envelopes: Vec<_> = logged.iter().map(|one| one.envelope).collect();
        for (sequence, envelope) in (0_u64..).zip(&envelopes) {
            assert_eq!((envelope.sequence, envelope.epoch), (sequence, 3));
            assert_eq!(u64::try_from(envelope.published_ns).unwrap(), sequence * 10);
        }
        assert_eq!(envelopes.len(), 5);
        assert_eq!(logged[4].payload, [4; 8]);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        fs::remove_dir_all(&folder).unwrap();
    }
}
