//! We are the sensor: a foreign robot's feedback in, our commands out. It decides nothing about the
//! motion: our controller does.

use bytemuck::Zeroable;
use nalgebra::UnitQuaternion;

use crate::egm::adapter::Axes;
use crate::egm::adapter::checks::{self, FEEDBACK_SLACK_RAD, Sender};
use crate::egm::adapter::robot::{fill, recycle_robot};
use crate::egm::adapter::transmit::{Schedule, SendPolicy, TransmitCounts};
use crate::egm::messages::{EgmCommand, EgmFeedback, SessionState};
use crate::egm::wire::messages::{EgmHeader, EgmPose, EgmSensor, EgmSpeedRef, MessageType};
use crate::egm::wire::robot::{EgmRobot, MciState, MotorState, RapidState};
use crate::egm::wire::{self, DatagramCounts, Refusal};
use crate::yumi::{Joints, Pose};
use hil_core::time::Instant;

/// [`EgmFeedback::queue_count`] of a foreign robot: the protocol does not tell it.
pub const QUEUE_COUNT_UNKNOWN: u32 = u32::MAX;

/// By how much a robot's clock may step back for the datagram to count as reordered or repeated
/// by the network; farther back, the robot has restarted. Milliseconds.
pub const REORDERING_MAX_MS: i32 = 1000;

/// By how much a robot's clock may run ahead of its numbers within one session, milliseconds: the
/// robot's own late cycles. Farther ahead, a session ended and another began behind an outage.
pub const AHEAD_MAX_MS: u32 = 100;

/// Numbers are taken to come at least so often, milliseconds, and farther apart where the session
/// has shown that they do: ABB's cycle is 4.032 ms, and the clock counts whole milliseconds.
const CYCLE_MIN_MS: f64 = 4.2;

/// What a [`SensorAdapter`] is told once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorAdapterSettings {
    /// Joints the robot's session moves.
    pub axes: Axes,
    /// J7 of a session of six axes, rad: such a robot says nothing about it.
    pub held_rad: f64,
    /// When to send.
    pub policy: SendPolicy,
}

/// The sensor's side of one arm's sessions.
///
/// Once its lists have grown, decoding allocates only for what is not used here (test signals,
/// forces, signals of the program, torques) and for the error of an undecodable datagram; encoding
/// not at all.
#[derive(Debug, Clone)]
pub struct SensorAdapter {
    settings: SensorAdapterSettings,
    robot: EgmRobot,
    sensor: EgmSensor,
    /// Lists of the speed part while a command has none.
    spare_speed: EgmSpeedRef,
    session: Option<Session>,
    /// Of the last datagram taken.
    release: Option<wire::Release>,
    session_count: u32,
    command: Option<EgmCommand>,
    command_is_fresh: bool,
    next_seqno: u32,
    schedule: Schedule,
    received: DatagramCounts,
    commands: DatagramCounts,
    transmit: TransmitCounts,
}

/// What is remembered of the session under way.
#[derive(Debug, Clone, Copy)]
struct Session {
    first_seqno: u32,
    first_cycle_index: u64,
    start_tm: u32,
    newest_seqno: u32,
    newest_tm: u32,
    /// Which of the newest number and those before it have come, the newest in the lowest bit.
    seen: u128,
    has_run: bool,
}

impl Session {
    fn cycle_index(&self) -> u64 {
        let since_first = self.newest_seqno.saturating_sub(self.first_seqno);
        self.first_cycle_index + u64::from(since_first)
    }

    /// Fate of a message behind the newest: of an earlier session, late, or come before.
    fn late(&mut self, seqno: u32) -> Refusal {
        let behind = self.newest_seqno.checked_sub(seqno);
        let bit = behind
            .and_then(|behind| 1_u128.checked_shl(behind))
            .unwrap_or(0);
        if self.seen & bit != 0 {
            return Refusal::Repeated { seqno };
        }
        self.seen |= bit;
        Refusal::Overtaken {
            seqno,
            newest: self.newest_seqno,
        }
    }

    /// Whether a datagram of this number and clock is of a later session.
    fn is_over(&self, seqno: u32, tm: u32) -> bool {
        let behind_ms = self.newest_tm.wrapping_sub(tm).cast_signed();
        if seqno <= self.newest_seqno {
            return !(0..=REORDERING_MAX_MS).contains(&behind_ms);
        }
        let ahead_ms = -f64::from(behind_ms);
        behind_ms > REORDERING_MAX_MS || ahead_ms > self.ahead_max_ms(seqno)
    }

