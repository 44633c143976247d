//! The maker's datagrams: messages of externally guided motion, encoded and decoded. A library by
//! itself: it opens no socket, knows no session and judges no value; [`crate::egm::adapter`] does.
//!
//! 1. [`messages`] and [`robot`]: every message of the protocol, for `RobotWare` 6 and 7.
//! 2. [`WireJoints`]: which joint is where.
//! 3. [`refusal`]: why a datagram is not taken, and the counts.
//!
//! **Bytes.** Decoding what a client or robot sent and encoding it again gives the same bytes for
//! every message of the three clients in `testdata`, which is what the tests hold against. Two
//! things do not survive: fields the protocol does not define (dropped), and repeated numbers that
//! came packed (they go out unpacked, as the maker's own definition has it).
//!
//! **Allocation.** A message owns one `Vec` per list of joints, so decoding allocates unless the
//! caller gives a message to decode into, as the adapters do. A refused datagram allocates its error.
//!
//! Decoding a robot's datagram and answering it:
//!
//! ```
//! use hil_arm::egm::wire::{self, EgmSensor, MessageType, messages::*};
//! # use hil_arm::egm::wire::{EgmRobot, Release};
//! # let mut datagram = Vec::new();
//! # let joints = EgmJoints { joints: vec![0.0, -130.0, 30.0, 0.0, 40.0, 0.0] };
//! # wire::encode(
//! #     &EgmRobot {
//! #         header: Some(EgmHeader { seqno: Some(7), tm: Some(28), mtype: Some(2) }),
//! #         feed_back: Some(EgmFeedBack { joints: Some(joints), ..Default::default() }),
//! #         ..Default::default()
//! #     },
//! #     &mut datagram,
//! # );
//!
//! let robot = wire::decode_robot(&datagram)?;
//! let joints = robot.feed_back.and_then(|part| part.joints).unwrap_or_default();
//!
//! // Hold the robot where it is.
//! let answer = EgmSensor {
//!     header: Some(EgmHeader {
//!         seqno: Some(0),
//!         tm: None,
//!         mtype: Some(MessageType::Correction as i32),
//!     }),
//!     planned: Some(EgmPlanned { joints: Some(joints), ..Default::default() }),
//!     ..Default::default()
//! };
//! let mut reply = Vec::new();
//! wire::encode(&answer, &mut reply);
//! assert_eq!(reply.len(), 64);
//! # Ok::<(), wire::Refusal>(())
//! ```

pub mod messages;
pub mod refusal;
pub mod robot;

use prost::Message;

pub use crate::egm::wire::messages::{EgmSensor, EgmSensorPathCorr, MessageType};
pub use crate::egm::wire::refusal::{Cause, DatagramCounts, Refusal};
pub use crate::egm::wire::robot::{EgmRobot, Release};
use crate::yumi::{CHAIN_TO_MAKER, JOINT_COUNT, Joints};

/// Longest datagram taken, bytes: what one Ethernet frame carries over UDP. Known clients and
/// robots stay far below it.
pub const DATAGRAM_BYTES_MAX: usize = 1472;

/// Decodes a sensor's position guidance.
///
/// # Errors
/// When the bytes are no such message. What the message says is not judged.
pub fn decode_sensor(datagram: &[u8]) -> Result<EgmSensor, Refusal> {
    decode(datagram)
}

/// Decodes a robot's message.
///
/// # Errors
/// When the bytes are no such message. What the message says is not judged.
pub fn decode_robot(datagram: &[u8]) -> Result<EgmRobot, Refusal> {
    decode(datagram)
}

/// Decodes a sensor's path correction.
///
/// # Errors
/// When the bytes are no such message. What the message says is not judged.
pub fn decode_path_correction(datagram: &[u8]) -> Result<EgmSensorPathCorr, Refusal> {
    decode(datagram)
}

fn decode<M: Message + Default>(datagram: &[u8]) -> Result<M, Refusal> {
    let mut message = M::default();
    merge(datagram, &mut message)?;
    Ok(message)
}

