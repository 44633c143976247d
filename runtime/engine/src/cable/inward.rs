//! What a program receives: each message is a frame that the program's interface is given. One that the interface
//! does not take counts as not taken.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::message::ETHERNET_FRAME;
use hil_core::record::TakenRecord;
use hil_core::time::Instant;
use hil_net::packet_ring::FrameSender;
use hil_platform::clock::MonotonicClock;
use hil_rundir::pipe::{CountByName, CounterGroup, InletReport};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder};
use hil_shm::{Domain, ShmInput};

use super::RING_RECORDS;
use super::attachment::Attachment;
use crate::process::recording::taken_record;
use crate::process::worker::WorkerError;

/// What is open before the thread begins.
#[derive(Debug)]
pub(crate) struct OpenInward {
    taken: RecordSink,
    /// Frames given to the program.
    pub(crate) count: Arc<AtomicU64>,
}

impl OpenInward {
    /// The record file of the frames on `channel`.
    ///
    /// # Errors
    /// When it cannot be made.
    pub(crate) fn new(recorder: &mut Recorder, channel: &str) -> Result<Self, RecordFileError> {
        let size = size_of::<TakenRecord>();
        Ok(Self {
            taken: recorder.sink(RecordKind::Taken, channel, size, RING_RECORDS)?,
            count: Arc::default(),
        })
    }
}

/// See the module documentation.
#[derive(Debug)]
pub(crate) struct Inward {
    ends: OpenInward,
    attachment: Attachment,
    sender: Option<FrameSender>,
    /// A program was there: what comes without one now came after its end.
    had_program: bool,
    input: ShmInput,
    channel: String,
    /// Frames that the interface of the program did not take.
    refused_count: u64,
}

impl Inward {
    /// Joins `channel`, whose frames are for the program whose cable has `socket`.
    ///
    /// # Errors
    /// When the channel does not appear.
    pub(crate) fn join(
        domain: &Domain,
        channel: &str,
        socket: &str,
        depth: usize,
        ends: OpenInward,
    ) -> Result<Self, WorkerError> {
        Ok(Self {
            ends,
            attachment: Attachment::new(domain, socket),
            sender: None,
            had_program: false,
            channel: channel.to_owned(),
            refused_count: 0,
            input: ShmInput::open(domain, channel, &ETHERNET_FRAME, depth)?,
        })
    }

    /// Gives the program one waiting frame; false when none waits.
    ///
    /// # Errors
    /// When the channel is broken.
    pub(crate) fn step(&mut self) -> Result<bool, WorkerError> {
        if self.sender.is_none() && !self.had_program {
            self.look()?;
            // What waits already is to be given at once.
            return Ok(self.sender.is_some());
        }
        let Self {
            ends,
            sender,
            input,
            refused_count,
            ..
        } = self;
        let delivered = input.take(|envelope, frame| {
            // Before it is given: the program's kernel may answer within the call.
            let now = MonotonicClock::now();
            let sent = sender.as_ref().map(|sender| sender.send(frame));
            // Not taken: its fate says so.
            if !matches!(sent, Some(Ok(()))) {
                *refused_count += u64::from(sent.is_some());
                return;
            }
            ends.taken.push(&taken_record(envelope, now));
            ends.count.fetch_add(1, Ordering::Relaxed);
        })?;
        if delivered.is_none() {
            self.look()?;
        }
        Ok(delivered.is_some())
    }

    /// Looks after the cable, now and then.
    fn look(&mut self) -> Result<(), WorkerError> {
        if !self.attachment.is_due(MonotonicClock::now()) {
            return Ok(());
        }
        if self.sender.is_some() {
            if self.attachment.has_ended() {
                self.sender = None;
            }
        } else if let Some(given) = self.attachment.ask()? {
            self.sender = Some(given.into_sender());
            self.had_program = true;
        }
        Ok(())
    }

    /// When it wants another step though no message came; `None` while the program is there.
    pub(crate) fn next_look(&self) -> Option<Instant> {
        let is_absent = self.sender.is_none();
        is_absent.then(|| self.attachment.next_look())
    }

    /// What the interface of the program did not take.
    pub(crate) fn report(&self) -> InletReport {
        InletReport {
            channel: self.channel.clone(),
            lost: CountByName::all(
                CounterGroup::Own,
                [(InletReport::REFUSED, self.refused_count)],
            )
            .collect(),
        }
    }

    /// Attempts to connect to a writer that failed.
    pub(crate) fn connection_failure_count(&self) -> u64 {
        self.input.counters().connection_failure_count
    }
}
