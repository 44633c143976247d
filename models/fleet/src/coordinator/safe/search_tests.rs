//! The exhaustive search: every state that the coordinator's decisions ([`Interlocking`]) and the robots' ([`Holder`])
//! can reach together, over a network that loses, repeats, reorders and delays without limit, with restarts of both.
//! The code is the one that runs; the model is what surrounds it: motion from pose to pose, the network, and a
//! coordinator that extends and takes back whatever and whenever it likes.
//!
//! Three reductions make the states finite without a limit of depth or of messages under way, and lose none that
//! matters:
//! - *Everything is sent at once and stays under way.* A message may come at any time, any number of times, or never,
//!   so one under way allows whatever its absence allows: sending later, loss and repetition need no steps of their own.
//! - *Messages without effect are dropped*: those that the code searched passes over now, and also as soon as a later
//!   mission of the robot begins or the robot restarts, as far as it may.
//! - *Sequences and header ids are only compared*, so a state keeps their order and not their values.
//!
//! `stateright` keeps of each state visited a 64-bit hash: of `n` states, two fall together with a probability below
//! `n²/2⁶⁵`. What the search does not cover stands in `docs/case-studies.md`.

use std::collections::BTreeSet;
use std::io;
use std::sync::Arc;

use stateright::report::WriteReporter;
use stateright::{Checker, Model, Property};

use crate::coordinator::safe::interlocking::Interlocking;
use crate::coordinator::safe::liveness::StopMargin;
use crate::coordinator::safe::reservation::common_pair;
use crate::geometry::{Footprint, Pose};
use crate::messages::{Authority, Header, Mission, Phase, State};
use crate::path::{Path, PathId, PathLibrary};
use crate::robot::authority::{Holder, MissionVerdict, Standing};
use crate::scenario::{Scenario, WorldParameters};
use crate::section::{MergePolicy, Side, Span};
use crate::world::{Bay, BayIndex, Route, Vehicle, World};

const MARGIN: StopMargin = StopMargin { poses: 1 };

/// What is searched.
#[derive(Debug, Clone)]
struct Setting {
    world: Arc<World>,
    /// Per robot the path of its first mission; that of the second leads back.
    paths: Vec<PathId>,
    /// Missions of each robot.
    missions: u32,
    /// Ends of authorities that are asked for; what the plan foresees comes on top.
    ends: Vec<usize>,
    /// Poses at which a robot is looked at; between two it may be anywhere.
    stops: Vec<usize>,
    /// Restarts of each robot, and of the coordinator.
    robot_restarts: Vec<u8>,
    coordinator_restarts: u8,
    fault: Option<Fault>,
}

/// A fault in the code searched, to show that the search finds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// A shrink counts as acknowledged when it is sent.
    LostAcknowledgement,
    /// A state counts whatever the account knows already.
    StaleState,
    /// A state of the mission before counts for the present one.
    OldMission,
    /// A robot takes commands that rest on states of before a restart.
    VoidCommand,
    /// A robot that restarted takes commands of before, until it hears a question.
    CommandOfBefore,
    /// A robot takes an authority of a mission before for the present one.
    OldAuthority,
    /// A robot takes less way though it cannot stop in it.
    LateShrink,
    /// A section is forgotten at its last pose.
    ForgottenSection,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Snapshot {
    core: Interlocking,
    question: u32,
    robots: Vec<Body>,
    down: Vec<Down>,
    up: Vec<Report>,
    coordinator_restarts: u8,
}

/// A robot with its body.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Body {
    holder: Holder,
    path: PathId,
    /// Last pose passed; it is between this and the next.
    passed: usize,
    /// Where it rolls to whatever it holds, as it cannot stop before: only a faulty robot does.
    rolls_to: usize,
    restarts: u8,
}

