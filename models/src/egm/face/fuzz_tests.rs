//! A million datagrams nobody meant: each is taken or refused and counted, none panics, and what
//! is taken is judged again from scratch.

use super::face_tests::{AT_ONCE, command, feedback, opened, robot_face, sensor_face};
use super::*;
use crate::egm::messages::{EgmCommand, EgmFeedback};
use crate::egm::wire::golden_tests::all;
use crate::egm::wire::messages::EgmJoints;
use crate::egm::wire::{self, Cause, DATAGRAM_BYTES_MAX, Refusal};
use crate::random::RandomStream;
use crate::time::Instant;
use crate::yumi::Joints;
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD};

const MUTANT_COUNT: usize = 1_000_000;
const SEED: u64 = 7;

/// Values a joint shall never be given, and some just inside what it may.
const NUMBERS: [f64; 10] = [
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::MAX,
    5e-324,
    -0.0,
    168.5,
    168.500_001,
    -1e9,
    400.0,
];

struct Mutator {
    stream: RandomStream,
    originals: Vec<Vec<u8>>,
    mutant: Vec<u8>,
}

impl Mutator {
    fn new(name: &str, originals: Vec<Vec<u8>>) -> Self {
        Self {
            stream: RandomStream::new(SEED, name),
            originals,
            mutant: Vec::with_capacity(4096),
        }
    }

    fn below(&mut self, bound: usize) -> usize {
        let bound = u64::try_from(bound.max(1)).unwrap();
        usize::try_from(self.stream.next_u64() % bound).unwrap()
    }

    fn next(&mut self) -> &[u8] {
        let chosen = self.below(self.originals.len());
        self.mutant.clear();
        self.mutant.extend_from_slice(&self.originals[chosen]);
        // One in five stays whole but for the numbers in it.
        for _ in 0..self.below(4) {
            self.mutate();
        }
        &self.mutant
    }

    fn mutate(&mut self) {
        let place = self.below(self.mutant.len());
        let Some(byte) = self.mutant.get(place).copied() else {
            return;
        };
        match self.below(9) {
            0 => self.mutant[place] = byte ^ (1 << self.below(8)),
            1 => self.mutant.truncate(place),
            2 => {
                let length = self.below(8);
                self.insert(place, length);
            }
            3 => {
                let length = if self.stream.chance(0.05) { 1500 } else { 40 };
                let length = self.below(length);
                self.insert(place, length);
            }
            4 => self.splice(place),
            5 => self.change_length_field(),
            6 => self.duplicate_field(),
            _ => self.replace_number(),
        }
    }

    fn insert(&mut self, place: usize, length: usize) {
        for _ in 0..length {
            let value = self.stream.next_u64().to_le_bytes()[0];
            self.mutant.insert(place, value);
        }
    }

    /// The head of this one and the tail of another.
    fn splice(&mut self, place: usize) {
        let chosen = self.below(self.originals.len());
        let cut = self.below(self.originals[chosen].len());
        self.mutant.truncate(place);
        self.mutant
            .extend_from_slice(&self.originals[chosen][cut..]);
    }

    /// A byte that follows what looks like the key of a length-delimited field.
    fn change_length_field(&mut self) {
        let start = self.below(self.mutant.len());
        let is_key = |byte: &u8| byte & 7 == 2;
        let key = self.mutant[start..].iter().position(is_key);
        if let Some(length) = key.and_then(|offset| self.mutant.get_mut(start + offset + 1)) {
            let step = self.stream.next_u64().to_le_bytes()[0] % 7;
            *length = length.wrapping_add(step).wrapping_sub(3);
        }
    }

    /// A whole field of the outermost message, once more at its end.
    fn duplicate_field(&mut self) {
        let mut fields = Vec::new();
        let mut start = 0;
        while let [_, length, rest @ ..] = &self.mutant[start..] {
            // Lengths above 127 take two bytes.
            let (length, head) = match rest.first() {
                Some(high) if *length > 127 => {
                    (usize::from(*length & 127) + 128 * usize::from(*high), 3)
                }
                _ => (usize::from(*length), 2),
            };
            let end = (start + head + length).min(self.mutant.len());
            fields.push(start..end);
            start = end;
        }
        if !fields.is_empty() {
            let chosen = self.below(fields.len());
            self.mutant.extend_from_within(fields[chosen].clone());
        }
    }

    /// Eight bytes that look like a number of a list, replaced by one that is hard to digest.
    fn replace_number(&mut self) {
        let start = self.below(self.mutant.len());
        let key = self.mutant[start..].iter().position(|byte| *byte == 0x09);
        let number = NUMBERS[self.below(NUMBERS.len())];
        let place = key.map_or(start, |offset| start + offset + 1);
        if let Some(bytes) = self.mutant.get_mut(place..place + 8) {
            bytes.copy_from_slice(&number.to_le_bytes());
        }
    }
}

fn count(list: Option<&EgmJoints>) -> usize {
    list.map_or(0, |list| list.joints.len())
}

fn is_within(joints: &Joints, slack_rad: f64) -> bool {
    let limits = POSITION_MIN_RAD.iter().zip(&POSITION_MAX_RAD);
    let mut places = joints.iter().zip(limits);
    places.all(|(value, (min, max))| (min - slack_rad..=max + slack_rad).contains(value))
}

