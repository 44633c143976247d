//! We are the robot: our feedback out as the maker's robot sends it, a foreign sensor's commands
//! in. It runs no controller: what a command does, [`crate::egm::controller`] says.

use core::time::Duration;

use bytemuck::Zeroable;
use prost::Message;

use crate::egm::adapter::checks::{self, Sender};
use crate::egm::adapter::{Axes, REORDERING_MAX_MS, RobotWare};
use crate::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use crate::egm::wire::messages::{
    EgmCartesian, EgmClock, EgmEuler, EgmHeader, EgmJoints, EgmPlanned, EgmPose, EgmQuaternion,
    EgmSensor, EgmSpeedRef, EgmTimestamp, MessageType,
};
use crate::egm::wire::robot::{
    EgmMciState, EgmMotorState, EgmRapidCtrlExecState, EgmRobot, MciState, MotorState, RapidState,
};
use crate::egm::wire::{self, DatagramCounts, EXTERNAL_PLACE, Refusal, WireJoints};
use crate::yumi::arm::{Arm, SPEED_MAX_RAD_PER_S};
use crate::yumi::{Joints, Pose};

/// What a [`RobotAdapter`] is told once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RobotAdapterSettings {
    /// The arm: its kinematics gives the planned tool pose.
    pub side: Side,
    /// Joints the sensor sees and moves.
    pub axes: Axes,
    /// Form of our messages.
    pub robotware: RobotWare,
    /// The controller's cycle.
    pub cycle: Duration,
    /// How far the planned position is ahead of the measured.
    pub planned_lead: Duration,
}

/// The robot's side of one arm's sessions.
///
/// Encoding allocates nothing once the buffers have grown; decoding only for what a joint session
/// does not use (a tool speed, signals to the program), and for the error of an undecodable
/// datagram.
#[derive(Debug, Clone)]
pub struct RobotAdapter {
    settings: RobotAdapterSettings,
    arm: Arm,
    robot: EgmRobot,
    sensor: EgmSensor,
    session: Option<OpenSession>,
    /// J7 where the newest session found it; `None` before the first.
    held_rad: Option<f64>,
    session_count: u64,
    received: DatagramCounts,
    sent_count: u64,
}

#[derive(Debug, Clone, Copy)]
struct OpenSession {
    number: u32,
    next_seqno: u32,
    /// What the utilisation is computed from.
    previous_cycle_index: u64,
    previous_clock_ms: u32,
    previous_planned_rad: Joints,
}

impl OpenSession {
    /// Whether `feedback` is of this session. A robot's process that starts anew counts sessions
    /// and cycles from the start, while its clock goes on; a late feedback has the older clock.
    fn holds(&self, feedback: &EgmFeedback) -> bool {
        let behind_ms = self.previous_clock_ms.wrapping_sub(feedback.clock_ms);
        let is_late = (0..=REORDERING_MAX_MS).contains(&behind_ms.cast_signed());
        let has_restarted = feedback.cycle_index < self.previous_cycle_index && !is_late;
        self.number == feedback.session && !has_restarted
    }
}

impl RobotAdapter {
    /// A robot that has not sent anything.
    pub fn new(settings: RobotAdapterSettings) -> Self {
        let arm = match settings.side {
            Side::Right => Arm::right(),
            Side::Left => Arm::left(),
        };
        Self {
            settings,
            arm,
            robot: EgmRobot::default(),
            sensor: EgmSensor::default(),
            session: None,
            held_rad: None,
            session_count: 0,
            received: DatagramCounts::default(),
            sent_count: 0,
        }
    }

