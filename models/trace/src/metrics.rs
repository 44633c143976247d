//! What a trace says of its link: loss ratio, lengths of bursts and gaps, memory of losses and of
//! delays, quantiles, the longest outage. Every share and quantile has its interval. It fits no
//! model: see [`super::fit`].

use serde::{Deserialize, Serialize};

use super::{Trace, TraceCounts, TraceFate, TraceRecord};
use hil_account::network::{Metric, OrderMetrics};
use hil_account::{BurstCount, BurstLengths, OutageFinder, OutageMetrics};
use hil_core::interval::Spread;
use hil_core::time::Instant;
use hil_stats::dependence::{Batches, Quantiles};
use hil_stats::histogram::Distribution;
use hil_stats::samples::Samples;

/// Quantiles with an interval of their own.
pub const QUANTILES: [f64; 6] = [0.01, 0.1, 0.5, 0.9, 0.99, 0.999];
/// Longest lag of an autocorrelation, messages.
pub const LAG_MAX: usize = 100;

/// One quantile of the delay.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QuantileMetric {
    /// Which, 0..=1.
    pub quantile: f64,
    /// Its value.
    pub value_ns: i64,
    /// 95 % interval, nanoseconds, or why there is none; `None` when no delay differs.
    pub interval: Option<Spread>,
}

/// A time without any delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct TraceOutage {
    /// Publication of its first lost message, since the start of the run.
    pub from_ns: i64,
    /// To the publication of the next message delivered, or to the last record.
    pub length_ns: i64,
    /// Messages lost in it.
    pub lost_count: u64,
    /// True when nothing was delivered after it.
    pub is_open: bool,
}

/// How strongly what one message meets depends on what those before it met.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// Correlation coefficient at lag 1, 2, ... messages.
    pub coefficients: Vec<f64>,
    /// An independent series stays within this of zero at 95 % of the lags.
    pub independent_within: f64,
}

/// The figures of a trace.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TraceMetrics {
    /// Messages by fate.
    pub counts: TraceCounts,
    /// Lost ones among those whose fate is known.
    pub loss_ratio: Option<f64>,
    /// Its 95 % interval, or why there is none.
    pub loss_ratio_interval: Option<Spread>,
    /// Losses in a row, by length. A message of unknown fate ends a row.
    pub loss_bursts: Vec<BurstCount>,
    /// Deliveries in a row, by length.
    pub delivery_runs: Vec<BurstCount>,
    /// Of losses; `None` when none or all were lost.
    pub loss_memory: Option<Memory>,
    /// Of successive delivered messages' delays; `None` when they do not vary.
    pub delay_memory: Option<Memory>,
    /// All delays of messages that were delivered.
    pub delay: Distribution,
    /// Delays of messages that arrived and were not published, mostly because they came too late;
    /// in no other figure of delays.
    pub late_delay: Distribution,
    /// With intervals.
    pub quantiles: Vec<QuantileMetric>,
    /// Each delay less the smallest one (RFC 5481, section 4.2: PDV).
    pub delay_variation: Distribution,
    /// Difference of the delays of two messages with successive numbers, both delivered, as magnitudes
    /// (RFC 5481, section 4.1: IPDV).
    pub successive_variation: Distribution,
    /// By the instants of arrival.
    pub order: Metric<OrderMetrics>,
    /// Largest error of any delay from the clocks, 0 on one clock; `None` without delays, and when
    /// that of one of them is not known.
    pub bound_max_ns: Option<u64>,
    /// Longest time without a delivery.
    pub longest_outage: Option<TraceOutage>,
    /// Middle time from one publication to the next.
    pub period_ns: Option<i64>,
    /// Messages per second, first to last publication.
    pub rate_hz: Option<f64>,
    /// Payload per second over that time.
    pub rate_bytes_per_s: Option<f64>,
}

