//! Who of two robots goes first through a critical section, when both could still wait: the
//! place for a user's own rule. It says nothing about what is safe; the coordinator does.

use core::cmp::Ordering;
use core::fmt::Debug;

use crate::section::{Section, Side};
use hil_core::time::Instant;

/// One of two robots that both need a section.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contender {
    /// Robot within its fleet.
    pub robot: usize,
    /// Last path pose it is known to have passed.
    pub index: usize,
    /// Speed it reported.
    pub speed_mps: f64,
    /// Poses from there to the section's start; 0 inside.
    pub to_start: usize,
    /// Poses to the end of its path.
    pub path_poses_left: usize,
    /// When its mission began.
    pub mission_started: Instant,
    /// Since when it stands at the end of its authority; `None` while it moves.
    pub waiting_since: Option<Instant>,
    /// Robots that stand and wait for it, directly or behind others; known in the safe mode.
    pub held_up_count: u32,
}

/// Two robots and the section both need.
#[derive(Debug, Clone, Copy)]
pub struct Contest<'a> {
    /// The section.
    pub section: &'a Section,
    /// The robot on [`Side::First`] of the section.
    pub first: Contender,
    /// The robot on the other side.
    pub second: Contender,
}

/// A rule that orders robots at critical sections.
///
/// ```
/// use core::cmp::Ordering;
/// use hil_fleet::coordinator::policy::{Contest, OrderingPolicy};
///
/// /// The faster one goes first.
/// #[derive(Debug)]
/// struct FasterFirst;
///
/// impl OrderingPolicy for FasterFirst {
///     fn compare(&self, contest: &Contest<'_>) -> Ordering {
///         contest.second.speed_mps.total_cmp(&contest.first.speed_mps)
///     }
/// }
/// ```
pub trait OrderingPolicy: Debug {
    /// `Less` when the first contender should go first, `Greater` when the second should,
    /// `Equal` without preference.
    fn compare(&self, contest: &Contest<'_>) -> Ordering;
}

hil_core::words! {
    /// The policies that a topology file can name.
    #[derive(Default)]
    pub enum PolicyName {
        /// [`ClosestFirst`].
        #[default]
        ClosestFirst = "closest-first",
        /// [`FirstCome`].
        FirstCome = "first-come",
        /// [`LongestQueue`].
        LongestQueue = "longest-queue",
        /// [`QuickestThrough`].
        QuickestThrough = "quickest-through",
    }
}

impl PolicyName {
    /// The policy of this name.
    pub fn policy(self) -> Box<dyn OrderingPolicy> {
        match self {
            Self::ClosestFirst => Box::new(ClosestFirst),
            Self::FirstCome => Box::new(FirstCome),
            Self::LongestQueue => Box::new(LongestQueue),
            Self::QuickestThrough => Box::new(QuickestThrough),
        }
    }
}

/// The robot with fewer poses to the section's start goes first: the original's default.
#[derive(Debug, Clone, Copy)]
pub struct ClosestFirst;

impl OrderingPolicy for ClosestFirst {
    fn compare(&self, contest: &Contest<'_>) -> Ordering {
        contest.first.to_start.cmp(&contest.second.to_start)
    }
}

/// The robot that holds up more others goes first; among equals the closer one.
#[derive(Debug, Clone, Copy)]
pub struct LongestQueue;

impl OrderingPolicy for LongestQueue {
    fn compare(&self, contest: &Contest<'_>) -> Ordering {
        let (first, second) = (&contest.first, &contest.second);
        let by_queue = second.held_up_count.cmp(&first.held_up_count);
        by_queue.then_with(|| ClosestFirst.compare(contest))
    }
}

/// The robot that is out of the section after fewer poses goes first: the other waits less for it
/// than it would have to wait for the other (shortest job first, Smith 1956).
#[derive(Debug, Clone, Copy)]
pub struct QuickestThrough;

impl OrderingPolicy for QuickestThrough {
    fn compare(&self, contest: &Contest<'_>) -> Ordering {
        let to_end =
            |contender: &Contender, side| contest.section.end(side).saturating_sub(contender.index);
        let first = to_end(&contest.first, Side::First);
        first.cmp(&to_end(&contest.second, Side::Second))
    }
}

/// The robot whose mission began earlier goes first, wherever the two are.
#[derive(Debug, Clone, Copy)]
pub struct FirstCome;

impl OrderingPolicy for FirstCome {
    fn compare(&self, contest: &Contest<'_>) -> Ordering {
        let (first, second) = (&contest.first, &contest.second);
        first.mission_started.cmp(&second.mission_started)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Footprint, Pose};
    use crate::path::Path;
    use crate::section::{MergePolicy, sections_between};

    fn contender(robot: usize, index: usize, to_start: usize) -> Contender {
        Contender {
            robot,
            index,
            speed_mps: 1.0,
            to_start,
            path_poses_left: 100,
            mission_started: Instant::from_ns(i64::try_from(robot).unwrap()),
            waiting_since: None,
            held_up_count: 0,
        }
    }

    #[test]
    fn each_policy_prefers_what_its_name_says() {
        let line = |ends: [(f64, f64); 2], heading| {
            let ends = ends.map(|(x, y)| Pose::new(x, y, heading));
            Path::new(&ends, 0.1).unwrap()
        };
        let east = line([(-10.0, 0.0), (10.0, 0.0)], 0.0);
        let north = line([(0.0, -10.0), (0.0, 10.0)], core::f64::consts::FRAC_PI_2);
        let cart = Footprint {
            length_m: 2.0,
            width_m: 1.0,
        };
        let sections = sections_between(&east, &north, &cart, MergePolicy::Never);
        let section = &sections[0];
        let check = |policy: PolicyName, first: Contender, second: Contender, expected| {
            let contest = Contest {
                section,
                first,
                second,
            };
            assert_eq!(policy.policy().compare(&contest), expected, "{policy:?}");
        };
        let start = section.start(Side::First);
        let (near, far) = (contender(1, start - 5, 5), contender(0, start - 20, 20));
        check(PolicyName::ClosestFirst, near, far, Ordering::Less);
        check(PolicyName::FirstCome, near, far, Ordering::Greater);
        check(PolicyName::QuickestThrough, near, far, Ordering::Less);
        check(PolicyName::LongestQueue, near, far, Ordering::Less);
        let leading = Contender {
            held_up_count: 2,
            ..far
        };
        check(PolicyName::LongestQueue, near, leading, Ordering::Greater);
        check(PolicyName::ClosestFirst, near, near, Ordering::Equal);
    }
}
