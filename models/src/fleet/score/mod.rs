//! What the robots made of a run: collisions, orders that came too late, throughput. The referee
//! judges the recorded truth; nothing the robots or the controller believe counts.

mod orders;
#[cfg(test)]
mod tests;

use crate::fleet::experiment::collision_interval;
use crate::fleet::messages::{Authority, State, Truth};
use crate::fleet::referee::{Incident, IncidentKind, Referee, Tally};
use crate::fleet::score::orders::{Key, Orders};
use crate::fleet::{FLEET_AUTHORITY, FLEET_STATE, FLEET_TRUTH, Fleet};
use crate::measure::histogram::LatencyHistogram;
use crate::run_log::RunLog;
use crate::score::{Metric, Score, ScoreEvent, Severity};
use crate::time::Instant;

/// Scores a run.
pub(crate) fn score(case: &Fleet, log: &RunLog) -> Score {
    let parameters = case.parameters();
    let mut truth: Vec<Truth> = log
        .messages::<Truth>(FLEET_TRUTH)
        .map(|(_, truth)| truth)
        .collect();
    truth.sort_by_key(|record| record.at_ns);
    let mut referee = Referee::new(case.scene(), parameters.fleets);
    let ends = truth.first().zip(truth.last());
    let run_s = ends.map_or(0.0, |(first, last)| {
        (last.at_ns - first.at_ns) as f64 * 1e-9
    });
    if let Some((first, last)) = ends {
        let [start, end] = [first, last].map(|record| Instant::from_ns(record.at_ns));
        referee.replay(&mut truth.iter().copied(), start, end);
    }
    let mut orders = Orders::sent(log);
    for record in &truth {
        orders.heard(record);
    }
    let mut metrics = Vec::new();
    metrics.extend(collisions(referee.tally(), truth.len()));
    metrics.extend(motion(case, referee.tally(), truth.len()));
    metrics.extend(commands(referee.tally(), truth.len()));
    metrics.push(orders.unheard_metric());
    metrics.extend(state_age(log));
    metrics.extend(throughput(referee.tally(), run_s, parameters.fleets));
    let mut events: Vec<_> = referee
        .incidents()
        .iter()
        .map(|incident| collision_event(incident, &orders))
        .collect();
    let period = parameters.coordinator.control_period();
    events.extend(orders.events(period, log.has_one_clock()));
    if log.has_one_clock() {
        events.sort_by_key(|event| event.at);
    }
    let mut score = Score {
        metrics,
        ..Score::default()
    };
    for event in events {
        score.add_event(event);
    }
    score
}

/// Why there is no figure of the robots.
const NO_TRUTH: &str = "no record of the robots' truth";

/// A count from the robots' truth.
fn count(
    (name, label): (&'static str, &'static str),
    count: u64,
    record_count: usize,
    method: &str,
) -> Metric {
    figure((name, label, "1"), Some(count as f64), record_count, method)
}

