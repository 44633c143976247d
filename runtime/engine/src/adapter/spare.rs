//! Takes the messages that the foreign protocol has no place for, such as requests to the motion
//! server or an arm the topology gives no address: recorded as taken, counted and dropped, so that
//! their channels' accounts close. It is not measured and has a thread of normal priority.

use hil_core::record::TakenRecord;

use crate::process::recording::taken_record;
use crate::process::worker::{JobWork, WorkerError};
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WAIT_MAX;
use hil_rundir::pipe::{Orders, ProcessReport};
use hil_rundir::record::{RecordKind, RecordSink, Recorder};
use hil_shm::{Domain, RawInput, Waiter};
use hil_topology::RoleChannel;

/// Records a ring holds.
const RING_RECORDS: usize = 16_384;

/// The channels that no arm serves.
#[derive(Debug)]
pub(super) struct Spare {
    channels: Vec<(RoleChannel, RecordSink)>,
}

impl Spare {
    /// Opens the record files of `channels`.
    ///
    /// # Errors
    /// When a file cannot be made.
    pub(super) fn open(
        channels: &[RoleChannel],
        recorder: &mut Recorder,
    ) -> Result<Self, WorkerError> {
        let mut opened = Vec::new();
        for channel in channels {
            let size = size_of::<TakenRecord>();
            let sink = recorder.sink(RecordKind::Taken, &channel.name, size, RING_RECORDS)?;
            opened.push((channel.clone(), sink));
        }
        Ok(Self { channels: opened })
    }

    /// Joins the channels.
    ///
    /// # Errors
    /// When a channel does not appear.
    pub(super) fn connect(self, domain: &Domain) -> Result<JoinedSpare, WorkerError> {
        let names = self.channels.iter().map(|(one, _)| one.name.as_str());
        let waiter = Waiter::open(domain, &names.collect::<Vec<_>>())?;
        let mut channels = Vec::new();
        for (channel, sink) in self.channels {
            let input = RawInput::open(domain, &channel.name, channel.depth)?;
            channels.push((input, sink));
        }
        Ok(JoinedSpare { channels, waiter })
    }
}

/// The channels that no arm serves, joined.
pub(super) struct JoinedSpare {
    channels: Vec<(RawInput, RecordSink)>,
    waiter: Waiter,
}

impl JobWork for JoinedSpare {
    /// It takes what was published before the run, too.
    fn begin(&mut self, _orders: &Orders) -> Result<bool, WorkerError> {
        Ok(true)
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        for (input, sink) in &mut self.channels {
            while input.receive(&mut |envelope, _| {
                sink.push(&taken_record(envelope, MonotonicClock::now()));
            })? {}
        }
        Ok(false)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        self.waiter.wait(WAIT_MAX)?;
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped.and_then(|()| self.step().map(|_none_left| ()))
    }

    /// What it took is in its records.
    fn report(&mut self) -> ProcessReport {
        ProcessReport::default()
    }
}
