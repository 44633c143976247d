//! Losses of the network: their share with an interval that knows of bursts, how many came in a
//! row, bursts and gaps as in RFC 3611, and the longest time without a message. Losses of a host
//! neither count nor interrupt anything here.

use core::fmt;

use serde::{Deserialize, Serialize};

use super::{Crossing, Metric, Passages};
use crate::{BurstCount, BurstLengths};
use hil_core::interval::Spread;
use hil_stats::dependence::Batches;

/// Messages received in a row that end a burst (`Gmin` of RFC 3611, section 4.7.2).
pub const BURST_GAP_MIN: u64 = 16;

/// Losses of the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LossMetrics {
    /// The share lost of what the network was handed.
    pub ratio: f64,
    /// 95 % interval of the share, or why there is none.
    pub interval: Spread,
    /// How often how many were lost in a row.
    pub runs: Vec<BurstCount>,
    /// Bursts of losses and the gaps between them; `None` without a burst.
    pub bursts: Option<BurstMetrics>,
    /// The longest time without a message that got through.
    pub longest: Option<LongestLoss>,
}

/// Bursts: from a lost message to a lost message with fewer than [`BURST_GAP_MIN`] received in a
/// row between, at least two lost; all the rest is gaps (RFC 3611, section 4.7.2).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BurstMetrics {
    /// Bursts.
    pub count: u64,
    /// Mean length, messages.
    pub length_mean: f64,
    /// Share of the messages in bursts that were lost (burst density).
    pub loss_ratio: f64,
    /// Mean length of what is between bursts, messages.
    pub gap_length_mean: f64,
    /// Share of the messages between bursts that were lost (gap density).
    pub gap_loss_ratio: f64,
}

/// A time without a message that got through.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LongestLoss {
    /// The first lost message was handed over so long after the start of the run, or on the
    /// producer's clock when that is unknown.
    pub start_ns: i64,
    /// To the next message that arrived, or to the end of the run.
    pub length_ns: i64,
    /// Messages lost in it.
    pub lost_count: u64,
    /// True when it lasted to the end of the run.
    pub is_open: bool,
}

/// Some losses with no arrival between, in order of their numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct LossRun {
    /// Place of the first among the messages handed to the network.
    pub(super) place: u64,
    pub(super) lost_count: u64,
    /// Of these, without a way to the peer.
    pub(super) unreachable_count: u64,
    pub(super) from_ns: Option<i64>,
    /// When the next one that arrived was handed over.
    pub(super) until_ns: Option<i64>,
}

/// Runs of losses, and how many messages the network was handed.
pub(super) fn loss_runs(passages: &Passages) -> (Vec<LossRun>, u64) {
    let mut runs: Vec<LossRun> = Vec::new();
    let (mut is_open, mut place) = (false, 0_u64);
    for one in passages.each() {
        match one.crossing {
            Crossing::Arrived => {
                if core::mem::take(&mut is_open)
                    && let Some(run) = runs.last_mut()
                {
                    run.until_ns = one.offered_ns;
                }
            }
            Crossing::LostByNetwork | Crossing::Unreachable => {
                if !core::mem::replace(&mut is_open, true) {
                    runs.push(LossRun {
                        place,
                        lost_count: 0,
                        unreachable_count: 0,
                        from_ns: None,
                        until_ns: None,
                    });
                }
                if let Some(run) = runs.last_mut() {
                    run.lost_count = run.lost_count.saturating_add(one.count);
                    if one.crossing == Crossing::Unreachable {
                        run.unreachable_count = run.unreachable_count.saturating_add(one.count);
                    }
                    run.from_ns = run.from_ns.or(one.offered_ns);
                }
            }
            Crossing::LostByHost | Crossing::Unknown | Crossing::Doubtful => continue,
        }
        place = place.saturating_add(one.count);
    }
    (runs, place)
}

/// Runs of `runs` that belong to one burst each, single losses included.
pub(super) fn clusters(runs: &[LossRun]) -> impl Iterator<Item = &[LossRun]> {
    runs.chunk_by(|before, after| {
        after
            .place
            .saturating_sub(before.place.saturating_add(before.lost_count))
            < BURST_GAP_MIN
    })
}

pub(super) fn losses(passages: &Passages, run_ns: Option<(i64, i64)>) -> Metric<LossMetrics> {
    let (runs, of_count) = loss_runs(passages);
    let lost_count = runs
        .iter()
        .fold(0_u64, |sum, run| sum.saturating_add(run.lost_count));
    if of_count == 0 {
        return Metric::unavailable("no message is known to have been lost or to have arrived");
    }
    let of_runs = runs.iter().map(|run| (run.place, run.lost_count));
    let mut lengths = BurstLengths::default();
    for run in &runs {
        lengths.add(run.lost_count);
    }
    Metric::Measured(LossMetrics {
        ratio: lost_count as f64 / of_count as f64,
        interval: Batches::of_runs(of_count, of_runs).share_interval(),
        runs: lengths.finish(),
        bursts: bursts(&runs, of_count, lost_count),
        longest: longest(&runs, run_ns),
    })
}

/// Between what the loss ratio of the network is, where it or the receiving host lost some messages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossBounds {
    /// If the host lost all of these.
    pub low: f64,
    /// If the network did.
    pub high: f64,
    /// How many these are.
    pub doubtful_count: u64,
}

impl fmt::Display for LossBounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [low, high] = [self.low, self.high].map(|ratio| 100.0 * ratio);
        write!(f, "between {low:.3} % and {high:.3} %")
    }
}

fn bursts(runs: &[LossRun], of_count: u64, lost_count: u64) -> Option<BurstMetrics> {
    let (mut count, mut length, mut lost_in_bursts) = (0_u64, 0_u64, 0_u64);
    for cluster in clusters(runs) {
        let lost_here: u64 = cluster.iter().map(|run| run.lost_count).sum();
        let (first, last) = cluster.first().zip(cluster.last())?;
        if lost_here < 2 {
            continue;
        }
        count += 1;
        lost_in_bursts += lost_here;
        length += last.place + last.lost_count - first.place;
    }
    let rest = of_count.saturating_sub(length) as f64;
    (count > 0).then(|| BurstMetrics {
        count,
        length_mean: length as f64 / count as f64,
        loss_ratio: lost_in_bursts as f64 / length as f64,
        gap_length_mean: rest / count as f64,
        gap_loss_ratio: if rest > 0.0 {
            lost_count.saturating_sub(lost_in_bursts) as f64 / rest
        } else {
            0.0
        },
    })
}

fn longest(runs: &[LossRun], run_ns: Option<(i64, i64)>) -> Option<LongestLoss> {
    let (start_ns, end_ns) = run_ns.map_or((0, None), |(start, end)| (start, Some(end)));
    let all = runs.iter().filter_map(|run| {
        let from_ns = run.from_ns?;
        Some(LongestLoss {
            start_ns: from_ns.saturating_sub(start_ns),
            length_ns: run.until_ns.or(end_ns)?.saturating_sub(from_ns).max(0),
            lost_count: run.lost_count,
            is_open: run.until_ns.is_none(),
        })
    });
    all.max_by_key(|one| one.length_ns)
}
