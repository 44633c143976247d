//! Which robots are near enough to look at closely: all pairs of a small fleet, a uniform grid
//! for a large one. It knows positions only and allocates nothing after its making.

use crate::referee::Track;

/// Fleets up to this size are compared pair by pair.
const ALL_PAIRS_MAX: usize = 16;

const NONE: u32 = u32::MAX;

/// A cell and half of its neighbours: the other half looks this way itself.
const FORWARD_CELLS: [[i32; 2]; 5] = [[0, 0], [1, -1], [1, 0], [1, 1], [0, 1]];

/// Finds the pairs of robots of one fleet within a reach of each other.
#[derive(Debug, Clone)]
pub(crate) struct PairFinder {
    reach_m: f64,
    per_fleet: usize,
    /// Per grid cell, by hash, the robot entered last.
    heads: Vec<u32>,
    /// Per robot of the fleet, the one entered before it in the same cell.
    links: Vec<u32>,
    cells: Vec<[i32; 2]>,
    near: Vec<[u32; 2]>,
}

impl PairFinder {
    /// For fleets of `per_fleet` robots; `reach_m` is the largest distance that counts as near.
    pub(crate) fn new(reach_m: f64, per_fleet: usize) -> Self {
        Self {
            reach_m,
            per_fleet,
            heads: vec![NONE; (2 * per_fleet).next_power_of_two()],
            links: vec![NONE; per_fleet],
            cells: vec![[0; 2]; per_fleet],
            near: Vec::with_capacity(8 * per_fleet),
        }
    }

    /// Looks for pairs of robots, as indices into `tracks`, the smaller first, of which at least
    /// one has moved, and says how many; `tracks` holds fleet after fleet.
    pub(crate) fn find(&mut self, tracks: &[Track]) -> usize {
        self.near.clear();
        let per_fleet = self.per_fleet.max(1);
        for (fleet, members) in tracks.chunks(per_fleet).enumerate() {
            let offset = fleet * per_fleet;
            if per_fleet <= ALL_PAIRS_MAX {
                self.compare_all(members, offset);
            } else {
                self.compare_cells(members, offset);
            }
        }
        self.near.len()
    }

    /// The pair found at `position` by the last [`PairFinder::find`].
    pub(crate) fn found(&self, position: usize) -> [u32; 2] {
        self.near[position]
    }

    /// True when the two are within reach of each other.
    pub(crate) fn are_within_reach(&self, one: &Track, other: &Track) -> bool {
        is_within(one, other, self.reach_m)
    }

    fn compare_all(&mut self, members: &[Track], offset: usize) {
        for (first, one) in members.iter().enumerate() {
            for (second, other) in members.iter().enumerate().skip(first + 1) {
                if is_near(one, other, self.reach_m) {
                    self.near.push(pair(offset + first, offset + second));
                }
            }
        }
    }

    fn compare_cells(&mut self, members: &[Track], offset: usize) {
        for (member, track) in members.iter().enumerate() {
            let cell = track.position.map(|at| cell_of(at / self.reach_m));
            self.cells[member] = cell;
            let slot = self.slot(cell);
            self.links[member] = self.heads[slot];
            self.heads[slot] = as_u32(member);
        }
        for (member, track) in members.iter().enumerate() {
            let [column, row] = self.cells[member];
            for [right, up] in FORWARD_CELLS {
                let neighbour = [column + right, row + up];
                let is_own = neighbour == [column, row];
                let mut other = self.heads[self.slot(neighbour)];
                while other != NONE {
                    let index = other as usize;
                    other = self.links[index];
                    let is_candidate =
                        self.cells[index] == neighbour && (!is_own || index > member);
                    if is_candidate && is_near(track, &members[index], self.reach_m) {
                        let (low, high) = (member.min(index), member.max(index));
                        self.near.push(pair(offset + low, offset + high));
                    }
                }
            }
        }
        for member in 0..members.len() {
            let slot = self.slot(self.cells[member]);
            self.heads[slot] = NONE;
        }
    }

    fn slot(&self, [column, row]: [i32; 2]) -> usize {
        let mixed = column.cast_unsigned().wrapping_mul(0x9e37_79b1)
            ^ row.cast_unsigned().wrapping_mul(0x85eb_ca77);
        (mixed ^ (mixed >> 15)) as usize & (self.heads.len() - 1)
    }
}

fn is_near(one: &Track, other: &Track, reach_m: f64) -> bool {
    (one.has_moved || other.has_moved) && is_within(one, other, reach_m)
}

fn is_within(one: &Track, other: &Track, reach_m: f64) -> bool {
    let (x, y) = (
        one.position[0] - other.position[0],
        one.position[1] - other.position[1],
    );
    x * x + y * y < reach_m * reach_m
}

fn pair(first: usize, second: usize) -> [u32; 2] {
    [as_u32(first), as_u32(second)]
}

pub(super) fn as_u32(index: usize) -> u32 {
    u32::try_from(index).unwrap_or(NONE)
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "a saturating cast: what lies beyond 2^31 cells shares the last one"
)]
fn cell_of(position: f64) -> i32 {
    position.floor().clamp(-1e9, 1e9) as i32
}