impl Body {
    /// It restarts `rolls` poses further on.
    fn restart(&mut self, rolls: usize) {
        self.restarts -= 1;
        self.passed += rolls;
        self.rolls_to = 0;
        // Where its clock is when it is back.
        self.holder = Holder::new(self.path.0, self.holder.header_id + 10);
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Down {
    Authority(Authority),
    Mission(Mission),
}

impl Down {
    fn header(&self) -> &Header {
        match self {
            Self::Authority(authority) => &authority.header,
            Self::Mission(mission) => &mission.header,
        }
    }

    fn echo_header_id(&mut self) -> &mut u32 {
        match self {
            Self::Authority(authority) => &mut authority.echo_header_id,
            Self::Mission(mission) => &mut mission.echo_header_id,
        }
    }

    fn robot(&self) -> usize {
        self.header().robot_id as usize
    }

    fn is_question(&self) -> bool {
        matches!(self, Self::Authority(authority) if authority.flags & Authority::QUESTION != 0)
    }

    fn sort_key(&self) -> (usize, u32, u32, i32) {
        match self {
            Self::Authority(authority) => (
                self.robot(),
                authority.flags,
                authority.sequence,
                authority.authority_index,
            ),
            Self::Mission(_) => (self.robot(), 0, 0, 0),
        }
    }
}

/// A state under way, without what only motion tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Report {
    robot: usize,
    header_id: u32,
    mission_id: u32,
    path_id: u32,
    path_index: i32,
    authority_index: i32,
    applied_sequence: u32,
    answered: u32,
    phase: u8,
    /// Where it stands, for one without a mission.
    bay: Option<BayIndex>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// The coordinator gives a robot its mission.
    Begin(usize),
    /// It decides for a robot: extends towards an end, or takes back down to one.
    Extend(usize, usize),
    Shrink(usize, usize),
    /// A message to a robot arrives; the robot can stop at the poses ahead, or at none.
    Arrive(usize, Braking),
    /// A robot passes a pose.
    Drive(usize),
    /// A state arrives.
    Hear(usize),
    /// A robot restarts where it is, or a pose further on.
    RestartRobot(usize, usize),
    RestartCoordinator,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Braking {
    InTime,
    TooLate,
}

/// The first header id valid at a robot, where only the order of header ids counts.
const VALID_FROM: u32 = 1000;

impl Setting {
    fn last(&self, path: PathId) -> usize {
        self.world.path(path).last_index()
    }

    fn route(&self, path: PathId) -> &Route {
        let mut routes = self.world.routes.iter();
        routes
            .find(|route| route.path == path)
            .expect("a path of a route")
    }

    /// Where a robot that may move is looked at next.
    fn target(&self, body: &Body) -> Option<usize> {
        let reach = body.holder.grant.reach(self.last(body.path));
        let may_move = body.holder.is_under_way() && reach > body.passed;
        let next = self.stops.iter().find(|stop| **stop > body.passed);
        next.filter(|_| may_move).map(|next| reach.min(*next))
    }

    /// The poses a robot may be at.
    fn occupied(&self, body: &Body) -> Span {
        let is_on_its_way = body.passed > 0 && body.passed < self.last(body.path);
        let rest = body.passed + usize::from(is_on_its_way);
        let reached = self.target(body).unwrap_or(0).max(body.rolls_to);
        Span {
            lower: body.passed,
            upper: reached.max(rest),
        }
    }

    fn are_apart(&self, one: &Body, other: &Body) -> bool {
        let (own, taken) = (self.occupied(one), self.occupied(other));
        let sections = self.world.guarded_sections.between(one.path, other.path);
        sections
            .iter()
            .all(|section| common_pair(section, own, taken).is_none())
    }

    fn report(&self, robot: usize, body: &Body) -> Report {
        let mut state = State::default();
        body.holder.describe(&mut state);
        let has_mission = state.header.mission_id != 0;
        let route = self.route(body.path);
        let bay = match body.passed {
            0 => Some(route.from),
            passed if passed == self.last(body.path) => Some(route.to),
            _ => None,
        };
        Report {
            robot,
            header_id: state.header.header_id,
            mission_id: state.header.mission_id,
            path_id: state.path_id,
            path_index: if has_mission {
                index_i32(body.passed)
            } else {
                -1
            },
            authority_index: state.authority_index,
            applied_sequence: state.applied_sequence,
            answered: state.answered,
            phase: state.phase,
            bay: bay.filter(|_| !has_mission),
        }
    }

    fn arrive(&self, body: &mut Body, message: &Down, braking: Braking) {
        let message = self.planted(body, *message);
        let last_index = self.last(body.path);
        let reach = body.holder.grant.reach(last_index);
        match message {
            Down::Authority(authority) => self.arrive_authority(body, &authority, braking),
            Down::Mission(mission) => self.arrive_mission(body, &mission),
        }
        if braking == Braking::TooLate && body.holder.grant.reach(last_index) < reach {
            body.rolls_to = reach;
        }
    }

    /// What a robot with the fault planted takes `message` for.
    fn planted(&self, body: &mut Body, mut message: Down) -> Down {
        let mut state = State::default();
        body.holder.describe(&mut state);
        let is_void_taken = match self.fault {
            Some(Fault::VoidCommand) => true,
            Some(Fault::CommandOfBefore) => state.answered == 0,
            _ => false,
        };
        if is_void_taken {
            let [valid_from, _] = body.holder.header_ids();
            *message.echo_header_id() = *valid_from;
        }
        if let Down::Authority(authority) = &mut message
            && self.fault == Some(Fault::OldAuthority)
        {
            let header = &mut authority.header;
            header.mission_id = header.mission_id.max(state.header.mission_id);
        }
        message
    }

    fn arrive_authority(&self, body: &mut Body, authority: &Authority, braking: Braking) {
        let last_index = self.last(body.path);
        let passed = body.passed;
        let can_stop = braking == Braking::InTime;
        let is_late_taken = self.fault == Some(Fault::LateShrink);
        let standing = Standing {
            last_index,
            passed,
            can_stop_at: &|index| {
                (can_stop && passed <= index) || (is_late_taken && passed < index)
            },
        };
        body.holder.on_authority(authority, &standing);
        if passed == last_index && body.holder.is_under_way() {
            body.holder.settle(true, passed, last_index);
        }
    }

    fn arrive_mission(&self, body: &mut Body, mission: &Mission) {
        if body.holder.judge_mission(mission) != MissionVerdict::Begin {
            return;
        }
        let path = PathId(mission.path_id);
        let stands_at_start = (body.path == path && body.passed == 0)
            || (body.path == path.reversed() && body.passed == self.last(path));
        if !stands_at_start {
            return;
        }
        self.begin(body, mission);
    }

    fn begin(&self, body: &mut Body, mission: &Mission) {
        (body.path, body.passed, body.rolls_to) = (PathId(mission.path_id), 0, 0);
        if let Some(kept) = body.holder.begin(mission) {
            self.arrive_authority(body, &kept, Braking::InTime);
        }
    }

    /// The body, and what a message under way may meet instead: it after a restart, and each at the start of each
    /// mission to come.
    fn bodies_to_come(&self, robot: usize, body: &Body) -> Vec<Body> {
        let mut bodies = vec![body.clone()];
        if body.restarts > 0 {
            let mut restarted = body.clone();
            restarted.restart(0);
            bodies.push(restarted);
        }
        for position in 0..bodies.len() {
            for mission_id in bodies[position].holder.mission_id + 1..=self.missions {
                let mut mission = Mission::default();
                mission.header.mission_id = mission_id;
                mission.path_id = self.path(robot, mission_id).0;
                let mut begun = bodies[position].clone();
                self.begin(&mut begun, &mission);
                bodies.push(begun);
            }
        }
        bodies
    }

    /// The path of a mission, counted from 1.
    fn path(&self, robot: usize, mission_id: u32) -> PathId {
        let first = self.paths[robot];
        if mission_id % 2 == 1 {
            first
        } else {
            first.reversed()
        }
    }

    /// The mission that may begin, if any.
    fn next_mission(&self, core: &Interlocking, robot: usize) -> Option<u32> {
        let ledger = &core.members[robot].ledger;
        let is_parked = ledger.mission_id() == 0
            && core.traffic.path(robot) == Some(self.paths[robot])
            && core.traffic.span(robot) == Span::at(0);
        let is_over = ledger.is_done() && ledger.mission_id() < self.missions;
        (core.is_complete() && (is_parked || is_over)).then(|| ledger.mission_id() + 1)
    }

    fn mission(&self, core: &Interlocking, robot: usize) -> Mission {
        let mission_id = core.members[robot].ledger.mission_id();
        let path = self.path(robot, mission_id);
        let mut mission = Mission {
            path_id: path.0,
            end_index: u32::try_from(self.last(path)).expect("few poses"),
            path_hash: self.world.path(path).hash(),
            ..Mission::default()
        };
        mission.header.robot_id = u32::try_from(robot).expect("few robots");
        mission.header.mission_id = mission_id;
        core.address(&mut mission);
        mission
    }

    fn new_coordinator(&self, question: u32) -> Interlocking {
        Interlocking::new(&self.world, MARGIN, self.paths.len(), question)
    }

    /// A state arrives at a coordinator.
    fn hear(&self, core: &mut Interlocking, report: &Report) {
        let mut state = State {
            path_index: report.path_index,
            authority_index: report.authority_index,
            applied_sequence: report.applied_sequence,
            answered: report.answered,
            path_id: report.path_id,
            phase: report.phase,
            ..State::default()
        };
        state.header.robot_id = u32::try_from(report.robot).expect("few robots");
        state.header.header_id = report.header_id;
        state.header.mission_id = report.mission_id;
        if self.fault == Some(Fault::StaleState) {
            core.members[report.robot].ledger.plant_stale_state();
        }
        let present_id = core.members[report.robot].ledger.mission_id();
        if self.fault == Some(Fault::OldMission) && present_id > 1 {
            state.header.mission_id = present_id;
        }
        core.on_state(report.robot, &state, || report.bay);
        self.forget_passed(core);
    }

    fn forget_passed(&self, core: &mut Interlocking) {
        core.forget_passed();
        if self.fault == Some(Fault::ForgottenSection) {
            core.traffic.plant_forgotten_sections();
        }
    }

    /// Puts under way what robots and coordinator would send, drops what has no effect, and keeps of all numbers that
    /// are only compared their order. The first `effective_count` states under way are known to have an effect.
    fn settle(&self, next: &mut Snapshot, effective_count: usize) {
        for robot in 0..next.robots.len() {
            self.send_commands(next, robot);
            self.send_report(next, robot);
            self.drop_commands(next, robot);
        }
        self.drop_reports(next, effective_count);
        for robot in 0..next.robots.len() {
            next.normalise_header_ids(robot);
            next.normalise_sequences(robot);
        }
        next.down.sort_by_key(Down::sort_key);
        next.down.dedup();
        next.up.sort_unstable();
        next.up.dedup();
    }

    fn send_commands(&self, next: &mut Snapshot, robot: usize) {
        let core = &next.core;
        let ledger = &core.members[robot].ledger;
        let told = core.question(robot).or_else(|| core.command(robot));
        next.down.extend(told.map(Down::Authority));
        let is_unseen =
            ledger.lower() == 0 && (ledger.newest().0 == 0 || !ledger.is_acknowledged());
        if ledger.mission_id() != 0 && !ledger.is_done() && is_unseen {
            next.down.push(Down::Mission(self.mission(core, robot)));
        }
    }

    fn send_report(&self, next: &mut Snapshot, robot: usize) {
        let valid_from = next.valid_from(robot);
        let body = &mut next.robots[robot];
        let mut report = self.report(robot, body);
        let mut sent = next.up.iter().filter(|sent| sent.header_id >= valid_from);
        let is_sent = sent.any(|sent| {
            let header_id = report.header_id;
            Report { header_id, ..*sent } == report
        });
        if !is_sent {
            body.holder.header_id += 1;
            report.header_id = body.holder.header_id;
            next.up.push(report);
        }
    }

    fn drop_commands(&self, next: &mut Snapshot, robot: usize) {
        let bodies = self.bodies_to_come(robot, &next.robots[robot]);
        let has_effect = |message: &Down, body: &Body| {
            let mut after = body.clone();
            self.arrive(&mut after, message, Braking::InTime);
            after != *body
        };
        next.down.retain(|message| {
            message.robot() != robot || bodies.iter().any(|body| has_effect(message, body))
        });
    }

    fn drop_reports(&self, next: &mut Snapshot, effective_count: usize) {
        let ways: Vec<_> = (0..next.robots.len())
            .map(|robot| self.cores_to_come(next, robot))
            .collect();
        for position in (effective_count..next.up.len()).rev() {
            let report = next.up[position];
            let valid_from = next.valid_from(report.robot);
            let has_effect = |core: &Interlocking| {
                let mut after = core.clone();
                self.hear(&mut after, &report);
                // Of the newest header id only counts whether commands may rest on it.
                let newest = &mut after.members[report.robot].newest_header_id;
                let was_newest = core.members[report.robot].newest_header_id;
                if (*newest >= valid_from) == (was_newest >= valid_from) {
                    *newest = was_newest;
                }
                after != *core
            };
            if !ways[report.robot].iter().any(has_effect) {
                next.up.remove(position);
            }
        }
    }

    /// The coordinator, and what a state under way may meet instead: one that restarted, and it at the start of each
    /// mission of the robot to come.
    fn cores_to_come(&self, next: &Snapshot, robot: usize) -> Vec<Interlocking> {
        let mut cores = vec![next.core.clone()];
        if next.coordinator_restarts > 0 {
            cores.push(self.new_coordinator(next.question + 1));
        }
        let present_id = next.core.members[robot].ledger.mission_id();
        if next.core.is_complete() {
            for mission_id in present_id + 1..=self.missions {
                let mut begun = next.core.clone();
                begun.begin(robot, mission_id, self.path(robot, mission_id));
                cores.push(begun);
            }
        }
        cores
    }
}

fn index_i32(index: usize) -> i32 {
    i32::try_from(index).expect("few poses")
}

impl Snapshot {
    fn valid_from(&mut self, robot: usize) -> u32 {
        *self.robots[robot].holder.header_ids()[0]
    }

    fn commands(&mut self, robot: usize) -> impl Iterator<Item = &mut Down> {
        let down = self.down.iter_mut();
        down.filter(move |message| message.robot() == robot)
    }

    fn reports(&mut self, robot: usize) -> impl Iterator<Item = &mut Report> {
        let up = self.up.iter_mut();
        up.filter(move |report| report.robot == robot)
    }

    fn normalise_sequences(&mut self, robot: usize) {
        fn all<'a>(snapshot: &'a mut Snapshot, robot: usize, take: &mut dyn FnMut(&mut u32)) {
            snapshot.core.members[robot]
                .ledger
                .sequences()
                .for_each(&mut *take);
            snapshot.robots[robot]
                .holder
                .sequences()
                .for_each(&mut *take);
            for message in snapshot.commands(robot) {
                if let Down::Authority(authority) = message
                    && authority.flags & Authority::QUESTION == 0
                {
                    take(&mut authority.sequence);
                }
            }
            let reports = snapshot.reports(robot);
            reports.for_each(|report| take(&mut report.applied_sequence));
        }
        self.core.members[robot].ledger.forget_ceiling();
        self.robots[robot].holder.grant.is_refused = false;
        let mut known = BTreeSet::from([0]);
        all(self, robot, &mut |sequence| {
            known.insert(*sequence);
        });
        all(self, robot, &mut |sequence| {
            *sequence = rank(&known, *sequence);
        });
    }

    /// Of the commands, what counts is whether they are void; of the newest state heard, whether a command that
    /// rests on it is; and of states, which came first, until one has been an answer.
    fn normalise_header_ids(&mut self, robot: usize) {
        let valid_from = self.valid_from(robot);
        let rests_on = |echo: u32| if echo >= valid_from { VALID_FROM } else { 0 };
        for message in self.commands(robot) {
            let echo = message.echo_header_id();
            *echo = rests_on(*echo);
        }
        if let Some(early) = self.robots[robot].holder.early() {
            early.echo_header_id = rests_on(early.echo_header_id);
        }
        let (answered, newest) = self.core.members[robot].header_ids();
        let has_answered = answered.is_some();
        *newest = rests_on(*newest);
        if let Some(first) = answered {
            *first = 0;
        }
        let ids = self.reports(robot).map(|report| report.header_id);
        let (old, new): (BTreeSet<u32>, BTreeSet<u32>) = ids.partition(|id| *id < valid_from);
        let number = |id: u32| match (id < valid_from, has_answered) {
            (true, true) => 1,
            (true, false) => 1 + rank(&old, id),
            (false, true) => VALID_FROM,
            (false, false) => VALID_FROM + rank(&new, id),
        };
        self.reports(robot)
            .for_each(|report| report.header_id = number(report.header_id));
        let latest = if has_answered {
            VALID_FROM
        } else {
            VALID_FROM + u32::try_from(new.len()).expect("few states")
        };
        let [first_valid, present] = self.robots[robot].holder.header_ids();
        (*first_valid, *present) = (VALID_FROM, latest);
    }
}

fn rank(known: &BTreeSet<u32>, number: u32) -> u32 {
    u32::try_from(known.range(..number).count()).expect("few numbers")
}

impl Model for Setting {
    type State = Snapshot;
    type Action = Step;

