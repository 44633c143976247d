//! The tables: Tables II and III beside our figures, what the robots did in each row, and the table
//! of mechanisms. It computes intervals and ratios, nothing else.

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::parameters::CoordinatorMode;
use crate::experiment::cells::{
    Cell as Experiment, Condition, Demand, FleetTally, Mechanism, Place, PublishedRow, SCENARIOS,
    collision_interval, mode_name, published_rows, scenario_name,
};
use crate::experiment::study::{FleetStudy, worlds_text};
use crate::scenario::Scenario;
use hil_core::study::{Cell, Column, Criterion, StudyReport, Table};
use hil_link::impaired::DelayLaw;
use hil_stats::comparison::{Share, difference};
use hil_stats::statistics::{CONFIDENCE, Interval};

/// The cells of a study with what came of them, as far as they were run.
#[derive(Debug)]
pub(crate) struct Results<'a> {
    cells: Vec<(&'a Experiment, Option<FleetTally>)>,
}

impl<'a> Results<'a> {
    /// Results in the order of their cells.
    pub(crate) fn of(cells: Vec<(&'a Experiment, Option<FleetTally>)>) -> Self {
        Self { cells }
    }

    /// All cells, and what came of those that were run.
    pub(crate) fn all(&self) -> impl Iterator<Item = (&'a Experiment, Option<&FleetTally>)> {
        self.cells
            .iter()
            .map(|(cell, tally)| (*cell, tally.as_ref()))
    }

    /// What came of the cell of a mechanism.
    pub(crate) fn mechanism(
        &self,
        scenario: Scenario,
        mechanism: Mechanism,
        mode: CoordinatorMode,
    ) -> Option<&FleetTally> {
        let is_it = |cell: &Experiment| {
            cell.scenario == scenario && cell.place == Place::Mechanism { mechanism, mode }
        };
        let (_, tally) = self.cells.iter().find(|(cell, _)| is_it(cell))?;
        tally.as_ref()
    }
}

/// The whole report.
pub(crate) fn report(study: &FleetStudy, results: &Results<'_>) -> StudyReport {
    let has = |is_wanted: fn(&Place) -> bool| {
        let mut cells = study.cells.iter();
        cells.any(|cell| is_wanted(&cell.place))
    };
    let mut tables = Vec::new();
    if has(|place| !matches!(place, Place::Mechanism { .. })) {
        for scenario in SCENARIOS {
            tables.push(published_table(scenario, results));
        }
        tables.push(motion_table(results));
    }
    if has(|place| matches!(place, Place::Mechanism { .. })) {
        for scenario in SCENARIOS {
            tables.push(mechanism_table(scenario, results));
        }
        tables.push(command_table(results));
    }
    StudyReport {
        title: "Case study 1: collisions per critical section (CS), in virtual time".to_owned(),
        notes: notes(study),
        tables,
        criteria: criteria(study, results),
        summary: summary(results),
    }
}

fn notes(study: &FleetStudy) -> Vec<String> {
    let parameters = study.parameters();
    let law = match parameters.delay_law {
        DelayLaw::Constant => "constant",
        DelayLaw::Uniform => "uniform from 0",
    };
    vec![
        format!(
            "seed {}, {} CS per cell in runs of {}; equal seeds give equal tables",
            study.seed,
            parameters.sections,
            parameters.sections_per_task.min(parameters.sections)
        ),
        format!("delay of the static rows: {law}"),
        worlds_text(study),
        "intervals: Clopper and Pearson, 95 %; without a collision the upper end is the exact \
         bound behind the rule of three"
            .to_owned(),
        "collisions: by the original's checker / true overlaps / of these outside every section; \
         the probability is of the first"
            .to_owned(),
    ]
}

const fn column(name: &'static str, label: &'static str) -> Column {
    Column { name, label }
}

const PUBLISHED_COLUMNS: [Column; 14] = [
    column("method", "Method"),
    column("loss_ratio", "PLR"),
    column("delay_ms", "Delay ms"),
    column("copies", "Copies"),
    column("sections", "CS"),
    column("collisions", "Collisions"),
    column("per_1000", "P x 1000"),
    column("per_1000", "95 %"),
    column("published_sections", "Paper: CS"),
    column("published_collisions", "Coll."),
    column("published_per_1000", "P x 1000"),
    column("published_per_1000", "95 %"),
    column("against_paper", "Against paper"),
    column("verdict", "Accepted if"),
];

/// Table II or III.
fn published_table(scenario: Scenario, results: &Results<'_>) -> Table {
    let (name, title) = match scenario {
        Scenario::Harbor => ("table-2-harbor", "Table II, harbor"),
        _ => ("table-3-warehouse", "Table III, warehouse"),
    };
    let mut rows = Vec::new();
    for published in published_rows(scenario) {
        let ours = results.all().filter(|(cell, _)| {
            let is_row =
                |place: &Place| matches!(place, Place::Published { row, .. } if row == published);
            cell.scenario == scenario && is_row(&cell.place)
        });
        let before = rows.len();
        rows.extend(ours.map(|(cell, tally)| published_row(published, Some((cell, tally)))));
        if rows.len() == before {
            rows.push(published_row(published, None));
        }
    }
    let variants = results.all().filter(|(cell, _)| {
        cell.scenario == scenario && matches!(cell.place, Place::Variant { .. })
    });
    rows.extend(variants.map(|(cell, tally)| variant_row(cell, tally)));
    Table {
        name: name.to_owned(),
        title: title.to_owned(),
        columns: PUBLISHED_COLUMNS.to_vec(),
        rows,
        notes: vec![
            "rows measured with hardware in the loop depend on hosts and radio; ours beside them \
             are over the Wi-Fi 6 model's presets, which are fitted to case study 2 alone"
                .to_owned(),
            "an overlap outside every section is a graze between two path poses, which a list of \
             sections at the poses cannot hold; the safe coordinator's guarded sections do"
                .to_owned(),
        ],
    }
}

fn published_row(
    published: &PublishedRow,
    ours: Option<(&Experiment, Option<&FleetTally>)>,
) -> Vec<Cell> {
    let mut row = match published.condition {
        Condition::Static {
            loss_ratio,
            delay_ms,
        } => vec![
            Cell::text("static"),
            Cell::number(Some(loss_ratio), 1),
            Cell::number(Some(delay_ms), 0),
        ],
        Condition::HardwareInTheLoop(network) => vec![
            Cell::text(format!("HiL, {network}")),
            Cell::Absent,
            Cell::Absent,
        ],
    };
    row.push(match ours.map(|(cell, _)| &cell.place) {
        Some(Place::Published { copies, .. }) => Cell::Count(u64::from(*copies)),
        _ => Cell::Absent,
    });
    row.extend(metrics(ours.and_then(|(_, tally)| tally)));
    let (sections, collisions) = (published.sections, published.collisions);
    row.extend([
        Cell::Count(sections),
        Cell::Count(collisions),
        Cell::number(Some(1e3 * collisions as f64 / sections as f64), 2),
        per_1000(collision_interval(collisions, sections)),
    ]);
    let against = ours.and_then(|(_, tally)| AgainstPaper::of(published, tally));
    row.push(against.map_or(Cell::Absent, |one| Cell::text(one.words())));
    row.push(ours.map_or(Cell::Absent, |(cell, tally)| judged(cell, tally)));
    row
}

fn variant_row(cell: &Experiment, tally: Option<&FleetTally>) -> Vec<Cell> {
    let Place::Variant { text } = cell.place else {
        return Vec::new();
    };
    let mut row = vec![
        Cell::text(text),
        Cell::number(Some(0.0), 1),
        Cell::number(Some(100.0), 0),
        Cell::Count(1),
    ];
    row.extend(metrics(tally));
    row.extend([const { Cell::Absent }; 5]);
    row.push(judged(cell, tally));
    row
}

/// How our probability of a row stands to the paper's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AgainstPaper {
    /// No difference at 5 %, in a sample of half the paper's or more.
    Agrees,
    /// The interval of their difference (Newcombe's) does not hold zero.
    Differs,
    /// No difference at 5 %, in a smaller sample.
    Inconclusive,
    /// The paper's row is of a real network, ours of the model of another one.
    NotComparable,
}

