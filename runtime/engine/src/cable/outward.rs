//! The thread of what a program sends: each frame becomes a message, published when the kernel saw it leave.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_cable::Inlet;
use hil_core::message::ETHERNET_FRAME;
use hil_core::record::{FrameRecord, PublishedRecord};
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::{Pause, WaitStrategy};
use hil_rundir::launch::CableWork;
use hil_rundir::pipe::{CountByName, CounterGroup, InletReport, Orders, ProcessReport};
use hil_rundir::record::RecordSink;
use hil_shm::{Domain, OutputSettings, ShmOutput};

use super::clear;
use crate::gateway::kernel_clock::KernelClock;
use crate::gateway::poll_descriptors;
use crate::process::recording::output_settings;
use crate::process::worker::{JobWork, WorkerError};

/// What is open before the thread begins.
#[derive(Debug)]
pub(super) struct Ends {
    pub(super) inlet: Inlet,
    pub(super) published: RecordSink,
    pub(super) frames: RecordSink,
    /// Frames published.
    pub(super) given: Arc<AtomicU64>,
}

/// See the module documentation.
#[derive(Debug)]
pub(super) struct Outward {
    channels: [String; 2],
    ends: Ends,
    output: ShmOutput,
    clock: KernelClock,
    wait: WaitStrategy,
    /// Longer than a message may be.
    too_long_count: u64,
    /// Dropped after the port.
    _domain: Arc<Domain>,
}

impl Outward {
    pub(super) fn join(
        work: &CableWork,
        domain: Arc<Domain>,
        ends: Ends,
    ) -> Result<Self, WorkerError> {
        // The kernel's stamp of the frame is the producer's.
        let settings = OutputSettings {
            stamp: None,
            ..output_settings()
        };
        Ok(Self {
            channels: [work.output.name.clone(), work.input.name.clone()],
            ends,
            output: ShmOutput::open(&domain, &work.output.name, &ETHERNET_FRAME, settings)?,
            clock: KernelClock::read()?,
            wait: WaitStrategy::new(work.wait),
            too_long_count: 0,
            _domain: domain,
        })
    }
}

impl JobWork for Outward {
    /// What the interface said on its own before is no message of the run.
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        let has_started = orders.wait_for_start();
        if has_started {
            self.ends.inlet.begin().map_err(WorkerError::Socket)?;
        }
        Ok(has_started)
    }

    /// Publishes one waiting frame.
    fn step(&mut self) -> Result<bool, WorkerError> {
        let Self {
            ends,
            output,
            clock,
            wait,
            too_long_count,
            ..
        } = self;
        let Ends {
            inlet,
            published,
            frames,
            given,
            ..
        } = ends;
        let mut outcome = Ok(());
        let has_moved = inlet.next_frame(|realtime_ns, frame| {
            let left = Instant::from_ns(realtime_ns - clock.offset_ns());
            wait.on_arrival(left);
            if frame.len() > ETHERNET_FRAME.size_bytes {
                *too_long_count += 1;
                return;
            }
            outcome = output.publish(left, frame).map(|envelope| {
                published.push(&PublishedRecord {
                    sequence: envelope.sequence,
                    published_ns: envelope.published_ns,
                    epoch: envelope.epoch,
                    reserved: 0,
                });
                frames.push(&FrameRecord::new(envelope.sequence, envelope.epoch, frame));
                given.fetch_add(1, Ordering::Relaxed);
            });
        });
        outcome?;
        Ok(has_moved)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        self.clock.refresh(now);
        match self.wait.pause(now, None) {
            Pause::Spin => core::hint::spin_loop(),
            Pause::Sleep(until) => {
                let inlet = self.ends.inlet.descriptor();
                poll_descriptors(core::iter::once(inlet), until)?;
            }
        }
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        clear(self)
    }

    fn report(&mut self) -> ProcessReport {
        let [output, input] = &self.channels;
        let report = |channel: &String, counts: &[(&str, u64)]| InletReport {
            channel: channel.clone(),
            lost: CountByName::all(CounterGroup::Own, counts.iter().copied()).collect(),
        };
        let inlets = self.ends.inlet.counters().map_or_else(
            |_unknown| Vec::new(),
            |counters| {
                let outward = [
                    ("ring of the inlet full", counters.ring_full_count),
                    (
                        "dropped by the interface of the program",
                        counters.dropped_outward_count,
                    ),
                    ("longer than 1522 bytes", self.too_long_count),
                ];
                let inward = [(
                    "dropped by the interface of the program",
                    counters.dropped_inward_count,
                )];
                vec![report(output, &outward), report(input, &inward)]
            },
        );
        ProcessReport {
            inlets,
            connection_failures: self.output.connection_failure_count(),
            ..ProcessReport::default()
        }
    }
}
