//! Reads tables of the tree as their declarations say ([`Options`]). Whatever is wrong is noted with
//! its place and the reading goes on, so that one attempt shows every fault; keys that no declaration
//! has are refused.

use hil_core::options::{
    ANY_NUMBER, Field, Options, Setting, Shape, Slot, Table as TableSlot, Tables,
};
use hil_core::text_file::has_decimal_comma;

use super::errors::{Fault, Faults, Place};
use super::tables::{NAME, NAME_WITH_SLASHES};
use super::tree::{Node, Table, Value, join};
use super::units::{format_duration, parse_duration};

/// A table being read.
#[derive(Debug)]
struct Reader<'t> {
    /// Path of the table.
    path: String,
    /// Where its key stands.
    place: Place,
    table: &'t Table,
    faults: &'t Faults,
    /// Keys that its declarations have.
    known: Vec<&'static str>,
    /// Those of them whose value was refused.
    refused: Vec<&'static str>,
}

/// Reads the table at `path` into `options`; `place` is where what is missing would stand. False when
/// something is missing or refused.
pub(super) fn read(
    options: &mut dyn Options,
    path: &str,
    table: &Table,
    place: Place,
    faults: &Faults,
) -> bool {
    let mut reader = Reader::new(path.to_owned(), place, table, faults);
    let before = faults.count();
    reader.options(options);
    reader.finish();
    faults.count() == before
}

impl<'t> Reader<'t> {
    fn new(path: String, place: Place, table: &'t Table, faults: &'t Faults) -> Self {
        Self {
            path,
            place,
            table,
            faults,
            known: Vec::new(),
            refused: Vec::new(),
        }
    }

    fn add(&self, key: &str, place: Place, fault: Fault) {
        self.faults.add(join(&self.path, key), Some(place), fault);
    }

    /// Notes a fault of `key`, at its value if it has one, else at the table.
    fn refuse(&self, key: &str, fault: Fault) {
        let place = self.table.get(key).map_or(self.place, |node| node.place);
        self.add(key, place, fault);
    }

    fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// The value of `key`, which becomes a known key.
    fn node(&mut self, key: &'static str) -> Option<&'t Node> {
        self.known.push(key);
        self.table.get(key)
    }

    /// Reads every option. True when all that are required are there and all fit together.
    fn options(&mut self, options: &mut dyn Options) -> bool {
        let mut is_usable = true;
        for field in options.fields() {
            let key = field.key;
            let is_read = self.field(field);
            if !is_read {
                self.refused.push(key);
            }
            is_usable &= is_read;
        }
        // Whether an option has a meaning is known only now that all are read.
        for field in options.fields() {
            let Some(condition) = field.condition.filter(|condition| !condition.is_met) else {
                continue;
            };
            if let Some(node) = self.table.get(field.key)
                && !self.refused.contains(&condition.key)
            {
                let fault = Fault::Inconsistent(condition.why.to_owned());
                self.add(field.key, node.key_place, fault);
            }
        }
        // Each option is within its range by now; what is left is what they say together.
        if is_usable && let Err(error) = options.check_together() {
            self.refuse(&error.key, Fault::Inconsistent(error.problem));
            return false;
        }
        is_usable
    }

    /// Reads one option; false when it is missing or refused.
    fn field(&mut self, field: Field<'_>) -> bool {
        let key = field.key;
        let is_missing = field.is_required && !self.has(key);
        if is_missing {
            let hint = match &field.slot {
                Slot::Value(_, Shape::Words(words)) => format!("write {}", one_of(words)),
                Slot::Value(_, shape) if field.hint.is_empty() => expected(shape).to_owned(),
                _ => field.hint.to_owned(),
            };
            self.refuse(key, Fault::Missing(hint));
        }
        let is_read = match field.slot {
            Slot::Value(mut value, shape) => {
                let node = self.node(key);
                node.is_none_or(|node| self.value(key, node, &shape, &mut *value))
            }
            Slot::Table(mut slot) => self.table(key, &mut *slot),
            Slot::Part(options) => self.options(options),
            Slot::Tables(tables, has_slashes) => self.tables(key, tables, has_slashes),
            Slot::Rows(rows) => self.rows(key, rows),
            Slot::Free => {
                let node = self.node(key);
                node.is_none_or(|node| self.below(key, node, "a table").is_some())
            }
        };
        is_read && !is_missing
    }

    fn value(
        &self,
        key: &str,
        node: &Node,
        shape: &Shape,
        value: &mut dyn hil_core::options::Value,
    ) -> bool {
        let Some(setting) = self.setting(key, node, shape) else {
            return false;
        };
        let set = value.set(setting);
        set.map_err(|why| self.add(key, node.place, Fault::Inconsistent(why)))
            .is_ok()
    }

    /// The value at `node` without its type, where `shape` allows it.
    fn setting(&self, key: &str, node: &Node, shape: &Shape) -> Option<Setting> {
        let setting = match (shape, &node.value) {
            (Shape::Boolean, Value::Boolean(value)) => Setting::Boolean(*value),
            (Shape::Integer(_), Value::Integer(value)) => Setting::Integer(*value),
            (Shape::Number(_), Value::Number(value)) => Setting::Number(*value),
            (Shape::Number(_), Value::Integer(value)) => Setting::Number(*value as f64),
            (Shape::Time(_), Value::Text(text)) => match parse_duration(text) {
                Ok(time) => Setting::Time(time),
                Err(error) => {
                    let (value, reason) = (text.clone(), error.to_string());
                    self.add(key, node.place, Fault::Duration { value, reason });
                    return None;
                }
            },
            (Shape::Text(rule), Value::Text(text)) => {
                if let Err(why) = (rule.check)(text) {
                    self.add(key, node.place, Fault::Inconsistent(why));
                    return None;
                }
                Setting::Text(text.clone())
            }
            (Shape::Words(words), Value::Text(text)) => {
                self.word(key, node, words)?;
                Setting::Text(text.clone())
            }
            (Shape::List(each) | Shape::OneOrMore(each), Value::Array(items)) => {
                // Each is read, so that every fault is noted.
                let read = items.iter().map(|item| self.setting(key, item, each));
                let read: Vec<Option<Setting>> = read.collect();
                return read
                    .into_iter()
                    .collect::<Option<Vec<_>>>()
                    .map(Setting::List);
            }
            (Shape::OneOrMore(each), Value::Integer(_)) => {
                return Some(Setting::List(vec![self.setting(key, node, each)?]));
            }
            (Shape::Texts, Value::Table(table)) => {
                let below = join(&self.path, key);
                let reader = Reader::new(below, node.key_place, table, self.faults);
                let text = |(name, node): (&String, &Node)| match &node.value {
                    Value::Text(text) => Some((name.clone(), text.clone())),
                    _ => reader.wrong_type(name, node, "a string"),
                };
                let read: Vec<Option<(String, String)>> = table.iter().map(text).collect();
                return read.into_iter().collect::<Option<_>>().map(Setting::Texts);
            }
            (Shape::Number(_) | Shape::Integer(_) | Shape::OneOrMore(_), Value::Text(text))
                if has_decimal_comma(text) =>
            {
                let point = match shape {
                    Shape::Number(_) => text.replacen(',', ".", 1),
                    _ => text.chars().take_while(|letter| *letter != ',').collect(),
                };
                let value = text.clone();
                self.add(key, node.place, Fault::DecimalComma { value, point });
                return None;
            }
            _ => return self.wrong_type(key, node, expected(shape)),
        };
        if shape.allows(&setting) {
            return Some(setting);
        }
        let value = match &node.value {
            Value::Text(text) => format!("\"{text}\""),
            Value::Number(number) => number.to_string(),
            other => other.to_plain().to_string(),
        };
        let allowed = range_text(shape);
        self.add(key, node.place, Fault::OutOfRange { value, allowed });
        None
    }

    /// The index of the word at `node` in `words`.
    fn word(&self, key: &str, node: &Node, words: &[&'static str]) -> Option<usize> {
        let Value::Text(text) = &node.value else {
            return self.wrong_type(key, node, "a string");
        };
        let found = words.iter().position(|word| word == text);
        if found.is_none() {
            let fault = Fault::UnknownWord {
                value: text.clone(),
                expected: "an allowed word",
                allowed: words.iter().map(|word| (*word).to_owned()).collect(),
            };
            self.add(key, node.place, fault);
        }
        found
    }

    fn wrong_type<T>(&self, key: &str, node: &Node, expected: impl Into<String>) -> Option<T> {
        let (found, expected) = (node.value.type_name(), expected.into());
        self.add(key, node.place, Fault::WrongType { found, expected });
        None
    }

    /// The reader of the table at `node`; the caller ends it with [`Reader::finish`].
    fn below(&self, key: &str, node: &'t Node, expected: impl Into<String>) -> Option<Self> {
        match &node.value {
            Value::Table(table) => {
                let path = join(&self.path, key);
                Some(Reader::new(path, node.key_place, table, self.faults))
            }
            _ => self.wrong_type(key, node, expected),
        }
    }

    /// Reads a table with options of its own, or what stands in its place.
    fn table(&mut self, key: &'static str, slot: &mut dyn TableSlot) -> bool {
        let node = self.node(key);
        let mut expected = "a table".to_owned();
        let mut is_usable = true;
        if let Some(mut short) = slot.shorthand() {
            if short.key != key {
                let short_node = self.node(short.key);
                if node.is_some()
                    && let Some(short_node) = short_node
                {
                    let why = format!("beside [{key}] says the {key} twice; leave one of them out");
                    self.add(short.key, short_node.key_place, Fault::Inconsistent(why));
                } else if let Some(node) = short_node {
                    is_usable = self.value(short.key, node, &short.shape, &mut *short.value);
                }
                expected = format!("a table with options; did you mean `{}`?", short.key);
            } else if let Some(node) = node.filter(|node| !matches!(node.value, Value::Table(_))) {
                return self.value(key, node, &short.shape, &mut *short.value);
            }
        }
        let Some(node) = node else { return is_usable };
        let Some(mut below) = self.below(key, node, expected) else {
            return false;
        };
        let mut template = Some(0);
        if let Some(templates) = slot.templates() {
            let named = below.node(templates.key);
            if templates.is_required {
                template = None;
                if named.is_none() {
                    below.refuse(templates.key, Fault::Missing(one_of(templates.names)));
                }
            }
            if let Some(node) = named {
                let index = below.word(templates.key, node, templates.names);
                is_usable &= index.is_some();
                template = index.or(template);
            }
        }
        // The keys that belong here depend on the template: without it none is unknown.
        let Some(template) = template else {
            return false;
        };
        is_usable &= below.options(slot.open(template));
        below.finish();
        is_usable
    }

    /// Reads the tables of a table, by name.
    fn tables(&mut self, key: &'static str, tables: &mut dyn Tables, has_slashes: bool) -> bool {
        let Some(node) = self.node(key) else {
            return true;
        };
        let Some(reader) = self.below(key, node, "a table") else {
            return false;
        };
        let rule = if has_slashes { NAME_WITH_SLASHES } else { NAME };
        let mut is_usable = true;
        for (name, node) in reader.table {
            if let Err(why) = (rule.check)(name) {
                reader.add(name, node.key_place, Fault::Inconsistent(why));
            } else if let Some(mut below) = reader.below(name, node, "a table") {
                is_usable &= below.options(tables.open(name));
                below.finish();
                continue;
            }
            is_usable = false;
        }
        is_usable
    }

    /// Reads an array of tables.
    fn rows(&mut self, key: &'static str, rows: &mut dyn Tables) -> bool {
        let Some(node) = self.node(key) else {
            return true;
        };
        let Value::Array(items) = &node.value else {
            return self
                .wrong_type(key, node, "an array of tables")
                .unwrap_or(false);
        };
        let mut is_usable = true;
        for (index, item) in items.iter().enumerate() {
            let path = format!("{}[{index}]", join(&self.path, key));
            is_usable &= match &item.value {
                Value::Table(table) => read(rows.open(""), &path, table, item.place, self.faults),
                _ => self.wrong_type(key, item, "a table").unwrap_or(false),
            };
        }
        is_usable
    }

    /// Refuses every key that no declaration has.
    fn finish(self) {
        for (key, node) in self.table {
            if self.known.contains(&key.as_str()) {
                continue;
            }
            let mut allowed: Vec<_> = self.known.iter().map(|key| (*key).to_owned()).collect();
            allowed.sort_unstable();
            self.add(key, node.key_place, Fault::UnknownKey { allowed });
        }
    }
}

/// `one of "a", "b"`.
fn one_of(words: &[&str]) -> String {
    let quoted: Vec<_> = words.iter().map(|word| format!("\"{word}\"")).collect();
    format!("one of {}", quoted.join(", "))
}

/// What a value must be, with its article.
fn expected(shape: &Shape) -> &'static str {
    match shape {
        Shape::Boolean => "true or false",
        Shape::Integer(_) => "an integer",
        Shape::Number(_) => "a number",
        Shape::Time(_) => "a string with a duration, e.g. \"20 ms\"",
        Shape::Text(_) | Shape::Words(_) => "a string",
        Shape::List(each) => match **each {
            Shape::Time(_) => "an array of durations, e.g. [\"1 ms\", \"2 ms\"]",
            Shape::Number(_) => "an array of numbers",
            _ => "an array of strings",
        },
        Shape::OneOrMore(_) => "an integer or an array of integers",
        Shape::Texts => "a table",
    }
}

/// The range of a shape in the words of the file; empty for one without.
pub(super) fn range_text(shape: &Shape) -> String {
    fn range(min: &str, max: &str) -> String {
        if min == max {
            min.to_owned()
        } else {
            format!("{min} to {max}")
        }
    }
    match shape {
        Shape::Integer(ends) => range(&ends.start().to_string(), &ends.end().to_string()),
        Shape::Number(ends) if *ends == ANY_NUMBER => "the real numbers".to_owned(),
        Shape::Number(ends) => range(&ends.start().to_string(), &ends.end().to_string()),
        Shape::Time(ends) => {
            let [min, max] = [ends.start(), ends.end()].map(|end| format_duration(*end));
            format!("\"{min}\" to \"{max}\"")
        }
        _ => String::new(),
    }
}
