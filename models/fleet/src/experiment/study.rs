//! The study `hil-runtime tables` runs for the fleet case: every cell cut into tasks with seeds of
//! their own. What the tables look like is in `report`.

use std::borrow::Cow;

use crate::case::FleetParameters;
use crate::experiment::cells::{
    CellSpec, CollidedRun, FleetTally, RunFigures, SCENARIOS, mechanism_cells, published_cells,
};
use crate::experiment::driver::{Experiment, Setup};
use crate::experiment::recorded::FleetRow;
use crate::experiment::report::{self, CellResult};
use crate::scenario::{Scenario, Scene, WorldParameters};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::recorded_run::RecordedRun;
use hil_core::study::{Study, StudyRefusal, StudyReport, Watch};
use hil_core::time::Instant;
use hil_link::impaired::DelayLaw;
use hil_stats::comparison::Share;

hil_core::words! {
    /// Which tables.
    pub enum TablePart {
        /// Tables II and III of the seed paper.
        Published = "published",
        /// What each impairment does to each coordinator.
        Mechanisms = "mechanisms",
    }
}

hil_core::options! {
    /// `[case.parameters.tables]`.
    pub struct TableParameters {
        /// Critical sections per cell.
        sections: u64 = 10_000, in 1..=1_000_000_000;
        /// Critical sections per task: a cell is cut into independent runs of so many.
        sections_per_task: u64 = 5_000, in 100..=1_000_000;
        /// Which tables.
        parts: Cow<'static, [TablePart]> = Cow::Borrowed(&TablePart::ALL);
        /// How the static rows' delay is drawn.
        delay_law: DelayLaw = DelayLaw::Constant;
        /// Only cells whose name contains one of these; empty for all.
        cells: Vec<String> = Vec::new();
    }
    check TableParameters::check_parts;
}

impl TableParameters {
    fn check_parts(&self) -> Result<(), ParameterError> {
        if self.parts.is_empty() {
            let problem = "[] leaves nothing to compute; name published, mechanisms or both";
            return Err(ParameterError::new("parts", problem));
        }
        Ok(())
    }
}

/// The study.
#[derive(Debug)]
pub(crate) struct FleetStudy {
    parameters: TableParameters,
    /// The seed all tasks' seeds come from.
    pub(crate) seed: u64,
    scenes: Vec<(Scenario, Scene)>,
    /// The cells in order.
    pub(crate) cells: Vec<CellSpec>,
    /// Rows beside them.
    pub(crate) recorded: Vec<FleetRow>,
}

/// One task: a run of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Task {
    cell: usize,
    replica: u64,
    sections: u64,
}

/// Critical sections of a part of a run: half an hour of a fleet, long against whatever makes collisions come together.
const PART_SECTIONS: u64 = 500;
/// Between two looks at how far a run has come.
const LOOK_NS: i64 = 60_000_000_000;
/// A fleet that passes no section for so long has come to a stand.
const STAND_NS: i64 = 7_200_000_000_000;

impl FleetStudy {
    /// The study with these parameters: those of `tables` say what to compute; those of the other
    /// tables hold wherever a cell does not say otherwise. `recorded` runs become rows.
    ///
    /// # Errors
    /// Names the parameter that keeps a world from being built, a filter no cell meets, or a run that can be no row.
    pub(crate) fn new(
        parameters: &FleetParameters,
        seed: u64,
        recorded: Vec<RecordedRun<FleetParameters>>,
    ) -> Result<Self, StudyRefusal> {
        let tables = parameters.tables.clone();
        let base = Setup {
            robot: parameters.robot.clone(),
            coordinator: parameters.coordinator.clone(),
            missions: parameters.missions,
            ..Setup::default()
        };
        let mut cells = Vec::new();
        for part in tables.parts.iter() {
            cells.extend(match part {
                TablePart::Published => published_cells(&base, tables.delay_law),
                TablePart::Mechanisms => mechanism_cells(&base),
            });
        }
        if !tables.cells.is_empty() {
            let is_wanted = |name: &str| tables.cells.iter().any(|part| name.contains(part));
            cells.retain(|cell| is_wanted(&cell.id.to_string()));
        }
        if cells.is_empty() {
            let problem = format!("{:?} is part of no cell's name", tables.cells);
            return Err(ParameterError::new("tables.cells", problem).into());
        }
        for cell in &cells {
            cell.setup.check()?;
        }
        let mut scenes = Vec::new();
        for scenario in SCENARIOS {
            if cells.iter().any(|cell| cell.id.scenario == scenario) {
                let world = WorldParameters {
                    scenario,
                    ..parameters.world.clone()
                };
                scenes.push((scenario, world.build()?));
            }
        }
        Ok(Self {
            parameters: tables,
            seed,
            scenes,
            cells,
            recorded: FleetRow::of_runs(recorded, &base)?,
        })
    }

