//! What can stand in a topology file, made from the declarations of its tables: the JSON Schema, for
//! editors that complete and check what they hold while it is typed, and the reference page of all keys.
//! They check no file themselves; what two keys say together, only a reader can judge.

use std::collections::BTreeMap;

use hil_core::options::{Field, Options, Shape, Slot, Table as TableSlot};
use serde_json::{Map, Value, json};

use super::reader::range_text;
use super::resolved::plain;
use super::tables::{File, NAME, NAME_WITH_SLASHES};
use super::units::{MICROSECONDS, unit_words};

const DIALECT: &str = "https://json-schema.org/draft/2020-12/schema";
/// Stands for the name of a host, process, channel or link.
const ANY_NAME: &str = "<name>";

/// The schema of topology files (JSON Schema, draft 2020-12). Durations are texts, whose range
/// stands in a description; a file that extends another may leave out any key.
pub(super) fn schema() -> Value {
    let mut schema = object(&mut File::TEMPLATE.clone());
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

fn object(options: &mut dyn Options) -> Value {
    let mut keys = Keys::default();
    keys.add_all(options);
    keys.object()
}

/// What each key of a table may be.
#[derive(Debug, Default)]
struct Keys(BTreeMap<&'static str, Vec<Value>>);

impl Keys {
    fn add(&mut self, key: &'static str, about: &str, mut value: Value) {
        if let Some(value) = value.as_object_mut() {
            let own = value.get("description").and_then(Value::as_str);
            let description = match own {
                Some(own) => format!("{} {own}", one_line(about)),
                None => one_line(about),
            };
            value.insert("description".to_owned(), json!(description.trim()));
        }
        let values = self.0.entry(key).or_default();
        if !values.contains(&value) {
            values.push(value);
        }
    }

    fn add_all(&mut self, options: &mut dyn Options) {
        for field in options.fields() {
            let (key, about) = (field.key, field.about);
            match field.slot {
                Slot::Value(_, shape) => self.add(key, about, value(&shape)),
                Slot::Part(part) => self.add_all(part),
                Slot::Table(mut slot) => {
                    if let Some(short) = slot.shorthand() {
                        self.add(short.key, short.about, value(&short.shape));
                    }
                    self.add(key, about, table(&mut *slot));
                }
                Slot::Tables(tables, has_slashes) => {
                    let rule = if has_slashes { NAME_WITH_SLASHES } else { NAME };
                    let tables = json!({
                        "type": "object",
                        "propertyNames": { "pattern": rule.pattern },
                        "additionalProperties": object(tables.open(ANY_NAME)),
                    });
                    self.add(key, about, tables);
                }
                Slot::Rows(rows) => {
                    let items = object(rows.open(""));
                    self.add(key, about, json!({ "type": "array", "items": items }));
                }
                Slot::Free => self.add(key, about, json!({ "type": "object" })),
            }
        }
    }

    fn object(self) -> Value {
        let mut properties = Map::new();
        for (key, mut values) in self.0 {
            let value = match (values.pop(), values.is_empty()) {
                (Some(only), true) => only,
                (last, _) => {
                    values.extend(last);
                    json!({ "anyOf": values })
                }
            };
            properties.insert(key.to_owned(), value);
        }
        json!({ "type": "object", "properties": properties, "additionalProperties": false })
    }
}

/// A table with the keys of all that it may start from.
fn table(slot: &mut dyn TableSlot) -> Value {
    let mut keys = Keys::default();
    let mut count = 1;
    if let Some(templates) = slot.templates() {
        count = templates.names.len();
        keys.add(templates.key, "", json!({ "enum": templates.names }));
    }
    for template in 0..count {
        keys.add_all(slot.open(template));
    }
    keys.object()
}

fn value(shape: &Shape) -> Value {
    match shape {
        Shape::Boolean => json!({ "type": "boolean" }),
        Shape::Integer(range) => {
            json!({ "type": "integer", "minimum": range.start(), "maximum": range.end() })
        }
        Shape::Number(range) => {
            json!({ "type": "number", "minimum": range.start(), "maximum": range.end() })
        }
        Shape::Time(_) => {
            let units = unit_words().chain(MICROSECONDS);
            let units = units.collect::<Vec<_>>().join("|");
            json!({
                "type": "string",
                "pattern": format!("^\\s*[0-9]+(\\.[0-9]+)?\\s*({units})\\s*$"),
                "description": format!("A duration with its unit, {}.", range_text(shape)),
            })
        }
        Shape::Text(rule) => match rule.pattern {
            Some(pattern) => json!({ "type": "string", "pattern": pattern }),
            None => json!({ "type": "string" }),
        },
        Shape::Words(words) => json!({ "enum": words }),
        Shape::List(each) => json!({ "type": "array", "items": value(each) }),
        Shape::OneOrMore(each) => {
            let one = value(each);
            json!({ "anyOf": [one, { "type": "array", "items": one }] })
        }
        Shape::Texts => json!({ "type": "object", "additionalProperties": { "type": "string" } }),
    }
}

/// The documentation of an option in one line.
fn one_line(about: &str) -> String {
    about.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// What stands above the generated part of the reference page.
const HEAD: &str = "# Keys of a topology file

Made from the declarations of the tables (not to be edited: CONTRIBUTING.md, \"To add\"); `hil-runtime documents FOLDER` writes the
same as a JSON Schema. A key without a default may be left out unless it is required. Durations are texts with a unit (h, min, s, ms,
us, ns). What several keys say together is checked by `hil-runtime --topology FILE --check`, which also prints every key in force.
";

/// The reference page of all keys of a topology file, in Markdown. Tables with equal keys share a section.
pub(super) fn reference() -> String {
    let mut sections = Sections::default();
    sections.add("", &mut File::TEMPLATE.clone(), "");
    let mut merged: Vec<Section> = Vec::new();
    for section in sections.0 {
        let is_alike = |one: &&mut Section| one.note == section.note && one.rows == section.rows;
        match merged.iter_mut().find(is_alike) {
            Some(same) => same.titles.extend(section.titles),
            None => merged.push(section),
        }
    }
    let mut page = HEAD.to_owned();
    for Section { titles, note, rows } in merged {
        page.extend(["\n## ", &titles.join(", "), &note, "\n\n"]);
        page += "| Key | Value | Default | Meaning |\n|---|---|---|---|\n";
        page += &rows;
    }
    page
}

/// The keys of tables that have them alike.
#[derive(Debug)]
struct Section {
    titles: Vec<String>,
    /// The template that its keys belong to.
    note: String,
    rows: String,
}

#[derive(Debug, Default)]
struct Sections(Vec<Section>);

impl Sections {
    /// Adds the table at `path`, and those below it. Gives back its index.
    fn add(&mut self, path: &str, options: &mut dyn Options, note: &str) -> usize {
        let index = self.0.len();
        let title = match path {
            "" => "The file".to_owned(),
            path => format!("`[{path}]`"),
        };
        self.0.push(Section {
            titles: vec![title],
            note: note.to_owned(),
            rows: String::new(),
        });
        self.0[index].rows = self.rows(path, options);
        index
    }

    fn rows(&mut self, path: &str, options: &mut dyn Options) -> String {
        let mut rows = String::new();
        for field in options.fields() {
            let (key, default) = (field.key, default_of(&field));
            let about = match &field.condition {
                Some(condition) => format!("{} {}.", field.about, sentence(condition.why)),
                None => field.about.to_owned(),
            };
            let below = format!("{path}.{key}").trim_start_matches('.').to_owned();
            rows += &match field.slot {
                Slot::Value(_, shape) => row(key, &shape_text(&shape), &default, &about),
                Slot::Part(part) => self.rows(path, part),
                Slot::Table(mut slot) => self.table(&below, &about, key, &mut *slot),
                Slot::Tables(tables, _) => {
                    self.add(&format!("{below}.{ANY_NAME}"), tables.open(ANY_NAME), "");
                    row(key, "tables by name", "", &about)
                }
                Slot::Rows(rows) => {
                    self.add(&format!("[{below}]"), rows.open(""), "");
                    row(key, "tables in an order", "", &about)
                }
                Slot::Free => row(key, "a table", "", &about),
            };
        }
        rows
    }

    /// Adds the sections of a table; gives back its rows in that of the table above.
    fn table(&mut self, path: &str, about: &str, key: &str, slot: &mut dyn TableSlot) -> String {
        let mut value = "a table".to_owned();
        match slot.templates() {
            None => {
                self.add(path, slot.open(0), "");
            }
            Some(one) if one.is_required => {
                for (index, name) in one.names.iter().enumerate() {
                    let note = format!(" with `{} = \"{name}\"`", one.key);
                    self.add(path, slot.open(index), &note);
                }
                value = format!("a table with `{}`", one.key);
            }
            Some(one) => {
                let index = self.add(path, slot.open(0), "");
                let names = shape_text(&Shape::Words(one.names.to_vec()));
                let head = row(
                    one.key,
                    &names,
                    "the first",
                    "What the other keys start from.",
                );
                self.0[index].rows.insert_str(0, &head);
            }
        }
        let short = slot.shorthand();
        let short = short.map(|one| row(one.key, &shape_text(&one.shape), "", one.about));
        short.unwrap_or_default() + &row(key, &value, "", about)
    }
}

fn row(key: &str, value: &str, default: &str, about: &str) -> String {
    format!("| `{key}` | {value} | {default} | {} |\n", one_line(about))
}

/// A reason as a sentence without its full stop.
fn sentence(why: &str) -> String {
    let mut letters = why.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().chain(letters).collect()
    })
}

fn default_of(field: &Field<'_>) -> String {
    match &field.slot {
        _ if field.is_required => "required".to_owned(),
        Slot::Value(value, shape) => {
            let setting = value.get();
            setting.map_or_else(String::new, |one| format!("`{}`", plain(&one, shape)))
        }
        _ => String::new(),
    }
}

/// What a value may be, in words.
fn shape_text(shape: &Shape) -> String {
    let range = range_text(shape);
    match shape {
        Shape::Boolean => "true or false".to_owned(),
        Shape::Integer(_) => format!("integer, {range}"),
        Shape::Number(_) => format!("number, {range}"),
        Shape::Time(_) => format!("duration, {range}"),
        Shape::Text(rule) => rule.what.to_owned(),
        Shape::Words(words) => {
            let quoted: Vec<_> = words.iter().map(|word| format!("`\"{word}\"`")).collect();
            quoted.join(", ")
        }
        Shape::List(each) => format!("array, each: {}", shape_text(each)),
        Shape::OneOrMore(each) => format!("{}, or an array of them", shape_text(each)),
        Shape::Texts => "texts by name".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::errors::{Faults, Place, Source};
    use crate::tree::join;
    use crate::{reader, tree};

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
    fn every_table_of_the_schema_has_keys() {
        let schema = schema();
        let mut found = Vec::new();
        objects(&schema, &mut found);
        assert!(found.len() > 30, "{}", found.len());
        for object in found {
            let properties = object["properties"].as_object().unwrap();
            assert!(!properties.is_empty(), "{object}");
        }
        let link = &schema["properties"]["links"]["additionalProperties"]["properties"];
        for key in [
            "via",
            "port",
            "dscp",
            "gateway",
            "outages",
            "wifi",
            "trace",
            "loss_ratio",
        ] {
            assert!(!link[key].is_null(), "{key}: {link}");
        }
        // A law's own keys, in a direction too.
        let delay = &link["backward"]["properties"]["delay"]["anyOf"];
        assert!(delay.to_string().contains("mean_excess"), "{delay}");
        let parameters = &schema["properties"]["case"]["properties"]["parameters"];
        assert_eq!(parameters["type"], "object");
        assert!(parameters["additionalProperties"].is_null(), "{parameters}");
    }

    /// The paths of all keys below `schema`, but for the options of laws, which depend on the law.
    fn paths(schema: &Value, path: &str, found: &mut Vec<String>) {
        let forms = schema["anyOf"].as_array().into_iter().flatten();
        forms.for_each(|form| paths(form, path, found));
        let tables = &schema["additionalProperties"];
        if tables.is_object() {
            paths(tables, &join(path, "any"), found);
        }
        for (key, value) in schema["properties"].as_object().into_iter().flatten() {
            let below = join(path, key);
            if !matches!(key.as_str(), "delay" | "loss") {
                paths(value, &below, found);
            }
            found.push(below);
        }
    }

    #[test]
    fn a_file_with_every_key_of_the_schema_has_no_unknown_one() {
        let mut found = Vec::new();
        paths(&schema(), "", &mut found);
        assert!(found.len() > 150, "{}", found.len());
        for path in found {
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
            reader::read(&mut File::TEMPLATE.clone(), "", &table, place, &faults);
            let words = faults.into_errors(Vec::from(sources)).to_string();
            assert!(!words.contains("is not a known key"), "{words}");
        }
    }

    /// Checks every value of a table, of the tables below it and of all that they start from.
    fn check_defaults(options: &mut dyn Options, count: &mut usize) {
        for field in options.fields() {
            let (key, is_required) = (field.key, field.is_required);
            match field.slot {
                Slot::Value(value, shape) => {
                    let setting = value.get().filter(|_| !is_required);
                    *count += usize::from(setting.is_some());
                    assert!(setting.is_none_or(|one| shape.allows(&one)), "{key}");
                }
                Slot::Part(part) => check_defaults(part, count),
                Slot::Table(mut slot) => {
                    let names = slot.templates().map_or(1, |one| one.names.len());
                    (0..names).for_each(|index| check_defaults(slot.open(index), count));
                }
                Slot::Tables(tables, _) | Slot::Rows(tables) => {
                    check_defaults(tables.open("any"), count);
                }
                Slot::Free => {}
            }
        }
    }

    /// `HIL_WRITE_DOCS=1` writes the page anew.
    #[test]
    fn the_reference_page_states_every_key_as_it_is_declared() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/topology.md");
        let page = reference();
        if std::env::var_os("HIL_WRITE_DOCS").is_some() {
            std::fs::write(path, &page).unwrap();
        }
        let written = std::fs::read_to_string(path).unwrap_or_default();
        assert!(
            written == page,
            "docs/topology.md is not up to date: run this with HIL_WRITE_DOCS=1"
        );
    }

    #[test]
    fn every_default_lies_within_its_own_range() {
        let mut count = 0;
        check_defaults(&mut File::TEMPLATE.clone(), &mut count);
        assert!(count > 100, "{count}");
        assert!(!Shape::Number(0.0..=1.0).allows(&hil_core::options::Setting::Number(f64::NAN)));
    }
}
