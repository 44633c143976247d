//! The score of a recorded run: the referee looks at the robots' truth, and what the controller
//! and the robots said to each other tells the rest. It makes no tables; those are the
//! experiment's.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case::{FLEET_AUTHORITY, FLEET_STATE, FLEET_TRUTH, Fleet, FleetParameters};
use crate::events::events;
use crate::messages::{Authority, State, Truth};
use crate::referee::{Clearances, Referee, SCAN_PERIOD, STOP_SCANS, Tally};
use crate::standing::{Patience, Standstill, standstills};
use hil_core::case_study::{ErrorSeries, Harm, Metric, Score};
use hil_core::interval::Spread;
use hil_core::run_log::RunLog;
use hil_core::time::Instant;
use hil_stats::dependence::Batches;
use hil_stats::histogram::{LatencyHistogram, LatencySummary};
use hil_stats::metric::{Label, label};

/// Control periods in which a command is heard or sent again: the legacy coordinator repeats one after three.
const ANSWER_PERIODS: u32 = 5;

/// Scores a run.
pub(crate) fn score(case: &Fleet, log: &RunLog) -> Score {
    let truths = truths(log);
    let Some((start, end)) = span(&truths) else {
        return Score {
            metrics: vec![COLLISIONS.unavailable("the robots left no record of their motion")],
            harms: harms(None),
            ..Score::default()
        };
    };
    let run_end = run_end(log, end);
    let FleetParameters {
        coordinator,
        missions,
        ..
    } = case.parameters();
    let patience = Patience {
        after: coordinator.stuck_after(),
        parking: missions.parking(),
        answer: ANSWER_PERIODS * coordinator.control_period() + coordinator.known_delay(),
    };
    let standing = standstills(log, &truths, run_end, patience, missions.never_end());
    let mut referee = Referee::new(case.scene(), case.parameters().fleets);
    referee.replay(&mut truths.into_iter(), start, end, &mut |_, _| {});
    let run_s = run_end.seconds_since(start);
    let tally = referee.tally();
    let collided = collided_share(tally, referee.collided_after());
    let mut score = Score {
        harms: harms(Some((tally, collided, &standing))),
        headline: &["separation_m_min", "missions_per_hour"],
        ..Score::default()
    };
    score.metrics.extend(collisions(tally, collided));
    score.metrics.extend(distances(case, tally));
    score
        .metrics
        .extend(clearances(&tally.clearances, referee.spacing_m()));
    score.metrics.extend(commands(tally));
    score.metrics.extend(ages(log));
    score
        .metrics
        .extend(work(tally, run_s, case.parameters().robot.longest_tick()));
    let standing_s: f64 = standing.iter().map(Standstill::duration_s).sum();
    let method = format!(
        "no robot of a fleet moved for more than {} s, or at all; all fleets together",
        patience.after.as_secs_f64()
    );
    score.metrics.push(STANDING.known(standing_s, method));
    let mut found = events(log, referee.incidents());
    found.extend(standing.iter().map(Standstill::event));
    found.sort_by_key(|event| event.at);
    for event in found {
        score.add_event(event);
    }
    score
}

/// What an authority that comes late or not at all leads to.
fn harms(seen: Option<(&Tally, Option<Spread>, &[Standstill])>) -> Vec<Harm> {
    let count = |of: fn(&Tally) -> u64| seen.map(|(tally, _, _)| of(tally));
    let collisions = Harm::new(
        "collisions, counted per crossing section",
        count(|tally| tally.section_collisions_count),
    );
    vec![
        match seen {
            Some((tally, interval, _)) => Harm {
                interval,
                ..collisions.of(tally.sections_passed_count, "critical sections passed")
            },
            None => collisions,
        },
        Harm::new(
            "collisions of outlines",
            count(|tally| tally.overlaps_count),
        ),
        Harm::new(
            "overruns of a late authority",
            count(|tally| tally.authorities_late_count),
        ),
        standstill_harm(seen.map(|(_, _, standing)| standing)),
    ]
}

/// Standstills of fleets; what robots that hear all do to one another is their own.
fn standstill_harm(standing: Option<&[Standstill]>) -> Harm {
    let own = standing.unwrap_or_default().iter();
    let own = own.filter(|one| one.is_their_own());
    Harm {
        own_count: own.count() as u64,
        ..Harm::new(
            "standstills of whole fleets",
            standing.map(|all| all.len() as u64),
        )
    }
}

