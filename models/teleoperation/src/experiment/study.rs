//! The study `hil-runtime tables` runs for the teleoperation case: every condition with every seed.
//! What the table looks like is in `report`.

use crate::experiment::conditions::{Condition, base, conditions};
use crate::experiment::drive::{Tally, drive};
use crate::experiment::recorded::MotionLossRow;
use crate::experiment::report::{self, Row};
use crate::experiment::trajectory::Trajectory;
use crate::{Teleoperation, TeleoperationParameters};
use hil_arm::egm::parameters::{ControllerSettings, Preset};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::recorded_run::RecordedRun;
use hil_core::study::{Study, StudyRefusal, StudyReport, Watch};

/// The study.
#[derive(Debug)]
pub(crate) struct MotionLossStudy {
    pub(crate) parameters: TableParameters,
    pub(crate) seed: u64,
    pub(crate) trajectory: Trajectory,
    pub(crate) conditions: Vec<Condition>,
    /// True when motion and robot are those with which outages were fitted to the paper.
    pub(crate) is_fitted: bool,
    /// Rows beside those of the conditions.
    pub(crate) recorded: Vec<MotionLossRow>,
}

impl MotionLossStudy {
    /// The table of `case`: its motion, its robot, its policies wherever a row does not say
    /// otherwise. `recorded` runs become rows.
    ///
    /// # Errors
    /// An entry of the filter that no condition meets, a motion without loops, or a run that can be no row.
    pub(crate) fn new(
        case: &Teleoperation,
        recorded: Vec<RecordedRun<TeleoperationParameters>>,
    ) -> Result<Self, StudyRefusal> {
        let parameters = case.parameters.tables.clone();
        let mut conditions = conditions(&base(case));
        keep_wanted(&mut conditions, &parameters.conditions)?;
        let is_fitted = is_fitted(case);
        Ok(Self {
            trajectory: Trajectory::new(case, parameters.loops)?,
            seed: case.seed,
            is_fitted,
            recorded: MotionLossRow::of_runs(recorded, &case.parameters, is_fitted)?,
            conditions,
            parameters,
        })
    }

    /// The condition and the seed of a task. Every condition has the same seeds, so that they
    /// meet the same outages.
    fn task(&self, task: usize) -> (&Condition, u64) {
        let seeds = self.parameters.seeds as usize;
        (
            &self.conditions[task / seeds],
            seed_of(self.seed, task % seeds),
        )
    }
}

/// Keeps the conditions whose name contains one of `wanted`, or all without any.
fn keep_wanted(conditions: &mut Vec<Condition>, wanted: &[String]) -> Result<(), ParameterError> {
    let meets = |condition: &Condition, part: &String| condition.name.contains(part.as_str());
    for part in wanted {
        if part.is_empty() || !conditions.iter().any(|condition| meets(condition, part)) {
            let names: Vec<_> = conditions.iter().map(|condition| condition.name).collect();
            let names = names.join(", ");
            let problem = format!("{part:?} is part of no condition's name; there are {names}");
            return Err(ParameterError::new("tables.conditions", problem));
        }
    }
    if !wanted.is_empty() {
        conditions.retain(|condition| wanted.iter().any(|part| meets(condition, part)));
    }
    Ok(())
}

/// True when nothing but the size of the tables, and what starts the first session, differs from
/// the parameters that the published rows were fitted with.
fn is_fitted(case: &Teleoperation) -> bool {
    let default = TeleoperationParameters::default();
    let but_for_robot = TeleoperationParameters {
        egm: default.egm.clone(),
        tables: default.tables.clone(),
        ..case.parameters.clone()
    };
    let fitted = ControllerSettings {
        start: case.settings.start,
        ..ControllerSettings::of(Preset::Paper)
    };
    but_for_robot == default && case.settings == fitted
}

/// The seed of the `replica`-th run of a condition.
pub(crate) fn seed_of(seed: u64, replica: usize) -> u64 {
    RandomStream::new(seed, &format!("motion loss, run {replica}")).next_u64()
}

impl Study for MotionLossStudy {
    type Outcome = Tally;

    fn task_count(&self) -> usize {
        self.conditions.len() * self.parameters.seeds as usize
    }

    fn label(&self, task: usize) -> String {
        self.task(task).0.name.to_owned()
    }

    fn run(&self, task: usize, watch: Watch<'_>) -> Option<Tally> {
        let (condition, seed) = self.task(task);
        drive(&self.trajectory, &condition.setup, seed, watch)
    }

    fn report(&self, outcomes: &[Option<&Tally>]) -> StudyReport {
        let runs = outcomes.chunks(self.parameters.seeds as usize);
        let results: Vec<_> = self
            .conditions
            .iter()
            .zip(runs)
            .map(|(condition, runs)| Row {
                condition,
                runs: runs.iter().flatten().copied().collect(),
                is_fitted: self.is_fitted,
            })
            .collect();
        report::report(self, &results)
    }
}

hil_core::options! {
    /// `[case.parameters.tables]`: the size of what `hil-runtime tables` and `calibrate` compute.
    pub struct TableParameters {
        /// Motion loops per run; the seed paper played 890.
        loops: u32 = 890, in 5..=2000;
        /// Runs per condition, each with a seed of its own.
        seeds: u32 = 12, in 1..=1000;
        /// Only conditions whose name contains one of these, each of which must be part of one; empty
        /// for all.
        conditions: Vec<String> = Vec::new();
    }
}

#[cfg(test)]
mod parameters_tests {
    use super::*;

    #[test]
    fn numbers_outside_their_range_are_refused_by_name() {
        let refused = |change: fn(&mut TableParameters)| {
            let mut parameters = TableParameters::default();
            change(&mut parameters);
            parameters.check().unwrap_err().key
        };
        assert_eq!(refused(|p| p.loops = 4), "loops");
        assert_eq!(refused(|p| p.loops = 2001), "loops");
        assert_eq!(refused(|p| p.seeds = 0), "seeds");
        assert_eq!(TableParameters::default().check(), Ok(()));
    }
}
