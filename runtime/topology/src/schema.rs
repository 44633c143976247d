//! The JSON Schema of topology files, for editors that complete and check what they hold while it is
//! typed. It checks no file itself.
//!
//! Nobody writes it: the readers of `file` note every key they ask for, with its type, range and
//! words, while they read texts that lead them into each of their branches. What they would refuse
//! as unknown, the schema refuses; what two keys say together, only a reader can judge.

use core::fmt::{Display, Write as _};
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};

use hil_link::delay::DelayLaw;
use hil_link::loss::LossLaw;
use serde_json::{Map, Value, json};

use super::errors::{Faults, Place, Source};
use super::file;
use super::limits::{Limit, NAME_LENGTH_MAX};
use super::tree::{self, join};
use super::units::{format_duration, unit_words};

const DIALECT: &str = "https://json-schema.org/draft/2020-12/schema";
/// Stands for the name of a host, process, channel or link.
const ANY_NAME: &str = "any";
/// Every table that a file can have, but those that take the place of another value.
const TABLES: &str = "
run = {}
security = {}
case.parameters = {}
hosts.any = {}
processes.any = { egm = {}, env = {} }
channels.any.message = {}
links.any.gateway = {}
";
/// The tables below a link and below each of its directions.
const IMPAIRMENTS: [&str; 3] = ["rate = {}", "reordering = {}", "duplication = {}"];
/// What stands in one place of the whole link only.
const OF_WHOLE_LINK: [&str; 5] = [
    "outages = {}",
    "wifi = \"short-range\"",
    "wifi = { outages = {} }",
    "trace = \"folder\"",
    "trace = { files = {} }",
];

/// What a key of a table may be.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Shape {
    Text,
    /// A text that can name a folder and a shared-memory service.
    Name,
    Boolean,
    /// One of these.
    Words(Vec<&'static str>),
    Integer {
        min: i64,
        max: i64,
    },
    /// One or several.
    Integers {
        min: i64,
        max: i64,
    },
    Number {
        min: f64,
        max: f64,
    },
    Numbers {
        min: f64,
        max: f64,
    },
    Duration {
        min: Duration,
        max: Duration,
    },
    Durations {
        min: Duration,
        max: Duration,
    },
    Texts,
    /// Texts by names that the file chooses.
    TextTable,
    Table,
    /// Tables by names that the file chooses.
    Tables,
}

impl Shape {
    pub(super) const fn integer(limit: &Limit<i64>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Integer { min, max }
    }

    pub(super) const fn integers(limit: &Limit<i64>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Integers { min, max }
    }

    pub(super) const fn number(limit: &Limit<f64>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Number { min, max }
    }

    pub(super) const fn numbers(limit: &Limit<f64>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Numbers { min, max }
    }

    pub(super) const fn duration(limit: &Limit<Duration>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Duration { min, max }
    }

    pub(super) const fn durations(limit: &Limit<Duration>) -> Self {
        let Limit { min, max, .. } = *limit;
        Self::Durations { min, max }
    }
}

/// What readers asked for, by the path of the table.
#[derive(Debug, Default)]
pub(super) struct RequestedKeys {
    tables: BTreeMap<String, BTreeMap<&'static str, Vec<Shape>>>,
    /// Tables that no reader looks into.
    unread: BTreeSet<String>,
}

impl RequestedKeys {
    /// Adds a key of the table at `path`.
    pub(super) fn add(&mut self, path: &str, key: &'static str, shape: Shape) {
        let table = self.tables.entry(path.to_owned()).or_default();
        let shapes = table.entry(key).or_default();
        if !shapes.contains(&shape) {
            shapes.push(shape);
        }
    }

    /// Adds a table that is handed on.
    pub(super) fn add_unread(&mut self, path: &str) {
        self.unread.insert(path.to_owned());
    }

    fn object(&self, path: &str) -> Value {
        if self.unread.contains(path) {
            return json!({ "type": "object" });
        }
        // A test checks that no table is without keys.
        let keys = self.tables.get(path).into_iter().flatten();
        let mut properties = Map::new();
        for (key, shapes) in keys {
            let mut all = shapes
                .iter()
                .map(|shape| self.value(&join(path, key), shape));
            let value = match (all.next(), all.len()) {
                (Some(only), 0) => only,
                (first, _) => json!({ "anyOf": first.into_iter().chain(all).collect::<Vec<_>>() }),
            };
            properties.insert((*key).to_owned(), value);
        }
        json!({ "type": "object", "properties": properties, "additionalProperties": false })
    }

    fn value(&self, path: &str, shape: &Shape) -> Value {
        match shape {
            Shape::Text => json!({ "type": "string" }),
            Shape::Name => json!({ "type": "string", "pattern": name_pattern(false) }),
            Shape::Boolean => json!({ "type": "boolean" }),
            Shape::Words(words) => json!({ "enum": words }),
            Shape::Integer { min, max } => integer(*min, *max),
            Shape::Integers { min, max } => {
                let one = integer(*min, *max);
                json!({ "anyOf": [one, { "type": "array", "items": one }] })
            }
            Shape::Number { min, max } => number(*min, *max),
            Shape::Numbers { min, max } => {
                json!({ "type": "array", "items": number(*min, *max) })
            }
            Shape::Duration { min, max } => duration(*min, *max),
            Shape::Durations { min, max } => {
                json!({ "type": "array", "items": duration(*min, *max) })
            }
            Shape::Texts => json!({ "type": "array", "items": { "type": "string" } }),
            Shape::TextTable => {
                json!({ "type": "object", "additionalProperties": { "type": "string" } })
            }
            Shape::Table => self.object(path),
            Shape::Tables => json!({
                "type": "object",
                "propertyNames": { "pattern": name_pattern(path == "channels") },
                "additionalProperties": self.object(&join(path, ANY_NAME)),
            }),
        }
    }
}