pub(crate) const COLLISIONS: Label = label(
    "section_collisions_count",
    "collisions, counted per crossing section",
    "1",
);

pub(crate) const OVERLAPS: Label = label("overlaps_count", "collisions of outlines", "1");

pub(crate) const OUTSIDE: Label = label("outside_count", "collisions outside any section", "1");

pub(crate) const CRITICAL_SECTIONS: Label =
    label("critical_sections_count", "critical sections passed", "1");

pub(crate) const COLLISION_RATIO: Label =
    label("collision_ratio", "collisions per critical section", "1");

pub(crate) const NEAR_MISSES: Label = label("near_misses_count", "near misses", "1");

pub(crate) const MISSIONS: Label = label("missions_count", "missions done", "1");

pub(crate) const MISSIONS_BEGUN: Label = label("missions_begun_count", "missions begun", "1");

pub(crate) const MISSION_DELAY: Label = label("mission_delay_s_mean", "time lost per mission", "s");

pub(crate) const RUN_LENGTH: Label = label("run_s", "length of the run", "s");

pub(crate) const RESETS: Label = label("resets_count", "resets", "1");

pub(crate) const STOPS: Label = label("stops_count", "stops on missions", "1");

const STANDING: Label = label("standing_s", "time a whole fleet stood", "s");

/// The interval of collisions per critical section on the effective sample of the sections in the order in which they were
/// passed: an outage makes several collide. `None` where collisions are not places in that series: more than there are
/// sections, or more than the referee keeps.
fn collided_share(tally: &Tally, collided_after: &[u64]) -> Option<Spread> {
    let (passed, count) = (tally.sections_passed_count, collided_after.len() as u64);
    if count != tally.section_collisions_count || count > passed {
        return None;
    }
    // Several may collide before the next is passed, and some at the end.
    let mut places = Vec::with_capacity(collided_after.len());
    for (index, after) in (0..).zip(collided_after) {
        let next = places.last().map_or(0, |(place, _)| place + 1);
        places.push(((*after).max(next).min(passed - (count - index)), 1));
    }
    Some(Batches::of_runs(passed, places).share_interval())
}

fn collisions(tally: &Tally, interval: Option<Spread>) -> Vec<Metric> {
    let passed = tally.sections_passed_count;
    let collided = tally.section_collisions_count;
    let mut ratio = if passed == 0 {
        COLLISION_RATIO.unavailable("no robot has passed a critical section")
    } else {
        let method = "collisions counted per crossing section over sections passed";
        COLLISION_RATIO.known(collided as f64 / passed as f64, method)
    };
    ratio.interval = interval.filter(|_| ratio.value.is_some());
    vec![
        COLLISIONS.count(
            collided,
            "both robots in a section and overlapping at the last path poses they passed, looked \
             at every 30 ms",
        ),
        OVERLAPS.count(
            tally.overlaps_count,
            "footprints overlapping where the robots truly were, looked at every 30 ms",
        ),
        OUTSIDE.count(
            tally.outside_count,
            "collisions of outlines that began where no critical section is",
        ),
        CRITICAL_SECTIONS.count(
            passed,
            "of two missions under way at once, driven through to the end",
        ),
        label("encounters_count", "encounters", "1").count(
            tally.encounters_count,
            "critical sections that both robots were in at the same time",
        ),
        ratio,
    ]
}

fn distances(case: &Fleet, tally: &Tally) -> Vec<Metric> {
    let least = label("separation_m_min", "smallest distance of two robots", "m")
        .held_against("0 is a collision");
    let bound_m = case
        .parameters()
        .robot
        .stop_error_bound_m(&case.scene().world.vehicle);
    vec![
        tally.separation_min_m.map_or_else(
            || least.unavailable("no two robots came near each other"),
            |value| least.known(value, "between footprints; 0 when they overlap"),
        ),
        label("stop_error_m_max", "farthest past an authority", "m").known(
            tally.stop_error_max_m,
            format!("of authorities that came in time; the tracker's bound is {bound_m:.3} m"),
        ),
        label(
            "late_overshoot_m_max",
            "farthest past a late authority",
            "m",
        )
        .known(
            tally.late_overshoot_max_m,
            "of authorities that came when the robot could not stop there any more",
        ),
    ]
}

