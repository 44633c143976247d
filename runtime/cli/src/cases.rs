//! `hil-runtime cases`: what each case study of this binary is called, carries and can be told.
//! It makes no case.

use core::fmt::Write;

use hil_core::run_log::RunLog;
use serde_json::Value;

use hil_topology::registry::{CaseEntry, Registry};

/// The cases with their channels and parameters, in the words of a topology file.
pub(crate) fn list(registry: &Registry) -> String {
    let mut text = String::new();
    for (index, entry) in registry.entries().iter().enumerate() {
        if index > 0 {
            text.push('\n');
        }
        list_case(&mut text, entry);
    }
    text
}

fn list_case(text: &mut String, entry: &CaseEntry) {
    line(text, format_args!("{}: {}", entry.name, entry.summary));
    let names = entry.channels.iter().map(|channel| channel.name.len());
    let width = names.max().unwrap_or(0);
    for channel in entry.channels {
        line(
            text,
            format_args!(
                "  {:<width$}  {} -> {}  {} ({} bytes)",
                channel.name,
                channel.from,
                channel.to.unwrap_or("the record only"),
                channel.message.name,
                channel.message.size_bytes
            ),
        );
    }
    for (what, words) in offers(entry) {
        line(text, format_args!("  {what:<12} {words}"));
    }
    if let Value::Object(parameters) = entry.defaults() {
        list_table(text, "case.parameters", &parameters);
    }
}

/// What the case offers beyond a run and its score, with the command for it. Tables and replay are
/// asked of the case as it is by default.
fn offers(entry: &CaseEntry) -> Vec<(&'static str, String)> {
    let name = entry.name;
    let case = entry.make(entry.defaults(), 0).ok();
    let has_tables = case
        .as_ref()
        .is_some_and(|case| matches!(case.study(Vec::new()), Ok(Some(_))));
    let has_replay = case
        .as_ref()
        .is_some_and(|case| case.replay(&RunLog::default()).is_some());
    let offer = |is_there: bool, words: String| {
        if is_there { words } else { "none".to_owned() }
    };
    let figures = entry.calibrated_metrics.join(", ");
    let calibration = format!("{figures}; hil-runtime calibrate {name} --figure NAME=VALUE");
    let series = format!("{}; in the folder of each run", entry.series.join(", "));
    let tables = "hil-runtime tables --topology FILE".to_owned();
    vec![
        ("tables", offer(has_tables, tables)),
        ("calibration", offer(!figures.is_empty(), calibration)),
        (
            "replay",
            offer(has_replay, "hil-runtime replay RUN".to_owned()),
        ),
        ("series", offer(!entry.series.is_empty(), series)),
    ]
}

/// One table under its heading: its own keys first, then the tables in it.
fn list_table(text: &mut String, path: &str, table: &serde_json::Map<String, Value>) {
    line(text, format_args!("  [{path}]"));
    for (key, value) in table {
        match value {
            Value::Object(_) => {}
            Value::Null => line(text, format_args!("  # {key} is not set")),
            value => line(text, format_args!("  {key} = {value}")),
        }
    }
    for (key, value) in table {
        if let Value::Object(inner) = value {
            list_table(text, &format!("{path}.{key}"), inner);
        }
    }
}

fn line(text: &mut String, words: core::fmt::Arguments<'_>) {
    // Writing to a string cannot fail.
    let _infallible = text.write_fmt(words);
    text.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_fleet::Fleet;
    use hil_shuttle::Shuttle;
    use serde_json::json;

    #[test]
    fn parameters_are_listed_as_a_topology_file_says_them() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let text = list(&registry);
        let table = text.split("  [case.parameters]\n").nth(1).unwrap();
        let table: toml::Table = toml::from_str(table).unwrap();
        assert_eq!(table["gain_per_s"].as_float(), Some(5.0));
        assert!(text.starts_with("shuttle: a cart on a rail"), "{text}");
        assert!(text.contains("  shuttle/command  controller -> robot  hil.ShuttleCommand.v1 (16"));
    }

    #[test]
    fn what_a_case_offers_is_listed_with_its_command() {
        let mut registry = Registry::default();
        registry.add::<Fleet>();
        registry.add::<Shuttle>();
        let words = |name: &str| -> Vec<_> {
            let offers = offers(registry.find(name).unwrap());
            offers.into_iter().map(|(_, words)| words).collect()
        };
        assert_eq!(words("shuttle"), ["none", "none", "none", "none"]);
        assert_eq!(words("fleet")[0], "hil-runtime tables --topology FILE");
        assert!(list(&registry).contains("  calibration  none\n"));
        let mut calibrated = *registry.find("shuttle").unwrap();
        calibrated.calibrated_metrics = &["mlr", "lag"];
        calibrated.series = &["tool"];
        let words = offers(&calibrated);
        let expected = "mlr, lag; hil-runtime calibrate shuttle --figure NAME=VALUE";
        assert_eq!(words[1].1, expected);
        assert_eq!(words[3].1, "tool; in the folder of each run");
    }

    #[test]
    fn tables_in_tables_follow_under_their_own_heading() {
        let value = json!({ "b": { "c": 1, "d": null, "e": { "f": "g" } }, "z": [1, 2] });
        let mut text = String::new();
        list_table(&mut text, "p", value.as_object().unwrap());
        let expected = "  [p]\n  z = [1,2]\n  [p.b]\n  c = 1\n  # d is not set\n  [p.b.e]\n  \
                        f = \"g\"\n";
        assert_eq!(text, expected);
    }
}
