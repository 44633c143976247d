//! What a link model was asked for and what it did in virtual time, per channel. Here achieved is
//! what the model said: virtual time is never late.

use core::fmt::Write;

use hil_models::link_model::{Fate, LossCauses};
use hil_models::stats::histogram::{LatencyHistogram, LatencySummary};
use hil_models::stats::statistics::wilson;
use hil_models::time::Instant;
use serde::Serialize;

use crate::report::terminal::duration;

/// What a link does to a channel, counted while it does.
#[derive(Debug, Default)]
pub(super) struct LinkTally {
    offered_count: u64,
    lost_count: u64,
    duplicated_count: u64,
    overtaken_count: u64,
    newest_arrival: Option<Instant>,
    delays: LatencyHistogram,
    causes: Option<LossCauses>,
}

/// The same when it is over.
#[derive(Debug, Clone, Serialize)]
pub(super) struct LinkFigures {
    /// The model in words.
    model: String,
    /// Share of the messages that its loss law loses in the long run, without outages and full
    /// queues; `None` for a replayed trace.
    requested_loss_ratio: Option<f64>,
    /// Messages offered.
    offered_count: u64,
    /// Of those, lost.
    lost_count: u64,
    /// 95 % Wilson interval of the loss ratio; `None` when nothing was offered. It takes losses to
    /// be independent.
    loss_ratio_interval: Option<(f64, f64)>,
    /// What they were lost to; `None` when the model does not tell.
    lost_to: Option<LossCauses>,
    /// Messages that arrived twice.
    duplicated_count: u64,
    /// Messages that arrived after one that set out later.
    overtaken_count: u64,
    /// Delay of the first arrivals; `None` when there were none.
    delay: Option<LatencySummary>,
}

impl LinkTally {
    /// Counts what became of a message offered at `now`.
    pub(super) fn count(&mut self, now: Instant, fate: Fate, causes: Option<LossCauses>) {
        self.offered_count += 1;
        self.causes = causes;
        let Some(at) = fate.arrival() else {
            self.lost_count += 1;
            return;
        };
        self.duplicated_count += u64::from(fate.second_arrival().is_some());
        self.delays.record(at.ns_since(now));
        self.overtaken_count += u64::from(self.newest_arrival.is_some_and(|newest| at < newest));
        self.newest_arrival = self.newest_arrival.max(Some(at));
    }

    /// The figures, of a model that `model` describes.
    pub(super) fn figures(&self, model: &str, requested_loss_ratio: Option<f64>) -> LinkFigures {
        let interval = wilson(self.lost_count, self.offered_count, 0.95);
        LinkFigures {
            model: model.to_owned(),
            requested_loss_ratio,
            offered_count: self.offered_count,
            lost_count: self.lost_count,
            loss_ratio_interval: interval.map(|interval| (interval.low, interval.high)),
            lost_to: self.causes,
            duplicated_count: self.duplicated_count,
            overtaken_count: self.overtaken_count,
            delay: self.delays.summary(),
        }
    }
}

impl LinkFigures {
    /// Lines of a page.
    pub(super) fn page(&self, channel: &str) -> String {
        let mut text = format!("  {channel}: {}\n", self.model);
        let mut line = |words: String| {
            let _infallible = writeln!(text, "    {words}");
        };
        match &self.delay {
            Some(delay) => line(format!(
                "delay p50 {}, p99 {}, max {}, mean {:.6} ms",
                duration(delay.p50_ns),
                duration(delay.p99_ns),
                duration(delay.max_ns),
                delay.mean_ns * 1e-6
            )),
            None => line("delay unavailable: nothing arrived".to_owned()),
        }
        let ratio = match self.loss_ratio_interval {
            Some((low, high)) => format!(
                "{:.6} ({low:.6} to {high:.6}, 95 % Wilson)",
                self.lost_count as f64 / self.offered_count as f64
            ),
            None => "unavailable: nothing was offered".to_owned(),
        };
        let causes = self.lost_to.map_or_else(String::new, |causes| {
            format!(
                ": {} to outages, {} by chance, {} to a full queue",
                causes.outage_count, causes.chance_count, causes.queue_count
            )
        });
        line(format!(
            "lost {} of {}{causes}; loss ratio {ratio}",
            self.lost_count, self.offered_count
        ));
        if self.duplicated_count + self.overtaken_count > 0 {
            line(format!(
                "twice {}, overtaken {}",
                self.duplicated_count, self.overtaken_count
            ));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tally_says_what_became_of_the_messages() {
        let at = |ms: i64| Instant::from_ns(ms * 1_000_000);
        let mut tally = LinkTally::default();
        let causes = LossCauses {
            chance_count: 1,
            ..LossCauses::default()
        };
        tally.count(at(0), Fate::Delivered(at(30)), None);
        tally.count(at(1), Fate::Delivered(at(11)), None);
        tally.count(at(2), Fate::Lost, Some(causes));
        let twice = Fate::Duplicated {
            first: at(33),
            second: at(40),
        };
        tally.count(at(3), twice, Some(causes));
        let figures = tally.figures("30 ms", Some(0.25));
        let counts = (figures.offered_count, figures.lost_count);
        assert_eq!(counts, (4, 1));
        assert_eq!((figures.duplicated_count, figures.overtaken_count), (1, 1));
        let page = figures.page("arm/command");
        assert!(page.contains("arm/command: 30 ms\n"), "{page}");
        assert!(
            page.contains("lost 1 of 4: 0 to outages, 1 by chance, 0 to a full"),
            "{page}"
        );
        assert!(
            page.contains("loss ratio 0.250000 (0.045587 to 0.699358"),
            "{page}"
        );
        let nothing = LinkTally::default().figures("x", None).page("a/b");
        assert!(
            nothing.contains("unavailable: nothing arrived"),
            "{nothing}"
        );
        assert!(
            nothing.contains("unavailable: nothing was offered"),
            "{nothing}"
        );
    }
}