impl TraceMetrics {
    /// The figures of `trace`.
    pub fn of(trace: &Trace) -> Self {
        let counts = trace.counts();
        let known_count = counts.message_count - counts.unknown_count;
        let delays_ns = trace.delays_ns();
        let reason = if counts.delivered_count == 0 {
            "no message was delivered"
        } else if trace.header.clock.is_empty() {
            "the trace tells no delay"
        } else {
            trace.header.clock.as_str()
        };
        let losses = known_losses(trace);
        let as_numbers: Vec<f64> = losses.iter().map(|is_lost| f64::from(*is_lost)).collect();
        let delays: Vec<f64> = delays_ns.iter().map(|ns| *ns as f64).collect();
        let (rate_hz, rate_bytes_per_s) = rates(&trace.records);
        let runs = |of_losses| run_counts(trace, of_losses);
        Self {
            counts,
            loss_ratio: (known_count > 0).then(|| counts.lost_count() as f64 / known_count as f64),
            loss_ratio_interval: (known_count > 0)
                .then(|| Batches::of(as_numbers.iter().copied()).share_interval()),
            loss_bursts: runs(true),
            delivery_runs: runs(false),
            loss_memory: memory(&as_numbers),
            delay_memory: memory(&delays),
            delay: Distribution::of_samples(&delays_ns, reason),
            late_delay: Distribution::of_samples(
                &trace.late_delays_ns(),
                "no message is known to have come too late",
            ),
            quantiles: quantiles(&delays_ns),
            delay_variation: Distribution::of_samples(&above_smallest(&delays_ns), reason),
            successive_variation: Distribution::of_samples(
                &successive_differences(&trace.records),
                "no two messages with successive numbers have a delay",
            ),
            order: order(&trace.records),
            bound_max_ns: trace.delay_bound_ns(),
            longest_outage: longest_outage(&trace.records),
            period_ns: trace.period_ns(),
            rate_hz,
            rate_bytes_per_s,
        }
    }
}

/// Whether each message of known fate was lost, in order.
pub fn known_losses(trace: &Trace) -> Vec<bool> {
    let known = trace.records.iter();
    let known = known.filter(|record| record.fate != TraceFate::Unknown);
    known.map(|record| record.fate.is_loss()).collect()
}

fn run_counts(trace: &Trace, of_losses: bool) -> Vec<BurstCount> {
    let (mut lengths, mut length) = (BurstLengths::default(), 0);
    for record in &trace.records {
        let is_known = record.fate != TraceFate::Unknown;
        if is_known && record.fate.is_loss() == of_losses {
            length += 1;
        } else {
            lengths.add(core::mem::take(&mut length));
        }
    }
    lengths.add(length);
    lengths.finish()
}

/// Sample autocorrelation (Box and Jenkins, equation 2.1.11) up to [`LAG_MAX`] or a quarter of the
/// series.
fn memory(series: &[f64]) -> Option<Memory> {
    let n = series.len() as f64;
    let mean = series.iter().sum::<f64>() / n;
    let centred: Vec<f64> = series.iter().map(|value| value - mean).collect();
    let variance: f64 = centred.iter().map(|value| value * value).sum();
    let lag_max = LAG_MAX.min(series.len() / 4);
    if lag_max == 0 || variance <= 0.0 {
        return None;
    }
    let at = |lag: usize| {
        let products = centred.iter().zip(&centred[lag..]);
        products.map(|(a, b)| a * b).sum::<f64>() / variance
    };
    Some(Memory {
        coefficients: (1..=lag_max).map(at).collect(),
        independent_within: 1.96 / n.sqrt(),
    })
}

fn above_smallest(delays_ns: &[i64]) -> Vec<i64> {
    let smallest_ns = delays_ns.iter().copied().min().unwrap_or(0);
    let delays = delays_ns.iter();
    delays.map(|ns| ns.saturating_sub(smallest_ns)).collect()
}

fn successive_differences(records: &[TraceRecord]) -> Vec<i64> {
    let delay_ns = |record: &TraceRecord| {
        let is_delivered = record.fate == TraceFate::Delivered;
        record.delay().filter(|_| is_delivered)
    };
    let pairs = records.windows(2).filter_map(|pair| {
        let is_next = pair[0].start == pair[1].start
            && pair[0].sequence.checked_add(1) == Some(pair[1].sequence);
        let delays = delay_ns(&pair[0]).zip(delay_ns(&pair[1]));
        let (one, other) = delays.filter(|_| is_next)?;
        Some(other.saturating_sub(one).saturating_abs())
    });
    pairs.collect()
}

/// Of the messages whose arrival is known. Those that arrived at once keep the order of their publication.
fn order(records: &[TraceRecord]) -> Metric<OrderMetrics> {
    let delivered = records.iter();
    let mut delivered = delivered.filter(|record| record.fate == TraceFate::Delivered);
    if delivered.any(|record| record.delay().is_none()) {
        return Metric::unavailable(
            "a message was delivered whose instant of arrival is not known",
        );
    }
    let has_arrived = |record: &TraceRecord| {
        matches!(record.fate, TraceFate::Delivered | TraceFate::LostAfterLink)
    };
    let arrived = records.iter().filter(|record| has_arrived(record));
    let arrivals =
        arrived.filter_map(|record| Some(record.departure_ns.saturating_add(record.delay()?)));
    let mut arrivals: Vec<(i64, u64)> = arrivals.zip(0..).collect();
    arrivals.sort_unstable();
    OrderMetrics::of(arrivals.into_iter().map(|(_, number)| number)).map_or_else(
        || Metric::unavailable("no message has a known instant of arrival"),
        Metric::Measured,
    )
}

