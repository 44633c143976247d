//! What the intervals cover: many runs of series whose truth is known, of every kind of dependence that a network
//! makes. Each row is a kind, each column a method: that of this crate, which prints an interval only where its tests
//! accept the run, and beside it, on all runs, independence (Wilson 1927), 30 batch means (Schmeiser 1982)
//! and the initial positive sequence (Geyer 1992).
//!
//! The short form runs with the tests. The long one makes the table of `docs/intervals.md`:
//!
//! ```sh
//! cargo test --release -p hil-stats --test coverage -- --ignored --nocapture
//! ```

use core::f64::consts::TAU;

use hil_core::interval::{Interval, IntervalMethod, Spread};
use hil_core::random::RandomStream;
use hil_stats::dependence::{Batches, Quantiles};
use hil_stats::samples::Samples;
use hil_stats::special::{
    ceil_count, invert, normal_distribution, normal_quantile, place_of, student_quantile,
};
use hil_stats::statistics::clopper_pearson;
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;

/// Ten minutes at 100 Hz.
const MESSAGES: usize = 60_000;
const HZ: f64 = 100.0;

/// Loops of a run of the second case study.
const LOOPS: usize = 400;

/// Accepted runs of which the coverage of a row can be shown.
const ACCEPTED_MIN: u64 = 400;

/// Coverage that the lower end of its own interval must reach.
const COVERAGE_MIN: f64 = 0.93;

/// First-order autoregressive, unit variance, whose correlation falls to 1/e in `memory_s`.
fn fading(memory_s: f64, random: &mut RandomStream) -> Vec<f64> {
    let phi = (-1.0 / (HZ * memory_s)).exp();
    let (mut state, step) = (random.normal(), (1.0 - phi * phi).sqrt());
    (0..MESSAGES)
        .map(|_| {
            state = phi * state + step * random.normal();
            state
        })
        .collect()
}

/// Fractional Gaussian noise (Davies and Harte 1987).
fn fractional(hurst: f64, random: &mut RandomStream) -> Vec<f64> {
    let n = 65_536;
    let covariance = |lag: usize| {
        let power = |lag: f64| lag.abs().powf(2.0 * hurst);
        let lag = lag as f64;
        0.5 * (power(lag - 1.0) - 2.0 * power(lag) + power(lag + 1.0))
    };
    let mut row: Vec<Complex<f64>> = (0..2 * n)
        .map(|place: usize| Complex::new(covariance(place.min(2 * n - place)), 0.0))
        .collect();
    let transform = FftPlanner::new().plan_fft_forward(2 * n);
    transform.process(&mut row);
    let mut noise: Vec<_> = row
        .iter()
        .map(|value| {
            let scale = (value.re.max(0.0) / (2 * n) as f64).sqrt();
            Complex::new(scale * random.normal(), scale * random.normal())
        })
        .collect();
    transform.process(&mut noise);
    noise[..MESSAGES].iter().map(|value| value.re).collect()
}

/// Bad and good spells in turn, from a random place on; lengths in messages.
fn spells(
    bad: &mut dyn FnMut(&mut RandomStream) -> f64,
    good_mean: f64,
    random: &mut RandomStream,
) -> Vec<bool> {
    let exponential = |mean: f64, random: &mut RandomStream| -mean * (1.0 - random.uniform()).ln();
    let mut series = Vec::with_capacity(MESSAGES);
    let burn_in = 20.0 * good_mean * random.uniform();
    let (mut at, mut is_bad) = (-5.0 * good_mean - burn_in, true);
    while series.len() < MESSAGES {
        let length = if is_bad {
            bad(random)
        } else {
            exponential(good_mean, random)
        };
        at += length;
        while (series.len() as f64) < at && series.len() < MESSAGES {
            series.push(is_bad);
        }
        is_bad = !is_bad;
    }
    series
}

fn bursts(mean: f64, good_mean: f64, random: &mut RandomStream) -> Vec<bool> {
    spells(
        &mut |random| -mean * (1.0 - random.uniform()).ln(),
        good_mean,
        random,
    )
}

fn drawn(mut chance: impl FnMut(f64) -> f64, random: &mut RandomStream) -> Vec<bool> {
    (0..MESSAGES)
        .map(|index| {
            let chance = chance(index as f64 / HZ);
            random.chance(chance)
        })
        .collect()
}

