//! TOML as a tree whose every key and value remembers the file and place it came from, and the
//! merging of such trees. It knows no key of the topology.

use std::collections::BTreeMap;

use toml::de::{DeString, DeTable, DeValue};

use super::errors::{Fault, Faults, Place, Source};

/// Keys in alphabetical order.
pub(super) type Table = BTreeMap<String, Node>;

/// A key with its value.
#[derive(Debug, Clone)]
pub(super) struct Node {
    /// Where the key stands.
    pub key_place: Place,
    /// Where the value stands.
    pub place: Place,
    pub value: Value,
}

#[derive(Debug, Clone)]
pub(super) enum Value {
    Text(String),
    Integer(i64),
    Number(f64),
    Boolean(bool),
    Datetime(toml::value::Datetime),
    Array(Vec<Node>),
    Table(Table),
}

impl Value {
    /// The type, with its article.
    pub(super) fn type_name(&self) -> &'static str {
        match self {
            Self::Text(_) => "a string",
            Self::Integer(_) => "an integer",
            Self::Number(_) => "a number with fraction",
            Self::Boolean(_) => "a boolean",
            Self::Datetime(_) => "a date or time",
            Self::Array(_) => "an array",
            Self::Table(_) => "a table",
        }
    }

    /// The same value without places.
    pub(super) fn to_plain(&self) -> toml::Value {
        match self {
            Self::Text(text) => toml::Value::String(text.clone()),
            Self::Integer(integer) => toml::Value::Integer(*integer),
            Self::Number(number) => toml::Value::Float(*number),
            Self::Boolean(boolean) => toml::Value::Boolean(*boolean),
            Self::Datetime(datetime) => toml::Value::Datetime(*datetime),
            Self::Array(items) => {
                toml::Value::Array(items.iter().map(|item| item.value.to_plain()).collect())
            }
            Self::Table(table) => {
                let table = table.iter();
                toml::Value::Table(
                    table
                        .map(|(key, node)| (key.clone(), node.value.to_plain()))
                        .collect(),
                )
            }
        }
    }
}

/// Parses the source with this index; notes every syntax error.
pub(super) fn parse(sources: &[Source], source_index: usize, faults: &Faults) -> Option<Table> {
    let text = &sources[source_index].text;
    let (document, errors) = DeTable::parse_recoverable(text);
    for error in &errors {
        let span = error.span().unwrap_or(0..0);
        let place = Place {
            source_index,
            start: span.start,
            end: span.end,
        };
        let mut message = error.message().to_owned();
        if is_at_decimal_comma(text, place.start) {
            message.push_str("; a decimal comma? Write a decimal point");
        }
        faults.add("", Some(place), Fault::Syntax(message));
    }
    let reader = SourceReader {
        source_index,
        faults,
    };
    errors
        .is_empty()
        .then(|| reader.table(document.get_ref(), ""))
}

/// A comma stands there between two digits.
fn is_at_decimal_comma(text: &str, at: usize) -> bool {
    let around = at
        .checked_sub(1)
        .and_then(|before| text.as_bytes().get(before..at + 2));
    matches!(around, Some([a, b',', b]) if a.is_ascii_digit() && b.is_ascii_digit())
}

struct SourceReader<'a> {
    source_index: usize,
    faults: &'a Faults,
}

impl SourceReader<'_> {
    fn place(&self, span: &core::ops::Range<usize>) -> Place {
        Place {
            source_index: self.source_index,
            start: span.start,
            end: span.end,
        }
    }

    fn table(&self, table: &DeTable<'_>, path: &str) -> Table {
        let entry = |(key, value): (&toml::Spanned<DeString<'_>>, &toml::Spanned<DeValue<'_>>)| {
            let name = key.get_ref().as_ref();
            let node = Node {
                key_place: self.place(&key.span()),
                place: self.place(&value.span()),
                value: self.value(value, &join(path, name)),
            };
            (name.to_owned(), node)
        };
        table.iter().map(entry).collect()
    }

    fn value(&self, value: &toml::Spanned<DeValue<'_>>, path: &str) -> Value {
        match value.get_ref() {
            DeValue::String(text) => Value::Text(text.as_ref().to_owned()),
            DeValue::Boolean(boolean) => Value::Boolean(*boolean),
            DeValue::Datetime(datetime) => Value::Datetime(*datetime),
            DeValue::Integer(integer) => {
                let parsed = i64::from_str_radix(integer.as_str(), integer.radix());
                Value::Integer(parsed.unwrap_or_else(|_overflow| {
                    let fault = Fault::OutOfRange {
                        value: integer.to_string(),
                        allowed: "the 64-bit integers".to_owned(),
                    };
                    self.faults
                        .add(path, Some(self.place(&value.span())), fault);
                    0
                }))
            }
            // Nothing but an exponent out of range fails here; Rust reads those as infinite.
            DeValue::Float(number) => Value::Number(number.as_str().parse().unwrap_or(f64::NAN)),
            DeValue::Array(items) => {
                let node = |item: &toml::Spanned<DeValue<'_>>| Node {
                    key_place: self.place(&item.span()),
                    place: self.place(&item.span()),
                    value: self.value(item, path),
                };
                Value::Array(items.iter().map(node).collect())
            }
            DeValue::Table(table) => Value::Table(self.table(table, path)),
        }
    }
}

