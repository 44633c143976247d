//! Robots that wait for each other in a circle: finding such circles among the closest
//! dependencies, and breaking them by turning one order round.

use crate::section::Side;

/// Robot `waiting` must not pass `wait_index` before robot `driving` passed `release_index`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Dependency {
    pub(crate) driving: usize,
    /// Pose of the waiting robot's path.
    pub(crate) wait_index: usize,
    /// Pose of the driving robot's path.
    pub(crate) release_index: usize,
    /// Where the section is kept.
    pub(crate) slot: usize,
    /// Who goes first there.
    pub(crate) leader: Side,
    /// The order of that section may be turned round.
    pub(crate) is_reversible: bool,
}

/// Finds circles; keeps its memory between calls.
#[derive(Debug, Default)]
pub(crate) struct CircleFinder {
    /// Number of the walk that reached each robot; 0 for none.
    walk_of: Vec<usize>,
    /// Robots of the circles that never dissolve by themselves, one circle after the other.
    members: Vec<usize>,
}

impl CircleFinder {
    /// Number of circles that never dissolve: each robot in them waits before the pose that
    /// would release the one behind it. `closest[r]` is what robot `r` waits for first; so each
    /// robot has one successor at most and each circle is met by following it.
    pub(crate) fn count(&mut self, closest: &[Option<Dependency>]) -> usize {
        self.walk_of.clear();
        self.walk_of.resize(closest.len(), 0);
        self.members.clear();
        let mut circle_count = 0;
        for start in 0..closest.len() {
            let walk = start + 1;
            let mut at = start;
            while self.walk_of[at] == 0 {
                self.walk_of[at] = walk;
                match closest[at] {
                    Some(dependency) => at = dependency.driving,
                    None => break,
                }
            }
            if self.walk_of[at] == walk && closest[at].is_some() {
                circle_count += usize::from(self.note_if_stuck(at, closest));
            }
        }
        circle_count
    }

    /// Robots of the circles found by the last count.
    pub(crate) fn members(&self) -> &[usize] {
        &self.members
    }

    fn note_if_stuck(&mut self, entry: usize, closest: &[Option<Dependency>]) -> bool {
        let known_count = self.members.len();
        let mut at = entry;
        while let Some(here) = closest[at] {
            let is_held =
                closest[here.driving].is_some_and(|next| next.wait_index <= here.release_index);
            if !is_held {
                self.members.truncate(known_count);
                return false;
            }
            self.members.push(at);
            at = here.driving;
            if at == entry {
                return true;
            }
        }
        self.members.truncate(known_count);
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[allow(clippy::unnecessary_wraps, reason = "what the finder takes")]
    fn waits_for(driving: usize, wait_index: usize, release_index: usize) -> Option<Dependency> {
        Some(Dependency {
            driving,
            wait_index,
            release_index,
            slot: 0,
            leader: Side::First,
            is_reversible: true,
        })
    }

    #[test]
    fn only_circles_that_never_dissolve_count() {
        let check = |closest: &[Option<Dependency>], expected: &[usize]| {
            let mut finder = CircleFinder::default();
            let count = finder.count(closest);
            assert_eq!(count, usize::from(!expected.is_empty()), "{closest:?}");
            assert_eq!(finder.members(), expected);
        };
        check(&[None, None], &[]);
        check(&[waits_for(1, 5, 9), None], &[]);
        check(&[waits_for(1, 5, 9), waits_for(0, 7, 8)], &[0, 1]);
        // Robot 1 passes pose 9, which releases robot 0, before it has to wait at 12.
        check(&[waits_for(1, 5, 9), waits_for(0, 12, 8)], &[]);
        // Robot 0 leads into the circle of 1 and 2 but is none of it.
        let tail = [waits_for(1, 1, 1), waits_for(2, 3, 6), waits_for(1, 4, 5)];
        check(&tail, &[1, 2]);
    }

    #[test]
    fn two_circles_are_two() {
        let pair = |other| waits_for(other, 1, 2);
        let mut finder = CircleFinder::default();
        assert_eq!(finder.count(&[pair(3), pair(2), pair(1), pair(0)]), 2);
        assert_eq!(finder.members().len(), 4);
    }
}
