//! The robot adapter: each feedback of our robot out, each command of the foreign program in. Both at
//! once: nothing is held back, and when an answer counts is decided by the robot's own cycle.

use core::time::Duration;

use bytemuck::bytes_of;
use hil_arm::egm::adapter::{RobotAdapter, RobotAdapterSettings};
use hil_arm::egm::messages::{EgmFeedback, Side};
use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::record::UNAVAILABLE;
use hil_core::time::Instant;

use super::arm::{Arm, DATAGRAM_BYTES_MAX, Work, published_here_ns, since_1970};
use super::peer::{Peer, refusals};
use crate::process::worker::WorkerError;
use hil_platform::clock::MonotonicClock;
use hil_rundir::adapter_record::AdapterSentRecord;
use hil_rundir::launch::AdapterSettings;
use hil_rundir::pipe::{CountByName, CounterGroup, RefusalCount};

/// The robot's side of one arm.
#[derive(Debug)]
pub(super) struct RobotWork {
    adapter: RobotAdapter,
    datagram: Vec<u8>,
    peer: Peer,
    /// Feedbacks of cycles without a session, in which a robot is silent.
    silent_count: u64,
    /// Feedbacks that were no message of their channel.
    malformed_count: u64,
}

impl RobotWork {
    pub(super) fn new(adapter: &AdapterSettings, side: Side) -> Self {
        Self {
            adapter: RobotAdapter::new(RobotAdapterSettings {
                side,
                axes: adapter.axes(),
                robotware: adapter.robotware(),
                cycle: Duration::from_nanos(adapter.cycle_ns),
                planned_lead: Duration::from_nanos(adapter.planned_lead_ns),
            }),
            // Room for the longest message, so that encoding never allocates.
            datagram: Vec::with_capacity(DATAGRAM_BYTES_MAX),
            peer: Peer::default(),
            silent_count: 0,
            malformed_count: 0,
        }
    }

    /// Sends the oldest waiting feedback; false when none waits.
    fn forward(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let Arm { input, line, .. } = arm;
        let mut take = |envelope: &_, payload: &[u8]| {
            let taken = MonotonicClock::now();
            let Ok(feedback) = bytemuck::try_pod_read_unaligned::<EgmFeedback>(payload) else {
                self.malformed_count += 1;
                return;
            };
            let at = since_1970(taken, line.clock.offset_ns());
            if !self.adapter.encode(&feedback, at, &mut self.datagram) {
                self.silent_count += 1;
                return;
            }
            let handed = MonotonicClock::now();
            self.peer.spoken_to(handed);
            line.send(
                &self.datagram,
                AdapterSentRecord {
                    published_ns: published_here_ns(envelope),
                    taken_ns: taken.as_ns(),
                    handed_ns: handed.as_ns(),
                    tx_software_ns: UNAVAILABLE,
                    realtime_offset_ns: 0,
                    flags: 0,
                },
            );
        };
        Ok(input.receive(Instant::ZERO, &mut take)?)
    }

    /// Publishes the command in the oldest waiting datagram; false when none waits.
    fn hear(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let Some(received) = arm.line.receive(arm.buffer.as_mut_slice())? else {
            return Ok(false);
        };
        let at = MonotonicClock::now();
        arm.wait.on_arrival(at);
        self.peer.heard(at);
        if let Ok(command) = self.adapter.decode(&arm.buffer[..received.length_bytes]) {
            arm.output.send(at, bytes_of(&command))?;
            arm.line.note_received(&received, at, MonotonicClock::now());
        }
        Ok(true)
    }
}

impl Work for RobotWork {
    fn turn(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let has_forwarded = self.forward(arm)?;
        Ok(self.hear(arm)? || has_forwarded)
    }

    fn next_due(&self) -> Option<Instant> {
        None
    }

    fn counters(&self) -> Vec<CountByName> {
        let received = self.adapter.received();
        let own = [
            ("datagrams encoded", self.adapter.sent_count()),
            ("cycles without a session", self.silent_count),
            ("sessions started", self.adapter.session_count()),
            ("datagrams received", received.total()),
            ("commands published", received.accepted()),
            ("malformed feedbacks", self.malformed_count),
        ];
        CountByName::all(CounterGroup::Own, own).collect()
    }

    fn refusals(&self) -> Vec<RefusalCount> {
        refusals(self.adapter.received()).collect()
    }

    fn peer_state(&self) -> String {
        self.peer.state()
    }
}
