//! What the figures are held against: per cell, and over the table of mechanisms. A verdict that
//! the number of critical sections does not allow is not given.

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::parameters::CoordinatorMode;
use crate::experiment::cells::{
    Cell, Demand, Mechanism, Place, SCENARIOS, mode_name, scenario_name,
};
use crate::experiment::report::Results;
use crate::experiment::study::FleetStudy;
use crate::experiment::tally::FleetTally;
use hil_core::study::Criterion;

/// Critical sections from which a demand is judged whatever its interval.
const DECISIVE_COUNT: u64 = 100_000;
/// Critical sections from which "none at all" is said to be met.
const TELLING_COUNT: u64 = 10_000;
/// Critical sections from which a rate of missions is compared.
const RATE_SECTIONS_MIN: u64 = 1000;
/// What the safe coordinator must keep of the legacy one's throughput on a clean channel.
const THROUGHPUT_RATIO_MIN: f64 = 0.9;

/// A demand in words, per 1000 critical sections.
pub(crate) fn demand_text(demand: Demand) -> String {
    match demand {
        Demand::None => "reported only".to_owned(),
        Demand::Below(high) => format!("95 % < {high}"),
        Demand::Within(low, high) => format!("> 0 and {low} to {high}"),
        Demand::NoneSeen => "none by the original's checker".to_owned(),
        Demand::NoneAtAll => "none by any checker".to_owned(),
    }
}

/// Whether a demand is met; `None` when there are too few critical sections to say. With few of
/// them, a demand is missed only if its whole interval is, and met only if its whole interval is.
pub(crate) fn verdict_of(demand: Demand, tally: &FleetTally) -> Option<bool> {
    let is_decisive = tally.section_count() >= DECISIVE_COUNT;
    // Without an interval there are no sections, or more collisions than sections.
    let Some((low, high)) = tally.collision_interval() else {
        return (tally.any_collision_count() > 0 && demand != Demand::None).then_some(false);
    };
    let (low, high) = (1e3 * low, 1e3 * high);
    let per_1000 = 1e3 * tally.collision_ratio()?;
    match demand {
        Demand::None => None,
        Demand::Below(bound) if high < bound => Some(true),
        Demand::Below(bound) => (is_decisive || low >= bound).then_some(false),
        Demand::Within(least, most) if is_decisive => {
            Some(low > 0.0 && (least..=most).contains(&per_1000))
        }
        Demand::Within(least, most) if high < least || low > most => Some(false),
        Demand::Within(least, most) => (low >= least && high <= most).then_some(true),
        Demand::NoneSeen if tally.collision_count() > 0 => Some(false),
        Demand::NoneAtAll if tally.any_collision_count() > 0 => Some(false),
        Demand::NoneSeen | Demand::NoneAtAll => {
            (tally.section_count() >= TELLING_COUNT).then_some(true)
        }
    }
}

/// Everything the study is held against.
pub(crate) fn criteria(study: &FleetStudy, results: &Results<'_>) -> Vec<Criterion> {
    let mut criteria: Vec<_> = results
        .all()
        .filter(|(cell, _)| {
            let is_published = !matches!(cell.place, Place::Mechanism { .. });
            is_published && cell.demand != Demand::None
        })
        .map(|(cell, tally)| of_cell(cell, tally))
        .collect();
    let has_mechanisms = study
        .cells()
        .iter()
        .any(|cell| matches!(cell.place, Place::Mechanism { .. }));
    if has_mechanisms {
        criteria.extend(safe_criteria(results));
        criteria.extend(SCENARIOS.map(|scenario| {
            let of = |mode| results.mechanism(scenario, Mechanism::Clean, mode);
            throughput(
                scenario_name(scenario),
                of(CoordinatorMode::Legacy),
                of(CoordinatorMode::Safe),
            )
        }));
        criteria.extend(SCENARIOS.map(|scenario| {
            let of = |mechanism| results.mechanism(scenario, mechanism, CoordinatorMode::Legacy);
            loss_exceeds_delay(
                scenario_name(scenario),
                of(Mechanism::CommandLoss10),
                of(Mechanism::Delay300Ms),
            )
        }));
    }
    criteria
}

fn of_cell(cell: &Cell, tally: Option<&FleetTally>) -> Criterion {
    let text = format!("{}: {}", cell.name(), demand_text(cell.demand));
    let Some(tally) = tally else {
        return Criterion {
            text,
            is_met: None,
            finding: "not run to its end".to_owned(),
        };
    };
    Criterion {
        text,
        is_met: verdict_of(cell.demand, tally),
        finding: collisions_text(tally),
    }
}

fn collisions_text(tally: &FleetTally) -> String {
    let seen = &tally.referee;
    let per_1000 = tally
        .collision_interval()
        .map_or_else(String::new, |(low, high)| {
            format!(", {:.2} to {:.2} per 1000", 1e3 * low, 1e3 * high)
        });
    format!(
        "{} collisions, {} overlaps in {} CS{per_1000}",
        seen.section_collisions_count,
        seen.overlaps_count,
        tally.section_count()
    )
}

