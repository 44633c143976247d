//! Which outages make a given motion loss rate: for each mechanism a curve of rates over mean
//! lengths, because one figure fixes no point. `hil-runtime calibrate teleoperation` runs it.

use crate::case_study::ParameterError;
use crate::egm::parameters::ControllerSettings;
use crate::link::outages::Outages;
use crate::study::{Cell, Column, Criterion, Study, StudyReport, Table, Watch, Work};
use crate::teleoperation::Teleoperation;
use crate::teleoperation::experiment::conditions::{back_after, base, changed, without_time_out};
use crate::teleoperation::experiment::drive::{Channel, Setup, drive};
use crate::teleoperation::experiment::study::seed_of;
use crate::teleoperation::experiment::trajectory::Trajectory;
use crate::teleoperation::series::Estimate;

/// Mean lengths of outages on the curve.
const MEANS_S: [f64; 4] = [0.3, 0.5, 1.0, 2.0];

/// Loss rates that a search can aim at: below, hours of runs would hold no loss; above, the count
/// saturates.
const RATIO_MIN: f64 = 0.001;
const RATIO_MAX: f64 = 0.3;

/// Runs per rate that is tried, each of the loops the tables have.
const SEED_COUNT: usize = 6;
/// Rates tried at most.
const TRIES_MAX: usize = 7;
/// Highest rate tried, but for the share of time the outages would take up.
const PER_HOUR_MAX: f64 = 3000.0;
/// Highest share of time that outages take up in a try.
const DOWN_RATIO_MAX: f64 = 0.5;

/// How a loop is lost.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Mechanism {
    /// The session ends, and the next runs so many seconds later.
    TimeOut(f64),
    /// The session goes on; the arm holds.
    Hold,
}

const MECHANISMS: [Mechanism; 4] = [
    Mechanism::TimeOut(1.0),
    Mechanism::TimeOut(2.0),
    Mechanism::TimeOut(3.0),
    Mechanism::Hold,
];

impl Mechanism {
    fn apply(self, settings: &mut ControllerSettings) {
        match self {
            Self::TimeOut(reactivation_s) => back_after(settings, reactivation_s),
            Self::Hold => without_time_out(settings),
        }
    }

    fn text(self, settings: &ControllerSettings) -> String {
        match self {
            Self::TimeOut(reactivation_s) => format!(
                "CommTimeout {} s, back after {reactivation_s} s",
                settings.comm_timeout_s
            ),
            Self::Hold => "no time-out, pure hold".to_owned(),
        }
    }
}

/// The search.
#[derive(Debug)]
pub(crate) struct Calibration {
    ratio: f64,
    seed: u64,
    loops: u32,
    trajectory: Trajectory,
    base: Setup,
}

/// A point of a curve, or why there is none.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Point {
    found: Found,
    tries: usize,
    loop_count: u64,
}

#[derive(Debug, Clone, PartialEq)]
enum Found {
    /// Outages per hour with their interval, and what came out at that rate.
    Rate {
        per_hour: f64,
        interval: Option<(f64, f64)>,
        ratio: f64,
    },
    /// Up to this rate fewer loops are lost.
    NoneUpTo { per_hour: f64, ratio: f64 },
}

impl Calibration {
    /// The search for outages that make the motion loss rate `ratio` with the motion and the robot
    /// of `case`.
    ///
    /// # Errors
    /// When `ratio` is outside what a search can aim at, or the motion has no loops.
    pub(crate) fn new(case: &Teleoperation, ratio: f64) -> Result<Self, ParameterError> {
        let allowed = RATIO_MIN..=RATIO_MAX;
        ParameterError::check("mlr", ratio, allowed, "0.001..=0.3")?;
        let loops = case.parameters.tables.loops;
        Ok(Self {
            ratio,
            seed: case.seed,
            loops,
            trajectory: Trajectory::new(case, loops)?,
            base: base(case),
        })
    }

    fn setup(&self, task: usize) -> (Mechanism, f64, Setup) {
        let mechanism = MECHANISMS[task / MEANS_S.len()];
        let mean_s = MEANS_S[task % MEANS_S.len()];
        let setup = changed(&self.base, |setup| mechanism.apply(&mut setup.settings));
        (mechanism, mean_s, setup)
    }
}

/// One rate that was tried.
#[derive(Debug, Clone, Copy)]
struct Try {
    per_hour: f64,
    ratio: f64,
    half_width: f64,
}

/// A search under way: what it tries, and how far it has come.
struct Search<'a, 'w> {
    calibration: &'a Calibration,
    setup: Setup,
    mean_s: f64,
    watch: &'a mut (dyn FnMut(f64) -> bool + 'w),
    try_count: usize,
    loop_count: u64,
}

