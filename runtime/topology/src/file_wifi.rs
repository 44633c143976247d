//! What an emulated link says of its radio, `wifi = "PRESET"` or `[links.x.wifi]`, and the same
//! written back; see `file_impairments`. The numbers and their ranges are the model's.

use hil_link::wifi::{AccessCategory, PowerSave, WIFI_FIELDS, WifiField, WifiPreset, WifiSpec};
use toml::Table;

use super::errors::Fault;
use super::file_impairments::read_outages;
use super::limits::Limit;
use super::reader::Reader;
use super::resolved::{integer, put};
use super::resolved_impairments::resolved_outages;

const PRESETS: &[(&str, WifiPreset)] = &[
    (WifiPreset::ShortRange.name(), WifiPreset::ShortRange),
    (WifiPreset::LongRange.name(), WifiPreset::LongRange),
];

/// The radio of a link, if it has one: a preset by name, or a table that starts from one and says
/// what differs.
pub(super) fn read_wifi(reader: &mut Reader<'_>) -> Option<WifiSpec> {
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
    let mut spec = preset.unwrap_or(WifiPreset::ShortRange).spec();
    for field in &WIFI_FIELDS {
        if let Some(value) = read_number(&mut table, field, &spec) {
            (field.set)(&mut spec, value);
        }
    }
    let category = table.word("access_category", AccessCategory::WORDS);
    spec.access_category = category.unwrap_or(spec.access_category);
    let power_save = table.word("power_save", PowerSave::WORDS);
    spec.power_save = power_save.unwrap_or(spec.power_save);
    spec.outages = read_outages(table.table("outages"), spec.outages);
    // Each number is within its own limits by now; what is left is what they say together.
    if let Err(error) = spec.check() {
        table.refuse(&error.key, Fault::Inconsistent(error.problem));
    }
    table.finish();
    Some(spec)
}

fn read_number(reader: &mut Reader<'_>, field: &WifiField, spec: &WifiSpec) -> Option<f64> {
    let limit = Limit {
        default: (field.get)(spec),
        min: field.low,
        max: field.high,
    };
    if !field.is_integer {
        return reader.number(field.key, &limit);
    }
    let limit = Limit {
        default: whole(limit.default),
        min: whole(limit.min),
        max: whole(limit.max),
    };
    reader.integer::<u32>(field.key, &limit).map(f64::from)
}

/// Counts of a radio are small.
#[allow(clippy::cast_possible_truncation, reason = "saturates")]
fn whole(value: f64) -> i64 {
    value.round() as i64
}

/// Every number of the radio, so that no preset is needed to read it again.
pub(super) fn resolved_wifi(spec: &WifiSpec) -> Table {
    let mut table = Table::new();
    for field in &WIFI_FIELDS {
        let value = (field.get)(spec);
        if field.is_integer {
            put(&mut table, field.key, integer(whole(value)));
        } else {
            put(&mut table, field.key, value);
        }
    }
    put(&mut table, "access_category", spec.access_category.word());
    put(&mut table, "power_save", spec.power_save.word());
    put(&mut table, "outages", resolved_outages(spec.outages));
    table
}