    /// Encodes the datagram of one cycle into `buffer`, if the cycle sends one: only while a
    /// session is set up, runs or ends. `at` is the time of the measurement since 1 January 1970.
    ///
    /// The number restarts at 0 with every session, by which sensors know a new one; motors are
    /// on and the program runs, as the model knows nothing else; guided motion runs while the
    /// session does. Utilisation is the speed of the planned motion, as a percentage of the speed
    /// limit of the joint nearest to its own (the maker states no formula); forces, test signals
    /// and collisions are left out, as the model has none.
    pub fn encode(&mut self, feedback: &EgmFeedback, at: Duration, buffer: &mut Vec<u8>) -> bool {
        let Some(mci) = mci_state(feedback) else {
            self.session = None;
            return false;
        };
        let (seqno, utilization) = self.advance(feedback);
        self.robot.header = Some(EgmHeader {
            seqno: Some(seqno),
            tm: Some(feedback.clock_ms),
            mtype: Some(MessageType::Data as i32),
        });
        let stamps = |at: Duration| match self.settings.robotware {
            RobotWare::Six => (Some(clock(at)), None),
            RobotWare::Seven => (Some(clock(at)), Some(time_stamp(at))),
        };
        let axes = self.settings.axes;
        let part = self.robot.feed_back.get_or_insert_default();
        fill(
            &mut part.joints,
            &mut part.external_joints,
            axes,
            &feedback.measured_rad,
        );
        part.cartesian = pose(&feedback.tool);
        (part.time, part.time_stamp) = stamps(at);

        let part = self.robot.planned.get_or_insert_default();
        fill(
            &mut part.joints,
            &mut part.external_joints,
            axes,
            &feedback.planned_rad,
        );
        part.cartesian = pose(&self.arm.tool(&feedback.planned_rad).into());
        (part.time, part.time_stamp) = stamps(at.saturating_add(self.settings.planned_lead));

        self.robot.motor_state = Some(EgmMotorState {
            state: MotorState::On as i32,
        });
        self.robot.mci_state = Some(EgmMciState { state: mci as i32 });
        self.robot.mci_convergence_met = Some(feedback.has(EgmFeedback::CONVERGED));
        let running = RapidState::Running as i32;
        self.robot.rapid_exec_state = Some(EgmRapidCtrlExecState { state: running });
        self.robot.utilization_rate = Some(utilization);
        wire::encode(&self.robot, buffer);
        self.sent_count += 1;
        true
    }

    /// Number and utilisation, percent, of this cycle's message.
    fn advance(&mut self, feedback: &EgmFeedback) -> (u32, f64) {
        let known = self.session.filter(|session| session.holds(feedback));
        if known.is_none() {
            self.session_count += 1;
            self.held_rad = Some(feedback.planned_rad[EXTERNAL_PLACE]);
        }
        // A session starts from standstill.
        let utilization = known.map_or(0.0, |session| self.utilization(&session, feedback));
        let seqno = known.map_or(0, |session| session.next_seqno);
        self.session = Some(OpenSession {
            number: feedback.session,
            next_seqno: seqno.wrapping_add(1),
            previous_cycle_index: feedback.cycle_index,
            previous_clock_ms: feedback.clock_ms,
            previous_planned_rad: feedback.planned_rad,
        });
        (seqno, utilization)
    }

    fn utilization(&self, session: &OpenSession, feedback: &EgmFeedback) -> f64 {
        let cycles = feedback
            .cycle_index
            .saturating_sub(session.previous_cycle_index)
            .max(1);
        let elapsed_s = cycles as f64 * self.settings.cycle.as_secs_f64();
        let shares = feedback
            .planned_rad
            .iter()
            .zip(&session.previous_planned_rad);
        let shares = shares.zip(&SPEED_MAX_RAD_PER_S);
        let ratio = shares
            .map(|((now, before), max)| (now - before).abs() / (elapsed_s * max))
            .fold(0.0, f64::max);
        100.0 * ratio
    }

    /// The command in a sensor's datagram.
    ///
    /// Its `frame_index` counts the datagrams taken so far, its `seqno` is the sender's (0 when it
    /// says none); a sensor's message has no time of the motion and does not say which cycle it
    /// answers. A tool pose or tool speed beside the joints is left aside, as in a joint session
    /// of the maker's. J7 of a six-axis session stays where the session found it.
    ///
    /// # Errors
    /// Why it is not taken; it is counted in [`RobotAdapter::received`].
    pub fn decode(&mut self, datagram: &[u8]) -> Result<EgmCommand, Refusal> {
        let outcome = self.judge(datagram);
        self.received.note(outcome)
    }

    fn judge(&mut self, datagram: &[u8]) -> Result<EgmCommand, Refusal> {
        let held_rad = self.held_rad.ok_or(Refusal::NoSession)?;
        recycle(&mut self.sensor);
        wire::merge(datagram, &mut self.sensor)
            .map_err(|error| checks::undecodable(error, datagram, MessageType::Correction))?;
        let header = checks::header_of(self.sensor.header.as_ref(), MessageType::Correction)?;
        let (axes, sender) = (self.settings.axes, Sender::Sensor);

        let planned = self.sensor.planned.as_ref().ok_or(Refusal::MissingJoints)?;
        let (joints, external) = (planned.joints.as_ref(), planned.external_joints.as_ref());
        let position_rad = checks::joints_of(joints, external, axes, sender, held_rad)?;
        let position_rad = checks::commanded(&position_rad.ok_or(Refusal::MissingJoints)?)?;

        let mut command = EgmCommand {
            frame_index: self.received.accepted(),
            position_rad,
            seqno: header.seqno.unwrap_or_default(),
            ..EgmCommand::zeroed()
        };
        if let Some(speed) = &self.sensor.speed_ref {
            let (joints, external) = (speed.joints.as_ref(), speed.external_joints.as_ref());
            if let Some(speed_rad_per_s) = checks::joints_of(joints, external, axes, sender, 0.0)? {
                checks::speeds(&speed_rad_per_s)?;
                command.speed_rad_per_s = speed_rad_per_s;
                command.flags |= EgmCommand::HAS_SPEED;
            }
        }
        Ok(command)
    }

