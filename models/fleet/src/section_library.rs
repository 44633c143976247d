//! The critical sections of every two paths of a world, each pair computed when first asked for.

use std::sync::{Arc, OnceLock};

use crate::geometry::{Bounds, Footprint};
use crate::overlap::CoveredPath;
use crate::path::{Path, PathId, PathLibrary};
use crate::section::{MergePolicy, Section, Side, sections_of, sort};

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

#[cfg(test)]
#[path = "section_tests.rs"]
mod tests;
