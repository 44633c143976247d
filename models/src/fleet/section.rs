//! Critical sections of two paths: connected sets of pose pairs at which two vehicles would
//! overlap (Lv et al., section II.B). Who goes first is the coordinator's business.

use crate::fleet::geometry::{Footprint, floor_index};
use crate::fleet::path::Path;

/// One of the two paths of a section.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The path named first.
    First,
    /// The path named second.
    Second,
}

impl Side {
    /// The other one.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::First => Self::Second,
            Self::Second => Self::First,
        }
    }

    const fn index(self) -> usize {
        self as usize
    }
}

/// Which separate overlaps are taken as one section.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MergePolicy {
    /// Those nearer than the vehicle's larger dimension on both paths: the original's rule.
    #[default]
    WithinVehicle,
    /// None.
    Never,
}

/// A critical section: on each path a range of poses, and for each pose of one the range of poses
/// of the other that it overlaps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    sides: [SectionSide; 2],
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct SectionSide {
    start: u32,
    /// Per pose from `start`: first and last partner; `first > last` where the pose meets none.
    partners: Vec<(u32, u32)>,
}

const NO_PARTNER: (u32, u32) = (u32::MAX, 0);

impl Section {
    /// First pose of the section on `side`.
    pub fn start(&self, side: Side) -> usize {
        self.sides[side.index()].start as usize
    }

    /// Last pose of the section on `side`.
    pub fn end(&self, side: Side) -> usize {
        self.start(side) + self.sides[side.index()].partners.len() - 1
    }

    /// First and last pose of the other path that pose `index` of `side` overlaps; between them
    /// all count as overlapped. `None` outside the section and in a gap of it.
    pub fn partners(&self, side: Side, index: usize) -> Option<(usize, usize)> {
        let offset = index.checked_sub(self.start(side))?;
        let (first, last) = *self.sides[side.index()].partners.get(offset)?;
        (first <= last).then_some((first as usize, last as usize))
    }

    /// First pose at or after `from` on `side` that overlaps any of the poses `leader_from..=
    /// leader_to` of the other path: where a follower must not go yet.
    pub fn first_conflict(
        &self,
        side: Side,
        from: usize,
        (leader_from, leader_to): (usize, usize),
    ) -> Option<usize> {
        if leader_from > self.end(side.other()) || leader_to < self.start(side.other()) {
            return None;
        }
        (from.max(self.start(side))..=self.end(side)).find(|&index| {
            self.partners(side, index)
                .is_some_and(|(first, last)| first <= leader_to && leader_from <= last)
        })
    }

    /// The same section with its sides exchanged.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        let [first, second] = self.sides.clone();
        Self {
            sides: [second, first],
        }
    }

    fn of_pairs(pairs: &[(u32, u32)]) -> Self {
        let swapped: Vec<_> = pairs.iter().map(|&(i, j)| (j, i)).collect();
        Self {
            sides: [
                SectionSide::of_pairs(pairs),
                SectionSide::of_pairs(&swapped),
            ],
        }
    }
}

impl SectionSide {
    fn of_pairs(pairs: &[(u32, u32)]) -> Self {
        let start = pairs.iter().map(|pair| pair.0).min().unwrap_or(0);
        let end = pairs.iter().map(|pair| pair.0).max().unwrap_or(0);
        let mut partners = vec![NO_PARTNER; (end - start + 1) as usize];
        for &(index, partner) in pairs {
            let (first, last) = &mut partners[(index - start) as usize];
            *first = (*first).min(partner);
            *last = (*last).max(partner);
        }
        Self { start, partners }
    }
}

/// The critical sections of two paths for one kind of vehicle, in order along the first path.
pub fn sections_between(
    first: &Path,
    second: &Path,
    footprint: &Footprint,
    merge: MergePolicy,
) -> Vec<Section> {
    let boxes = |path: &Path| -> Vec<_> {
        let with_bounds = |pose| {
            let covered = footprint.at(pose);
            (covered, covered.bounds())
        };
        path.poses().iter().map(with_bounds).collect()
    };
    let (rows, columns) = (boxes(first), boxes(second));
    let mut groups = Groups::default();
    for (i, (row, row_bounds)) in (0_u32..).zip(&rows) {
        for (j, (column, column_bounds)) in (0_u32..).zip(&columns) {
            if row_bounds.meets(column_bounds) && row.overlaps(column) {
                groups.add((i, j));
            }
        }
    }
    let gap = match merge {
        MergePolicy::Never => None,
        MergePolicy::WithinVehicle => Some([first, second].map(|path| {
            u32::try_from(floor_index(footprint.size_max_m() / path.spacing_m()))
                .unwrap_or(u32::MAX)
        })),
    };
    let mut sections: Vec<_> = groups
        .merged(gap)
        .iter()
        .map(|pairs| Section::of_pairs(pairs))
        .collect();
    sections.sort_by_key(|section| (section.start(Side::First), section.start(Side::Second)));
    sections
}

