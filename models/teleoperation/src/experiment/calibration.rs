//! Which outages make a given motion loss rate: for each mechanism a curve of rates over mean
//! lengths, because one figure fixes no point. `hil-runtime calibrate teleoperation` runs it.

use crate::Teleoperation;
use crate::experiment::conditions::{back_after, base, changed, without_time_out};
use crate::experiment::drive::{Channel, Setup, drive};
use crate::experiment::study::seed_of;
use crate::experiment::trajectory::Trajectory;
use hil_arm::egm::parameters::ControllerSettings;
use hil_core::case_study::ParameterError;
use hil_core::study::{Cell, Column, Criterion, Study, StudyReport, Table, Watch};
use hil_link::outages::Outages;
use hil_stats::comparison::mean_interval;
use hil_stats::statistics::CONFIDENCE;

/// Mean lengths of outages on the curve.
const MEANS_S: [f64; 4] = [0.3, 0.5, 1.0, 2.0];

/// Loss rates that a search can aim at: below, hours of runs would hold no loss; above, the count
/// saturates.
const RATIO_MIN: f64 = 0.001;
const RATIO_MAX: f64 = 0.3;

/// Rates tried at most.
const TRIES_MAX: usize = 5;
/// A try this near to the aim ends the search: the count of lost loops scatters more than that.
const NEAR_RATIO: f64 = 0.05;
/// A nearest try farther than this from the aim is said to be far.
const FAR_RATIO: f64 = 1.0 / 3.0;
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
    /// Runs per rate that is tried, each of these loops.
    seeds: u32,
    trajectory: Trajectory,
    base: Setup,
}

/// A point of a curve, or why there is none.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Point {
    found: Found,
    tries: usize,
}

