//! What an emulated link does, written back in the shape of the file; see `resolved`. It leaves
//! nothing out and repeats no default of the file's own.

use core::time::Duration;

use hil_link::delay::DelayLaw;
use hil_link::loss::LossLaw;
use hil_link::outages::Outages;
use hil_link::spec::LinkSpec;
use toml::{Table, Value};

use super::resolved::{duration, integer, put};

/// The table of one direction, without what both share.
pub(super) fn resolved_spec(spec: &LinkSpec) -> Table {
    let mut table = Table::new();
    match &spec.delay {
        DelayLaw::Fixed(law) => put(&mut table, "delay", duration(law.delay)),
        law => put(&mut table, "delay", resolved_delay(law, spec.reorders)),
    }
    match &spec.loss {
        LossLaw::Bernoulli(law) => put(&mut table, "loss_ratio", law.ratio),
        law => put(&mut table, "loss", resolved_loss(law)),
    }
    if let Some(rate) = &spec.rate {
        let mut rates = Table::new();
        put(&mut rates, "bits_per_second", integer(rate.bits_per_second));
        put(&mut rates, "queue_bytes", integer(rate.queue_bytes));
        put(&mut rates, "overhead_bytes", integer(rate.overhead_bytes));
        put(&mut table, "rate", rates);
    }
    if let Some(one) = &spec.reordering {
        put(
            &mut table,
            "reordering",
            struck(one.ratio, "hold", one.hold),
        );
    }
    if let Some(one) = &spec.duplication {
        put(&mut table, "duplication", struck(one.ratio, "lag", one.lag));
    }
    table
}

/// The table of what strikes both directions at once.
pub(super) fn resolved_outages(outages: Outages) -> Table {
    let mut table = Table::new();
    let mean = Duration::from_secs_f64(outages.mean_s);
    put(&mut table, "mean", duration(mean));
    put(&mut table, "per_hour", outages.per_hour);
    put(&mut table, "buffered", outages.buffered);
    table
}

fn struck(ratio: f64, key: &str, later: Duration) -> Table {
    let mut table = Table::new();
    put(&mut table, "ratio", ratio);
    put(&mut table, key, duration(later));
    table
}

fn resolved_delay(law: &DelayLaw, reorders: bool) -> Table {
    let mut table = Table::new();
    let mut times = |word: &str, times: &[(&str, Duration)]| {
        put(&mut table, "law", word);
        for (key, time) in times {
            put(&mut table, key, duration(*time));
        }
    };
    match law {
        DelayLaw::Fixed(law) => times("fixed", &[("delay", law.delay)]),
        DelayLaw::Uniform(law) => times("uniform", &[("min", law.min), ("max", law.max)]),
        DelayLaw::Normal(law) => times(
            "normal",
            &[
                ("mean", law.mean),
                ("deviation", law.deviation),
                ("max", law.max),
            ],
        ),
        DelayLaw::LogNormal(law) => {
            times(
                "log-normal",
                &[("min", law.min), ("median", law.median), ("max", law.max)],
            );
            put(&mut table, "sigma", law.sigma);
        }
        DelayLaw::Exponential(law) => times(
            "exponential",
            &[
                ("min", law.min),
                ("mean_excess", law.mean_excess),
                ("max", law.max),
            ],
        ),
        DelayLaw::Pareto(law) => {
            times(
                "pareto",
                &[("min", law.min), ("scale", law.scale), ("max", law.max)],
            );
            put(&mut table, "shape", law.shape);
        }
        DelayLaw::Histogram(law) => {
            put(&mut table, "law", "histogram");
            let edges: Vec<Value> = law.edges.iter().copied().map(duration).collect();
            put(&mut table, "edges", edges);
            put(&mut table, "weights", law.weights.clone());
        }
    }
    if !law.is_fixed() {
        put(&mut table, "reorders", reorders);
    }
    table
}

fn resolved_loss(law: &LossLaw) -> Table {
    let mut table = Table::new();
    let (bad, good) = match law {
        LossLaw::Bernoulli(law) => {
            put(&mut table, "law", "bernoulli");
            put(&mut table, "ratio", law.ratio);
            return table;
        }
        LossLaw::GilbertElliott(law) => {
            put(&mut table, "law", "gilbert-elliott");
            put(&mut table, "to_bad", law.to_bad);
            put(&mut table, "to_good", law.to_good);
            (law.bad_loss_ratio, law.good_loss_ratio)
        }
        LossLaw::Bursts(law) => {
            put(&mut table, "law", "bursts");
            put(&mut table, "good_mean", duration(law.good_mean));
            put(&mut table, "bad_mean", duration(law.bad_mean));
            (law.bad_loss_ratio, law.good_loss_ratio)
        }
    };
    put(&mut table, "bad_loss_ratio", bad);
    put(&mut table, "good_loss_ratio", good);
    table
}
