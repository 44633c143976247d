//! The tables: Tables II and III beside our figures, what the robots did in each row, and the table
//! of mechanisms. It computes intervals and ratios, nothing else.

use crate::coordinator::parameters::CoordinatorMode;
use crate::experiment::cells::{
    CellSpec, CollidedRun, Condition, Demand, FleetTally, Mechanism, Place, PublishedRow,
    RunFigures, SCENARIOS, per_1000_interval, published_rows,
};
use crate::experiment::costs::{COSTS, Costs};
use crate::experiment::recorded::FleetRow;
use crate::experiment::study::{FleetStudy, worlds_text};
use crate::referee::{SCAN_PERIOD, STOP_SCANS, Tally};
use crate::scenario::Scenario;
use hil_core::study::{self, Cell, Column, Criterion, Field, Larger, StudyReport, Table, Verdict};
use hil_link::impaired::DelayLaw;
use hil_stats::comparison::{Judge, Scatter, Share, against_published, welch};
use hil_stats::recorded::{PooledShare, REPLAYS_NOTE, ROWS_NOTE, replays_summary};
use hil_stats::statistics::CONFIDENCE;

/// A cell with what came of it; `None` when it was not run.
#[derive(Debug)]
pub(crate) struct CellResult<'a> {
    pub(crate) cell: &'a CellSpec,
    pub(crate) tally: Option<FleetTally>,
}

impl CellResult<'_> {
    fn place(&self) -> &Place {
        &self.cell.id.place
    }

    fn is_mechanism(&self) -> bool {
        matches!(self.place(), Place::Mechanism { .. })
    }
}

/// A row of recorded runs with what happened in them.
#[derive(Debug)]
struct RecordedResult<'a> {
    of: &'a FleetRow,
    collided: PooledShare,
    verdict: Verdict,
    replay: Option<Box<Self>>,
}

impl<'a> RecordedResult<'a> {
    /// Without a collision, collisions are taken to scatter by `of_none`; `judge` is that of the replays.
    fn new(of: &'a FleetRow, of_none: f64, judge: Judge) -> Self {
        let collided = of.pooled(of_none);
        let published = of.published().map(PublishedRow::share);
        let replay = of.replay.as_deref().map(|of| {
            let replayed = of.pooled(of_none);
            Box::new(Self {
                of,
                collided: replayed,
                verdict: of.row.verdict_of_replay(&replayed, &collided, judge),
                replay: None,
            })
        });
        Self {
            of,
            collided,
            verdict: of.row.verdict(&collided, published),
            replay,
        }
    }

    /// Its row and that of its replay.
    fn rows(&self) -> impl Iterator<Item = Vec<Cell>> {
        [Some(self), self.replay.as_deref()]
            .into_iter()
            .flatten()
            .map(Self::cells)
    }

    fn cells(&self) -> Vec<Cell> {
        let (row, happened) = (&self.of.row, &self.collided);
        let ends = happened.interval.map(|one| (1e3 * one.low, 1e3 * one.high));
        let mut cells = vec![
            Cell::text(row.method()),
            Cell::number(row.loss_ratio(), 4),
            Cell::number(row.delay_ms(0.5), 2),
            Cell::number(row.delay_ms(0.99), 2),
            Cell::Absent,
            Cell::Count(self.of.tally.sections_passed_count),
            Cell::text(collisions_of(&self.of.tally)),
            Cell::number(happened.ratio().map(|ratio| 1e3 * ratio), 2),
            Cell::interval(ends, 2),
        ];
        cells.extend(Field::cells(&PUBLISHED, self.of.published()));
        cells.extend([Cell::Verdict(self.verdict), Cell::Absent]);
        cells
    }
}

/// What came of the cell of a mechanism.
fn mechanism_tally<'a>(
    results: &'a [CellResult<'_>],
    scenario: Scenario,
    mechanism: Mechanism,
    mode: CoordinatorMode,
) -> Option<&'a FleetTally> {
    let place = Place::Mechanism { mechanism, mode };
    let mut results = results.iter();
    let found = results.find(|one| one.cell.id.scenario == scenario && *one.place() == place)?;
    found.tally.as_ref()
}