fn judge_command(command: &EgmCommand, datagram: &[u8], axes: Axes) {
    assert!(is_within(&command.position_rad, 0.0), "{command:?}");
    let sensor = wire::decode_sensor(datagram).unwrap();
    let planned = sensor.planned.unwrap();
    assert_eq!(count(planned.joints.as_ref()), 6);
    assert_eq!(count(planned.external_joints.as_ref()), axes.count() - 6);
    assert_eq!(command.flags & !EgmCommand::HAS_SPEED, 0);
    let speeds = command.speed_rad_per_s;
    assert!(
        speeds
            .iter()
            .all(|speed| speed.abs() <= SPEED_REFERENCE_MAX_RAD_PER_S)
    );
    if command.flags & EgmCommand::HAS_SPEED != 0 {
        let part = sensor.speed_ref.unwrap();
        assert_eq!(count(part.joints.as_ref()), 6);
        assert_eq!(count(part.external_joints.as_ref()), axes.count() - 6);
    }
}

fn judge_feedback(feedback: &EgmFeedback, datagram: &[u8], axes: Axes) {
    assert!(
        is_within(&feedback.measured_rad, FEEDBACK_SLACK_RAD),
        "{feedback:?}"
    );
    assert!(
        is_within(&feedback.planned_rad, FEEDBACK_SLACK_RAD),
        "{feedback:?}"
    );
    assert!(feedback.session_state().is_some());
    let robot = wire::decode_robot(datagram).unwrap();
    let (measured, planned) = (robot.feed_back.unwrap(), robot.planned.unwrap());
    assert_eq!(
        (
            count(measured.joints.as_ref()),
            count(planned.joints.as_ref())
        ),
        (6, 6)
    );
    if axes == Axes::Seven {
        assert!(count(measured.external_joints.as_ref()) > 0);
        assert!(count(planned.external_joints.as_ref()) > 0);
    }
}

fn refused_labels(counts: &wire::DatagramCounts) -> Vec<&'static str> {
    counts.causes().map(|(cause, _)| cause.label()).collect()
}

#[test]
fn no_mutated_sensor_datagram_panics_or_passes_unjudged() {
    let wanted = |name: &str| !name.starts_with("robot");
    let originals = all()
        .filter(|(name, _)| wanted(name))
        .map(|(_, bytes)| bytes)
        .collect();
    let mut mutator = Mutator::new("sensor", originals);
    for axes in [Axes::Six, Axes::Seven] {
        let mut face = opened(axes);
        let mut accepted_count = 0;
        for _ in 0..MUTANT_COUNT / 4 {
            let datagram = mutator.next();
            match face.decode(datagram) {
                Ok(command) => {
                    judge_command(&command, datagram, axes);
                    assert_eq!(command.frame_index, accepted_count);
                    accepted_count += 1;
                }
                Err(Refusal::TooLong { length_bytes }) => {
                    assert!(length_bytes > DATAGRAM_BYTES_MAX);
                }
                Err(_) => {}
            }
        }
        let counts = face.received();
        assert_eq!(counts.total(), (MUTANT_COUNT / 4) as u64);
        assert_eq!(counts.accepted(), accepted_count);
        let share = accepted_count as f64 / counts.total() as f64;
        assert!((0.05..0.6).contains(&share), "{share}");
        // All but the two that depend on the session.
        assert_eq!(
            refused_labels(counts),
            Cause::ALL[..9]
                .iter()
                .map(|c| c.label())
                .collect::<Vec<_>>()
        );
    }
}

#[test]
fn no_mutated_robot_datagram_panics_or_passes_unjudged() {
    let named = all().filter(|(name, _)| name.starts_with("robot"));
    let mut originals: Vec<_> = named.map(|(_, bytes)| bytes).collect();
    let mut ours = robot_face(Axes::Seven, RobotWare::Seven);
    for cycle in 0..20 {
        let mut datagram = Vec::new();
        assert!(ours.encode(&feedback(cycle), core::time::Duration::ZERO, &mut datagram));
        originals.push(datagram);
    }
    let mut mutator = Mutator::new("robot", originals);
    for axes in [Axes::Six, Axes::Seven] {
        let mut face = sensor_face(axes, AT_ONCE);
        let (mut accepted_count, mut answer_count) = (0, 0);
        let mut answer = Vec::new();
        for index in 0..MUTANT_COUNT / 4 {
            let now = Instant::from_ns(i64::try_from(index).unwrap() * 4_000_000);
            let datagram = mutator.next();
            if let Ok(feedback) = face.decode(now, datagram) {
                judge_feedback(&feedback, datagram, axes);
                accepted_count += 1;
                face.command(&command(RIGHT_START_RAD)).unwrap();
            }
            while face.poll_transmit(now, &mut answer) {
                answer_count += 1;
            }
        }
        let counts = face.received();
        assert_eq!(counts.total(), (MUTANT_COUNT / 4) as u64);
        assert_eq!(
            (counts.accepted(), answer_count),
            (accepted_count, accepted_count)
        );
        let share = accepted_count as f64 / counts.total() as f64;
        assert!((0.05..0.6).contains(&share), "{share}");
        for cause in Cause::ALL {
            // A robot's datagram has no speeds and needs no session.
            let is_possible = !matches!(cause, Cause::TooFast | Cause::NoSession);
            assert_eq!(counts.refused(cause) > 0, is_possible, "{cause:?}");
        }
    }
}