impl Search<'_, '_> {
    /// The loss rate at `per_hour`, over runs that are the same for every rate but for the times
    /// between outages. `None` when stopped.
    fn try_rate(&mut self, per_hour: f64) -> Option<Try> {
        let outages = Outages {
            mean_s: self.mean_s,
            per_hour,
            buffered: false,
        };
        self.setup.channel = Channel::Outages(outages);
        let mut ratios = [0.0; SEED_COUNT];
        for (replica, ratio) in ratios.iter_mut().enumerate() {
            let done = (self.try_count * SEED_COUNT + replica) as f64;
            let step = 1.0 / (TRIES_MAX * SEED_COUNT) as f64;
            let watch = &mut *self.watch;
            let mut look = |share: f64| watch((done + share) * step);
            let seed = seed_of(self.calibration.seed, replica);
            let tally = drive(&self.calibration.trajectory, &self.setup, seed, &mut look)?;
            *ratio = tally.loss_ratio();
            self.loop_count += tally.sent_count;
        }
        self.try_count += 1;
        let estimate = Estimate::of_mean(&ratios)?;
        Some(Try {
            per_hour,
            ratio: estimate.value,
            half_width: estimate
                .interval
                .map_or(f64::INFINITY, |(_, high)| high - estimate.value),
        })
    }

    fn run(&mut self) -> Option<Point> {
        let target = self.calibration.ratio;
        let highest = PER_HOUR_MAX.min(DOWN_RATIO_MAX * 3600.0 / self.mean_s);
        // One lost loop per outage is the most that short outages cost.
        let loops_per_hour = 3600.0 / (self.calibration.trajectory.counter.period_ns * 1e-9);
        let mut low: Option<Try> = None;
        let mut high: Option<Try> = None;
        let mut next = (2.0 * target * loops_per_hour).clamp(1.0, highest);
        let mut best: Option<Try> = None;
        while self.try_count < TRIES_MAX {
            let tried = self.try_rate(next)?;
            let is_nearer =
                |known: Try| (tried.ratio - target).abs() < (known.ratio - target).abs();
            if best.is_none_or(is_nearer) {
                best = Some(tried);
            }
            if tried.ratio < target {
                if tried.per_hour >= highest {
                    return Some(self.none_up_to(tried));
                }
                low = Some(tried);
            } else {
                high = Some(tried);
            }
            if (tried.ratio - target).abs() < 0.02 * target {
                break;
            }
            next = between(low, high, (target, highest));
        }
        let best = best?;
        if high.is_none() {
            return Some(self.none_up_to(best));
        }
        Some(self.rate(best, (low, high)))
    }

    fn none_up_to(&self, tried: Try) -> Point {
        self.point(Found::NoneUpTo {
            per_hour: tried.per_hour,
            ratio: tried.ratio,
        })
    }

    /// The rate by a straight line between the tries on both sides, and as far from it to either
    /// side as the scatter of the runs reaches along that line.
    fn rate(&self, best: Try, (low, high): (Option<Try>, Option<Try>)) -> Point {
        let target = self.calibration.ratio;
        let slope = match (low, high) {
            (Some(low), Some(high)) if high.ratio > low.ratio => {
                (high.ratio - low.ratio) / (high.per_hour - low.per_hour)
            }
            // Few loops are lost: their number grows as the rate does.
            _ => best.ratio / best.per_hour,
        };
        // Tries close to each other have little but noise between them.
        let slope = slope.clamp(
            0.5 * best.ratio / best.per_hour,
            4.0 * best.ratio / best.per_hour,
        );
        let per_hour = best.per_hour + (target - best.ratio) / slope;
        let reach = best.half_width / slope;
        self.point(Found::Rate {
            per_hour,
            interval: reach
                .is_finite()
                .then_some(((per_hour - reach).max(0.0), per_hour + reach)),
            ratio: best.ratio,
        })
    }

    fn point(&self, found: Found) -> Point {
        Point {
            found,
            tries: self.try_count,
            loop_count: self.loop_count,
        }
    }
}

/// The next rate to try: on the line between both sides in logarithms, kept off its ends; without
/// one side, four times as far.
fn between(low: Option<Try>, high: Option<Try>, (target, highest): (f64, f64)) -> f64 {
    match (low, high) {
        (Some(low), Some(high)) => {
            let log = |tried: Try| tried.ratio.max(1e-5).ln();
            let span = log(high) - log(low);
            let share = if span > 0.0 {
                (target.ln() - log(low)) / span
            } else {
                0.5
            };
            let share = share.clamp(0.1, 0.9);
            (low.per_hour.ln() * (1.0 - share) + high.per_hour.ln() * share).exp()
        }
        (Some(low), None) => (4.0 * low.per_hour).min(highest),
        (None, Some(high)) => 0.25 * high.per_hour,
        (None, None) => highest,
    }
}

