//! A path as evenly spaced poses. Way, indices and time: `index = floor(way / spacing)`. It is
//! geometry only; how fast a robot goes along it is the tracker's business.

use core::fmt;
use std::sync::Arc;

use crate::geometry::{Pose, floor_index};
use hil_core::message::{FNV_OFFSET, fnv1a};

/// A path's number in its [`PathLibrary`]: `2 n` is the n-th path, `2 n + 1` the same driven
/// backwards from its end to its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PathId(pub u32);

impl PathId {
    /// The same path the other way.
    #[must_use]
    pub const fn reversed(self) -> Self {
        Self(self.0 ^ 1)
    }

    /// Position in the library.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for PathId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let direction = if self.0 & 1 == 0 { "" } else { "'" };
        write!(f, "{}{direction}", self.0 / 2)
    }
}

/// Poses at even spacing along the way of a vehicle's reference point.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    poses: Vec<Pose>,
    spacing_m: f64,
    hash: u64,
}

/// Why a list of poses is no path.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PathError {
    /// Fewer than two distinct poses.
    #[error("a path needs two poses that differ, {count} given")]
    TooShort {
        /// Poses given.
        count: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("pose {index} of the path is not finite: ({x_m}, {y_m}, {heading_rad})")]
    NotFinite {
        /// Which pose.
        index: usize,
        /// Metres.
        x_m: f64,
        /// Metres.
        y_m: f64,
        /// Radians.
        heading_rad: f64,
    },
    /// The spacing is not a positive number.
    #[error("path spacing {spacing_m} m is not above 0")]
    Spacing {
        /// What was asked.
        spacing_m: f64,
    },
}

impl Path {
    /// Resamples `poses` evenly, at most `spacing_m` apart; headings turn the shorter way between
    /// them.
    ///
    /// # Errors
    /// When the poses do not make a path; see [`PathError`].
    pub fn new(poses: &[Pose], spacing_m: f64) -> Result<Self, PathError> {
        if !(spacing_m > 0.0 && spacing_m.is_finite()) {
            return Err(PathError::Spacing { spacing_m });
        }
        for (index, pose) in poses.iter().enumerate() {
            if !pose.is_finite() {
                return Err(PathError::NotFinite {
                    index,
                    x_m: pose.x_m,
                    y_m: pose.y_m,
                    heading_rad: pose.heading_rad,
                });
            }
        }
        let length_m: f64 = poses.windows(2).map(|two| two[0].distance_m(&two[1])).sum();
        if length_m <= 0.0 {
            let count = poses.len();
            return Err(PathError::TooShort { count });
        }
        let step_count = floor_index((length_m / spacing_m - 1e-9).ceil().max(1.0));
        let even_m = length_m / step_count as f64;
        Ok(Self::of_even(resample(poses, even_m, step_count), even_m))
    }

    fn of_even(poses: Vec<Pose>, spacing_m: f64) -> Self {
        let hash = hash_of(&poses);
        Self {
            poses,
            spacing_m,
            hash,
        }
    }

    /// The same way driven backwards: same poses, other order, same headings.
    #[must_use]
    pub fn reversed(&self) -> Self {
        let poses = self.poses.iter().rev().copied().collect();
        Self::of_even(poses, self.spacing_m)
    }

    /// The poses.
    pub fn poses(&self) -> &[Pose] {
        &self.poses
    }

    /// Way between neighbouring poses, metres.
    pub fn spacing_m(&self) -> f64 {
        self.spacing_m
    }

    /// Index of the last pose.
    pub fn last_index(&self) -> usize {
        self.poses.len() - 1
    }

    /// Whole way, metres.
    pub fn length_m(&self) -> f64 {
        self.way_to_m(self.last_index())
    }

    /// Way from the start to the pose `index`.
    pub fn way_to_m(&self, index: usize) -> f64 {
        index as f64 * self.spacing_m
    }

    /// Last pose at or before `way_m`; a way within a nanometre short of a pose counts as there.
    pub fn index_at(&self, way_m: f64) -> usize {
        floor_index(way_m / self.spacing_m + 1e-9).min(self.last_index())
    }

    /// The pose at `way_m`, between its neighbours.
    pub fn pose_at(&self, way_m: f64) -> Pose {
        let position = (way_m / self.spacing_m).clamp(0.0, self.last_index() as f64);
        let index = floor_index(position).min(self.last_index() - 1);
        self.poses[index].towards(&self.poses[index + 1], position - index as f64)
    }

