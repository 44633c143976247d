//! The critical sections that pairs of driving robots still have ahead of them, found per robot.
//! It keeps who goes first but does not decide it.

use std::sync::Arc;

use crate::section::{Section, Side};

/// A section that two driving robots both have still to pass.
#[derive(Debug, Clone)]
pub struct ActiveSection {
    /// The robots on the first and on the second side; the lower number first.
    robots: [usize; 2],
    /// All sections of the two paths, shared with the library.
    sections: Arc<[Section]>,
    position: usize,
    /// First and last pose per side, kept here because every cycle reads them.
    ranges: [(usize, usize); 2],
    /// Who goes first, once somebody decided; kept over the cycles.
    pub leader: Option<Side>,
}

impl ActiveSection {
    /// The section's geometry.
    pub fn section(&self) -> &Section {
        &self.sections[self.position]
    }

    /// The robot on `side`.
    pub fn robot(&self, side: Side) -> usize {
        self.robots[side as usize]
    }

    /// The side of `robot`, which must be one of the two.
    pub fn side_of(&self, robot: usize) -> Side {
        if self.robots[0] == robot {
            Side::First
        } else {
            Side::Second
        }
    }

    /// First pose of the section for the robot on `side`.
    pub fn start(&self, side: Side) -> usize {
        self.ranges[side as usize].0
    }

    /// Last pose of the section for the robot on `side`.
    pub fn end(&self, side: Side) -> usize {
        self.ranges[side as usize].1
    }
}

/// Every active section of a fleet, found by slot number and by robot.
#[derive(Debug, Default)]
pub struct SectionBook {
    slots: Vec<Option<ActiveSection>>,
    free: Vec<usize>,
    of_robot: Vec<Vec<usize>>,
}

impl SectionBook {
    pub(crate) fn new(robot_count: usize) -> Self {
        Self {
            of_robot: vec![Vec::new(); robot_count],
            ..Self::default()
        }
    }

    /// The section in `slot`; `None` when the slot is empty.
    pub fn get(&self, slot: usize) -> Option<&ActiveSection> {
        self.slots.get(slot)?.as_ref()
    }

    /// The section in `slot`, for its order.
    pub fn get_mut(&mut self, slot: usize) -> Option<&mut ActiveSection> {
        self.slots.get_mut(slot)?.as_mut()
    }

    /// Slots in use are below this; a slot is used again after its section went away.
    pub fn slot_count(&self) -> usize {
        self.slots.len()
    }

    /// The sections of `robot` with their slots, in no particular but reproducible order.
    pub fn of_robot(&self, robot: usize) -> impl Iterator<Item = (usize, &ActiveSection)> {
        self.of_robot[robot]
            .iter()
            .filter_map(|&slot| Some((slot, self.get(slot)?)))
    }

    /// Adds the sections of two robots' paths that neither has passed. `robots` ascend,
    /// `sections` have the first robot's path first, `passed` are the reported indices.
    pub(crate) fn add(
        &mut self,
        robots: [usize; 2],
        sections: &Arc<[Section]>,
        indices: [usize; 2],
    ) {
        for (position, section) in sections.iter().enumerate() {
            let ranges =
                [Side::First, Side::Second].map(|side| (section.start(side), section.end(side)));
            if indices[0] > ranges[0].1 || indices[1] > ranges[1].1 {
                continue;
            }
            let active = ActiveSection {
                robots,
                sections: Arc::clone(sections),
                position,
                ranges,
                leader: None,
            };
            let slot = self.free.pop().unwrap_or(self.slots.len());
            if slot == self.slots.len() {
                self.slots.push(None);
            }
            self.slots[slot] = Some(active);
            for robot in robots {
                self.of_robot[robot].push(slot);
            }
        }
    }

    /// Removes the sections of `robot` that end before `index`; gives their number.
    pub(crate) fn remove_passed(&mut self, robot: usize, index: usize) -> u64 {
        self.remove_where(robot, |active| index > active.end(active.side_of(robot)))
    }

    /// Removes all sections of `robot`; gives their number.
    pub(crate) fn remove_all(&mut self, robot: usize) -> u64 {
        self.remove_where(robot, |_| true)
    }

    fn remove_where(&mut self, robot: usize, is_over: impl Fn(&ActiveSection) -> bool) -> u64 {
        let mut removed_count = 0;
        let mut position = 0;
        while let Some(&slot) = self.of_robot[robot].get(position) {
            let Some(active) = self.slots[slot].take_if(|active| is_over(active)) else {
                position += 1;
                continue;
            };
            self.of_robot[robot].swap_remove(position);
            let other = active.robot(active.side_of(robot).other());
            self.of_robot[other].retain(|&kept| kept != slot);
            self.free.push(slot);
            removed_count += 1;
        }
        removed_count
    }
}

#[cfg(test)]
impl SectionBook {
    /// Every section once with its slot, in reproducible order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (usize, &ActiveSection)> {
        (0..self.of_robot.len()).flat_map(move |robot| {
            self.of_robot(robot)
                .filter(move |(_, active)| active.robots[0] == robot)
        })
    }
}