    fn init_states(&self) -> Vec<Snapshot> {
        let robots = self
            .paths
            .iter()
            .zip(&self.robot_restarts)
            .map(|(&path, &restarts)| Body {
                holder: Holder::new(path.0, 0),
                path,
                passed: 0,
                rolls_to: 0,
                restarts,
            });
        let mut first = Snapshot {
            core: self.new_coordinator(1),
            question: 1,
            robots: robots.collect(),
            down: Vec::new(),
            up: Vec::new(),
            coordinator_restarts: self.coordinator_restarts,
        };
        self.settle(&mut first, 0);
        vec![first]
    }

    fn actions(&self, state: &Snapshot, steps: &mut Vec<Step>) {
        let core = &state.core;
        for (robot, body) in state.robots.iter().enumerate() {
            let ledger = &core.members[robot].ledger;
            let bound = ledger.bound();
            if self.next_mission(core, robot).is_some() {
                steps.push(Step::Begin(robot));
            }
            if ledger.mission_id() != 0 && !ledger.is_done() {
                let wanted = self.ends.iter().filter(|end| **end > bound);
                steps.extend(wanted.map(|end| Step::Extend(robot, *end)));
                let kept = self
                    .ends
                    .iter()
                    .filter(|end| (ledger.lower() + 1..bound).contains(end));
                if !ledger.is_shrinking() {
                    steps.extend(kept.map(|end| Step::Shrink(robot, *end)));
                }
            }
            let target = self.target(body);
            if target.is_some() {
                steps.push(Step::Drive(robot));
            }
            if body.restarts > 0 {
                steps.push(Step::RestartRobot(robot, 0));
                if let Some(target) = target {
                    steps.push(Step::RestartRobot(robot, target - body.passed));
                }
            }
        }
        for (position, message) in state.down.iter().enumerate() {
            steps.push(Step::Arrive(position, Braking::InTime));
            if matches!(message, Down::Authority(_)) && !message.is_question() {
                steps.push(Step::Arrive(position, Braking::TooLate));
            }
        }
        steps.extend((0..state.up.len()).map(Step::Hear));
        if state.coordinator_restarts > 0 {
            steps.push(Step::RestartCoordinator);
        }
    }