/// Pose pairs gathered into 8-connected sets.
#[derive(Debug, Default)]
struct Groups {
    sets: Vec<Vec<(u32, u32)>>,
}

impl Groups {
    fn add(&mut self, pair: (u32, u32)) {
        let is_near = |set: &Vec<(u32, u32)>| {
            set.iter()
                .rev()
                .take_while(|known| known.0 + 1 >= pair.0)
                .any(|known| known.0.abs_diff(pair.0) <= 1 && known.1.abs_diff(pair.1) <= 1)
        };
        let mut joined = vec![pair];
        let mut index = 0;
        while index < self.sets.len() {
            if is_near(&self.sets[index]) {
                joined.append(&mut self.sets.swap_remove(index));
            } else {
                index += 1;
            }
        }
        joined.sort_unstable();
        self.sets.push(joined);
    }

    fn merged(mut self, gap: Option<[u32; 2]>) -> Vec<Vec<(u32, u32)>> {
        let Some(gap) = gap else {
            return self.sets;
        };
        let range = |set: &[(u32, u32)], pick: fn(&(u32, u32)) -> u32| {
            let low = set.iter().map(pick).min().unwrap_or(0);
            (low, set.iter().map(pick).max().unwrap_or(0))
        };
        let near = |a: (u32, u32), b: (u32, u32), gap: u32| {
            a.0 <= b.1.saturating_add(gap) && b.0 <= a.1.saturating_add(gap)
        };
        let mut index = 0;
        while index < self.sets.len() {
            let partner = (index + 1..self.sets.len()).find(|&other| {
                let (a, b) = (&self.sets[index], &self.sets[other]);
                near(range(a, |p| p.0), range(b, |p| p.0), gap[0])
                    && near(range(a, |p| p.1), range(b, |p| p.1), gap[1])
            });
            if let Some(other) = partner {
                let mut set = self.sets.swap_remove(other);
                self.sets[index].append(&mut set);
                index = 0;
            } else {
                index += 1;
            }
        }
        self.sets
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::geometry::Pose;

    const CART: Footprint = Footprint {
        length_m: 2.0,
        width_m: 1.0,
    };

    fn line(from: (f64, f64), to: (f64, f64)) -> Path {
        let heading = (to.1 - from.1).atan2(to.0 - from.0);
        let ends = [from, to].map(|(x, y)| Pose::new(x, y, heading));
        Path::new(&ends, 0.1).unwrap()
    }

    #[test]
    fn a_right_angle_crossing_has_the_section_of_its_closed_form() {
        let east = line((-10.0, 0.0), (10.0, 0.0));
        let north = line((0.0, -10.0), (0.0, 10.0));
        let sections = sections_between(&east, &north, &CART, MergePolicy::Never);
        assert_eq!(sections.len(), 1);
        // Overlap while both |x| and |y| are below half a length plus half a width, 1.5 m; the
        // poses at the very ends only touch.
        for side in [Side::First, Side::Second] {
            assert_eq!((sections[0].start(side), sections[0].end(side)), (86, 114));
        }
        assert_eq!(sections[0].mirrored().mirrored(), sections[0]);
    }

    #[test]
    fn a_follower_may_go_as_far_as_the_leader_has_cleared() {
        let east = line((0.0, 0.0), (20.0, 0.0));
        let sections = sections_between(&east, &east, &CART, MergePolicy::Never);
        assert_eq!(sections.len(), 1);
        // A leader at 10 m still covers 9 m to the end; the follower's front is 1 m ahead of it.
        let first = sections[0].first_conflict(Side::Second, 0, (100, 200));
        assert_eq!(first, Some(81));
        assert_eq!(
            sections[0].first_conflict(Side::Second, 0, (100, 100)),
            Some(81)
        );
    }

    #[test]
    fn sections_nearer_than_a_vehicle_merge_only_on_request() {
        let east = line((-10.0, 0.0), (10.0, 0.0));
        let poses = [
            Pose::new(-3.0, 5.0, -core::f64::consts::FRAC_PI_2),
            Pose::new(-3.0, -2.0, -core::f64::consts::FRAC_PI_2),
            Pose::new(-0.5, -2.0, core::f64::consts::FRAC_PI_2),
            Pose::new(-0.5, 5.0, core::f64::consts::FRAC_PI_2),
        ];
        let loop_back = Path::new(&poses, 0.1).unwrap();
        let count = |merge| sections_between(&east, &loop_back, &CART, merge).len();
        assert_eq!(count(MergePolicy::Never), 2);
        assert!(count(MergePolicy::WithinVehicle) <= 2);
    }
}
