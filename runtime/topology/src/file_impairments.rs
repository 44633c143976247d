//! What an emulated link's tables say about what it does to messages, in each direction; see
//! `file_links`. It builds no model.

use core::time::Duration;

use hil_core::case_study::ParameterError;
use hil_link::delay::{
    DelayLaw, Exponential, Fixed, Histogram, LogNormal, Normal, Pareto, Uniform,
};
use hil_link::loss::{Bernoulli, Bursts, GilbertElliott, LossLaw};
use hil_link::outages::Outages;
use hil_link::rate::RateLimit;
use hil_link::reordering::{Duplication, Reordering};
use hil_link::spec::LinkSpec;

use super::errors::Fault;
use super::file_trace::read_trace;
use super::file_wifi::read_wifi;
use super::limits::{self, Limit};
use super::model_links::Emulation;
use super::reader::Reader;

/// Keys that only an emulated link has.
pub(super) const EMULATION_KEYS: &[&str] = &[
    "delay",
    "loss_ratio",
    "loss",
    "rate",
    "reordering",
    "duplication",
    "forward",
    "backward",
    "outages",
    "trace",
    "wifi",
];

#[derive(Debug, Clone, Copy)]
enum DelayWord {
    Fixed,
    Uniform,
    Normal,
    LogNormal,
    Exponential,
    Pareto,
    Histogram,
}

const DELAY_WORDS: &[(&str, DelayWord)] = &[
    ("fixed", DelayWord::Fixed),
    ("uniform", DelayWord::Uniform),
    ("normal", DelayWord::Normal),
    ("log-normal", DelayWord::LogNormal),
    ("exponential", DelayWord::Exponential),
    ("pareto", DelayWord::Pareto),
    ("histogram", DelayWord::Histogram),
];

#[derive(Debug, Clone, Copy)]
enum LossWord {
    Bernoulli,
    GilbertElliott,
    Bursts,
}

/// The names of the delay laws.
pub(super) fn delay_laws() -> impl Iterator<Item = &'static str> {
    DELAY_WORDS.iter().map(|(word, _)| *word)
}

const LOSS_WORDS: &[(&str, LossWord)] = &[
    ("bernoulli", LossWord::Bernoulli),
    ("gilbert-elliott", LossWord::GilbertElliott),
    ("bursts", LossWord::Bursts),
];

/// The names of the loss laws.
pub(super) fn loss_laws() -> impl Iterator<Item = &'static str> {
    LOSS_WORDS.iter().map(|(word, _)| *word)
}

/// Reads what the link does: each direction does what is said for both, but for the parts it has a
/// key or table of its own for.
pub(super) fn read_emulation(reader: &mut Reader<'_>) -> Emulation {
    let none = LinkSpec {
        wifi: read_wifi(reader),
        outages: read_outages(reader.table("outages"), NO_OUTAGES),
        ..LinkSpec::default()
    };
    let both = read_spec(reader, &none);
    let mut direction = |key| match reader.table(key) {
        Some(mut reader) => {
            let spec = read_spec(&mut reader, &both);
            reader.finish();
            spec
        }
        None => both.clone(),
    };
    Emulation {
        forward: direction("forward"),
        backward: direction("backward"),
        trace: read_trace(reader),
    }
}

fn read_spec(reader: &mut Reader<'_>, default: &LinkSpec) -> LinkSpec {
    let mut spec = default.clone();
    if reader.is_table("delay") {
        if let Some((law, reorders)) = reader.table("delay").and_then(read_delay) {
            (spec.delay, spec.reorders) = (law, reorders);
        }
    } else if let Some(delay) = reader.duration("delay", &limits::LINK_DELAY) {
        (spec.delay, spec.reorders) = (DelayLaw::fixed(delay), false);
    }
    let ratio = reader.number("loss_ratio", &limits::LINK_LOSS_RATIO);
    if let Some(ratio) = ratio {
        spec.loss = LossLaw::bernoulli(ratio);
    }
    if let Some(table) = reader.table_or("loss", "a table with a law; did you mean `loss_ratio`?") {
        if ratio.is_some() {
            let why = "beside [loss] says the loss twice; leave one of them out";
            reader.refuse_present(&["loss_ratio"], why);
        }
        spec.loss = read_loss(table).unwrap_or(spec.loss);
    }
    if let Some(table) = reader.table("rate") {
        spec.rate = read_rate(table).or(spec.rate);
    }
    if let Some(mut table) = reader.table("reordering") {
        let ratio = required_number(&mut table, "ratio", &limits::LINK_LOSS_RATIO);
        let hold = required_duration(&mut table, "hold", &limits::LINK_DELAY);
        table.finish();
        let read = ratio.zip(hold);
        spec.reordering = read
            .map(|(ratio, hold)| Reordering { ratio, hold })
            .or(spec.reordering);
    }
    if let Some(mut table) = reader.table("duplication") {
        let ratio = required_number(&mut table, "ratio", &limits::LINK_LOSS_RATIO);
        let lag = table
            .duration("lag", &limits::LINK_DELAY)
            .unwrap_or_default();
        table.finish();
        let read = ratio.map(|ratio| Duplication { ratio, lag });
        spec.duplication = read.or(spec.duplication);
    }
    spec
}