fn quantiles(delays_ns: &[i64]) -> Vec<QuantileMetric> {
    if delays_ns.is_empty() {
        return Vec::new();
    }
    let series: Samples = delays_ns.iter().copied().collect();
    let ascending = series.ascending();
    let intervals = Quantiles::of(&series, &ascending);
    let of = |quantile: f64| QuantileMetric {
        quantile,
        value_ns: ascending.at_share(quantile),
        interval: intervals.interval(quantile),
    };
    QUANTILES.into_iter().map(of).collect()
}

fn longest_outage(records: &[TraceRecord]) -> Option<TraceOutage> {
    let mut outages = OutageFinder::default();
    for record in records {
        let published_ns = Some(record.published_ns);
        if record.fate.is_loss() {
            let is_by_network = record.fate == TraceFate::LostInNetwork;
            outages.lost(record.sequence, 1, published_ns, is_by_network);
        } else if record.fate == TraceFate::Delivered {
            outages.arrived(published_ns, None);
        }
    }
    let end = Instant::from_ns(records.last()?.published_ns);
    let longest = OutageMetrics::of(&outages.finish(), Some(end)).longest?;
    Some(TraceOutage {
        from_ns: longest.start_ns,
        length_ns: longest.length_ns,
        lost_count: longest.lost_count,
        is_open: longest.is_open,
    })
}