#[derive(Debug, Clone, PartialEq)]
enum Found {
    /// Outages per hour with their interval, if the runs show one, and what came out at that rate.
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
        ParameterError::check("mlr", ratio, allowed, "0.001 to 0.3")?;
        let loops = case.parameters.tables.loops;
        Ok(Self {
            ratio,
            seed: case.seed,
            loops,
            seeds: case.parameters.tables.seeds,
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
#[derive(Debug, Clone)]
struct Try {
    per_hour: f64,
    missing_count: u64,
    sent_count: u64,
    /// The share lost of each run.
    run_ratios: Vec<f64>,
}

impl Try {
    fn ratio(&self) -> f64 {
        self.missing_count as f64 / self.sent_count as f64
    }
}

/// A search under way: what it tries, and how far it has come.
struct Search<'a, 'w> {
    calibration: &'a Calibration,
    setup: Setup,
    mean_s: f64,
    watch: &'a mut (dyn FnMut(f64) -> bool + 'w),
    tries: Vec<Try>,
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
        let mut tried = Try {
            per_hour,
            missing_count: 0,
            sent_count: 0,
            run_ratios: Vec::new(),
        };
        let seeds = self.calibration.seeds as usize;
        for replica in 0..seeds {
            let done = (self.tries.len() * seeds + replica) as f64;
            let step = 1.0 / (TRIES_MAX * seeds) as f64;
            let watch = &mut *self.watch;
            let mut look = |share: f64| watch((done + share) * step);
            let seed = seed_of(self.calibration.seed, replica);
            let tally = drive(&self.calibration.trajectory, &self.setup, seed, &mut look)?;
            tried.missing_count += tally.missing_count();
            tried.sent_count += tally.sent_count;
            tried.run_ratios.push(tally.loss_ratio());
        }
        self.tries.push(tried.clone());
        Some(tried)
    }

    fn run(&mut self) -> Option<Point> {
        let target = self.calibration.ratio;
        let highest = PER_HOUR_MAX.min(DOWN_RATIO_MAX * 3600.0 / self.mean_s);
        // One lost loop per outage is the most that short outages cost.
        let loops_per_hour = 3600.0 / (self.calibration.trajectory.counter.period_ns * 1e-9);
        let mut next = (2.0 * target * loops_per_hour).clamp(1.0, highest);
        let (mut low, mut high) = (None, None);
        while self.tries.len() < TRIES_MAX {
            let tried = self.try_rate(next)?;
            if tried.ratio() < target {
                if tried.per_hour >= highest {
                    return Some(self.none_up_to(&tried));
                }
                low = Some(tried.clone());
            } else {
                high = Some(tried.clone());
            }
            if (tried.ratio() - target).abs() < NEAR_RATIO * target {
                break;
            }
            next = between(low.as_ref(), high.as_ref(), target, highest);
        }
        let nearest = |a: &&Try, b: &&Try| {
            let apart = |tried: &Try| (tried.ratio() - target).abs();
            apart(a).total_cmp(&apart(b))
        };
        let best = self.tries.iter().min_by(nearest)?;
        // A search that only climbed, and is still far below, has not found its rate.
        if high.is_none() && best.ratio() < 0.5 * target {
            return Some(self.none_up_to(best));
        }
        Some(self.rate(best))
    }

    fn none_up_to(&self, tried: &Try) -> Point {
        self.point(Found::NoneUpTo {
            per_hour: tried.per_hour,
            ratio: tried.ratio(),
        })
    }

    /// The rate at which a power law through all tries meets the aim. Its interval is Student's of the runs' shares at
    /// the nearest try, carried over by the same law: loops are lost together, runs are independent. `None` of one run, and
    /// where it reaches to no loss at all, which no rate would make.
    fn rate(&self, best: &Try) -> Point {
        let (exponent, at_one) = power_law(&self.tries);
        let per_hour = ((self.calibration.ratio.ln() - at_one) / exponent).exp();
        let lost = mean_interval(&best.run_ratios, CONFIDENCE).filter(|lost| lost.low > 0.0);
        // Fewer lost than the true mean: the true rate for the aim is lower, and the other way.
        let end = |bound: f64| per_hour * (best.ratio() / bound).powf(1.0 / exponent);
        self.point(Found::Rate {
            per_hour,
            interval: lost.map(|lost| (end(lost.high), end(lost.low))),
            ratio: best.ratio(),
        })
    }

    fn point(&self, found: Found) -> Point {
        Point {
            found,
            tries: self.tries.len(),
        }
    }
}

/// Exponents of a loss rate over a rate of outages: 1 while each outage stands alone, more where
/// several must come together.
const EXPONENTS: (f64, f64) = (0.8, 3.0);

/// Exponent, and logarithm of the ratio at one outage an hour, of the power law through `tries`:
/// least squares of logarithms, each try weighted by its count.
fn power_law(tries: &[Try]) -> (f64, f64) {
    let points = tries.iter().filter(|tried| tried.missing_count > 0);
    let points = points.map(|tried| {
        let weight = tried.missing_count as f64;
        (weight, tried.per_hour.ln(), tried.ratio().ln())
    });
    let (mut weights, mut x_mean, mut y_mean, mut square, mut product) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (weight, x, y) in points {
        weights += weight;
        let (x_off, y_off) = (x - x_mean, y - y_mean);
        x_mean += x_off * weight / weights;
        y_mean += y_off * weight / weights;
        square += weight * x_off * (x - x_mean);
        product += weight * x_off * (y - y_mean);
    }
    let exponent = if square > 0.0 { product / square } else { 1.0 };
    let exponent = exponent.clamp(EXPONENTS.0, EXPONENTS.1);
    (exponent, y_mean - exponent * x_mean)
}

/// The next rate to try: on the line between both sides in logarithms, kept off its ends; without
/// one side, four times as far.
fn between(low: Option<&Try>, high: Option<&Try>, target: f64, highest: f64) -> f64 {
    match (low, high) {
        (Some(low), Some(high)) => {
            let log = |tried: &Try| tried.ratio().max(1e-5).ln();
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
            tries: Vec::with_capacity(TRIES_MAX),
        };
        search.run()
    }

    fn report(&self, outcomes: &[Option<&Point>]) -> StudyReport {
        let ended = outcomes.iter().flatten();
        let found = ended
            .filter(|point| matches!(point.found, Found::Rate { .. }))
            .count();
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
                is_judged: true,
                finding: format!("{found} of {} points have a rate", outcomes.len()),
            }],
            ..StudyReport::default()
        }
    }
}

const COLUMNS: [Column; 8] = [
    Column::new("mechanism", "Mechanism"),
    Column::new("outage_mean_s", "Mean (s)"),
    Column::new("outages_per_hour", "Outages/h"),
    Column::new("outages_per_hour_interval", "95 %"),
    Column::new("down_ratio", "Time down"),
    Column::new("mlr_tried", "MLR tried"),
    Column::new("tries", "Tries"),
    Column::new("remark", "Remark"),
];

impl Calibration {
    fn notes(&self) -> Vec<String> {
        vec![
            format!(
                "seed {}; each rate is tried in {} runs of {} loops that share their random numbers",
                self.seed, self.seeds, self.loops
            ),
            format!("a loop counts by {}", self.trajectory.counter.text()),
            "one loss rate fixes a curve, not a point: measure how long outages last on the real \
             link, then read off their rate"
                .to_owned(),
            "the rate is where a power law through all tries meets the aim; interval: Student's of the \
             runs' shares at the nearest try, carried over by that law, whose own error is not in it; outages \
             are exponential in length and in the time between them"
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
            ..Table::default()
        }
    }

    /// What a rate rests on when no try came near the aim.
    fn remark(&self, tried: f64) -> String {
        if (tried - self.ratio).abs() > FAR_RATIO * self.ratio {
            format!("interpolated, nearest try {tried:.4}")
        } else {
            String::new()
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
            }) => (
                Some(*per_hour),
                *interval,
                Some(*ratio),
                self.remark(*ratio),
            ),
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
