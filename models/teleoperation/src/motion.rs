//! Human motion as a function of time: one loop, synthetic or recorded, and a player that repeats
//! it. It publishes nothing: the role "human" does.

use nalgebra::Isometry3;

use crate::bvh::Bvh;
use crate::skeleton::Skeleton;
use crate::swing::Swing;
use hil_core::random::RandomStream;

/// Root and hands in the capture's frame: x to the person's left, y up, z forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HumanPose {
    /// Pelvis.
    pub root: Isometry3<f64>,
    /// Right hand.
    pub right_hand: Isometry3<f64>,
    /// Left hand.
    pub left_hand: Isometry3<f64>,
}

/// What a loop may take, seconds.
pub(crate) const LOOP_S: core::ops::RangeInclusive<f64> = 0.5..=60.0;

/// Why a motion file cannot be played.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// The skeleton lacks a hand.
    #[error("no joint is {wanted}; there are {}", .joints.join(", "))]
    MissingJoint {
        /// What was looked for.
        wanted: String,
        /// The names that there are.
        joints: Vec<String>,
    },
    /// The file ends too early for the period.
    #[error(
        "{frame_count} frames every {frame_time_s} s end too early for a loop of {period_s} s, and fill {}",
        filled(*frame_count, *frame_time_s)
    )]
    TooShort {
        /// Frames in the file.
        frame_count: usize,
        /// Seconds from frame to frame.
        frame_time_s: f64,
        /// The loop's period.
        period_s: f64,
    },
}

/// The loop that so many frames fill.
fn filled(frame_count: usize, frame_time_s: f64) -> String {
    let length_s = (frame_count as f64 * frame_time_s * 1e6).round() / 1e6;
    if LOOP_S.contains(&length_s) {
        format!("one of motion_period_s = {length_s}")
    } else {
        let (least, most) = (LOOP_S.start(), LOOP_S.end());
        format!("{length_s} s; a loop is of {least} to {most} s")
    }
}

/// Where in a skeleton root and hands are: turns frames into poses, one at a time.
#[derive(Debug, Clone)]
pub struct Actor {
    pub(crate) skeleton: Skeleton,
    pub(crate) right_hand: usize,
    pub(crate) left_hand: usize,
    pub(crate) unit_m: f64,
}

impl Actor {
    /// The person of `skeleton`, lengths times `unit_m`, with the hands as they are named.
    ///
    /// # Errors
    /// When a hand is missing.
    pub fn new(skeleton: &Skeleton, hands: Hands<'_>, unit_m: f64) -> Result<Self, MotionError> {
        let find = |given: Option<&str>, side: [&str; 2]| {
            let found = match given {
                Some(name) => skeleton.find(|joint| joint == name),
                None => ["hand", "wrist"]
                    .iter()
                    .find_map(|part| skeleton.find(|joint| is_part(joint, side, part))),
            };
            found.ok_or_else(|| MotionError::MissingJoint {
                wanted: given.map_or_else(
                    || format!("a {} hand by its name", side[0]),
                    |name| format!("called \"{name}\""),
                ),
                joints: skeleton
                    .joints()
                    .iter()
                    .map(|one| one.name.clone())
                    .collect(),
            })
        };
        Ok(Self {
            right_hand: find(hands.right, ["right", "r"])?,
            left_hand: find(hands.left, ["left", "l"])?,
            skeleton: skeleton.clone(),
            unit_m,
        })
    }

    /// Root and hands in the frame of these channel values, one per channel of the skeleton.
    pub fn pose(&self, values: &[f64]) -> HumanPose {
        let of = |joint| self.skeleton.pose(joint, values, self.unit_m);
        HumanPose {
            root: of(0),
            right_hand: of(self.right_hand),
            left_hand: of(self.left_hand),
        }
    }
}

/// One loop of recorded motion. It is repeated by time, not by frames: a loop need not be a whole
/// number of frames long, and over hundreds of loops the rest would add up.
#[derive(Debug, Clone)]
pub struct Recording {
    poses: Vec<HumanPose>,
    frame_time_s: f64,
    period_s: f64,
}

/// The joints that are hands, where they are named.
#[derive(Debug, Clone, Copy, Default)]
pub struct Hands<'a> {
    /// The right one.
    pub right: Option<&'a str>,
    /// The left one.
    pub left: Option<&'a str>,
}

/// True for a joint whose name ends with the words `part` and one of `side`, in either order and whatever is before:
/// `RightHand`, `mixamorig:RightHand`, `Bip01 R Hand`, `Hand_R`, `hand.R`.
fn is_part(joint: &str, side: [&str; 2], part: &str) -> bool {
    let words = words(joint);
    match &words[..] {
        [.., one, other] if side.contains(&one.as_str()) && other == part => true,
        [.., one, other] if side.contains(&other.as_str()) && one == part => true,
        [.., last] => *last == format!("{}{part}", side[0]),
        [] => false,
    }
}

