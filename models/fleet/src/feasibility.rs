//! Whether a fleet can begin: from where the robots start, some order lets each of them set out. It looks at places
//! alone, and decides both ways only where it can; between lies what nobody has decided.

use core::fmt;

use crate::mission::{MissionMode, MissionParameters, ways};
use crate::scenario::Scene;
use crate::world::{BayIndex, Route, World};

/// What is known of a fleet's beginning.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Beginning {
    /// No robot that starts stands in the way of another: each can set out at any time.
    Free,
    /// Each robot can set out once others have; one of those that cannot before.
    Undecided(Obstruction),
    /// A robot that no way leads from where it starts to where it may go: which, and what it lacks, in words.
    Wayless(String),
    /// More robots stop after their last missions than find a bay each to stop in.
    Crowded(Ends),
    /// Robots each of which waits for the next, and the last for the first, whatever the others do.
    Never(Vec<Obstruction>),
}

/// A robot that can take none of its ways.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Obstruction {
    robot: usize,
    bay: BayIndex,
    /// Where it cannot go, and who stands in the way there.
    to: BayIndex,
    by: usize,
}

/// Where robots stay after their last missions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Ends {
    missions: u32,
    robots: usize,
    /// Robots that find a bay each, at most.
    parked: usize,
}

/// What is known of the beginning of `scene`'s robots. In the safe mode a vehicle in the way of another is in its
/// way; in the legacy mode only one in the bay it goes to.
///
/// A robot that has set out is taken to be in nobody's way any more, so that *never* is said of nobody who could.
pub(crate) fn beginning(scene: &Scene, missions: &MissionParameters, is_safe: bool) -> Beginning {
    let starts = &scene.starts;
    // Per robot and way, who stands in it.
    let blocked: Vec<Vec<(BayIndex, Vec<usize>)>> = (0..starts.len())
        .map(|robot| {
            let ways = ways(scene, missions.mode, starts[robot]);
            let ways = ways.map(|route| (route.to, blockers(scene, robot, route, is_safe)));
            ways.collect()
        })
        .collect();
    if let Some(robot) = blocked.iter().position(Vec::is_empty) {
        let bay = starts[robot];
        let partner = scene.partners.get(bay).copied().flatten();
        let lack = match (missions.mode, partner) {
            (MissionMode::Random, _) => "no path leads from there".to_owned(),
            (MissionMode::Shuttle | MissionMode::Once, None) => {
                "no bay is the other end of its shuttle line".to_owned()
            }
            (MissionMode::Shuttle | MissionMode::Once, Some(to)) => {
                format!("no path leads to bay {to}, the other end of its shuttle line")
            }
        };
        let what = format!("robot {robot} in bay {bay} can never set out: {lack}");
        return Beginning::Wayless(what);
    }
    let mut is_waiting = vec![true; starts.len()];
    loop {
        let sets_out = |robot: &usize| {
            let is_clear = |by: &Vec<usize>| !by.iter().any(|by| is_waiting[*by]);
            is_waiting[*robot] && blocked[*robot].iter().any(|(_, by)| is_clear(by))
        };
        let Some(robot) = (0..starts.len()).find(sets_out) else {
            break;
        };
        is_waiting[robot] = false;
    }
    let Some(first) = is_waiting.iter().position(|waits| *waits) else {
        if let Some(ends) = crowded(scene, missions) {
            return Beginning::Crowded(ends);
        }
        let found = blocked.iter().enumerate().find_map(|(robot, ways)| {
            let bay = starts[robot];
            let found = ways.iter().find_map(|(to, by)| Some((*to, *by.first()?)));
            found.map(|(to, by)| Obstruction { robot, bay, to, by })
        });
        return found.map_or(Beginning::Free, Beginning::Undecided);
    };
    let mut chain: Vec<Obstruction> = Vec::new();
    let mut robot = first;
    loop {
        if let Some(begin) = chain.iter().position(|link| link.robot == robot) {
            return Beginning::Never(chain.split_off(begin));
        }
        let in_the_way = |(to, by): &(BayIndex, Vec<usize>)| {
            let by = by.iter().find(|by| is_waiting[**by])?;
            Some((*to, *by))
        };
        let (to, by) = blocked[robot]
            .iter()
            .find_map(in_the_way)
            .expect("one that waits has a way, and one that waits in it");
        let bay = starts[robot];
        chain.push(Obstruction { robot, bay, to, by });
        robot = by;
    }
}