/// Notes that `key` is missing, and what it would be.
fn missing(reader: &Reader<'_>, key: &str, hint: &str) {
    if !reader.has(key) {
        reader.refuse(key, Fault::Missing(hint.to_owned()));
    }
}

fn required_duration(
    reader: &mut Reader<'_>,
    key: &'static str,
    limit: &Limit<Duration>,
) -> Option<Duration> {
    missing(reader, key, "a duration, e.g. \"20 ms\"");
    reader.duration(key, limit)
}

fn required_number(reader: &mut Reader<'_>, key: &'static str, limit: &Limit<f64>) -> Option<f64> {
    missing(reader, key, "a number");
    reader.number(key, limit)
}

/// What each number says by itself is within limits by now; what is left is what they say together.
fn refuse_inconsistent(reader: &Reader<'_>, checked: Result<(), ParameterError>) -> Option<()> {
    let error = checked.err();
    if let Some(ParameterError { key, problem }) = &error {
        reader.refuse(key, Fault::Inconsistent(problem.clone()));
    }
    error.is_none().then_some(())
}

fn read_delay(mut reader: Reader<'_>) -> Option<(DelayLaw, bool)> {
    missing(
        &reader,
        "law",
        "one of \"fixed\", \"uniform\", \"normal\", \"log-normal\", \"exponential\", \"pareto\", \
         \"histogram\"",
    );
    let word = reader.word("law", DELAY_WORDS);
    let law = word.and_then(|word| read_delay_law(word, &mut reader));
    let reorders = match word {
        None | Some(DelayWord::Fixed) => None,
        Some(_) => reader.boolean("reorders"),
    };
    let is_consistent = law
        .as_ref()
        .and_then(|law| refuse_inconsistent(&reader, law.check()));
    // The keys that belong here depend on the law: without it none is unknown.
    if word.is_some() {
        reader.finish();
    }
    is_consistent?;
    Some((law?, reorders.unwrap_or(false)))
}

fn read_delay_law(word: DelayWord, reader: &mut Reader<'_>) -> Option<DelayLaw> {
    use limits::{LINK_DELAY, LINK_DELAY_SCALE};
    let min = |reader: &mut Reader<'_>| reader.duration("min", &LINK_DELAY).unwrap_or_default();
    let max = |reader: &mut Reader<'_>| {
        let read = reader.duration("max", &LINK_DELAY);
        read.unwrap_or(LINK_DELAY.max)
    };
    Some(match word {
        DelayWord::Fixed => DelayLaw::Fixed(Fixed {
            delay: required_duration(reader, "delay", &LINK_DELAY)?,
        }),
        DelayWord::Uniform => {
            let (min, max) = (
                required_duration(reader, "min", &LINK_DELAY),
                required_duration(reader, "max", &LINK_DELAY),
            );
            DelayLaw::Uniform(Uniform {
                min: min?,
                max: max?,
            })
        }
        DelayWord::Normal => {
            let mean = required_duration(reader, "mean", &LINK_DELAY);
            let deviation = required_duration(reader, "deviation", &LINK_DELAY_SCALE);
            let max = max(reader);
            DelayLaw::Normal(Normal {
                mean: mean?,
                deviation: deviation?,
                max,
            })
        }
        DelayWord::LogNormal => {
            let (min, max) = (min(reader), max(reader));
            let median = required_duration(reader, "median", &LINK_DELAY_SCALE);
            let sigma = required_number(reader, "sigma", &limits::LINK_DELAY_SIGMA);
            DelayLaw::LogNormal(LogNormal {
                min,
                median: median?,
                sigma: sigma?,
                max,
            })
        }
        DelayWord::Exponential => {
            let (min, max) = (min(reader), max(reader));
            let mean_excess = required_duration(reader, "mean_excess", &LINK_DELAY_SCALE);
            DelayLaw::Exponential(Exponential {
                min,
                mean_excess: mean_excess?,
                max,
            })
        }
        DelayWord::Pareto => {
            let (min, max) = (min(reader), max(reader));
            let scale = required_duration(reader, "scale", &LINK_DELAY_SCALE);
            let shape = required_number(reader, "shape", &limits::LINK_DELAY_SHAPE);
            DelayLaw::Pareto(Pareto {
                min,
                scale: scale?,
                shape: shape?,
                max,
            })
        }
        DelayWord::Histogram => DelayLaw::Histogram(read_histogram(reader)?),
    })
}

