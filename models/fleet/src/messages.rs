//! What controller and robots of a fleet tell each other, and what the robots tell the recorder.
//! Names and meanings follow VDA 5050 (order = mission, base = authority, state); the encoding is
//! our own fixed-size one. Nothing here decides anything.

use hil_core::time::Instant;
hil_core::message! {
    /// What the three messages between controller and robot begin with, 24 bytes.
    #[derive(Eq, Hash, Default)]
    pub struct Header, 24 bytes {
        /// Which of the independent fleets that share the channel.
        pub fleet_id: u32,
        /// Robot within its fleet, from 0.
        pub robot_id: u32,
        /// Counts the sender's messages of this kind to or from this robot (`headerId`), from the
        /// milliseconds on its clock when it started, so that it grows across restarts.
        pub header_id: u32,
        /// The mission meant (`orderId`); 0 is none.
        pub mission_id: u32,
        /// When the sender gave the message, nanoseconds on its own clock.
        pub sent_ns: i64,
    }
}

hil_core::words! {
    /// What a receiver does with messages that arrive out of order or twice.
    #[derive(Default)]
    pub enum MessageOrder {
        /// Takes them as they come, as from a raw UDP socket; only the rules of each message decide.
        #[default]
        Legacy = "legacy",
        /// Passes over each whose `header_id` is not newer than the newest of its kind.
        Strict = "strict",
    }
}

hil_core::numbered! {
    /// What a robot is about.
    pub enum Phase: u8 {
        /// In a bay without a mission.
        Parked = 0,
        /// On its way.
        Driving = 1,
        /// Standing at the end of its authority, short of its goal.
        AtPoint = 2,
        /// Standing at its goal.
        Done = 3,
    }
}

hil_core::message! {
    /// Robot to controller, every tracking period (VDA 5050 `state`), 96 bytes.
    #[derive(Default)]
    pub struct State = "hil.FleetState.v2", 96 bytes {
        /// Who, which mission, when.
        pub header: Header,
        /// When the robot sampled its motion, nanoseconds on its clock.
        pub sampled_ns: i64,
        /// Position in the map frame, metres.
        pub x_m: f64,
        /// Position in the map frame, metres.
        pub y_m: f64,
        /// Heading in the map frame, radians from the x axis, counter-clockwise.
        pub heading_rad: f64,
        /// Way travelled along the path, metres.
        pub travelled_m: f64,
        /// Speed along the path.
        pub speed_mps: f32,
        /// The newest question of a coordinator ([`Authority::QUESTION`]) heard since the robot started; 0 if none.
        pub answered: u32,
        /// Last path pose passed (`lastNodeSequenceId`); -1 without a mission.
        pub path_index: i32,
        /// Authority in force: last pose the robot may reach; [`TO_GOAL`] for the whole path,
        /// [`NO_AUTHORITY`] when none came yet.
        pub authority_index: i32,
        /// `sequence` of the authority message last applied; 0 before the first.
        pub applied_sequence: u32,
        /// First pose at which the robot could still stop, were it told now.
        pub stop_index: i32,
        /// The path `path_index` refers to; of a robot without a mission, one that begins or ends where it stands.
        pub path_id: u32,
        /// A [`Phase`].
        pub phase: u8,
        /// [`State::REFUSED`].
        pub flags: u8,
        /// Zero.
        pub reserved: [u8; 2],
    }
}

/// First `header_id`, and question, of a sender that starts at `now` on its clock: newer than any it gave before
/// it restarted, as long as it gives fewer than one a millisecond.
pub(crate) fn first_id(now: Instant) -> u32 {
    let ms = now.as_ns().max(0) / 1_000_000;
    u32::try_from(ms & i64::from(u32::MAX)).expect("masked")
}

/// `authority_index`: the whole path.
pub const TO_GOAL: i32 = -1;
/// `authority_index` of a state: no authority received for this mission yet.
pub const NO_AUTHORITY: i32 = -2;

impl State {
    /// Flag: the last authority with a newer sequence would have shortened the way below what
    /// the robot can still stop at; it was noted (`applied_sequence`) but the old authority stays.
    pub const REFUSED: u8 = 1;

    /// True when every real number is finite and the phase is known.
    pub fn is_sound(&self) -> bool {
        let reals = [self.x_m, self.y_m, self.heading_rad, self.travelled_m];
        reals.iter().all(|value| value.is_finite())
            && self.speed_mps.is_finite()
            && Phase::from_number(self.phase).is_some()
    }
}