/// Lays `overlay` over `base`: tables merge, everything else replaces.
pub(super) fn merge(base: &mut Table, overlay: Table) {
    for (key, over) in overlay {
        match (base.get_mut(&key), over) {
            (
                Some(Node {
                    key_place,
                    place,
                    value: Value::Table(below),
                }),
                Node {
                    value: Value::Table(above),
                    key_place: over_key_place,
                    place: over_place,
                },
            ) => {
                // What is missing from a table is reported where it was last extended.
                *key_place = over_key_place;
                *place = over_place;
                merge(below, above);
            }
            (_, over) => {
                base.insert(key, over);
            }
        }
    }
}

/// Where `path` stands in `table`, or as much of it as the files say; `None` where they say nothing of it.
pub(super) fn place_of(table: &Table, path: &str) -> Option<Place> {
    let (_, deepest) = walk(table, path);
    deepest.map(|node| match &node.value {
        Value::Table(_) => node.key_place,
        _ => node.place,
    })
}

/// The key at `path`, which may end in an index as in `bays[2]`.
pub(super) fn find<'t>(table: &'t Table, path: &str) -> Option<&'t Node> {
    walk(table, path).0
}

/// The key at `path`, and the deepest one on the way to it.
fn walk<'t>(table: &'t Table, path: &str) -> (Option<&'t Node>, Option<&'t Node>) {
    let (mut below, mut deepest) = (Some(table), None);
    for step in segments(path) {
        let (key, index) = split_index(&step);
        let Some(node) = below.and_then(|table| table.get(key)) else {
            return (None, deepest);
        };
        let item = match (&node.value, index) {
            (Value::Array(items), Some(index)) => items.get(index),
            _ => None,
        };
        let node = item.unwrap_or(node);
        deepest = Some(node);
        below = match &node.value {
            Value::Table(table) => Some(table),
            _ => None,
        };
    }
    (deepest, deepest)
}

/// `bays[2]` as `bays` and 2.
fn split_index(step: &str) -> (&str, Option<usize>) {
    let parts = step.strip_suffix(']').and_then(|rest| rest.split_once('['));
    let found = parts.and_then(|(key, index)| Some((key, index.parse().ok()?)));
    found.map_or((step, None), |(key, index)| (key, Some(index)))
}

/// The keys of a path that [`join`] made.
fn segments(path: &str) -> Vec<String> {
    let (mut keys, mut key) = (Vec::new(), String::new());
    let (mut is_quoted, mut is_escaped) = (false, false);
    for letter in path.chars() {
        match letter {
            _ if is_escaped => {
                key.push(letter);
                is_escaped = false;
            }
            '\\' if is_quoted => is_escaped = true,
            '"' => is_quoted = !is_quoted,
            '.' if !is_quoted => keys.push(core::mem::take(&mut key)),
            _ => key.push(letter),
        }
    }
    keys.push(key);
    keys
}

/// `path.key`, the key quoted when TOML needs it.
pub(super) fn join(path: &str, key: &str) -> String {
    let is_bare = |letter: char| letter.is_ascii_alphanumeric() || letter == '_' || letter == '-';
    let dot = if path.is_empty() { "" } else { "." };
    if !key.is_empty() && key.chars().all(is_bare) {
        format!("{path}{dot}{key}")
    } else {
        format!("{path}{dot}\"{}\"", key.escape_debug())
    }
}
