//! What a network costs a fleet besides collisions: near misses, stops, and time. One set of figures for virtual time and
//! recorded runs.

use core::ops::Add;

use crate::case::FleetParameters;
use crate::experiment::cells::FleetTally;
use crate::score::{
    CRITICAL_SECTIONS, MISSION_DELAY, MISSIONS, MISSIONS_PER_HOUR, NEAR_MISSES, STOPS,
};
use hil_core::recorded_run::RecordedRun;
use hil_core::study::Field;

/// Sums over runs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Costs {
    section_count: u64,
    near_miss_count: u64,
    mission_count: u64,
    stop_count: u64,
    /// Of the missions done, seconds.
    mission_delay_s: f64,
    /// Run time of one fleet, hours.
    fleet_hours: f64,
}

impl Costs {
    /// Of runs in virtual time.
    pub(crate) fn of_tally(tally: &FleetTally) -> Self {
        let seen = &tally.referee;
        Self {
            section_count: seen.sections_passed_count,
            near_miss_count: seen.clearances.near_miss_count(),
            mission_count: seen.missions_done_count,
            stop_count: seen.stops_count,
            mission_delay_s: seen.mission_delay_s,
            fleet_hours: tally.run_s / 3600.0,
        }
    }

    /// Of a recorded run; `None` where its score has not all of them.
    pub(crate) fn of_run(run: &RecordedRun<FleetParameters>) -> Option<Self> {
        let value = |name: &str| run.score.get(name).and_then(|metric| metric.value);
        let count = |name: &str| run.count(name).ok();
        let mission_count = count(MISSIONS.name)?;
        // All fleets together.
        let per_hour = value(MISSIONS_PER_HOUR.name).filter(|rate| *rate > 0.0)?;
        Some(Self {
            section_count: count(CRITICAL_SECTIONS.name)?,
            near_miss_count: count(NEAR_MISSES.name)?,
            mission_count,
            stop_count: count(STOPS.name)?,
            mission_delay_s: value(MISSION_DELAY.name)?,
            fleet_hours: mission_count as f64 / per_hour * f64::from(run.parameters.fleets),
        })
    }

    fn per_mission(&self, sum: f64) -> Option<f64> {
        (self.mission_count > 0).then(|| sum / self.mission_count as f64)
    }
}

impl Add for Costs {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            section_count: self.section_count + other.section_count,
            near_miss_count: self.near_miss_count + other.near_miss_count,
            mission_count: self.mission_count + other.mission_count,
            stop_count: self.stop_count + other.stop_count,
            mission_delay_s: self.mission_delay_s + other.mission_delay_s,
            fleet_hours: self.fleet_hours + other.fleet_hours,
        }
    }
}

/// Their columns.
pub(crate) const COSTS: [Field<Costs>; 5] = [
    Field::count("missions", "Missions", |costs: &Costs| costs.mission_count),
    Field::number("missions_per_hour", "Missions/h", 0, |costs: &Costs| {
        (costs.fleet_hours > 0.0).then(|| costs.mission_count as f64 / costs.fleet_hours)
    }),
    Field::number(
        "mission_delay_s",
        "Lost per mission s",
        2,
        |costs: &Costs| costs.per_mission(costs.mission_delay_s),
    ),
    Field::number(
        "stops_per_mission",
        "Stops per mission",
        2,
        |costs: &Costs| costs.per_mission(costs.stop_count as f64),
    ),
    Field::number(
        "near_misses_per_1000",
        "Near misses x 1000",
        1,
        |costs: &Costs| {
            (costs.section_count > 0)
                .then(|| 1e3 * costs.near_miss_count as f64 / costs.section_count as f64)
        },
    ),
];