/// How near robots came to each other.
fn clearances(seen: &Clearances, spacing_m: f64) -> Vec<Metric> {
    let count = seen.count();
    let bin_m = Clearances::BIN_SPACINGS * spacing_m;
    let quantile = |label: Label, quantile| {
        let clearance_m = seen.quantile(quantile).map(|spacings| spacings * spacing_m);
        let method = format!(
            "least distance between footprints in each of {count} approaches, 0 in contact; middle of a bin of {bin_m:.3} m"
        );
        label.measured(
            clearance_m,
            method,
            "no two robots under way came near each other and parted again",
        )
    };
    vec![
        label("approaches_count", "approaches", "1").count(
            count,
            format!(
                "two robots of a fleet, both under way, within two pose spacings ({:.2} m) of each other until they \
                 part, looked at every 30 ms; those not over at the end do not count",
                2.0 * spacing_m
            ),
        ),
        NEAR_MISSES.count(
            seen.near_miss_count(),
            format!(
                "approaches to less than a pose spacing ({spacing_m:.2} m) without contact"
            ),
        ),
        quantile(label("clearance_m_p50", "clearance of approaches, median", "m"), 0.5),
        quantile(label("clearance_m_p5", "clearance of approaches, 5 %", "m"), 0.05),
    ]
}

fn commands(tally: &Tally) -> Vec<Metric> {
    vec![
        label("authorities_applied_count", "authorities applied", "1")
            .count(tally.authorities_applied_count, "taken in time to stop at"),
        label("authorities_late_count", "authorities too late", "1").count(
            tally.authorities_late_count,
            "the robot could not stop there any more and went past",
        ),
        label("authorities_ignored_count", "authorities ignored", "1").count(
            tally.authorities_ignored_count,
            "behind the robot when they came",
        ),
        label("authorities_refused_count", "authorities refused", "1").count(
            tally.authorities_refused_count,
            "the robot could not stop there and kept the old one",
        ),
        label("stale_count", "commands passed over", "1").count(
            tally.stale_count,
            "older than what the robot had, or a repeat of it",
        ),
    ]
}

/// Robots that stand still on a mission, over time. Some always wait for others at a section; what a
/// network holds up or loses makes more of them wait, and longer.
pub(crate) fn errors(case: &Fleet, log: &RunLog) -> Vec<ErrorSeries> {
    let truths = truths(log);
    let Some((start, end)) = span(&truths) else {
        return Vec::new();
    };
    let mut samples = Vec::new();
    let mut referee = Referee::new(case.scene(), case.parameters().fleets);
    referee.replay(&mut truths.into_iter(), start, end, &mut |now, referee| {
        samples.push((now, referee.standing_count() as f64));
    });
    vec![ErrorSeries {
        name: "standing_count",
        label: "robots standing still on a mission",
        unit: "1",
        clock_of: FLEET_TRUTH,
        samples,
    }]
}

/// What the robots recorded, in order of time.
fn truths(log: &RunLog) -> Vec<Truth> {
    let mut truths: Vec<Truth> = log.messages(FLEET_TRUTH).map(|(_, truth)| truth).collect();
    // A robot notes what happened between two of its events afterwards, with its true time.
    truths.sort_by_key(|truth| truth.at_ns);
    truths
}

/// From the first record to a look after the last: robots in motion go on until then.
fn span(truths: &[Truth]) -> Option<(Instant, Instant)> {
    let (first, last) = truths.first().zip(truths.last())?;
    let end = Instant::from_ns(last.at_ns) + SCAN_PERIOD;
    Some((Instant::from_ns(first.at_ns), end))
}

/// The end of the run: robots that stand leave no record of motion but go on to report.
fn run_end(log: &RunLog, end: Instant) -> Instant {
    let states = log.messages::<State>(FLEET_STATE);
    let sampled = states.map(|(_, state)| Instant::from_ns(state.sampled_ns));
    sampled.fold(end, Instant::max)
}

