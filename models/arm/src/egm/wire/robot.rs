//! The robot's message, in the forms of `RobotWare` 6 and 7, and how to tell them apart. Layout only.

use prost::bytes::{Buf, BufMut};
use prost::encoding::{self, DecodeContext, WireType};
use prost::{DecodeError, Message};

use crate::egm::wire::messages::{EgmFeedBack, EgmHeader, EgmJoints, EgmPlanned, EgmRapidData};

/// From the robot to the sensor, every cycle of a session.
///
/// One type serves both releases: what only `RobotWare` 7 has is optional and absent before, and
/// [`EgmMeasuredForce`], the one message that changed, knows both its forms.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmRobot {
    /// Header; its type is [`MessageType::Data`](crate::egm::wire::MessageType::Data).
    #[prost(message, optional, tag = "1")]
    pub header: Option<EgmHeader>,
    /// Measured position.
    #[prost(message, optional, tag = "2")]
    pub feed_back: Option<EgmFeedBack>,
    /// Planned position.
    #[prost(message, optional, tag = "3")]
    pub planned: Option<EgmPlanned>,
    /// Motors.
    #[prost(message, optional, tag = "4")]
    pub motor_state: Option<EgmMotorState>,
    /// Guided motion.
    #[prost(message, optional, tag = "5")]
    pub mci_state: Option<EgmMciState>,
    /// Every joint is within the convergence window of its order.
    #[prost(bool, optional, tag = "6")]
    pub mci_convergence_met: Option<bool>,
    /// Test signals.
    #[prost(message, optional, tag = "7")]
    pub test_signals: Option<EgmTestSignals>,
    /// The controller's program.
    #[prost(message, optional, tag = "8")]
    pub rapid_exec_state: Option<EgmRapidCtrlExecState>,
    /// Forces.
    #[prost(message, optional, tag = "9")]
    pub measured_force: Option<EgmMeasuredForce>,
    /// How much of what the robot can do the motion uses; since `RobotWare` 6.10.
    #[prost(double, optional, tag = "10")]
    pub utilization_rate: Option<f64>,
    /// Number of the motion under way; `RobotWare` 7.
    #[prost(uint32, optional, tag = "11")]
    pub move_index: Option<u32>,
    /// Collision detection; `RobotWare` 7.
    #[prost(message, optional, tag = "12")]
    pub collision_info: Option<EgmCollisionInfo>,
    /// `RAPIDfromRobot`; `RobotWare` 7.
    #[prost(message, optional, tag = "13")]
    pub rapid_from_robot: Option<EgmRapidData>,
    /// Torque references; `RobotWare` 7.
    #[prost(message, optional, tag = "14")]
    pub torque_ref: Option<EgmJoints>,
}

/// Which fields a robot's message has: what its release can be told from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Release {
    /// No times: before `RobotWare` 6.07.
    Before6_07,
    /// Times, no utilisation: `RobotWare` 6.07 to 6.09.
    From6_07,
    /// Times and utilisation, nothing of `RobotWare` 7: 6.10 or newer. A controller of release 7
    /// that leaves all its own fields out looks the same.
    From6_10,
    /// A field that only `RobotWare` 7 has.
    RobotWare7,
}

impl EgmRobot {
    /// The release its fields tell. The time and utilisation rules are those by which `abb_libegm`
    /// tells them; the rest follows from the message definitions of the two releases.
    pub fn release(&self) -> Release {
        let (feed_back, planned) = (self.feed_back.as_ref(), self.planned.as_ref());
        let stamps = [
            feed_back.and_then(|part| part.time_stamp),
            planned.and_then(|part| part.time_stamp),
        ];
        let force = self.measured_force.as_ref();
        if self.move_index.is_some()
            || self.collision_info.is_some()
            || self.rapid_from_robot.is_some()
            || self.torque_ref.is_some()
            || stamps.iter().any(Option::is_some)
            || force.is_some_and(EgmMeasuredForce::tells_release_7)
        {
            return Release::RobotWare7;
        }
        if feed_back.and_then(|part| part.time).is_none() {
            Release::Before6_07
        } else if self.utilization_rate.is_none() {
            Release::From6_07
        } else {
            Release::From6_10
        }
    }
}

/// The motors.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub struct EgmMotorState {
    /// [`MotorState`] as a number.
    #[prost(enumeration = "MotorState", required, tag = "1")]
    pub state: i32,
}

