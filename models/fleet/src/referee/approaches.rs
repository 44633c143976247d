//! Approaches: how near two robots under way come to each other, collision or not. It sees the gaps that the referee
//! computes and no robot.

use crate::geometry::{OrientedBox, floor_index};

/// Bins of a pose spacing.
const BINS_PER_SPACING: usize = 10;
/// Bins up to where robots have separated.
const BINS: usize = SEPARATED_SPACINGS * BINS_PER_SPACING;
/// Robots farther apart than so many pose spacings have separated: the original's checker looks where each robot was up
/// to a pose spacing before.
const SEPARATED_SPACINGS: usize = 2;

/// Clearances of approaches that are over, in pose spacings: contacts, then bins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Clearances([u64; 1 + BINS]);

impl Clearances {
    /// Width of a bin, pose spacings.
    pub const BIN_SPACINGS: f64 = 1.0 / BINS_PER_SPACING as f64;

    fn add(&mut self, spacings: f64) {
        let is_contact = spacings <= 0.0;
        let bin = floor_index(spacings * BINS_PER_SPACING as f64).min(BINS - 1);
        self.0[if is_contact { 0 } else { 1 + bin }] += 1;
    }

    /// Approaches.
    pub fn count(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Approaches to less than a pose spacing, without contact.
    pub fn near_miss_count(&self) -> u64 {
        self.0[1..=BINS_PER_SPACING].iter().sum()
    }

    /// The smallest clearance that at least `quantile` (0..=1) of all do not exceed, pose spacings: the middle of its
    /// bin, and 0 of a contact; `None` without approaches.
    pub fn quantile(&self, quantile: f64) -> Option<f64> {
        let wanted = (quantile * self.count() as f64).max(1.0);
        let mut below_count = 0;
        let bin = self.0.iter().position(|count| {
            below_count += count;
            below_count as f64 >= wanted
        })?;
        Some((bin as f64 - 0.5).max(0.0) / BINS_PER_SPACING as f64)
    }
}

impl core::ops::AddAssign for Clearances {
    fn add_assign(&mut self, other: Self) {
        for (mine, other) in self.0.iter_mut().zip(other.0) {
            *mine += other;
        }
    }
}

#[derive(Debug)]
struct Approach {
    pair: [u32; 2],
    clearance_m: f64,
}

/// Approaches that are not over.
#[derive(Debug)]
pub(super) struct Approaches {
    pub(super) spacing_m: f64,
    open: Vec<Approach>,
}

impl Approaches {
    /// With room for so many at once.
    pub(super) fn new(spacing_m: f64, capacity: usize) -> Self {
        Self {
            spacing_m,
            open: Vec::with_capacity(capacity),
        }
    }

    /// Robots this far apart have separated.
    pub(super) fn separated_m(&self) -> f64 {
        SEPARATED_SPACINGS as f64 * self.spacing_m
    }

    /// Takes the gap of a pair and, if both are under way, the ground they cover.
    pub(super) fn judge(
        &mut self,
        pair: [u32; 2],
        gap_m: f64,
        ground: Option<&[OrientedBox; 2]>,
        over: &mut Clearances,
    ) {
        let known = self.open.iter().position(|one| one.pair == pair);
        if gap_m > self.separated_m() {
            if let Some(position) = known {
                let ended = self.open.swap_remove(position);
                over.add(ended.clearance_m / self.spacing_m);
            }
            return;
        }
        let least_m = known.map_or(self.separated_m(), |at| self.open[at].clearance_m);
        // The distance, which costs more, is no less than the gap.
        let ground = ground.filter(|_| gap_m.max(0.0) < least_m);
        let distance_m = ground.map(|[one, other]| one.distance_m(other));
        if let Some(clearance_m) = distance_m.filter(|distance_m| *distance_m < least_m) {
            match known {
                Some(position) => self.open[position].clearance_m = clearance_m,
                None => self.open.push(Approach { pair, clearance_m }),
            }
        }
    }

    /// Ends the approaches of pairs that are no longer within reach.
    pub(super) fn end_apart(
        &mut self,
        is_within_reach: impl Fn(&[u32; 2]) -> bool,
        over: &mut Clearances,
    ) {
        let ended = (self.open).extract_if(.., |one| !is_within_reach(&one.pair));
        ended.for_each(|one| over.add(one.clearance_m / self.spacing_m));
    }
}
