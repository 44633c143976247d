//! The network over time: what each stretch of a run sent, lost and delayed, and how long the
//! receiver had heard nothing. Stretches are equally long, so that they can be compared with what a
//! robot did at the same time.

use super::{Crossing, Moment, Passages};
use crate::Side;
use hil_core::plot::{PlotColumn, PlotSeries, name_part};
use hil_stats::in_order::in_order;
use hil_stats::samples::Samples;

/// Shortest bin.
const WIDTH_MIN_NS: i64 = 100_000_000;

/// Most bins of a run.
const COUNT_MAX: i64 = 4_000;

/// The width of bins for a run of this length: 100 ms, or the next of 200 ms, 500 ms, 1 s, 2 s, …
/// that leaves at most 4000 of them.
pub fn bin_width_ns(duration_ns: i64) -> i64 {
    let mut decade_ns = WIDTH_MIN_NS;
    loop {
        for factor in [1, 2, 5] {
            let width_ns = decade_ns.saturating_mul(factor);
            if duration_ns / width_ns < COUNT_MAX {
                return width_ns;
            }
        }
        decade_ns = decade_ns.saturating_mul(10);
    }
}

/// Puts moments of a channel's two hosts on the axis of the run: nanoseconds after its start, `None`
/// where the clocks do not say.
pub type Place<'a> = dyn Fn(Moment) -> Option<i64> + 'a;

/// What [`NetworkBins::to_series`] calls the series of a channel.
pub fn network_series_name(channel: &str) -> String {
    format!("network-{}", name_part(channel))
}

/// What happened in one stretch of time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NetworkBin {
    /// Messages handed to the network whose outcome is known.
    pub sent_count: u64,
    /// Of these, lost by the network.
    pub lost_count: u64,
    /// Lost by a host.
    pub host_lost_count: u64,
    /// Median delay of those that arrived.
    pub delay_p50_ns: Option<i64>,
    /// Largest delay.
    pub delay_max_ns: Option<i64>,
    /// Largest error of any of these delays from the alignment of the clocks; 0 on one clock.
    pub delay_bound_ns: Option<u64>,
    /// The longest time since the last reception that was reached in this stretch; `None` before
    /// the first reception.
    pub silence_max_ns: Option<i64>,
}

/// A channel's network over time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkBins {
    /// Width of a bin.
    pub width_ns: i64,
    /// From the start of the run on, without a hole.
    pub bins: Vec<NetworkBin>,
    /// Messages that are in no bin because the time they were handed over has no place. Those that were handed over before
    /// or after the run, or never, are in none either.
    pub unplaced_count: u64,
}

impl NetworkBins {
    /// Of a run of `duration_ns`. Messages are put where they were handed to the network, silences
    /// where the receiver had them.
    pub fn of(passages: &Passages, duration_ns: i64, width_ns: i64, place: &Place<'_>) -> Self {
        let width_ns = width_ns.max(1);
        let count = usize::try_from(duration_ns.max(1).saturating_add(width_ns - 1) / width_ns)
            .unwrap_or(1);
        let mut bins = vec![NetworkBin::default(); count];
        let mut delays_ns = vec![Samples::default(); count];
        let mut unplaced_count = 0;
        for one in passages.each() {
            let Some(ns) = one.offered_ns else { continue };
            let side = Side::Producer;
            let Some(at_ns) = place(Moment { side, ns }) else {
                unplaced_count += one.count;
                continue;
            };
            let Some(index) = index_of(at_ns, width_ns, count) else {
                continue;
            };
            let bin = &mut bins[index];
            match one.crossing {
                Crossing::Arrived => bin.sent_count += one.count,
                Crossing::LostByNetwork | Crossing::Unreachable => {
                    bin.sent_count += one.count;
                    bin.lost_count += one.count;
                }
                Crossing::LostByHost => bin.host_lost_count += one.count,
                Crossing::Unknown | Crossing::Doubtful => {}
            }
            delays_ns[index].extend(one.delay_ns);
            let bound_ns = one.delay_ns.map(|_| one.delay_bound_ns);
            bin.delay_bound_ns = bin.delay_bound_ns.max(bound_ns);
        }
        for (bin, delays_ns) in bins.iter_mut().zip(&mut delays_ns) {
            delays_ns.sort();
            let last = delays_ns.len().checked_sub(1);
            bin.delay_max_ns = last.map(|last| delays_ns.at(last));
            bin.delay_p50_ns = last.map(|_| delays_ns.at_share(0.5));
        }
        drop(delays_ns);
        silences(&mut bins, passages, duration_ns, width_ns, place);
        Self {
            width_ns,
            bins,
            unplaced_count,
        }
    }

