//! Figures over the last second: counts of what happened in it and percentiles of what was measured
//! in it. It knows no clock; "now" is an argument.

use std::collections::VecDeque;

use hil_stats::histogram::LatencySummary;
use serde_json::{Value, json};

/// How far back figures look, nanoseconds.
pub(crate) const WINDOW_NS: i64 = 1_000_000_000;

/// Values kept at most; beyond, the oldest go, and figures are of the newest.
const SAMPLES_MAX: usize = 4096;

/// Records are read some time after they were written; a window that ends now would lack the newest.
/// It ends with the newest that is known, but no longer ago than this, nanoseconds.
const READ_LATE_NS: i64 = 250_000_000;

/// Instants kept apart at most; of a faster channel several count as one.
const INSTANTS_MAX: usize = 8192;

/// How many things happened within the window.
#[derive(Debug, Default)]
pub(crate) struct Recent {
    instants: VecDeque<(i64, u64)>,
}

impl Recent {
    /// `count` things happened at `at_ns`.
    pub(crate) fn add(&mut self, at_ns: i64, count: u64) {
        let is_full = self.instants.len() >= INSTANTS_MAX;
        match self.instants.back_mut() {
            // What comes out of order counts with the newest: it was learned then.
            Some((last, sum)) if is_full || *last >= at_ns => *sum += count,
            _ => self.instants.push_back((at_ns, count)),
        }
    }

    /// How many happened in the window before `now_ns`.
    pub(crate) fn count(&mut self, now_ns: i64) -> u64 {
        let newest_ns = self.instants.back().map_or(now_ns, |(at, _)| *at);
        let end_ns = newest_ns.clamp(now_ns - READ_LATE_NS, now_ns.max(newest_ns));
        let begin_ns = end_ns - WINDOW_NS;
        while self.instants.front().is_some_and(|(at, _)| *at <= begin_ns) {
            self.instants.pop_front();
        }
        self.instants.iter().map(|(_, count)| count).sum()
    }
}

/// Durations measured within the window.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    values: VecDeque<(i64, i64)>,
    /// True once there was one: whether this host has the two stages at all.
    pub(crate) is_available: bool,
}

impl Samples {
    /// `value_ns` was learned at `at_ns`.
    pub(crate) fn add(&mut self, at_ns: i64, value_ns: i64) {
        self.is_available = true;
        if self.values.len() == SAMPLES_MAX {
            self.values.pop_front();
        }
        self.values.push_back((at_ns, value_ns));
    }

    /// `p50_us`, `p99_us`, `max_us`, `count` and `is_available` of the window before `now_ns`, as `name`.
    pub(crate) fn figures(&mut self, name: &str, now_ns: i64) -> Value {
        let oldest_ns = now_ns - WINDOW_NS;
        while self.values.front().is_some_and(|(at, _)| *at <= oldest_ns) {
            self.values.pop_front();
        }
        let values: Vec<i64> = self.values.iter().map(|(_, value)| *value).collect();
        let summary = LatencySummary::of_samples(&values);
        let of =
            |figure: fn(&LatencySummary) -> i64| summary.as_ref().map(figure).map(microseconds);
        json!({
            "name": name,
            "p50_us": of(|one| one.p50_ns), "p99_us": of(|one| one.p99_ns),
            "max_us": of(|one| one.max_ns),
            "count": values.len(), "is_available": self.is_available,
        })
    }
}

/// To a tenth, as far as any stamp means something.
fn microseconds(ns: i64) -> f64 {
    (ns as f64 / 100.0).round() / 10.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_older_than_a_second_does_not_count() {
        let mut recent = Recent::default();
        for tick in 0..300 {
            recent.add(tick * 10_000_000, 1);
        }
        assert_eq!(recent.count(3_000_000_000), 100);
        assert_eq!(recent.count(3_200_000_000), 100);
        assert_eq!(recent.count(3_500_000_000), 74);
        assert_eq!(recent.count(9_000_000_000), 0);
    }

    #[test]
    fn percentiles_are_those_of_the_window() {
        let mut samples = Samples::default();
        assert_eq!(samples.figures("x", 0)["is_available"], false);
        assert_eq!(samples.figures("x", 0)["p50_us"], Value::Null);
        samples.add(0, 900_000);
        for index in 1..=100 {
            samples.add(WINDOW_NS + index, index * 1000);
        }
        let figures = samples.figures("x", WINDOW_NS + 200);
        assert_eq!(figures["count"], 100);
        assert_eq!(figures["p50_us"], 50.0);
        assert_eq!(figures["p99_us"], 99.0);
        assert_eq!(figures["max_us"], 100.0);
        let later = samples.figures("x", 3 * WINDOW_NS);
        assert_eq!(
            (&later["count"], &later["max_us"]),
            (&json!(0), &Value::Null)
        );
        assert_eq!(later["is_available"], true);
    }
}
