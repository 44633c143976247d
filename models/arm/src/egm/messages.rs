//! Messages of guided motion as they lie in shared memory. Layout only; SI units and radians; joints
//! in chain order, see [`crate::yumi`]. The maker's own datagrams are in [`crate::egm::wire`].

use serde::{Deserialize, Serialize};

pub use crate::egm::parameters::EgmStartParameters;
use crate::yumi::{Joints, Pose};

hil_core::labelled! {
    /// One of the robot's two arms, each a motion task of its own.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Side, word {
        /// The robot's right arm.
        Right = "right",
        /// The robot's left arm.
        Left = "left",
    }
}

impl Side {
    /// Both, in the order of every list.
    pub const BOTH: [Self; 2] = [Self::Right, Self::Left];

    /// 0 for right, 1 for left: its number in messages.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// As [`Side::index`], as messages carry it.
    pub const fn number(self) -> u32 {
        self as u32
    }
}

hil_core::message! {
    /// To the robot: where one arm shall be.
    pub struct EgmCommand = "hil.EgmCommand.v1", 144 bytes {
        /// The human frame this command answers; a foreign client's counts its datagrams instead.
        pub frame_index: u64,
        /// Time of that frame on the motion's own time axis; of a foreign client, zero.
        pub source_time_ns: i64,
        /// [`EgmFeedback::cycle_index`] of the newest feedback the sender had seen; meaningless
        /// without [`EgmCommand::ANSWERS`].
        pub answered_cycle: u64,
        /// Desired joint positions.
        pub position_rad: Joints,
        /// Desired joint speeds; meaningless without [`EgmCommand::HAS_SPEED`].
        pub speed_rad_per_s: Joints,
        /// Sender's number of this message; foreign clients do not always count by one.
        pub seqno: u32,
        /// Bits below; all others are zero.
        pub flags: u32,
    }
}

impl EgmCommand {
    /// [`EgmCommand::speed_rad_per_s`] is meant.
    pub const HAS_SPEED: u32 = 1;
    /// [`EgmCommand::answered_cycle`] is meant.
    pub const ANSWERS: u32 = 1 << 1;
    /// No joint position reaches the hand's target: the command holds.
    pub const UNREACHABLE: u32 = 1 << 2;
    /// On the way to the target but not there: a joint's speed or position limit binds.
    pub const LIMITED: u32 = 1 << 3;
    /// The hand moved farther in one frame than the mapping allows; the target follows slowly.
    pub const JUMP_LIMITED: u32 = 1 << 4;
    /// The sender follows no hand at the moment: it repeats where the arm is or was.
    pub const PARKED: u32 = 1 << 5;
}

hil_core::message! {
    /// From the robot, every cycle: where one arm is.
    pub struct EgmFeedback = "hil.EgmFeedback.v1", 216 bytes {
        /// Controller cycle, counted from the robot's start; a skipped cycle leaves a gap.
        pub cycle_index: u64,
        /// [`EgmCommand::frame_index`] of the reference in use; meaningless without
        /// [`EgmFeedback::HAS_REFERENCE`].
        pub reference_frame_index: u64,
        /// Time since the reference in use arrived at the robot, queueing included; without
        /// [`EgmFeedback::HAS_REFERENCE`], since its session began to be set up or to run.
        pub reference_age_ns: i64,
        /// Joint positions as measured.
        pub measured_rad: Joints,
        /// Joint positions as the controller plans them, ahead of the measured by its own delay.
        pub planned_rad: Joints,
        /// Tool centre point (the flange frame `tool0`) in the robot's body frame: x forward, y to
        /// the robot's left, z up.
        pub tool: Pose,
        /// The controller's clock in milliseconds, wrapping; the protocol's `tm`.
        pub clock_ms: u32,
        /// Counts the cycles since guided motion last began to run, from 0; the protocol's `seqno`. A
        /// skipped cycle leaves a gap.
        pub seqno: u32,
        /// Counts the sessions (activations) since the robot's start, from 1; 0 before the first.
        pub session: u32,
        /// [`SessionState`] as a number.
        pub state: u32,
        /// Commands waiting after this cycle took its own.
        pub queue_count: u32,
        /// Bits below; all others are zero.
        pub flags: u32,
    }
}

