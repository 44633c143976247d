//! How well the hosts kept an emulated link: the delay that the model asked for beside the delay
//! that the gateway gave, and what it had no room for. It judges the emulation, not the model.

use core::borrow::Borrow;

use hil_core::record::{IngressRecord, UNAVAILABLE};
use hil_stats::histogram::{LatencyHistogram, LatencySummary};
use serde::{Deserialize, Serialize};

/// A release may be late by this much at its 99th percentile, whatever the model asks for.
const ERROR_FLOOR_NS: i64 = 1_000_000;
/// Or by this share of the span that the requested delays cover: a smaller error is lost in it.
const ERROR_SPREAD_RATIO: f64 = 0.1;

/// What became of the datagrams that a link model took on one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EmulationMetrics {
    /// The model's delay: from when the gateway had the datagram to when it was due.
    pub requested: LatencySummary,
    /// The delay given: from when the gateway had the datagram to when it had it back.
    pub achieved: LatencySummary,
    /// The second less the first, message by message: how late the host was.
    pub scheduling_error: LatencySummary,
    /// What the 99th percentile of the error may be.
    pub error_max_ns: i64,
    /// Datagrams dropped because the gateway already held as many as it may; `None` when its
    /// counters are not at hand.
    pub overflow_count: Option<u64>,
}