/// The whole report.
pub(crate) fn report(study: &FleetStudy, results: &[CellResult<'_>]) -> StudyReport {
    let mut tables = Vec::new();
    let of_none = scatter(results).divisor().unwrap_or(1.0);
    let recorded = study.recorded.iter();
    let replay_count = recorded.clone().filter(|one| one.replay.is_some()).count();
    let of_replays = Judge::of_tests(replay_count);
    let recorded: Vec<_> = recorded
        .map(|of| RecordedResult::new(of, of_none, of_replays))
        .collect();
    let has_published = !results.iter().all(CellResult::is_mechanism);
    if has_published || !recorded.is_empty() {
        tables.extend(SCENARIOS.map(|scenario| published_table(scenario, results, &recorded)));
    }
    if has_published {
        tables.push(motion_table(results));
    }
    if results.iter().any(CellResult::is_mechanism) {
        tables.extend(SCENARIOS.map(|scenario| mechanism_table(scenario, results)));
        tables.push(command_table(results));
    }
    if !(results.is_empty() && recorded.is_empty()) {
        tables.push(costs_table(results, &recorded));
    }
    let verdicts: Vec<_> = results.iter().filter_map(verdict_against).collect();
    let criteria = criteria(results);
    let named = verdicts.iter();
    let named = named.map(|(one, of)| (one.cell.id.to_string(), *of));
    let named: Vec<_> = named
        .chain(recorded.iter().map(|one| {
            let name = format!("{}, {}", one.of.scenario, one.of.row.method());
            (name, one.verdict)
        }))
        .collect();
    let replays = recorded.iter().filter_map(|one| one.replay.as_deref());
    let replays: Vec<_> = replays.map(|one| one.verdict).collect();
    let mut summary = study::summary(&named, &criteria);
    summary.extend(replays_summary(&replays));
    StudyReport {
        title: study::title(
            "Case study 1: collisions per critical section (CS)",
            !study.recorded.is_empty(),
        ),
        notes: notes(study, results),
        tables,
        summary,
        larger: larger(study, &verdicts, &criteria),
        criteria,
    }
}

fn notes(study: &FleetStudy, results: &[CellResult<'_>]) -> Vec<String> {
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
        "intervals: Clopper and Pearson, 95 %, of counts divided by how much more collisions vary from part to part \
         of a run than those of independent sections (Korn and Graubard 1998); without a collision that of the other \
         cells; the paper's, of which no parts are known, as of independent sections"
            .to_owned(),
        "collisions: by the original's checker / true overlaps / of these outside every section; \
         the probability is of the first"
            .to_owned(),
        format!(
            "error rate: if all {} criteria on rates hold, at most {:.0} of 100 tables of other seeds miss one \
             (Bonferroni); a criterion that does not hold is met in at most 1 of 40; collisions vary {} as much as \
             those of independent sections, all cells together (Rao and Scott 1992); what the safe mode's \
             proof rules out has no error rate: once is a miss",
            test_count(results),
            100.0 * Judge::ERROR_RATE,
            scatter(results).ratio().map_or_else(
                || "an unknown number of times".to_owned(),
                |ratio| format!("{ratio:.2} times")
            ),
        ),
    ]
}

/// Criteria that are tests of a rate.
fn test_count(results: &[CellResult<'_>]) -> usize {
    let of_rows = results
        .iter()
        .filter(|one| !one.is_mechanism() && !matches!(one.cell.demand, Demand::None));
    let of_mechanisms =
        2 * SCENARIOS.len() * usize::from(results.iter().any(CellResult::is_mechanism));
    of_rows.count() + of_mechanisms
}

/// How much more collisions vary than those of independent sections, each cell about its own share.
fn scatter(results: &[CellResult<'_>]) -> Scatter {
    let tallies = results.iter().filter_map(|one| one.tally.as_ref());
    let all = tallies.map(FleetTally::own_scatter);
    all.fold(Scatter::default(), Scatter::and)
}

/// Gives each cell the scatter that its intervals are of: its own, and at least that of all cells.
pub(crate) fn take_scatter(results: &mut [CellResult<'_>]) {
    let of_all = scatter(results).divisor().unwrap_or(1.0);
    for tally in results.iter_mut().filter_map(|one| one.tally.as_mut()) {
        tally.scatter = tally.own_scatter().divisor().unwrap_or(of_all).max(of_all);
    }
}

/// What Tables II and III show of ours.
const FOUND: [Field<FleetTally>; 4] = [
    Field::count("sections", "CS", FleetTally::section_count).ranked(3),
    Field::text("collisions", "Collisions", collisions).ranked(4),
    Field::number("per_1000", "Per 1000", 2, per_1000),
    Field::interval("per_1000", "95 %", 2, interval_per_1000),
];

/// What they show of the paper's.
const PUBLISHED: [Field<PublishedRow>; 4] = [
    Field::count("published_sections", "Paper: CS", |row: &PublishedRow| {
        row.sections
    })
    .ranked(5),
    Field::count(
        "published_collisions",
        "Paper: coll.",
        |row: &PublishedRow| row.collisions,
    )
    .ranked(6),
    Field::number("published_per_1000", "Paper", 2, |row| {
        Some(1e3 * row.collisions as f64 / row.sections as f64)
    }),
    Field::interval(
        "published_per_1000",
        "Paper: 95 %",
        2,
        |row: &PublishedRow| per_1000_interval(row.collisions, row.sections, 1.0, CONFIDENCE),
    )
    .ranked(2),
];

/// Table II or III.
fn published_table(
    scenario: Scenario,
    results: &[CellResult<'_>],
    recorded: &[RecordedResult<'_>],
) -> Table {
    let (name, title) = match scenario {
        Scenario::Harbor => ("table-2-harbor", "Table II, harbor"),
        _ => ("table-3-warehouse", "Table III, warehouse"),
    };
    let judge = Judge::of_tests(test_count(results));
    let mut rows = Vec::new();
    let ours = || {
        let of_scenario = |one: &&CellResult<'_>| one.cell.id.scenario == scenario;
        results.iter().filter(of_scenario)
    };
    let recorded = recorded.iter().filter(|one| one.of.scenario == scenario);
    let recorded: Vec<_> = recorded.collect();
    // Recorded rows have a second quantile of the delay.
    let is_wide = !recorded.is_empty();
    let widened = |mut row: Vec<Cell>| {
        if is_wide {
            row.insert(P99_PLACE, Cell::Absent);
        }
        row
    };
    for published in published_rows(scenario) {
        let before = rows.len();
        for one in ours() {
            if let Place::Published { row, .. } = one.place()
                && row == published
            {
                rows.push(widened(published_row(published, Some(one), judge)));
            }
        }
        if rows.len() == before {
            rows.push(widened(published_row(published, None, judge)));
        }
        let beside = recorded.iter();
        let beside = beside.filter(|one| one.of.published() == Some(published));
        rows.extend(beside.flat_map(|one| one.rows()));
    }
    for one in ours() {
        if let Place::Variant(variant) = one.place() {
            let mut row = vec![
                Cell::text(variant.label()),
                Cell::number(Some(0.0), 1),
                Cell::number(Some(100.0), 0),
                Cell::Count(1),
            ];
            row.extend(Field::cells(&FOUND, one.tally.as_ref()));
            row.extend(Field::cells(&PUBLISHED, None));
            let verdict = verdict_against(one).map(|(_, verdict)| verdict);
            row.extend([Cell::verdict(verdict), judged(one, judge)]);
            rows.push(widened(row));
        }
    }
    let alone = recorded.iter().filter(|one| one.of.published().is_none());
    rows.extend(alone.flat_map(|one| one.rows()));
    let mut columns = vec![
        Column::new("method", "Method"),
        Column::new("loss_ratio", "PLR"),
        Column::new("delay_ms", "Delay ms"),
        Column::new("copies", "Copies"),
    ];
    columns.extend(Field::columns(&FOUND));
    columns.extend(Field::columns(&PUBLISHED));
    columns.push(Column::new("against_paper", "Verdict"));
    columns.push(Column::new("verdict", "Accepted if").ranked(9));
    if is_wide {
        columns.insert(P99_PLACE, Column::new("delay_ms_p99", "p99 ms").ranked(1));
    }
    let mut table = Table {
        name: name.to_owned(),
        title: title.to_owned(),
        columns,
        rows,
        is_detail: false,
        notes: vec![
            "not comparable: not in the paper, or measured there with hardware in the loop, which \
             depends on hosts and radio; ours beside these are over the Wi-Fi 6 model's presets, \
             which are fitted to case study 2 alone"
                .to_owned(),
            "an overlap outside every section is a graze between two path poses, which a list of \
             sections at the poses cannot hold; the safe coordinator's guarded sections do"
                .to_owned(),
        ],
    };
    if is_wide {
        table.notes.push(ROWS_NOTE.to_owned());
        if recorded.iter().any(|one| one.replay.is_some()) {
            table.notes.push(REPLAYS_NOTE.to_owned());
        }
        let notes = recorded.iter();
        table
            .notes
            .extend(notes.map(|one| one.of.row.note(&one.collided)));
    }
    table
}

/// Behind the column of delays.
const P99_PLACE: usize = 3;

/// A published row beside ours, if there is one.
fn published_row(
    published: &PublishedRow,
    ours: Option<&CellResult<'_>>,
    judge: Judge,
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
            Cell::text(format!("HiL, {}", network.label())),
            Cell::Absent,
            Cell::Absent,
        ],
    };
    row.push(match ours.map(CellResult::place) {
        Some(Place::Published { copies, .. }) => Cell::Count(u64::from(*copies)),
        _ => Cell::Absent,
    });
    let tally = ours.and_then(|one| one.tally.as_ref());
    row.extend(Field::cells(&FOUND, tally));
    row.extend(Field::cells(&PUBLISHED, Some(published)));
    let is_model = matches!(published.condition, Condition::Static { .. });
    let verdict = ours.and_then(verdict_against).map(|(_, verdict)| verdict);
    let verdict = verdict.or((!is_model).then_some(Verdict::NotComparable));
    row.push(Cell::verdict(verdict));
    row.push(ours.map_or(Cell::Absent, |one| judged(one, judge)));
    row
}

/// How a row of Table II or III stands to the paper's; `None` of a mechanism, and where nothing was run.
fn verdict_against<'a>(one: &'a CellResult<'a>) -> Option<(&'a CellResult<'a>, Verdict)> {
    let tally = one.tally.as_ref()?;
    let verdict = match one.place() {
        Place::Mechanism { .. } => return None,
        Place::Published { row, .. } if matches!(row.condition, Condition::Static { .. }) => {
            let of = tally.section_count();
            let ours = Share {
                count: tally.collision_count().min(of),
                of,
            };
            against_published(row.share(), ours, tally.scatter.max(1.0))?
        }
        Place::Published { .. } | Place::Variant(_) => Verdict::NotComparable,
    };
    Some((one, verdict))
}

/// Cells whose names still make a short command.
const NAMED_MAX: usize = 3;

/// What more critical sections would decide.
fn larger(
    study: &FleetStudy,
    verdicts: &[(&CellResult<'_>, Verdict)],
    criteria: &[Criterion],
) -> Vec<Larger> {
    let sections = |count: u64| format!("tables.sections={count}");
    let open = verdicts.iter().filter(|one| one.1 == Verdict::Inconclusive);
    let open: Vec<_> = open.map(|(one, _)| *one).collect();
    let needed = open.iter().filter_map(|one| match one.place() {
        Place::Published { row, .. } => Some(row.sections.div_ceil(2)),
        _ => None,
    });
    let mut larger = Vec::new();
    if let Some(needed) = needed.max() {
        let mut parameters = vec![sections(needed)];
        if open.len() <= NAMED_MAX {
            let names = open.iter().map(|one| format!("\"{}\"", one.cell.id));
            let names = names.collect::<Vec<_>>().join(", ");
            parameters.push(format!("tables.cells=[{names}]"));
        } else {
            parameters.push("tables.parts=[\"published\"]".to_owned());
        }
        larger.push(Larger {
            of: "inconclusive rows",
            parameters,
        });
    }
    let is_open = criteria.iter().any(|one| one.is_met.is_none());
    if is_open && study.parameters().sections < DECISIVE_COUNT {
        larger.push(Larger {
            of: "criteria with too few",
            parameters: vec![sections(DECISIVE_COUNT)],
        });
    }
    larger
}

fn collisions(tally: &FleetTally) -> String {
    collisions_of(&tally.referee)
}

fn collisions_of(seen: &Tally) -> String {
    format!(
        "{} / {} / {}",
        seen.section_collisions_count, seen.overlaps_count, seen.outside_count
    )
}

fn per_1000(tally: &FleetTally) -> Option<f64> {
    tally.collision_ratio().map(|ratio| 1e3 * ratio)
}

fn interval_per_1000(tally: &FleetTally) -> Option<(f64, f64)> {
    tally.per_1000_interval(CONFIDENCE)
}

/// What a cell is held against, and whether it holds.
fn judged(one: &CellResult<'_>, judge: Judge) -> Cell {
    let demand = one.cell.demand;
    let text = demand_text(demand);
    if demand == Demand::None {
        return Cell::text(text);
    }
    let tally = one.tally.as_ref();
    let verdict = match tally.and_then(|tally| verdict_of(demand, tally, judge)) {
        Some(true) => "met",
        Some(false) => "MISSED",
        None => "too few",
    };
    Cell::text(format!("{text}: {verdict}"))
}

const MOTION: [Field<FleetTally>; 11] = [
    Field::number("separation_min_m", "Closest m", 2, |t| {
        t.referee.separation_min_m
    }),
    Field::number("stop_error_max_m", "Past point m", 2, |t| {
        Some(t.referee.stop_error_max_m)
    }),
    Field::number("stop_error_bound_m", "Bound m", 2, |t| {
        Some(t.stop_error_bound_m)
    }),
    Field::number("late_overshoot_max_m", "Late, past m", 2, |t| {
        Some(t.referee.late_overshoot_max_m)
    }),
    Field::count("late", "Late", |t| t.referee.authorities_late_count),
    Field::count("ignored", "Ignored", |t| {
        t.referee.authorities_ignored_count
    }),
    Field::count("order_reversals", "Reversals", |t| {
        t.coordinator.order_reversals
    }),
    Field::count("deadlocks_broken", "Deadlocks", |t| {
        t.coordinator.deadlocks_broken
    }),
    Field::count("resets", "Resets", |t| t.coordinator.resets),
    Field::number("robot_km", "Robot-km", 0, |t| {
        Some(1e-3 * t.referee.travelled_m)
    }),
    Field::number("collisions_per_1000_km", "Coll./1000 km", 2, |t| {
        let robot_km = 1e-3 * t.referee.travelled_m;
        (robot_km > 0.0).then(|| 1e3 * t.collision_count() as f64 / robot_km)
    }),
];

/// What the robots did in each row of Tables II and III.
fn motion_table(results: &[CellResult<'_>]) -> Table {
    Table {
        name: "motion".to_owned(),
        title: "Tables II and III: what the robots did".to_owned(),
        is_detail: true,
        notes: vec![
            "past point: farthest stop beyond an order that came in time; bound: 3 v (TT + D) + v \
             TT / 2 for the stepped tracker, 0 for the exact one; late: orders too late to stop at"
                .to_owned(),
        ],
        ..by_cell(
            "Row",
            &MOTION,
            results.iter().filter(|one| !one.is_mechanism()),
        )
    }
}

/// A row for each of `results`.
fn by_cell<'a>(
    label: &'static str,
    fields: &[Field<FleetTally>],
    results: impl Iterator<Item = &'a CellResult<'a>>,
) -> Table {
    let rows = results.map(|one| {
        let mut row = vec![Cell::text(one.cell.id.to_string())];
        row.extend(Field::cells(fields, one.tally.as_ref()));
        row
    });
    let mut columns = vec![Column::new("cell", label)];
    columns.extend(Field::columns(fields));
    Table {
        rows: rows.collect(),
        columns,
        ..Table::default()
    }
}

const LEGACY: [Field<FleetTally>; 6] = [
    Field::count("legacy_sections", "Legacy: CS", FleetTally::section_count).ranked(3),
    Field::text("legacy_collisions", "Legacy: coll.", collisions).ranked(4),
    Field::number("legacy_per_1000", "Legacy: P x 1000", 2, per_1000),
    Field::interval("legacy_per_1000", "95 %", 2, interval_per_1000),
    Field::count("legacy_resets", "Legacy: resets", |t: &FleetTally| {
        t.coordinator.resets
    })
    .ranked(6),
    Field::number(
        "legacy_missions_per_hour",
        "Legacy: missions/h",
        0,
        FleetTally::missions_per_hour,
    )
    .ranked(5),
];

const SAFE: [Field<FleetTally>; 5] = [
    Field::count("safe_sections", "Safe: CS", FleetTally::section_count).ranked(3),
    Field::text("safe_collisions", "Safe: coll.", collisions).ranked(1),
    Field::number("safe_per_1000_high", "Safe: P x 1000 below", 3, |t| {
        Some(interval_per_1000(t)?.1)
    }),
    Field::count("safe_stuck", "Safe: stuck", |t: &FleetTally| t.safe.stuck).ranked(2),
    Field::number(
        "safe_missions_per_hour",
        "Safe: missions/h",
        0,
        FleetTally::missions_per_hour,
    )
    .ranked(5),
];

/// What each impairment does to each coordinator.
fn mechanism_table(scenario: Scenario, results: &[CellResult<'_>]) -> Table {
    let rows = Mechanism::ALL.into_iter().map(|mechanism| {
        let of = |mode| mechanism_tally(results, scenario, mechanism, mode);
        let mut row = vec![Cell::text(mechanism.label())];
        row.extend(Field::cells(&LEGACY, of(CoordinatorMode::Legacy)));
        row.extend(Field::cells(&SAFE, of(CoordinatorMode::Safe)));
        row
    });
    let mut columns = vec![Column::new("mechanism", "What the network does")];
    columns.extend(Field::columns(&LEGACY));
    columns.extend(Field::columns(&SAFE));
    Table {
        name: format!("mechanisms-{scenario}"),
        title: format!(
            "What causes collisions, {scenario}: status over the network, exact tracker, delay \
             unknown to the coordinator"
        ),
        columns,
        rows: rows.collect(),
        ..Table::default()
    }
}

const COMMANDS: [Field<FleetTally>; 12] = [
    Field::count("commands", "Commands", |t| t.commands.offered_count),
    Field::count("commands_lost", "Lost", |t| t.commands.lost_count),
    Field::count("states", "States", |t| t.status.offered_count),
    Field::count("states_lost", "Lost", |t| t.status.lost_count),
    Field::count("repeats", "Repeats", |t| t.coordinator.authority_repeats),
    Field::count("late", "Late", |t| t.referee.authorities_late_count),
    Field::count("ignored", "Ignored", |t| {
        t.referee.authorities_ignored_count
    }),
    Field::count("refused", "Refused", |t| {
        t.referee.authorities_refused_count
    }),
    Field::count("stale", "Stale", |t| t.referee.stale_count),
    Field::count("order_reversals", "Reversals", |t| {
        t.coordinator.order_reversals
    }),
    Field::number("stop_error_max_m", "Past point m", 2, |t| {
        Some(t.referee.stop_error_max_m)
    }),
    Field::number("separation_min_m", "Closest m", 2, |t| {
        t.referee.separation_min_m
    }),
];

/// What became of the commands in each cell of the table of mechanisms.
fn command_table(results: &[CellResult<'_>]) -> Table {
    Table {
        name: "commands".to_owned(),
        title: "What causes collisions: what became of the messages".to_owned(),
        is_detail: true,
        notes: vec![
            "late: too late to stop at; ignored: behind the robot, which drove on; refused: not \
             applied because it could not stop (safe); stale: older than one applied"
                .to_owned(),
        ],
        ..by_cell(
            "Cell",
            &COMMANDS,
            results.iter().filter(|one| one.is_mechanism()),
        )
    }
}

/// Near misses, stops and time lost, in virtual time and in recorded runs.
fn costs_table(results: &[CellResult<'_>], recorded: &[RecordedResult<'_>]) -> Table {
    let row = |name: String, costs: Option<&Costs>| {
        let mut row = vec![Cell::text(name)];
        row.extend(Field::cells(&COSTS, costs));
        row
    };
    let mut rows: Vec<_> = (results.iter())
        .map(|one| {
            let costs = one.tally.as_ref().map(Costs::of_tally);
            row(one.cell.id.to_string(), costs.as_ref())
        })
        .collect();
    for one in recorded {
        let both = [Some(one), one.replay.as_deref()].into_iter().flatten();
        rows.extend(both.map(|one| {
            let name = format!("{}, {}", one.of.scenario, one.of.row.method());
            row(name, one.of.costs.as_ref())
        }));
    }
    let mut columns = vec![Column::new("cell", "Row")];
    columns.extend(Field::columns(&COSTS));
    Table {
        name: "costs".to_owned(),
        title: "Besides collisions: missions, time lost, stops and near misses".to_owned(),
        columns,
        rows,
        is_detail: true,
        notes: vec![
            format!(
                "missions/h: of one fleet, missions under way at the end do not count; lost: what a mission done took from its \
                 arrival at the robot beyond a drive from rest to rest without a stop by the vehicle's limits, which the stepped \
                 tracker exceeds by up to a tick; stop: {:.1} s or longer, also before setting out, per mission begun",
                f64::from(STOP_SCANS) * SCAN_PERIOD.as_secs_f64()
            ),
            "a recorded row is like its replay and not like the static rows, whose runs are longer; recorded before these \
             figures were in the score, it has none"
                .to_owned(),
            "near misses: two robots under way within a pose spacing of each other without contact, \
             per CS; counted once until they are two spacings apart"
                .to_owned(),
        ],
    }
}

/// Critical sections from which the demands on rates can be judged.
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
        Demand::Within(low, high) => format!("95 % in {low} to {high}"),
        Demand::NoneAtAll => "none by any checker".to_owned(),
    }
}

/// Whether a demand is met; `None` when there are too few critical sections to say.
pub(crate) fn verdict_of(demand: Demand, tally: &FleetTally, judge: Judge) -> Option<bool> {
    let interval = |confidence| tally.per_1000_interval(confidence);
    // Without an interval there are no sections, or more collisions than sections.
    if demand != Demand::None && interval(CONFIDENCE).is_none() {
        return (tally.any_collision_count() > 0).then_some(false);
    }
    match demand {
        Demand::None => None,
        Demand::Below(bound) => judge.verdict(
            interval,
            |(_, high)| *high < bound,
            |(low, _)| *low >= bound,
        ),
        Demand::Within(least, most) => judge.verdict(
            interval,
            |(low, high)| *low >= least && *high <= most,
            |(low, high)| *high < least || *low > most,
        ),
        Demand::NoneAtAll if tally.any_collision_count() > 0 => Some(false),
        Demand::NoneAtAll => (tally.section_count() >= TELLING_COUNT).then_some(true),
    }
}

/// A criterion; without `known` nothing could be judged, for want of `missing`.
fn criterion(text: String, known: Option<(Option<bool>, String)>, missing: &str) -> Criterion {
    let (is_met, finding) = known.unwrap_or_else(|| (None, missing.to_owned()));
    Criterion {
        text,
        is_met,
        is_judged: true,
        finding,
    }
}

const NOT_RUN: &str = "not run to its end";

/// Everything the study is held against.
pub(crate) fn criteria(results: &[CellResult<'_>]) -> Vec<Criterion> {
    let judge = Judge::of_tests(test_count(results));
    let published = results.iter().filter(|one| !one.is_mechanism());
    let mut criteria: Vec<_> = published
        .filter(|one| one.cell.demand != Demand::None)
        .map(|one| {
            let CellSpec { id, demand, .. } = one.cell;
            let known = one.tally.as_ref().map(|tally| {
                let is_met = verdict_of(*demand, tally, judge);
                (is_met, collisions_text(tally))
            });
            criterion(format!("{id}: {}", demand_text(*demand)), known, NOT_RUN)
        })
        .collect();
    if results.iter().any(CellResult::is_mechanism) {
        criteria.extend(safe_criteria(results));
        criteria.extend(SCENARIOS.map(|scenario| throughput(scenario, results, judge)));
        criteria.extend(SCENARIOS.map(|scenario| loss_exceeds_delay(scenario, results, judge)));
    }
    criteria
}

fn collisions_text(tally: &FleetTally) -> String {
    let seen = &tally.referee;
    let interval = tally.per_1000_interval(CONFIDENCE);
    let per_1000 = interval.map_or_else(String::new, |(low, high)| {
        format!(", {low:.2} to {high:.2} per 1000")
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
fn safe_criteria(results: &[CellResult<'_>]) -> [Criterion; 3] {
    let is_safe = |one: &&CellResult<'_>| matches!(one.place(), Place::Mechanism { mode, .. } if *mode == CoordinatorMode::Safe);
    let cells = results.iter().filter(is_safe);
    let cell_count = cells.clone().count();
    let (mut sum, mut seen_again) = (FleetTally::default(), String::new());
    let (mut ended_count, mut collisions) = (0, 0);
    for (id, tally) in cells.filter_map(|one| Some((one.cell.id, one.tally.as_ref()?))) {
        ended_count += 1;
        collisions += tally.any_collision_count();
        sum.merge(tally);
        for run in &tally.collided {
            let CollidedRun {
                replica,
                seed,
                first_at,
            } = run;
            let again = format!("; {id}, run {replica}, seed {seed}, first at {first_at}");
            seen_again.push_str(&again);
        }
    }
    // One is enough to miss a demand; to meet it takes all cells, and something to see in them.
    let sections = sum.section_count();
    let is_telling = ended_count == cell_count && sections >= TELLING_COUNT;
    let safe = &sum.safe;
    let impossible = safe.states_impossible + safe.authorities_exceeded + safe.margins_exceeded;
    let judged = |what: &str, is_met: bool, finding: String| Criterion {
        text: format!("{}: {what}", CoordinatorMode::Safe),
        is_met: (!is_met || is_telling).then_some(is_met),
        is_judged: true,
        finding,
    };
    [
        judged(
            "no collision by any checker, in any row run",
            collisions == 0,
            format!(
                "{collisions} in {sections} CS of {ended_count} of {cell_count} cells{seen_again}"
            ),
        ),
        judged(
            "no robot stuck, no fleet at a stand",
            safe.stuck == 0 && sum.stand_count == 0,
            format!(
                "{} robots made no way for too long, {} runs came to a stand",
                safe.stuck, sum.stand_count
            ),
        ),
        judged(
            "nothing that its proof rules out",
            impossible == 0,
            format!(
                "{} impossible states, {} beyond their authority, {} beyond the stop margin",
                safe.states_impossible, safe.authorities_exceeded, safe.margins_exceeded
            ),
        ),
    ]
}

/// Safety costs little where nothing is wrong: by the logarithms of the runs' rates (Welch 1947).
fn throughput(scenario: Scenario, results: &[CellResult<'_>], judge: Judge) -> Criterion {
    let tally = |mode| mechanism_tally(results, scenario, Mechanism::Clean, mode);
    let is_telling = |tally: &FleetTally| tally.section_count() >= RATE_SECTIONS_MIN;
    let rates = |mode| {
        let runs = &tally(mode).filter(|tally| is_telling(tally))?.runs;
        let rate = |run: &RunFigures| Some(run.missions_per_hour?.ln());
        let rates: Option<Vec<f64>> = runs.iter().map(rate).collect();
        rates.filter(|rates| rates.iter().all(|rate| rate.is_finite()))
    };
    // A rate of zero has no logarithm: such a run is a miss by itself, unless it was too short to end a mission.
    let idle_count = tally(CoordinatorMode::Safe).map_or(0, |tally| {
        let is_idle = |run: &&RunFigures| run.missions_per_hour == Some(0.0);
        let is_judged = tally.stand_count > 0 || is_telling(tally);
        tally.runs.iter().filter(is_idle).count() * usize::from(is_judged)
    });
    let idle = (idle_count > 0).then(|| {
        let finding = format!("runs of safe without a mission driven to its end: {idle_count}");
        (Some(false), finding)
    });
    let both = rates(CoordinatorMode::Legacy).zip(rates(CoordinatorMode::Safe));
    let compared = both.and_then(|(legacy, safe)| {
        let interval = |confidence| {
            let difference = welch(&legacy, &safe, confidence)?;
            Some(difference.map(f64::exp))
        };
        let is_met = judge.verdict(
            interval,
            |ratio| ratio.low >= THROUGHPUT_RATIO_MIN,
            |ratio| ratio.high < THROUGHPUT_RATIO_MIN,
        );
        let ratio = interval(CONFIDENCE)?;
        let finding = format!(
            "{:.1} to {:.1} % (95 %) of legacy's, {} and {} runs",
            100.0 * ratio.low,
            100.0 * ratio.high,
            safe.len(),
            legacy.len()
        );
        Some((is_met, finding))
    });
    criterion(
        format!("{scenario}: safe keeps 90 % of legacy's missions per hour when clean"),
        idle.or(compared),
        &format!(
            "{NOT_RUN}, in a single run, with fewer than {RATE_SECTIONS_MIN} CS, or legacy ended no mission in a run"
        ),
    )
}

/// Losing commands causes collisions where delaying them does not.
fn loss_exceeds_delay(scenario: Scenario, results: &[CellResult<'_>], judge: Judge) -> Criterion {
    let tally = |mechanism| mechanism_tally(results, scenario, mechanism, CoordinatorMode::Legacy);
    let both = tally(Mechanism::CommandLoss10).zip(tally(Mechanism::Delay300Ms));
    let known = both.and_then(|(loss, delay)| {
        let interval = |confidence| {
            Some((
                loss.per_1000_interval(confidence)?,
                delay.per_1000_interval(confidence)?,
            ))
        };
        let is_met = judge.verdict(
            interval,
            |(loss, delay)| loss.0 > delay.1,
            |(loss, delay)| loss.1 < delay.0,
        );
        let (loss, delay) = interval(CONFIDENCE)?;
        let finding = format!(
            "{:.2} to {:.2} against {:.2} to {:.2} per 1000",
            loss.0, loss.1, delay.0, delay.1
        );
        Some((is_met, finding))
    });
    let text = format!("{scenario}, legacy: losing 10 % of the commands is worse than 300 ms");
    let missing = format!("{NOT_RUN}, or more collisions than CS");
    criterion(text, known, &missing)
}

#[cfg(test)]
mod judgement_tests {
    use super::*;
    use crate::experiment::Setup;
    use crate::experiment::cells::mechanism_cells;

    /// Of a miss that leaves 0.001 of doubt.
    const JUDGE: Judge = Judge::of_tests(50);

    fn tally(collisions: u64, sections: u64) -> FleetTally {
        let mut tally = FleetTally::default();
        tally.referee.section_collisions_count = collisions;
        tally.referee.sections_passed_count = sections;
        tally
    }

    #[test]
    fn a_demand_is_met_or_missed_only_by_a_whole_interval() {
        let verdict =
            |demand, collisions, sections| verdict_of(demand, &tally(collisions, sections), JUDGE);
        // No collision in 10 000 leaves up to 0.37 per 1000.
        assert_eq!(verdict(Demand::Below(0.2), 0, 10_000), None);
        assert_eq!(verdict(Demand::Below(0.37), 0, 10_000), Some(true));
        assert_eq!(verdict(Demand::Below(0.2), 0, 100_000), Some(true));
        assert_eq!(verdict(Demand::Below(0.2), 50, 10_000), Some(false));
        // However many there are: a rate as the bound may fall on either side.
        assert_eq!(verdict(Demand::Below(0.2), 15, 100_000), None);
        assert_eq!(verdict(Demand::Below(0.2), 25, 100_000), None);
        // Beyond 95 %, and not beyond what a table of many criteria takes.
        assert_eq!(verdict(Demand::Below(0.2), 32, 100_000), None);
        assert_eq!(verdict(Demand::Below(0.2), 45, 100_000), Some(false));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 0, 10_000), None);
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 0, 100_000), Some(false));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 13, 10_000), Some(true));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 130, 100_000), Some(true));
        assert_eq!(verdict(Demand::Within(0.2, 4.0), 22, 100_000), None);
        assert_eq!(verdict(Demand::None, 500, 100_000), None);
    }

    #[test]
    fn collisions_that_come_together_count_as_fewer() {
        let tally_of = |collisions, scatter| FleetTally {
            scatter,
            ..tally(collisions, 100_000)
        };
        let verdict = |scatter| verdict_of(Demand::Below(0.2), &tally_of(45, scatter), JUDGE);
        assert_eq!((verdict(1.0), verdict(4.0)), (Some(false), None));
        // One stays more than none.
        let interval = |collisions| tally_of(collisions, 4.0).per_1000_interval(CONFIDENCE);
        let ((low, high), none) = (interval(1).unwrap(), interval(0).unwrap());
        assert!(none.0 == 0.0 && low > 0.0 && high > none.1);
    }

    #[test]
    fn collisions_without_an_interval_miss_every_demand() {
        for demand in [
            Demand::Below(0.2),
            Demand::Within(0.2, 4.0),
            Demand::NoneAtAll,
        ] {
            let verdict =
                |collisions, sections| verdict_of(demand, &tally(collisions, sections), JUDGE);
            assert_eq!(verdict(3, 2), Some(false));
            assert_eq!(verdict(1, 0), Some(false));
            assert_eq!(verdict(0, 0), None);
        }
        assert_eq!(verdict_of(Demand::None, &tally(3, 2), JUDGE), None);
    }

    /// The criterion on missions per hour of legacy and safe runs, so many sections a run; the safe fleet came to a
    /// stand so many times.
    fn throughput_of(
        legacy: &[Option<f64>],
        safe: &[Option<f64>],
        sections: u64,
        stand_count: u64,
    ) -> Criterion {
        let cells = mechanism_cells(&Setup::default());
        let result = |mode, rates: &[Option<f64>]| {
            let place = Place::Mechanism {
                mechanism: Mechanism::Clean,
                mode,
            };
            let is_it =
                |cell: &&CellSpec| cell.id.scenario == SCENARIOS[0] && cell.id.place == place;
            let mut sum = tally(0, sections * rates.len() as u64);
            sum.runs = rates
                .iter()
                .map(|rate| RunFigures {
                    parts: Vec::new(),
                    missions_per_hour: *rate,
                })
                .collect();
            (cells.iter().find(is_it).unwrap(), sum)
        };
        let (legacy_cell, legacy) = result(CoordinatorMode::Legacy, legacy);
        let (safe_cell, mut safe) = result(CoordinatorMode::Safe, safe);
        safe.stand_count = stand_count;
        let results = [(legacy_cell, legacy), (safe_cell, safe)].map(|(cell, tally)| CellResult {
            cell,
            tally: Some(tally),
        });
        throughput(SCENARIOS[0], &results, JUDGE)
    }

    #[test]
    fn a_safe_fleet_that_ends_no_mission_misses_its_rate() {
        let (fast, idle) = ([Some(100.0), Some(101.0), Some(99.0)], Some(0.0));
        let verdict =
            |safe: &[_], sections, stands| throughput_of(&fast, safe, sections, stands).is_met;
        assert_eq!(verdict(&fast, 1000, 0), Some(true));
        assert_eq!(
            verdict(&[Some(50.0), Some(50.5), Some(49.5)], 1000, 0),
            Some(false)
        );
        let one_idle = [fast[0], idle, fast[2]];
        assert_eq!(verdict(&one_idle, 1000, 1), Some(false));
        // Also of one run, and of a fleet that stood before it passed many sections.
        assert_eq!(verdict(&[idle], 2, 1), Some(false));
        assert!(
            throughput_of(&fast, &one_idle, 1000, 1)
                .finding
                .ends_with("driven to its end: 1")
        );
        // Too short to end one, a rate that is unavailable, and legacy at a stand say nothing.
        assert_eq!(verdict(&[idle, idle], 2, 0), None);
        assert_eq!(verdict(&[fast[0], None, fast[2]], 1000, 0), None);
        assert_eq!(throughput_of(&one_idle, &fast, 1000, 0).is_met, None);
    }

    #[test]
    fn one_collision_by_any_checker_misses_none_at_all() {
        let verdict = |tally| verdict_of(Demand::NoneAtAll, &tally, JUDGE);
        assert_eq!(verdict(tally(0, 10_000)), Some(true));
        assert_eq!(verdict(tally(0, 100)), None);
        assert_eq!(verdict(tally(1, 100)), Some(false));
        let mut overlap = tally(0, 1_000_000);
        overlap.referee.overlaps_count = 1;
        assert_eq!(verdict(overlap), Some(false));
        let mut early = tally(0, 0);
        early.referee.overlaps_count = 1;
        assert_eq!(verdict(early), Some(false));
    }
}