impl EgmFeedback {
    /// A command was taken in this session.
    pub const HAS_REFERENCE: u32 = 1;
    /// Commands came before in this session and have stopped: the last one goes on acting.
    pub const HOLDING: u32 = 1 << 1;
    /// A joint stands at its position limit.
    pub const AT_POSITION_LIMIT: u32 = 1 << 2;
    /// A joint's own speed limit binds.
    pub const SPEED_LIMITED: u32 = 1 << 3;
    /// `MaxSpeedDeviation` binds.
    pub const SPEED_DEVIATION_LIMITED: u32 = 1 << 4;
    /// Every joint is within the convergence window of its order.
    pub const CONVERGED: u32 = 1 << 5;
    /// This cycle took a command; without, it went on with the last one.
    pub const TOOK_COMMAND: u32 = 1 << 6;

    /// True when `bit` is set.
    pub const fn has(&self, bit: u32) -> bool {
        self.flags & bit != 0
    }

    /// The session's state; `None` for a number that is none.
    pub fn session_state(&self) -> Option<SessionState> {
        SessionState::from_number(self.state)
    }
}

hil_core::numbered! {
    /// What an arm's motion task is doing.
    pub enum SessionState: u32 {
        /// No session, none coming by itself: a request must start one.
        Idle = 0,
        /// A motion of its own (joint, linear, home) is under way.
        Moving = 1,
        /// The last session ended; the program waits before it starts the next.
        Waiting = 2,
        /// Moving to the fine point from which guided motion starts, and setting it up.
        Activating = 3,
        /// Guided motion runs.
        Running = 4,
        /// A session is ending by its ramp.
        Stopping = 5,
    }
}

impl SessionState {
    /// One word for a log line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Moving => "moving",
            Self::Waiting => "waiting",
            Self::Activating => "activating",
            Self::Running => "running",
            Self::Stopping => "stopping",
        }
    }
}

hil_core::message! {
    /// To the record: something happened to an arm's session. What `value`, `limit` and `count` mean,
    /// `kind` says.
    pub struct EgmEvent = "hil.EgmEvent.v1", 56 bytes {
        /// Grid time of the cycle in which it happened, the robot's clock.
        pub at_ns: i64,
        /// That cycle.
        pub cycle_index: u64,
        /// What was seen, in the unit of the kind.
        pub value: f64,
        /// What it was held against, in the same unit.
        pub limit: f64,
        /// A count that belongs to it.
        pub count: u64,
        /// [`EgmEventKind`] as a number.
        pub kind: u32,
        /// [`Side::index`].
        pub side: u32,
        /// The session it belongs to.
        pub session: u32,
        /// [`EndCause`] or refusal as a number, where the kind has one.
        pub cause: u32,
    }
}

hil_core::numbered! {
    /// What an [`EgmEvent`] tells.
    pub enum EgmEventKind: u32 {
        /// The controller's first cycle: the origin of its grid.
        Started = 0,
        /// A session is being set up; `value`: seconds that takes.
        Activating = 1,
        /// Guided motion runs; `value`: seconds since the last session ended (or since the start).
        Running = 2,
        /// A session ended; `cause`: [`EndCause`]; `value` against `limit`: what tripped it, in the
        /// cause's unit. Holding ends with it untold, throttling just before.
        Ended = 3,
        /// `MaxSpeedDeviation` began to bind; `value`: deg/s asked, `limit`: deg/s allowed.
        SpeedThrottled = 4,
        /// It has not bound for half a second, or the session ends; `value`: highest deg/s asked since
        /// it began to bind, `limit`: deg/s allowed, `count`: nanoseconds from there to when it last did.
        SpeedFree = 5,
        /// Commands stopped coming: the last one goes on acting; `value`: seconds since it was taken.
        HoldBegan = 6,
        /// Commands are back; `value`: seconds without.
        HoldEnded = 7,
        /// A command was refused; `cause`: [`CommandRefusal`]; `value` against `limit`: joint value
        /// (rad); `count`: joint, chain order from 0. Told for the first of a row of equal refusals.
        CommandRefused = 8,
        /// The queue of `limit` commands was full: `count` were dropped so far. Told again only after
        /// it was half empty.
        QueueOverflow = 9,
        /// A motion of its own began; `cause`: the request's kind.
        MotionBegan = 10,
        /// A motion of its own ended; `value`: seconds it took.
        MotionEnded = 11,
    }
}

hil_core::numbered! {
    /// Why a session ended.
    pub enum EndCause: u32 {
        /// No command that was not refused came for `CommTimeout`; unit: s.
        CommTimeout = 1,
        /// All joints stayed within the convergence window for `CondTime`; unit: s.
        ConditionTime = 2,
        /// A joint went farther from the start than `MaxPosDeviation`; unit: deg; `count`: joint,
        /// chain order from 0.
        PositionDeviation = 3,
        /// A request asked for it; unit: s from there to the end.
        Requested = 4,
    }
}