impl AgainstPaper {
    const ALL: [Self; 4] = [
        Self::Agrees,
        Self::Differs,
        Self::Inconclusive,
        Self::NotComparable,
    ];

    /// `None` while the row was not run.
    fn of(published: &PublishedRow, tally: Option<&FleetTally>) -> Option<Self> {
        let tally = tally?;
        if matches!(published.condition, Condition::HardwareInTheLoop(_)) {
            return Some(Self::NotComparable);
        }
        let share = |count: u64, of: u64| {
            let count = count.min(of);
            Share { count, of }.estimate(CONFIDENCE)
        };
        let paper = share(published.collisions, published.sections)?;
        let count = tally.section_count();
        let ours = share(tally.referee.section_collisions_count, count)?;
        let Interval { low, high } = difference(paper, ours)?;
        Some(if low > 0.0 || high < 0.0 {
            Self::Differs
        } else if 2 * count >= published.sections {
            Self::Agrees
        } else {
            Self::Inconclusive
        })
    }

    const fn words(self) -> &'static str {
        match self {
            Self::Agrees => "agrees",
            Self::Differs => "differs",
            Self::Inconclusive => "inconclusive",
            Self::NotComparable => "not comparable",
        }
    }
}

/// How many rows agree with the paper, which differ, and what would decide the others.
fn summary(results: &Results<'_>) -> Vec<String> {
    let compared: Vec<(String, AgainstPaper, u64)> = results
        .all()
        .filter_map(|(cell, tally)| {
            let Place::Published { row, .. } = &cell.place else {
                return None;
            };
            Some((cell.name(), AgainstPaper::of(row, tally)?, row.sections))
        })
        .collect();
    if compared.is_empty() {
        return Vec::new();
    }
    let of = |wanted: AgainstPaper| compared.iter().filter(move |one| one.1 == wanted);
    let counts = AgainstPaper::ALL.map(|one| format!("{} {}", one.words(), of(one).count()));
    let mut lines = vec![format!(
        "Against the paper, of {} cells: {}; one in twenty differs by chance.",
        compared.len(),
        counts.join(", ")
    )];
    let differing: Vec<&str> = of(AgainstPaper::Differs)
        .map(|one| one.0.as_str())
        .collect();
    if !differing.is_empty() {
        lines.push(format!("These differ: {}.", differing.join("; ")));
    }
    let needed = of(AgainstPaper::Inconclusive).map(|one| one.2.div_ceil(2));
    if let Some(sections) = needed.max() {
        lines.push(format!(
            "The inconclusive ones have fewer than half of the paper's critical sections; --sections {sections} \
             is enough."
        ));
    }
    lines
}

