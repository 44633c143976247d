//! Which poses of its path each robot of a fleet has to itself, and who is in whose way. It knows
//! neither messages nor time.
//!
//! A reservation is a range of poses `lower..=upper` of one path. Reservations of two robots are
//! *apart* when no pose of one overlaps a pose of the other in the world's guarded sections,
//! whose footprint is grown so that a vehicle between two poses lies within what it covers at
//! the two. So as long as each robot is within its reservation and all are apart, none collide.

use std::hash::{Hash, Hasher};
use std::sync::Arc;

use crate::path::PathId;
use crate::section::{Section, Side, Span};
use crate::world::{BayIndex, World};

/// A critical section that lies ahead of one robot and, unless passed meanwhile, of another.
#[derive(Debug, Clone)]
pub(crate) struct Contact {
    pub(crate) other: usize,
    /// The section's poses of this robot and of the other.
    pub(crate) own: Span,
    pub(crate) others: Span,
    sections: Arc<[Section]>,
    position: usize,
}

impl Contact {
    pub(crate) fn section(&self) -> &Section {
        &self.sections[self.position]
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Way {
    path: PathId,
    last: usize,
}

/// The reservations of a fleet.
#[derive(Debug, Clone)]
pub struct Traffic {
    world: Arc<World>,
    ways: Vec<Option<Way>>,
    /// All reservations.
    pub(crate) spans: Vec<Span>,
    /// Per robot its contacts, by robot and along the path.
    contacts: Vec<Vec<Contact>>,
}

impl Traffic {
    /// Of `robot_count` robots nothing is known.
    pub(crate) fn new(world: &Arc<World>, robot_count: usize) -> Self {
        Self {
            world: Arc::clone(world),
            ways: vec![None; robot_count],
            spans: vec![Span::at(0); robot_count],
            contacts: vec![Vec::new(); robot_count],
        }
    }

    /// `robot` stands in `bay`.
    pub(crate) fn park(&mut self, robot: usize, bay: BayIndex) {
        // Any path that begins or ends in the bay has the pose a robot parks at.
        let leaving = self.world.routes_from(bay).first();
        let leaving = leaving.map(|route| (route.path, true));
        let arriving = || {
            let mut routes = self.world.routes.iter();
            let route = routes.find(|route| route.to == bay);
            route.map(|route| (route.path, false))
        };
        if let Some((path, leaves)) = leaving.or_else(arriving) {
            let last = self.world.path(path).last_index();
            self.put(robot, path, Span::at(if leaves { 0 } else { last }));
        }
    }

    /// Number of robots.
    pub fn robot_count(&self) -> usize {
        self.spans.len()
    }

    /// The reservation of `robot`.
    pub fn span(&self, robot: usize) -> Span {
        self.spans[robot]
    }

    /// Last pose of the path `robot` is on; 0 for a robot in a bay that no path touches.
    pub fn last(&self, robot: usize) -> usize {
        self.ways[robot].map_or(0, |way| way.last)
    }

    /// The path `robot` is on.
    pub fn path(&self, robot: usize) -> Option<PathId> {
        self.ways[robot].map(|way| way.path)
    }

    /// The sections that `robot` may still have to share.
    pub(crate) fn contacts(&self, robot: usize) -> &[Contact] {
        &self.contacts[robot]
    }

    /// Puts `robot` on `path` and lets it have `span` of it. What it had before is given up.
    pub fn put(&mut self, robot: usize, path: PathId, span: Span) {
        let last = self.world.path(path).last_index();
        self.ways[robot] = Some(Way { path, last });
        self.spans[robot] = span;
        self.contacts[robot].clear();
        for other in 0..self.robot_count() {
            if other == robot {
                continue;
            }
            self.contacts[other].retain(|contact| contact.other != robot);
            if let Some(way) = self.ways[other] {
                let there = self.contacts_between(path, way.path, other, [robot, other]);
                self.contacts[robot].extend(there);
                let back = self.contacts_between(way.path, path, robot, [other, robot]);
                let position = self.contacts[other].partition_point(|known| known.other < robot);
                self.contacts[other].splice(position..position, back);
            }
        }
    }

    /// Changes the reservation of `robot`.
    pub fn reserve(&mut self, robot: usize, span: Span) {
        self.spans[robot] = span;
    }

    /// Forgets the sections of `robot` that it or the other robot has passed.
    pub(crate) fn forget_passed(&mut self, robot: usize) {
        let spans = &self.spans;
        let lower = spans[robot].lower;
        self.contacts[robot].retain(|contact| {
            contact.own.upper >= lower && contact.others.upper >= spans[contact.other].lower
        });
    }

    /// First pose of `from..=to` of `robot` that overlaps what another robot has in `spans`, and
    /// that robot.
    pub(crate) fn first_conflict(
        &self,
        robot: usize,
        from: usize,
        to: usize,
        spans: &[Span],
    ) -> Option<(usize, usize)> {
        let mut found = None;
        let mut to = to;
        for contact in &self.contacts[robot] {
            if contact.own.lower > to || contact.own.upper < from {
                continue;
            }
            let (poses, taken) = (Span::between(from, to), spans[contact.other]);
            if let Some(index) = contact.section().first_conflict(Side::First, poses, taken) {
                found = Some((index, contact.other));
                if index == from {
                    break;
                }
                to = index - 1;
            }
        }
        found
    }

    /// Two robots whose reservations are not apart, if any: the safety invariant's checker.
    pub fn first_overlap(&self) -> Option<(usize, usize)> {
        (0..self.robot_count()).find_map(|robot| {
            let own = self.spans[robot];
            let contacts = self.contacts[robot].iter();
            contacts
                .filter(|contact| contact.other > robot)
                .find(|contact| {
                    common_pair(contact.section(), own, self.spans[contact.other]).is_some()
                })
                .map(|contact| (robot, contact.other))
        })
    }

    fn contacts_between(
        &self,
        first: PathId,
        second: PathId,
        other: usize,
        robots: [usize; 2],
    ) -> Vec<Contact> {
        let sections = self.world.guarded_sections.between(first, second);
        let lowers = robots.map(|robot| self.spans[robot].lower);
        let contact = |(position, section): (usize, &Section)| {
            let of = |side| Span {
                lower: section.start(side),
                upper: section.end(side),
            };
            let contact = Contact {
                other,
                own: of(Side::First),
                others: of(Side::Second),
                sections: Arc::clone(sections),
                position,
            };
            (contact.own.upper >= lowers[0] && contact.others.upper >= lowers[1]).then_some(contact)
        };
        sections.iter().enumerate().filter_map(contact).collect()
    }
}

/// The contacts follow from these, once those passed are forgotten.
impl PartialEq for Traffic {
    fn eq(&self, other: &Self) -> bool {
        self.ways == other.ways && self.spans == other.spans
    }
}

impl Eq for Traffic {}

impl Hash for Traffic {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.ways.hash(state);
        self.spans.hash(state);
    }
}

/// A pose of `own` and one of `taken` that overlap, if any. Each side of a section knows of a
/// pose only the first and the last partner; a pair that both sides know is meant.
pub(crate) fn common_pair(section: &Section, own: Span, taken: Span) -> Option<(usize, usize)> {
    let from = own.lower.max(section.start(Side::First));
    let to = own.upper.min(section.end(Side::First));
    (from..=to).find_map(|index| {
        let (first, last) = section.partners(Side::First, index)?;
        (first.max(taken.lower)..=last.min(taken.upper))
            .find(|&partner| {
                let back = section.partners(Side::Second, partner);
                back.is_some_and(|(first, last)| first <= index && index <= last)
            })
            .map(|partner| (index, partner))
    })
}

#[cfg(test)]
impl Traffic {
    /// As [`Traffic::first_overlap`], from the section library alone: what tests check the
    /// above against.
    pub(crate) fn first_overlap_by_library(&self) -> Option<(usize, usize)> {
        let library = &self.world.guarded_sections;
        let count = self.robot_count();
        let pairs =
            (0..count).flat_map(|robot| (robot + 1..count).map(move |other| (robot, other)));
        pairs
            .filter_map(|(robot, other)| Some((robot, other, self.ways[robot]?, self.ways[other]?)))
            .find(|&(robot, other, way, others)| {
                let sections = library.between(way.path, others.path);
                let (own, taken) = (self.spans[robot], self.spans[other]);
                let mut sections = sections.iter();
                sections.any(|section| common_pair(section, own, taken).is_some())
            })
            .map(|(robot, other, ..)| (robot, other))
    }

    /// Whether each robot knows every section that neither it nor the other has passed.
    pub(crate) fn knows_sections_ahead(&self) -> bool {
        (0..self.robot_count()).all(|robot| {
            let Some(way) = self.ways[robot] else {
                return true;
            };
            let others = (0..self.robot_count()).filter(|other| *other != robot);
            let mut others = others.filter_map(|other| Some((other, self.ways[other]?)));
            others.all(|(other, others)| {
                let ahead = self.contacts_between(way.path, others.path, other, [robot, other]);
                let known = self.contacts[robot].iter();
                let known = known.filter(|contact| contact.other == other).count();
                known >= ahead.len()
            })
        })
    }

    /// A planted fault: a section counts as passed at its last pose.
    pub(crate) fn plant_forgotten_sections(&mut self) {
        for (contacts, span) in self.contacts.iter_mut().zip(&self.spans) {
            contacts.retain(|contact| contact.own.upper > span.lower);
        }
    }
}