fn wave(period_s: f64, phase: f64) -> impl Fn(f64) -> f64 {
    move |time_s| (TAU * (time_s / period_s + phase)).sin()
}

/// Motion loops of 4.033 s that are lost when an outage takes a quarter of one or more.
fn loops(count: usize, outage_s: f64, apart_s: f64, random: &mut RandomStream) -> Vec<bool> {
    const LOOP_S: f64 = 4.033;
    let mut lost = vec![false; count];
    let mut exponential = |mean: f64| -mean * (1.0 - random.uniform()).ln();
    let mut at_s = exponential(apart_s);
    while at_s < count as f64 * LOOP_S {
        let until_s = at_s + exponential(outage_s);
        for (index, lost) in lost
            .iter_mut()
            .enumerate()
            .skip(ceil_count((at_s / LOOP_S).floor()))
        {
            let from_s = index as f64 * LOOP_S;
            if from_s >= until_s {
                break;
            }
            let taken_s = until_s.min(from_s + LOOP_S) - at_s.max(from_s);
            *lost |= taken_s >= 0.25 * LOOP_S;
        }
        at_s = until_s + exponential(apart_s);
    }
    lost
}

type Losses = fn(&mut RandomStream) -> Vec<bool>;

/// Kind, what it is called, whether nine of ten runs must be accepted, its share of losses, a run of it.
struct LossKind {
    kind: &'static str,
    name: &'static str,
    is_usual: bool,
    share: Option<f64>,
    run: Losses,
}

/// Kinds that the tests of the data do not tell from those that are covered: their rows are shown and not judged.
const LIMITS: [&str; 4] = [
    "rate varies, 10 s",
    "Pareto bursts, 1.5",
    "H 0.8",
    "H 0.9 in noise",
];

const fn losses(
    kind: &'static str,
    name: &'static str,
    is_usual: bool,
    share: Option<f64>,
    run: Losses,
) -> LossKind {
    LossKind {
        kind,
        name,
        is_usual,
        share,
        run,
    }
}

const LOSSES: [LossKind; 22] = [
    losses("independent", "0.1 %", true, Some(0.001), |r| {
        drawn(|_| 0.001, r)
    }),
    losses("independent", "1 %", true, Some(0.01), |r| {
        drawn(|_| 0.01, r)
    }),
    losses("independent", "20 %", true, Some(0.2), |r| {
        drawn(|_| 0.2, r)
    }),
    losses("bursty", "0.05 s, 0.5 %", true, Some(0.005), |r| {
        bursts(5.0, 995.0, r)
    }),
    losses("bursty", "0.1 s, 1 %", true, Some(0.01), |r| {
        bursts(10.0, 990.0, r)
    }),
    losses("bursty", "0.1 s, 5 %", true, Some(0.05), |r| {
        bursts(10.0, 190.0, r)
    }),
    losses("bursty", "0.1 s, 10 a run", false, Some(1.0 / 600.0), |r| {
        bursts(10.0, 5_990.0, r)
    }),
    losses("bursty", "0.2 s, 20 a run", false, Some(1.0 / 150.0), |r| {
        bursts(20.0, 2_980.0, r)
    }),
    losses("bursty", "0.5 s, 60 a run", false, Some(0.05), |r| {
        bursts(50.0, 950.0, r)
    }),
    losses("bursty", "2 s, 30 a run", false, Some(0.1), |r| {
        bursts(200.0, 1_800.0, r)
    }),
    losses("bursty", "5 s, 30 a run", false, Some(0.25), |r| {
        bursts(500.0, 1_500.0, r)
    }),
    losses("bursty", "20 s, 12 a run", false, Some(0.4), |r| {
        bursts(2_000.0, 3_000.0, r)
    }),
    losses("memory", "rate varies, 1 s", true, Some(0.02), |r| {
        let level = fading(1.0, r);
        drawn(
            |s| 0.02 * (level[ceil_count((s * HZ).round())] - 0.5).exp(),
            r,
        )
    }),
    losses("memory", "rate varies, 10 s", false, Some(0.02), |r| {
        let level = fading(10.0, r);
        drawn(
            |s| 0.02 * (level[ceil_count((s * HZ).round())] - 0.5).exp(),
            r,
        )
    }),
    losses(
        "long memory",
        "rate varies, H 0.8",
        false,
        Some(0.02),
        |r| {
            let level = fractional(0.8, r);
            drawn(
                |s| 0.02 * (level[ceil_count((s * HZ).round())] - 0.5).exp(),
                r,
            )
        },
    ),
    losses(
        "long memory",
        "Pareto bursts, 1.5",
        false,
        Some(10.0 / 500.0),
        |r| {
            let pareto =
                &mut |r: &mut RandomStream| 10.0 / 3.0 * (1.0 - r.uniform()).powf(-1.0 / 1.5);
            spells(pareto, 490.0, r)
        },
    ),
    losses("periodic", "rate, 1 s", false, Some(0.02), |r| {
        let wave = wave(1.0, r.uniform());
        drawn(|s| 0.02 * (1.0 + wave(s)), r)
    }),
    losses("periodic", "rate, 60 s", false, Some(0.02), |r| {
        let wave = wave(60.0, r.uniform());
        drawn(|s| 0.02 * (1.0 + wave(s)), r)
    }),
    losses("periodic", "0.5 s out of 10 s", false, Some(0.05), |r| {
        let phase = r.uniform();
        drawn(
            |s| {
                if (s / 10.0 + phase).fract() < 0.05 {
                    1.0
                } else {
                    0.0
                }
            },
            r,
        )
    }),
    losses("drifting", "rate from 0 to 4 %", false, Some(0.02), |r| {
        drawn(|s| 0.04 * s / 600.0, r)
    }),
    losses("motion loops", "outages of 5 s", false, None, |r| {
        loops(LOOPS, 5.0, 60.0, r)
    }),
    losses("motion loops", "outages of 20 s", false, None, |r| {
        loops(LOOPS, 20.0, 180.0, r)
    }),
];

