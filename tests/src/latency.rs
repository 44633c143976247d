//! How long messages took around the moments at which something was done beside a run, against all others of
//! the same run.

use std::ops::Range;
use std::path::Path;
use std::{fmt, fs};

use hil_core::record::TakenRecord;
use hil_rundir::record::{RecordFile, RecordKind};

/// What belongs to a moment, nanoseconds from it on: a killed process goes on dying for a while.
const NEAR_NS: Range<i64> = -10_000_000..250_000_000;
/// Largest ratio of the medians. Generous: this is to notice that the run waits for what was done to
/// something else, and no measurement.
const RATIO_MAX: f64 = 5.0;
/// Fewer messages around the moments would say nothing.
const COUNT_MIN: usize = 100;

/// How long messages took from publication to being taken, nanoseconds, ascending.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Latencies(Vec<i64>);

impl Latencies {
    /// Of latencies in any order, nanoseconds.
    pub fn of(mut latencies_ns: Vec<i64>) -> Self {
        latencies_ns.sort_unstable();
        Self(latencies_ns)
    }

    /// The smallest latency that so many in a thousand do not exceed; `None` without messages.
    pub fn quantile_ns(&self, per_mille: usize) -> Option<i64> {
        let rank = (self.0.len() * per_mille).div_ceil(1000);
        self.0.get(rank.saturating_sub(1)).copied()
    }
}

impl fmt::Display for Latencies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, per_mille) in [("p50", 500), ("p99", 990), ("p99.9", 999), ("max", 1000)] {
            let us = self
                .quantile_ns(per_mille)
                .map_or(f64::NAN, |ns| ns as f64 * 1e-3);
            write!(f, "{name} {us:.1} us, ")?;
        }
        write!(f, "{} messages", self.0.len())
    }
}

/// Those of messages published around one of the moments, and those of all others.
fn split(latencies: impl Iterator<Item = (i64, i64)>, moments_ns: &[i64]) -> [Latencies; 2] {
    let is_near = |at_ns: i64| {
        moments_ns
            .iter()
            .any(|moment| NEAR_NS.contains(&(at_ns - moment)))
    };
    let (near, others): (Vec<_>, Vec<_>) =
        latencies.partition(|(published_ns, _)| is_near(*published_ns));
    [near, others].map(|some| Latencies::of(some.into_iter().map(|(_, latency)| latency).collect()))
}

/// Publication and latency of every message that was taken in the run at `root`.
fn latencies(root: &Path) -> Vec<(i64, i64)> {
    let entries = match fs::read_dir(root.join("records")) {
        Ok(entries) => entries,
        Err(error) => panic!("{}: {error}", root.display()),
    };
    let mut found = Vec::new();
    for entry in entries.flatten() {
        let file = match RecordFile::read(&entry.path()) {
            Ok(file) => file,
            Err(error) => panic!("{error}"),
        };
        if file.header.kind == RecordKind::Taken {
            let records = file.records::<TakenRecord>();
            found.extend(records.map(|one| (one.published_ns, one.taken_ns - one.published_ns)));
        }
    }
    found
}

/// Prints how long messages took around these moments of the finished run at `root`, on its monotonic
/// clock, and how long all others did, and compares their medians.
///
/// # Panics
/// When the records cannot be read, tell too little, or the messages around the moments took several
/// times as long.
#[allow(clippy::print_stdout, reason = "the figures are the result")]
pub fn assert_undisturbed(root: &Path, moments_ns: &[i64]) {
    let [near, others] = split(latencies(root).into_iter(), moments_ns);
    println!("around {} moments: {near}", moments_ns.len());
    println!("elsewhere: {others}");
    assert!(near.0.len() >= COUNT_MIN, "around: {near}");
    assert!(others.0.len() >= COUNT_MIN, "elsewhere: {others}");
    let median_ns = |some: &Latencies| some.quantile_ns(500).unwrap_or_default() as f64;
    let ratio = median_ns(&near) / median_ns(&others);
    println!("ratio of the medians {ratio:.3}");
    assert!(ratio <= RATIO_MAX, "around: {near}; elsewhere: {others}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_near_a_moment_from_shortly_before_it_on() {
        let moments_ns = [1_000_000_000, 3_000_000_000];
        let all = [
            (900_000_000, 1),
            (995_000_000, 20),
            (1_100_000_000, 40),
            (1_300_000_000, 2),
            (3_000_000_000, 30),
        ];
        let [near, others] = split(all.into_iter(), &moments_ns);
        assert_eq!(near, Latencies(vec![20, 30, 40]));
        assert_eq!(others, Latencies(vec![1, 2]));
        assert_eq!(near.quantile_ns(500), Some(30));
        assert_eq!(near.quantile_ns(1000), Some(40));
        assert_eq!(Latencies::default().quantile_ns(500), None);
    }
}
