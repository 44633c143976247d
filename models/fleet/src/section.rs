//! Critical sections of two paths: connected sets of pose pairs at which two vehicles would
//! overlap (Lv et al., section II.B). Who goes first is the coordinator's business.

use crate::geometry::floor_index;
use crate::overlap::{CoveredPath, Run, components};

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

/// A range of poses of a path, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// First pose.
    pub lower: usize,
    /// Last pose.
    pub upper: usize,
}

impl Span {
    /// One pose.
    pub const fn at(index: usize) -> Self {
        Self {
            lower: index,
            upper: index,
        }
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

    /// First pose at or after `from` on `side` that overlaps any of the poses of `leader`
    /// on the other path: where a follower must not go yet.
    pub fn first_conflict(&self, side: Side, from: usize, leader: Span) -> Option<usize> {
        if leader.lower > self.end(side.other()) || leader.upper < self.start(side.other()) {
            return None;
        }
        (from.max(self.start(side))..=self.end(side)).find(|&index| {
            self.partners(side, index)
                .is_some_and(|(first, last)| first <= leader.upper && leader.lower <= last)
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

    /// The same section when the path of `side` is driven backwards and `last_index` is its last
    /// pose.
    ///
    /// # Panics
    /// When the section does not lie on a path that short.
    #[must_use]
    pub fn reversed(&self, side: Side, last_index: usize) -> Self {
        assert!(
            last_index >= self.end(side),
            "a section to pose {} lies on no path to pose {last_index}",
            self.end(side)
        );
        let last_index = u32::try_from(last_index).expect("a path has fewer than 2^32 poses");
        let mut reversed = self.clone();
        let own = &mut reversed.sides[side.index()];
        own.partners.reverse();
        own.start = last_index - (own.start + own.last_offset());
        for partners in &mut reversed.sides[side.other().index()].partners {
            if *partners != NO_PARTNER {
                *partners = (last_index - partners.1, last_index - partners.0);
            }
        }
        reversed
    }

    fn of_runs(runs: &[Run]) -> Self {
        let mut sides = [
            SectionSide::empty(runs.iter().map(|run| (run.row, run.row))),
            SectionSide::empty(runs.iter().map(|run| (run.first, run.last))),
        ];
        for run in runs {
            sides[0].meet(run.row, run.first, run.last);
            for column in run.first..=run.last {
                sides[1].meet(column, run.row, run.row);
            }
        }
        Self { sides }
    }

    /// By which sections of one pair of paths are listed.
    fn order(&self) -> [u32; 4] {
        let [first, second] = &self.sides;
        let lengths = [first.last_offset(), second.last_offset()];
        [first.start, second.start, lengths[0], lengths[1]]
    }
}

/// Puts the sections of one pair of paths in order along the first path.
pub(crate) fn sort(sections: &mut [Section]) {
    sections.sort_by_key(Section::order);
}

impl SectionSide {
    /// A side that spans these ranges and meets nothing yet.
    fn empty(ranges: impl Iterator<Item = (u32, u32)>) -> Self {
        let widen = |all: (u32, u32), one: (u32, u32)| (all.0.min(one.0), all.1.max(one.1));
        let (start, end) = ranges.fold(NO_PARTNER, widen);
        Self {
            start,
            partners: vec![NO_PARTNER; (end - start + 1) as usize],
        }
    }

    fn meet(&mut self, index: u32, first: u32, last: u32) {
        let partners = &mut self.partners[(index - self.start) as usize];
        *partners = (partners.0.min(first), partners.1.max(last));
    }

    fn last_offset(&self) -> u32 {
        u32::try_from(self.partners.len() - 1).expect("a path has fewer than 2^32 poses")
    }
}

/// As [`sections_between`], of paths whose ground is known already.
pub(crate) fn sections_of(
    first: &CoveredPath,
    second: &CoveredPath,
    merge: MergePolicy,
) -> Vec<Section> {
    let mut parts = components(first, second);
    if merge == MergePolicy::WithinVehicle {
        let gap = |path: &CoveredPath| {
            let gap = floor_index(path.footprint().size_max_m() / path.spacing_m());
            u32::try_from(gap).unwrap_or(u32::MAX)
        };
        parts = merged(parts, [gap(first), gap(second)]);
    }
    let mut sections: Vec<_> = parts.iter().map(|runs| Section::of_runs(runs)).collect();
    sort(&mut sections);
    sections
}

/// First and last pose on both paths.
type Ranges = [(u32, u32); 2];

/// Joins parts that are at most `gap` poses apart on both paths, until none are. Joining only
/// widens, so the result does not depend on the order.
fn merged(parts: Vec<Vec<Run>>, gap: [u32; 2]) -> Vec<Vec<Run>> {
    let mut open: Vec<(Ranges, Vec<Run>)> = Vec::new();
    for mut runs in parts {
        let widen = |all: (u32, u32), one: (u32, u32)| (all.0.min(one.0), all.1.max(one.1));
        let mut range = [
            runs.iter()
                .map(|run| (run.row, run.row))
                .fold(NO_PARTNER, widen),
            runs.iter()
                .map(|run| (run.first, run.last))
                .fold(NO_PARTNER, widen),
        ];
        let is_near = |a: &Ranges, b: &Ranges| {
            (0..2).all(|side| {
                a[side].0 <= b[side].1.saturating_add(gap[side])
                    && b[side].0 <= a[side].1.saturating_add(gap[side])
            })
        };
        while let Some(index) = open.iter().position(|(known, _)| is_near(known, &range)) {
            let (known, mut others) = open.swap_remove(index);
            range = [widen(range[0], known[0]), widen(range[1], known[1])];
            runs.append(&mut others);
        }
        open.push((range, runs));
    }
    open.into_iter().map(|(_, runs)| runs).collect()
}

/// The critical sections of two paths for one kind of vehicle, in order along the first path.
#[cfg(test)]
pub(crate) fn sections_between(
    first: &crate::path::Path,
    second: &crate::path::Path,
    footprint: &crate::geometry::Footprint,
    merge: MergePolicy,
) -> Vec<Section> {
    let (rows, columns) = (
        CoveredPath::new(first, footprint),
        CoveredPath::new(second, footprint),
    );
    sections_of(&rows, &columns, merge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Footprint, Pose};
    use crate::path::Path;

    const CART: Footprint = Footprint {
        length_m: 2.0,
        width_m: 1.0,
    };

    fn line(from: [f64; 2], to: [f64; 2]) -> Path {
        let heading = (to[1] - from[1]).atan2(to[0] - from[0]);
        let ends = [from, to].map(|[x, y]| Pose::new(x, y, heading));
        Path::new(&ends, 0.1).unwrap()
    }

    #[test]
    fn a_right_angle_crossing_has_the_section_of_its_closed_form() {
        let east = line([-10.0, 0.0], [10.0, 0.0]);
        let north = line([0.0, -10.0], [0.0, 10.0]);
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
        let east = line([0.0, 0.0], [20.0, 0.0]);
        let sections = sections_between(&east, &east, &CART, MergePolicy::Never);
        assert_eq!(sections.len(), 1);
        // A leader at 10 m still covers 9 m to the end; the follower's front is 1 m ahead of it.
        let beyond = Span {
            lower: 100,
            upper: 200,
        };
        let first = sections[0].first_conflict(Side::Second, 0, beyond);
        assert_eq!(first, Some(81));
        assert_eq!(
            sections[0].first_conflict(Side::Second, 0, Span::at(100)),
            Some(81)
        );
    }

    #[test]
    fn sections_nearer_than_a_vehicle_merge_only_on_request() {
        let east = line([-10.0, 0.0], [10.0, 0.0]);
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