/// Sections, collisions, probability and its interval.
fn metrics(tally: Option<&FleetTally>) -> [Cell; 4] {
    let Some(tally) = tally else {
        return [Cell::Absent, Cell::Absent, Cell::Absent, Cell::Absent];
    };
    [
        Cell::Count(tally.section_count()),
        collisions_cell(tally),
        Cell::number(tally.collision_ratio().map(|ratio| 1e3 * ratio), 2),
        per_1000(tally.collision_interval()),
    ]
}

fn collisions_cell(tally: &FleetTally) -> Cell {
    let seen = &tally.referee;
    Cell::text(format!(
        "{} / {} / {}",
        seen.section_collisions_count, seen.overlaps_count, seen.outside_count
    ))
}

fn per_1000(ends: Option<(f64, f64)>) -> Cell {
    Cell::interval(ends.map(|(low, high)| (1e3 * low, 1e3 * high)), 2)
}

/// What a cell is held against, and whether it holds.
fn judged(cell: &Experiment, tally: Option<&FleetTally>) -> Cell {
    let text = demand_text(cell.demand);
    if cell.demand == Demand::None {
        return Cell::text(text);
    }
    let verdict = match tally.and_then(|tally| verdict_of(cell.demand, tally)) {
        Some(true) => "met",
        Some(false) => "MISSED",
        None => "too few",
    };
    Cell::text(format!("{text}: {verdict}"))
}