    fn next_state(&self, state: &Snapshot, step: Step) -> Option<Snapshot> {
        let mut next = state.clone();
        let mut effective_count = 0;
        match step {
            Step::Begin(robot) => {
                let mission_id = self.next_mission(&next.core, robot)?;
                let path = self.path(robot, mission_id);
                next.core.begin(robot, mission_id, path);
            }
            Step::Extend(robot, end) => {
                self.forget_passed(&mut next.core);
                next.core.admit_all(true, |_| {});
                let is_given =
                    next.core.is_open(robot) && next.core.extend(robot, end, true).is_given;
                if !is_given {
                    return None;
                }
            }
            Step::Shrink(robot, end) => {
                if !next.core.shrink(robot, end) {
                    return None;
                }
                if self.fault == Some(Fault::LostAcknowledgement) {
                    next.core.members[robot].ledger.plant_lost_acknowledgement();
                    next.core.plant_span(robot);
                }
            }
            Step::Arrive(position, braking) => {
                let message = next.down[position];
                self.arrive(&mut next.robots[message.robot()], &message, braking);
                if !message.is_question() {
                    effective_count = state.up.len();
                }
            }
            Step::Drive(robot) => {
                effective_count = state.up.len();
                let target = self.target(&next.robots[robot])?;
                let body = &mut next.robots[robot];
                body.passed = target;
                let last = self.last(body.path);
                if body.passed == last {
                    body.holder.settle(true, last, last);
                }
            }
            Step::Hear(position) => {
                let report = next.up[position];
                self.hear(&mut next.core, &report);
            }
            Step::RestartRobot(robot, rolls) => {
                next.robots[robot].restart(rolls);
            }
            Step::RestartCoordinator => {
                next.coordinator_restarts -= 1;
                next.question += 1;
                next.core = self.new_coordinator(next.question);
            }
        }
        self.settle(&mut next, effective_count);
        Some(next)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        let mut properties = vec![
            Property::always("robots are apart", |setting: &Self, state: &Snapshot| {
                (0..state.robots.len()).all(|one| {
                    (one + 1..state.robots.len())
                        .all(|other| setting.are_apart(&state.robots[one], &state.robots[other]))
                })
            }),
            Property::always("reservations are apart", |_: &Self, state: &Snapshot| {
                let traffic = &state.core.traffic;
                !state.core.is_complete() || traffic.first_overlap_by_library().is_none()
            }),
            Property::always("sections ahead are known", |_: &Self, state: &Snapshot| {
                state.core.traffic.knows_sections_ahead()
            }),
            Property::always("the plan is possible", |_: &Self, state: &Snapshot| {
                state.core.plan.is_possible(&state.core.traffic)
            }),
            Property::sometimes(
                "all reach their goals",
                |setting: &Self, state: &Snapshot| {
                    let has_restarted = state.coordinator_restarts < setting.coordinator_restarts;
                    has_restarted == (setting.coordinator_restarts > 0)
                        && state.robots.iter().all(|body| {
                            body.holder.phase == Phase::Done
                                && body.holder.mission_id == setting.missions
                        })
                },
            ),
        ];
        if self.fault.is_none() && self.ends.len() > 1 {
            let refused = |_: &Self, state: &Snapshot| {
                let mut ledgers = state.core.members.iter().map(|member| &member.ledger);
                ledgers.any(|ledger| ledger.is_acknowledged() && ledger.bound() > ledger.newest().1)
            };
            properties.push(Property::sometimes("a refusal is heard", refused));
        }
        properties
    }
}

/// Searches all states; gives how many there are. No state is a collision, and each event that is possible occurs.
fn search(setting: Setting) -> usize {
    // Breadth first, for the shortest way to a failure: a fault may let messages pile up, among which depth first gets
    // lost.
    let ends = stateright::HasDiscoveries::AnyFailures;
    count(setting.checker().finish_when(ends).spawn_bfs())
}

fn count(checker: impl Checker<Setting>) -> usize {
    // Prints states, steps, depth and seconds, and the way to what was found.
    let checker = checker
        .report(&mut WriteReporter::new(&mut io::stdout()))
        .join();
    checker.assert_properties();
    // The frontier is empty: a search ends before only with a failure.
    assert!(checker.is_done());
    checker.unique_state_count()
}

/// A fault is found: the search ends at a state in which robots or reservations are not apart, or a section ahead is
/// not known.
fn finds(fault: Fault, setting: Setting) {
    let failures = [
        "robots are apart",
        "reservations are apart",
        "sections ahead are known",
    ];
    let ends = stateright::HasDiscoveries::AnyOf(failures.into());
    let setting = Setting {
        fault: Some(fault),
        ..setting
    };
    // Breadth first, for the shortest way.
    let checker = setting.checker().finish_when(ends).spawn_bfs();
    let checker = checker
        .report(&mut WriteReporter::new(&mut io::stdout()))
        .join();
    let found = failures.map(|name| checker.discovery(name).is_some());
    assert!(found.contains(&true), "{fault:?}");
}

/// Two robots that cross, 9 poses each.
fn crossing() -> Setting {
    let scenario = Scenario::Crossing;
    setting(
        of_scenario(scenario, [1.0, 2.0], 2.5),
        &[0, 2],
        &[1, 8],
        &[1, 4, 5, 8],
    )
}

/// Two robots of which one follows the other, 9 poses each.
fn lane() -> Setting {
    let line = |x_m: f64| vec![Pose::new(x_m, 0.0, 0.0), Pose::new(x_m + 14.4, 0.0, 0.0)];
    setting(
        of_lines(&[line(3.6), line(0.0)], 1.8),
        &[0, 2],
        &[3, 8],
        &[7, 8],
    )
}

/// Three robots each of which crosses the way of the next.
fn cycle() -> Setting {
    let world = of_scenario(Scenario::ThreeCycle, [2.0, 0.5], 5.0);
    setting(world, &[0, 2, 4], &[9], &[5, 9])
}

fn setting(world: Arc<World>, paths: &[u32], ends: &[usize], stops: &[usize]) -> Setting {
    Setting {
        world,
        paths: paths.iter().map(|path| PathId(*path)).collect(),
        missions: 1,
        ends: ends.to_vec(),
        stops: stops.to_vec(),
        robot_restarts: vec![1; paths.len()],
        coordinator_restarts: 1,
        fault: None,
    }
}

fn of_scenario(scenario: Scenario, size_m: [f64; 2], path_spacing_m: f64) -> Arc<World> {
    let parameters = WorldParameters {
        scenario,
        length_m: Some(size_m[0]),
        width_m: Some(size_m[1]),
        path_spacing_m,
        ..WorldParameters::default()
    };
    parameters.build().expect("a small world").world
}

fn of_lines(lines: &[Vec<Pose>], spacing_m: f64) -> Arc<World> {
    let vehicle = Vehicle {
        footprint: Footprint {
            length_m: 1.0,
            width_m: 0.5,
        },
        speed_max_mps: 2.0,
        acceleration_mps2: 1.0,
    };
    let (mut bays, mut routes, mut paths) = (Vec::new(), Vec::new(), PathLibrary::default());
    for line in lines {
        let path = paths.add(Path::new(line, spacing_m).expect("a straight path"));
        let (from, to) = (bays.len(), bays.len() + 1);
        bays.extend([line[0], line[line.len() - 1]].map(|pose| Bay { pose }));
        routes.push(Route { from, to, path });
        let (from, to, path) = (to, from, path.reversed());
        routes.push(Route { from, to, path });
    }
    Arc::new(World::new(
        vehicle,
        bays,
        routes,
        paths,
        MergePolicy::WithinVehicle,
    ))
}

#[test]
fn the_worlds_searched_are_what_they_are_said_to_be() {
    for setting in [crossing(), lane(), cycle()] {
        let world = &setting.world;
        for (position, &path) in setting.paths.iter().enumerate() {
            assert!(setting.last(path) >= 7, "{}", setting.last(path));
            assert_eq!(setting.stops.last(), Some(&setting.last(path)));
            for &other in &setting.paths[position + 1..] {
                let sections = world.guarded_sections.between(path, other);
                assert_eq!(sections.len(), 1);
                for (path, side) in [(path, Side::First), (other, Side::Second)] {
                    // There, and on the way back.
                    let ends = [
                        sections[0].end(side),
                        setting.last(path) - sections[0].start(side),
                    ];
                    assert!(
                        ends.iter().all(|end| setting.stops.contains(end)),
                        "{ends:?}"
                    );
                }
            }
        }
        let bodies = setting.init_states().remove(0).robots;
        assert!(setting.are_apart(&bodies[0], &bodies[1]));
    }
}

impl Setting {
    /// With these restarts of each robot, and of the coordinator.
    fn restarts(self, robots: &[u8], coordinator: u8) -> Self {
        Self {
            robot_restarts: robots.to_vec(),
            coordinator_restarts: coordinator,
            ..self
        }
    }