hil_core::numbered! {
    /// Why a command never reached the servo.
    pub enum CommandRefusal: u32 {
        /// A position or speed is not a number or infinite.
        NotFinite = 1,
        /// A position is outside the joint's limits.
        OutsideLimits = 2,
        /// Guided motion does not run: nobody takes commands.
        NoSession = 3,
    }
}

hil_core::message! {
    /// To the record: a command as it arrived at the controller, before anything was made of it. With
    /// [`MotionArrival`] and [`EgmEventKind::Started`] it is all that a replay needs.
    pub struct EgmArrival = "hil.EgmArrival.v1", 160 bytes {
        /// When, on the robot's clock.
        pub at_ns: i64,
        /// [`Side::index`].
        pub side: u32,
        /// Zero.
        pub reserved: u32,
        /// The command.
        pub command: EgmCommand,
    }
}

hil_core::message! {
    /// To the motion server: do something that guided motion is not, or start and stop that.
    pub struct MotionRequest = "hil.MotionRequest.v1", 312 bytes {
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
}

impl MotionRequest {
    /// Bit of `side` in [`MotionRequest::arms`].
    pub const fn bit(side: Side) -> u32 {
        1 << side.index()
    }
}

hil_core::numbered! {
    /// What a request asks for.
    pub enum MotionKind: u32 {
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
}

hil_core::message! {
    /// From the motion server: at once when a request is taken or refused, and once more when what
    /// it began has ended.
    pub struct MotionResponse = "hil.MotionResponse.v1", 144 bytes {
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
        /// [`SessionState`] of right and left arm.
        pub states: [u32; 2],
        /// Measured joints of right and left arm.
        pub measured_rad: [Joints; 2],
    }
}

hil_core::numbered! {
    /// How a request stands.
    pub enum MotionOutcome: u32 {
        /// Taken; a motion or activation is under way.
        Accepted = 1,
        /// What was asked is reached.
        Done = 2,
        /// Not taken; see [`MotionResponse::refusal`].
        Refused = 3,
        /// Taken, but something else ended it.
        Interrupted = 4,
    }
}

hil_core::numbered! {
    /// Why a request was not taken.
    pub enum MotionRefusal: u32 {
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
}

hil_core::message! {
    /// To the record: a request as it arrived at the motion server.
    pub struct MotionArrival = "hil.MotionArrival.v1", 320 bytes {
        /// When, on the robot's clock.
        pub at_ns: i64,
        /// The request.
        pub request: MotionRequest,
    }
}

impl Side {
    /// The side with this number, see [`Side::index`].
    pub fn from_index(index: u32) -> Option<Self> {
        Self::BOTH.into_iter().find(|side| side.number() == index)
    }
}

impl MotionKind {
    /// A few words for a log line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::GetState => "state",
            Self::MoveJoints => "joint motion",
            Self::MoveLinear => "linear motion",
            Self::EgmStart => "start of guided motion",
            Self::EgmStop => "stop of guided motion",
            Self::Home => "motion to the home posture",
        }
    }
}

#[cfg(test)]
mod numbers_tests {
    use super::*;

    /// Numbers `from..to` must read back as themselves, those around as nothing.
    fn check<T>(from: u32, to: u32, read: fn(u32) -> Option<T>, number: fn(T) -> u32) {
        for candidate in 0..50 {
            let known = (from..to).contains(&candidate).then_some(candidate);
            assert_eq!(read(candidate).map(number), known);
        }
        assert!(read(u32::MAX).is_none());
    }

    #[test]
    fn every_number_reads_back_as_the_one_written() {
        check(0, 12, EgmEventKind::from_number, |kind| kind as u32);
        check(1, 5, EndCause::from_number, |cause| cause as u32);
        check(1, 4, CommandRefusal::from_number, |refusal| refusal as u32);
        check(0, 6, MotionKind::from_number, |kind| kind as u32);
        check(1, 5, MotionOutcome::from_number, |outcome| outcome as u32);
        check(1, 8, MotionRefusal::from_number, |refusal| refusal as u32);
        check(0, 6, SessionState::from_number, |state| state as u32);
        check(0, 2, Side::from_index, |side| match side {
            Side::Right => 0,
            Side::Left => 1,
        });
    }
}