fn rates(records: &[TraceRecord]) -> (Option<f64>, Option<f64>) {
    let ends = records.first().zip(records.last());
    let span_s = ends.map_or(0.0, |(first, last)| {
        last.published_ns.saturating_sub(first.published_ns) as f64 * 1e-9
    });
    if span_s <= 0.0 {
        return (None, None);
    }
    let bytes: u64 = records[1..]
        .iter()
        .map(|record| u64::from(record.size_bytes))
        .sum();
    let steps = (records.len() - 1) as f64;
    (Some(steps / span_s), Some(bytes as f64 / span_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{TraceHeader, UNAVAILABLE_NS};
    use hil_core::random::RandomStream;

    const MS: i64 = 1_000_000;

    /// One message every 10 ms; `x` is lost, `?` unknown, a digit its delay in milliseconds.
    pub(crate) fn trace(fates: &str) -> Trace {
        let record = |(index, fate): (u64, char)| {
            let published_ns = i64::try_from(index).unwrap() * 10 * MS;
            let mut record = TraceRecord::published(published_ns, index, 25);
            match fate.to_digit(10) {
                Some(ms) => record = record.delivered(i64::from(ms) * MS, 7),
                None if fate == 'x' => record.fate = TraceFate::LostInNetwork,
                None => {}
            }
            record
        };
        Trace {
            header: TraceHeader::new("a/b"),
            records: (0..).zip(fates.chars()).map(record).collect(),
        }
    }

    #[test]
    fn ratio_bursts_gaps_and_outage_are_those_of_the_fates() {
        let figures = TraceMetrics::of(&trace("11xx2?x11xxx3x?"));
        assert_eq!(figures.counts.lost_count(), 7);
        assert_eq!(figures.counts.unknown_count, 2);
        let ratio = figures.loss_ratio.unwrap();
        assert!((ratio - 7.0 / 13.0).abs() < 1e-12);
        let interval = figures.loss_ratio_interval.unwrap();
        assert_eq!(interval.known(), None, "13 messages are too few");
        let pairs = |runs: &[BurstCount]| -> Vec<(u64, u64)> {
            let runs = runs.iter();
            runs.map(|run| (run.length_messages, run.count)).collect()
        };
        assert_eq!(pairs(&figures.loss_bursts), [(1, 2), (2, 1), (3, 1)]);
        assert_eq!(pairs(&figures.delivery_runs), [(1, 2), (2, 2)]);
        let outage = figures.longest_outage.unwrap();
        assert_eq!((outage.from_ns, outage.length_ns), (90 * MS, 30 * MS));
        assert_eq!((outage.lost_count, outage.is_open), (3, false));
        assert_eq!(figures.period_ns, Some(10 * MS));
        assert!((figures.rate_hz.unwrap() - 100.0).abs() < 1e-9);
        assert!((figures.rate_bytes_per_s.unwrap() - 2_500.0).abs() < 1e-6);
        assert_eq!(figures.bound_max_ns, Some(7));
        assert_eq!(figures.delay.measured().unwrap().count, 6);
    }

    #[test]
    fn order_and_both_variations_are_those_of_the_instants_of_arrival_whatever_the_flags_say() {
        // The fourth of ten arrives at 75 ms, behind the four that were published after it.
        let mut traced = trace("1111111111");
        traced.records[3].delay_ns = 45 * MS;
        let figures = TraceMetrics::of(&traced);
        let order = *figures.order.measured().unwrap();
        let extents = (order.extent_p50, order.extent_max, order.n_max);
        assert_eq!((order.count, order.reordered_count), (10, 1));
        assert_eq!(extents, (Some(4), Some(4), Some(4)));
        let above = *figures.delay_variation.measured().unwrap();
        assert_eq!((above.p50_ns, above.max_ns), (0, 44 * MS));
        let pairs = *figures.successive_variation.measured().unwrap();
        assert_eq!((pairs.count, pairs.p50_ns, pairs.max_ns), (9, 0, 44 * MS));
        // Flags tell of what a gateway saw; here it saw nothing late.
        traced.records[3].delay_ns = MS;
        traced.records[5].flags = TraceRecord::REORDERED;
        traced.records[5].fate = TraceFate::LostAfterLink;
        let order = TraceMetrics::of(&traced).order;
        assert_eq!(order.measured().unwrap().reordered_count, 0);
        // A loss parts successive numbers, and an arrival without an instant leaves the order open.
        let parted = TraceMetrics::of(&trace("1x1")).successive_variation;
        assert!(parted.measured().is_none());
        traced.records[0].delay_ns = UNAVAILABLE_NS;
        assert!(TraceMetrics::of(&traced).order.measured().is_none());
        assert!(TraceMetrics::of(&trace("x?")).order.measured().is_none());
    }

    #[test]
    fn a_bound_that_one_delay_does_not_have_is_known_of_none() {
        let mut traced = trace("1122");
        traced.records[2].bound_ns = 90;
        assert_eq!(TraceMetrics::of(&traced).bound_max_ns, Some(90));
        traced.records[0].bound_ns = crate::UNBOUNDED_NS;
        assert_eq!(TraceMetrics::of(&traced).bound_max_ns, None);
        assert_eq!(TraceMetrics::of(&trace("xx")).bound_max_ns, None);
    }

    #[test]
    fn what_came_too_late_has_its_delay_in_a_figure_of_its_own() {
        let mut traced = trace("11911");
        traced.records[2].fate = TraceFate::LostAfterLink;
        let figures = TraceMetrics::of(&traced);
        assert_eq!(figures.delay.measured().unwrap().max_ns, MS);
        let late = figures.late_delay.measured().unwrap();
        assert_eq!((late.count, late.max_ns), (1, 9 * MS));
        assert!(
            TraceMetrics::of(&trace("1x"))
                .late_delay
                .measured()
                .is_none()
        );
    }

    #[test]
    fn memory_tells_bursts_from_independent_losses() {
        let mut random = RandomStream::new(3, "memory");
        let mut is_bad = false;
        let (mut bursty, mut single) = (String::new(), String::new());
        for _ in 0..20_000 {
            is_bad = if is_bad {
                random.chance(0.8)
            } else {
                random.chance(0.05)
            };
            bursty.push(if is_bad { 'x' } else { '3' });
            single.push(if random.chance(0.2) { 'x' } else { '3' });
        }
        let of = |fates: &str| TraceMetrics::of(&trace(fates)).loss_memory.unwrap();
        // A two-state chain has 1 - 0.05 - 0.2 at lag 1 and its powers after that.
        let bursty = of(&bursty).coefficients;
        assert!((bursty[0] - 0.75).abs() < 0.03, "{}", bursty[0]);
        assert!((bursty[3] - 0.75_f64.powi(4)).abs() < 0.05, "{}", bursty[3]);
        let single = of(&single);
        let within = single.independent_within;
        let outside = single.coefficients.iter().filter(|c| c.abs() > within);
        assert!(outside.count() <= 12, "5 of 100 are expected");
    }

    #[test]
    fn a_quantile_with_too_few_delays_beyond_it_has_no_interval() {
        let delays = |count: i64| (0..count).map(|at| at * 7_919 % 9_973).collect::<Vec<_>>();
        let with = |count| -> Vec<f64> {
            let figures = quantiles(&delays(count)).into_iter();
            let told = figures.filter(|one| one.interval.is_some_and(|one| one.known().is_some()));
            told.map(|figure| figure.quantile).collect()
        };
        assert_eq!(with(50), [0.0; 0]);
        assert!(!with(1_000).contains(&0.999));
    }

    #[test]
    fn an_empty_or_lossless_trace_makes_up_nothing() {
        let empty = TraceMetrics::of(&trace(""));
        assert_eq!((empty.loss_ratio, empty.rate_hz), (None, None));
        assert!(empty.quantiles.is_empty() && empty.longest_outage.is_none());
        let lossless = TraceMetrics::of(&trace("555"));
        assert_eq!(lossless.loss_ratio, Some(0.0));
        assert_eq!(lossless.loss_memory, None);
        let open = TraceMetrics::of(&trace("5xx")).longest_outage.unwrap();
        assert_eq!((open.length_ns, open.is_open), (10 * MS, true));
    }
}