/// The words of a name in small letters: separated by what is no letter or digit, or by capitals.
fn words(name: &str) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    let letters: Vec<char> = name.chars().collect();
    for (index, letter) in letters.iter().enumerate() {
        let before = index.checked_sub(1).map(|before| letters[before]);
        let is_small = |other: Option<&char>| other.is_some_and(|one| one.is_lowercase());
        let begins = before.is_none_or(|before| {
            let ends_small = !before.is_uppercase() || is_small(letters.get(index + 1));
            !before.is_alphanumeric() || (letter.is_uppercase() && ends_small)
        });
        if !letter.is_alphanumeric() {
            continue;
        }
        if begins || words.is_empty() {
            words.push(String::new());
        }
        if let Some(word) = words.last_mut() {
            word.extend(letter.to_lowercase());
        }
    }
    words
}

impl Recording {
    /// The part of `bvh` before `period_s`, lengths times `unit_m`, with the hands as they are
    /// named. The loop closes from the last frame to the first in what is left of the period, at most two frame times.
    ///
    /// # Errors
    /// When a hand is missing or the file ends too early.
    pub fn new(
        bvh: &Bvh,
        hands: Hands<'_>,
        period_s: f64,
        unit_m: f64,
    ) -> Result<Self, MotionError> {
        let actor = Actor::new(&bvh.skeleton, hands, unit_m)?;
        let frame_time_s = bvh.frame_time_s;
        let poses: Vec<_> = bvh
            .frames()
            .enumerate()
            .take_while(|(index, _)| (*index as f64) * frame_time_s < period_s)
            .map(|(_, values)| actor.pose(values))
            .collect();
        if (poses.len() as f64 + 1.0) * frame_time_s < period_s - 1e-9 {
            return Err(MotionError::TooShort {
                frame_count: bvh.frame_count(),
                frame_time_s,
                period_s,
            });
        }
        Ok(Self {
            poses,
            frame_time_s,
            period_s,
        })
    }

    /// Root and hands `time_s` into the loop, 0..period; between frames on a straight line.
    pub fn at(&self, time_s: f64) -> HumanPose {
        let last_index = self.poses.len() - 1;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "saturating, then bounded by the last frame"
        )]
        let index = ((time_s / self.frame_time_s) as usize).min(last_index);
        let begin_s = index as f64 * self.frame_time_s;
        let (next_index, span_s) = if index < last_index {
            (index + 1, self.frame_time_s)
        } else {
            (0, self.period_s - begin_s)
        };
        let share = ((time_s - begin_s) / span_s).clamp(0.0, 1.0);
        let (from, to) = (&self.poses[index], &self.poses[next_index]);
        HumanPose {
            root: from.root.lerp_slerp(&to.root, share),
            right_hand: from.right_hand.lerp_slerp(&to.right_hand, share),
            left_hand: from.left_hand.lerp_slerp(&to.left_hand, share),
        }
    }
}

/// One loop of motion.
#[derive(Debug, Clone)]
pub enum Motion {
    /// Computed at any moment.
    Synthetic(Swing),
    /// Read from a motion file.
    Recorded(Recording),
}

impl Motion {
    /// Root and hands at `phase` of the loop, 0..1, of nominal length `period_s`.
    fn at(&self, phase: f64, period_s: f64) -> HumanPose {
        match self {
            Self::Synthetic(swing) => swing.at(phase),
            Self::Recorded(recording) => recording.at(phase * period_s),
        }
    }

    /// How far the right hand moves from side to side in one loop, metres.
    pub fn lateral_peak_to_peak_m(&self, period_s: f64) -> f64 {
        let samples = (0..2000).map(|step| {
            let pose = self.at(f64::from(step) / 2000.0, period_s);
            pose.right_hand.translation.x
        });
        let (min, max) = samples.fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), x| {
            (min.min(x), max.max(x))
        });
        max - min
    }
}

/// Repeats a motion for ever; with variation, every loop has its own period and amplitude.
#[derive(Debug, Clone)]
pub struct Player {
    motion: Motion,
    start_s: f64,
    period_s: f64,
    variation_ratio: f64,
    random: RandomStream,
    resting: HumanPose,
    loop_index: u64,
    loop_start_s: f64,
    loop_period_s: f64,
    amplitude_before: f64,
    amplitude_after: f64,
}

/// Human amplitudes scatter about three times as much as periods.
const AMPLITUDE_PER_PERIOD_VARIATION: f64 = 3.0;

