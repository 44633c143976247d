//! The roster against states and missions made by hand.

use super::*;
use crate::messages::{Mission, Phase};
use crate::mission::{MissionMode, MissionParameters};
use crate::scenario::{Scenario, WorldParameters};
use hil_core::random::RandomStream;

struct Bench {
    roster: Roster,
    missions: MissionSource,
    counts: CoordinatorCounts,
}

impl Bench {
    fn new(message_order: MessageOrder) -> Self {
        let world = WorldParameters {
            scenario: Scenario::Crossing,
            ..WorldParameters::default()
        };
        let scene = world.build().unwrap();
        let parameters = CoordinatorParameters {
            message_order,
            ..CoordinatorParameters::default()
        };
        let missions = MissionParameters {
            mode: MissionMode::Shuttle,
            ..MissionParameters::default()
        };
        Self {
            roster: Roster::new(&scene, &parameters, 4),
            missions: MissionSource::new(&missions, &scene, RandomStream::new(1, "missions")),
            counts: CoordinatorCounts::default(),
        }
    }

    fn cycle(&mut self, now_s: i64) -> Vec<Mission> {
        let mut given = Vec::new();
        let mut send = |message| {
            if let ToRobot::Mission(mission) = message {
                given.push(mission);
            }
        };
        let (now, counts) = (seconds(now_s), &mut self.counts);
        self.roster.settle(counts);
        self.roster.dispatch(now, &mut self.missions, &mut send);
        self.roster.reset_stuck(now, counts, &mut send);
        given
    }

    fn report(&mut self, now_s: i64, header_id: u32, mission_id: u32, index: i32) {
        let phase = if index == 134 {
            Phase::Done
        } else {
            Phase::Driving
        };
        let state = state(header_id, mission_id, index, phase);
        self.roster
            .on_state(seconds(now_s), &state, &mut self.counts);
    }
}

fn seconds(seconds: i64) -> Instant {
    Instant::from_ns(1_000_000_000 * seconds)
}

fn state(header_id: u32, mission_id: u32, path_index: i32, phase: Phase) -> State {
    State {
        header: Header {
            fleet_id: 4,
            robot_id: 0,
            header_id,
            mission_id,
            sent_ns: 0,
        },
        path_index,
        phase: phase as u8,
        ..State::default()
    }
}

fn names(sent: &[Mission]) -> Vec<(u32, u32, u32)> {
    sent.iter()
        .map(|mission| {
            (
                mission.header.robot_id,
                mission.header.mission_id,
                mission.flags,
            )
        })
        .collect()
}

#[test]
fn one_mission_begins_per_cycle_and_is_repeated_until_a_state_shows_it() {
    let mut bench = Bench::new(MessageOrder::Legacy);
    assert_eq!(names(&bench.cycle(0)), [(0, 1, 0)]);
    assert_eq!(bench.roster.sections.iter().count(), 0);
    assert_eq!(names(&bench.cycle(1)), [(0, 1, 0), (1, 1, 0)]);
    assert_eq!(bench.roster.sections.iter().count(), 1);
    bench.report(1, 1, 1, 0);
    let sent = bench.cycle(2);
    assert_eq!(names(&sent), [(1, 1, 0)]);
    assert_eq!((sent[0].header.header_id, sent[0].end_index), (2, 134));
}

#[test]
fn a_robot_that_arrives_frees_its_sections_parks_and_goes_again() {
    let mut bench = Bench::new(MessageOrder::Legacy);
    bench.cycle(0);
    bench.cycle(1);
    bench.report(40, 1, 1, 134);
    assert_eq!(names(&bench.cycle(41)), [(1, 1, 0)]);
    let view = &bench.roster.robots()[0];
    assert!(view.mission.is_none());
    assert_eq!((view.bay, view.parked_since), (2, Some(seconds(40))));
    assert_eq!(bench.counts.sections_obsolete, 1);
    assert_eq!(names(&bench.cycle(42)), [(1, 1, 0)]);
    assert_eq!(names(&bench.cycle(43)), [(0, 2, 0), (1, 1, 0)]);
    // A state of the mission that is over says nothing about the new one.
    bench.report(43, 2, 1, 134);
    assert_eq!(bench.counts.states_outdated, 1);
    assert!(bench.roster.robots()[0].mission.is_some());
}