fn read_histogram(reader: &mut Reader<'_>) -> Option<Histogram> {
    missing(
        reader,
        "edges",
        "an array of durations, one more than weights",
    );
    missing(reader, "weights", "an array of numbers, one per bin");
    let edges = reader.durations("edges", &limits::LINK_DELAY);
    let weights = reader.numbers("weights", &limits::LINK_DELAY_WEIGHT);
    Some(Histogram {
        edges: edges?,
        weights: weights?,
    })
}

fn read_loss(mut reader: Reader<'_>) -> Option<LossLaw> {
    missing(
        &reader,
        "law",
        "one of \"bernoulli\", \"gilbert-elliott\", \"bursts\"",
    );
    let word = reader.word("law", LOSS_WORDS)?;
    let law = read_loss_law(word, &mut reader);
    reader.finish();
    law
}

fn read_loss_law(word: LossWord, reader: &mut Reader<'_>) -> Option<LossLaw> {
    use limits::{LINK_LOSS_RATIO, LINK_STATE_MEAN, LINK_STEP};
    let ratios = |reader: &mut Reader<'_>| {
        let bad = reader.number("bad_loss_ratio", &limits::LINK_BAD_LOSS_RATIO);
        let good = reader.number("good_loss_ratio", &LINK_LOSS_RATIO);
        (
            bad.unwrap_or(limits::LINK_BAD_LOSS_RATIO.default),
            good.unwrap_or(LINK_LOSS_RATIO.default),
        )
    };
    Some(match word {
        LossWord::Bernoulli => LossLaw::Bernoulli(Bernoulli {
            ratio: required_number(reader, "ratio", &LINK_LOSS_RATIO)?,
        }),
        LossWord::GilbertElliott => {
            let to_bad = required_number(reader, "to_bad", &LINK_STEP);
            let to_good = required_number(reader, "to_good", &LINK_STEP);
            let (bad_loss_ratio, good_loss_ratio) = ratios(reader);
            LossLaw::GilbertElliott(GilbertElliott {
                to_bad: to_bad?,
                to_good: to_good?,
                bad_loss_ratio,
                good_loss_ratio,
            })
        }
        LossWord::Bursts => {
            let good_mean = required_duration(reader, "good_mean", &LINK_STATE_MEAN);
            let bad_mean = required_duration(reader, "bad_mean", &LINK_STATE_MEAN);
            let (bad_loss_ratio, good_loss_ratio) = ratios(reader);
            LossLaw::Bursts(Bursts {
                good_mean: good_mean?,
                bad_mean: bad_mean?,
                bad_loss_ratio,
                good_loss_ratio,
            })
        }
    })
}

fn read_rate(mut reader: Reader<'_>) -> Option<RateLimit> {
    missing(&reader, "bits_per_second", "an integer, e.g. 10_000_000");
    let bits_per_second = reader.integer("bits_per_second", &limits::LINK_RATE_BITS_PER_SECOND);
    let mut bytes = |key, limit: &Limit<i64>| {
        let read: Option<u64> = reader.integer(key, limit);
        read.unwrap_or_else(|| limit.default.unsigned_abs())
    };
    let queue_bytes = bytes("queue_bytes", &limits::LINK_QUEUE_BYTES);
    let overhead_bytes = bytes("overhead_bytes", &limits::LINK_OVERHEAD_BYTES);
    reader.finish();
    Some(RateLimit {
        bits_per_second: bits_per_second?,
        queue_bytes,
        overhead_bytes,
    })
}

/// What a link without outages says of them.
const NO_OUTAGES: Outages = Outages {
    mean_s: limits::LINK_OUTAGE_MEAN.default.as_millis() as f64 * 1e-3,
    per_hour: limits::LINK_OUTAGES_PER_HOUR.default,
    buffered: false,
};

/// Outages as the table has them; what it leaves out is that of `none`.
pub(super) fn read_outages(reader: Option<Reader<'_>>, none: Outages) -> Outages {
    let (mean, per_hour) = (&limits::LINK_OUTAGE_MEAN, &limits::LINK_OUTAGES_PER_HOUR);
    let Some(mut reader) = reader else {
        return none;
    };
    let read_mean = reader.duration("mean", mean);
    let outages = Outages {
        mean_s: read_mean.map_or(none.mean_s, |mean| mean.as_secs_f64()),
        per_hour: reader.number("per_hour", per_hour).unwrap_or(none.per_hour),
        buffered: reader.boolean("buffered").unwrap_or(none.buffered),
    };
    // Each number is within its own limits by now; what is left is what they say together.
    if let Err(error) = outages.check() {
        reader.refuse("per_hour", Fault::Inconsistent(error.problem));
    }
    reader.finish();
    outages
}
