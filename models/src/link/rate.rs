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

use serde::{Deserialize, Serialize};

use crate::case_study::ParameterError;
use crate::time::{Instant, duration_ns};

/// A rate and a queue in front of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RateLimit {
    /// Rate, 1 kbit/s..=100 Gbit/s.
    pub bits_per_second: u64,
    /// Bytes that may wait, the message being sent included, 64..=67108864.
    #[serde(default = "default_queue_bytes")]
    pub queue_bytes: u64,
    /// What each message takes on the wire on top of what is offered to the model, which is our
    /// datagram with its own header; 0..=1000. 28 are the headers of IPv4 and UDP.
    #[serde(default = "default_overhead_bytes")]
    pub overhead_bytes: u64,
}

/// What Linux gives a socket by default, twice over: a hundred full frames.
pub const QUEUE_BYTES_DEFAULT: u64 = 150_000;
/// Headers of IPv4 and UDP.
pub const OVERHEAD_BYTES_DEFAULT: u64 = 28;

const fn default_queue_bytes() -> u64 {
    QUEUE_BYTES_DEFAULT
}

const fn default_overhead_bytes() -> u64 {
    OVERHEAD_BYTES_DEFAULT
}

const NS_PER_S: u128 = 1_000_000_000;

impl RateLimit {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let ranges = [
            (
                "bits_per_second",
                self.bits_per_second,
                1_000..=100_000_000_000,
            ),
            ("queue_bytes", self.queue_bytes, 64..=67_108_864),
            ("overhead_bytes", self.overhead_bytes, 0..=1_000),
        ];
        for (key, value, range) in ranges {
            if !range.contains(&value) {
                let problem = format!("{value} is outside {}..={}", range.start(), range.end());
                return Err(ParameterError::new(key, problem));
            }
        }
        Ok(())
    }

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
