//! The sensor adapter: each feedback of a foreign robot in, commands of our controller out to where
//! the feedback came from. When a command goes out the protocol's policy says; see
//! `hil_arm::egm::adapter::SendPolicy`.

use bytemuck::bytes_of;
use core::time::Duration;
use hil_arm::egm::adapter::{SendPolicy, SensorAdapter, SensorAdapterSettings};
use hil_arm::egm::messages::{EgmCommand, Side};
use hil_arm::yumi::arm::{LEFT_START_RAD, RIGHT_START_RAD};
use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::record::UNAVAILABLE;
use hil_core::time::Instant;

use super::arm::{Arm, DATAGRAM_BYTES_MAX, Work, published_here_ns};
use super::peer::{Peer, refusals};
use super::robot_address::RobotAddress;
use crate::process::worker::WorkerError;
use hil_platform::clock::MonotonicClock;
use hil_rundir::adapter_record::AdapterSentRecord;
use hil_rundir::launch::AdapterSettings;
use hil_rundir::pipe::{AdapterRefusal, CountByName, CounterGroup, FromProcess, RefusalCount, say};
use hil_topology::AdapterSend;

/// A command is repeated for so long after our controller's last one, then the adapter falls silent:
/// a robot must notice that its sensor is gone. More than six frames of 125 Hz.
const COMMAND_AGE_MAX: Duration = Duration::from_millis(50);
/// Where J7 stands in chain order, the arm's third joint from the body.
const J7_PLACE: usize = 2;

/// The sensor's side of one arm.
#[derive(Debug)]
pub(super) struct SensorWork {
    adapter: SensorAdapter,
    side: Side,
    datagram: Vec<u8>,
    peer: Peer,
    robot: RobotAddress,
    withheld_count: u64,
    malformed_count: u64,
    session: u32,
    session_count: u64,
    /// The newest command: when it was published here and taken, and whether it was sent.
    newest: Option<Taken>,
}

#[derive(Debug, Clone, Copy)]
struct Taken {
    published_ns: i64,
    at: Instant,
    is_sent: bool,
}

impl SensorWork {
    pub(super) fn new(adapter: &AdapterSettings, side: Side) -> Self {
        let policy = match adapter.egm.send() {
            // Half a cycle leaves the answer in the cycle it belongs to.
            AdapterSend::Coupled => SendPolicy::Coupled {
                patience: Duration::from_nanos(adapter.cycle_ns / 2),
            },
            AdapterSend::Free { rate_hz } => SendPolicy::Free {
                period: Duration::from_secs_f64(1.0 / rate_hz),
            },
        };
        let start_rad = match side {
            Side::Right => RIGHT_START_RAD,
            Side::Left => LEFT_START_RAD,
        };
        Self {
            adapter: SensorAdapter::new(SensorAdapterSettings {
                axes: adapter.axes(),
                held_rad: start_rad[J7_PLACE],
                policy,
            }),
            side,
            // Room for the longest message, so that encoding never allocates.
            datagram: Vec::with_capacity(DATAGRAM_BYTES_MAX),
            peer: Peer::default(),
            robot: RobotAddress::new(adapter.egm.robot),
            withheld_count: 0,
            malformed_count: 0,
            session: 0,
            session_count: 0,
            newest: None,
        }
    }

    /// Publishes the feedback in the oldest waiting datagram; false when none waits.
    fn hear(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let Some(received) = arm.line.receive(arm.buffer.as_mut_slice())? else {
            return Ok(false);
        };
        let at = MonotonicClock::now();
        arm.wait.on_arrival(at);
        let heard = self.peer.last_heard();
        if !self.robot.may_speak(received.source, heard, at) {
            return Ok(true);
        }
        let bytes = &arm.buffer[..received.length_bytes];
        let Ok(feedback) = self.adapter.decode(at, bytes) else {
            return Ok(true);
        };
        self.peer.heard(at);
        if let Some(change) = self.robot.hold(received.source) {
            arm.line.answer_to(received.source);
            if let Some(former) = change.former {
                let (arm, now) = (self.side.word(), received.source);
                say(&FromProcess::Warning(format!(
                    "the robot of the {arm} arm speaks from {now} now, from {former} before"
                )));
            }
        }
        if feedback.session != self.session {
            self.session = feedback.session;
            self.session_count += 1;
        }
        arm.output.send(at, bytes_of(&feedback))?;
        arm.line.note_received(&received, at, MonotonicClock::now());
        self.withheld_count += u64::from(self.newest.is_some() && self.is_stale(at));
        Ok(true)
    }