    fn looked_at(self, stops: &[usize]) -> Self {
        Self {
            stops: stops.to_vec(),
            ..self
        }
    }

    fn there_and_back(self) -> Self {
        Self {
            missions: 2,
            ..self
        }
    }
}

/// Compares with what `docs/case-studies.md` says. The number of states proves nothing: it tells that what is searched
/// has changed.
fn assert_states(setting: Setting, expected: usize) {
    assert_eq!(search(setting), expected);
}

#[test]
fn no_state_of_a_shared_lane_is_a_collision() {
    assert_states(lane().looked_at(&[3, 8]), 418_457);
}

#[test]
fn no_state_of_a_crossing_with_a_restart_of_the_coordinator_is_a_collision() {
    assert_states(crossing().restarts(&[0, 0], 1), 23_184);
}

#[test]
fn no_state_of_a_crossing_with_a_restart_of_a_robot_is_a_collision() {
    assert_states(crossing().restarts(&[0, 1], 0), 65_547);
}

#[test]
fn no_state_of_a_crossing_there_and_back_is_a_collision() {
    assert_states(crossing().there_and_back().restarts(&[0, 0], 0), 31_579);
}

#[test]
fn no_state_of_a_shared_lane_there_and_back_is_a_collision() {
    assert_states(lane().there_and_back().restarts(&[0, 0], 0), 23_515);
}

#[test]
fn no_state_of_a_cycle_with_a_restart_of_the_coordinator_is_a_collision() {
    assert_states(cycle().restarts(&[0, 0, 0], 1), 70_522);
}

#[test]
#[ignore = "minutes"]
fn no_state_of_a_shared_lane_looked_at_at_the_ends_of_sections_is_a_collision() {
    assert_states(lane(), 1_893_211);
}

#[test]
#[ignore = "minutes"]
fn no_state_of_a_crossing_is_a_collision() {
    assert_states(crossing(), 1_536_632);
}

#[test]
#[ignore = "minutes"]
fn no_state_of_a_cycle_with_a_restart_of_a_robot_too_is_a_collision() {
    assert_states(cycle().restarts(&[1, 0, 0], 1), 454_523);
}

#[test]
#[ignore = "minutes"]
fn no_state_of_a_cycle_with_a_restart_of_everyone_is_a_collision() {
    // Depth first, as it keeps few states beside the hashes of those visited.
    let ends = stateright::HasDiscoveries::AnyFailures;
    let setting = cycle().looked_at(&[9]);
    let states = count(setting.checker().finish_when(ends).spawn_dfs());
    assert_eq!(states, 12_082_781);
}

#[test]
fn a_lost_acknowledgement_taken_as_given_is_found() {
    finds(Fault::LostAcknowledgement, crossing().restarts(&[0, 0], 0));
}

#[test]
fn a_stale_state_accepted_is_found() {
    finds(Fault::StaleState, crossing().restarts(&[0, 0], 0));
}

#[test]
fn a_state_of_the_mission_before_is_found() {
    let setting = crossing().there_and_back().restarts(&[0, 0], 0);
    finds(Fault::OldMission, setting);
}

#[test]
fn a_void_command_obeyed_is_found() {
    finds(Fault::VoidCommand, crossing().restarts(&[0, 0], 1));
}

#[test]
fn a_command_of_before_a_restart_of_a_robot_obeyed_is_found() {
    finds(Fault::CommandOfBefore, crossing().restarts(&[0, 1], 0));
}

#[test]
fn an_authority_of_the_mission_before_obeyed_is_found() {
    let setting = crossing().there_and_back().restarts(&[0, 0], 0);
    finds(Fault::OldAuthority, setting);
}

#[test]
fn a_shrink_obeyed_too_late_is_found() {
    finds(Fault::LateShrink, crossing().restarts(&[0, 0], 0));
}

#[test]
fn a_section_forgotten_at_its_last_pose_is_found() {
    let setting = lane().there_and_back().restarts(&[0, 0], 0);
    finds(Fault::ForgottenSection, setting);
}