/// The schema of topology files (JSON Schema, draft 2020-12). Durations are texts, whose range
/// stands in a description; a file that extends another may leave out any key.
pub fn schema() -> Value {
    let mut schema = asked().object("");
    let head = [
        ("$schema", json!(DIALECT)),
        ("title", json!("hil-runtime topology")),
        (
            "description",
            json!(
                "Hosts, processes, channels and links of a run. What several keys say together is \
                 checked by hil-runtime --topology FILE --check."
            ),
        ),
    ];
    if let Some(table) = schema.as_object_mut() {
        table.extend(head.map(|(key, value)| (key.to_owned(), value)));
    }
    schema
}

/// What the readers ask for in all their branches.
fn asked() -> RequestedKeys {
    let faults = Faults::with_notes();
    for text in texts() {
        let sources = [Source {
            name: "schema".to_owned(),
            text,
        }];
        let place = Place {
            source_index: 0,
            start: 0,
            end: 0,
        };
        if let Some(table) = tree::parse(&sources, 0, &faults) {
            drop(file::read(&table, place, &faults));
        }
    }
    faults.into_notes()
}

/// Texts that lead the readers into every branch. They are no topologies: what they lack is noted
/// as a fault, and nobody looks at it.
fn texts() -> Vec<String> {
    let mut impairments: Vec<String> = IMPAIRMENTS.map(str::to_owned).to_vec();
    impairments.extend(
        DelayLaw::NAMES
            .iter()
            .map(|law| format!("delay = {{ law = \"{law}\" }}")),
    );
    impairments.extend(
        LossLaw::NAMES
            .iter()
            .map(|law| format!("loss = {{ law = \"{law}\" }}")),
    );
    let directions = ["forward", "backward"];
    let mut texts = vec![TABLES.to_owned()];
    texts.extend(OF_WHOLE_LINK.map(of_link));
    for impairment in impairments {
        texts.push(of_link(&impairment));
        let below =
            directions.map(|direction| of_link(&format!("{direction} = {{ {impairment} }}")));
        texts.extend(below);
    }
    texts
}

fn of_link(text: &str) -> String {
    format!("links.{ANY_NAME}.{text}")
}

fn integer(min: i64, max: i64) -> Value {
    json!({ "type": "integer", "minimum": min, "maximum": max })
}

fn number(min: f64, max: f64) -> Value {
    json!({ "type": "number", "minimum": min, "maximum": max })
}

fn duration(min: Duration, max: Duration) -> Value {
    let mut units = String::new();
    for word in unit_words() {
        write!(units, "{word}|").expect("a String takes all");
    }
    json!({
        "type": "string",
        "pattern": format!("^\\s*[0-9]+(\\.[0-9]+)?\\s*({units}µs)\\s*$"),
        "description": range(&format_duration(min), &format_duration(max)),
    })
}

fn range(min: &dyn Display, max: &dyn Display) -> String {
    format!("a duration with its unit, {min} to {max}")
}

/// As the readers have it, in `is_name`.
fn name_pattern(may_have_slashes: bool) -> String {
    let slash = if may_have_slashes { "/" } else { "" };
    let rest = NAME_LENGTH_MAX - 1;
    format!("^[A-Za-z0-9][A-Za-z0-9._{slash}-]{{0,{rest}}}$")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn objects<'v>(value: &'v Value, found: &mut Vec<&'v Value>) {
        if value["additionalProperties"] == json!(false) {
            found.push(value);
        }
        match value {
            Value::Array(items) => items.iter().for_each(|item| objects(item, found)),
            Value::Object(table) => table.values().for_each(|item| objects(item, found)),
            _ => {}
        }
    }

    #[test]
    fn the_texts_lead_into_every_table_and_their_keys_are_all_known() {
        let schema = schema();
        let mut found = Vec::new();
        objects(&schema, &mut found);
        for object in found {
            let properties = object["properties"].as_object().unwrap();
            assert!(!properties.is_empty(), "{object}");
        }
        let link = &schema["properties"]["links"]["additionalProperties"]["properties"];
        for key in super::super::file_impairments::EMULATION_KEYS {
            assert!(!link[key].is_null(), "{key}: {link}");
        }
        // A law's own keys, in a direction too.
        let delay = &link["backward"]["properties"]["delay"]["anyOf"];
        assert!(delay.to_string().contains("mean_excess"), "{delay}");
        let parameters = &schema["properties"]["case"]["properties"]["parameters"];
        assert_eq!(*parameters, json!({ "type": "object" }));
    }

    #[test]
    fn a_file_with_every_key_of_the_schema_has_no_unknown_one() {
        for (path, keys) in asked().tables {
            for key in keys.into_keys() {
                let path = join(&path, key);
                let faults = Faults::default();
                let sources = [Source {
                    name: "schema".to_owned(),
                    text: format!("{path} = 7"),
                }];
                let place = Place {
                    source_index: 0,
                    start: 0,
                    end: 0,
                };
                let table = tree::parse(&sources, 0, &faults).unwrap();
                drop(file::read(&table, place, &faults));
                let words = faults.into_errors(Vec::from(sources)).to_string();
                // Which keys of a law are known depends on the law.
                let depends = path.contains(".loss.") || path.contains(".delay.");
                assert!(depends || !words.contains("is not a known key"), "{words}");
            }
        }
    }
}