/// How old the newest state was on which each authority rests.
fn ages(log: &RunLog) -> Vec<Metric> {
    let labels = [
        label("state_age_s_p50", "age of state at decision, median", "s"),
        label("state_age_s_p99", "age of state at decision, 99 %", "s"),
        label("state_age_s_max", "age of state at decision, largest", "s"),
    ];
    let none = |why: &str| labels.map(|label| label.unavailable(why)).into();
    if !log.has_one_clock() {
        return none("states and authorities were stamped by two clocks that are not aligned");
    }
    let states: BTreeMap<(u32, u32, u32), Instant> = log
        .messages::<State>(FLEET_STATE)
        .map(|(_, state)| {
            let from = &state.header;
            let key = (from.fleet_id, from.robot_id, from.header_id);
            (key, Instant::from_ns(state.sampled_ns))
        })
        .collect();
    let mut histogram = LatencyHistogram::default();
    for (sent, authority) in log.messages::<Authority>(FLEET_AUTHORITY) {
        let to = &authority.header;
        let key = (to.fleet_id, to.robot_id, authority.echo_header_id);
        if let Some(sampled) = states.get(&key) {
            histogram.record(sent.ns_since(*sampled));
        }
    }
    let Some(ages) = histogram.summary() else {
        return none("no authority names the state it rests on");
    };
    let LatencySummary {
        p50_ns,
        p99_ns,
        max_ns,
        count,
        ..
    } = ages;
    let figures = labels.into_iter().zip([p50_ns, p99_ns, max_ns]);
    let figures = figures.map(|(label, ns)| {
        let seconds = ns as f64 * 1e-9;
        let clock = log.clock_words(Some(seconds));
        let method =
            format!("sampled by the robot to authority sent, of {count} authorities{clock}");
        label.known(seconds, method)
    });
    figures.collect()
}

/// Robots that stood still on their missions.
fn stops(tally: &Tally, longest_tick: Duration) -> Metric {
    let stop = STOP_SCANS * SCAN_PERIOD;
    if 2 * longest_tick > stop {
        return STOPS.unavailable(format!(
            "between its ticks of up to {:.2} s a robot under way stands as long as in a stop",
            longest_tick.as_secs_f64()
        ));
    }
    STOPS.count(
        tally.stops_count,
        format!(
            "robots on a mission that stood still for {:.1} s or longer, also before they set out",
            stop.as_secs_f64()
        ),
    )
}