/// [`EgmMotorState::state`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
pub enum MotorState {
    /// Not said.
    Undefined = 0,
    /// Motors on.
    On = 1,
    /// Motors off.
    Off = 2,
}

/// The motion control interface, that is: guided motion.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub struct EgmMciState {
    /// [`MciState`] as a number.
    #[prost(enumeration = "MciState", required, tag = "1")]
    pub state: i32,
}

/// [`EgmMciState::state`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
pub enum MciState {
    /// Not said.
    Undefined = 0,
    /// It failed.
    Error = 1,
    /// Connected, not running.
    Stopped = 2,
    /// Running.
    Running = 3,
}

/// The controller's program.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub struct EgmRapidCtrlExecState {
    /// [`RapidState`] as a number.
    #[prost(enumeration = "RapidState", required, tag = "1")]
    pub state: i32,
}

/// [`EgmRapidCtrlExecState::state`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
pub enum RapidState {
    /// Not said.
    Undefined = 0,
    /// Stopped.
    Stopped = 1,
    /// Running.
    Running = 2,
}

/// Test signals.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmTestSignals {
    /// The signals.
    #[prost(double, repeated, packed = "false", tag = "1")]
    pub signals: Vec<f64>,
}

/// Collision detection; `RobotWare` 7.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmCollisionInfo {
    /// A collision was detected (`collsionTriggered`, as the maker spells it).
    #[prost(bool, optional, tag = "1")]
    pub collision_triggered: Option<bool>,
    /// How near each joint is to being taken for a collision.
    #[prost(double, repeated, packed = "false", tag = "2")]
    pub coll_det_quota: Vec<f64>,
}

/// Which layout an [`EgmMeasuredForce`] has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ForceForm {
    /// Field 1: the forces.
    RobotWare6,
    /// Field 1: whether force control is active; field 2: the forces.
    #[default]
    RobotWare7,
}

/// Measured forces and torques, N and Nm.
///
/// The releases use field 1 for different things, but of different wire types, so a decoder can
/// tell them apart: written by hand because a derived message has one type per field. An empty
/// message has the same bytes in both forms and decodes as the newer.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EgmMeasuredForce {
    /// The layout it came in and goes out in.
    pub form: ForceForm,
    /// Force control is active; in the form of `RobotWare` 7 only.
    pub fc_active: Option<bool>,
    /// Forces.
    pub force: Vec<f64>,
}

impl EgmMeasuredForce {
    fn tells_release_7(&self) -> bool {
        let is_empty = self.fc_active.is_none() && self.force.is_empty();
        self.form == ForceForm::RobotWare7 && !is_empty
    }
}

impl Message for EgmMeasuredForce {
    fn encode_raw(&self, buffer: &mut impl BufMut) {
        match self.form {
            ForceForm::RobotWare6 => encoding::double::encode_repeated(1, &self.force, buffer),
            ForceForm::RobotWare7 => {
                if let Some(active) = &self.fc_active {
                    encoding::bool::encode(1, active, buffer);
                }
                encoding::double::encode_repeated(2, &self.force, buffer);
            }
        }
    }

    fn merge_field(
        &mut self,
        tag: u32,
        wire_type: WireType,
        buffer: &mut impl Buf,
        context: DecodeContext,
    ) -> Result<(), DecodeError> {
        match (tag, wire_type) {
            (1, WireType::Varint) => {
                self.form = ForceForm::RobotWare7;
                let active = self.fc_active.get_or_insert(false);
                encoding::bool::merge(wire_type, active, buffer, context)
            }
            (1 | 2, _) => {
                self.form = if tag == 1 {
                    ForceForm::RobotWare6
                } else {
                    ForceForm::RobotWare7
                };
                encoding::double::merge_repeated(wire_type, &mut self.force, buffer, context)
            }
            _ => encoding::skip_field(wire_type, tag, buffer, context),
        }
    }

    fn encoded_len(&self) -> usize {
        // Tags 1 and 2 both take one byte.
        let force = encoding::double::encoded_len_repeated(1, &self.force);
        match (self.form, &self.fc_active) {
            (ForceForm::RobotWare7, Some(active)) => encoding::bool::encoded_len(1, active) + force,
            _ => force,
        }
    }

    fn clear(&mut self) {
        self.form = ForceForm::default();
        self.fc_active = None;
        self.force.clear();
    }
}