type Delays = fn(&mut RandomStream) -> Vec<f64>;

/// A law of delays: equally likely means, and the deviation about them; see [`LossKind`].
struct DelayKind {
    kind: &'static str,
    name: &'static str,
    is_usual: bool,
    means: fn() -> Vec<f64>,
    deviation: f64,
    run: Delays,
}

const fn delays(
    kind: &'static str,
    name: &'static str,
    is_usual: bool,
    means: fn() -> Vec<f64>,
    deviation: f64,
    run: Delays,
) -> DelayKind {
    DelayKind {
        kind,
        name,
        is_usual,
        means,
        deviation,
        run,
    }
}

fn plus(mut series: Vec<f64>, mut more: impl FnMut(f64) -> f64) -> Vec<f64> {
    for (index, value) in series.iter_mut().enumerate() {
        *value += more(index as f64 / HZ);
    }
    series
}

fn white(random: &mut RandomStream) -> Vec<f64> {
    (0..MESSAGES).map(|_| random.normal()).collect()
}

const GRID: i32 = 2_000;

fn along(of: impl Fn(f64) -> f64) -> Vec<f64> {
    (0..GRID)
        .map(|place| of((f64::from(place) + 0.5) / f64::from(GRID)))
        .collect()
}

const DELAYS: [DelayKind; 14] = [
    delays("independent", "", true, || vec![0.0], 1.0, white),
    delays(
        "bursty",
        "spikes of 0.1 s",
        true,
        || along(|at| if at < 0.02 { 8.0 } else { 0.0 }),
        1.0,
        |r| {
            let spikes = bursts(10.0, 490.0, r);
            plus(white(r), |s| {
                if spikes[ceil_count((s * HZ).round())] {
                    8.0
                } else {
                    0.0
                }
            })
        },
    ),
    delays(
        "memory",
        "0.1 s",
        true,
        || vec![0.0],
        1.0,
        |r| fading(0.1, r),
    ),
    delays("memory", "1 s", true, || vec![0.0], 1.0, |r| fading(1.0, r)),
    delays(
        "memory",
        "2 s",
        false,
        || vec![0.0],
        1.0,
        |r| fading(2.0, r),
    ),
    delays(
        "memory",
        "5 s",
        false,
        || vec![0.0],
        1.0,
        |r| fading(5.0, r),
    ),
    delays(
        "memory",
        "20 s",
        false,
        || vec![0.0],
        1.0,
        |r| fading(20.0, r),
    ),
    delays(
        "long memory",
        "H 0.7",
        false,
        || vec![0.0],
        1.0,
        |r| fractional(0.7, r),
    ),
    delays(
        "long memory",
        "H 0.8",
        false,
        || vec![0.0],
        1.0,
        |r| fractional(0.8, r),
    ),
    delays(
        "long memory",
        "H 0.9",
        false,
        || vec![0.0],
        1.0,
        |r| fractional(0.9, r),
    ),
    delays(
        "long memory",
        "H 0.9 in noise",
        false,
        || vec![0.0],
        1.0,
        |r| {
            let slow = fractional(0.9, r);
            white(r)
                .into_iter()
                .zip(slow)
                .map(|(fast, slow)| 0.8 * fast + 0.6 * slow)
                .collect()
        },
    ),
    delays(
        "periodic",
        "1 s",
        false,
        || along(|at| (TAU * at).sin()),
        0.5,
        |r| {
            let wave = wave(1.0, r.uniform());
            plus(white(r).into_iter().map(|one| 0.5 * one).collect(), wave)
        },
    ),
    delays(
        "periodic",
        "60 s",
        false,
        || along(|at| (TAU * at).sin()),
        0.5,
        |r| {
            let wave = wave(60.0, r.uniform());
            plus(white(r).into_iter().map(|one| 0.5 * one).collect(), wave)
        },
    ),
    delays(
        "drifting",
        "2 deviations a run",
        false,
        || along(|at| 2.0 * at),
        1.0,
        |r| plus(white(r), |s| s / 300.0),
    ),
];

