//! What an emulated link's tables say about what it does to messages, in each direction, and the same
//! written back; see `file_links`. It builds no model. The keys of a part are those that the part
//! itself declares.

use core::time::Duration;

use hil_link::delay::DelayLaw;
use hil_link::loss::LossLaw;
use hil_link::options::{Options, Slot};
use hil_link::outages::Outages;
use hil_link::rate::RateLimit;
use hil_link::reordering::{Duplication, Reordering};
use hil_link::spec::LinkSpec;
use hil_link::wifi::{WifiPreset, WifiSpec};
use toml::{Table, Value};

use super::errors::Fault;
use super::file_trace::read_trace;
use super::limits::{self, Limit};
use super::model_links::Emulation;
use super::reader::Reader;
use super::resolved::{duration, integer, put};

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

const PRESETS: &[(&str, WifiPreset)] = &[
    (WifiPreset::ShortRange.name(), WifiPreset::ShortRange),
    (WifiPreset::LongRange.name(), WifiPreset::LongRange),
];

/// Reads what the link does: each direction does what is said for both, but for the parts it has a
/// key or table of its own for.
pub(super) fn read_emulation(reader: &mut Reader<'_>) -> Emulation {
    let none = LinkSpec {
        wifi: read_wifi(reader),
        outages: read_part(reader.table("outages"), Outages::default()).unwrap_or_default(),
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
    spec.rate = read_part(reader.table("rate"), RateLimit::TEMPLATE).or(spec.rate);
    let reordering = read_part(reader.table("reordering"), Reordering::TEMPLATE);
    spec.reordering = reordering.or(spec.reordering);
    let duplication = read_part(reader.table("duplication"), Duplication::TEMPLATE);
    spec.duplication = duplication.or(spec.duplication);
    spec
}

fn read_delay(mut reader: Reader<'_>) -> Option<(DelayLaw, bool)> {
    // The keys that belong here depend on the law: without it none is unknown.
    let mut law = DelayLaw::named(read_law(&mut reader, DelayLaw::NAMES)?)?;
    let is_usable = read_options(&mut reader, law.options());
    let reorders = !law.is_fixed() && reader.boolean("reorders").unwrap_or(false);
    reader.finish();
    is_usable.then_some((law, reorders))
}

fn read_loss(mut reader: Reader<'_>) -> Option<LossLaw> {
    let mut law = LossLaw::named(read_law(&mut reader, LossLaw::NAMES)?)?;
    let is_usable = read_options(&mut reader, law.options());
    reader.finish();
    is_usable.then_some(law)
}

/// The name of a law, one of `names`.
fn read_law(reader: &mut Reader<'_>, names: &[&'static str]) -> Option<&'static str> {
    if !reader.has("law") {
        let quoted: Vec<_> = names.iter().map(|name| format!("\"{name}\"")).collect();
        let hint = format!("one of {}", quoted.join(", "));
        reader.refuse("law", Fault::Missing(hint));
    }
    let words: Vec<_> = names.iter().map(|name| (*name, *name)).collect();
    reader.word("law", &words)
}

/// The radio of a link, if it has one: a preset by name, or a table that starts from one and says
/// what differs.
fn read_wifi(reader: &mut Reader<'_>) -> Option<WifiSpec> {
    if !reader.has("wifi") {
        return None;
    }
    reader.refuse_present(
        &["outages"],
        "beside `wifi` says outages twice; the radio has its own, in [links.<name>.wifi.outages]",
    );
    reader.refuse_present(
        &["trace"],
        "beside `wifi` stands in its place, so no message would meet the radio; say one of them",
    );
    if !reader.is_table("wifi") {
        return Some(reader.word("wifi", PRESETS)?.spec());
    }
    let mut table = reader.table("wifi")?;
    let preset = table.word("preset", PRESETS);
    let preset = preset.unwrap_or(WifiPreset::ShortRange);
    read_part(Some(table), preset.spec())
}

/// The part that a table describes; what it leaves out is that of `default`. `None` without a table,
/// and when something is missing or refused, which is noted.
fn read_part<P: Options>(table: Option<Reader<'_>>, default: P) -> Option<P> {
    let (mut table, mut part) = (table?, default);
    let is_usable = read_options(&mut table, &mut part);
    table.finish();
    is_usable.then_some(part)
}