    /// As a table, one row per bin.
    pub fn to_series(&self, channel: &str, notes: Vec<String>) -> PlotSeries {
        let column = |name, label, unit| PlotColumn { name, label, unit };
        let seconds = |ns: Option<i64>| ns.map_or(f64::NAN, |ns| ns as f64 * 1e-9);
        let rows = self.bins.iter().zip(0_i64..);
        PlotSeries {
            name: network_series_name(channel),
            title: format!("The network under {channel} over time"),
            notes,
            panel_lines: None,
            columns: vec![
                column(
                    "time_s",
                    "begin of the bin, since the start of the run",
                    "s",
                ),
                column("sent_count", "messages handed to the network", "1"),
                column("lost_count", "of these, lost by the network", "1"),
                column(
                    "host_lost_count",
                    "lost before they got onto the network, or with a process that was down",
                    "1",
                ),
                column(
                    "delay_s_p50",
                    "median delay, kernel to receiving gateway",
                    "s",
                ),
                column("delay_s_max", "largest delay", "s"),
                column(
                    "delay_s_bound",
                    "largest error of these delays by the clocks' alignment, 0 on one clock",
                    "s",
                ),
                column(
                    "silence_s_max",
                    "longest time since the last reception that was reached in the bin",
                    "s",
                ),
            ],
            values: rows
                .flat_map(|(bin, index)| {
                    [
                        index as f64 * self.width_ns as f64 * 1e-9,
                        bin.sent_count as f64,
                        bin.lost_count as f64,
                        bin.host_lost_count as f64,
                        seconds(bin.delay_p50_ns),
                        seconds(bin.delay_max_ns),
                        bin.delay_bound_ns.map_or(f64::NAN, |ns| ns as f64 * 1e-9),
                        seconds(bin.silence_max_ns),
                    ]
                })
                .collect(),
        }
    }
}

fn index_of(ns: i64, width_ns: i64, count: usize) -> Option<usize> {
    let index = usize::try_from(ns.div_euclid(width_ns)).ok()?;
    (index < count).then_some(index)
}

/// Within a silence its length so far grows from bin to bin. Where it begins is a place on the axis; how
/// long it is, the receiver's own clock says.
fn silences(
    bins: &mut [NetworkBin],
    passages: &Passages,
    duration_ns: i64,
    width_ns: i64,
    place: &Place<'_>,
) {
    let received = || {
        passages
            .each()
            .filter_map(|one| Some((one.received_ns?, ())))
    };
    let mut received = in_order(received).map(|(ns, ())| ns).peekable();
    while let Some(ns) = received.next() {
        let next_ns = received.peek();
        let side = Side::Consumer;
        let Some(from_ns) = place(Moment { side, ns }) else {
            continue;
        };
        let until_ns = next_ns.map_or(duration_ns, |next_ns| {
            from_ns.saturating_add(next_ns.saturating_sub(ns))
        });
        let (first, last) = (from_ns.div_euclid(width_ns), until_ns.div_euclid(width_ns));
        let indexes = first.max(0)..=last;
        let skipped = usize::try_from(first.max(0)).unwrap_or(usize::MAX);
        for (bin, index) in bins.iter_mut().skip(skipped).zip(indexes) {
            let end_ns = until_ns.min((index + 1).saturating_mul(width_ns));
            let silence_ns = end_ns.saturating_sub(from_ns);
            bin.silence_max_ns = bin.silence_max_ns.max(Some(silence_ns));
        }
    }
}