/// What a method came to over the runs of a row.
#[derive(Default, Clone)]
struct Tally {
    runs: u64,
    accepted: u64,
    covered: u64,
    width: f64,
}

impl Tally {
    fn add(&mut self, interval: Option<Interval>, truth: f64) {
        self.runs += 1;
        if let Some(interval) = interval {
            self.accepted += 1;
            self.covered += u64::from(interval.holds(truth));
            self.width += interval.high - interval.low;
        }
    }

    fn coverage_low(&self) -> f64 {
        clopper_pearson(self.covered, self.accepted, 0.95).map_or(1.0, |one| one.low)
    }

    fn accepted_share(&self) -> f64 {
        self.accepted as f64 / self.runs as f64
    }

    fn mean_width(&self) -> f64 {
        self.width / self.accepted as f64
    }
}

struct Row {
    name: String,
    is_usual: bool,
    /// Ours, independent, batch means, initial positive sequence; the last three on the runs that ours accepts.
    own: Tally,
    others: [Tally; 3],
    scale: f64,
}

impl Row {
    fn words(&self) -> String {
        let percent = |share: f64| format!("{:.1}", 100.0 * share);
        let own = &self.own;
        let mut cells = vec![self.name.clone(), percent(own.accepted_share())];
        if own.accepted == 0 {
            cells.extend(["–".to_owned(), "–".to_owned(), "–".to_owned()]);
        } else {
            let covered = own.covered as f64 / own.accepted as f64;
            cells.push(format!(
                "{} (≥ {})",
                percent(covered),
                percent(own.coverage_low())
            ));
            cells.push(format!("{:.3}", own.mean_width() / self.scale));
            cells.push(format!("{:.3}", self.others[1].mean_width() / self.scale));
        }
        cells.extend(
            self.others
                .iter()
                .map(|one| percent(one.covered as f64 / one.runs as f64)),
        );
        format!("| {} |", cells.join(" | "))
    }

    /// What of the row is not as it should be.
    fn fault(&self) -> Option<String> {
        let low = self.own.coverage_low();
        let is_judged = self.own.accepted >= ACCEPTED_MIN;
        let is_limit = LIMITS.iter().any(|kind| self.name.ends_with(kind));
        let covers = is_limit || !is_judged || low >= COVERAGE_MIN;
        let accepts = !self.is_usual || self.own.accepted_share() >= 0.9;
        (!covers || !accepts).then(|| format!("{}: {}", self.name, self.words()))
    }
}