const MOTION_COLUMNS: [Column; 13] = [
    column("cell", "Row"),
    column("separation_min_m", "Closest m"),
    column("stop_error_max_m", "Past point m"),
    column("stop_error_bound_m", "Bound m"),
    column("late_overshoot_max_m", "Late, past m"),
    column("late", "Late"),
    column("ignored", "Ignored"),
    column("order_reversals", "Reversals"),
    column("deadlocks_broken", "Deadlocks"),
    column("resets", "Resets"),
    column("missions_per_hour", "Missions/h"),
    column("robot_km", "Robot-km"),
    column("collisions_per_1000_km", "Coll./1000 km"),
];

/// What the robots did in each row of Tables II and III.
fn motion_table(results: &Results<'_>) -> Table {
    let rows = results
        .all()
        .filter(|(cell, _)| !matches!(cell.place, Place::Mechanism { .. }))
        .map(|(cell, tally)| {
            let mut row = vec![Cell::text(cell.name())];
            row.extend(motion_cells(tally));
            row
        });
    Table {
        name: "motion".to_owned(),
        title: "Tables II and III: what the robots did".to_owned(),
        columns: MOTION_COLUMNS.to_vec(),
        rows: rows.collect(),
        notes: vec![
            "past point: farthest stop beyond an order that came in time; bound: 3 v (TT + D) + v \
             TT / 2 for the stepped tracker, 0 for the exact one; late: orders too late to stop at"
                .to_owned(),
        ],
    }
}

fn motion_cells(tally: Option<&FleetTally>) -> Vec<Cell> {
    let Some(tally) = tally else {
        return vec![Cell::Absent; MOTION_COLUMNS.len() - 1];
    };
    let (seen, decided) = (&tally.referee, &tally.coordinator);
    let robot_km = 1e-3 * seen.travelled_m;
    let per_1000_km = (robot_km > 0.0).then(|| 1e3 * tally.collision_count() as f64 / robot_km);
    vec![
        Cell::number(seen.separation_min_m, 2),
        Cell::number(Some(seen.stop_error_max_m), 2),
        Cell::number(Some(tally.stop_error_bound_m), 2),
        Cell::number(Some(seen.late_overshoot_max_m), 2),
        Cell::Count(seen.authorities_late_count),
        Cell::Count(seen.authorities_ignored_count),
        Cell::Count(decided.order_reversals),
        Cell::Count(decided.deadlocks_broken),
        Cell::Count(decided.resets),
        Cell::number(tally.missions_per_hour(), 0),
        Cell::number(Some(robot_km), 0),
        Cell::number(per_1000_km, 2),
    ]
}

const MECHANISM_COLUMNS: [Column; 12] = [
    column("mechanism", "What the network does"),
    column("legacy_sections", "Legacy: CS"),
    column("legacy_collisions", "Collisions"),
    column("legacy_per_1000", "P x 1000"),
    column("legacy_per_1000", "95 %"),
    column("legacy_resets", "Resets"),
    column("legacy_missions_per_hour", "Missions/h"),
    column("safe_sections", "Safe: CS"),
    column("safe_collisions", "Collisions"),
    column("safe_per_1000_high", "P x 1000 below"),
    column("safe_stuck", "Stuck"),
    column("safe_missions_per_hour", "Missions/h"),
];

