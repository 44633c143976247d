//! Reads one table of the tree key by key. Whatever is wrong is noted with its place and the
//! reading goes on, so that one attempt shows every fault; keys nobody asked for are refused.

use core::time::Duration;
use std::collections::BTreeMap;

use super::errors::{Fault, Faults, Place};
use super::limits::{Limit, NAME_LENGTH_MAX, RangeText};
use super::schema::Shape;
use super::tree::{Node, Table, Value, join};
use super::units::parse_duration;

/// A value with the place it stands at.
#[derive(Debug, Clone)]
pub(super) struct At<T> {
    pub value: T,
    pub place: Place,
}

/// A table being read.
#[derive(Debug)]
pub(super) struct Reader<'t> {
    /// Path of the table.
    pub path: String,
    /// Where its key stands.
    pub place: Place,
    table: &'t Table,
    asked: Vec<&'static str>,
    faults: &'t Faults,
}

impl<'t> Reader<'t> {
    /// Reads `table`, whose key is `path`.
    pub(super) fn new(path: String, place: Place, table: &'t Table, faults: &'t Faults) -> Self {
        Self {
            path,
            place,
            table,
            asked: Vec::new(),
            faults,
        }
    }

    /// The path of `key` in this table.
    pub(super) fn path_of(&self, key: &str) -> String {
        join(&self.path, key)
    }

    /// Notes a fault of `key`, at its value if it has one, else at the table.
    pub(super) fn refuse(&self, key: &str, fault: Fault) {
        let place = self.table.get(key).map_or(self.place, |node| node.place);
        self.faults.add(self.path_of(key), Some(place), fault);
    }

    /// True when the table has `key`; does not make the key known.
    pub(super) fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Where the value of `key` stands; does not make the key known.
    pub(super) fn place_of(&self, key: &str) -> Option<Place> {
        self.table.get(key).map(|node| node.place)
    }

    /// True when `key` is a table; does not make the key known.
    pub(super) fn is_table(&self, key: &str) -> bool {
        let node = self.table.get(key);
        node.is_some_and(|node| matches!(node.value, Value::Table(_)))
    }