    /// What the tables were asked for.
    pub(crate) fn parameters(&self) -> &TableParameters {
        &self.parameters
    }

    /// The world of a scenario.
    pub(crate) fn scene(&self, scenario: Scenario) -> &Scene {
        let scene = self.scenes.iter().find(|(known, _)| *known == scenario);
        &scene.expect("every cell's scenario has its scene").1
    }

    fn replica_count(&self) -> u64 {
        let TableParameters {
            sections,
            sections_per_task,
            ..
        } = self.parameters;
        sections.div_ceil(sections_per_task)
    }

    fn task(&self, task: usize) -> Task {
        let (task, replicas) = (task as u64, self.replica_count());
        let (cell, replica) = (task / replicas, task % replicas);
        let done = replica * self.parameters.sections_per_task;
        Task {
            cell: usize::try_from(cell).expect("a task number was a usize"),
            replica,
            sections: self
                .parameters
                .sections_per_task
                .min(self.parameters.sections - done),
        }
    }

    /// The seed of a task depends on what it is about, not on its place among the others.
    fn seed_of(&self, task: Task) -> u64 {
        let cell = self.cells[task.cell].id.seed_name();
        let name = format!("{cell}, run {}", task.replica);
        RandomStream::new(self.seed, &name).next_u64()
    }
}

impl Study for FleetStudy {
    type Outcome = FleetTally;

    fn task_count(&self) -> usize {
        let replicas = usize::try_from(self.replica_count()).unwrap_or(usize::MAX);
        self.cells.len().saturating_mul(replicas)
    }

    fn label(&self, task: usize) -> String {
        self.cells[self.task(task).cell].id.to_string()
    }

    fn run(&self, task: usize, watch: Watch<'_>) -> Option<FleetTally> {
        let task = self.task(task);
        let cell = &self.cells[task.cell];
        let scene = self.scene(cell.id.scenario);
        let seed = self.seed_of(task);
        let mut experiment = Experiment::new(scene, &cell.setup, seed)
            .expect("the setup was checked when the study was made");
        let (mut newest_count, mut newest_at) = (0, Instant::ZERO);
        let mut parts: Vec<Share> = Vec::new();
        let mut part_start = Share { count: 0, of: 0 };
        loop {
            let until = Instant::from_ns(experiment.now().as_ns() + LOOK_NS);
            experiment.run_until(until, &mut ());
            let count = experiment.section_count();
            if count > newest_count {
                (newest_count, newest_at) = (count, until);
            }
            let is_standing = until.ns_since(newest_at) > STAND_NS;
            let has_ended = count >= task.sections || is_standing;
            if has_ended || count - part_start.of >= PART_SECTIONS {
                let collided = experiment.referee().tally().section_collisions_count;
                parts.push(Share {
                    count: collided - part_start.count,
                    of: count - part_start.of,
                });
                part_start = Share {
                    count: collided,
                    of: count,
                };
            }
            if has_ended {
                let robot = &cell.setup.robot;
                let first = experiment.incidents().first();
                let tally = experiment.tally();
                return Some(FleetTally {
                    runs: vec![RunFigures {
                        parts,
                        missions_per_hour: tally.missions_per_hour(),
                    }],
                    stop_error_bound_m: robot.stop_error_bound_m(&scene.world.vehicle),
                    stand_count: u64::from(is_standing),
                    collided: Vec::from_iter(first.map(|incident| CollidedRun {
                        replica: task.replica,
                        seed,
                        first_at: incident.at,
                    })),
                    ..tally
                });
            }
            if !watch(count as f64 / task.sections as f64) {
                return None;
            }
        }
    }

    fn report(&self, outcomes: &[Option<&FleetTally>]) -> StudyReport {
        let replicas = usize::try_from(self.replica_count()).unwrap_or(usize::MAX);
        let tallies = outcomes.chunks(replicas).map(|runs| {
            // A cell counts with the runs that ended; without any it is empty.
            let mut ended = runs.iter().flatten();
            let mut sum = (*ended.next()?).clone();
            for run in ended {
                sum.merge(run);
            }
            Some(sum)
        });
        let cells = self.cells.iter().zip(tallies);
        let mut results: Vec<_> = cells
            .map(|(cell, tally)| CellResult { cell, tally })
            .collect();
        report::take_scatter(&mut results);
        report::report(self, &results)
    }
}

/// The worlds a study drives in, for a note.
pub(crate) fn worlds_text(study: &FleetStudy) -> String {
    let text = |(scenario, scene): &(Scenario, Scene)| {
        let (world, planning) = (&scene.world, &scene.planning);
        format!(
            "{scenario}: {} robots, {} bays, {} paths ({} planned, {} states expanded)",
            scene.starts.len(),
            world.bays.len(),
            world.paths.len() / 2,
            planning.planned_count,
            planning.expanded_count,
        )
    };
    let texts: Vec<_> = study.scenes.iter().map(text).collect();
    texts.join("; ")
}
