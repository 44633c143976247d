//! Why a datagram, or a command to be sent, is not taken: the causes and their counts. It decides
//! nothing: the adapters do.

use serde::{Deserialize, Serialize};

use crate::egm::wire::{DATAGRAM_BYTES_MAX, ROBOT_JOINT_COUNT};

/// One datagram or command that is not taken.
///
/// Joints carry the maker's numbers, J1 to J7.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Longer than any message.
    #[error("datagram of {length_bytes} bytes is longer than {DATAGRAM_BYTES_MAX}")]
    TooLong {
        /// Its length.
        length_bytes: usize,
    },
    /// Not the bytes of the message expected.
    #[error("datagram is not the protobuf message expected")]
    NotProtobuf,
    /// No header: nothing says what it is.
    #[error("message has no header")]
    MissingHeader,
    /// A message, but of another type.
    #[error("message type {found} is not {expected}")]
    WrongMessageType {
        /// Type in its header, as a number; 0 when it does not say.
        found: i32,
        /// The type expected.
        expected: i32,
    },
    /// No joints: pose or speed guidance alone is not what a joint session takes.
    #[error("message has no joints")]
    MissingJoints,
    /// Another number of values than the arm has joints.
    #[error(
        "{robot_count} joints and {external_count} external axes do not make {joint_count} \
         joints, {ROBOT_JOINT_COUNT} of them the robot's"
    )]
    WrongArity {
        /// Joints found.
        robot_count: usize,
        /// External axes found.
        external_count: usize,
        /// Joints expected, J7 included.
        joint_count: usize,
    },
    /// A value that is no finite number.
    #[error("value of J{joint} is not a finite number")]
    NotFinite {
        /// The first such joint; 0 stands for the tool's pose.
        joint: usize,
    },
    /// A position outside the joint's limits.
    #[error("J{joint} at {value_rad} rad is outside {min_rad} to {max_rad}")]
    OutsideLimits {
        /// The first such joint.
        joint: usize,
        /// Its value.
        value_rad: f64,
        /// Lowest position.
        min_rad: f64,
        /// Highest position.
        max_rad: f64,
    },
    /// A speed no joint of a robot reaches.
    #[error("J{joint} at {value_rad_per_s} rad/s is faster than {max_rad_per_s}")]
    TooFast {
        /// The first such joint.
        joint: usize,
        /// Its value.
        value_rad_per_s: f64,
        /// Highest speed taken.
        max_rad_per_s: f64,
    },
    /// A command before the robot has sent anything.
    #[error("the robot has not opened a session yet")]
    NoSession,
    /// A message that came before: the network duplicated it (RFC 5560).
    #[error("message {seqno} came before")]
    Repeated {
        /// Its number.
        seqno: u32,
    },
    /// A message older than one already taken: the network reordered it (RFC 4737).
    #[error("message {seqno} came after {newest}")]
    Overtaken {
        /// Its number.
        seqno: u32,
        /// The newest number taken.
        newest: u32,
    },
}

/// Makes [`Cause`] of the names of all refusals and a few words for each.
macro_rules! causes {
    ($($cause:ident: $label:literal),+ $(,)?) => {
        /// A [`Refusal`] without its numbers: what is counted.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        #[repr(usize)]
        pub enum Cause {
            $(#[doc = concat!("[`Refusal::", stringify!($cause), "`].")] $cause,)+
        }

        impl Cause {
            /// Every cause, in the order of the counts.
            pub const ALL: [Self; Self::COUNT] = [$(Self::$cause),+];

            /// Number of causes.
            pub const COUNT: usize = [$($label),+].len();

            /// A few words for a report.
            pub const fn label(self) -> &'static str {
                match self {
                    $(Self::$cause => $label,)+
                }
            }
        }

        impl Refusal {
            /// Its cause.
            pub const fn cause(&self) -> Cause {
                match self {
                    $(Self::$cause { .. } => Cause::$cause,)+
                }
            }
        }
    };
}

causes! {
    TooLong: "too long",
    NotProtobuf: "not protobuf",
    MissingHeader: "missing header",
    WrongMessageType: "wrong message type",
    MissingJoints: "no joints",
    WrongArity: "wrong number of joints",
    NotFinite: "not a finite number",
    OutsideLimits: "outside joint limits",
    TooFast: "too fast",
    NoSession: "no session",
    Overtaken: "reordered",
    Repeated: "duplicated",
}

/// What became of the datagrams or commands of one direction. Without allocation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DatagramCounts {
    accepted_count: u64,
    refused_counts: [u64; Cause::COUNT],
}

impl DatagramCounts {
    /// Counts one outcome and hands it on.
    ///
    /// # Errors
    /// The refusal it was given.
    pub fn note<T>(&mut self, outcome: Result<T, Refusal>) -> Result<T, Refusal> {
        match &outcome {
            Ok(_) => self.accepted_count += 1,
            Err(refusal) => self.refused_counts[refusal.cause() as usize] += 1,
        }
        outcome
    }

    /// Those taken.
    pub fn accepted(&self) -> u64 {
        self.accepted_count
    }

    /// Those refused for `cause`.
    pub fn refused(&self, cause: Cause) -> u64 {
        self.refused_counts[cause as usize]
    }

    /// All that came.
    pub fn total(&self) -> u64 {
        self.accepted_count + self.refused_counts.iter().sum::<u64>()
    }

    /// Cause and count of each cause that occurred.
    pub fn causes(&self) -> impl Iterator<Item = (Cause, u64)> + '_ {
        let counted = Cause::ALL.into_iter().zip(self.refused_counts);
        counted.filter(|(_, count)| *count > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_outcome_is_counted_once() {
        let mut counts = DatagramCounts::default();
        for index in 0..10 {
            let outcome = match index % 3 {
                0 => Ok(index),
                1 => Err(Refusal::MissingHeader),
                _ => Err(Refusal::NotFinite { joint: 7 }),
            };
            assert_eq!(counts.note(outcome), outcome);
        }
        assert_eq!((counts.accepted(), counts.total()), (4, 10));
        let causes: Vec<_> = counts.causes().collect();
        assert_eq!(causes, [(Cause::MissingHeader, 3), (Cause::NotFinite, 3)]);
    }

    #[test]
    fn a_refusal_states_value_and_bound() {
        let refusal = Refusal::WrongArity {
            robot_count: 12,
            external_count: 1,
            joint_count: 7,
        };
        let said = refusal.to_string();
        assert!(
            said.starts_with("12 joints and 1 external axes do not make 7 joints"),
            "{said}"
        );
        assert_eq!(refusal.cause().label(), "wrong number of joints");
    }
}
