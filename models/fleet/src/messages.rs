//! What controller and robots of a fleet tell each other, and what the robots tell the recorder.
//! Names and meanings follow VDA 5050 (order = mission, base = authority, state); the encoding is
//! our own fixed-size one. Nothing here decides anything.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

hil_core::message! {
    /// What the three messages between controller and robot begin with, 24 bytes.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
    #[repr(C)]
    pub struct Header {
        /// Which of the independent fleets that share the channel.
        pub fleet_id: u32,
        /// Robot within its fleet, from 0.
        pub robot_id: u32,
        /// Counts the sender's messages of this kind to or from this robot, from 1 (`headerId`).
        pub header_id: u32,
        /// The mission meant (`orderId`); 0 is none.
        pub mission_id: u32,
        /// When the sender gave the message, nanoseconds on its own clock.
        pub sent_ns: i64,
    }
}

/// What a receiver does with messages that arrive out of order or twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MessageOrder {
    /// Takes them as they come, as from a raw UDP socket; only the rules of each message decide.
    #[default]
    Legacy,
    /// Passes over each whose `header_id` is not newer than the newest of its kind.
    Strict,
}

/// What a robot is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Phase {
    /// In a bay without a mission.
    Parked = 0,
    /// On its way.
    Driving = 1,
    /// Standing at the end of its authority, short of its goal.
    AtPoint = 2,
    /// Standing at its goal.
    Done = 3,
}

impl Phase {
    /// The phase a message names; `None` for an unknown number.
    pub const fn of(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::Parked),
            1 => Some(Self::Driving),
            2 => Some(Self::AtPoint),
            3 => Some(Self::Done),
            _ => None,
        }
    }
}

hil_core::message! {
    /// Robot to controller, every tracking period (VDA 5050 `state`), 96 bytes.
    #[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
    #[repr(C)]
    pub struct State = "hil.FleetState.v1" {
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
        /// Acceleration along the path.
        pub acceleration_mps2: f32,
        /// Last path pose passed (`lastNodeSequenceId`); -1 without a mission.
        pub path_index: i32,
        /// Authority in force: last pose the robot may reach; [`TO_GOAL`] for the whole path,
        /// [`NO_AUTHORITY`] when none came yet.
        pub authority_index: i32,
        /// `sequence` of the authority message last applied; 0 before the first.
        pub applied_sequence: u32,
        /// First pose at which the robot could still stop, were it told now.
        pub stop_index: i32,
        /// A [`Phase`].
        pub phase: u8,
        /// [`State::REFUSED`].
        pub flags: u8,
        /// Zero.
        pub reserved: [u8; 6],
    }
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
            && self.acceleration_mps2.is_finite()
            && Phase::of(self.phase).is_some()
    }
}

hil_core::message! {
    /// Controller to robot: how far it may go (the end of VDA 5050's *base*), 48 bytes.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
    #[repr(C)]
    pub struct Authority = "hil.FleetAuthority.v1" {
        /// To whom, for which mission.
        pub header: Header,
        /// Grows with every change of this mission's authority, from 1 (`orderUpdateId`); a repeat
        /// carries the same number.
        pub sequence: u32,
        /// Last pose the robot may reach; [`TO_GOAL`] for the whole path.
        pub authority_index: i32,
        /// How long the authority holds after its receipt; 0 for ever. A robot brakes when it ends.
        pub lease_ns: i64,
        /// `header_id` of the newest state the decision rests on; 0 if none.
        pub echo_header_id: u32,
        /// [`Authority::ACKNOWLEDGED`].
        pub flags: u32,
    }
}

impl Authority {
    /// Flag: acknowledged movement authority. The robot applies only newer sequences and never
    /// shortens below where it can stop. Without the flag it follows the original's rules.
    pub const ACKNOWLEDGED: u32 = 1;
}

hil_core::message! {
    /// Controller to robot: the path to drive (VDA 5050 `order`), repeated until a state shows the
    /// mission, 48 bytes. Path geometry is not sent: both ends make it, and compare by hash.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
    #[repr(C)]
    pub struct Mission = "hil.FleetMission.v1" {
        /// To whom; `mission_id` is the new mission.
        pub header: Header,
        /// Which path, as [`PathId`](crate::path::PathId) numbers them.
        pub path_id: u32,
        /// Pose to start from; 0.
        pub start_index: u32,
        /// Pose to end at; the path's last.
        pub end_index: u32,
        /// [`Mission::REPLACE`].
        pub flags: u32,
        /// [`Path::hash`](crate::path::Path::hash) as the controller knows it.
        pub path_hash: u64,
    }
}

impl Mission {
    /// Flag: a stuck fleet is being cleared; the robot is put at the path's end at once.
    pub const REPLACE: u32 = 1;
}

hil_core::message! {
    /// Robot to recorder, never over the network: its motion from this instant until the next such
    /// record, `s(t) = travelled + speed t + acceleration t^2 / 2`, never backwards. 64 bytes.
    #[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
    #[repr(C)]
    pub struct Truth = "hil.FleetTruth.v1" {
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

/// Why a truth record was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum TruthKind {
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
    /// The lease of the authority ended and the robot braked.
    LeaseEnded = 8,
    /// The robot was put at its goal to clear a stuck fleet.
    Replaced = 9,
}

impl TruthKind {
    /// The kind a record names; `None` for an unknown number.
    pub const fn of(number: u32) -> Option<Self> {
        const KINDS: [TruthKind; 10] = [
            TruthKind::Motion,
            TruthKind::MissionStarted,
            TruthKind::MissionDone,
            TruthKind::AuthorityApplied,
            TruthKind::AuthorityLate,
            TruthKind::AuthorityIgnored,
            TruthKind::AuthorityRefused,
            TruthKind::MessageStale,
            TruthKind::LeaseEnded,
            TruthKind::Replaced,
        ];
        if (number as usize) < KINDS.len() {
            Some(KINDS[number as usize])
        } else {
            None
        }
    }
}

hil_core::message_set! {
    /// What a fleet controller gives: one port, and so one flow, per kind.
    pub enum ToRobot { Authority(Authority), Mission(Mission) }
}

hil_core::message_set! {
    /// What the robots give: states for the controller, truth for the recorder.
    pub enum FromRobot { State(State), Truth(Truth) }
}

const _: () = assert!(size_of::<Header>() == 24);
const _: () = assert!(size_of::<State>() == 96);
const _: () = assert!(size_of::<Authority>() == 48);
const _: () = assert!(size_of::<Mission>() == 48);
const _: () = assert!(size_of::<Truth>() == 64);