/// The safe coordinator: no collision by any checker; no robot that stands for ever, and nothing
/// seen that its proof rules out.
fn safe_criteria(results: &Results<'_>) -> [Criterion; 3] {
    let is_safe = |cell: &Cell| matches!(cell.place, Place::Mechanism { mode, .. } if mode == CoordinatorMode::Safe);
    let (mut sections, mut collisions, mut stands) = (0, 0, 0);
    let (mut safe, mut seen_again) = (SafeCounts::default(), Vec::new());
    let (mut cell_count, mut ended_count) = (0, 0);
    for (cell, tally) in results.all().filter(|(cell, _)| is_safe(cell)) {
        cell_count += 1;
        let Some(tally) = tally else {
            continue;
        };
        ended_count += 1;
        safe.merge(&tally.safe);
        sections += tally.section_count();
        collisions += tally.any_collision_count();
        stands += tally.stand_count;
        seen_again.extend(tally.collided.iter().map(|run| {
            format!(
                "{}, run {}, seed {}, first at {}",
                cell.name(),
                run.replica,
                run.seed,
                run.first_at
            )
        }));
    }
    // One is enough to miss a demand; to meet it takes all cells, and something to see in them.
    let is_telling = ended_count == cell_count && sections >= TELLING_COUNT;
    let judged = |is_met: bool| (!is_met || is_telling).then_some(is_met);
    let mut finding =
        format!("{collisions} in {sections} CS of {ended_count} of {cell_count} cells");
    if !seen_again.is_empty() {
        finding.push_str("; ");
        finding.push_str(&seen_again.join("; "));
    }
    let mode = mode_name(CoordinatorMode::Safe);
    let impossible = safe.states_impossible + safe.authorities_exceeded + safe.margins_exceeded;
    [
        Criterion {
            text: format!("{mode}: no collision by any checker, in any row run"),
            is_met: judged(collisions == 0),
            finding,
        },
        Criterion {
            text: format!("{mode}: no robot stuck, no fleet at a stand"),
            is_met: judged(safe.stuck == 0 && stands == 0),
            finding: format!(
                "{} robots made no way for too long, {stands} runs came to a stand",
                safe.stuck
            ),
        },
        Criterion {
            text: format!("{mode}: nothing that its proof rules out"),
            is_met: judged(impossible == 0),
            finding: format!(
                "{} impossible states, {} beyond their authority, {} beyond the stop margin",
                safe.states_impossible, safe.authorities_exceeded, safe.margins_exceeded
            ),
        },
    ]
}

fn throughput(scenario: &str, legacy: Option<&FleetTally>, safe: Option<&FleetTally>) -> Criterion {
    let rate = |tally: Option<&FleetTally>| {
        let is_telling = |tally: &&FleetTally| tally.section_count() >= RATE_SECTIONS_MIN;
        tally.filter(is_telling)?.missions_per_hour()
    };
    let rates = rate(legacy).zip(rate(safe));
    let text = format!("{scenario}: safe keeps 90 % of legacy's missions per hour when clean");
    let Some((legacy, safe)) = rates else {
        return Criterion {
            text,
            is_met: None,
            finding: format!("not run to its end, or with fewer than {RATE_SECTIONS_MIN} CS"),
        };
    };
    let ratio = safe / legacy;
    Criterion {
        text,
        is_met: Some(ratio >= THROUGHPUT_RATIO_MIN),
        finding: format!("{safe:.0} of {legacy:.0} per hour, {:.1} %", 100.0 * ratio),
    }
}

/// Losing commands causes collisions where delaying them does not.
fn loss_exceeds_delay(
    scenario: &str,
    loss: Option<&FleetTally>,
    delay: Option<&FleetTally>,
) -> Criterion {
    let ends = loss
        .and_then(FleetTally::collision_interval)
        .zip(delay.and_then(FleetTally::collision_interval));
    let text = format!("{scenario}, legacy: losing 10 % of the commands is worse than 300 ms");
    let Some((loss, delay)) = ends else {
        return Criterion {
            text,
            is_met: None,
            finding: "not run to its end".to_owned(),
        };
    };
    let is_met = if loss.0 > delay.1 {
        Some(true)
    } else {
        (loss.1 < delay.0).then_some(false)
    };
    Criterion {
        text,
        is_met,
        finding: format!(
            "{:.2} to {:.2} against {:.2} to {:.2} per 1000",
            1e3 * loss.0,
            1e3 * loss.1,
            1e3 * delay.0,
            1e3 * delay.1
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tally(collisions: u64, sections: u64) -> FleetTally {
        let mut tally = FleetTally::default();
        tally.referee.section_collisions_count = collisions;
        tally.referee.sections_passed_count = sections;
        tally
    }

    #[test]
    fn few_sections_give_a_verdict_only_when_it_is_beyond_doubt() {
        let verdict =
            |demand, collisions, sections| verdict_of(demand, &tally(collisions, sections));
        // No collision in 10 000 leaves up to 0.37 per 1000.
        assert_eq!(verdict(Demand::Below(0.2), 0, 10_000), None);
        assert_eq!(verdict(Demand::Below(0.37), 0, 10_000), Some(true));
        assert_eq!(verdict(Demand::Below(0.2), 0, 100_000), Some(true));
        assert_eq!(verdict(Demand::Below(0.2), 50, 10_000), Some(false));
        assert_eq!(verdict(Demand::Below(0.2), 15, 100_000), Some(false));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 0, 10_000), None);
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 0, 100_000), Some(false));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 13, 10_000), Some(true));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 130, 100_000), Some(true));
        assert_eq!(verdict(Demand::None, 500, 100_000), None);
    }

    #[test]
    fn one_collision_by_any_checker_misses_none_at_all() {
        let verdict = |tally| verdict_of(Demand::NoneAtAll, &tally);
        assert_eq!(verdict(tally(0, 10_000)), Some(true));
        assert_eq!(verdict(tally(0, 100)), None);
        assert_eq!(verdict(tally(1, 100)), Some(false));
        let mut overlap = tally(0, 1_000_000);
        overlap.referee.overlaps_count = 1;
        assert_eq!(verdict_of(Demand::NoneSeen, &overlap), Some(true));
        assert_eq!(verdict(overlap), Some(false));
        let mut early = tally(0, 0);
        early.referee.overlaps_count = 1;
        assert_eq!(verdict(early), Some(false));
    }
}