    /// What became of the datagrams that came.
    pub fn received(&self) -> &DatagramCounts {
        &self.received
    }

    /// Sessions that sensors saw begin.
    pub fn session_count(&self) -> u64 {
        self.session_count
    }

    /// Datagrams encoded.
    pub fn sent_count(&self) -> u64 {
        self.sent_count
    }
}

/// What guided motion does in this state; `None` when there is no session to speak of.
fn mci_state(feedback: &EgmFeedback) -> Option<MciState> {
    match feedback.session_state()? {
        SessionState::Running => Some(MciState::Running),
        SessionState::Activating | SessionState::Stopping => Some(MciState::Stopped),
        SessionState::Idle | SessionState::Moving | SessionState::Waiting => None,
    }
}

/// Writes joints into a message that keeps its lists.
pub(super) fn fill(
    joints: &mut Option<EgmJoints>,
    external: &mut Option<EgmJoints>,
    axes: Axes,
    chain: &Joints,
) {
    let values = WireJoints::from_chain(chain);
    let list = &mut joints.get_or_insert_default().joints;
    list.clear();
    list.extend(values.robot_deg);
    if axes == Axes::Seven {
        let list = &mut external.get_or_insert_default().joints;
        list.clear();
        list.push(values.external_deg);
    }
}

/// The pose on the wire; `None` for numbers that are no pose.
fn pose(tool: &Pose) -> Option<EgmPose> {
    let isometry = tool.isometry()?;
    let [x, y, z] = tool.position_m.map(|metres| metres * 1e3);
    let rotation = isometry.rotation;
    let (about_x, about_y, about_z) = rotation.euler_angles();
    Some(EgmPose {
        pos: Some(EgmCartesian { x, y, z }),
        orient: Some(EgmQuaternion {
            u0: rotation.w,
            u1: rotation.i,
            u2: rotation.j,
            u3: rotation.k,
        }),
        euler: Some(EgmEuler {
            x: about_x.to_degrees(),
            y: about_y.to_degrees(),
            z: about_z.to_degrees(),
        }),
    })
}

fn clock(at: Duration) -> EgmClock {
    EgmClock {
        sec: at.as_secs(),
        usec: u64::from(at.subsec_micros()),
    }
}

fn time_stamp(at: Duration) -> EgmTimestamp {
    EgmTimestamp {
        sec: Some(at.as_secs()),
        nsec: Some(u64::from(at.subsec_nanos())),
    }
}

/// Clears a message but keeps its lists of joints, which are then empty instead of absent.
fn recycle(message: &mut EgmSensor) {
    let planned = emptied(message.planned.take());
    let speed = message.speed_ref.take().unwrap_or_default();
    message.clear();
    message.planned = Some(planned);
    message.speed_ref = Some(EgmSpeedRef {
        joints: Some(emptied_list(speed.joints)),
        external_joints: Some(emptied_list(speed.external_joints)),
        ..EgmSpeedRef::default()
    });
}

/// The same for a robot's message.
pub(super) fn recycle_robot(message: &mut EgmRobot) {
    let feed_back = emptied(message.feed_back.take());
    let planned = emptied(message.planned.take());
    message.clear();
    message.feed_back = Some(feed_back);
    message.planned = Some(planned);
}

fn emptied(part: Option<EgmPlanned>) -> EgmPlanned {
    let part = part.unwrap_or_default();
    EgmPlanned {
        joints: Some(emptied_list(part.joints)),
        external_joints: Some(emptied_list(part.external_joints)),
        ..EgmPlanned::default()
    }
}

fn emptied_list(list: Option<EgmJoints>) -> EgmJoints {
    let mut list = list.unwrap_or_default();
    list.joints.clear();
    list
}
