//! Safe robots under mixes of everything that networks and hosts do to messages, for as many critical sections as
//! there is time for.

use core::time::Duration;
use std::env;

use hil_core::simulation::Observe;
use hil_core::time::Instant;
use hil_fleet::coordinator::parameters::CoordinatorMode;
use hil_fleet::experiment::{Experiment, FleetModel, FleetTally, Setup};
use hil_fleet::messages::{MessageOrder, Truth, TruthKind};
use hil_fleet::scenario::{Scenario, WorldParameters};
use hil_link::impaired::{DelayLaw, Impairments};

/// None of which may make safe robots collide or stand.
fn worst_mixes() -> [Setup; 3] {
    let mix = |overrun_max_s, impairments| {
        let mut setup = Setup {
            overrun_max_s,
            ..Setup::default()
        };
        setup.coordinator.mode = CoordinatorMode::Safe;
        setup.coordinator.message_order = MessageOrder::Strict;
        (setup.links.commands, setup.links.status) = (impairments, impairments);
        setup
    };
    let lossy = Impairments {
        loss_ratio: 0.3,
        duplicate_ratio: 0.1,
        duplicate_lag_ms: 3000.0,
        hold_ratio: 0.1,
        hold_ms: 3000.0,
        ..Impairments::default()
    };
    let stalled = Impairments {
        delay_ms: 1000.0,
        delay_law: DelayLaw::Uniform,
        stall_mean_s: 3.0,
        ..Impairments::default()
    };
    let all = Impairments {
        delay_ms: 1000.0,
        delay_law: DelayLaw::Uniform,
        stall_mean_s: 3.0,
        ..lossy
    };
    [mix(0.0, lossy), mix(4.0, stalled), mix(4.0, all)]
}

/// When a mission was last driven to its end.
struct LastMission(Instant);

impl Observe<FleetModel> for LastMission {
    fn recorded(&mut self, now: Instant, truth: &Truth) {
        if truth.kind == TruthKind::MissionDone as u32 {
            self.0 = now;
        }
    }
}

/// A fleet that ends no mission for so long stands, which `liveness.rs` rules out.
const STAND: Duration = Duration::from_mins(30);
const SECTIONS_PER_CHUNK: u64 = 5000;
const CHUNKS_VARIABLE: &str = "HIL_FLEET_CHUNKS";

fn counts(tally: &FleetTally) -> String {
    let seen = &tally.referee;
    format!(
        "{} sections, collisions {} by the section checker, {} overlaps, {} of them outside",
        tally.section_count(),
        seen.section_collisions_count,
        seen.overlaps_count,
        seen.outside_count
    )
}

/// Each chunk is a run of 5000 critical sections of one mix in one map, seeded with its number. Without
/// `HIL_FLEET_CHUNKS=first..end` twelve are run, two of each mix and map: 60 000 critical sections. A line sums up its
/// chunk, and those of its call; `docs/case-studies.md` says which were run.
#[test]
#[ignore = "twelve runs of 5000 critical sections"]
fn safe_robots_collide_in_none_of_the_worst_mixes() {
    let chunks = env::var(CHUNKS_VARIABLE).unwrap_or_else(|_| "0..12".to_owned());
    let (first, end) = chunks.split_once("..").expect("first..end");
    let scenes = [Scenario::Harbor, Scenario::Warehouse].map(|scenario| {
        let parameters = WorldParameters {
            scenario,
            ..WorldParameters::default()
        };
        parameters.build().unwrap()
    });
    let (mut sum, mut stuck) = (FleetTally::default(), 0);
    for chunk in first.parse::<usize>().unwrap()..end.parse().unwrap() {
        let setup = &worst_mixes()[chunk / 2 % 3];
        let mut experiment = Experiment::new(&scenes[chunk % 2], setup, chunk as u64).unwrap();
        let mut last_mission = LastMission(Instant::ZERO);
        let mut stands = false;
        while experiment.section_count() < SECTIONS_PER_CHUNK && !stands {
            let until = experiment.now() + Duration::from_mins(1);
            experiment.run_until(until, &mut last_mission);
            stands = until > last_mission.0 + STAND;
        }
        let tally = experiment.tally();
        sum.merge(&tally);
        stuck += tally.safe.stuck;
        println!(
            "chunk {chunk}: {}; sum {}; robots that stood {stuck}",
            counts(&tally),
            counts(&sum)
        );
        assert_eq!(tally.any_collision_count() + tally.referee.outside_count, 0);
        assert!(!stands, "no mission ended for {STAND:?}");
        let safe = tally.safe;
        assert_eq!(safe.authorities_exceeded + safe.margins_exceeded, 0);
    }
}