    fn is_stale(&self, now: Instant) -> bool {
        let age = |newest: Taken| now.saturating_duration_since(newest.at);
        self.newest
            .is_none_or(|newest| age(newest) > COMMAND_AGE_MAX)
    }

    /// Takes the oldest waiting command of our controller; false when none waits.
    fn take(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let mut take = |envelope: &_, payload: &[u8]| {
            let at = MonotonicClock::now();
            let Ok(command) = bytemuck::try_pod_read_unaligned::<EgmCommand>(payload) else {
                self.malformed_count += 1;
                return;
            };
            if self.adapter.command(&command).is_ok() {
                self.newest = Some(Taken {
                    published_ns: published_here_ns(envelope),
                    at,
                    is_sent: false,
                });
            }
        };
        Ok(arm.input.receive(Instant::ZERO, &mut take)?)
    }

    /// Sends what is due.
    fn send(&mut self, arm: &mut Arm) -> bool {
        let now = MonotonicClock::now();
        if self.is_stale(now) || !self.adapter.poll_transmit(now, &mut self.datagram) {
            return false;
        }
        let Some(newest) = &mut self.newest else {
            return false;
        };
        let is_repeated = core::mem::replace(&mut newest.is_sent, true);
        let handed = MonotonicClock::now();
        self.peer.spoken_to(handed);
        arm.line.send(
            &self.datagram,
            AdapterSentRecord {
                published_ns: newest.published_ns,
                taken_ns: newest.at.as_ns(),
                handed_ns: handed.as_ns(),
                tx_software_ns: UNAVAILABLE,
                realtime_offset_ns: 0,
                flags: if is_repeated {
                    AdapterSentRecord::REPEATED
                } else {
                    0
                },
            },
        )
    }
}

impl Work for SensorWork {
    fn turn(&mut self, arm: &mut Arm) -> Result<bool, WorkerError> {
        let has_heard = self.hear(arm)?;
        let has_taken = self.take(arm)?;
        let has_sent = self.send(arm);
        Ok(has_heard || has_taken || has_sent)
    }

    fn next_due(&self) -> Option<Instant> {
        // Nothing goes out on behalf of a controller that is gone.
        let is_stale = self.is_stale(MonotonicClock::now());
        self.adapter.next_transmit().filter(|_| !is_stale)
    }

    fn counters(&self) -> Vec<CountByName> {
        let (received, commands) = (self.adapter.received(), self.adapter.commands());
        let transmit = self.adapter.transmit();
        let own = [
            (
                "datagrams received",
                received.total() + self.robot.foreign_count,
            ),
            ("feedbacks published", received.accepted()),
            ("sessions seen", self.session_count),
            ("changes of the robot's address", self.robot.change_count),
            ("commands taken", commands.total()),
            (
                "commands replaced by newer ones before they were sent",
                transmit.superseded_count,
            ),
            ("datagrams encoded", transmit.sent_count),
            ("datagrams that repeat a command", transmit.repeated_count),
            (
                "robot's messages without an answer",
                transmit.unanswered_count,
            ),
            (
                "answers withheld, no command for 50 ms",
                self.withheld_count,
            ),
            ("grid points without a datagram", transmit.skipped_count),
            ("malformed commands", self.malformed_count),
        ];
        let not_sent = commands.causes();
        let not_sent = not_sent.map(|(cause, count)| (cause.label(), count));
        CountByName::all(CounterGroup::Own, own)
            .chain(CountByName::all(CounterGroup::NotSent, not_sent))
            .collect()
    }

    fn refusals(&self) -> Vec<RefusalCount> {
        let foreign = RefusalCount {
            cause: AdapterRefusal::ForeignAddress,
            count: self.robot.foreign_count,
        };
        [foreign]
            .into_iter()
            .chain(refusals(self.adapter.received()))
            .collect()
    }

    fn peer_state(&self) -> String {
        match self.robot.held() {
            Some(address) => format!("robot at {address}: {}", self.peer.state()),
            None => "no robot came".to_owned(),
        }
    }
}
