//! The critical sections of missions under way at once: begun with the later mission, over when a
//! robot has driven through. It counts them and knows who is inside; geometry is not its
//! business.

use crate::referee::pairs::as_u32;
use crate::referee::{Tally, Track};
use crate::section::Side;
use crate::world::World;

/// A critical section of two robots under way.
#[derive(Debug, Clone, Copy)]
struct ActiveSection {
    robots: [u32; 2],
    /// Per robot, first and last pose of the section.
    ranges: [(u32, u32); 2],
    is_inside: [bool; 2],
    is_encounter: bool,
    is_collision: bool,
}

impl ActiveSection {
    /// Which of the two `robot` is.
    fn side_of(&self, robot: u32) -> usize {
        usize::from(self.robots[1] == robot)
    }
}

/// All active sections, and per robot its own by their start.
#[derive(Debug, Clone)]
pub(crate) struct ActiveSections {
    sections: Vec<ActiveSection>,
    free: Vec<u32>,
    of_robot: Vec<Vec<u32>>,
}

/// Sections per robot that fit without allocating.
const SECTIONS_PER_ROBOT: usize = 64;

impl ActiveSections {
    /// None yet, of `robot_count` robots.
    pub(crate) fn new(robot_count: usize) -> Self {
        Self {
            sections: Vec::with_capacity(robot_count * SECTIONS_PER_ROBOT / 2),
            free: Vec::with_capacity(robot_count * SECTIONS_PER_ROBOT / 2),
            of_robot: vec![Vec::with_capacity(SECTIONS_PER_ROBOT); robot_count],
        }
    }

    /// Adds the sections of `robot`'s mission with every other mission of its fleet under way;
    /// `fleet` is the range of the fleet's robots in `tracks`.
    pub(crate) fn begin(
        &mut self,
        robot: usize,
        fleet: core::ops::Range<usize>,
        tracks: &[Track],
        world: &World,
        tally: &mut Tally,
    ) {
        for other in fleet.filter(|other| *other != robot && tracks[*other].is_driving) {
            let (own, their) = (&tracks[robot], &tracks[other]);
            for section in world.sections.between(own.path_id, their.path_id).iter() {
                let is_ahead = section.end(Side::First) >= own.index
                    && section.end(Side::Second) >= their.index;
                if !is_ahead {
                    continue;
                }
                let range = |side| (as_u32(section.start(side)), as_u32(section.end(side)));
                tally.sections_created_count += 1;
                self.add(ActiveSection {
                    robots: [as_u32(robot), as_u32(other)],
                    ranges: [range(Side::First), range(Side::Second)],
                    is_inside: [false; 2],
                    is_encounter: false,
                    is_collision: false,
                });
            }
            self.update(other, their.index, tally);
        }
        self.update(robot, tracks[robot].index, tally);
    }

    /// Ends all sections of `robot`: passed when it has driven to its goal, else dropped.
    pub(crate) fn end(&mut self, robot: usize, has_passed: bool, tally: &mut Tally) {
        while let Some(&id) = self.of_robot[robot].last() {
            self.remove(id);
            if has_passed {
                tally.sections_passed_count += 1;
            } else {
                tally.sections_dropped_count += 1;
            }
        }
    }

    /// Notes that `robot` has passed the pose `index`.
    pub(crate) fn update(&mut self, robot: usize, index: usize, tally: &mut Tally) {
        let index = as_u32(index);
        let mut position = 0;
        while let Some(&id) = self.of_robot[robot].get(position) {
            let section = &mut self.sections[id as usize];
            let side = section.side_of(as_u32(robot));
            let (start, end) = section.ranges[side];
            if start > index {
                return;
            }
            if end < index {
                tally.sections_passed_count += 1;
                self.remove(id);
                continue;
            }
            section.is_inside[side] = true;
            if section.is_inside == [true; 2] && !section.is_encounter {
                section.is_encounter = true;
                tally.encounters_count += 1;
            }
            position += 1;
        }
    }

    /// Goes through the sections of a pair that both are in; `is_overlapping` says whether they
    /// overlap at the last poses passed, `is_separated` whether a collision is over. Gives the
    /// number of collisions that began.
    pub(crate) fn judge(
        &mut self,
        pair: [u32; 2],
        is_separated: bool,
        is_overlapping: impl Fn() -> bool,
    ) -> u32 {
        let mut overlap = None;
        let mut begun_count = 0;
        for &id in &self.of_robot[pair[0] as usize] {
            let section = &mut self.sections[id as usize];
            if !section.robots.contains(&pair[1]) || section.is_inside != [true; 2] {
                continue;
            }
            if is_separated {
                section.is_collision = false;
            } else if !section.is_collision && *overlap.get_or_insert_with(&is_overlapping) {
                section.is_collision = true;
                begun_count += 1;
            }
        }
        begun_count
    }

    /// True when an active section of the pair has both robots in it or, being between two poses,
    /// about to enter.
    pub(crate) fn covers(&self, pair: [u32; 2], indices: [usize; 2]) -> bool {
        self.of_robot[pair[0] as usize].iter().any(|&id| {
            let section = &self.sections[id as usize];
            section.robots.contains(&pair[1])
                && [0, 1].iter().all(|&member| {
                    let (start, end) = section.ranges[section.side_of(pair[member])];
                    let index = as_u32(indices[member]);
                    start <= index.saturating_add(1) && index <= end
                })
        })
    }

    fn add(&mut self, section: ActiveSection) {
        let id = if let Some(id) = self.free.pop() {
            self.sections[id as usize] = section;
            id
        } else {
            self.sections.push(section);
            as_u32(self.sections.len() - 1)
        };
        for (side, robot) in section.robots.into_iter().enumerate() {
            let sections = &self.sections;
            let own = &mut self.of_robot[robot as usize];
            let start = section.ranges[side].0;
            let place = own.partition_point(|&known| {
                let known = &sections[known as usize];
                known.ranges[known.side_of(robot)].0 <= start
            });
            own.insert(place, id);
        }
    }

    fn remove(&mut self, id: u32) {
        for robot in self.sections[id as usize].robots {
            self.of_robot[robot as usize].retain(|&known| known != id);
        }
        self.free.push(id);
    }
}
