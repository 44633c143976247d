//! Whether a fleet can begin: from where the robots start, some order lets each of them set out. It looks at places
//! alone, and decides both ways only where it can; between lies what nobody has decided.

use core::fmt;

use crate::mission::MissionMode;
use crate::scenario::Scene;
use crate::world::{BayIndex, Route, World};

/// What is known of a fleet's beginning.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Beginning {
    /// No robot that starts stands in the way of another: each can set out at any time.
    Free,
    /// Each robot can set out once others have; one of those that cannot before.
    Undecided(Obstruction),
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

/// What is known of the beginning of `scene`'s robots. In the safe mode a vehicle in the way of another is in its
/// way; in the legacy mode only one in the bay it goes to.
///
/// A robot that has set out is taken to be in nobody's way any more, so that *never* is said of nobody who could.
pub(crate) fn beginning(scene: &Scene, mode: MissionMode, is_safe: bool) -> Beginning {
    let starts = &scene.starts;
    let routes = |robot: usize| {
        let bay = starts[robot];
        let is_meant = move |route: &&Route| match mode {
            MissionMode::Random => true,
            MissionMode::Shuttle | MissionMode::Once => {
                scene.partners.get(bay).copied().flatten() == Some(route.to)
            }
        };
        scene.world.routes_from(bay).iter().filter(is_meant)
    };
    // Per robot and way, who stands in it.
    let blocked: Vec<Vec<(BayIndex, Vec<usize>)>> = (0..starts.len())
        .map(|robot| {
            let ways =
                routes(robot).map(|route| (route.to, blockers(scene, robot, route, is_safe)));
            ways.collect()
        })
        .collect();
    // Those without any way never set out, by themselves.
    let mut is_waiting: Vec<bool> = blocked.iter().map(|ways| !ways.is_empty()).collect();
    let stays = |robot: usize, is_waiting: &[bool]| is_waiting[robot] || blocked[robot].is_empty();
    loop {
        let sets_out = |robot: &usize| {
            let is_clear = |by: &Vec<usize>| !by.iter().any(|by| stays(*by, &is_waiting));
            is_waiting[*robot] && blocked[*robot].iter().any(|(_, by)| is_clear(by))
        };
        let Some(robot) = (0..starts.len()).find(sets_out) else {
            break;
        };
        is_waiting[robot] = false;
    }
    let Some(first) = is_waiting.iter().position(|waits| *waits) else {
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
            let by = by.iter().find(|by| stays(**by, &is_waiting))?;
            Some((*to, *by))
        };
        let Some((to, by)) = blocked[robot].iter().find_map(in_the_way) else {
            // One without a way ends the chain.
            return Beginning::Never(chain);
        };
        let bay = starts[robot];
        chain.push(Obstruction { robot, bay, to, by });
        robot = by;
    }
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
pub(crate) fn undecided_because(scene: &Scene, mode: MissionMode, is_safe: bool) -> Option<String> {
    match beginning(scene, mode, is_safe) {
        Beginning::Undecided(one) => Some(format!("{one}, unless that one sets out first")),
        Beginning::Free if is_safe => way_past_a_bay(&scene.world).map(|(route, bay)| {
            let Route { from, to, .. } = route;
            format!(
                "the way from bay {from} to bay {to} leads past bay {bay}, where another may stand"
            )
        }),
        Beginning::Free | Beginning::Never(_) => None,
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
            let Beginning::Never(chain) = beginning(&ring(count, false), MissionMode::Random, true)
            else {
                panic!("{count} robots can begin");
            };
            assert_eq!(chain.len(), count);
            let text = obstruction_text(&chain);
            assert!(text.contains("robot 0 in bay 0 cannot go to bay"), "{text}");
            assert!(text.ends_with("for robot 0"), "{text}");
        }
        // The legacy mode sees only who stands in the bay it goes to.
        let legacy = beginning(&ring(3, false), MissionMode::Random, false);
        assert_eq!(legacy, Beginning::Free);
    }

    #[test]
    fn with_a_way_out_it_is_not_decided() {
        let scene = ring(5, true);
        let reason = undecided_because(&scene, MissionMode::Random, true).unwrap();
        assert_eq!(
            reason,
            "robot 0 in bay 0 cannot go to bay 5 for robot 1, unless that one sets out first"
        );
        // Nobody starts in the way, but who parks there later will stand in it.
        let one = Scene {
            starts: vec![0],
            ..scene
        };
        assert_eq!(beginning(&one, MissionMode::Random, true), Beginning::Free);
        let reason = undecided_because(&one, MissionMode::Random, true).unwrap();
        assert!(
            reason.ends_with("leads past bay 1, where another may stand"),
            "{reason}"
        );
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
                let reason = undecided_because(&scene, mode, true);
                assert_eq!(reason, None, "{scenario:?}");
            }
        }
    }
}