    /// Fingerprint of the poses to the millimetre and milliradian: what two hosts compare.
    pub fn hash(&self) -> u64 {
        self.hash
    }
}

fn resample(poses: &[Pose], spacing_m: f64, step_count: usize) -> Vec<Pose> {
    let mut even = Vec::with_capacity(step_count + 1);
    let (mut segment, mut segment_start_m) = (0, 0.0);
    for step in 0..step_count {
        let way_m = step as f64 * spacing_m;
        let mut segment_length_m = poses[segment].distance_m(&poses[segment + 1]);
        while segment + 2 < poses.len() && way_m > segment_start_m + segment_length_m {
            segment_start_m += segment_length_m;
            segment += 1;
            segment_length_m = poses[segment].distance_m(&poses[segment + 1]);
        }
        let ratio = if segment_length_m > 0.0 {
            ((way_m - segment_start_m) / segment_length_m).clamp(0.0, 1.0)
        } else {
            0.0
        };
        even.push(poses[segment].towards(&poses[segment + 1], ratio));
    }
    even.extend(poses.last());
    even
}

fn hash_of(poses: &[Pose]) -> u64 {
    poses.iter().fold(FNV_OFFSET, |hash, pose| {
        [pose.x_m, pose.y_m, pose.heading_rad]
            .iter()
            .fold(hash, |hash, value| {
                // Rounded to a whole number, so equal on hosts whose last bits differ.
                fnv1a(hash, &((value * 1e3).round() + 0.0).to_bits().to_le_bytes())
            })
    })
}

/// All paths of a world, each in both directions.
#[derive(Debug, Clone, Default)]
pub struct PathLibrary {
    paths: Vec<Arc<Path>>,
}

impl PathLibrary {
    /// Adds a path and its reverse; gives the id of the forward one.
    ///
    /// # Panics
    /// Beyond 2^31 paths.
    pub fn add(&mut self, path: Path) -> PathId {
        let id = PathId(u32::try_from(self.paths.len()).expect("fewer than 2^31 paths"));
        let reversed = Arc::new(path.reversed());
        self.paths.push(Arc::new(path));
        self.paths.push(reversed);
        id
    }

    /// The path `id`; `None` for an unknown one.
    pub fn get(&self, id: PathId) -> Option<&Arc<Path>> {
        self.paths.get(id.index())
    }

    /// Number of ids, twice that of paths.
    pub fn len(&self) -> usize {
        self.paths.len()
    }

    /// True without paths.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }

    /// All ids in order.
    pub fn ids(&self) -> impl Iterator<Item = PathId> + use<> {
        (0..u32::try_from(self.paths.len()).unwrap_or(u32::MAX)).map(PathId)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_line_is_spaced_evenly_to_its_very_end() {
        let ends = [Pose::new(0.0, 0.0, 0.0), Pose::new(10.0, 0.0, 0.0)];
        let path = Path::new(&ends, 0.3).unwrap();
        assert_eq!(path.last_index(), 34);
        assert!((path.length_m() - 10.0).abs() < 1e-12);
        for (index, pose) in path.poses().iter().enumerate() {
            assert!((pose.x_m - path.way_to_m(index)).abs() < 1e-9);
            assert_eq!(path.index_at(path.way_to_m(index)), index);
        }
        assert!((path.pose_at(3.21).x_m - 3.21).abs() < 1e-12);
        let back = path.reversed();
        assert!((back.pose_at(2.0).x_m - 8.0).abs() < 1e-9);
        assert_ne!(back.hash(), path.hash());
    }

    #[test]
    fn what_is_no_path_is_refused_by_name() {
        let here = Pose::new(1.0, 2.0, 0.0);
        let error = |poses: &[Pose], spacing| Path::new(poses, spacing).unwrap_err().to_string();
        assert!(error(&[here, here], 0.3).contains("two poses"));
        assert!(error(&[], 0.3).contains("0 given"));
        let lost = Pose::new(f64::NAN, 2.0, 0.0);
        assert!(error(&[here, lost], 0.3).contains("pose 1"));
        assert!(error(&[here, Pose::default()], 0.0).contains("spacing 0"));
    }
}