    /// How far the clock may have run when `seqno` follows in the same session.
    fn ahead_max_ms(&self, seqno: u32) -> f64 {
        let seen_ms = f64::from(self.newest_tm.wrapping_sub(self.start_tm));
        let seen_count = f64::from(self.newest_seqno - self.first_seqno);
        let cycle_ms = (seen_ms / seen_count.max(1.0)).max(CYCLE_MIN_MS);
        f64::from(seqno - self.newest_seqno) * cycle_ms + f64::from(AHEAD_MAX_MS)
    }
}

impl SensorAdapter {
    /// A sensor no robot has spoken to.
    ///
    /// # Panics
    /// When the period of a free sender is zero.
    pub fn new(settings: SensorAdapterSettings) -> Self {
        Self {
            settings,
            robot: EgmRobot::default(),
            sensor: EgmSensor::default(),
            spare_speed: EgmSpeedRef::default(),
            session: None,
            release: None,
            session_count: 0,
            command: None,
            command_is_fresh: false,
            next_seqno: 0,
            schedule: Schedule::new(settings.policy),
            received: DatagramCounts::default(),
            commands: DatagramCounts::default(),
            transmit: TransmitCounts::default(),
        }
    }

    /// The feedback in a robot's datagram that came at `now`.
    ///
    /// A session is told by the robot's number: it begins where the number does not grow although
    /// the robot's clock does, where that clock has stepped back by more than
    /// [`REORDERING_MAX_MS`], or where it has run on for more than [`AHEAD_MAX_MS`] longer than the
    /// numbers since the last datagram last: behind an outage the numbers of the next session may
    /// have outgrown those of the last. Commands of the last session are forgotten then: their positions
    /// belong to where that one was.
    ///
    /// What the protocol does not carry: the reference in use
    /// ([`EgmFeedback::HAS_REFERENCE`] is never set, and the age counts from the session's first
    /// datagram), the queue ([`QUEUE_COUNT_UNKNOWN`]), the causes of a limit. `cycle_index` counts
    /// the robot's numbers over all sessions, so that a lost datagram leaves a gap. The tool is in
    /// the frame the robot's program chose, and not a number where the robot sends none.
    ///
    /// # Errors
    /// Why it is not taken; it is counted in [`SensorAdapter::received`].
    pub fn decode(&mut self, now: Instant, datagram: &[u8]) -> Result<EgmFeedback, Refusal> {
        let outcome = self.judge(datagram);
        let outcome = self.received.note(outcome);
        if outcome.is_ok() {
            let has_command = self.command.is_some();
            self.schedule.received(now, has_command, &mut self.transmit);
        }
        outcome
    }

    fn judge(&mut self, datagram: &[u8]) -> Result<EgmFeedback, Refusal> {
        recycle_robot(&mut self.robot);
        wire::merge(datagram, &mut self.robot)
            .map_err(|error| checks::undecodable(error, datagram, MessageType::Data))?;
        let header = checks::header_of(self.robot.header.as_ref(), MessageType::Data)?;
        // Without number and clock nothing tells a new session from a repeated datagram.
        let (Some(seqno), Some(tm)) = (header.seqno, header.tm) else {
            return Err(Refusal::MissingHeader);
        };
        let (axes, held_rad) = (self.settings.axes, self.settings.held_rad);

        let part = self
            .robot
            .feed_back
            .as_ref()
            .ok_or(Refusal::MissingJoints)?;
        let (joints, external) = (part.joints.as_ref(), part.external_joints.as_ref());
        let measured_rad = checks::joints_of(joints, external, axes, Sender::Robot, held_rad)?;
        let tool = tool(part.cartesian.as_ref())?;

        let part = self.robot.planned.as_ref().ok_or(Refusal::MissingJoints)?;
        let (joints, external) = (part.joints.as_ref(), part.external_joints.as_ref());
        let planned_rad = checks::joints_of(joints, external, axes, Sender::Robot, held_rad)?;

        let joints = [measured_rad, planned_rad].map(|list| list.ok_or(Refusal::MissingJoints));
        let [measured_rad, planned_rad] = joints;
        let (measured_rad, planned_rad) = (measured_rad?, planned_rad?);
        checks::within_limits(&measured_rad, FEEDBACK_SLACK_RAD)?;
        checks::within_limits(&planned_rad, FEEDBACK_SLACK_RAD)?;
        let session = self.follow(seqno, tm)?;
        self.release = Some(self.robot.release());
        Ok(self.feedback(&session, [measured_rad, planned_rad], tool))
    }