impl Study for Calibration {
    type Outcome = Point;

    fn task_count(&self) -> usize {
        MECHANISMS.len() * MEANS_S.len()
    }

    fn label(&self, task: usize) -> String {
        let (mechanism, mean_s, setup) = self.setup(task);
        format!("{}, outages of {mean_s} s", mechanism.text(&setup.settings))
    }

    fn run(&self, task: usize, watch: Watch<'_>) -> Option<Point> {
        let (_, mean_s, setup) = self.setup(task);
        let mut search = Search {
            calibration: self,
            setup,
            mean_s,
            watch,
            try_count: 0,
            loop_count: 0,
        };
        search.run()
    }

    fn report(&self, outcomes: &[Option<&Point>]) -> StudyReport {
        let ended = outcomes.iter().flatten();
        let found = ended
            .clone()
            .filter(|point| matches!(point.found, Found::Rate { .. }))
            .count();
        let loops: f64 = ended.map(|point| point.loop_count as f64).sum();
        StudyReport {
            title: format!(
                "Case study 2: outages that make the motion loss rate {}, in virtual time",
                self.ratio
            ),
            notes: self.notes(),
            tables: vec![self.table(outcomes)],
            criteria: vec![Criterion {
                text: "at least one point of the curve exists".to_owned(),
                is_met: outcomes.iter().all(Option::is_some).then_some(found > 0),
                finding: format!("{found} of {} points have a rate", outcomes.len()),
            }],
            work: vec![Work {
                name: "motion loops",
                amount: loops,
            }],
        }
    }
}

const fn column(name: &'static str, label: &'static str) -> Column {
    Column { name, label }
}

const COLUMNS: [Column; 8] = [
    column("mechanism", "Mechanism"),
    column("outage_mean_s", "Mean outage (s)"),
    column("outages_per_hour", "Outages/h"),
    column("outages_per_hour_interval", "95 %"),
    column("down_ratio", "Time down"),
    column("mlr_tried", "MLR at the nearest try"),
    column("tries", "Rates tried"),
    column("remark", "Remark"),
];

impl Calibration {
    fn notes(&self) -> Vec<String> {
        vec![
            format!(
                "seed {}; each rate is tried in {SEED_COUNT} runs of {} loops that share their \
                 random numbers",
                self.seed, self.loops
            ),
            format!("a loop counts by {}", self.trajectory.counter.text()),
            "one loss rate fixes a curve, not a point: measure how long outages last on the real \
             link, then read off their rate"
                .to_owned(),
            "interval: from the scatter of the runs at the nearest try, along the line between \
             the tries; outages are exponential in length and in the time between them"
                .to_owned(),
        ]
    }

    fn table(&self, outcomes: &[Option<&Point>]) -> Table {
        let rows = outcomes.iter().enumerate();
        Table {
            name: "calibration".to_owned(),
            title: format!(
                "Outages per hour at which the motion loss rate is {}",
                self.ratio
            ),
            columns: COLUMNS.to_vec(),
            rows: rows.map(|(task, point)| self.row(task, *point)).collect(),
            notes: Vec::new(),
        }
    }

    fn row(&self, task: usize, point: Option<&Point>) -> Vec<Cell> {
        let (mechanism, mean_s, setup) = self.setup(task);
        let mut cells = vec![
            Cell::text(mechanism.text(&setup.settings)),
            Cell::number(Some(mean_s), 1),
        ];
        let (rate, interval, ratio, remark) = match point.map(|point| &point.found) {
            Some(Found::Rate {
                per_hour,
                interval,
                ratio,
            }) => (Some(*per_hour), *interval, Some(*ratio), String::new()),
            Some(Found::NoneUpTo { per_hour, ratio }) => (
                None,
                None,
                Some(*ratio),
                format!("none up to {per_hour:.0}/h"),
            ),
            None => (None, None, None, "not computed".to_owned()),
        };
        cells.extend([
            Cell::number(rate, 1),
            Cell::interval(interval, 1),
            Cell::number(rate.map(|per_hour| per_hour * mean_s / 3600.0), 4),
            Cell::number(ratio, 5),
            point.map_or(Cell::Absent, |point| Cell::Count(point.tries as u64)),
            Cell::Text(remark),
        ]);
        cells
    }
}
