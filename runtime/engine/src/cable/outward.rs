//! What a program sends: each frame becomes a message, published when the kernel saw it leave.

use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_cable::Inlet;
use hil_core::message::ETHERNET_FRAME;
use hil_core::record::{FrameRecord, PublishedRecord};
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_rundir::pipe::{CountByName, CounterGroup, InletReport, RunStart};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder};
use hil_shm::{Domain, OutputSettings, ShmOutput};

use super::RING_RECORDS;
use super::attachment::Attachment;
use crate::gateway::kernel_clock::KernelClock;
use crate::process::recording::{output_settings, published_record};
use crate::process::worker::WorkerError;

/// What is open before the thread begins.
#[derive(Debug)]
pub(crate) struct OpenOutward {
    published: RecordSink,
    frames: RecordSink,
    /// Frames published.
    pub(crate) given: Arc<AtomicU64>,
}

impl OpenOutward {
    /// The record files of the frames on `channel`.
    ///
    /// # Errors
    /// When one cannot be made.
    pub(crate) fn new(recorder: &mut Recorder, channel: &str) -> Result<Self, RecordFileError> {
        let mut sink = |kind, size| recorder.sink(kind, channel, size, RING_RECORDS);
        Ok(Self {
            published: sink(RecordKind::Published, size_of::<PublishedRecord>())?,
            frames: sink(RecordKind::Frame, size_of::<FrameRecord>())?,
            given: Arc::default(),
        })
    }
}

/// See the module documentation.
#[derive(Debug)]
pub(crate) struct Outward {
    channel: String,
    ends: OpenOutward,
    attachment: Attachment,
    inlet: Option<Inlet>,
    /// The inlet is of a program that had begun when it was taken.
    has_program_begun: bool,
    is_flowing: bool,
    start: RunStart,
    output: ShmOutput,
    clock: KernelClock,
    lost: Lost,
}

/// Frames that became no message.
#[derive(Debug, Clone, Copy, Default)]
struct Lost {
    /// Longer than a message may be.
    too_long: u64,
    /// Found no room in the ring of an inlet that is gone.
    ring_full: u64,
    /// Sent while nobody fetched them.
    unfetched: u64,
}

impl Outward {
    /// Joins `channel`, whose frames are those of the program whose cable has `socket`. With `notifies_readers` off, whoever
    /// calls it wakes them.
    ///
    /// # Errors
    /// When the channel does not appear, or the clocks cannot be read.
    pub(crate) fn join(
        domain: &Domain,
        channel: &str,
        socket: &str,
        notifies_readers: bool,
        ends: OpenOutward,
        start: RunStart,
    ) -> Result<Self, WorkerError> {
        // The kernel's stamp of the frame is the producer's.
        let settings = OutputSettings {
            stamp: None,
            notifies_readers,
            ..output_settings()
        };
        Ok(Self {
            channel: channel.to_owned(),
            ends,
            attachment: Attachment::new(domain, socket),
            inlet: None,
            has_program_begun: false,
            is_flowing: false,
            start,
            output: ShmOutput::open(domain, channel, &ETHERNET_FRAME, settings)?,
            clock: KernelClock::read()?,
            lost: Lost::default(),
        })
    }

    /// Publishes one waiting frame; false when none waits.
    ///
    /// # Errors
    /// When the channel or the cable's end is broken.
    pub(crate) fn step(&mut self) -> Result<bool, WorkerError> {
        let Self {
            ends,
            output,
            clock,
            lost,
            ..
        } = self;
        let Some(inlet) = self.inlet.as_mut().filter(|_| self.is_flowing) else {
            self.look()?;
            return Ok(false);
        };
        let mut outcome = Ok(());
        let has_moved = inlet.next_frame(|realtime_ns, frame| {
            let left = Instant::from_ns(realtime_ns - clock.offset_ns());
            // Under load too. Not by when the frame left: after a step of the system clock that is another time.
            clock.refresh(MonotonicClock::now());
            if frame.len() > ETHERNET_FRAME.size_bytes {
                lost.too_long += 1;
                return;
            }
            outcome = output.publish(left, frame).map(|envelope| {
                ends.published.push(&published_record(&envelope));
                let record = FrameRecord::new(envelope.sequence, envelope.epoch, frame);
                ends.frames.push(&record);
                ends.given.fetch_add(1, Ordering::Relaxed);
            });
        });
        outcome?;
        if !has_moved {
            self.look()?;
        }
        Ok(has_moved)
    }

    /// Looks after clock and cable, now and then.
    fn look(&mut self) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        if !self.attachment.is_due(now) {
            return Ok(());
        }
        self.clock.refresh(now);
        if self.is_flowing {
            return self.look_for_end();
        }
        if self.inlet.is_none()
            && let Some(given) = self.attachment.ask()?
        {
            self.has_program_begun = given.has_program_begun;
            self.inlet = Some(given.into_inlet().map_err(WorkerError::Socket)?);
        }
        // What the interface said on its own before the run is no message of it.
        if let Some(inlet) = &mut self.inlet
            && self.start.get().is_some()
        {
            let discarded_count = inlet.begin().map_err(WorkerError::Socket)?;
            if self.has_program_begun {
                self.lost.unfetched += discarded_count;
                self.is_flowing = true;
            } else {
                self.is_flowing = self.attachment.begin_program();
                if !self.is_flowing {
                    self.detach()?;
                }
            }
        }
        Ok(())
    }

    fn look_for_end(&mut self) -> Result<(), WorkerError> {
        if let Some(inlet) = &self.inlet {
            inlet.clear_error();
        }
        if self.attachment.has_ended() {
            self.detach()?;
        }
        Ok(())
    }

    fn detach(&mut self) -> Result<(), WorkerError> {
        if let Some(mut inlet) = self.inlet.take() {
            let count = inlet.ring_full_count().map_err(WorkerError::Socket)?;
            self.lost.ring_full += count;
        }
        // Its process is looked for until there is another.
        self.attachment.has_ended();
        self.is_flowing = false;
        Ok(())
    }

    /// Readable while a frame waits; `None` without a program.
    pub(crate) fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        let inlet = self.inlet.as_ref().filter(|_| self.is_flowing);
        inlet.map(Inlet::descriptor)
    }

    /// When it wants another step though no frame waits; `None` while frames can come.
    pub(crate) fn next_look(&self) -> Option<Instant> {
        (!self.is_flowing).then(|| self.attachment.next_look())
    }

    /// What was lost on the way to the channel.
    pub(crate) fn report(&mut self) -> InletReport {
        let Lost {
            too_long,
            mut ring_full,
            unfetched,
        } = self.lost;
        let open = self.inlet.as_mut().map(Inlet::ring_full_count);
        ring_full += open.and_then(Result::ok).unwrap_or(0);
        let lost = [
            ("ring of the inlet full", ring_full),
            ("sent while nobody fetched them", unfetched),
            ("longer than 1522 bytes", too_long),
        ];
        InletReport {
            channel: self.channel.clone(),
            lost: CountByName::all(CounterGroup::Own, lost).collect(),
        }
    }

    /// Attempts to connect to a reader that failed.
    pub(crate) fn connection_failure_count(&self) -> u64 {
        self.output.connection_failure_count()
    }
}
