//! Which tick of its producer each record of a trace belongs to, from the instants alone; and which
//! ticks have no record because the process that should have published was held up. The messages offered to
//! a replay have theirs from [`super::replay_offers`].
//!
//! A producer's timer stands on an absolute grid (`time::PeriodicTimer`): its messages leave late, never
//! early, and a late one moves none after it. So the grid is the lower edge of the instants. It is found
//! in the first well-filled stretch and then followed block by block in both directions, each block
//! correcting phase and period a little: an error of the period does not add up, however long the
//! trace is. What is promised, and what no instant can tell, is said in `docs/traces.md`.

use super::TraceRecord;

/// Fewest records with a period.
const RECORDS_MIN: usize = 16;
/// Records of the stretch that the period is searched in.
const SEARCHED_COUNT: usize = 2_048;
/// How far from the middle step the period is searched.
const SEARCH_RATIO: f64 = 0.02;
/// Mean resultant length (Mardia and Jupp 2000, section 2.3.1) below which there is no period.
const CONCENTRATION_MIN: f64 = 0.5;
/// Records that correct the grid together.
const BLOCK_COUNT: usize = 256;
/// Of a block's instants in their period, the one that stands for the grid: the earlier tenth, as what
/// is later is lateness.
const EDGE_RATIO: f64 = 0.1;
/// By how much of a period a block may correct the phase, so that one of nothing but late messages
/// does not carry the grid away.
const CORRECTION_MAX: f64 = 0.05;
/// Blocks that the grid is drawn through; older ones are forgotten bit by bit.
const MEMORY_BLOCKS: f64 = 64.0;
/// Most of a period by which an instant may lie before the grid; the rest is lateness.
pub(super) const EARLY_RATIO: f64 = 0.125;
/// And least, where the grid is sharp.
const EARLY_MIN_RATIO: f64 = 0.01;
/// Of all latenesses, the one that says how sharp it is: fewer messages are late by almost a period.
const SHARPNESS_RATIO: f64 = 0.02;
/// So many times that is allowed for.
const SHARPNESS_FACTOR: f64 = 4.0;
/// The same while the grid is known by its middle phase only.
const EARLY_OF_MIDDLE_RATIO: f64 = 0.25;
/// How far back a message that left in a later period is looked for a tick without one: as many as a
/// producer that was held up may find waiting and publish at once.
const LATE_TICKS_MAX: usize = 256;
/// Most ticks from the first record to the last: at 1 kHz seven weeks, and whole numbers to spare in
/// every sum.
const TICKS_MAX: i64 = 1 << 32;

/// A producer's ticks.
#[derive(Debug, Clone)]
pub(super) struct Ticks {
    /// Middle period of the whole trace.
    pub(super) period_ns: f64,
    /// The tick of each record, counted from the first record's; ascending.
    ticks: Vec<u64>,
}

/// Instants of a grid: that of tick n is `phase_ns + n * period_ns`.
#[derive(Debug, Clone, Copy)]
struct Grid {
    phase_ns: f64,
    period_ns: f64,
}

impl Grid {
    /// Where `at_ns` lies, in periods.
    fn place(&self, at_ns: f64) -> f64 {
        (at_ns - self.phase_ns) / self.period_ns
    }

    /// Its tick, and how late it is in periods, from -`early` to 1 - `early`.
    fn tick(&self, at_ns: f64, early: f64) -> (i64, f64) {
        let place = self.place(at_ns);
        let tick = (place + early).floor();
        (whole(tick), place - tick)
    }

    /// The early edge of the lateness of `instants`, in periods.
    fn edge(&self, instants: &[f64], early: f64) -> f64 {
        let lateness = instants.iter().map(|at| self.tick(*at, early).1);
        quantile(lateness.collect(), EDGE_RATIO)
    }
}

/// The one of `values`, of which there are some, that a share of `ratio` lies below.
fn quantile(mut values: Vec<f64>, ratio: f64) -> f64 {
    let rank = whole(ratio * values.len() as f64);
    let rank = usize::try_from(rank).unwrap_or(0).min(values.len() - 1);
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// A whole number as one.
#[allow(
    clippy::cast_possible_truncation,
    reason = "ticks are far below 2^63, and the cast saturates"
)]
pub(super) fn whole(x: f64) -> i64 {
    x as i64
}

/// The first stretch of `count` instants that is at most half empty, else the fullest.
fn stretch(instants: &[f64], count: usize, middle_ns: f64) -> usize {
    let windows = instants.windows(count.min(instants.len()));
    let span = |window: &[f64]| window[window.len() - 1] - window[0];
    let filled_ns = 2.0 * count as f64 * middle_ns;
    let mut fullest = (f64::INFINITY, 0);
    for (start, window) in windows.enumerate() {
        let span_ns = span(window);
        if span_ns <= filled_ns {
            return start;
        }
        if span_ns < fullest.0 {
            fullest = (span_ns, start);
        }
    }
    fullest.1
}