impl Player {
    /// Plays `motion` with loops of `period_s` on average. `variation_ratio` is the standard
    /// deviation of a loop's period; the amplitude's is three times that, both cut at three
    /// standard deviations.
    pub fn new(motion: Motion, period_s: f64, variation_ratio: f64, random: RandomStream) -> Self {
        let resting = motion.at(0.0, period_s);
        let mut player = Self {
            motion,
            start_s: 0.0,
            period_s,
            variation_ratio,
            random,
            resting,
            loop_index: 0,
            loop_start_s: 0.0,
            loop_period_s: period_s,
            amplitude_before: 1.0,
            amplitude_after: 1.0,
        };
        player.draw();
        player
    }

    /// Rests where the motion begins until `start_s`.
    #[must_use]
    pub fn starting_at(self, start_s: f64) -> Self {
        Self { start_s, ..self }
    }

    /// The pose at `time_s`. Calls come in non-decreasing time.
    pub fn at(&mut self, time_s: f64) -> HumanPose {
        let time_s = (time_s - self.start_s).max(0.0);
        while time_s >= self.loop_start_s + self.loop_period_s {
            self.next_loop();
        }
        let phase = ((time_s - self.loop_start_s) / self.loop_period_s).clamp(0.0, 1.0);
        let mut pose = self.motion.at(phase, self.period_s);
        if self.variation_ratio > 0.0 {
            // The amplitude glides through the loop, so that neither position nor speed jumps.
            let glide = phase * phase * (3.0 - 2.0 * phase);
            let amplitude =
                self.amplitude_before + glide * (self.amplitude_after - self.amplitude_before);
            let origin = self.resting.right_hand.translation.vector;
            let position = &mut pose.right_hand.translation.vector;
            *position = origin + (*position - origin) * amplitude;
        }
        pose
    }

    fn next_loop(&mut self) {
        self.loop_index += 1;
        self.loop_start_s = if self.variation_ratio > 0.0 {
            self.loop_start_s + self.loop_period_s
        } else {
            // A product does not pile up rounding errors over an hour; a sum does.
            self.loop_index as f64 * self.period_s
        };
        self.amplitude_before = self.amplitude_after;
        self.draw();
    }