fn figure(
    (name, label, unit): (&'static str, &'static str, &'static str),
    value: Option<f64>,
    record_count: usize,
    method: &str,
) -> Metric {
    let has_truth = record_count > 0;
    Metric {
        name,
        label,
        value: value.filter(|_| has_truth),
        interval: None,
        unit,
        method: if has_truth { method } else { NO_TRUTH }.to_owned(),
    }
}

fn collisions(tally: &Tally, record_count: usize) -> Vec<Metric> {
    let sections = tally.sections_passed_count;
    let collided = tally.section_collisions_count;
    let ratio = (sections > 0).then(|| collided as f64 / sections as f64);
    let method = if ratio.is_none() {
        "no critical section was passed".to_owned()
    } else if collided == 0 {
        format!(
            "Clopper and Pearson, 95 %, {sections} critical sections; without a collision the \
             upper end is the exact bound behind the rule of three, 3 / {sections}"
        )
    } else {
        format!("Clopper and Pearson, 95 %, {collided} of {sections} critical sections")
    };
    let mut probability = figure(
        ("collision_ratio", "collisions per critical section", "1"),
        ratio,
        record_count,
        &method,
    );
    probability.interval = ratio.and_then(|_| collision_interval(collided, sections));
    vec![
        count(
            ("critical_sections_count", "critical sections passed"),
            sections,
            record_count,
            "sections of two missions under way at once that a robot drove through",
        ),
        count(
            ("encounters_count", "sections both robots were in"),
            tally.encounters_count,
            record_count,
            "critical sections that both robots were in at the same time",
        ),
        count(
            (
                "section_collisions_count",
                "collisions by the original's checker",
            ),
            collided,
            record_count,
            "both robots in a section and overlapping at the last path poses passed",
        ),
        count(
            ("overlaps_count", "overlaps of robots where they truly were"),
            tally.overlaps_count,
            record_count,
            "looked for every 30 ms; one until the two separate",
        ),
        count(
            ("outside_count", "overlaps outside every critical section"),
            tally.outside_count,
            record_count,
            "of the overlaps, those the list of sections misses",
        ),
        probability,
    ]
}

fn motion(case: &Fleet, tally: &Tally, record_count: usize) -> [Metric; 3] {
    let vehicle = &case.scene().world.vehicle;
    let bound_m = case.parameters().robot.stop_error_bound_m(vehicle);
    [
        figure(
            (
                "separation_min_m",
                "smallest distance between two robots",
                "m",
            ),
            tally.separation_min_m,
            record_count,
            if tally.separation_min_m.is_some() {
                "between footprints, looked at every 30 ms"
            } else {
                "no two robots came near each other"
            },
        ),
        figure(
            ("stop_error_m_max", "farthest past an order in time", "m"),
            Some(tally.stop_error_max_m),
            record_count,
            &format!("way beyond the end of authority; the tracker's bound is {bound_m:.2} m"),
        ),
        figure(
            (
                "late_overshoot_m_max",
                "farthest past an order too late",
                "m",
            ),
            Some(tally.late_overshoot_max_m),
            record_count,
            "way beyond an end of authority that came when the robot could not stop there",
        ),
    ]
}

fn commands(tally: &Tally, record_count: usize) -> [Metric; 5] {
    let of = |name, label, value, method| count((name, label), value, record_count, method);
    [
        of(
            "authorities_late_count",
            "orders too late to stop at",
            tally.authorities_late_count,
            "applied; the robot went past",
        ),
        of(
            "authorities_ignored_count",
            "orders behind the robot",
            tally.authorities_ignored_count,
            "ignored; the robot drove on",
        ),
        of(
            "authorities_refused_count",
            "orders refused",
            tally.authorities_refused_count,
            "the robot could not stop there, kept its authority and said so",
        ),
        of(
            "messages_stale_count",
            "orders passed over",
            tally.stale_count,
            "older than one applied, a repeat of it, or of a mission that is over",
        ),
        of(
            "leases_ended_count",
            "leases that ended",
            tally.leases_ended_count,
            "no newer authority came in time, and the robot braked",
        ),
    ]
}

/// How old the newest state behind each decision was.
fn state_age(log: &RunLog) -> [Metric; 3] {
    let mut sampled: Vec<_> = log
        .messages::<State>(FLEET_STATE)
        .map(|(_, state)| {
            let header = state.header;
            let key = (header.fleet_id, header.robot_id, header.header_id);
            (key, state.sampled_ns)
        })
        .collect();
    sampled.sort_unstable();
    let mut ages = LatencyHistogram::default();
    for (_, authority) in log.messages::<Authority>(FLEET_AUTHORITY) {
        let header = authority.header;
        let key = (header.fleet_id, header.robot_id, authority.echo_header_id);
        if let Ok(index) = sampled.binary_search_by_key(&key, |(key, _)| *key) {
            ages.record(header.sent_ns - sampled[index].1);
        }
    }
    let summary = ages.summary().filter(|_| log.has_one_clock());
    let method = match (&summary, log.has_one_clock()) {
        (Some(summary), _) => format!(
            "from the robot's sample to the order that rests on it, {} orders",
            summary.count
        ),
        (None, true) => "no order names a state it rests on".to_owned(),
        (None, false) => "orders and states were stamped by two clocks that are not aligned".into(),
    };
    let metric = |name, label, age_ns: Option<i64>| Metric {
        name,
        label,
        value: age_ns.map(|ns| ns as f64 * 1e-6),
        interval: None,
        unit: "ms",
        method: method.clone(),
    };
    let age =
        |pick: fn(&crate::measure::histogram::LatencySummary) -> i64| summary.as_ref().map(pick);
    [
        metric(
            "state_age_ms_p50",
            "age of state at decision, median",
            age(|s| s.p50_ns),
        ),
        metric(
            "state_age_ms_p99",
            "age of state at decision, p99",
            age(|s| s.p99_ns),
        ),
        metric(
            "state_age_ms_max",
            "age of state at decision, largest",
            age(|s| s.max_ns),
        ),
    ]
}

fn throughput(tally: &Tally, run_s: f64, fleets: u32) -> [Metric; 5] {
    let record_count = usize::from(run_s > 0.0);
    let per_hour = (run_s > 0.0).then(|| 3600.0 * tally.missions_done_count as f64 / run_s);
    let mut reversals = figure(
        (
            "order_reversals_count",
            "changes of order at a section",
            "1",
        ),
        None,
        1,
        "only the coordinator knows them, and no message tells; `hil-runtime tables` prints them",
    );
    reversals.value = None;
    [
        figure(
            ("missions_per_hour", "missions per hour", "1/h"),
            per_hour,
            record_count,
            &format!(
                "{} missions of {fleets} fleets in {run_s:.1} s",
                tally.missions_done_count
            ),
        ),
        figure(
            ("travelled_km", "way driven by all robots", "km"),
            Some(1e-3 * tally.travelled_m),
            record_count,
            "from the robots' truth, resets left out",
        ),
        count(
            ("missions_done_count", "missions driven to their goal"),
            tally.missions_done_count,
            record_count,
            "goals reached, resets left out",
        ),
        count(
            ("resets_count", "robots put at their goal"),
            tally.replaced_count,
            record_count,
            "to clear a fleet that made no way",
        ),
        reversals,
    ]
}

/// A collision, with the orders that led to it or should have prevented it.
fn collision_event(incident: &Incident, orders: &Orders) -> ScoreEvent {
    let what = match incident.kind {
        IncidentKind::Section => "collided (original's checker)",
        IncidentKind::Overlap => "overlapped",
        IncidentKind::Outside => "overlapped outside every section",
    };
    let [one, other] = incident.robots;
    let text = format!(
        "robots {one} and {other} of fleet {} {what} at ({:.1} m, {:.1} m)",
        incident.fleet_id, incident.position_m[0], incident.position_m[1]
    );
    let mut event = ScoreEvent::new(Severity::Incident, incident.at, FLEET_TRUTH, text);
    for side in 0..2 {
        let last = Key {
            fleet_id: incident.fleet_id,
            robot_id: incident.robots[side],
            mission_id: incident.mission_ids[side],
            sequence: incident.causes[side].caused_by_sequence,
        };
        // The last order that reached the robot, and those sent since that did not.
        for message in orders.messages_from(last, incident.at) {
            event = event.naming(message);
        }
    }
    event
}