    /// The session this number and clock belong to, brought up to date.
    fn follow(&mut self, seqno: u32, tm: u32) -> Result<Session, Refusal> {
        let known = self.session;
        let is_new = known.is_none_or(|session| session.is_over(seqno, tm));
        let mut session = match known {
            Some(mut session) if !is_new => {
                let behind_ms = session.newest_tm.wrapping_sub(tm).cast_signed();
                let is_older = (1..=REORDERING_MAX_MS).contains(&behind_ms);
                if is_older || seqno <= session.newest_seqno {
                    let refusal = session.late(seqno);
                    self.session = Some(session);
                    return Err(refusal);
                }
                let ahead = seqno - session.newest_seqno;
                session.seen = session.seen.checked_shl(ahead).unwrap_or(0) | 1;
                session
            }
            _ => self.open(seqno, tm),
        };
        session.newest_seqno = seqno;
        session.newest_tm = tm;
        session.has_run |= self.guided_motion() == Some(MciState::Running);
        self.session = Some(session);
        Ok(session)
    }

    fn open(&mut self, seqno: u32, tm: u32) -> Session {
        self.session_count = self.session_count.saturating_add(1);
        self.next_seqno = 0;
        if self.command.take().is_some() && self.command_is_fresh {
            self.transmit.superseded_count += 1;
        }
        self.command_is_fresh = false;
        self.schedule.forget(&mut self.transmit);
        Session {
            first_seqno: seqno,
            first_cycle_index: self.session.map_or(0, |last| last.cycle_index() + 1),
            start_tm: tm,
            newest_seqno: seqno,
            newest_tm: tm,
            seen: 1,
            has_run: false,
        }
    }

    /// What the robot says of guided motion; `None` when motors or program do not allow any.
    fn guided_motion(&self) -> Option<MciState> {
        let motors = self.robot.motor_state.map(|part| part.state());
        let program = self.robot.rapid_exec_state.map(|part| part.state());
        let is_stopped = motors != Some(MotorState::On) || program == Some(RapidState::Stopped);
        if is_stopped {
            return None;
        }
        self.robot.mci_state.map(|part| part.state())
    }

    fn feedback(&self, session: &Session, joints: [Joints; 2], tool: Pose) -> EgmFeedback {
        let state = match self.guided_motion() {
            Some(MciState::Running) => SessionState::Running,
            Some(MciState::Stopped) if session.has_run => SessionState::Stopping,
            Some(MciState::Stopped) => SessionState::Activating,
            Some(MciState::Error | MciState::Undefined) | None => SessionState::Idle,
        };
        let is_converged = self.robot.mci_convergence_met == Some(true);
        let age_ms = session.newest_tm.wrapping_sub(session.start_tm);
        let [measured_rad, planned_rad] = joints;
        EgmFeedback {
            cycle_index: session.cycle_index(),
            reference_age_ns: i64::from(age_ms) * 1_000_000,
            measured_rad,
            planned_rad,
            tool,
            clock_ms: session.newest_tm,
            seqno: session.newest_seqno,
            session: self.session_count,
            state: state as u32,
            queue_count: QUEUE_COUNT_UNKNOWN,
            flags: if is_converged {
                EgmFeedback::CONVERGED
            } else {
                0
            },
            ..EgmFeedback::zeroed()
        }
    }

    /// Takes the newest command of our controller; it replaces the one before.
    ///
    /// # Errors
    /// A command that shall reach no robot: not finite, outside the joints' limits, too fast. It
    /// is counted in [`SensorAdapter::commands`], and the one before stays.
    pub fn command(&mut self, command: &EgmCommand) -> Result<(), Refusal> {
        let has_session = self.session.is_some();
        let outcome = commanded(command, has_session);
        let command = self.commands.note(outcome)?;
        if self.command.replace(command).is_some() && self.command_is_fresh {
            self.transmit.superseded_count += 1;
        }
        self.command_is_fresh = true;
        Ok(())
    }

    /// When [`SensorAdapter::poll_transmit`] has something to send next, as far as is known now.
    pub fn next_transmit(&self) -> Option<Instant> {
        self.command.as_ref()?;
        self.schedule.due(self.command_is_fresh)
    }