fn student_of(values: &[f64]) -> Interval {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>()
        / (n - 1.0);
    let reach = student_quantile(0.975, n - 1.0) * (variance / n).sqrt();
    Interval::new(mean - reach, mean + reach, IntervalMethod::Student)
}

/// Wilson's interval of a share of `n` trials (1927).
fn wilson_of(share: f64, n: f64) -> Interval {
    let z = normal_quantile(0.975);
    let centre = share + z * z / (2.0 * n);
    let spread = z * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + z * z / n;
    Interval::new(
        ((centre - spread) / scale).max(0.0),
        ((centre + spread) / scale).min(1.0),
        IntervalMethod::EffectiveShare,
    )
}

/// Wilson's interval, that of 30 batch means, and Wilson's on the count by the initial positive sequence.
fn published(outcomes: &[bool]) -> [Interval; 3] {
    let n = outcomes.len();
    let count = outcomes.iter().filter(|one| **one).count();
    let share = count as f64 / n as f64;
    let batches: Vec<f64> = outcomes
        .chunks_exact(n / 30)
        .map(|batch| batch.iter().filter(|one| **one).count() as f64 / batch.len() as f64)
        .collect();
    // Geyer's sums of pairs of autocovariances while they are positive, on batches that keep the cost linear.
    let length = (n / 6_000).max(1);
    let coarse: Vec<f64> = outcomes
        .chunks_exact(length)
        .map(|batch| batch.iter().filter(|one| **one).count() as f64 / length as f64 - share)
        .collect();
    let at = |lag: usize| {
        coarse
            .iter()
            .zip(&coarse[lag..])
            .map(|(a, b)| a * b)
            .sum::<f64>()
            / coarse.len() as f64
    };
    let mut sum = -at(0);
    for lag in (0..coarse.len() - 1).step_by(2) {
        let pair = at(lag) + at(lag + 1);
        if pair <= 0.0 {
            break;
        }
        sum += 2.0 * pair;
    }
    let of_mean = sum / coarse.len() as f64;
    let effective = if of_mean > 0.0 {
        share * (1.0 - share) / of_mean
    } else {
        n as f64
    };
    [
        wilson_of(share, n as f64),
        student_of(&batches),
        wilson_of(share, effective.min(n as f64)),
    ]
}

fn loss_row(kind: &LossKind, runs: u64) -> Row {
    let truth = kind.share.unwrap_or_else(|| {
        let mut random = RandomStream::new(7, "coverage.truth");
        let outage_s = if kind.name.contains("20 s") {
            (20.0, 180.0)
        } else {
            (5.0, 60.0)
        };
        let many = loops(4_000_000, outage_s.0, outage_s.1, &mut random);
        many.iter().filter(|one| **one).count() as f64 / many.len() as f64
    });
    let mut row = Row {
        name: format!("loss, {}: {}", kind.kind, kind.name),
        is_usual: kind.is_usual,
        own: Tally::default(),
        others: Default::default(),
        scale: truth,
    };
    for seed in 0..runs {
        let mut random = RandomStream::new(seed, &row.name);
        let outcomes = (kind.run)(&mut random);
        let batches = Batches::of(outcomes.iter().map(|one| f64::from(u8::from(*one))));
        row.own.add(batches.share_interval().known(), truth);
        for (tally, interval) in row.others.iter_mut().zip(published(&outcomes)) {
            tally.add(Some(interval), truth);
        }
    }
    row
}

/// The quantile of a law.
fn true_quantile(kind: &DelayKind, share: f64) -> f64 {
    let means = (kind.means)();
    invert(share, -20.0, 20.0, |x| {
        let below = means
            .iter()
            .map(|mean| normal_distribution((x - mean) / kind.deviation));
        below.sum::<f64>() / means.len() as f64
    })
}

const SHARES: [(f64, &str); 3] = [(0.5, "p50"), (0.99, "p99"), (0.999, "p99.9")];