/// What each impairment does to each coordinator.
fn mechanism_table(scenario: Scenario, results: &Results<'_>) -> Table {
    let absent = || vec![Cell::Absent; 6];
    let rows = Mechanism::ALL.into_iter().map(|mechanism| {
        let of = |mode| results.mechanism(scenario, mechanism, mode);
        let mut cells = vec![Cell::text(mechanism.label())];
        cells.extend(of(CoordinatorMode::Legacy).map_or_else(absent, |tally| {
            let mut cells = metrics(Some(tally)).to_vec();
            cells.push(Cell::Count(tally.coordinator.resets));
            cells.push(Cell::number(tally.missions_per_hour(), 0));
            cells
        }));
        let safe = of(CoordinatorMode::Safe).map_or_else(absent, |tally| {
            let high = tally.collision_interval().map(|(_, high)| 1e3 * high);
            let [sections, collisions, ..] = metrics(Some(tally));
            vec![
                sections,
                collisions,
                Cell::number(high, 3),
                Cell::Count(tally.safe.stuck),
                Cell::number(tally.missions_per_hour(), 0),
            ]
        });
        cells.extend(safe.into_iter().take(5));
        cells
    });
    Table {
        name: format!("mechanisms-{}", scenario_name(scenario)),
        title: format!(
            "What causes collisions, {}: status over the network, exact tracker, delay unknown to \
             the coordinator",
            scenario_name(scenario)
        ),
        columns: MECHANISM_COLUMNS.to_vec(),
        rows: rows.collect(),
        notes: Vec::new(),
    }
}

const COMMAND_COLUMNS: [Column; 13] = [
    column("cell", "Cell"),
    column("commands", "Commands"),
    column("commands_lost", "Lost"),
    column("states", "States"),
    column("states_lost", "Lost"),
    column("repeats", "Repeats"),
    column("late", "Late"),
    column("ignored", "Ignored"),
    column("refused", "Refused"),
    column("stale", "Stale"),
    column("order_reversals", "Reversals"),
    column("stop_error_max_m", "Past point m"),
    column("separation_min_m", "Closest m"),
];

/// What became of the commands in each cell of the table of mechanisms.
fn command_table(results: &Results<'_>) -> Table {
    let rows = results
        .all()
        .filter(|(cell, _)| matches!(cell.place, Place::Mechanism { .. }))
        .map(|(cell, tally)| {
            let mut row = vec![Cell::text(cell.name())];
            row.extend(tally.map_or_else(
                || vec![Cell::Absent; COMMAND_COLUMNS.len() - 1],
                |tally| command_cells(tally).to_vec(),
            ));
            row
        });
    Table {
        name: "commands".to_owned(),
        title: "What causes collisions: what became of the messages".to_owned(),
        columns: COMMAND_COLUMNS.to_vec(),
        rows: rows.collect(),
        notes: vec![
            "late: too late to stop at; ignored: behind the robot, which drove on; refused: not \
             applied because it could not stop (safe); stale: older than one applied"
                .to_owned(),
        ],
    }
}

fn command_cells(tally: &FleetTally) -> [Cell; 12] {
    let (seen, decided) = (&tally.referee, &tally.coordinator);
    [
        Cell::Count(tally.commands.offered_count),
        Cell::Count(tally.commands.lost_count),
        Cell::Count(tally.status.offered_count),
        Cell::Count(tally.status.lost_count),
        Cell::Count(decided.authority_repeats),
        Cell::Count(seen.authorities_late_count),
        Cell::Count(seen.authorities_ignored_count),
        Cell::Count(seen.authorities_refused_count),
        Cell::Count(seen.stale_count),
        Cell::Count(decided.order_reversals),
        Cell::number(Some(seen.stop_error_max_m), 2),
        Cell::number(seen.separation_min_m, 2),
    ]
}

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
        .cells
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

fn of_cell(cell: &Experiment, tally: Option<&FleetTally>) -> Criterion {
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
    let is_safe = |cell: &Experiment| matches!(cell.place, Place::Mechanism { mode, .. } if mode == CoordinatorMode::Safe);
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
mod judgement_tests {
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
