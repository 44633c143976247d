//! The messages of the protocol, field for field, and the body both directions share. Layout only:
//! whether a message makes sense is judged by [`crate::egm::adapter`].
//!
//! proto2, package `abb.egm`. Message names are the maker's; field names are its names in snake
//! case. Angles are in degrees, lengths in millimetres, and stay so here.
//!
//! A *required* number that is missing decodes as NaN (whole numbers as 0), so that no check for
//! finite numbers passes it: prost, unlike the maker's decoder, does not refuse the message.

/// What every message begins with.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmHeader {
    /// Number of the message, meant to find lost ones. Clients count it as they like: one of the
    /// known ones by two.
    #[prost(uint32, optional, tag = "1")]
    pub seqno: Option<u32>,
    /// The sender's clock, ms, wrapping.
    #[prost(uint32, optional, tag = "2")]
    pub tm: Option<u32>,
    /// What the message is.
    #[prost(enumeration = "MessageType", optional, tag = "3")]
    pub mtype: Option<i32>,
}

/// [`EgmHeader::mtype`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, prost::Enumeration)]
#[repr(i32)]
pub enum MessageType {
    /// Not said.
    Undefined = 0,
    /// Reserved by the maker.
    Command = 1,
    /// From the robot: [`EgmRobot`](crate::egm::wire::EgmRobot).
    Data = 2,
    /// To the robot, position guidance: [`EgmSensor`].
    Correction = 3,
    /// To the robot, path correction: [`EgmSensorPathCorr`].
    PathCorrection = 4,
}

/// A position, mm.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmCartesian {
    /// Along x.
    #[prost(double, required, tag = "1", default = "nan")]
    pub x: f64,
    /// Along y.
    #[prost(double, required, tag = "2", default = "nan")]
    pub y: f64,
    /// Along z.
    #[prost(double, required, tag = "3", default = "nan")]
    pub z: f64,
}

/// An orientation as a quaternion.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmQuaternion {
    /// Scalar part.
    #[prost(double, required, tag = "1", default = "nan")]
    pub u0: f64,
    /// Along x.
    #[prost(double, required, tag = "2", default = "nan")]
    pub u1: f64,
    /// Along y.
    #[prost(double, required, tag = "3", default = "nan")]
    pub u2: f64,
    /// Along z.
    #[prost(double, required, tag = "4", default = "nan")]
    pub u3: f64,
}

/// An orientation as angles, degrees: turned about z, then the new y, then the new x.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmEuler {
    /// About x.
    #[prost(double, required, tag = "1", default = "nan")]
    pub x: f64,
    /// About y.
    #[prost(double, required, tag = "2", default = "nan")]
    pub y: f64,
    /// About z.
    #[prost(double, required, tag = "3", default = "nan")]
    pub z: f64,
}

/// Time since 1 January 1970; in every message of the robot since `RobotWare` 6.07.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub struct EgmClock {
    /// Whole seconds.
    #[prost(uint64, required, tag = "1")]
    pub sec: u64,
    /// Microseconds of the second.
    #[prost(uint64, required, tag = "2")]
    pub usec: u64,
}

/// Time of the precision time protocol (IEEE 1588); `RobotWare` 7 only.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub struct EgmTimestamp {
    /// Whole seconds.
    #[prost(uint64, optional, tag = "1")]
    pub sec: Option<u64>,
    /// Nanoseconds of the second.
    #[prost(uint64, optional, tag = "2")]
    pub nsec: Option<u64>,
}

/// Position and orientation of the tool in the frame the controller's program chose. Angles win
/// over the quaternion where a command has both.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmPose {
    /// Position.
    #[prost(message, optional, tag = "1")]
    pub pos: Option<EgmCartesian>,
    /// Orientation.
    #[prost(message, optional, tag = "2")]
    pub orient: Option<EgmQuaternion>,
    /// The same orientation as angles.
    #[prost(message, optional, tag = "3")]
    pub euler: Option<EgmEuler>,
}