fn delay_rows(kind: &DelayKind, runs: u64) -> Vec<Row> {
    let ns = |value: f64| 1e7 + 1e6 * value;
    let truths = SHARES.map(|(share, _)| ns(true_quantile(kind, share)));
    let mut rows: Vec<Row> = SHARES
        .iter()
        .map(|(share, quantile)| Row {
            name: format!("{quantile}, {}: {}", kind.kind, kind.name),
            // Ten minutes of a memory hold too few independent values that far out.
            is_usual: kind.is_usual
                && (kind.kind != "memory"
                    || *share < if kind.name == "1 s" { 0.99 } else { 0.999 }),
            own: Tally::default(),
            others: Default::default(),
            scale: 1e6,
        })
        .collect();
    for seed in 0..runs {
        let mut random = RandomStream::new(seed, &format!("{} {}", kind.kind, kind.name));
        #[expect(clippy::cast_possible_truncation, reason = "far from the ends of i64")]
        let series: Samples = (kind.run)(&mut random)
            .into_iter()
            .map(|one| ns(one) as i64)
            .collect();
        let ascending = series.ascending();
        let quantiles = Quantiles::of(&series, &ascending);
        for ((row, (share, _)), truth) in rows.iter_mut().zip(SHARES).zip(truths) {
            let interval = quantiles.interval(share).and_then(Spread::known);
            row.own.add(interval, truth);
            let count = ascending.len();
            let value = ascending.at(place_of(share, count));
            let outcomes: Vec<bool> = series.iter().map(|one| one <= value).collect();
            let at = |place: f64| ascending.at(place_of(place.clamp(0.0, 1.0), count)) as f64;
            for (tally, of_share) in row.others.iter_mut().zip(published(&outcomes)) {
                tally.add(Some(of_share.map(at)), truth);
            }
        }
    }
    rows
}

fn study(runs: u64, mut each: impl FnMut(&Row)) -> Vec<String> {
    let wanted = std::env::var("HIL_COVERAGE_KIND").unwrap_or_default();
    let is_wanted =
        |what: &str, kind: &str, name: &str| format!("{what} {kind} {name}").contains(&wanted);
    let mut faults = Vec::new();
    let of_losses = LOSSES
        .iter()
        .filter(|one| is_wanted("loss", one.kind, one.name));
    let of_delays = DELAYS
        .iter()
        .filter(|one| is_wanted("delay", one.kind, one.name));
    let rows = of_losses.map(|kind| vec![loss_row(kind, runs)]);
    let rows = rows.chain(of_delays.map(|kind| delay_rows(kind, runs)));
    for row in rows.flatten() {
        each(&row);
        faults.extend(row.fault());
    }
    faults
}

/// The whole study, at least 2000 runs a row; `HIL_COVERAGE_RUNS` and `HIL_COVERAGE_KIND` choose.
#[test]
#[ignore = "minutes; ./check.sh long"]
fn intervals_cover_what_they_claim() {
    let runs = std::env::var("HIL_COVERAGE_RUNS").ok();
    let runs = runs.and_then(|count| count.parse().ok()).unwrap_or(2_000);
    println!(
        "| series | accepted % | covered % | mean width | of batch means | independent | batch means | positive sequence |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let faults = study(runs, |row| println!("{}", row.words()));
    assert!(faults.is_empty(), "{faults:#?}");
}

/// Kinds of which a few runs say enough: with memory that fades nearly all are accepted and cover, and with one that does
/// not, or a trend, none.
#[test]
fn a_few_runs_of_each_kind_are_accepted_and_cover_or_are_refused() {
    let find = |name: &str| LOSSES.iter().find(|one| one.name == name).expect("a kind");
    for name in ["1 %", "0.1 s, 1 %", "rate varies, 1 s"] {
        let row = loss_row(find(name), 60);
        let own = &row.own;
        assert!(
            own.accepted >= 50 && own.covered + 5 >= own.accepted,
            "{}",
            row.words()
        );
    }
    for name in ["20 s, 12 a run", "rate, 60 s", "rate from 0 to 4 %"] {
        let row = loss_row(find(name), 20);
        assert!(row.own.accepted <= 1, "{}", row.words());
    }
    let delays = DELAYS
        .iter()
        .find(|one| one.name == "1 s" && one.kind == "memory");
    for row in delay_rows(delays.expect("a kind"), 30).iter().take(2) {
        let own = &row.own;
        assert!(
            own.accepted >= 22 && own.covered + 3 >= own.accepted,
            "{}",
            row.words()
        );
        assert!(row.others[0].covered < 24, "{}", row.words());
    }
}
