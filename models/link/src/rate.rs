//! A bottleneck: messages leave one after the other at a fixed rate, and wait in a queue of finite
//! length; what finds no room is lost (tail drop). It has no random part, serves in the order of
//! arrival, and knows no other channel: each channel of a link has a bottleneck of its own, as if
//! it had been given that share of the rate.
//!
//! A message of L bytes takes (L + `overhead_bytes`) * 8 / `bits_per_second`. It is taken when the
//! bytes not yet sent, those left of the message just being sent included, and its own fit into
//! `queue_bytes`. For messages of equal size and a queue of K of them this is the M/D/1/K system
//! (K counts the one in service).

use core::time::Duration;

use hil_core::case_study::ParameterError;
use hil_core::options;
use hil_core::time::{Instant, duration_ns};

options! {
    /// A rate and a queue in front of it.
    #[derive(Copy, Eq)]
    pub struct RateLimit {
        /// Rate.
        bits_per_second: u64, in 1_000..=100_000_000_000, hint "an integer, e.g. 10_000_000";
        /// Bytes that may wait, the message being sent included. By default what Linux gives a socket,
        /// twice over: a hundred full frames.
        queue_bytes: u64 = 150_000, in 64..=67_108_864;
        /// What each message takes on the wire on top of what is offered to the model, which is our
        /// datagram with its own header. 28 are the headers of IPv4 and UDP.
        overhead_bytes: u64 = 28, in 0..=1_000;
    }
}

const NS_PER_S: u128 = 1_000_000_000;

impl RateLimit {
    /// How long a full queue takes to empty: the longest a message waits here, its own sending
    /// included.
    pub fn longest(&self) -> Duration {
        self.time_of(u128::from(self.queue_bytes))
    }

    fn time_of(&self, bytes: u128) -> Duration {
        let ns = bytes * 8 * NS_PER_S / u128::from(self.bits_per_second);
        Duration::from_nanos(u64::try_from(ns).unwrap_or(u64::MAX))
    }
}

/// The bottleneck at work.
#[derive(Debug, Clone)]
pub struct Bottleneck {
    limit: RateLimit,
    /// When everything taken so far has been sent, rounded down.
    free_at: Instant,
    /// What was rounded off, in 1 / `bits_per_second` of a nanosecond.
    remainder: u128,
}

impl Bottleneck {
    /// An empty one.
    ///
    /// # Errors
    /// The first key of `limit` outside its range.
    pub fn new(limit: RateLimit) -> Result<Self, ParameterError> {
        limit.check()?;
        Ok(Self {
            limit,
            free_at: Instant::from_ns(i64::MIN),
            remainder: 0,
        })
    }

    /// Bytes taken and not yet sent at `now`, rounded up.
    pub fn backlog_bytes(&self, now: Instant) -> u64 {
        if self.free_at < now {
            return 0;
        }
        let rate = u128::from(self.limit.bits_per_second);
        let left_ns = duration_ns(self.free_at.saturating_duration_since(now));
        let left = u128::from(left_ns.unsigned_abs()) * rate + self.remainder;
        u64::try_from(left.div_ceil(8 * NS_PER_S)).unwrap_or(u64::MAX)
    }