/// Speed of the tool: x, y, z in mm/s, then about x, y, z in degrees/s.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmCartesianSpeed {
    /// The speeds.
    #[prost(double, repeated, packed = "false", tag = "1")]
    pub value: Vec<f64>,
}

/// Joints of the robot (up to six) or of external axes, degrees or degrees/s. The maker also defines
/// `EgmExternalJoints`, laid out alike, and uses it nowhere.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmJoints {
    /// One value per joint; see the constants of [`crate::egm::wire`] for which is which.
    #[prost(double, repeated, packed = "false", tag = "1")]
    pub joints: Vec<f64>,
}

/// Where the robot shall be (from the sensor) or is planned to be (from the robot).
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmPlanned {
    /// The robot's first six joints.
    #[prost(message, optional, tag = "1")]
    pub joints: Option<EgmJoints>,
    /// The tool.
    #[prost(message, optional, tag = "2")]
    pub cartesian: Option<EgmPose>,
    /// External axes; the seventh joint of a seven-axis arm is the first of them.
    #[prost(message, optional, tag = "3")]
    pub external_joints: Option<EgmJoints>,
    /// When the robot is there.
    #[prost(message, optional, tag = "4")]
    pub time: Option<EgmClock>,
    /// The same in the time of the network; `RobotWare` 7.
    #[prost(message, optional, tag = "5")]
    pub time_stamp: Option<EgmTimestamp>,
}

/// Where the robot is measured to be, laid out as [`EgmPlanned`] is; its times say when it was
/// measured.
pub type EgmFeedBack = EgmPlanned;

/// Speeds the sensor adds to the controller's position law.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmSpeedRef {
    /// The robot's first six joints, degrees/s.
    #[prost(message, optional, tag = "1")]
    pub joints: Option<EgmJoints>,
    /// The tool.
    #[prost(message, optional, tag = "2")]
    pub cartesians: Option<EgmCartesianSpeed>,
    /// External axes, degrees/s or mm/s.
    #[prost(message, optional, tag = "3")]
    pub external_joints: Option<EgmJoints>,
}

/// Signals between the sensor and the controller's program, either way; `RobotWare` 7.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmRapidData {
    /// A digital signal.
    #[prost(bool, optional, tag = "1")]
    pub dig_val: Option<bool>,
    /// Up to 40 numbers.
    #[prost(double, repeated, packed = "false", tag = "2")]
    pub dnum: Vec<f64>,
}

/// From the sensor to the robot, position guidance.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmSensor {
    /// Header; its type is [`MessageType::Correction`].
    #[prost(message, optional, tag = "1")]
    pub header: Option<EgmHeader>,
    /// Where the robot shall be.
    #[prost(message, optional, tag = "2")]
    pub planned: Option<EgmPlanned>,
    /// How fast.
    #[prost(message, optional, tag = "3")]
    pub speed_ref: Option<EgmSpeedRef>,
    /// `RAPIDtoRobot`; `RobotWare` 7.
    #[prost(message, optional, tag = "4")]
    pub rapid_to_robot: Option<EgmRapidData>,
}

/// A correction of the path.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmPathCorr {
    /// What the sensor measured, in its tool's frame, mm.
    #[prost(message, required, tag = "1")]
    pub pos: EgmCartesian,
    /// Age of the measurement, ms.
    #[prost(uint32, required, tag = "2")]
    pub age: u32,
}

/// From the sensor to the robot, path correction.
#[derive(Clone, PartialEq, prost::Message)]
pub struct EgmSensorPathCorr {
    /// Header; its type is [`MessageType::PathCorrection`].
    #[prost(message, optional, tag = "1")]
    pub header: Option<EgmHeader>,
    /// The correction.
    #[prost(message, optional, tag = "2")]
    pub path_corr: Option<EgmPathCorr>,
}
