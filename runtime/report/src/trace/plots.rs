//! The series of a trace, ready for any plotting program.

use hil_account::BurstCount;
use hil_core::plot::{PlotColumn, PlotSeries};
use hil_trace::metrics::TraceMetrics;
use hil_trace::{Trace, UNBOUNDED_NS};

const fn column(name: &'static str, label: &'static str, unit: &'static str) -> PlotColumn {
    PlotColumn { name, label, unit }
}

/// Steps of the distribution function.
const CDF_STEPS: usize = 400;

/// Every series of `trace`.
pub(super) fn series(trace: &Trace, figures: &TraceMetrics) -> Vec<PlotSeries> {
    vec![
        cdf(trace),
        runs("bursts", "losses in a row", &figures.loss_bursts),
        runs("deliveries", "deliveries in a row", &figures.delivery_runs),
        memory(figures),
        over_time(trace),
    ]
}

fn made(name: &str, title: &str, columns: Vec<PlotColumn>, values: Vec<f64>) -> PlotSeries {
    PlotSeries {
        name: name.to_owned(),
        title: title.to_owned(),
        notes: Vec::new(),
        panel_lines: None,
        columns,
        values,
    }
}

fn cdf(trace: &Trace) -> PlotSeries {
    let mut delays = trace.delays_ns();
    delays.sort_unstable();
    let steps = if delays.is_empty() { 0 } else { CDF_STEPS };
    let point = |step: usize| {
        let rank = (step * (delays.len() - 1)) / CDF_STEPS;
        [
            delays[rank] as f64 * 1e-6,
            (rank + 1) as f64 / delays.len() as f64,
        ]
    };
    let bound_ms = bound_ms(trace.delay_bound_ns());
    let point = |step: usize| {
        let [delay_ms, share] = point(step);
        [delay_ms, share, bound_ms]
    };
    let values = (0..=steps).filter(|_| steps > 0).flat_map(point).collect();
    let columns = vec![
        column("delay_ms", "delay", "ms"),
        column(
            "share_ratio",
            "share of the delivered messages up to it",
            "1",
        ),
        column(
            "bound_ms",
            "largest error of any delay by the clocks, empty where unknown",
            "ms",
        ),
    ];
    made("cdf", "distribution of the delay", columns, values)
}

fn bound_ms(bound_ns: Option<u64>) -> f64 {
    bound_ns.map_or(f64::NAN, |ns| ns as f64 * 1e-6)
}

fn runs(name: &str, title: &str, runs: &[BurstCount]) -> PlotSeries {
    let values = runs
        .iter()
        .flat_map(|run| [run.length_messages as f64, run.count as f64])
        .collect();
    let columns = vec![
        column("length_messages", "messages in a row", "1"),
        column("count", "how often", "1"),
    ];
    made(name, title, columns, values)
}

fn memory(figures: &TraceMetrics) -> PlotSeries {
    let of = |which: &Option<hil_trace::metrics::Memory>| {
        which
            .as_ref()
            .map_or(Vec::new(), |memory| memory.coefficients.clone())
    };
    let (loss, delay) = (of(&figures.loss_memory), of(&figures.delay_memory));
    let at = |series: &[f64], lag: usize| series.get(lag).copied().unwrap_or(f64::NAN);
    let lags = 0..loss.len().max(delay.len());
    let values = lags
        .flat_map(|lag| [(lag + 1) as f64, at(&loss, lag), at(&delay, lag)])
        .collect();
    let columns = vec![
        column("lag_messages", "lag", "1"),
        column("loss_correlation", "autocorrelation of loss", "1"),
        column("delay_correlation", "autocorrelation of delay", "1"),
    ];
    made(
        "memory",
        "how long losses and delays remember",
        columns,
        values,
    )
}

fn over_time(trace: &Trace) -> PlotSeries {
    let values = trace
        .records
        .iter()
        .flat_map(|record| {
            let delay = record.delay().map_or(f64::NAN, |ns| ns as f64 * 1e-6);
            let is_lost = f64::from(record.fate.is_loss());
            let bound_ns = record.delay().map(|_| record.bound_ns);
            let bound = bound_ms(bound_ns.filter(|ns| *ns != UNBOUNDED_NS));
            [record.published_ns as f64 * 1e-9, delay, bound, is_lost]
        })
        .collect();
    let columns = vec![
        column("published_s", "publication, since the run's start", "s"),
        column("delay_ms", "delay, empty where there is none", "ms"),
        column(
            "bound_ms",
            "its largest error by the clocks, empty where unknown",
            "ms",
        ),
        column("lost", "1 when it was lost", "1"),
    ];
    made("time", "every message", columns, values)
}