fn work(tally: &Tally, run_s: f64, longest_tick: Duration) -> Vec<Metric> {
    let per_hour = 3600.0 * tally.missions_done_count as f64 / run_s;
    vec![
        MISSIONS.count(
            tally.missions_done_count,
            "driven to their goal, all fleets together",
        ),
        label("missions_per_hour", "missions per hour", "1").known(
            per_hour,
            format!("all fleets together, over the whole run of {run_s:.1} s; missions under way do not count"),
        ),
        MISSION_DELAY.measured(
            tally.mean_mission_delay_s(),
            "from a mission's arrival at its robot to its goal, beyond a drive from rest to rest without a stop by the \
             vehicle's limits, which the stepped tracker exceeds by up to a tick; of missions done",
            "no mission whose beginning was recorded was done",
        ),
        MISSIONS_BEGUN.count(tally.missions_started_count, "taken by a robot"),
        stops(tally, longest_tick),
        RUN_LENGTH.known(run_s, "from the first record of a robot to the last"),
        label("travelled_km", "way driven", "km")
            .known(tally.travelled_m * 1e-3, "by all robots of all fleets"),
        RESETS.count(
            tally.replaced_count,
            "robots put at their goal to clear a stuck fleet",
        ),
        label("unsound_records_count", "unsound records", "1").count(
            tally.unsound_count,
            "records of motion that name nothing known or no finite motion",
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coordinator::parameters::CoordinatorMode;
    use crate::scenario::Scenario;
    use hil_core::case_study::CaseStudy;
    use hil_core::link_model::{Fate, LinkModel};
    use hil_core::simulation::{Carrier, Simulation};

    fn crossing() -> Fleet {
        let mut parameters = FleetParameters::default();
        parameters.world.scenario = Scenario::Crossing;
        parameters.fleets = 2;
        Fleet::new(parameters, 3).unwrap()
    }

    #[test]
    fn two_fleets_at_a_crossing_are_scored_from_what_they_left_in_the_log() {
        let case = crossing();
        let result = Simulation::new(&case, BTreeMap::new()).unwrap();
        let result = result.run(Duration::from_mins(2)).unwrap();
        let score = case.score(&result.log);
        let value = |name: &str| score.get(name).and_then(|metric| metric.value);
        assert_eq!(value("section_collisions_count"), Some(0.0));
        assert_eq!(value("overlaps_count"), Some(0.0));
        assert!(
            value("critical_sections_count").unwrap() >= 2.0,
            "{score:?}"
        );
        assert!(value("missions_count").unwrap() >= 4.0, "{score:?}");
        assert!(value("state_age_s_max").unwrap() < 1.0, "{score:?}");
        assert!(value("separation_m_min").unwrap() > 0.0, "{score:?}");
        assert_eq!(
            score.events,
            [],
            "a perfect channel does nothing to a robot"
        );
    }

    /// Loses everything offered from 30 s to 60 s.
    #[derive(Debug)]
    struct Silence;

    impl LinkModel for Silence {
        fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
            if (30.0..60.0).contains(&now.seconds_since(Instant::ZERO)) {
                Fate::Lost
            } else {
                Fate::Delivered(now)
            }
        }
    }

    #[test]
    fn more_robots_stand_still_while_no_command_gets_through() {
        let case = crossing();
        let standing_s = |carriers: BTreeMap<String, Box<dyn Carrier>>| -> f64 {
            let result = Simulation::new(&case, carriers).unwrap();
            let result = result.run(Duration::from_mins(2)).unwrap();
            let errors = case.errors(&result.log);
            assert_eq!(errors.len(), 1);
            let samples = &errors[0].samples;
            assert!(samples.is_sorted_by_key(|sample| sample.0));
            assert!(samples.iter().all(|sample| sample.1 >= 0.0));
            let within = samples
                .iter()
                .filter(|(at, _)| (40.0..60.0).contains(&at.seconds_since(Instant::ZERO)));
            within
                .map(|(_, count)| count * SCAN_PERIOD.as_secs_f64())
                .sum()
        };
        let silence: Box<dyn Carrier> = Box::new(Silence);
        let silent_s = standing_s(BTreeMap::from([(FLEET_AUTHORITY.to_owned(), silence)]));
        let whole_s = standing_s(BTreeMap::new());
        assert!(silent_s > whole_s + 10.0, "{silent_s} s, {whole_s} s");
        assert!(case.errors(&RunLog::default()).is_empty());
    }

    /// Lets nothing through from 30 s on.
    #[derive(Debug)]
    struct End;

    impl LinkModel for End {
        fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
            if now.seconds_since(Instant::ZERO) < 30.0 {
                Fate::Delivered(now)
            } else {
                Fate::Lost
            }
        }
    }

    #[test]
    fn a_fleet_that_stands_has_the_rate_of_the_whole_run_and_an_event_with_its_cause() {
        let mut parameters = FleetParameters::default();
        parameters.world.scenario = Scenario::Crossing;
        parameters.missions.parking_s = 1.0;
        let case = Fleet::new(parameters, 3).unwrap();
        let links: BTreeMap<String, Box<dyn Carrier>> = [FLEET_AUTHORITY, crate::FLEET_MISSION]
            .into_iter()
            .map(|channel| (channel.to_owned(), Box::new(End) as Box<dyn Carrier>))
            .collect();
        let result = Simulation::new(&case, links).unwrap();
        let result = result.run(Duration::from_hours(1)).unwrap();
        let score = case.score(&result.log);
        let value = |name: &str| score.get(name).and_then(|metric| metric.value).unwrap();
        // One hour: as many an hour as there were.
        let missions = value("missions_count");
        assert!(
            (value("missions_per_hour") - missions).abs() < 0.01 * missions.max(1.0),
            "{score:?}"
        );
        assert!(value("standing_s") > 3300.0, "{score:?}");
        let told = score
            .events
            .iter()
            .filter(|event| event.what.contains("stood for"));
        let told: Vec<_> = told.map(|event| event.what.as_str()).collect();
        assert!(
            told.len() == 1 && told[0].contains("reached a robot"),
            "{told:?}"
        );
        let harm = score.harms.last().unwrap();
        assert_eq!(
            (harm.what, harm.count, harm.own_count),
            ("standstills of whole fleets", Some(1), 0)
        );
    }

    /// Lets nothing through.
    #[derive(Debug)]
    struct Nothing;

    impl LinkModel for Nothing {
        fn offer(&mut self, _now: Instant, _length_bytes: usize) -> Fate {
            Fate::Lost
        }
    }

    #[test]
    fn a_short_run_without_a_command_that_arrives_is_a_standstill_and_one_that_just_begins_is_not()
    {
        for mode in [CoordinatorMode::Legacy, CoordinatorMode::Safe] {
            let mut parameters = FleetParameters::default();
            parameters.coordinator.mode = mode;
            let case = Fleet::new(parameters, 3).unwrap();
            let standstills = |is_lost: bool, run: Duration| {
                let lost: BTreeMap<String, Box<dyn Carrier>> =
                    [FLEET_AUTHORITY, crate::FLEET_MISSION]
                        .into_iter()
                        .filter(|_| is_lost)
                        .map(|channel| (channel.to_owned(), Box::new(Nothing) as Box<dyn Carrier>))
                        .collect();
                let result = Simulation::new(&case, lost).unwrap().run(run).unwrap();
                let score = case.score(&result.log);
                let events = score.events.iter().map(|event| event.what.clone());
                (
                    score.harms.last().unwrap().count.unwrap(),
                    events.collect::<Vec<_>>(),
                )
            };
            let (count, events) = standstills(true, Duration::from_mins(1));
            assert_eq!(count, 1, "{mode:?}");
            assert!(
                events[0].contains("stood for 60 s") && events[0].ends_with("reached a robot"),
                "{events:?}"
            );
            for run_s in [1, 3, 5, 8, 13, 30] {
                let (count, events) = standstills(false, Duration::from_secs(run_s));
                assert_eq!((count, events), (0, Vec::new()), "{mode:?} {run_s} s");
            }
        }
    }

    #[test]
    fn collisions_that_come_together_widen_their_interval() {
        let tally = |count| Tally {
            sections_passed_count: 2000,
            section_collisions_count: count,
            ..Tally::default()
        };
        let interval = |places: &[u64]| {
            let tally = tally(places.len() as u64);
            collided_share(&tally, places).unwrap()
        };
        let apart: Vec<u64> = (0..40).map(|at| 13 + 47 * at + at % 7).collect();
        let wide = |spread: Spread| spread.known().map(|one| one.high - one.low);
        let apart = wide(interval(&apart)).unwrap();
        // Four at a time, as within an outage; several before one section is passed, and at the end.
        let together: Vec<u64> = (0..40).map(|at| 200 * (at / 4 + 1)).collect();
        let together = wide(interval(&together));
        assert!(
            together.is_none_or(|wide| wide > 1.5 * apart),
            "{apart}, {together:?}"
        );
        // None, or all in one go, tell nothing of how they come.
        assert_eq!(interval(&[]).known(), None);
        assert_eq!(interval(&[700; 40]).known(), None);
        // More than sections, or more than were kept, are no series.
        assert_eq!(collided_share(&tally(3), &[1, 2]), None);
        let few = Tally {
            sections_passed_count: 1,
            ..tally(2)
        };
        assert_eq!(collided_share(&few, &[0, 0]), None);
    }

    #[test]
    fn without_an_approach_there_is_no_clearance() {
        let metrics = clearances(&Clearances::default(), 0.3);
        let known = metrics.iter().map(|metric| (metric.name, metric.value));
        let expected = [
            ("approaches_count", Some(0.0)),
            ("near_misses_count", Some(0.0)),
            ("clearance_m_p50", None),
            ("clearance_m_p5", None),
        ];
        assert!(known.eq(expected), "{metrics:?}");
        assert!(metrics[2].method.contains("no two robots"), "{metrics:?}");
    }

    #[test]
    fn a_run_without_record_has_no_figure() {
        let score = crossing().score(&RunLog::default());
        assert_eq!(score.metrics[0].value, None);
        assert!(score.metrics[0].method.contains("no record"));
    }
}
