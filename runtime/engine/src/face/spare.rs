//! Takes the messages that the foreign protocol has no place for, such as requests to the motion
//! server or an arm the topology gives no address: recorded as taken, counted and dropped, so that
//! their channels' accounts close. It is not measured and has a thread of normal priority.

use std::sync::Arc;
use std::thread::{self, JoinHandle};

use hil_core::message::Envelope;
use hil_core::record::{TakenRecord, UNAVAILABLE};

use super::{FaceError, Gate};
use crate::gateway::GatewayError;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WAIT_MAX;
use hil_rundir::record::{RecordKind, RecordSink, Recorder};
use hil_shm::{Domain, RawInput, Waiter};
use hil_topology::CardChannel;

/// Records a ring holds.
const RING_RECORDS: usize = 16_384;

/// The channels nobody speaks for.
#[derive(Debug)]
pub(super) struct Spare {
    channels: Vec<(CardChannel, RecordSink)>,
}

impl Spare {
    /// Opens the record files of `channels`.
    ///
    /// # Errors
    /// When a file cannot be made.
    pub(super) fn open(
        channels: &[CardChannel],
        recorder: &mut Recorder,
    ) -> Result<Self, FaceError> {
        let mut opened = Vec::new();
        for channel in channels {
            let size = size_of::<TakenRecord>();
            let sink = recorder.sink(RecordKind::Taken, &channel.name, size, RING_RECORDS)?;
            opened.push((channel.clone(), sink));
        }
        Ok(Self { channels: opened })
    }

    /// Takes their messages until the gate closes.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn spawn(
        self,
        domain: &Arc<Domain>,
        gate: &Arc<Gate>,
    ) -> Result<JoinHandle<Result<(), FaceError>>, FaceError> {
        let (domain, gate) = (Arc::clone(domain), Arc::clone(gate));
        let spawned = thread::Builder::new()
            .name("spare".to_owned())
            .spawn(move || self.take_all(&domain, &gate));
        Ok(spawned.map_err(GatewayError::Thread)?)
    }

    fn take_all(self, domain: &Domain, gate: &Gate) -> Result<(), FaceError> {
        if self.channels.is_empty() {
            return Ok(());
        }
        let names: Vec<&str> = self
            .channels
            .iter()
            .map(|(one, _)| one.name.as_str())
            .collect();
        let mut waiter = Waiter::open(domain, &names)?;
        let mut inputs = Vec::new();
        for (channel, _) in &self.channels {
            inputs.push(RawInput::open(domain, &channel.name, channel.depth)?);
        }
        let mut sinks: Vec<RecordSink> = self.channels.into_iter().map(|(_, sink)| sink).collect();
        loop {
            let is_last = gate.is_closed();
            for (input, sink) in inputs.iter_mut().zip(&mut sinks) {
                while input.receive(&mut |envelope, _| sink.push(&taken(envelope)))? {}
            }
            if is_last {
                return Ok(());
            }
            waiter.wait(WAIT_MAX)?;
        }
    }
}

fn taken(envelope: &Envelope) -> TakenRecord {
    TakenRecord {
        sequence: envelope.sequence,
        published_ns: envelope.published_ns,
        forwarded_ns: if envelope.is_forwarded() {
            envelope.forwarded_ns
        } else {
            UNAVAILABLE
        },
        taken_ns: MonotonicClock::now().as_ns(),
        epoch: envelope.epoch,
        reserved: 0,
    }
}