    /// Notes that each present key of `keys` does not belong here, and why.
    pub(super) fn refuse_present(&self, keys: &[&'static str], why: &str) {
        for key in keys {
            if let Some(node) = self.table.get(*key) {
                let fault = Fault::Inconsistent(why.to_owned());
                let path = self.path_of(key);
                self.faults.add(path, Some(node.key_place), fault);
            }
        }
    }

    /// The value of `key`, which becomes a known key; what it may be is noted for the schema.
    fn node(&mut self, key: &'static str, shape: impl FnOnce() -> Shape) -> Option<&'t Node> {
        self.asked.push(key);
        self.faults.note(&self.path, key, shape);
        self.table.get(key)
    }

    fn wrong_type<T>(&self, key: &str, node: &Node, expected: &'static str) -> Option<T> {
        let found = node.value.type_name();
        let fault = Fault::WrongType { found, expected };
        self.faults.add(self.path_of(key), Some(node.place), fault);
        None
    }

    /// A string.
    pub(super) fn text(&mut self, key: &'static str) -> Option<At<String>> {
        self.text_as(key, || Shape::Text)
    }

    fn text_as(&mut self, key: &'static str, shape: impl FnOnce() -> Shape) -> Option<At<String>> {
        let node = self.node(key, shape)?;
        match &node.value {
            Value::Text(text) => Some(At {
                value: text.clone(),
                place: node.place,
            }),
            _ => self.wrong_type(key, node, "a string"),
        }
    }

    /// A string that can name a folder and a shared-memory service.
    pub(super) fn name(&mut self, key: &'static str) -> Option<At<String>> {
        let name = self.text_as(key, || Shape::Name)?;
        if !is_name(&name.value, false) {
            self.refuse(key, bad_name(&name.value, false));
            return None;
        }
        Some(name)
    }

    /// A boolean.
    pub(super) fn boolean(&mut self, key: &'static str) -> Option<bool> {
        let node = self.node(key, || Shape::Boolean)?;
        match &node.value {
            Value::Boolean(boolean) => Some(*boolean),
            _ => self.wrong_type(key, node, "true or false"),
        }
    }

    /// An integer within `limit`.
    pub(super) fn integer<T>(&mut self, key: &'static str, limit: &Limit<i64>) -> Option<T>
    where
        T: TryFrom<i64>,
    {
        let node = self.node(key, || Shape::integer(limit))?;
        self.integer_of(key, node, limit)
    }

    fn integer_of<T>(&self, key: &str, node: &Node, limit: &Limit<i64>) -> Option<T>
    where
        T: TryFrom<i64>,
    {
        let Value::Integer(integer) = &node.value else {
            return self.wrong_type(key, node, "an integer");
        };
        let within = limit.allows(integer).then(|| T::try_from(*integer).ok());
        within.flatten().or_else(|| {
            self.out_of_range(key, node, &integer.to_string(), limit);
            None
        })
    }

    /// One integer within `limit`, or an array of them; empty when the key is absent.
    pub(super) fn integers<T>(&mut self, key: &'static str, limit: &Limit<i64>) -> Vec<T>
    where
        T: TryFrom<i64>,
    {
        let Some(node) = self.node(key, || Shape::integers(limit)) else {
            return Vec::new();
        };
        match &node.value {
            Value::Array(items) => items
                .iter()
                .filter_map(|item| self.integer_of(key, item, limit))
                .collect(),
            Value::Integer(_) => self.integer_of(key, node, limit).into_iter().collect(),
            _ => {
                let nothing: Option<T> =
                    self.wrong_type(key, node, "an integer or an array of integers");
                nothing.into_iter().collect()
            }
        }
    }

    /// A number within `limit`; integers are numbers.
    pub(super) fn number(&mut self, key: &'static str, limit: &Limit<f64>) -> Option<f64> {
        let node = self.node(key, || Shape::number(limit))?;
        self.number_of(key, node, limit)
    }

    fn number_of(&self, key: &str, node: &Node, limit: &Limit<f64>) -> Option<f64> {
        let number = match &node.value {
            Value::Number(number) => *number,
            Value::Integer(integer) => *integer as f64,
            _ => return self.wrong_type(key, node, "a number"),
        };
        if limit.allows(&number) {
            return Some(number);
        }
        self.out_of_range(key, node, &number.to_string(), limit);
        None
    }

    /// An array of numbers within `limit`.
    pub(super) fn numbers(&mut self, key: &'static str, limit: &Limit<f64>) -> Option<Vec<f64>> {
        let node = self.node(key, || Shape::numbers(limit))?;
        let Value::Array(items) = &node.value else {
            return self.wrong_type(key, node, "an array of numbers");
        };
        let items = items.iter().map(|item| self.number_of(key, item, limit));
        all_of(items)
    }

    /// An array of durations within `limit`.
    pub(super) fn durations(
        &mut self,
        key: &'static str,
        limit: &Limit<Duration>,
    ) -> Option<Vec<Duration>> {
        let node = self.node(key, || Shape::durations(limit))?;
        let Value::Array(items) = &node.value else {
            return self.wrong_type(
                key,
                node,
                "an array of durations, e.g. [\"1 ms\", \"2 ms\"]",
            );
        };
        let items = items.iter().map(|item| self.duration_of(key, item, limit));
        all_of(items)
    }

    /// A duration within `limit`, written with its unit.
    pub(super) fn duration(
        &mut self,
        key: &'static str,
        limit: &Limit<Duration>,
    ) -> Option<Duration> {
        let node = self.node(key, || Shape::duration(limit))?;
        self.duration_of(key, node, limit)
    }

    fn duration_of(&self, key: &str, node: &Node, limit: &Limit<Duration>) -> Option<Duration> {
        let Value::Text(text) = &node.value else {
            return self.wrong_type(key, node, "a string with a duration, e.g. \"20 ms\"");
        };
        match parse_duration(text) {
            Ok(duration) if limit.allows(&duration) => return Some(duration),
            Ok(_) => self.out_of_range(key, node, &format!("\"{text}\""), limit),
            Err(error) => {
                let fault = Fault::Duration {
                    value: text.clone(),
                    reason: error.to_string(),
                };
                self.faults.add(self.path_of(key), Some(node.place), fault);
            }
        }
        None
    }

    fn out_of_range(&self, key: &str, node: &Node, value: &str, limit: &dyn RangeText) {
        let fault = Fault::OutOfRange {
            value: value.to_owned(),
            allowed: limit.range_text(),
        };
        self.faults.add(self.path_of(key), Some(node.place), fault);
    }

    /// One word of a fixed list.
    pub(super) fn word<T: Copy>(
        &mut self,
        key: &'static str,
        words: &[(&'static str, T)],
    ) -> Option<T> {
        let shape = || Shape::Words(words.iter().map(|(word, _)| *word).collect());
        let text = self.text_as(key, shape)?;
        let found = words.iter().find(|(word, _)| *word == text.value);
        if found.is_none() {
            let fault = Fault::UnknownWord {
                value: text.value,
                expected: "an allowed word",
                allowed: words.iter().map(|(word, _)| (*word).to_owned()).collect(),
            };
            self.refuse(key, fault);
        }
        found.map(|(_, value)| *value)
    }

    /// An array of strings.
    pub(super) fn texts(&mut self, key: &'static str) -> Option<At<Vec<At<String>>>> {
        let node = self.node(key, || Shape::Texts)?;
        let Value::Array(items) = &node.value else {
            return self.wrong_type(key, node, "an array of strings");
        };
        let text = |item: &Node| match &item.value {
            Value::Text(text) => Some(At {
                value: text.clone(),
                place: item.place,
            }),
            _ => self.wrong_type(key, item, "a string"),
        };
        let texts: Option<Vec<_>> = items.iter().map(text).collect();
        texts.map(|value| At {
            value,
            place: node.place,
        })
    }

    /// A table of strings, e.g. environment variables.
    pub(super) fn text_table(&mut self, key: &'static str) -> BTreeMap<String, String> {
        let node = self.node(key, || Shape::TextTable);
        let Some(reader) = node.and_then(|node| self.table_of(key, node)) else {
            return BTreeMap::new();
        };
        let mut texts = BTreeMap::new();
        for (name, node) in reader.table {
            if let Value::Text(text) = &node.value {
                texts.insert(name.clone(), text.clone());
            } else {
                let _nothing: Option<()> = reader.wrong_type(name, node, "a string");
            }
        }
        texts
    }

    /// A table; the caller ends it with [`Reader::finish`].
    pub(super) fn table(&mut self, key: &'static str) -> Option<Reader<'t>> {
        self.table_or(key, "a table")
    }

    /// As [`Reader::table`], with words of its own for anything else.
    pub(super) fn table_or(
        &mut self,
        key: &'static str,
        expected: &'static str,
    ) -> Option<Reader<'t>> {
        let node = self.node(key, || Shape::Table)?;
        if matches!(node.value, Value::Table(_)) {
            return self.table_of(key, node);
        }
        self.wrong_type(key, node, expected)
    }

    fn table_of(&self, key: &str, node: &'t Node) -> Option<Reader<'t>> {
        match &node.value {
            Value::Table(table) => Some(Reader::new(
                self.path_of(key),
                node.key_place,
                table,
                self.faults,
            )),
            _ => self.wrong_type(key, node, "a table"),
        }
    }

    /// The tables of a table, by name.
    pub(super) fn named_tables(&mut self, key: &'static str) -> Vec<(String, Reader<'t>)> {
        let node = self.node(key, || Shape::Tables);
        let Some(reader) = node.and_then(|node| self.table_of(key, node)) else {
            return Vec::new();
        };
        let has_slashes = key == "channels";
        let mut tables = Vec::new();
        for (name, node) in reader.table {
            if !is_name(name, has_slashes) {
                let path = reader.path_of(name);
                let fault = bad_name(name, has_slashes);
                self.faults.add(path, Some(node.key_place), fault);
            } else if let Some(table) = reader.table_of(name, node) {
                tables.push((name.clone(), table));
            }
        }
        tables
    }

    /// The tree below this table, for what is handed on unread.
    pub(super) fn unread(&self) -> &'t Table {
        self.faults.note_unread(&self.path);
        self.table
    }

    /// Refuses every key that was not asked for.
    pub(super) fn finish(self) {
        for (key, node) in self.table {
            if self.asked.contains(&key.as_str()) {
                continue;
            }
            let mut allowed: Vec<_> = self.asked.iter().map(|key| (*key).to_owned()).collect();
            allowed.sort_unstable();
            let path = self.path_of(key);
            let fault = Fault::UnknownKey { allowed };
            self.faults.add(path, Some(node.key_place), fault);
        }
    }
}

/// All of them, each asked for, so that every fault is noted.
fn all_of<T>(items: impl Iterator<Item = Option<T>>) -> Option<Vec<T>> {
    let read: Vec<Option<T>> = items.collect();
    read.into_iter().collect()
}

fn is_name(name: &str, may_have_slashes: bool) -> bool {
    let is_allowed = |letter: char| {
        letter.is_ascii_alphanumeric()
            || matches!(letter, '-' | '_' | '.')
            || (may_have_slashes && letter == '/')
    };
    let starts_well = name.starts_with(|letter: char| letter.is_ascii_alphanumeric());
    starts_well && name.len() <= NAME_LENGTH_MAX && name.chars().all(is_allowed)
}

fn bad_name(name: &str, may_have_slashes: bool) -> Fault {
    let slash = if may_have_slashes { ", `/`" } else { "" };
    Fault::Inconsistent(format!(
        "`{name}` is no name: 1 to {NAME_LENGTH_MAX} letters, digits, `-`, `_`, `.`{slash}, \
         starting with a letter or digit"
    ))
}