/// Where robots stay, if they do not all find a bay: each bay holds one.
fn crowded(scene: &Scene, missions: &MissionParameters) -> Option<Ends> {
    let mission_count = missions.limit()?;
    let starts = scene.starts.iter();
    let ends: Vec<_> = starts
        .map(|bay| ends_after(scene, missions.mode, *bay, mission_count))
        .collect();
    let parked_count = placed_count(&ends, scene.world.bays.len());
    (parked_count < ends.len()).then_some(Ends {
        missions: mission_count,
        robots: ends.len(),
        parked: parked_count,
    })
}

/// The bays that a robot which starts in `bay` may be in after so many missions. As each way leads back, these are those
/// in reach of as many or fewer, but for an even number.
fn ends_after(
    scene: &Scene,
    mode: MissionMode,
    bay: BayIndex,
    mission_count: u32,
) -> Vec<BayIndex> {
    let mut is_seen = vec![[false; 2]; scene.world.bays.len()];
    let mut edge = vec![bay];
    is_seen[bay][0] = true;
    let mut parity = 0;
    for _ in 0..mission_count {
        parity = 1 - parity;
        let mut next = Vec::new();
        for route in edge.iter().flat_map(|bay| ways(scene, mode, *bay)) {
            if !core::mem::replace(&mut is_seen[route.to][parity], true) {
                next.push(route.to);
            }
        }
        if next.is_empty() {
            break;
        }
        edge = next;
    }
    let last = (mission_count % 2) as usize;
    let all = is_seen.iter().enumerate();
    all.filter_map(|(bay, seen)| seen[last].then_some(bay))
        .collect()
}

/// How many of those who would have one of these bays each can have one each, at most: a largest matching, by augmenting
/// paths.
fn placed_count(wanted: &[Vec<BayIndex>], bay_count: usize) -> usize {
    let mut holder: Vec<Option<usize>> = vec![None; bay_count];
    let mut count = 0;
    for robot in 0..wanted.len() {
        // By bay, for whom its holder would have to leave it.
        let mut asked_by: Vec<Option<usize>> = vec![None; bay_count];
        let mut asking = vec![robot];
        let mut found = None;
        while found.is_none()
            && let Some(one) = asking.pop()
        {
            for bay in &wanted[one] {
                if asked_by[*bay].is_some() {
                    continue;
                }
                asked_by[*bay] = Some(one);
                match holder[*bay] {
                    Some(other) => asking.push(other),
                    None => found = found.or(Some(*bay)),
                }
            }
        }
        let Some(mut bay) = found else {
            continue;
        };
        count += 1;
        // Each takes the bay it asked for and leaves the one it had to who asked for that.
        while let Some(one) = asked_by[bay] {
            let had = holder.iter().position(|holder| *holder == Some(one));
            holder[bay] = Some(one);
            let Some(had) = had else {
                break;
            };
            bay = had;
        }
    }
    count
}

/// A bay that a robot with a number of missions may be in, from which fewer ways lead than robots come to their ends: the
/// others may have stopped in all of these. With the number of the ways.
fn scarce_bay(scene: &Scene, missions: &MissionParameters) -> Option<(BayIndex, usize)> {
    let mission_count = missions.limit()?;
    let after = |bay: BayIndex, count| ends_after(scene, missions.mode, bay, count);
    let bay_count = scene.world.bays.len();
    let mut leaves = vec![false; bay_count];
    // Per robot, where it may ever be.
    let mut comes_to = Vec::new();
    for start in &scene.starts {
        let mut comes = vec![false; bay_count];
        for bay in after(*start, mission_count) {
            comes[bay] = true;
        }
        for count in mission_count.saturating_sub(2)..mission_count {
            for bay in after(*start, count) {
                comes[bay] = true;
                leaves[bay] = true;
            }
        }
        comes_to.push(comes);
    }
    let leaves = leaves.iter().enumerate().filter(|(_, leaves)| **leaves);
    leaves
        .map(|(bay, _)| {
            let goals: Vec<_> = ways(scene, missions.mode, bay).map(|way| way.to).collect();
            let comers = comes_to
                .iter()
                .filter(|comes| goals.iter().any(|goal| comes[*goal]));
            (bay, goals.len(), comers.count())
        })
        .find_map(|(bay, way_count, comer_count)| {
            (way_count < comer_count).then_some((bay, way_count))
        })
}

