//! What both adapters demand of a message before its values are used.

use crate::egm::adapter::Axes;
use crate::egm::wire::messages::{EgmHeader, EgmJoints};
use crate::egm::wire::{
    EXTERNAL_PLACE, MessageType, ROBOT_JOINT_COUNT, Refusal, WireJoints, message_type,
};
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD};
use crate::yumi::{CHAIN_TO_MAKER, Joints};

/// How far outside its limits a commanded joint may be and still be taken, as the limit: what
/// converting to degrees and back can do to a joint that stands at its limit.
pub const COMMAND_SLACK_RAD: f64 = 1e-9;

/// How far outside its limits a foreign robot's joint may be reported: a servo overshoots. It is
/// passed on as it is.
pub const FEEDBACK_SLACK_RAD: f64 = 5.0_f64.to_radians();

/// Fastest speed reference taken, any joint: the largest `MaxSpeedDeviation`, more than twice
/// what the fastest joint reaches. Between a joint's own limit and this one the controller scales.
pub const SPEED_REFERENCE_MAX_RAD_PER_S: f64 = 1000.0_f64.to_radians();

/// Why `datagram`, which should have been an `expected`, could not be decoded.
pub(super) fn undecodable(error: Refusal, datagram: &[u8], expected: MessageType) -> Refusal {
    match message_type(datagram) {
        Some(found) if found != expected => wrong_type(found as i32, expected),
        _ => error,
    }
}

fn wrong_type(found: i32, expected: MessageType) -> Refusal {
    Refusal::WrongMessageType {
        found,
        expected: expected as i32,
    }
}

/// The header, if it is there and says `expected`.
pub(super) fn header_of(
    header: Option<&EgmHeader>,
    expected: MessageType,
) -> Result<&EgmHeader, Refusal> {
    let header = header.ok_or(Refusal::MissingHeader)?;
    let found = header.mtype.unwrap_or_default();
    if found == expected as i32 {
        Ok(header)
    } else {
        Err(wrong_type(found, expected))
    }
}

/// Who sent the joints, which decides how many external axes may be with them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sender {
    /// Exactly the joints of the session.
    Sensor,
    /// A robot may have further external axes; they are no part of the arm.
    Robot,
}

/// The values of one list of joints, chain order, rad or rad/s; `None` when there is none. J7
/// takes `held_rad` when the session does not move it.
pub(super) fn joints_of(
    joints: Option<&EgmJoints>,
    external: Option<&EgmJoints>,
    axes: Axes,
    sender: Sender,
    held_rad: f64,
) -> Result<Option<Joints>, Refusal> {
    let robot = joints.map_or(&[][..], |list| &list.joints);
    let external = external.map_or(&[][..], |list| &list.joints);
    if robot.is_empty() && external.is_empty() {
        return Ok(None);
    }
    let is_external_right = match (axes, sender) {
        (Axes::Seven, Sender::Sensor) => external.len() == 1,
        (Axes::Seven, Sender::Robot) => !external.is_empty(),
        (Axes::Six, Sender::Sensor) => external.is_empty(),
        (Axes::Six, Sender::Robot) => true,
    };
    let wrong_arity = Refusal::WrongArity {
        robot_count: robot.len(),
        external_count: external.len(),
        joint_count: axes.count(),
    };
    let Ok(robot_deg) = <[f64; ROBOT_JOINT_COUNT]>::try_from(robot) else {
        // A list without the robot's joints, such as a lone external axis, is not a joint list.
        return Err(if robot.is_empty() {
            Refusal::MissingJoints
        } else {
            wrong_arity
        });
    };
    if !is_external_right {
        return Err(wrong_arity);
    }
    let external_deg = external.first().copied().unwrap_or_default();
    let mut chain_rad = WireJoints {
        robot_deg,
        external_deg,
    }
    .to_chain();
    if axes == Axes::Six {
        chain_rad[EXTERNAL_PLACE] = held_rad;
    }
    finite(&chain_rad)?;
    Ok(Some(chain_rad))
}

fn finite(chain: &Joints) -> Result<(), Refusal> {
    match chain.iter().position(|value| !value.is_finite()) {
        Some(place) => Err(Refusal::NotFinite {
            joint: CHAIN_TO_MAKER[place],
        }),
        None => Ok(()),
    }
}

/// Positions no farther than `slack_rad` outside their limits.
pub(super) fn within_limits(chain_rad: &Joints, slack_rad: f64) -> Result<(), Refusal> {
    finite(chain_rad)?;
    let limits = POSITION_MIN_RAD.iter().zip(&POSITION_MAX_RAD);
    for (place, (value_rad, (min_rad, max_rad))) in chain_rad.iter().zip(limits).enumerate() {
        if *value_rad < min_rad - slack_rad || *value_rad > max_rad + slack_rad {
            return Err(Refusal::OutsideLimits {
                joint: CHAIN_TO_MAKER[place],
                value_rad: *value_rad,
                min_rad: *min_rad,
                max_rad: *max_rad,
            });
        }
    }
    Ok(())
}

/// Commanded positions, exactly within their limits.
pub(super) fn commanded(chain_rad: &Joints) -> Result<Joints, Refusal> {
    within_limits(chain_rad, COMMAND_SLACK_RAD)?;
    Ok(core::array::from_fn(|place| {
        chain_rad[place].clamp(POSITION_MIN_RAD[place], POSITION_MAX_RAD[place])
    }))
}

/// Speed references a robot could be meant to follow.
pub(super) fn speeds(chain_rad_per_s: &Joints) -> Result<(), Refusal> {
    finite(chain_rad_per_s)?;
    let too_fast = |speed: &f64| speed.abs() > SPEED_REFERENCE_MAX_RAD_PER_S;
    match chain_rad_per_s.iter().position(too_fast) {
        Some(place) => Err(Refusal::TooFast {
            joint: CHAIN_TO_MAKER[place],
            value_rad_per_s: chain_rad_per_s[place],
            max_rad_per_s: SPEED_REFERENCE_MAX_RAD_PER_S,
        }),
        None => Ok(()),
    }
}
