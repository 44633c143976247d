//! Which poses of two paths cannot both be taken: found without trying every pair. Boxes around
//! 32 poses each sort out most pairs; along what remains, the distance (or depth) of two footprints
//! says how many poses certainly stay apart (or together). The result is that of trying all.

use core::ops::Range;

use crate::geometry::{Bounds, Footprint, OrientedBox};
use crate::path::Path;

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
        crate::geometry::floor_index(steps).clamp(1, self.boxes.len())
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