/// Who stands where `robot` would come along `route`, or in its bay.
fn blockers(scene: &Scene, robot: usize, route: &Route, is_safe: bool) -> Vec<usize> {
    let is_in_the_way = |other: usize| {
        let bay = scene.starts[other];
        bay == route.to || (is_safe && passes(&scene.world, route, bay))
    };
    let others = (0..scene.starts.len()).filter(|other| *other != robot);
    others.filter(|other| is_in_the_way(*other)).collect()
}

/// Whether a vehicle on `route` comes where one in `bay` stands.
fn passes(world: &World, route: &Route, bay: BayIndex) -> bool {
    let footprint = world.guarded_sections.footprint();
    let reach_m = 2.0 * footprint.radius_m();
    let parked = world.bays[bay].pose;
    let covered = footprint.at(&parked);
    world.path(route.path).poses()[1..]
        .iter()
        .any(|pose| pose.distance_m(&parked) < reach_m && footprint.at(pose).overlaps(&covered))
}

/// A route that passes a third bay: a world without is *well-formed* (Čáp, Vokřínek and Kleiner 2015), and whoever
/// has a free bay to go to gets there while the others stand in theirs.
fn way_past_a_bay(world: &World) -> Option<(&Route, BayIndex)> {
    world.routes.iter().find_map(|route| {
        let mut third = (0..world.bays.len()).filter(|bay| ![route.from, route.to].contains(bay));
        let passed = third.find(|bay| passes(world, route, *bay));
        passed.map(|bay| (route, bay))
    })
}

/// Why it is not decided whether each robot of `scene` can always go on; `None` where it is.
pub(crate) fn undecided_because(
    scene: &Scene,
    missions: &MissionParameters,
    is_safe: bool,
) -> Option<String> {
    let scarce = scarce_bay(scene, missions).map(|(bay, way_count)| {
        format!(
            "robots that have had their missions may stay in each bay to which a way leads from bay {bay}, {way_count} in \
             all"
        )
    });
    match beginning(scene, missions, is_safe) {
        Beginning::Undecided(one) => Some(format!("{one}, unless that one sets out first")),
        Beginning::Free if scarce.is_some() => scarce,
        Beginning::Free if is_safe => way_past_a_bay(&scene.world).map(|(route, bay)| {
            let Route { from, to, .. } = route;
            format!(
                "the way from bay {from} to bay {to} leads past bay {bay}, where another may stand"
            )
        }),
        Beginning::Free | Beginning::Wayless(_) | Beginning::Never(_) | Beginning::Crowded(_) => {
            None
        }
    }
}

impl fmt::Display for Obstruction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { robot, bay, to, by } = self;
        write!(
            f,
            "robot {robot} in bay {bay} cannot go to bay {to} for robot {by}"
        )
    }
}

impl fmt::Display for Ends {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            missions,
            robots,
            parked,
        } = self;
        write!(
            f,
            "{missions}: no order lets each robot end its missions, as at most {parked} of {robots} \
             find a bay each to stay in"
        )
    }
}