/// Adds what the datagram says to `message`: with a cleared one, the same as decoding into it.
pub(crate) fn merge<M: Message>(datagram: &[u8], message: &mut M) -> Result<(), Refusal> {
    if datagram.len() > DATAGRAM_BYTES_MAX {
        return Err(Refusal::TooLong {
            length_bytes: datagram.len(),
        });
    }
    // Which byte it failed at helps nobody: the whole datagram is refused and counted.
    message
        .merge(datagram)
        .map_err(|_at_byte| Refusal::NotProtobuf)
}

/// Only the header: to tell a message of another type from bytes that are no message.
#[derive(Clone, PartialEq, prost::Message)]
struct AnyMessage {
    #[prost(message, optional, tag = "1")]
    header: Option<messages::EgmHeader>,
}

/// The type a datagram says it is, whatever the rest of it holds.
pub fn message_type(datagram: &[u8]) -> Option<MessageType> {
    let header = decode::<AnyMessage>(datagram).ok()?.header?;
    MessageType::try_from(header.mtype?).ok()
}

/// Encodes `message` into `buffer`, replacing what it held; allocates only when its capacity is
/// too small.
#[expect(clippy::missing_panics_doc, reason = "a vector never lacks room")]
pub fn encode(message: &impl Message, buffer: &mut Vec<u8>) {
    buffer.clear();
    message
        .encode(buffer)
        .expect("a vector grows, and that is the one thing encoding can lack");
}

#[cfg(test)]
pub(crate) mod golden_tests;

/// Joints of the robot itself in a message.
pub const ROBOT_JOINT_COUNT: usize = 6;

/// Place of J7 in the chain.
pub const EXTERNAL_PLACE: usize = 2;

/// Place in the chain of each joint J1 to J6.
pub const ROBOT_PLACES: [usize; ROBOT_JOINT_COUNT] = [0, 1, 3, 4, 5, 6];

const _: () = {
    let mut joint = 0;
    while joint < ROBOT_JOINT_COUNT {
        assert!(CHAIN_TO_MAKER[ROBOT_PLACES[joint]] == joint + 1);
        joint += 1;
    }
    assert!(CHAIN_TO_MAKER[EXTERNAL_PLACE] == JOINT_COUNT);
};

/// One value per joint in the order and unit of the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireJoints {
    /// J1 to J6, degrees or degrees/s.
    pub robot_deg: [f64; ROBOT_JOINT_COUNT],
    /// J7, degrees or degrees/s.
    pub external_deg: f64,
}

impl WireJoints {
    /// From chain order, rad or rad/s.
    pub fn from_chain(chain_rad: &Joints) -> Self {
        Self {
            robot_deg: ROBOT_PLACES.map(|place| chain_rad[place].to_degrees()),
            external_deg: chain_rad[EXTERNAL_PLACE].to_degrees(),
        }
    }

    /// To chain order, rad or rad/s.
    pub fn to_chain(&self) -> Joints {
        let mut chain_rad = [0.0; JOINT_COUNT];
        for (value_deg, place) in self.robot_deg.iter().zip(ROBOT_PLACES) {
            chain_rad[place] = value_deg.to_radians();
        }
        chain_rad[EXTERNAL_PLACE] = self.external_deg.to_radians();
        chain_rad
    }
}

#[cfg(test)]
mod joints_tests {
    use super::*;

    #[test]
    fn the_third_of_the_chain_is_the_first_external_axis() {
        let chain_rad = [1.0, 2.0, 7.0, 3.0, 4.0, 5.0, 6.0].map(f64::to_radians);
        let wire = WireJoints::from_chain(&chain_rad);
        for (joint, value_deg) in wire.robot_deg.iter().enumerate() {
            assert!((value_deg - (joint + 1) as f64).abs() < 1e-12);
        }
        assert!((wire.external_deg - 7.0).abs() < 1e-12);
        for (back, there) in wire.to_chain().iter().zip(&chain_rad) {
            assert!((back - there).abs() < 1e-15);
        }
    }
}