    fn draw(&mut self) {
        if self.variation_ratio > 0.0 {
            let period = self.random.normal().clamp(-3.0, 3.0);
            let amplitude = self.random.normal().clamp(-3.0, 3.0);
            self.loop_period_s = self.period_s * (1.0 + self.variation_ratio * period);
            self.amplitude_after =
                1.0 + AMPLITUDE_PER_PERIOD_VARIATION * self.variation_ratio * amplitude;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::swing::{UNIT_M, swing_bvh};

    const PERIOD_S: f64 = 4.033;

    fn player(variation_ratio: f64, seed: u64) -> Player {
        let motion = Motion::Synthetic(Swing::new(0.1875).unwrap());
        Player::new(
            motion,
            PERIOD_S,
            variation_ratio,
            RandomStream::new(seed, "motion"),
        )
    }

    #[test]
    fn eight_hundred_and_ninety_loops_do_not_drift() {
        let (mut player, mut fresh) = (player(0.0, 0), player(0.0, 0));
        for loop_index in 0..890 {
            let time_s = f64::from(loop_index) * PERIOD_S + 1.0;
            let heard = player.at(time_s).right_hand.translation.vector;
            let computed = fresh.motion.at(1.0 / PERIOD_S, PERIOD_S).right_hand;
            let apart_m = (heard - computed.translation.vector).norm();
            assert!(apart_m < 1e-10, "{apart_m} m in loop {loop_index}");
        }
        assert_eq!(fresh.at(0.0), fresh.resting);
    }

    #[test]
    fn a_recorded_loop_of_504_frames_and_a_bit_is_repeated_by_time() {
        // 4.033 s are 504.125 frames of 125 Hz: repeated by frames, 890 loops would end 0.89 s off.
        let bvh = Bvh::parse(&swing_bvh(PERIOD_S, 0.1875, 125.0).unwrap().as_str().into()).unwrap();
        let motion =
            Motion::Recorded(Recording::new(&bvh, Hands::default(), PERIOD_S, UNIT_M).unwrap());
        let random = RandomStream::new(0, "motion");
        let (mut recorded, mut computed) =
            (Player::new(motion, PERIOD_S, 0.0, random), player(0.0, 0));
        for loop_index in [0, 1, 100, 889] {
            for part in [0.1, 1.0, 2.5, 4.03] {
                let time_s = f64::from(loop_index) * PERIOD_S + part;
                let [a, b] = [&mut recorded, &mut computed]
                    .map(|player| player.at(time_s).right_hand.translation.vector);
                assert!((a - b).norm() < 1e-4, "{time_s} s: {}", (a - b).norm());
            }
        }
    }

    #[test]
    fn varied_loops_stay_continuous_and_scatter_as_told() {
        let mut player = player(0.01, 4);
        let (mut periods, mut before) = (Vec::new(), player.at(0.0));
        let mut loop_index = 0;
        for step in 1..400_000 {
            let pose = player.at(f64::from(step) * 0.004);
            let [to, from] = [pose, before].map(|pose| pose.right_hand.translation.vector);
            let moved_m = (to - from).norm();
            // 0.1875 m * 1.09 * 2 pi / 3.9 s over 4 ms, with the arc's share.
            assert!(moved_m < 1.5e-3, "{moved_m} m at step {step}");
            before = pose;
            if player.loop_index > loop_index {
                loop_index = player.loop_index;
                periods.push(player.loop_period_s);
            }
        }
        let n = periods.len() as f64;
        let mean = periods.iter().sum::<f64>() / n;
        let variance = periods.iter().map(|p| (p - mean).powi(2)).sum::<f64>() / (n - 1.0);
        assert!((mean / PERIOD_S - 1.0).abs() < 5.0 * 0.01 / n.sqrt());
        assert!((variance.sqrt() / PERIOD_S - 0.01).abs() < 0.002);
    }

    #[test]
    fn equal_seeds_vary_equally() {
        let (mut a, mut b, mut c) = (player(0.01, 1), player(0.01, 1), player(0.01, 2));
        let (a, b, c) = (a.at(50.0), b.at(50.0), c.at(50.0));
        assert_eq!(a, b);
        assert_ne!(a, c);
    }

    #[test]
    fn before_its_start_the_human_rests() {
        let (mut late, mut prompt) = (player(0.01, 3).starting_at(2.0), player(0.01, 3));
        assert_eq!(late.at(0.0), late.resting);
        assert_eq!(late.at(1.999), late.resting);
        assert_eq!(late.at(9.5), prompt.at(7.5));
    }

    #[test]
    fn a_file_that_ends_too_early_is_refused_with_its_length() {
        let bvh = Bvh::parse(&swing_bvh(2.0, 0.1, 125.0).unwrap().as_str().into()).unwrap();
        let error = Recording::new(&bvh, Hands::default(), PERIOD_S, UNIT_M).unwrap_err();
        assert!(
            error.to_string().starts_with("250 frames every 0.008 s"),
            "{error}"
        );
        let told = error.to_string();
        assert!(
            told.ends_with("and fill one of motion_period_s = 2"),
            "{told}"
        );
        assert!(Recording::new(&bvh, Hands::default(), 2.0, UNIT_M).is_ok());
        assert!(Recording::new(&bvh, Hands::default(), 1.0, UNIT_M).is_ok());
        // Nine frames at 20 Hz are no loop that could be asked for.
        let few = MotionError::TooShort {
            frame_count: 9,
            frame_time_s: 0.05,
            period_s: PERIOD_S,
        };
        let told = few.to_string();
        assert!(
            told.ends_with("and fill 0.45 s; a loop is of 0.5 to 60 s"),
            "{told}"
        );
    }

    #[test]
    fn a_file_without_hands_is_refused() {
        let text = swing_bvh(2.0, 0.1, 125.0)
            .unwrap()
            .replace("LeftHand", "Hook");
        let bvh = Bvh::parse(&text.as_str().into()).unwrap();
        let error = Recording::new(&bvh, Hands::default(), 2.0, UNIT_M).unwrap_err();
        let text = error.to_string();
        assert!(text.starts_with("no joint is a left hand"), "{text}");
        assert!(
            text.contains("RightHand") && text.contains("Hook"),
            "{text}"
        );
        // The names that the message lists can be given.
        let hands = Hands {
            right: None,
            left: Some("Hook"),
        };
        assert!(Recording::new(&bvh, hands, 2.0, UNIT_M).is_ok());
    }

    #[test]
    fn hands_are_found_by_the_names_that_programs_give_them() {
        for name in [
            "RightHand",
            "righthand",
            "mixamorig:RightHand",
            "Bip01 R Hand",
            "Hand_R",
            "hand.R",
            "rHand",
            "RHand",
            "Armature_hand.r",
            "Hand Right",
        ] {
            assert!(is_part(name, ["right", "r"], "hand"), "{name}");
            assert!(!is_part(name, ["left", "l"], "hand"), "{name}");
        }
        for name in ["RightHandThumb1", "otherhand", "Hand", "RightForeArm", ""] {
            assert!(!is_part(name, ["right", "r"], "hand"), "{name}");
        }
    }
}