/// The words for robots that can never set out.
pub(crate) fn obstruction_text(chain: &[Obstruction]) -> String {
    let links: Vec<_> = chain.iter().map(Obstruction::to_string).collect();
    format!("no order lets the fleet begin: {}", links.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Footprint, Pose};
    use crate::path::{Path, PathLibrary};
    use crate::scenario::{PlanningSummary, Scenario, WorldParameters};
    use crate::section::MergePolicy;
    use crate::world::{Bay, Vehicle, World};
    use std::sync::Arc;

    const fn missions(mode: MissionMode, missions_per_robot: u32) -> MissionParameters {
        MissionParameters {
            mode,
            missions_per_robot,
            parking_s: 3.0,
        }
    }

    const RANDOM: MissionParameters = missions(MissionMode::Random, 0);

    /// Robots in a ring, each of whose only way leads through the bay of the next: `count` of them, or, when the
    /// last has a way out, in a row.
    fn ring(count: usize, has_exit: bool) -> Scene {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 2.0,
                width_m: 1.0,
            },
            speed_max_mps: 2.0,
            acceleration_mps2: 1.0,
        };
        let on_ring = |index: usize, radius_m: f64| {
            let angle = core::f64::consts::TAU * index as f64 / count as f64;
            Pose::new(radius_m * angle.cos(), radius_m * angle.sin(), 0.0)
        };
        let radius_m = 3.0 * count as f64;
        let (mut bays, mut routes, mut paths) = (Vec::new(), Vec::new(), PathLibrary::default());
        bays.extend((0..count).map(|index| Bay {
            pose: on_ring(index, radius_m),
        }));
        for from in 0..count {
            let outside = on_ring(from + 1, radius_m + 10.0);
            let direct = on_ring(from, radius_m + 10.0);
            let is_exit = has_exit && from + 1 == count;
            let way = if is_exit {
                vec![bays[from].pose, direct]
            } else {
                vec![bays[from].pose, bays[(from + 1) % count].pose, outside]
            };
            let to = bays.len();
            bays.push(Bay {
                pose: way[way.len() - 1],
            });
            let path = paths.add(Path::new(&way, 0.3).unwrap());
            routes.push(Route { from, to, path });
            let (from, to, path) = (to, from, path.reversed());
            routes.push(Route { from, to, path });
        }
        Scene {
            partners: vec![None; bays.len()],
            world: Arc::new(World::new(
                vehicle,
                bays,
                routes,
                paths,
                MergePolicy::WithinVehicle,
            )),
            starts: (0..count).collect(),
            planning: PlanningSummary::default(),
        }
    }

    #[test]
    fn robots_that_block_one_another_in_a_ring_never_begin_and_are_named() {
        for count in [3, 14] {
            let Beginning::Never(chain) = beginning(&ring(count, false), &RANDOM, true) else {
                panic!("{count} robots can begin");
            };
            assert_eq!(chain.len(), count);
            let text = obstruction_text(&chain);
            assert!(text.contains("robot 0 in bay 0 cannot go to bay"), "{text}");
            assert!(text.ends_with("for robot 0"), "{text}");
        }
        // The legacy mode sees only who stands in the bay it goes to.
        let legacy = beginning(&ring(3, false), &RANDOM, false);
        assert_eq!(legacy, Beginning::Free);
    }

    #[test]
    fn with_a_way_out_it_is_not_decided() {
        let scene = ring(5, true);
        let reason = undecided_because(&scene, &RANDOM, true).unwrap();
        assert_eq!(
            reason,
            "robot 0 in bay 0 cannot go to bay 5 for robot 1, unless that one sets out first"
        );
        // Nobody starts in the way, but who parks there later will stand in it.
        let one = Scene {
            starts: vec![0],
            ..scene
        };
        assert_eq!(beginning(&one, &RANDOM, true), Beginning::Free);
        let reason = undecided_because(&one, &RANDOM, true).unwrap();
        assert!(
            reason.ends_with("leads past bay 1, where another may stand"),
            "{reason}"
        );
    }

    /// So many left bays with a robot each and right ones, and a straight path for each pair of ranks.
    fn yard(left: usize, right: usize, pairs: &[(usize, usize)]) -> Scene {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 2.0,
                width_m: 1.0,
            },
            speed_max_mps: 2.0,
            acceleration_mps2: 1.0,
        };
        let column = |x_m: f64, count: usize| {
            (0..count).map(move |rank| Bay {
                pose: Pose::new(x_m, 10.0 * rank as f64, 0.0),
            })
        };
        let bays: Vec<_> = column(0.0, left).chain(column(40.0, right)).collect();
        let (mut routes, mut paths) = (Vec::new(), PathLibrary::default());
        for (from, to) in pairs {
            let (from, to) = (*from, left + to);
            let path = paths.add(Path::new(&[bays[from].pose, bays[to].pose], 0.3).unwrap());
            routes.push(Route { from, to, path });
            let (from, to, path) = (to, from, path.reversed());
            routes.push(Route { from, to, path });
        }
        let mut partners = vec![None; left + right];
        for rank in 0..left.min(right) {
            partners[rank] = Some(left + rank);
            partners[left + rank] = Some(rank);
        }
        Scene {
            partners,
            world: Arc::new(World::new(
                vehicle,
                bays,
                routes,
                paths,
                MergePolicy::WithinVehicle,
            )),
            starts: (0..left).collect(),
            planning: PlanningSummary::default(),
        }
    }

    fn all_pairs(left: usize, right: usize) -> Vec<(usize, usize)> {
        (0..left)
            .flat_map(|from| (0..right).map(move |to| (from, to)))
            .collect()
    }

    #[test]
    fn a_robot_without_a_way_to_go_is_named_in_both_modes() {
        for is_safe in [true, false] {
            let said = |scene: &Scene, mode| match beginning(scene, &missions(mode, 0), is_safe) {
                Beginning::Wayless(what) => what,
                other => format!("{other:?}"),
            };
            // Only robot 0 has a path.
            assert_eq!(
                said(&yard(2, 2, &[(0, 0)]), MissionMode::Random),
                "robot 1 in bay 1 can never set out: no path leads from there"
            );
            let three = yard(3, 1, &all_pairs(3, 1));
            assert_eq!(said(&three, MissionMode::Random), "Free");
            // Paths lead to other bays than those of equal rank.
            let crossed = yard(2, 2, &[(0, 1), (1, 0)]);
            for mode in [MissionMode::Once, MissionMode::Shuttle] {
                assert_eq!(
                    said(&crossed, mode),
                    "robot 0 in bay 0 can never set out: no path leads to bay 2, the other end of its shuttle line"
                );
                assert_eq!(
                    said(&three, mode),
                    "robot 1 in bay 1 can never set out: no bay is the other end of its shuttle line"
                );
            }
        }
    }

    #[test]
    fn a_number_of_missions_needs_a_bay_for_each_robot_to_end_in() {
        let parked = |scene: &Scene, count| match beginning(
            scene,
            &missions(MissionMode::Random, count),
            false,
        ) {
            Beginning::Crowded(ends) => Some(ends.parked),
            _ => None,
        };
        // Of odd numbers all end on the right, of even ones on the left.
        for (left, right) in [(3, 1), (7, 3)] {
            let yard = yard(left, right, &all_pairs(left, right));
            for count in [1, 3, 9] {
                assert_eq!(parked(&yard, count), Some(right), "{count}");
            }
            for count in [0, 2, 4] {
                assert_eq!(parked(&yard, count), None, "{count}");
            }
        }
        // Three right bays, two robots that reach only the first; with three missions robot 1 may come to the second
        // by way of robot 2's bay.
        let shared = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2)];
        assert_eq!(parked(&yard(3, 3, &shared), 1), Some(2));
        assert_eq!(parked(&yard(3, 3, &shared), 3), None);
        // Robot 0 must leave its first choice to robot 1, and that is left to chance.
        let yields = yard(2, 2, &[(0, 0), (0, 1), (1, 0)]);
        assert_eq!(parked(&yields, 1), None);
        let reason = |scene: &Scene, count| {
            undecided_because(scene, &missions(MissionMode::Random, count), false)
        };
        assert_eq!(
            reason(&yields, 1).unwrap(),
            "robots that have had their missions may stay in each bay to which a way leads from bay 1, 1 in all"
        );
        assert_eq!(reason(&yields, 0), None);
        assert_eq!(reason(&yard(2, 2, &all_pairs(2, 2)), 1), None);
        // Nobody else comes to the other end of one's only way.
        assert_eq!(reason(&yard(2, 2, &[(0, 0), (1, 1)]), 3), None);
    }

    #[test]
    fn every_built_in_scenario_can_begin() {
        for scenario in [
            Scenario::Warehouse,
            Scenario::Harbor,
            Scenario::Crossing,
            Scenario::HeadOn,
            Scenario::ThreeCycle,
        ] {
            let parameters = WorldParameters {
                scenario,
                ..WorldParameters::default()
            };
            let scene = parameters.build().unwrap();
            for mode in [MissionMode::Random, MissionMode::Shuttle] {
                let missions = missions(mode, 0);
                let reason = undecided_because(&scene, &missions, true);
                assert_eq!(reason, None, "{scenario:?}");
            }
        }
    }
}
