//! The plan can be driven to its end, whatever was given and taken back before.

use std::sync::Arc;

use crate::coordinator::safe::interlocking::{Heard, Interlocking};
use crate::coordinator::safe::liveness::StopMargin;
use crate::messages::{Phase, State, TO_GOAL};
use crate::scenario::{Scenario, Scene, WorldParameters};
use crate::world::{BayIndex, World};
use hil_core::random::RandomStream;

const MARGIN: StopMargin = StopMargin { poses: 1 };
const QUESTION: u32 = 1;

/// A robot that hears and tells everything, stops in no time, and stands at the end of its authority at last.
#[derive(Debug, Clone, Default)]
struct Body {
    state: State,
    from: BayIndex,
    to: BayIndex,
}

struct Fleet {
    world: Arc<World>,
    core: Interlocking,
    bodies: Vec<Body>,
    random: RandomStream,
}

impl Fleet {
    fn new(scene: &Scene, seed: u64) -> Self {
        let random = RandomStream::new(seed, "plan");
        let robot_count = scene.starts.len();
        let mut core = Interlocking::new(&scene.world, MARGIN, robot_count, QUESTION);
        let mut bodies = vec![Body::default(); robot_count];
        for (robot, (body, &bay)) in bodies.iter_mut().zip(&scene.starts).enumerate() {
            (body.from, body.to) = (bay, bay);
            body.state.header.robot_id = u32::try_from(robot).unwrap();
            body.state.header.header_id = 1;
            body.state.answered = QUESTION;
            assert_eq!(
                core.on_state(robot, &body.state, || Some(bay)),
                Heard::Answered
            );
        }
        Self {
            world: Arc::clone(&scene.world),
            core,
            bodies,
            random,
        }
    }

    fn pick(&mut self, count: usize) -> usize {
        usize::try_from(self.random.next_u64() % count as u64).unwrap()
    }

    fn is_parked(&self, robot: usize) -> bool {
        let ledger = &self.core.members[robot].ledger;
        ledger.mission_id() == 0 || ledger.is_done()
    }

    /// A mission to a bay that no other robot stands in, leaves or drives to.
    fn begin(&mut self, robot: usize) {
        let taken: Vec<_> = self
            .bodies
            .iter()
            .flat_map(|body| [body.from, body.to])
            .collect();
        let routes = self.world.routes_from(self.bodies[robot].to).iter();
        let routes: Vec<_> = routes.filter(|route| !taken.contains(&route.to)).collect();
        if routes.is_empty() {
            return;
        }
        let (path, to) = {
            let choice = self.random.next_u64() % routes.len() as u64;
            let route = routes[usize::try_from(choice).unwrap()];
            (route.path, route.to)
        };
        let body = &mut self.bodies[robot];
        (body.from, body.to) = (body.to, to);
        let state = &mut body.state;
        state.header.mission_id += 1;
        (state.path_id, state.path_index) = (path.0, 0);
        (state.applied_sequence, state.authority_index) = (0, 0);
        state.phase = Phase::Driving as u8;
        let mission_id = state.header.mission_id;
        self.core.begin(robot, mission_id, path);
    }

    fn extend(&mut self, robot: usize, want: usize, may_reorder: bool) {
        self.core.forget_passed();
        self.core.admit_all(may_reorder, |_| {});
        let bound = self.core.members[robot].ledger.bound();
        if self.core.is_open(robot) && want > bound {
            self.core.extend(robot, want, may_reorder);
        }
    }

    fn shrink(&mut self, robot: usize) {
        let ledger = &self.core.members[robot].ledger;
        let (lower, bound) = (ledger.lower(), ledger.bound());
        if !ledger.is_done() && !ledger.is_shrinking() && bound > lower + 2 {
            let end = lower + 1 + self.pick(bound - lower - 1);
            self.core.shrink(robot, end);
        }
    }

    /// The newest command arrives, the robot drives up to `poses` on, and says so.
    fn drive(&mut self, robot: usize, poses: usize) {
        let last = self.core.traffic.last(robot);
        let command = self.core.command(robot);
        let state = &mut self.bodies[robot].state;
        let index_i32 = |index: usize| i32::try_from(index).unwrap();
        if let Some(command) = command {
            state.applied_sequence = command.sequence;
            let is_refused = (0..state.path_index).contains(&command.authority_index);
            if !is_refused {
                state.authority_index = command.authority_index;
            }
        }
        let held = match state.authority_index {
            TO_GOAL => index_i32(last),
            held => held,
        };
        state.path_index = held.min(state.path_index + index_i32(poses));
        if state.path_index == index_i32(last) {
            state.phase = Phase::Done as u8;
            self.bodies[robot].from = self.bodies[robot].to;
        }
        let state = self.bodies[robot].state;
        self.core.on_state(robot, &state, || None);
    }

    fn step(&mut self) {
        let robot = self.pick(self.bodies.len());
        if self.is_parked(robot) {
            return self.begin(robot);
        }
        let last = self.core.traffic.last(robot);
        match self.pick(4) {
            0 | 1 => {
                let want = self.core.members[robot].ledger.bound() + 1 + self.pick(last / 2);
                let may_reorder = self.pick(4) > 0;
                self.extend(robot, want.min(last), may_reorder);
            }
            2 => self.shrink(robot),
            _ => {
                let poses = self.pick(last / 4);
                self.drive(robot, poses);
            }
        }
    }

    /// Whether all missions end when the order of all is kept and nothing is taken back.
    fn can_finish(&mut self) -> bool {
        let mut rounds = 0..20 * self.bodies.len();
        rounds.any(|_| {
            for robot in 0..self.bodies.len() {
                let last = self.core.traffic.last(robot);
                if !self.is_parked(robot) {
                    self.drive(robot, last);
                    self.extend(robot, last, false);
                }
            }
            (0..self.bodies.len()).all(|robot| self.is_parked(robot))
        })
    }
}

#[test]
fn every_mission_can_end_in_the_order_of_the_plan_whatever_was_given_and_taken_back() {
    for scenario in [Scenario::Harbor, Scenario::Warehouse] {
        let parameters = WorldParameters {
            scenario,
            ..WorldParameters::default()
        };
        let scene = parameters.build().unwrap();
        for seed in 0..20 {
            let mut fleet = Fleet::new(&scene, seed);
            for step in 1..=5000 {
                fleet.step();
                let core = &fleet.core;
                let context = format!("{scenario:?}, seed {seed}, step {step}");
                assert!(core.plan.is_possible(&core.traffic), "{context}");
                assert_eq!(core.traffic.first_overlap(), None, "{context}");
                assert!(step % 1000 != 0 || fleet.can_finish(), "{context}");
            }
            let ended = fleet.bodies.iter().map(|body| body.state.header.mission_id);
            assert!(ended.sum::<u32>() > 20, "{scenario:?}, seed {seed}");
        }
    }
}
