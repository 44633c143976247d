//! How regularly messages come: rate, gaps, jitter and what is missing by number. It is given
//! times and reads no clock.

use hil_core::message::Envelope;
use hil_stats::histogram::LatencyHistogram;
use serde::Serialize;

use super::observer::Arrival;
use hil_shm::SequenceTracker;

/// Collects the messages of one channel as one place sees them.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    tracker: SequenceTracker,
    last_ns: Option<i64>,
    window: Gaps,
    total: Gaps,
    /// Counted by the tracker when the window began.
    before: Counted,
}

/// The times between messages.
#[derive(Debug, Clone, Default)]
struct Gaps {
    message_count: u64,
    histogram: LatencyHistogram,
    /// Of all gaps, nanoseconds.
    sum_ns: f64,
    /// Of their squares.
    square_sum: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Counted {
    missed: u64,
    restarts: u64,
    reordered: u64,
}

/// Figures of a window or of all time; what needs two messages is `None` before.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PaceMetrics {
    /// Messages that came.
    pub(crate) message_count: u64,
    /// Messages per second: one over the mean gap.
    pub(crate) rate_hz: Option<f64>,
    /// Times between successive messages.
    pub(crate) gap: Option<GapMetrics>,
    /// Numbers below the highest that did not come.
    pub(crate) missed_count: u64,
    /// Messages that came after one with a higher number.
    pub(crate) reordered_count: u64,
    /// New starts of the producer.
    pub(crate) restart_count: u64,
}

/// Times between successive messages, nanoseconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[allow(clippy::struct_field_names, reason = "the unit belongs to the name")]
pub(crate) struct GapMetrics {
    /// Smallest.
    pub(crate) min_ns: i64,
    /// Arithmetic mean.
    pub(crate) mean_ns: f64,
    /// 99th percentile.
    pub(crate) p99_ns: i64,
    /// Largest.
    pub(crate) max_ns: i64,
    /// Standard deviation of the gaps.
    pub(crate) jitter_ns: f64,
}

impl Pace {
    /// A message that came.
    pub(crate) fn take(&mut self, arrival: &Arrival) {
        let Arrival {
            at_ns,
            epoch,
            sequence,
        } = *arrival;
        let envelope = Envelope {
            sequence,
            epoch,
            ..Envelope::default()
        };
        if !self.tracker.accept(&envelope) {
            return;
        }
        let gap_ns = self.last_ns.map(|last_ns| at_ns.saturating_sub(last_ns));
        self.last_ns = Some(at_ns);
        self.window.add(gap_ns);
        self.total.add(gap_ns);
    }

    /// The figures since the last call, or since the first message.
    pub(crate) fn turn(&mut self) -> PaceMetrics {
        let now = self.counted();
        let figures = self.window.metrics(now.since(self.before));
        self.window = Gaps::default();
        self.before = now;
        figures
    }

    /// The figures of all time.
    pub(crate) fn total(&self) -> PaceMetrics {
        self.total.metrics(self.counted())
    }

    fn counted(&self) -> Counted {
        let counters = self.tracker.counters();
        Counted {
            missed: counters.missed_count,
            restarts: counters.restart_count,
            reordered: counters.reordered_count,
        }
    }
}

impl Counted {
    /// A late message may have filled a gap of an earlier window: nothing is missing then.
    const fn since(self, before: Self) -> Self {
        Self {
            missed: self.missed.saturating_sub(before.missed),
            restarts: self.restarts - before.restarts,
            reordered: self.reordered - before.reordered,
        }
    }
}

impl Gaps {
    fn add(&mut self, gap_ns: Option<i64>) {
        self.message_count += 1;
        if let Some(gap_ns) = gap_ns {
            self.histogram.record(gap_ns);
            self.sum_ns += gap_ns as f64;
            self.square_sum += (gap_ns as f64).powi(2);
        }
    }

    fn metrics(&self, counted: Counted) -> PaceMetrics {
        let summary = self.histogram.summary();
        let count = self.histogram.count() as f64;
        let gap = summary.map(|summary| {
            let mean_ns = self.sum_ns / count;
            GapMetrics {
                min_ns: summary.min_ns,
                mean_ns,
                p99_ns: summary.p99_ns,
                max_ns: summary.max_ns,
                jitter_ns: (self.square_sum / count - mean_ns.powi(2)).max(0.0).sqrt(),
            }
        });
        let mean_ns = gap.as_ref().map(|gap| gap.mean_ns);
        PaceMetrics {
            message_count: self.message_count,
            rate_hz: mean_ns.filter(|mean| *mean > 0.0).map(|mean| 1e9 / mean),
            gap,
            missed_count: counted.missed,
            reordered_count: counted.reordered,
            restart_count: counted.restarts,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn take(pace: &mut Pace, at_ns: i64, epoch: u32, sequence: u64) {
        pace.take(&Arrival {
            at_ns,
            epoch,
            sequence,
        });
    }

    #[test]
    fn rate_and_jitter_are_of_the_gaps_between_messages() {
        let mut pace = Pace::default();
        for (number, at_ms) in [0, 4, 8, 14, 16].into_iter().enumerate() {
            take(&mut pace, at_ms * MS, 1, number as u64);
        }
        let figures = pace.turn();
        assert_eq!(figures.message_count, 5);
        assert!((figures.rate_hz.unwrap() - 250.0).abs() < 1e-9);
        let gap = figures.gap.unwrap();
        assert_eq!((gap.min_ns, gap.max_ns), (2 * MS, 6 * MS));
        // Gaps of 4, 4, 6 and 2 ms about a mean of 4 ms.
        assert!((gap.jitter_ns - 2_f64.sqrt() * 1e6).abs() < 1.0, "{gap:?}");
    }

    #[test]
    fn one_message_has_no_rate_and_none_has_nothing() {
        let mut pace = Pace::default();
        assert_eq!(pace.total().rate_hz, None);
        take(&mut pace, 5, 1, 0);
        let figures = pace.turn();
        assert_eq!((figures.message_count, figures.rate_hz), (1, None));
        assert_eq!(figures.gap, None);
    }

    #[test]
    fn a_gap_over_the_border_of_two_windows_is_counted_once() {
        let mut pace = Pace::default();
        take(&mut pace, 0, 1, 0);
        assert_eq!(pace.turn().gap, None);
        take(&mut pace, 10 * MS, 1, 3);
        let figures = pace.turn();
        assert_eq!(figures.gap.unwrap().max_ns, 10 * MS);
        assert_eq!((figures.missed_count, pace.turn().missed_count), (2, 0));
        assert_eq!(pace.total().missed_count, 2);
    }

    #[test]
    fn a_late_message_fills_its_gap_and_a_restart_is_none() {
        let mut pace = Pace::default();
        for (epoch, sequence) in [(1, 0), (1, 2), (1, 1), (2, 0)] {
            take(&mut pace, 0, epoch, sequence);
        }
        let total = pace.total();
        assert_eq!((total.missed_count, total.reordered_count), (0, 1));
        assert_eq!(total.restart_count, 1);
    }
}
