//! Which bay a robot is sent to next. When it goes, and whether it may, is the coordinator's
//! business.

use core::time::Duration;

use crate::geometry::floor_index;
use crate::scenario::Scene;
use crate::world::{BayIndex, Route};
use hil_core::random::RandomStream;

hil_core::words! {
    /// How goals are chosen.
    #[derive(Default)]
    pub enum MissionMode {
        /// Any free bay a path leads to, each as likely.
        #[default]
        Random = "random",
        /// To the bay at the other end of the start's shuttle line, and back, for ever.
        Shuttle = "shuttle",
        /// Once to the other end of the shuttle line.
        Once = "once",
    }
}

hil_core::options! {
    /// `[case.parameters.missions]`.
    #[derive(Copy)]
    pub struct MissionParameters {
        /// How goals are chosen.
        mode: MissionMode = MissionMode::Random;
        /// Missions after which a robot stays parked; 0 for no end. `once` gives one at most.
        missions_per_robot: u32 = 0, in 0..=u32::MAX;
        /// How long a robot stays in a bay before its next mission, seconds.
        parking_s: f64 = 3.0, in 0.0..=3600.0;
    }
}

impl MissionParameters {
    /// How long a robot stays in a bay before its next mission.
    pub(crate) fn parking(&self) -> Duration {
        Duration::from_secs_f64(self.parking_s)
    }

    /// True when a robot that is parked is always sent on, sooner or later.
    pub(crate) fn never_end(&self) -> bool {
        self.limit().is_none()
    }

    /// Missions after which a robot stays parked.
    pub(crate) fn limit(&self) -> Option<u32> {
        match (self.mode, self.missions_per_robot) {
            (MissionMode::Once, _) => Some(1),
            (MissionMode::Random | MissionMode::Shuttle, 0) => None,
            (MissionMode::Random | MissionMode::Shuttle, count) => Some(count),
        }
    }
}

/// The ways that a robot in `bay` may be sent.
pub(crate) fn ways(
    scene: &Scene,
    mode: MissionMode,
    bay: BayIndex,
) -> impl Iterator<Item = &Route> {
    let is_meant = move |route: &&Route| match mode {
        MissionMode::Random => true,
        MissionMode::Shuttle | MissionMode::Once => {
            scene.partners.get(bay).copied().flatten() == Some(route.to)
        }
    };
    scene.world.routes_from(bay).iter().filter(is_meant)
}

/// Gives out missions.
#[derive(Debug, Clone)]
pub struct MissionSource {
    mode: MissionMode,
    /// How long a robot stays in a bay before its next mission.
    pub(crate) parking: Duration,
    left_counts: Vec<u32>,
    scene: Scene,
    random: RandomStream,
}

impl MissionSource {
    /// A source for the robots of `scene`; all its choices come from `random`.
    pub fn new(parameters: &MissionParameters, scene: &Scene, random: RandomStream) -> Self {
        let limit = parameters.limit().unwrap_or(u32::MAX);
        Self {
            mode: parameters.mode,
            parking: parameters.parking(),
            left_counts: vec![limit; scene.starts.len()],
            scene: scene.clone(),
            random,
        }
    }

    /// `robot` has had `count` missions already.
    pub(crate) fn resume(&mut self, robot: usize, count: u32) {
        self.left_counts[robot] = self.left_counts[robot].saturating_sub(count);
    }

    /// The next way for `robot`, which stands in bay `at`; `None` when it has had all its missions
    /// or when no bay it could go to is free now. A bay that the robot itself stands in is never
    /// asked about.
    ///
    /// # Panics
    /// When the scene has no such robot.
    pub fn next(
        &mut self,
        robot: usize,
        at: BayIndex,
        is_free: &dyn Fn(BayIndex) -> bool,
    ) -> Option<Route> {
        if self.left_counts[robot] == 0 {
            return None;
        }
        let free = || ways(&self.scene, self.mode, at).filter(|route| is_free(route.to));
        let last = free().count().checked_sub(1)?;
        let pick = match self.mode {
            MissionMode::Random => floor_index(self.random.uniform() * (last + 1) as f64),
            MissionMode::Shuttle | MissionMode::Once => 0,
        };
        let route = *free().nth(pick.min(last))?;
        // Without a limit the count never runs out within a run's mission numbers.
        self.left_counts[robot] -= 1;
        Some(route)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{Scenario, WorldParameters};

    fn scene(scenario: Scenario) -> Scene {
        let parameters = WorldParameters {
            scenario,
            ..WorldParameters::default()
        };
        parameters.build().unwrap()
    }

    fn source(
        scene: &Scene,
        mode: MissionMode,
        missions_per_robot: u32,
        seed: u64,
    ) -> MissionSource {
        let parameters = MissionParameters {
            mode,
            missions_per_robot,
            ..MissionParameters::default()
        };
        MissionSource::new(&parameters, scene, RandomStream::new(seed, "missions"))
    }

    /// Sends seven robots about in turn; gives all routes.
    fn tour(scene: &Scene, mut source: MissionSource, rounds: usize) -> Vec<Route> {
        let mut places = scene.starts.clone();
        let mut routes = Vec::new();
        for _ in 0..rounds {
            for robot in 0..places.len() {
                let taken = places.clone();
                let is_free = |bay: BayIndex| !taken.contains(&bay);
                if let Some(route) = source.next(robot, places[robot], &is_free) {
                    assert!(route.from == places[robot] && is_free(route.to));
                    places[robot] = route.to;
                    routes.push(route);
                }
            }
        }
        routes
    }

    #[test]
    fn random_missions_reach_all_bays_alike_and_repeat_with_their_seed() {
        let scene = scene(Scenario::Warehouse);
        let once = tour(&scene, source(&scene, MissionMode::Random, 0, 1), 1000);
        assert_eq!(once.len(), 7000);
        for bay in 0..14 {
            let count = once.iter().filter(|route| route.to == bay).count();
            assert!((400..600).contains(&count), "{bay} {count}");
        }
        let again = tour(&scene, source(&scene, MissionMode::Random, 0, 1), 1000);
        assert_eq!(once, again);
        let other = tour(&scene, source(&scene, MissionMode::Random, 0, 2), 1000);
        assert_ne!(once, other);
    }

    #[test]
    fn shuttles_go_there_and_back_and_end_with_their_missions() {
        let scene = scene(Scenario::Warehouse);
        let routes = tour(&scene, source(&scene, MissionMode::Shuttle, 3, 1), 10);
        assert_eq!(routes.len(), 21);
        assert!(
            routes
                .iter()
                .all(|route| route.from.abs_diff(route.to) == 7)
        );
        assert_eq!(routes[7].path, routes[0].path.reversed());
    }

    #[test]
    fn once_is_once_and_only_to_a_free_bay() {
        let scene = scene(Scenario::Crossing);
        let mut once = source(&scene, MissionMode::Once, 0, 1);
        assert_eq!(once.next(0, 0, &|_| false), None);
        assert_eq!(once.next(0, 0, &|_| true).map(|route| route.to), Some(2));
        assert_eq!(once.next(0, 2, &|_| true), None);
        assert_eq!(once.next(1, 1, &|_| true).map(|route| route.to), Some(3));
        assert!(once.left_counts.iter().all(|count| *count == 0));
    }

    #[test]
    fn parking_for_no_number_of_seconds_is_refused() {
        let parameters = MissionParameters {
            parking_s: f64::NAN,
            ..MissionParameters::default()
        };
        assert_eq!(parameters.check().unwrap_err().key, "parking_s");
    }
}
