//! Two hosts with imperfect clocks and a path that favours one direction, for tests of the
//! estimator: drift that wanders, steps, stamps that err, bursts, losses. The truth is known.

#![allow(
    clippy::cast_possible_truncation,
    reason = "simulated times are far below 292 years"
)]

use crate::{Exchange, Requester};
use hil_core::random::RandomStream;
use hil_core::record::RoundTripRecord;
use hil_core::time::{Instant, RemoteInstant};

/// Largest error of a stamp, nanoseconds; below what the settings allow for.
const STAMP_NOISE_NS: f64 = 900.0;
/// How often a clock's rate changes.
const WANDER_PERIOD_NS: i64 = 100_000_000;
/// Largest deviation of a clock's rate from true time.
const RATE_MAX: f64 = 100e-6;

/// A clock as a function of true time.
#[derive(Debug, Clone)]
struct SimulatedClock {
    /// Its reading at each multiple of the period, without steps.
    readings: Vec<f64>,
    origin_ns: i64,
    /// True time of a step, and what the clock gains.
    steps: Vec<(i64, i64)>,
}

impl SimulatedClock {
    fn new(random: &mut RandomStream, duration_ns: i64, steps: Vec<(i64, i64)>) -> Self {
        let mut rate = (random.uniform() * 2.0 - 1.0) * RATE_MAX;
        let wander = 10_f64.powf(random.uniform() * 3.0 - 8.0);
        let count = duration_ns / WANDER_PERIOD_NS + 2;
        let mut readings = vec![0.0];
        for _ in 0..count {
            rate = (rate + wander * random.normal()).clamp(-RATE_MAX, RATE_MAX);
            let last = readings.last().copied().unwrap();
            readings.push(last + WANDER_PERIOD_NS as f64 * rate);
        }
        let origin_ns = ((random.uniform() * 2.0 - 1.0) * 1e14) as i64;
        Self {
            readings,
            origin_ns,
            steps,
        }
    }

    fn read(&self, true_ns: i64) -> i64 {
        let index = true_ns.div_euclid(WANDER_PERIOD_NS);
        let within = true_ns.rem_euclid(WANDER_PERIOD_NS) as f64 / WANDER_PERIOD_NS as f64;
        let index = usize::try_from(index).unwrap();
        let gain = self.readings[index] * (1.0 - within) + self.readings[index + 1] * within;
        let past = self.steps.iter().filter(|(at_ns, _)| *at_ns <= true_ns);
        let stepped_ns: i64 = past.map(|(_, gain_ns)| gain_ns).sum();
        self.origin_ns + true_ns + gain.round() as i64 + stepped_ns
    }
}

/// What one direction of the path does.
#[derive(Debug, Clone, Copy)]
#[allow(clippy::struct_field_names, reason = "units stand at the end")]
struct Direction {
    floor_ns: f64,
    jitter_ns: f64,
    burst_ns: f64,
}

/// What is drawn once for a run.
#[derive(Debug)]
pub(super) struct SimulatedRun {
    local: SimulatedClock,
    remote: SimulatedClock,
    there: Direction,
    back: Direction,
    loss_ratio: f64,
    period_ns: i64,
    duration_ns: i64,
    /// Spans of true time in which the path is congested.
    bursts: Vec<(i64, i64)>,
    random: RandomStream,
}

impl SimulatedRun {
    /// A run of `duration_ns`; `step_sizes_ns` are the sizes, in powers of ten, that steps may
    /// have, none when empty.
    pub(super) fn new(seed: u64, duration_ns: i64, step_powers: Option<(f64, f64)>) -> Self {
        let mut random = RandomStream::new(seed, "clock.simulated");
        let mut local_steps = Vec::new();
        let mut remote_steps = Vec::new();
        if let Some((lowest, highest)) = step_powers {
            // Two steps at most, seconds apart: a clock under steady steps has no relation.
            for place in [0.3, 0.7] {
                let at = duration_ns as f64 * (place + 0.1 * (random.uniform() - 0.5));
                let size = 10_f64.powf(lowest + random.uniform() * (highest - lowest));
                // A monotonic clock jumps forwards only; the offset does so both ways, for
                // either host may jump.
                let step = (at as i64, size as i64);
                match random.next_u64() % 3 {
                    0 => {}
                    1 => local_steps.push(step),
                    _ => remote_steps.push(step),
                }
            }
        }
        let local = SimulatedClock::new(&mut random, duration_ns * 2, local_steps);
        let remote = SimulatedClock::new(&mut random, duration_ns * 2, remote_steps);
        let mut direction = || Direction {
            floor_ns: 10_f64.powf(3.0 + 3.3 * random.uniform()),
            jitter_ns: 10_f64.powf(2.0 + 4.0 * random.uniform()),
            burst_ns: 10_f64.powf(5.0 + 2.5 * random.uniform()),
        };
        let (there, back) = (direction(), direction());
        let mut bursts = Vec::new();
        let mut at_ns = 0;
        while at_ns < duration_ns {
            let quiet_ns = (random.uniform() * 8e9) as i64;
            let length_ns = (random.uniform().powi(3) * 3e9) as i64;
            bursts.push((at_ns + quiet_ns, at_ns + quiet_ns + length_ns));
            at_ns += quiet_ns + length_ns;
        }
        Self {
            local,
            remote,
            there,
            back,
            loss_ratio: random.uniform() * 0.3,
            period_ns: 10_000_000 + (random.uniform() * 90e6) as i64,
            duration_ns,
            bursts,
            random,
        }
    }

