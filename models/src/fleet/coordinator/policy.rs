//! Who of two robots goes first through a critical section, when both could still wait: the
//! place for a user's own rule. It says nothing about what is safe; the coordinator does.

use core::cmp::Ordering;
use core::fmt::Debug;

use serde::{Deserialize, Serialize};

use crate::fleet::section::Section;
use crate::time::Instant;

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
    /// The robot on [`Side::First`](crate::fleet::section::Side::First) of the section.
    pub first: Contender,
    /// The robot on the other side.
    pub second: Contender,
}

/// A rule that orders robots at critical sections.
///
/// ```
/// use core::cmp::Ordering;
/// use hil_models::fleet::coordinator::policy::{Contest, OrderingPolicy};
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

/// The policies that a topology file can name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PolicyName {
    /// [`ClosestFirst`].
    #[default]
    ClosestFirst,
    /// [`FirstCome`].
    FirstCome,
    /// [`LongestQueue`].
    LongestQueue,
    /// [`FirstOut`].
    FirstOut,
}

impl PolicyName {
    /// The policy of this name.
    pub fn policy(self) -> Box<dyn OrderingPolicy> {
        match self {
            Self::ClosestFirst => Box::new(ClosestFirst),
            Self::FirstCome => Box::new(FirstCome),
            Self::LongestQueue => Box::new(LongestQueue),
            Self::FirstOut => Box::new(FirstOut),
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

/// The robot that has less way left goes first: what leaves the ground soonest is in nobody's
/// way afterwards.
#[derive(Debug, Clone, Copy)]
pub struct FirstOut;

impl OrderingPolicy for FirstOut {
    fn compare(&self, contest: &Contest<'_>) -> Ordering {
        let (first, second) = (&contest.first, &contest.second);
        first.path_poses_left.cmp(&second.path_poses_left)
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
