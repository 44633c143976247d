//! `hil-runtime cases`: what each case study of this binary is called, carries and can be told.
//! It makes no case.

use core::fmt::Write;

use serde_json::Value;

use crate::registry::{CaseEntry, Registry};

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
    if let Value::Object(parameters) = entry.defaults() {
        list_table(text, "case.parameters", &parameters);
    }
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
    use hil_models::shuttle::Shuttle;
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
    fn tables_in_tables_follow_under_their_own_heading() {
        let value = json!({ "b": { "c": 1, "d": null, "e": { "f": "g" } }, "z": [1, 2] });
        let mut text = String::new();
        list_table(&mut text, "p", value.as_object().unwrap());
        let expected = "  [p]\n  z = [1,2]\n  [p.b]\n  c = 1\n  # d is not set\n  [p.b.e]\n  \
                        f = \"g\"\n";
        assert_eq!(text, expected);
    }
}
