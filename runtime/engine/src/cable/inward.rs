//! The thread of what a program receives: each message is a frame that the program's interface is given. One that
//! the interface does not take counts as not taken.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::message::ETHERNET_FRAME;
use hil_core::record::TakenRecord;
use hil_net::packet_ring::FrameSender;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::{Pause, WaitMode, WaitStrategy};
use hil_rundir::launch::CableWork;
use hil_rundir::pipe::{CountByName, CounterGroup, InletReport, ProcessReport};
use hil_rundir::record::RecordSink;
use hil_shm::{Domain, ShmInput, Waiter};

use super::clear;
use crate::process::recording::forwarded_ns;
use crate::process::worker::{JobWork, WorkerError};

/// What is open before the thread begins.
#[derive(Debug)]
pub(super) struct Ends {
    pub(super) sender: FrameSender,
    pub(super) taken: RecordSink,
    /// Frames given to the program.
    pub(super) count: Arc<AtomicU64>,
}

/// See the module documentation.
#[derive(Debug)]
pub(super) struct Inward {
    channel: String,
    ends: Ends,
    input: ShmInput,
    /// `None` for a thread that spins.
    waiter: Option<Waiter>,
    wait: WaitStrategy,
    refused_count: u64,
    /// Dropped after the ports.
    _domain: Arc<Domain>,
}

impl Inward {
    pub(super) fn join(
        work: &CableWork,
        domain: Arc<Domain>,
        ends: Ends,
    ) -> Result<Self, WorkerError> {
        let channel = work.input.name.as_str();
        let waiter = (work.wait != WaitMode::Spin)
            .then(|| Waiter::open(&domain, &[channel]))
            .transpose()?;
        Ok(Self {
            channel: channel.to_owned(),
            ends,
            input: ShmInput::open(&domain, channel, &ETHERNET_FRAME, work.input.depth)?,
            waiter,
            wait: WaitStrategy::new(work.wait),
            refused_count: 0,
            _domain: domain,
        })
    }
}

impl JobWork for Inward {
    /// Gives the program one waiting frame.
    fn step(&mut self) -> Result<bool, WorkerError> {
        let Self {
            ends,
            input,
            wait,
            refused_count,
            ..
        } = self;
        let delivered = input.take(|envelope, frame| {
            // Before it is given: the program's kernel may answer within the call.
            let now = MonotonicClock::now();
            wait.on_arrival(now);
            let sent = ends.sender.send(frame);
            if sent.is_err() {
                *refused_count += 1;
                return;
            }
            ends.taken.push(&TakenRecord {
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                forwarded_ns: forwarded_ns(envelope),
                taken_ns: now.as_ns(),
                epoch: envelope.epoch,
                reserved: 0,
            });
            ends.count.fetch_add(1, Ordering::Relaxed);
        })?;
        Ok(delivered.is_some())
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        let pause = self.wait.pause(MonotonicClock::now(), None);
        if let (Pause::Sleep(until), Some(waiter)) = (pause, &mut self.waiter) {
            waiter.wait_until(Some(until))?;
        } else {
            core::hint::spin_loop();
        }
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        clear(self)
    }

    fn report(&mut self) -> ProcessReport {
        let lost = [(
            "refused by the interface of the program",
            self.refused_count,
        )];
        ProcessReport {
            inlets: vec![InletReport {
                channel: self.channel.clone(),
                lost: CountByName::all(CounterGroup::Own, lost).collect(),
            }],
            connection_failures: self.input.counters().connection_failure_count,
            ..ProcessReport::default()
        }
    }
}