#[test]
fn a_late_state_is_the_newest_in_order_of_arrival_and_dropped_in_strict_order() {
    for (order, expected) in [(MessageOrder::Legacy, 20), (MessageOrder::Strict, 30)] {
        let mut bench = Bench::new(order);
        bench.cycle(0);
        bench.report(1, 7, 1, 10);
        bench.report(2, 9, 1, 30);
        bench.report(3, 8, 1, 20);
        bench.report(4, 9, 1, expected);
        assert_eq!(
            i32::try_from(bench.roster.robots()[0].index()),
            Ok(expected)
        );
        let counts = bench.counts;
        assert_eq!((counts.states_reordered, counts.states_duplicate), (1, 1));
        let is_strict = order == MessageOrder::Strict;
        assert_eq!(counts.states_dropped, 2 * u64::from(is_strict));
    }
}

#[test]
fn what_makes_no_sense_is_counted_and_ignored() {
    let mut bench = Bench::new(MessageOrder::Legacy);
    bench.cycle(0);
    let sound = state(1, 1, 5, Phase::Driving);
    let mut check = |change: fn(&mut State), pick: fn(&CoordinatorCounts) -> u64| {
        let mut changed = sound;
        change(&mut changed);
        let before = pick(&bench.counts);
        bench
            .roster
            .on_state(seconds(1), &changed, &mut bench.counts);
        assert_eq!(pick(&bench.counts), before + 1, "{changed:?}");
    };
    check(|state| state.x_m = f64::NAN, |counts| counts.states_unsound);
    check(|state| state.phase = 9, |counts| counts.states_unsound);
    check(
        |state| state.path_index = 135,
        |counts| counts.states_unsound,
    );
    check(
        |state| state.path_index = -1,
        |counts| counts.states_unsound,
    );
    check(
        |state| state.header.robot_id = 2,
        |counts| counts.states_unknown,
    );
    check(
        |state| state.header.fleet_id = 0,
        |counts| counts.states_unknown,
    );
    check(
        |state| state.header.mission_id = 2,
        |counts| counts.states_unknown,
    );
    check(
        |state| state.header.mission_id = 0,
        |counts| counts.states_outdated,
    );
    assert_eq!(bench.counts.states_accepted, 0);
    assert!(bench.roster.robots()[0].state.is_none());
}

#[test]
fn a_robot_without_way_for_too_long_is_put_at_its_goal_and_only_one_at_a_time() {
    let mut bench = Bench::new(MessageOrder::Legacy);
    bench.cycle(0);
    bench.cycle(1);
    bench.report(2, 1, 1, 8);
    assert_eq!(names(&bench.cycle(120)), [(1, 1, 0)]);
    assert_eq!(bench.counts.resets, 0);
    assert_eq!(
        names(&bench.cycle(122)),
        [(1, 1, 0), (1, 1, Mission::REPLACE)]
    );
    assert_eq!(names(&bench.cycle(123)), [(1, 1, Mission::REPLACE)]);
    let later = names(&bench.cycle(132));
    assert!(later.contains(&(0, 1, Mission::REPLACE)));
    bench.report(133, 2, 1, 134);
    bench.cycle(134);
    let counts = bench.counts;
    assert_eq!((counts.resets, counts.missions_done), (2, 1));
    assert_eq!(
        (counts.sections_obsolete, counts.sections_abandoned),
        (0, 1)
    );
}

#[test]
fn a_bay_is_free_again_only_when_who_left_it_is_clear_of_it() {
    let mut bench = Bench::new(MessageOrder::Legacy);
    bench.cycle(0);
    assert_eq!(bench.roster.bay_users, [1, 1, 1, 0]);
    // 2 m of vehicle are clear after 7 steps of 0.3 m.
    bench.report(1, 1, 1, 6);
    bench.roster.settle(&mut bench.counts);
    assert_eq!(bench.roster.bay_users, [1, 1, 1, 0]);
    bench.report(2, 2, 1, 7);
    bench.roster.settle(&mut bench.counts);
    assert_eq!(bench.roster.bay_users, [0, 1, 1, 0]);
}