    /// Encodes the datagram due at `now` into `buffer`, if one is: to be asked until it says no.
    ///
    /// Numbers count by one from 0 in each session; the sender's clock is `now` in milliseconds.
    pub fn poll_transmit(&mut self, now: Instant, buffer: &mut Vec<u8>) -> bool {
        let is_fresh = self.command.map(|_| self.command_is_fresh);
        if !self.schedule.take(now, is_fresh, &mut self.transmit) {
            return false;
        }
        let Some(command) = self.command else {
            return false;
        };
        self.encode(now, &command, buffer);
        self.transmit.sent_count += 1;
        self.transmit.repeated_count += u64::from(!self.command_is_fresh);
        self.command_is_fresh = false;
        true
    }

    fn encode(&mut self, now: Instant, command: &EgmCommand, buffer: &mut Vec<u8>) {
        let axes = self.settings.axes;
        self.sensor.header = Some(EgmHeader {
            seqno: Some(self.next_seqno),
            tm: Some(wrapped_ms(now)),
            mtype: Some(MessageType::Correction as i32),
        });
        self.next_seqno = self.next_seqno.wrapping_add(1);
        let planned = self.sensor.planned.get_or_insert_default();
        fill(
            &mut planned.joints,
            &mut planned.external_joints,
            axes,
            &command.position_rad,
        );
        if command.flags & EgmCommand::HAS_SPEED != 0 {
            let mut part = core::mem::take(&mut self.spare_speed);
            fill(
                &mut part.joints,
                &mut part.external_joints,
                axes,
                &command.speed_rad_per_s,
            );
            self.sensor.speed_ref = Some(part);
        }
        wire::encode(&self.sensor, buffer);
        if let Some(part) = self.sensor.speed_ref.take() {
            self.spare_speed = part;
        }
    }

    /// What became of the robot's datagrams.
    pub fn received(&self) -> &DatagramCounts {
        &self.received
    }

    /// What became of our controller's commands before sending.
    pub fn commands(&self) -> &DatagramCounts {
        &self.commands
    }

    /// What became of the sending.
    pub fn transmit(&self) -> &TransmitCounts {
        &self.transmit
    }

    /// The robot's release as the last datagram that was taken tells it; `None` before the first.
    pub fn release(&self) -> Option<wire::Release> {
        self.release
    }
}

/// A command that may reach a robot.
fn commanded(command: &EgmCommand, has_session: bool) -> Result<EgmCommand, Refusal> {
    if !has_session {
        return Err(Refusal::NoSession);
    }
    let position_rad = checks::commanded(&command.position_rad)?;
    if command.flags & EgmCommand::HAS_SPEED != 0 {
        checks::speeds(&command.speed_rad_per_s)?;
    }
    Ok(EgmCommand {
        position_rad,
        ..*command
    })
}

fn wrapped_ms(now: Instant) -> u32 {
    let ms = now.as_ns().div_euclid(1_000_000).rem_euclid(1 << 32);
    u32::try_from(ms).expect("a remainder by 2^32 is below it")
}

/// The tool as the robot reports it; not a number where it reports none.
fn tool(cartesian: Option<&EgmPose>) -> Result<Pose, Refusal> {
    const NOT_FINITE: Refusal = Refusal::NotFinite { joint: 0 };
    let mut tool = Pose {
        position_m: [f64::NAN; 3],
        quaternion_wxyz: [f64::NAN; 4],
    };
    let Some(pose) = cartesian else {
        return Ok(tool);
    };
    if let Some(pos) = &pose.pos {
        tool.position_m = [pos.x, pos.y, pos.z].map(|mm| mm * 1e-3);
        if !tool.position_m.iter().all(|value| value.is_finite()) {
            return Err(NOT_FINITE);
        }
    }
    if let Some(orient) = &pose.orient {
        tool.quaternion_wxyz = [orient.u0, orient.u1, orient.u2, orient.u3];
    } else if let Some(euler) = &pose.euler {
        let [x, y, z] = [euler.x, euler.y, euler.z].map(f64::to_radians);
        let turned = UnitQuaternion::from_euler_angles(x, y, z);
        tool.quaternion_wxyz = [turned.w, turned.i, turned.j, turned.k];
    } else {
        return Ok(tool);
    }
    if tool.quaternion_wxyz.iter().all(|value| value.is_finite()) {
        Ok(tool)
    } else {
        Err(NOT_FINITE)
    }
}