hil_core::message! {
    /// Controller to robot: how far it may go (the end of VDA 5050's *base*), 48 bytes.
    #[derive(Eq, Hash, Default)]
    pub struct Authority = "hil.FleetAuthority.v2", 48 bytes {
        /// To whom, for which mission.
        pub header: Header,
        /// Grows with every change of this mission's authority, from 1 (`orderUpdateId`); a repeat
        /// carries the same number.
        pub sequence: u32,
        /// Last pose the robot may reach; [`TO_GOAL`] for the whole path.
        pub authority_index: i32,
        /// `header_id` of the newest state the decision rests on; 0 if none.
        pub echo_header_id: u32,
        /// [`Authority::ACKNOWLEDGED`], [`Authority::QUESTION`].
        pub flags: u32,
        /// Zero.
        pub reserved: [u8; 8],
    }
}

impl Authority {
    /// Flag: acknowledged movement authority. The robot applies only newer sequences and never
    /// shortens below where it can stop. Without the flag it follows the original's rules.
    pub const ACKNOWLEDGED: u32 = 1;
    /// Flag: a coordinator that started asks what the robot holds; `sequence` is the question, newer
    /// from start to start. It gives no way, and commands that rest on states of before are void.
    pub const QUESTION: u32 = 2;
}

hil_core::message! {
    /// Controller to robot: the path to drive (VDA 5050 `order`), repeated until a state shows the
    /// mission, 48 bytes. Path geometry is not sent: both ends make it, and compare by hash.
    #[derive(Eq, Hash, Default)]
    pub struct Mission = "hil.FleetMission.v2", 48 bytes {
        /// To whom; `mission_id` is the new mission.
        pub header: Header,
        /// Which path, as [`PathId`](crate::path::PathId) numbers them.
        pub path_id: u32,
        /// As [`Authority::echo_header_id`], with [`Mission::ACKNOWLEDGED`].
        pub echo_header_id: u32,
        /// Pose to end at; the path's last.
        pub end_index: u32,
        /// [`Mission::REPLACE`], [`Mission::ACKNOWLEDGED`].
        pub flags: u32,
        /// [`Path::hash`](crate::path::Path::hash) as the controller knows it.
        pub path_hash: u64,
    }
}

impl Mission {
    /// Flag: a stuck fleet is being cleared; the robot is put at the path's end at once.
    pub const REPLACE: u32 = 1;
    /// Flag: it counts only if it rests on a state of the robot's present time; see [`Authority::QUESTION`].
    pub const ACKNOWLEDGED: u32 = 2;
}

hil_core::message! {
    /// Robot to recorder, never over the network: its motion from this instant until the next such
    /// record, `s(t) = travelled + speed t + acceleration t^2 / 2`, never backwards. 64 bytes.
    #[derive(Default)]
    pub struct Truth = "hil.FleetTruth.v1", 64 bytes {
        /// When, nanoseconds on the robots' clock.
        pub at_ns: i64,
        /// Which fleet.
        pub fleet_id: u32,
        /// Which robot.
        pub robot_id: u32,
        /// Its mission; 0 if none.
        pub mission_id: u32,
        /// The path whose poses `travelled_m` refers to; of a parked robot, the path it came by.
        pub path_id: u32,
        /// Way travelled along the path, metres.
        pub travelled_m: f64,
        /// Speed along the path.
        pub speed_mps: f64,
        /// Acceleration along the path.
        pub acceleration_mps2: f64,
        /// Authority in force, as in [`State`].
        pub authority_index: i32,
        /// `sequence` of the authority message that caused this record; 0 if none did.
        pub caused_by_sequence: u32,
        /// A [`TruthKind`].
        pub kind: u32,
        /// Zero.
        pub reserved: u32,
    }
}

hil_core::numbered! {
    /// Why a truth record was written.
    pub enum TruthKind: u32 {
        /// The acceleration changed, or a tick of a stepped tracker.
        Motion = 0,
        /// A mission began.
        MissionStarted = 1,
        /// The goal was reached.
        MissionDone = 2,
        /// An authority was applied.
        AuthorityApplied = 3,
        /// An authority came too late: the robot could not stop at it any more and went past.
        AuthorityLate = 4,
        /// An authority behind the robot was ignored; the old one stays in force.
        AuthorityIgnored = 5,
        /// An authority was refused because the robot could not stop at it; the old one stays.
        AuthorityRefused = 6,
        /// An older or repeated authority or mission was passed over.
        MessageStale = 7,
        /// The robot was put at its goal to clear a stuck fleet.
        Replaced = 9,
    }
}

/// What a fleet controller gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ToRobot {
    /// How far a robot may go.
    Authority(Authority),
    /// What a robot shall drive.
    Mission(Mission),
}
