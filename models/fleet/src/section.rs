//! Critical sections of two paths: connected sets of pose pairs at which two vehicles would
//! overlap (Lv et al., section II.B). Who goes first is the coordinator's business.

use core::ops::Range;
use std::sync::{Arc, OnceLock};

use crate::geometry::{Bounds, Footprint, OrientedBox, floor_index};
use crate::path::{Path, PathId, PathLibrary};

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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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

    /// From one pose to another.
    pub const fn between(lower: usize, upper: usize) -> Self {
        Self { lower, upper }
    }
}

hil_core::words! {
    /// Which separate overlaps are taken as one section.
    #[derive(Default)]
    pub enum MergePolicy {
        /// Those nearer than the vehicle's larger dimension on both paths: the original's rule.
        #[default]
        WithinVehicle = "within-vehicle",
        /// None.
        Never = "never",
    }
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

    /// First pose of `poses` on `side` that overlaps any of the poses of `leader`
    /// on the other path: where a follower must not go yet.
    pub fn first_conflict(&self, side: Side, poses: Span, leader: Span) -> Option<usize> {
        if leader.lower > self.end(side.other()) || leader.upper < self.start(side.other()) {
            return None;
        }
        (poses.lower.max(self.start(side))..=poses.upper.min(self.end(side))).find(|&index| {
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
    first: &Path,
    second: &Path,
    footprint: &Footprint,
    merge: MergePolicy,
) -> Vec<Section> {
    let (rows, columns) = (
        CoveredPath::new(first, footprint),
        CoveredPath::new(second, footprint),
    );
    sections_of(&rows, &columns, merge)
}

/// Sections of one pair of paths, once known.
type Cell = OnceLock<Arc<[Section]>>;

/// The critical sections of every two paths, each computed when first asked for and kept. Only
/// paths near each other have a place to keep them, so a large world costs no more than many
/// small ones.
pub struct SectionLibrary {
    paths: PathLibrary,
    footprint: Footprint,
    merge: MergePolicy,
    none: Arc<[Section]>,
    /// Per path without direction.
    covered: Vec<OnceLock<CoveredPath>>,
    near: Vec<Near>,
}

/// The pairs of one path, without direction, and those not before it in the library.
#[derive(Debug, Default)]
struct Near {
    /// The other paths, ascending.
    others: Vec<usize>,
    /// Per other path: own direction, the other's direction (times 2), which comes first (times
    /// 4).
    cells: Vec<[Cell; 8]>,
}

impl core::fmt::Debug for SectionLibrary {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        // Which sections were asked for yet says nothing of the world.
        f.debug_struct("SectionLibrary")
            .field("paths", &self.paths.len())
            .field("footprint", &self.footprint)
            .field("merge", &self.merge)
            .finish_non_exhaustive()
    }
}

impl SectionLibrary {
    /// A library without any section computed yet.
    pub fn new(paths: PathLibrary, footprint: Footprint, merge: MergePolicy) -> Self {
        let forward = paths.ids().step_by(2).filter_map(|id| paths.get(id));
        let around: Vec<_> = forward
            .map(|path| bounds_of(path, footprint.radius_m()))
            .collect();
        let near = around.iter().enumerate().map(|(low, bounds)| {
            let others = around.iter().enumerate().skip(low);
            let others: Vec<_> = others
                .filter(|(_, other)| bounds.meets(other))
                .map(|(high, _)| high)
                .collect();
            let cells = others.iter().map(|_| <[Cell; 8]>::default()).collect();
            Near { others, cells }
        });
        Self {
            near: near.collect(),
            covered: around.iter().map(|_| OnceLock::new()).collect(),
            paths,
            footprint,
            merge,
            none: Arc::new([]),
        }
    }

    /// The footprint whose overlaps count.
    pub fn footprint(&self) -> &Footprint {
        &self.footprint
    }

    /// The sections of two paths, `first` being [`Side::First`]. Several threads may ask at once;
    /// each pair is the same whoever computed it.
    ///
    /// # Panics
    /// When a path is not in the library.
    pub fn between(&self, first: PathId, second: PathId) -> &Arc<[Section]> {
        assert!(
            first.index().max(second.index()) < self.paths.len(),
            "paths {first} and {second} are of this library of {} ids",
            self.paths.len()
        );
        let is_mirrored = first.index() / 2 > second.index() / 2;
        let (low, high) = if is_mirrored {
            (second, first)
        } else {
            (first, second)
        };
        let near = &self.near[low.index() / 2];
        let Ok(place) = near.others.binary_search(&(high.index() / 2)) else {
            return &self.none;
        };
        let cells = &near.cells[place];
        let forward = cells[0]
            .get_or_init(|| sections_of(self.covered(low), self.covered(high), self.merge).into());
        let variant = (low.index() & 1) + 2 * (high.index() & 1) + 4 * usize::from(is_mirrored);
        if variant == 0 {
            return forward;
        }
        cells[variant].get_or_init(|| {
            let turned = |section: &Section| {
                let mut section = section.clone();
                for (side, path) in [(Side::First, low), (Side::Second, high)] {
                    if path.index() & 1 == 1 {
                        section = section.reversed(side, self.path(path).last_index());
                    }
                }
                if is_mirrored {
                    section.mirrored()
                } else {
                    section
                }
            };
            let mut sections: Vec<_> = forward.iter().map(turned).collect();
            sort(&mut sections);
            sections.into()
        })
    }

    fn covered(&self, id: PathId) -> &CoveredPath {
        self.covered[id.index() / 2].get_or_init(|| {
            let forward = PathId(id.0 & !1);
            CoveredPath::new(self.path(forward), &self.footprint)
        })
    }

    fn path(&self, id: PathId) -> &Path {
        self.paths.get(id).expect("a path of this library")
    }
}

/// A rectangle around all that a vehicle of this radius covers along the path.
fn bounds_of(path: &Path, radius_m: f64) -> Bounds {
    let mut bounds = Bounds {
        x_min_m: f64::INFINITY,
        x_max_m: f64::NEG_INFINITY,
        y_min_m: f64::INFINITY,
        y_max_m: f64::NEG_INFINITY,
    };
    for pose in path.poses() {
        bounds = bounds.joined(&Bounds {
            x_min_m: pose.x_m - radius_m,
            x_max_m: pose.x_m + radius_m,
            y_min_m: pose.y_m - radius_m,
            y_max_m: pose.y_m + radius_m,
        });
    }
    bounds
}

/// Poses in a block of the broad phase.
const BLOCK: usize = 32;
/// What rounding can make of a distance, metres, with room.
const ROUNDING_M: f64 = 1e-9;

/// The ground a vehicle covers along a path.
#[derive(Debug, Clone)]
pub(crate) struct CoveredPath {
    footprint: Footprint,
    spacing_m: f64,
    boxes: Vec<OrientedBox>,
    /// Around each [`BLOCK`] poses.
    blocks: Vec<Bounds>,
    /// What any point of the vehicle moves between neighbouring poses, at most.
    motion_m: f64,
}

impl CoveredPath {
    pub(crate) fn new(path: &Path, footprint: &Footprint) -> Self {
        let boxes: Vec<_> = path.poses().iter().map(|pose| footprint.at(pose)).collect();
        let around = |block: &[OrientedBox]| {
            let bounds = block.iter().map(OrientedBox::bounds);
            bounds.reduce(|all, one| all.joined(&one))
        };
        let motions = path.poses().windows(2).map(|two| {
            let half_turn = 0.5 * (two[1].heading_rad - two[0].heading_rad);
            two[0].distance_m(&two[1]) + 2.0 * footprint.radius_m() * half_turn.sin().abs()
        });
        Self {
            footprint: *footprint,
            spacing_m: path.spacing_m(),
            blocks: boxes.chunks(BLOCK).filter_map(around).collect(),
            motion_m: motions.fold(0.0, f64::max),
            boxes,
        }
    }

    pub(crate) fn footprint(&self) -> &Footprint {
        &self.footprint
    }

    pub(crate) fn spacing_m(&self) -> f64 {
        self.spacing_m
    }

    /// Poses whose certain fate `distance_m` tells, the present one among them.
    fn certain(&self, distance_m: f64) -> usize {
        let steps = (distance_m - ROUNDING_M) / self.motion_m;
        floor_index(steps).clamp(1, self.boxes.len())
    }

    /// The ranges of poses whose blocks meet `bounds`, neighbouring ones joined.
    fn ranges_near(&self, bounds: &Bounds, ranges: &mut Vec<Range<usize>>) {
        ranges.clear();
        for (block, around) in self.blocks.iter().enumerate() {
            if around.meets(bounds) {
                let begin = block * BLOCK;
                let end = (begin + BLOCK).min(self.boxes.len());
                match ranges.last_mut() {
                    Some(last) if last.end == begin => last.end = end,
                    _ => ranges.push(begin..end),
                }
            }
        }
    }
}

/// Poses of the second path, without a gap, that one pose of the first overlaps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Run {
    /// Pose of the first path.
    pub(crate) row: u32,
    /// First pose of the second path.
    pub(crate) first: u32,
    /// Last pose of the second path.
    pub(crate) last: u32,
}

/// The overlapping pose pairs of two paths as sets connected along rows, columns and diagonals,
/// each as runs in order of rows.
pub(crate) fn components(first: &CoveredPath, second: &CoveredPath) -> Vec<Vec<Run>> {
    let runs = runs_of(first, second);
    let mut parents: Vec<usize> = (0..runs.len()).collect();
    let (mut above, mut begin) = (0..0, 0);
    while begin < runs.len() {
        let row = runs[begin].row;
        let end = begin + runs[begin..].partition_point(|run| run.row == row);
        let mut upper = above.clone().peekable();
        let is_next = above.end > above.start && runs[above.start].row + 1 == row;
        for lower in begin..end {
            // Both rows are in order, so one pass over each finds all touching pairs.
            while is_next
                && upper
                    .next_if(|&up| runs[up].last + 1 < runs[lower].first)
                    .is_some()
            {}
            let mut touching = upper.clone();
            while let Some(up) = touching.next_if(|&up| runs[up].first <= runs[lower].last + 1) {
                if is_next {
                    join(&mut parents, up, lower);
                }
            }
        }
        above = begin..end;
        begin = end;
    }
    let mut parts: Vec<Vec<Run>> = vec![Vec::new(); runs.len()];
    for (index, run) in runs.iter().enumerate() {
        parts[root(&mut parents, index)].push(*run);
    }
    parts.retain(|part| !part.is_empty());
    parts
}

fn runs_of(first: &CoveredPath, second: &CoveredPath) -> Vec<Run> {
    let (mut runs, mut ranges) = (Vec::new(), Vec::new());
    for (block, around) in first.blocks.iter().enumerate() {
        second.ranges_near(around, &mut ranges);
        let begin = block * BLOCK;
        let end = (begin + BLOCK).min(first.boxes.len());
        for row in begin..end {
            for range in &ranges {
                add_runs(&mut runs, row, &first.boxes[row], second, range.clone());
            }
        }
    }
    runs
}

fn add_runs(
    runs: &mut Vec<Run>,
    row: usize,
    here: &OrientedBox,
    second: &CoveredPath,
    range: Range<usize>,
) {
    let number = |index: usize| u32::try_from(index).expect("a path has fewer than 2^32 poses");
    let (mut index, mut open) = (range.start, None);
    while index < range.end {
        let gap_m = here.gap_m(&second.boxes[index]);
        let next = (index + second.certain(gap_m.abs())).min(range.end);
        if gap_m < 0.0 {
            open.get_or_insert(index);
        } else if let Some(first) = open.take() {
            runs.push(Run {
                row: number(row),
                first: number(first),
                last: number(index - 1),
            });
        }
        index = next;
    }
    if let Some(first) = open {
        runs.push(Run {
            row: number(row),
            first: number(first),
            last: number(range.end - 1),
        });
    }
}

fn root(parents: &mut [usize], mut index: usize) -> usize {
    while parents[index] != index {
        parents[index] = parents[parents[index]];
        index = parents[index];
    }
    index
}

fn join(parents: &mut [usize], a: usize, b: usize) {
    let (a, b) = (root(parents, a), root(parents, b));
    parents[a.max(b)] = a.min(b);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Footprint, Pose};
    use Path;

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
        let first = sections[0].first_conflict(Side::Second, Span::between(0, usize::MAX), beyond);
        assert_eq!(first, Some(81));
        assert_eq!(
            sections[0].first_conflict(Side::Second, Span::between(0, usize::MAX), Span::at(100)),
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

#[cfg(test)]
#[path = "section_tests.rs"]
mod section_library_tests;
