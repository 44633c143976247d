//! Parameters of a case read from a TOML table, with errors that say by themselves which key is wrong and
//! what it may be called. It checks no value.

use core::fmt;

use serde::de::value::{MapAccessDeserializer, StrDeserializer};
use serde::de::{
    DeserializeSeed, Deserializer, Error, IntoDeserializer, MapAccess, SeqAccess, Visitor,
};
use serde::forward_to_deserialize_any;
use toml::Value;

use super::known::ParameterFault;

/// What reads `table`.
pub(super) fn read(table: &toml::Table) -> TableReader<'_> {
    TableReader(table)
}

/// Why parameters cannot be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReadError {
    /// The innermost key first.
    path: Vec<String>,
    problem: Problem,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Problem {
    UnknownField { valid_keys: &'static [&'static str] },
    MissingField { name: &'static str },
    Other { text: String },
}

impl ReadError {
    pub(super) const fn is_missing_field(&self) -> bool {
        matches!(self.problem, Problem::MissingField { .. })
    }

    fn below(mut self, key: &str) -> Self {
        self.path.push(key.to_owned());
        self
    }

    pub(super) fn to_fault(&self) -> ParameterFault {
        let key: Vec<String> = self.path.iter().rev().cloned().collect();
        let (message, is_unknown_key, valid_keys) = match &self.problem {
            Problem::UnknownField { valid_keys } => (self.to_string(), true, *valid_keys),
            Problem::MissingField { .. } | Problem::Other { .. } => {
                (format!("cannot be read: {self}"), false, [].as_slice())
            }
        };
        ParameterFault {
            key,
            message,
            is_unknown_key,
            valid_keys: valid_keys.iter().map(|key| (*key).to_owned()).collect(),
        }
    }
}

impl fmt::Display for ReadError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.problem {
            Problem::UnknownField { valid_keys } => {
                let name = self.path.first().map_or("", String::as_str);
                let valid: Vec<String> = valid_keys.iter().map(|key| format!("`{key}`")).collect();
                write!(
                    formatter,
                    "unknown field `{name}`, expected one of {}",
                    valid.join(", ")
                )
            }
            Problem::MissingField { name } => write!(formatter, "missing field `{name}`"),
            Problem::Other { text } => formatter.write_str(text),
        }
    }
}

impl core::error::Error for ReadError {}

impl Error for ReadError {
    fn custom<T: fmt::Display>(text: T) -> Self {
        Self {
            path: Vec::new(),
            problem: Problem::Other {
                text: text.to_string(),
            },
        }
    }

    fn unknown_field(field: &str, expected: &'static [&'static str]) -> Self {
        Self {
            path: vec![field.to_owned()],
            problem: Problem::UnknownField {
                valid_keys: expected,
            },
        }
    }

    fn missing_field(field: &'static str) -> Self {
        Self {
            path: Vec::new(),
            problem: Problem::MissingField { name: field },
        }
    }
}

/// Reads a table.
#[derive(Debug, Clone, Copy)]
pub(super) struct TableReader<'a>(&'a toml::Table);

impl<'de> Deserializer<'de> for TableReader<'_> {
    type Error = ReadError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_map(Entries {
            rest: self.0.iter(),
            next: None,
        })
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option
        unit unit_struct newtype_struct seq tuple tuple_struct map struct enum identifier ignored_any
    }
}

struct Entries<'a> {
    rest: toml::map::Iter<'a, String, Value>,
    next: Option<(&'a str, &'a Value)>,
}

impl<'de> MapAccess<'de> for Entries<'_> {
    type Error = ReadError;

    fn next_key_seed<K: DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, ReadError> {
        let Some((key, value)) = self.rest.next() else {
            return Ok(None);
        };
        self.next = Some((key, value));
        let key: StrDeserializer<'_, ReadError> = key.as_str().into_deserializer();
        seed.deserialize(key).map(Some)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, ReadError> {
        let (key, value) = self
            .next
            .take()
            .expect("a value is asked for after its key");
        let read = seed.deserialize(ValueReader(value));
        read.map_err(|error| error.below(key))
    }
}

/// Reads a value.
struct ValueReader<'a>(&'a Value);

impl<'de> Deserializer<'de> for ValueReader<'_> {
    type Error = ReadError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.0 {
            Value::String(text) => visitor.visit_str(text),
            Value::Integer(number) => visitor.visit_i64(*number),
            Value::Float(number) => visitor.visit_f64(*number),
            Value::Boolean(truth) => visitor.visit_bool(*truth),
            Value::Datetime(time) => visitor.visit_string(time.to_string()),
            Value::Array(values) => visitor.visit_seq(Elements(values.iter())),
            Value::Table(table) => read(table).deserialize_any(visitor),
        }
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_some(self)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        _variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        match self.0 {
            Value::String(variant) => visitor.visit_enum(variant.as_str().into_deserializer()),
            Value::Table(table) => visitor.visit_enum(MapAccessDeserializer::new(Entries {
                rest: table.iter(),
                next: None,
            })),
            _ => self.deserialize_any(visitor),
        }
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit
        unit_struct seq tuple tuple_struct map struct identifier ignored_any
    }
}

struct Elements<'a>(core::slice::Iter<'a, Value>);

impl<'de> SeqAccess<'de> for Elements<'_> {
    type Error = ReadError;

    fn next_element_seed<T: DeserializeSeed<'de>>(
        &mut self,
        seed: T,
    ) -> Result<Option<T::Value>, ReadError> {
        let value = self.0.next();
        value
            .map(|value| seed.deserialize(ValueReader(value)))
            .transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        inner: Inner,
        mode: Mode,
        sizes: Vec<u8>,
        rate: Option<f64>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        count: u32,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum Mode {
        Off,
        Every { ticks: u32 },
    }

    fn outer(text: &str) -> Result<Outer, ReadError> {
        Outer::deserialize(read(&text.parse().unwrap()))
    }

    #[test]
    fn every_form_of_a_value_is_read_as_toml_itself_reads_it() {
        for mode in ["\"off\"", "{ every = { ticks = 3 } }"] {
            let text = format!("mode = {mode}\nsizes = [1, 2]\nrate = 3\n[inner]\ncount = 7\n");
            assert_eq!(outer(&text).unwrap(), toml::from_str(&text).unwrap());
        }
    }

    #[test]
    fn a_wrong_key_or_value_is_named_with_its_path() {
        let fault = |text: &str| outer(text).unwrap_err().to_fault();
        let unknown = fault("[inner]\ncuont = 7\n");
        assert_eq!(unknown.key, ["inner", "cuont"]);
        assert!(unknown.is_unknown_key);
        assert_eq!(unknown.valid_keys, ["count"]);
        let wrong = fault("[inner]\ncount = \"many\"\n");
        assert_eq!(wrong.key, ["inner", "count"]);
        assert_eq!(
            wrong.message,
            "cannot be read: invalid type: string \"many\", expected u32"
        );
        assert!(outer("").unwrap_err().is_missing_field());
        assert!(
            !outer("[inner]\ncount = -1\n")
                .unwrap_err()
                .is_missing_field()
        );
    }
}