/// The grid of largest concentration, its phase at the middle of the instants.
fn grid_of(searched: &[f64], middle_ns: f64) -> Option<Grid> {
    let origin = *searched.first()?;
    let span = searched.last()? - origin;
    let resultant = |period: f64| {
        let turn = core::f64::consts::TAU / period;
        let sum = searched.iter().fold((0.0, 0.0), |(x, y), at| {
            let (sine, cosine) = (turn * (at - origin)).sin_cos();
            (x + cosine, y + sine)
        });
        let n = searched.len() as f64;
        (sum.0.hypot(sum.1) / n, sum.1.atan2(sum.0))
    };
    // A peak is as wide as one turn over the whole span; eight steps cannot miss it.
    let mut step = (middle_ns * middle_ns / span / 8.0).max(middle_ns * 1e-6);
    let (mut best, mut from, mut upto) = (
        (0.0, middle_ns),
        middle_ns * (1.0 - SEARCH_RATIO),
        middle_ns * (1.0 + SEARCH_RATIO),
    );
    for _ in 0..6 {
        let mut period = from;
        while period <= upto {
            let (length, _) = resultant(period);
            if length > best.0 {
                best = (length, period);
            }
            period += step;
        }
        (from, upto) = (best.1 - step, best.1 + step);
        step /= 8.0;
    }
    if best.0 < CONCENTRATION_MIN {
        return None;
    }
    let (_, angle) = resultant(best.1);
    Some(Grid {
        phase_ns: origin + angle / core::f64::consts::TAU * best.1,
        period_ns: best.1,
    })
}

/// The grid as it is followed: a straight line through the early edges of the blocks seen, weighted,
/// as a difference from the grid that it began with.
#[derive(Debug, Clone)]
struct Tracker {
    began: Grid,
    /// The tick that sums count from: the newest block's.
    origin: f64,
    /// Sums of weight, weight x, weight x², weight d, weight x d.
    sums: [f64; 5],
}

impl Tracker {
    fn new(began: Grid) -> Self {
        Self {
            began,
            origin: 0.0,
            sums: [0.0; 5],
        }
    }

    /// The grid by all blocks seen.
    fn grid(&self) -> Grid {
        let [w, wx, wxx, wd, wxd] = self.sums;
        if w <= 0.0 {
            return self.began;
        }
        let spread = w * wxx - wx * wx;
        // One block tells a phase and no period.
        let slope = if spread > 1e-9 * w * w {
            (w * wxd - wx * wd) / spread
        } else {
            0.0
        };
        let offset = (wd - slope * wx) / w;
        Grid {
            phase_ns: self.began.phase_ns + offset - slope * self.origin,
            period_ns: self.began.period_ns + slope,
        }
    }

    /// Corrects the grid by `block`, which `grid` was foretold for.
    fn correct(&mut self, block: &[f64], grid: Grid) {
        let edge = grid.edge(block, EARLY_RATIO);
        let correction = edge.clamp(-CORRECTION_MAX, CORRECTION_MAX);
        let middle = grid.tick(block[block.len() / 2], EARLY_RATIO).0 as f64;
        let at_ns = grid.phase_ns + (middle + correction) * grid.period_ns;
        let difference = at_ns - (self.began.phase_ns + middle * self.began.period_ns);
        let weight = block.len() as f64 / BLOCK_COUNT as f64;
        let shift = middle - self.origin;
        let kept = 1.0 - weight / MEMORY_BLOCKS;
        let [w, wx, wxx, wd, wxd] = self.sums.map(|sum| kept * sum);
        self.sums = [
            w + weight,
            wx - shift * w,
            wxx - 2.0 * shift * wx + shift * shift * w,
            wd + weight * difference,
            wxd - shift * wd,
        ];
        self.origin = middle;
    }

    /// Corrects the grid by `block` and puts its instants' ticks on the corrected one, with their
    /// latenesses, into `found`.
    fn follow(&mut self, block: &[f64], found: &mut [(i64, f64)]) {
        let foretold = self.grid();
        self.correct(block, foretold);
        let grid = self.grid();
        for (at, found) in block.iter().zip(found) {
            *found = grid.tick(*at, EARLY_RATIO);
        }
    }
}