    /// When a message of `length_bytes` that arrives at `now` has been sent; `None` when it finds
    /// no room. Calls come in non-decreasing `now`.
    pub fn offer(&mut self, now: Instant, length_bytes: usize) -> Option<Instant> {
        let bytes = length_bytes as u64 + self.limit.overhead_bytes;
        if self.backlog_bytes(now).saturating_add(bytes) > self.limit.queue_bytes {
            return None;
        }
        if self.free_at < now {
            self.free_at = now;
            self.remainder = 0;
        }
        let rate = u128::from(self.limit.bits_per_second);
        let work = u128::from(bytes) * 8 * NS_PER_S + self.remainder;
        let whole_ns = u64::try_from(work / rate).unwrap_or(u64::MAX);
        self.free_at = self.free_at + Duration::from_nanos(whole_ns);
        self.remainder = work % rate;
        // It is all there only when its last part is.
        let rest = Duration::from_nanos(u64::from(self.remainder > 0));
        Some(self.free_at + rest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    /// 1000 bytes take 1 ms.
    const LIMIT: RateLimit = RateLimit {
        bits_per_second: 8_000_000,
        queue_bytes: 5_000,
        overhead_bytes: 28,
    };
    const LENGTH_BYTES: usize = 972;
    const MS: i64 = 1_000_000;

    #[test]
    fn a_message_waits_for_the_backlog_and_its_own_sending() {
        let mut link = Bottleneck::new(LIMIT).unwrap();
        let now = Instant::from_ns(7 * MS);
        for place in 1..=5 {
            let sent = link.offer(now, LENGTH_BYTES).unwrap();
            assert_eq!(sent.as_ns(), (7 + place) * MS);
        }
        assert_eq!(link.backlog_bytes(now), 5_000);
        assert_eq!(link.offer(now, LENGTH_BYTES), None);
        // A short one fits as soon as there is room for it, not before.
        let almost = Instant::from_ns(7 * MS + 27_000);
        assert_eq!(link.offer(almost, 0), None);
        let room = Instant::from_ns(7 * MS + 28_000);
        assert_eq!(link.offer(room, 0).unwrap().as_ns(), 12 * MS + 28_000);
        let idle = Instant::from_ns(50 * MS);
        assert_eq!(link.backlog_bytes(idle), 0);
        assert_eq!(link.offer(idle, LENGTH_BYTES).unwrap().as_ns(), 51 * MS);
    }

    #[test]
    fn an_overloaded_link_carries_its_rate_exactly_and_drops_the_rest() {
        // 3 does not divide the time of a message: what is rounded off must not add up.
        let limit = RateLimit {
            bits_per_second: 3_000_000,
            ..LIMIT
        };
        let mut link = Bottleneck::new(limit).unwrap();
        let (mut sent_count, mut last) = (0_u64, Instant::ZERO);
        for step in 0..1_000_000 {
            let now = Instant::from_ns(step * MS);
            if let Some(at) = link.offer(now, LENGTH_BYTES) {
                assert!(at > last);
                (sent_count, last) = (sent_count + 1, at);
            }
        }
        // From the first message on the link is never idle: 8000 bits each at 3 Mbit/s, rounded up
        // once.
        let busy_ns = (sent_count * 8_000_000).div_ceil(3);
        assert_eq!(last, Instant::ZERO + Duration::from_nanos(busy_ns));
        // In 1e6 ms it sends 375 000 messages and holds five at the end; a message sets out with
        // every third of 8 ms.
        assert!((375_000..=375_005).contains(&sent_count), "{sent_count}");
    }

    /// Poisson arrivals at `load` of the link; the mean wait in message times and the loss ratio of
    /// each of 100 batches of 20 000.
    fn batches(load: f64, places: u64, seed: u64) -> Vec<(f64, f64)> {
        let limit = RateLimit {
            queue_bytes: 1_000 * places,
            ..LIMIT
        };
        let mut link = Bottleneck::new(limit).unwrap();
        let mut random = RandomStream::new(seed, "arrivals");
        let mut now = Instant::ZERO;
        let mut batch = || {
            let (mut waited, mut taken, mut lost) = (0.0, 0.0, 0.0);
            for _ in 0..20_000 {
                let gap_s = -1e-3 / load * (1.0 - random.uniform()).ln();
                now = now + Duration::from_secs_f64(gap_s);
                match link.offer(now, LENGTH_BYTES) {
                    Some(at) => {
                        waited += at.seconds_since(now) * 1e3 - 1.0;
                        taken += 1.0;
                    }
                    None => lost += 1.0,
                }
            }
            (waited / taken, lost / 20_000.0)
        };
        (0..100).map(|_| batch()).collect()
    }

    /// Mean of batch means and its standard error.
    fn mean_and_error(means: impl Iterator<Item = f64>) -> (f64, f64) {
        let means: Vec<f64> = means.collect();
        let count = means.len() as f64;
        let mean = means.iter().sum::<f64>() / count;
        let square: f64 = means.iter().map(|one| (one - mean).powi(2)).sum();
        (mean, (square / (count - 1.0) / count).sqrt())
    }

    #[test]
    fn poisson_arrivals_wait_as_pollaczek_and_khinchine_say() {
        for load in [0.3, 0.7] {
            let (found, error) = mean_and_error(batches(load, 60_000, 1).iter().map(|one| one.0));
            // M/D/1: half of what M/M/1 waits.
            let promised = load / (2.0 * (1.0 - load));
            let errors = (found - promised) / error;
            assert!(errors.abs() < 5.0, "load {load}: {found} of {promised}");
        }
    }

    /// Loss ratio of M/D/1/K: departures of the embedded chain (Gross and Harris 1998, section
    /// 5.1.8), 1 - 1 / (p0 + load).
    fn promised_loss(load: f64, places: usize) -> f64 {
        let mut arrivals = vec![(-load).exp()];
        for count in 1..places {
            arrivals.push(arrivals[count - 1] * load / count as f64);
        }
        // Unscaled long-run shares of those left behind, by balance from the lowest on.
        let mut left = vec![1.0];
        for state in 0..places - 1 {
            let mut next = left[state] - left[0] * arrivals[state];
            for (from, share) in left.iter().enumerate().skip(1).take(state) {
                next -= share * arrivals[state + 1 - from];
            }
            left.push(next / arrivals[0]);
        }
        let nobody = left[0] / left.iter().sum::<f64>();
        1.0 - 1.0 / (nobody + load)
    }

    #[test]
    fn a_finite_queue_loses_as_the_oracle_says() {
        // M/D/1/1 is Erlang's loss system.
        assert!((promised_loss(0.8, 1) - 0.8 / 1.8).abs() < 1e-12);
        for (load, places) in [(0.8, 1), (0.8, 3), (1.0, 5), (1.2, 5)] {
            let found = batches(load, places as u64, 2);
            let (ratio, error) = mean_and_error(found.iter().map(|one| one.1));
            let promised = promised_loss(load, places);
            let errors = (ratio - promised) / error;
            assert!(
                errors.abs() < 5.0,
                "load {load}, {places} places: {ratio} of {promised}"
            );
        }
    }

    #[test]
    fn numbers_outside_their_range_are_refused_by_name() {
        let cases = [
            (
                RateLimit {
                    bits_per_second: 999,
                    ..LIMIT
                },
                "bits_per_second",
            ),
            (
                RateLimit {
                    queue_bytes: 63,
                    ..LIMIT
                },
                "queue_bytes",
            ),
            (
                RateLimit {
                    overhead_bytes: 1_001,
                    ..LIMIT
                },
                "overhead_bytes",
            ),
        ];
        for (limit, key) in cases {
            assert_eq!(Bottleneck::new(limit).unwrap_err().key, key);
        }
    }
}