impl EmulationMetrics {
    /// The figures of a channel's arrivals; `None` when no link model took any.
    pub fn of(
        records: impl IntoIterator<Item = impl Borrow<IngressRecord>>,
        overflow_count: Option<u64>,
    ) -> Option<Self> {
        let (mut requested, mut achieved, mut error) = (
            LatencyHistogram::default(),
            LatencyHistogram::default(),
            LatencyHistogram::default(),
        );
        for record in records {
            let record = record.borrow();
            if record.emulated_ns == UNAVAILABLE || record.due_ns == UNAVAILABLE {
                continue;
            }
            // Copied out: a record's fields may not be borrowed where it is packed.
            let (taken, due, back) = (record.emulated_ns, record.due_ns, record.received_ns);
            requested.record(due.saturating_sub(taken));
            achieved.record(back.saturating_sub(taken));
            error.record(back.saturating_sub(due));
        }
        let spread_ns = requested.quantile(0.99)? - requested.quantile(0.01)?;
        #[expect(
            clippy::cast_possible_truncation,
            reason = "a tenth of a difference of two 64-bit numbers"
        )]
        let tolerated_ns = (ERROR_SPREAD_RATIO * spread_ns as f64) as i64;
        Some(Self {
            requested: requested.summary()?,
            achieved: achieved.summary()?,
            scheduling_error: error.summary()?,
            error_max_ns: tolerated_ns.max(ERROR_FLOOR_NS),
            overflow_count,
        })
    }

    /// True when the host did what the model asked for.
    pub fn is_kept(&self) -> bool {
        self.scheduling_error.p99_ns <= self.error_max_ns && self.overflow_count.unwrap_or(0) == 0
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;

    use super::*;
    use crate::assessment::{Assessment, NetworkVerdict};
    use crate::summary::{ChannelSummary, LinkKind, RunSummary};
    use crate::terminal::{Style, render};
    use crate::tests::sample_events::{recorded_channel, summary, ticking};

    /// Delays of 10 to 20 ms in turn, each given back `late_ns` late.
    fn records(late_ns: impl Fn(i64) -> i64) -> Vec<IngressRecord> {
        let record = |index: i64| {
            let emulated_ns = index * 1_000_000;
            let due_ns = emulated_ns + 10_000_000 + index % 101 * 100_000;
            IngressRecord {
                emulated_ns,
                due_ns,
                follow_up_sequence: 0,
                follow_up_ns: UNAVAILABLE,
                received_ns: due_ns + late_ns(index),
                ..IngressRecord::zeroed()
            }
        };
        (1..=10_100).map(record).collect()
    }

    #[test]
    fn requested_and_achieved_delay_differ_by_the_scheduling_error() {
        let figures = EmulationMetrics::of(records(|_| 40_000), Some(0)).unwrap();
        assert_eq!(figures.scheduling_error.max_ns, 40_000);
        let close = |found: i64, expected: i64| (found - expected).abs() <= expected / 900;
        assert!(close(figures.requested.p50_ns, 15_000_000));
        assert!(close(figures.achieved.p50_ns, 15_040_000));
        assert!((figures.achieved.mean_ns - figures.requested.mean_ns - 40_000.0).abs() < 1.0);
        assert!(figures.is_kept());
    }

    #[test]
    fn a_late_host_and_a_full_one_did_not_keep_the_link() {
        // The delays span 10 ms, so a tenth of that is 1 ms: one in fifty is later.
        let late = |index: i64| if index % 50 == 0 { 1_200_000 } else { 0 };
        let figures = EmulationMetrics::of(records(late), Some(0)).unwrap();
        assert_eq!(figures.error_max_ns, ERROR_FLOOR_NS);
        assert!(!figures.is_kept(), "{figures:?}");
        // One in two hundred does not reach the 99th percentile.
        let rarely = |index: i64| if index % 200 == 0 { 1_200_000 } else { 0 };
        assert!(
            EmulationMetrics::of(records(rarely), None)
                .unwrap()
                .is_kept()
        );
        assert!(
            !EmulationMetrics::of(records(|_| 0), Some(1))
                .unwrap()
                .is_kept()
        );
    }

    #[test]
    fn a_run_whose_emulated_link_was_not_kept_blames_neither_network_nor_model() {
        let late = EmulationMetrics::of(records(|_| 3_000_000), Some(7));
        let mut run = summary(recorded_channel());
        run.channels.push(ChannelSummary {
            name: "arm/command".to_owned(),
            to: Some("robot".to_owned()),
            link: LinkKind::Emulated,
            emulation: late.clone(),
            ..recorded_channel()
        });
        run.processes.push(ticking());
        let assessment = Assessment::of(&run);
        let channels = vec!["arm/command".to_owned()];
        let expected = NetworkVerdict::EmulationNotKept { channels };
        assert_eq!(assessment.network, expected);
        let warning = &assessment.warnings[0];
        for part in [
            "the host could not keep the emulated link: arm/command",
            "3.000 ms late at p99, where 1.000 ms are allowed",
            "and 7 found no room",
        ] {
            assert!(warning.contains(part), "{warning}");
        }
        let page = render(&run, 100, Style::Plain);
        assert!(
            page.contains("NOT VALID: the host could not keep the emulated link of arm/command"),
            "{page}"
        );
        let again = RunSummary::from_json(&run.to_json().unwrap()).unwrap();
        assert_eq!(again.channels[1].emulation, late);
        run.channels[1].emulation = EmulationMetrics::of(records(|_| 0), Some(0));
        assert_eq!(Assessment::of(&run).network, NetworkVerdict::EmulatedLink);
    }

    #[test]
    fn a_link_with_a_wide_law_may_be_later() {
        let wide = |index: i64| {
            let mut record = records(|_| 0)[0];
            record.due_ns = record.emulated_ns + index * 1_000_000;
            record.received_ns = record.due_ns + 5_000_000;
            record
        };
        let records: Vec<_> = (0..101).map(wide).collect();
        let figures = EmulationMetrics::of(&records, Some(0)).unwrap();
        assert!(
            figures.error_max_ns > 9_000_000 && figures.is_kept(),
            "{figures:?}"
        );
    }

    #[test]
    fn a_real_link_has_no_such_metrics() {
        let mut real = records(|_| 0);
        for record in &mut real {
            (record.emulated_ns, record.due_ns) = (UNAVAILABLE, UNAVAILABLE);
        }
        assert_eq!(EmulationMetrics::of(&real, Some(0)), None);
        assert_eq!(EmulationMetrics::of(&real[..0], None), None);
    }
}
