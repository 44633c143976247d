//! Messages between a client and the motion server: requests, responses, and what is recorded of
//! them. Layout only.

use bytemuck::{Pod, Zeroable};

use super::Side;
use crate::yumi::{Joints, Pose};
use hil_core::layout::Field;
use hil_core::message::Message;

/// To the motion server: do something that guided motion is not, or start and stop that.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct MotionRequest {
    /// The sender's number; the responses carry it.
    pub request_id: u64,
    /// [`MotionKind`] as a number.
    pub kind: u32,
    /// Bit 0: right arm, bit 1: left arm; several at once are done together.
    pub arms: u32,
    /// Target of a joint motion, right then left.
    pub joints_rad: [Joints; 2],
    /// Target of a linear motion in the body frame, right then left.
    pub poses: [Pose; 2],
    /// Speed of a motion: share of the joints' own limits (joint motion, home), or m/s of the
    /// tool (linear); 0 takes the controller's default.
    pub speed: f64,
    /// Parameters of [`MotionKind::EgmStart`].
    pub egm: EgmStartParameters,
}

impl MotionRequest {
    /// Bit of `side` in [`MotionRequest::arms`].
    pub const fn bit(side: Side) -> u32 {
        1 << side.index()
    }
}

hil_core::layout!(MotionRequest {
    request_id,
    kind,
    arms,
    joints_rad,
    poses,
    speed,
    egm
});

impl Message for MotionRequest {
    const NAME: &'static str = "hil.MotionRequest.v1";
    const FIELDS: &'static [Field] = Self::LAYOUT;
}

const _: () = assert!(size_of::<MotionRequest>() == 312);

/// What a session shall differ in from the controller's own settings; NaN keeps the setting.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct EgmStartParameters {
    /// `CommTimeout`, s.
    pub comm_timeout_s: f64,
    /// `CondTime`, s.
    pub condition_time_s: f64,
    /// `MaxSpeedDeviation`, rad/s.
    pub max_speed_deviation_rad_per_s: f64,
    /// `MaxPosDeviation`, rad.
    pub max_position_deviation_rad: f64,
    /// `RampInTime`, s.
    pub ramp_in_s: f64,
    /// `PosCorrGain`, 0..=1.
    pub position_correction_ratio: f64,
    /// Proportional position gain, 1/s.
    pub position_gain_per_s: f64,
    /// Low-pass corner, Hz; 0 switches it off.
    pub low_pass_hz: f64,
}

hil_core::layout!(EgmStartParameters {
    comm_timeout_s,
    condition_time_s,
    max_speed_deviation_rad_per_s,
    max_position_deviation_rad,
    ramp_in_s,
    position_correction_ratio,
    position_gain_per_s,
    low_pass_hz
});

impl EgmStartParameters {
    /// Keeps every setting.
    pub const KEEP: Self = Self {
        comm_timeout_s: f64::NAN,
        condition_time_s: f64::NAN,
        max_speed_deviation_rad_per_s: f64::NAN,
        max_position_deviation_rad: f64::NAN,
        ramp_in_s: f64::NAN,
        position_correction_ratio: f64::NAN,
        position_gain_per_s: f64::NAN,
        low_pass_hz: f64::NAN,
    };
}

/// What a request asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum MotionKind {
    /// Only the state.
    GetState = 0,
    /// A joint motion (`MoveAbsJ`).
    MoveJoints = 1,
    /// A straight line of the tool (`MoveL`) of at most 5000 cycles, i.e. 20 s at 4 ms.
    MoveLinear = 2,
    /// Start guided motion.
    EgmStart = 3,
    /// Stop guided motion.
    EgmStop = 4,
    /// A joint motion to the home posture.
    Home = 5,
}

/// From the motion server: at once when a request is taken or refused, and once more when what
/// it began has ended.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct MotionResponse {
    /// [`MotionRequest::request_id`].
    pub request_id: u64,
    /// [`MotionRequest::kind`].
    pub kind: u32,
    /// [`MotionOutcome`] as a number.
    pub outcome: u32,
    /// [`MotionRefusal`] as a number when refused, otherwise 0.
    pub refusal: u32,
    /// [`Side::index`] of the arm at fault when refused.
    pub refused_side: u32,
    /// [`SessionState`](super::SessionState) of right and left arm.
    pub states: [u32; 2],
    /// Measured joints of right and left arm.
    pub measured_rad: [Joints; 2],
}

hil_core::layout!(MotionResponse {
    request_id,
    kind,
    outcome,
    refusal,
    refused_side,
    states,
    measured_rad
});

impl Message for MotionResponse {
    const NAME: &'static str = "hil.MotionResponse.v1";
    const FIELDS: &'static [Field] = Self::LAYOUT;
}

const _: () = assert!(size_of::<MotionResponse>() == 144);

/// How a request stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum MotionOutcome {
    /// Taken; a motion or activation is under way.
    Accepted = 1,
    /// What was asked is reached.
    Done = 2,
    /// Not taken; see [`MotionResponse::refusal`].
    Refused = 3,
    /// Taken, but something else ended it.
    Interrupted = 4,
}

/// Why a request was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum MotionRefusal {
    /// No such kind.
    UnknownKind = 1,
    /// No arm, or one that does not exist.
    NoArm = 2,
    /// A number is not finite or outside its range, or a linear motion is so slow that it would
    /// last more than 5000 cycles.
    BadNumber = 3,
    /// The target is outside a joint's limits.
    OutsideLimits = 4,
    /// No joint position puts the tool there, or none on the straight line to it.
    Unreachable = 5,
    /// Another motion is under way.
    Busy = 6,
    /// Guided motion runs, and the request needs it not to.
    GuidedMotionRuns = 7,
}

/// To the record: a request as it arrived at the motion server.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct MotionArrival {
    /// When, on the robot's clock.
    pub at_ns: i64,
    /// The request.
    pub request: MotionRequest,
}

hil_core::layout!(MotionArrival { at_ns, request });

impl Message for MotionArrival {
    const NAME: &'static str = "hil.MotionArrival.v1";
    const FIELDS: &'static [Field] = Self::LAYOUT;
}

const _: () = assert!(size_of::<MotionArrival>() == 320);