/// Reads every option of a part. True when all that are required are there and all fit together; what
/// is wrong is noted.
fn read_options(reader: &mut Reader<'_>, options: &mut dyn Options) -> bool {
    fn set<T>(place: &mut T, read: Option<T>) -> bool {
        let is_read = read.is_some();
        if let Some(value) = read {
            *place = value;
        }
        is_read
    }
    let mut is_usable = true;
    for field in options.fields() {
        let key = field.key;
        if field.is_required && !reader.has(key) {
            reader.refuse(key, Fault::Missing(field.hint.to_owned()));
        }
        let is_read = match field.slot {
            Slot::Duration(time, range) => set(time, reader.duration(key, &Limit::of(&range))),
            Slot::Seconds(time_s, range) => {
                let time = reader.duration(key, &Limit::of(&range));
                set(time_s, time.as_ref().map(Duration::as_secs_f64))
            }
            Slot::Number(number, range) => set(number, reader.number(key, &Limit::of(&range))),
            Slot::Integer(count, range) => set(count, reader.integer(key, &Limit::whole(&range))),
            Slot::Count(count, range) => set(count, reader.integer(key, &Limit::whole(&range))),
            Slot::Boolean(value) => set(value, reader.boolean(key)),
            Slot::Word(word) => {
                let words: Vec<_> = word.words().iter().copied().zip(0..).collect();
                let index = reader.word(key, &words);
                index.map(|index| word.set(index)).is_some()
            }
            Slot::Durations(times, range) => set(times, reader.durations(key, &Limit::of(&range))),
            Slot::Numbers(numbers, range) => set(numbers, reader.numbers(key, &Limit::of(&range))),
            Slot::Table(part) => reader.table(key).is_some_and(|mut table| {
                let is_usable = read_options(&mut table, part);
                table.finish();
                is_usable
            }),
        };
        is_usable &= is_read || !field.is_required;
    }
    // Each option is within its range by now; what is left is what they say together.
    if is_usable && let Err(error) = options.check_all() {
        reader.refuse(&error.key, Fault::Inconsistent(error.problem));
        return false;
    }
    is_usable
}

/// The table of one direction, without what both share. It leaves nothing out and repeats no default of
/// the file's own.
pub(super) fn resolved_spec(mut spec: LinkSpec) -> Table {
    let mut table = Table::new();
    match &mut spec.delay {
        DelayLaw::Fixed(law) => put(&mut table, "delay", duration(law.delay)),
        law => {
            let mut delay = resolved_part(law.options());
            put(&mut delay, "law", law.name());
            put(&mut delay, "reorders", spec.reorders);
            put(&mut table, "delay", delay);
        }
    }
    match &mut spec.loss {
        LossLaw::Bernoulli(law) => put(&mut table, "loss_ratio", law.ratio),
        law => {
            let mut loss = resolved_part(law.options());
            put(&mut loss, "law", law.name());
            put(&mut table, "loss", loss);
        }
    }
    for (key, part) in spec.tables() {
        put(&mut table, key, resolved_part(part));
    }
    table
}

/// Every option of a part.
pub(super) fn resolved_part(part: &mut dyn Options) -> Table {
    let mut table = Table::new();
    for field in part.fields() {
        let value = match field.slot {
            Slot::Duration(time, _) => duration(*time),
            Slot::Seconds(time_s, _) => duration(Duration::from_secs_f64(*time_s)),
            Slot::Number(number, _) => Value::from(*number),
            Slot::Integer(count, _) => integer(*count),
            Slot::Count(count, _) => integer(*count),
            Slot::Boolean(value) => Value::from(*value),
            Slot::Word(word) => Value::from(word.word()),
            Slot::Durations(times, _) => {
                Value::Array(times.iter().copied().map(duration).collect())
            }
            Slot::Numbers(numbers, _) => Value::from(numbers.clone()),
            Slot::Table(part) => Value::Table(resolved_part(part)),
        };
        put(&mut table, field.key, value);
    }
    table
}
