//! Near misses, stops and time lost: what a network does to a fleet besides collisions. One set of figures for virtual time
//! and recorded runs.

use core::ops::Add;

use crate::case::FleetParameters;
use crate::experiment::cells::{FleetTally, missions_per_hour};
use crate::score::{
    CRITICAL_SECTIONS, MISSION_DELAY, MISSIONS, MISSIONS_BEGUN, NEAR_MISSES, RESETS, RUN_LENGTH,
    STOPS,
};
use hil_core::recorded_run::RecordedRun;
use hil_core::study::Field;

/// Sums over runs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Costs {
    section_count: u64,
    near_miss_count: u64,
    begun_count: u64,
    done_count: u64,
    reset_count: u64,
    /// Stops on all missions begun.
    stop_count: u64,
    /// Of the missions whose time lost is known, seconds.
    lost_s: f64,
    timed_count: u64,
    /// Run time of one fleet, seconds.
    fleet_s: f64,
}

impl Costs {
    /// Of runs in virtual time.
    pub(crate) fn of_tally(tally: &FleetTally) -> Self {
        let seen = &tally.referee;
        Self {
            section_count: seen.sections_passed_count,
            near_miss_count: seen.clearances.near_miss_count(),
            begun_count: seen.missions_started_count,
            done_count: seen.missions_done_count,
            reset_count: seen.replaced_count,
            stop_count: seen.stops_count,
            lost_s: seen.mission_delay_s,
            timed_count: seen.missions_timed_count,
            fleet_s: tally.run_s,
        }
    }

    /// Of a recorded run; `None` where its score has not all counts and its length.
    pub(crate) fn of_run(run: &RecordedRun<FleetParameters>) -> Option<Self> {
        let value = |name: &str| run.score.get(name).and_then(|metric| metric.value);
        let count = |name: &str| run.count(name).ok();
        let done_count = count(MISSIONS.name)?;
        // Without a mission done there is no mean.
        let mean_s = value(MISSION_DELAY.name);
        let timed_count = if mean_s.is_some() { done_count } else { 0 };
        Some(Self {
            section_count: count(CRITICAL_SECTIONS.name)?,
            near_miss_count: count(NEAR_MISSES.name)?,
            begun_count: count(MISSIONS_BEGUN.name)?,
            done_count,
            reset_count: count(RESETS.name)?,
            stop_count: count(STOPS.name)?,
            lost_s: mean_s.map_or(0.0, |mean_s| mean_s * done_count as f64),
            timed_count,
            fleet_s: value(RUN_LENGTH.name)? * f64::from(run.parameters.fleets),
        })
    }
}

/// `None` of none.
fn per(sum: f64, count: u64) -> Option<f64> {
    (count > 0).then(|| sum / count as f64)
}

impl Add for Costs {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            section_count: self.section_count + other.section_count,
            near_miss_count: self.near_miss_count + other.near_miss_count,
            begun_count: self.begun_count + other.begun_count,
            done_count: self.done_count + other.done_count,
            reset_count: self.reset_count + other.reset_count,
            stop_count: self.stop_count + other.stop_count,
            lost_s: self.lost_s + other.lost_s,
            timed_count: self.timed_count + other.timed_count,
            fleet_s: self.fleet_s + other.fleet_s,
        }
    }
}

/// Their columns.
pub(crate) const COSTS: [Field<Costs>; 7] = [
    Field::count("missions_begun", "Begun", |one: &Costs| one.begun_count),
    Field::count("missions_done", "Done", |one: &Costs| one.done_count),
    Field::count("resets", "Resets", |one: &Costs| one.reset_count),
    Field::number("fleet_missions_per_hour", "Missions/h", 0, |one: &Costs| {
        missions_per_hour(one.done_count, one.fleet_s)
    }),
    Field::number(
        "mission_delay_s_mean",
        "Lost per mission s",
        2,
        |one: &Costs| per(one.lost_s, one.timed_count),
    ),
    Field::number(
        "stops_per_mission",
        "Stops per mission",
        2,
        |one: &Costs| per(one.stop_count as f64, one.begun_count),
    ),
    Field::number(
        "near_misses_per_1000",
        "Near misses x 1000",
        1,
        |one: &Costs| per(1e3 * one.near_miss_count as f64, one.section_count),
    ),
];