    fn delay_ns(&mut self, direction: Direction, at_ns: i64) -> i64 {
        let mut exponential = |mean_ns: f64| -mean_ns * (1.0 - self.random.uniform()).ln();
        let mut delay = direction.floor_ns + exponential(direction.jitter_ns);
        let mut bursts = self.bursts.iter();
        if bursts.any(|(from_ns, until_ns)| (*from_ns..*until_ns).contains(&at_ns)) {
            delay += exponential(direction.burst_ns);
        }
        delay as i64
    }

    fn stamp(&mut self, is_local: bool, true_ns: i64) -> i64 {
        let clock = if is_local { &self.local } else { &self.remote };
        let noise = (self.random.uniform() * 2.0 - 1.0) * STAMP_NOISE_NS;
        clock.read(true_ns) + noise as i64
    }

    /// The exchanges both hosts record.
    pub(super) fn exchanges(&mut self) -> Vec<Exchange> {
        let mut found = Vec::new();
        for is_local in [true, false] {
            let mut at_ns = (self.random.uniform() * self.period_ns as f64) as i64;
            while at_ns < self.duration_ns {
                found.extend(self.exchange(is_local, at_ns));
                at_ns += self.period_ns;
            }
        }
        found
    }

    fn exchange(&mut self, is_local: bool, at_ns: i64) -> Option<Exchange> {
        let (out, home) = if is_local {
            (self.there, self.back)
        } else {
            (self.back, self.there)
        };
        let arrived_ns = at_ns + self.delay_ns(out, at_ns);
        let replied_ns = arrived_ns + (self.random.uniform() * 200e3) as i64;
        let ended_ns = replied_ns + self.delay_ns(home, replied_ns);
        if self.random.chance(self.loss_ratio) {
            return None;
        }
        let record = RoundTripRecord {
            sequence: 0,
            t1_ns: self.stamp(is_local, at_ns),
            t2_ns: self.stamp(!is_local, arrived_ns),
            t3_ns: self.stamp(!is_local, replied_ns),
            t4_ns: self.stamp(is_local, ended_ns),
            session: 0,
            sources: [1; 4],
        };
        let requester = if is_local {
            Requester::Local
        } else {
            Requester::Remote
        };
        Exchange::of(&record, requester)
    }

    /// One moment on both clocks.
    pub(super) fn truth(&self, true_ns: i64) -> (RemoteInstant, Instant) {
        (
            RemoteInstant::from_ns(self.remote.read(true_ns)),
            Instant::from_ns(self.local.read(true_ns)),
        )
    }

    /// Lets one of the clocks gain `size_ns` at `true_ns`.
    pub(super) fn step(&mut self, is_local: bool, true_ns: i64, size_ns: i64) {
        let clock = if is_local {
            &mut self.local
        } else {
            &mut self.remote
        };
        clock.steps.push((true_ns, size_ns));
    }

    /// What the offset gained by the steps of both clocks, in order of time.
    pub(super) fn offset_steps_ns(&self) -> Vec<i64> {
        let remote = self.remote.steps.iter().map(|(at, gain)| (*at, -gain));
        let mut steps: Vec<_> = self.local.steps.iter().copied().chain(remote).collect();
        steps.sort_unstable();
        steps.into_iter().map(|(_, gain_ns)| gain_ns).collect()
    }

    /// How much faster the local clock ran than the other one, parts per million.
    pub(super) fn skew_ppm(&self) -> f64 {
        let gain = |clock: &SimulatedClock| clock.read(self.duration_ns) - clock.read(0);
        let (local, remote) = (gain(&self.local) as f64, gain(&self.remote) as f64);
        (local / remote - 1.0) * 1e6
    }
}