/// The tick of each of `instants`, from an unknown first one; `None` when they have no period.
fn ticks_of(instants: &[f64], middle_ns: f64) -> Option<Vec<i64>> {
    let start = stretch(instants, SEARCHED_COUNT, middle_ns);
    let end = (start + SEARCHED_COUNT).min(instants.len());
    let searched = &instants[start..end];
    let mut grid = grid_of(searched, middle_ns)?;
    grid.phase_ns += grid.edge(searched, EARLY_OF_MIDDLE_RATIO) * grid.period_ns;
    let mut tracker = Tracker::new(grid);
    for block in searched.chunks(BLOCK_COUNT) {
        tracker.correct(block, grid);
    }
    let mut found = vec![(0, 0.0); instants.len()];
    // What lies before the stretch is followed backwards from it.
    let mut backwards = tracker.clone();
    let before = instants[..start].rchunks(BLOCK_COUNT);
    for (block, found) in before.zip(found[..start].rchunks_mut(BLOCK_COUNT)) {
        backwards.follow(block, found);
    }
    let after = instants[start..].chunks(BLOCK_COUNT);
    for (block, found) in after.zip(found[start..].chunks_mut(BLOCK_COUNT)) {
        tracker.follow(block, found);
    }
    // All along, not only where it was searched, there must be a period.
    let turns = found.iter().fold((0.0, 0.0), |(x, y), (_, lateness)| {
        let (sine, cosine) = (core::f64::consts::TAU * lateness).sin_cos();
        (x + cosine, y + sine)
    });
    if turns.0.hypot(turns.1) < CONCENTRATION_MIN * found.len() as f64 {
        return None;
    }
    // Nothing leaves before its tick but by the error of the grid: what is earlier is very late.
    let sharpness = quantile(found.iter().map(|one| one.1).collect(), SHARPNESS_RATIO);
    let early = (-SHARPNESS_FACTOR * sharpness).clamp(EARLY_MIN_RATIO, EARLY_RATIO);
    let ticks = found.into_iter();
    let ticks = ticks.map(|(tick, lateness)| tick - i64::from(lateness < -early));
    Some(ticks.collect())
}

/// Of two messages in one period the earlier is a late one: it takes the last tick before that has
/// none, if there is one not far off; what is between moves with it.
pub(super) fn sort_out(ticks: &mut [i64]) {
    for index in 1..ticks.len() {
        if ticks[index] > ticks[index - 1] {
            continue;
        }
        ticks[index] = ticks[index - 1];
        let mut moved = index - 1;
        while moved > 0 && index - moved < LATE_TICKS_MAX && ticks[moved] - ticks[moved - 1] == 1 {
            moved -= 1;
        }
        if moved == 0 || ticks[moved] - ticks[moved - 1] > 1 {
            for tick in &mut ticks[moved..index] {
                *tick -= 1;
            }
        }
    }
}

/// The period of the straight line through `instants` over their ticks; `None` for a single tick.
fn middle_period(instants: &[f64], ticks: &[u64]) -> Option<f64> {
    let n = instants.len() as f64;
    let centre = ticks.iter().map(|tick| *tick as f64).sum::<f64>() / n;
    let middle_ns = instants.iter().sum::<f64>() / n;
    let pairs = instants.iter().zip(ticks);
    let (above, below) = pairs.fold((0.0, 0.0), |(above, below), (at, tick)| {
        let x = *tick as f64 - centre;
        (above + x * (at - middle_ns), below + x * x)
    });
    let period_ns = above / below;
    (period_ns.is_finite() && period_ns > 0.0).then_some(period_ns)
}

impl Ticks {
    /// The ticks of `records`; `None` when their instants have no period, or the producer was
    /// started anew, which begins another grid.
    pub(super) fn of(records: &[TraceRecord], middle_ns: i64) -> Option<Self> {
        let is_restarted = records.iter().any(|record| record.start > 0);
        if records.len() < RECORDS_MIN || middle_ns <= 0 || is_restarted {
            return None;
        }
        let first_ns = records[0].published_ns;
        let since_first =
            |record: &TraceRecord| record.published_ns.saturating_sub(first_ns) as f64;
        let instants: Vec<f64> = records.iter().map(since_first).collect();
        let span_ns = instants[instants.len() - 1];
        if span_ns <= 0.0 || span_ns / middle_ns as f64 > TICKS_MAX as f64 {
            return None;
        }
        let mut ticks = ticks_of(&instants, middle_ns as f64)?;
        sort_out(&mut ticks);
        let first = ticks[0];
        let counted = ticks.iter().map(|tick| u64::try_from(tick - first).ok());
        let ticks: Vec<u64> = counted.collect::<Option<_>>()?;
        let period_ns = middle_period(&instants, &ticks)?;
        Some(Self { period_ns, ticks })
    }

    /// Ticks from the first to the last record.
    pub(super) fn count(&self) -> u64 {
        self.ticks.last().map_or(0, |last| last + 1)
    }

    /// The place of the record of `tick`; `None` when nobody published at it.
    pub(super) fn record_of(&self, tick: u64) -> Option<usize> {
        let place = self.ticks.partition_point(|before| *before < tick);
        (self.ticks.get(place) == Some(&tick)).then_some(place)
    }
}

#[cfg(test)]
#[path = "replay_ticks_tests.rs"]
mod tests;
