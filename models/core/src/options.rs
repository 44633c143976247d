//! Options of tables as data. A table declares each of its options once, with [`options!`](crate::options!):
//! key, meaning, type, default, range and condition. Checks, the reader and the writer of topology files,
//! their JSON schema and the reference page run from that. It reads and writes no file itself.

use core::fmt::Debug;
use core::net::{AddrParseError, IpAddr, Ipv4Addr, SocketAddr};
use core::ops::RangeInclusive;
use core::time::Duration;
use std::borrow::Cow;
use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::case_study::ParameterError;

/// The range of a real number that may have any value; NaN is none.
pub const ANY_NUMBER: RangeInclusive<f64> = f64::MIN..=f64::MAX;

/// What a value of an option may be.
#[derive(Debug, Clone)]
pub enum Shape {
    /// True or false.
    Boolean,
    /// An integer in the range.
    Integer(RangeInclusive<i64>),
    /// A real number in the range; NaN never is.
    Number(RangeInclusive<f64>),
    /// A time in the range.
    Time(RangeInclusive<Duration>),
    /// A text.
    Text(TextRule),
    /// One word of a list.
    Words(Vec<&'static str>),
    /// Any number of values.
    List(Box<Self>),
    /// A value alone, or any number of them in a list.
    OneOrMore(Box<Self>),
    /// Texts by names that the file chooses.
    Texts,
}

/// What a text may be, beyond what the type of its option says.
#[derive(Debug, Clone, Copy)]
pub struct TextRule {
    /// What it is, e.g. `an IP address`.
    pub what: &'static str,
    /// Why a text is not one; lower-case, without full stop.
    pub check: fn(&str) -> Result<(), String>,
    /// The same as a regular expression, where one says it.
    pub pattern: Option<&'static str>,
}

impl TextRule {
    /// Any text.
    pub const ANY: Self = Self {
        what: "a text",
        check: |_any| Ok(()),
        pattern: None,
    };
}

impl Default for TextRule {
    fn default() -> Self {
        Self::ANY
    }
}

/// The value of an option without its type.
#[derive(Debug, Clone, PartialEq)]
pub enum Setting {
    /// True or false.
    Boolean(bool),
    /// An integer.
    Integer(i64),
    /// A real number. In place of a time, its seconds.
    Number(f64),
    /// A time.
    Time(Duration),
    /// A text or a word.
    Text(String),
    /// Several values.
    List(Vec<Self>),
    /// Texts by name.
    Texts(BTreeMap<String, String>),
}

impl Shape {
    /// True when `setting` is within the ranges of the shape; its type is right already.
    pub fn allows(&self, setting: &Setting) -> bool {
        self.outside(setting).is_none()
    }

    /// The first value of `setting` that is outside its range, with that range in words.
    fn outside(&self, setting: &Setting) -> Option<[String; 3]> {
        fn beyond<T: PartialOrd>(
            value: &T,
            range: &RangeInclusive<T>,
            text: impl Fn(&T) -> String,
        ) -> Option<[String; 3]> {
            let is_outside = !range.contains(value);
            is_outside.then(|| [value, range.start(), range.end()].map(text))
        }
        match (self, setting) {
            (Self::Integer(range), Setting::Integer(value)) => beyond(value, range, i64::to_string),
            (Self::Number(range), Setting::Number(value)) => beyond(value, range, f64::to_string),
            (Self::Time(range), Setting::Time(value)) => {
                beyond(value, range, |time| format!("{time:?}"))
            }
            (Self::Time(range), Setting::Number(value_s)) => {
                let range_s = range.start().as_secs_f64()..=range.end().as_secs_f64();
                beyond(value_s, &range_s, f64::to_string)
            }
            (Self::List(each) | Self::OneOrMore(each), Setting::List(values)) => {
                values.iter().find_map(|value| each.outside(value))
            }
            _ => None,
        }
    }
}

/// A value of an option, whatever its type.
pub trait Value: Debug {
    /// The value; `None` for an option that may be left out and is.
    fn get(&self) -> Option<Setting>;

    /// Sets it to a value that its shape allows.
    ///
    /// # Errors
    /// Why it is none all the same; lower-case, without full stop.
    fn set(&mut self, setting: Setting) -> Result<(), String>;
}

/// A table below a table.
pub trait Table: Debug {
    /// Its options; `None` for a table that may be left out and is.
    fn options(&mut self) -> Option<&mut dyn Options>;

    /// Makes it a table that starts from a template: an index into [`Templates::names`], 0 without.
    fn open(&mut self, template: usize) -> &mut dyn Options;

    /// What it may start from.
    fn templates(&self) -> Option<Templates> {
        None
    }

    /// A single value that may stand in its place.
    fn shorthand(&mut self) -> Option<Shorthand<'_>> {
        None
    }
}

/// Named sets of options that a table may start from.
#[derive(Debug, Clone, Copy)]
pub struct Templates {
    /// The key that names one.
    pub key: &'static str,
    /// What it may say.
    pub names: &'static [&'static str],
    /// The one that the table started from, where that is part of what it says.
    pub chosen: Option<&'static str>,
    /// False when the first is the default.
    pub is_required: bool,
}

/// A value in place of a table.
#[derive(Debug)]
pub struct Shorthand<'o> {
    /// Its key: that of the table, or one of its own.
    pub key: &'static str,
    /// What it is.
    pub about: &'static str,
    /// What it may be.
    pub shape: Shape,
    /// The value; none when only the table says the same.
    pub value: Box<dyn Value + 'o>,
}

/// A table that a single value may stand for, and that may start from a template.
pub trait Short: Options + Sized {
    /// What it may start from.
    const TEMPLATES: Option<Templates>;
    /// The key of the value.
    const KEY: &'static str;
    /// What the value is.
    const ABOUT: &'static str;

    /// The table as it starts.
    fn template(index: usize) -> Self;

    /// The template that it started from, where that is part of what it says.
    fn chosen(&self) -> Option<&'static str> {
        None
    }

    /// What the value may be.
    fn shape() -> Shape;

    /// The value that says all that the table does, if one does.
    fn short(&self) -> Option<Setting> {
        None
    }

    /// The table that a value stands for.
    ///
    /// # Errors
    /// Why it stands for none.
    fn of_short(setting: Setting) -> Result<Self, String>;
}

/// A short table that may be left out.
#[derive(Debug)]
struct Abbreviated<'o, T>(&'o mut Option<T>);

impl<T: Short> Table for Abbreviated<'_, T> {
    fn options(&mut self) -> Option<&mut dyn Options> {
        self.0.as_mut().map(|options| options as &mut dyn Options)
    }

    fn open(&mut self, template: usize) -> &mut dyn Options {
        self.0.insert(T::template(template))
    }

    fn templates(&self) -> Option<Templates> {
        let chosen = self.0.as_ref().and_then(T::chosen);
        T::TEMPLATES.map(|templates| Templates {
            chosen,
            ..templates
        })
    }

    fn shorthand(&mut self) -> Option<Shorthand<'_>> {
        Some(Shorthand {
            key: T::KEY,
            about: T::ABOUT,
            shape: T::shape(),
            value: Box::new(Abbreviation(self.0)),
        })
    }
}

/// The value that stands for a short table.
#[derive(Debug)]
struct Abbreviation<'o, T>(&'o mut Option<T>);

impl<T: Short> Value for Abbreviation<'_, T> {
    fn get(&self) -> Option<Setting> {
        self.0.as_ref().and_then(T::short)
    }

    fn set(&mut self, setting: Setting) -> Result<(), String> {
        *self.0 = Some(T::of_short(setting)?);
        Ok(())
    }
}

/// Tables by names that the file chooses, or in the order of the file.
pub trait Tables: Debug {
    /// Makes one of that name; in an order, the next one.
    fn open(&mut self, name: &str) -> &mut dyn Options;

    /// Checks every table.
    ///
    /// # Errors
    /// The first key that is refused, behind `key` and the table's name or index.
    fn check_all(&mut self, key: &str) -> Result<(), ParameterError>;
}

/// The place of an option.
#[derive(Debug)]
pub enum Slot<'o> {
    /// A value.
    Value(Box<dyn Value + 'o>, Shape),
    /// A table with options of its own.
    Table(Box<dyn Table + 'o>),
    /// Options that stand in the same table; their key is none.
    Part(&'o mut dyn Options),
    /// Tables by name; names may have slashes or not.
    Tables(&'o mut dyn Tables, bool),
    /// Any number of tables, in an order.
    Rows(&'o mut dyn Tables),
    /// A table that is handed on unread.
    Free,
}

/// One option of a table.
#[derive(Debug)]
pub struct Field<'o> {
    /// Its key.
    pub key: &'static str,
    /// What it means: whole sentences, the first one with the unit where the key has none.
    pub about: &'static str,
    /// True when it has no default.
    pub is_required: bool,
    /// What to write, for whoever left it out; empty where its shape says it.
    pub hint: &'static str,
    /// When it has a meaning at all; `None` for always.
    pub condition: Option<Condition>,
    /// Its place.
    pub slot: Slot<'o>,
}

/// When an option has a meaning.
#[derive(Debug, Clone, Copy)]
pub struct Condition {
    /// The key that decides it.
    pub key: &'static str,
    /// Whether it does as the table is.
    pub is_met: bool,
    /// What to say where it does not.
    pub why: &'static str,
}

impl<'o> Field<'o> {
    /// An option with a default, without a condition.
    pub const fn new(key: &'static str, about: &'static str, slot: Slot<'o>) -> Self {
        Self {
            key,
            about,
            is_required: false,
            hint: "",
            condition: None,
            slot,
        }
    }

    /// Checks the value against its range.
    ///
    /// # Errors
    /// When it is outside. A time that is kept in seconds is named with `_s` behind its key; a key of a table
    /// below has that table's before it.
    pub fn check(self) -> Result<(), ParameterError> {
        let (value, shape) = match self.slot {
            Slot::Value(value, shape) => (value.get(), shape),
            Slot::Table(mut table) => {
                let checked = table.options().map_or(Ok(()), Options::check_all);
                return checked.map_err(|error| error.below(self.key));
            }
            Slot::Part(options) => return options.check_all(),
            Slot::Tables(tables, _) | Slot::Rows(tables) => return tables.check_all(self.key),
            Slot::Free => return Ok(()),
        };
        let Some(setting) = value else { return Ok(()) };
        let Some([value, low, high]) = shape.outside(&setting) else {
            return Ok(());
        };
        let is_in_seconds = matches!((&shape, &setting), (Shape::Time(_), Setting::Number(_)));
        let unit = if is_in_seconds { "_s" } else { "" };
        let problem = match shape {
            Shape::Number(range) if range == ANY_NUMBER => format!("{value} is not finite"),
            _ => format!("{value} is outside {low} to {high}"),
        };
        Err(ParameterError::new(&format!("{}{unit}", self.key), problem))
    }
}

/// A table that has options.
pub trait Options: Debug {
    /// All options, in the order of their declaration.
    fn fields(&mut self) -> Vec<Field<'_>>;

    /// Checks what the options say together; each is within its range by then.
    ///
    /// # Errors
    /// The first key that does not fit the others.
    fn check_together(&self) -> Result<(), ParameterError> {
        Ok(())
    }

    /// Checks every option against its range, then all together.
    ///
    /// # Errors
    /// The first key that is refused.
    fn check_all(&mut self) -> Result<(), ParameterError> {
        self.fields().into_iter().try_for_each(Field::check)?;
        self.check_together()
    }
}

/// A key that has another value in one table of options than in another.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The key; dots lead into tables.
    pub key: String,
    /// Its value, in words.
    pub found: String,
    /// The other table's.
    pub wanted: String,
}

/// The keys in which `found` differs from `wanted`, a table of the same type, in the order of their declaration.
///
/// ```
/// hil_core::options! {
///     /// Of a robot.
///     pub struct Robot {
///         /// Ticks per second.
///         rate_hz: f64 = 125.0, in 1.0..=1000.0;
///         /// A table below.
///         arm: Arm;
///     }
/// }
/// hil_core::options! {
///     /// Of its arm.
///     pub struct Arm {
///         /// Its joints.
///         joints: Vec<String> = Vec::new();
///         /// Degrees of freedom.
///         freedom: Option<u32> = None, in 1..=9;
///     }
/// }
/// let mut wanted = Robot::default();
/// let mut found = wanted.clone();
/// found.arm.joints = vec!["a".to_owned(), "b".to_owned()];
/// found.arm.freedom = Some(7);
/// let different = hil_core::options::differences(&mut found, &mut wanted);
/// let words: Vec<_> = different.iter().map(|one| [&one.key, &one.found, &one.wanted]).collect();
/// assert_eq!(words, [["arm.joints", "[a, b]", "[]"], ["arm.freedom", "7", "none"]]);
/// ```
pub fn differences(found: &mut dyn Options, wanted: &mut dyn Options) -> Vec<Difference> {
    let mut all = Vec::new();
    add_differences(&mut all, "", found, wanted);
    all
}

fn add_differences(
    all: &mut Vec<Difference>,
    prefix: &str,
    found: &mut dyn Options,
    wanted: &mut dyn Options,
) {
    for (one, other) in found.fields().into_iter().zip(wanted.fields()) {
        let key = format!("{prefix}{}", one.key);
        let values = match (one.slot, other.slot) {
            (Slot::Value(one, _), Slot::Value(other, _)) => [one.get(), other.get()].map(words_of),
            (Slot::Part(one), Slot::Part(other)) => {
                add_differences(all, prefix, one, other);
                continue;
            }
            (Slot::Table(mut one), Slot::Table(mut other)) => {
                match (one.options(), other.options()) {
                    (Some(one), Some(other)) => {
                        add_differences(all, &format!("{key}."), one, other);
                        continue;
                    }
                    (one, other) => [one.is_some(), other.is_some()]
                        .map(|is_there| if is_there { "a table" } else { "none" }.to_owned()),
                }
            }
            (Slot::Tables(one, _), Slot::Tables(other, _))
            | (Slot::Rows(one), Slot::Rows(other)) => {
                [one, other].map(|tables| format!("{tables:?}"))
            }
            _ => continue,
        };
        let [found, wanted] = values;
        if found != wanted {
            all.push(Difference { key, found, wanted });
        }
    }
}

fn words_of(value: Option<Setting>) -> String {
    match value {
        None => "none".to_owned(),
        Some(Setting::Boolean(value)) => value.to_string(),
        Some(Setting::Integer(value)) => value.to_string(),
        Some(Setting::Number(value)) => value.to_string(),
        Some(Setting::Time(value)) => format!("{value:?}"),
        Some(Setting::Text(value)) => value,
        Some(Setting::List(values)) => {
            let values = values.into_iter().map(|value| words_of(Some(value)));
            format!("[{}]", values.collect::<Vec<_>>().join(", "))
        }
        Some(Setting::Texts(values)) => format!("{values:?}"),
    }
}

/// A type of options.
pub trait Kind: Debug + Sized {
    /// The range that a declaration states for it.
    type Range;
    /// Value of an option without a default until it is set.
    const UNSET: Self;
    /// True when it is something not to be there.
    const IS_OPTIONAL: bool = false;

    /// The value in its slot.
    fn slot(&mut self, range: Self::Range) -> Slot<'_>;

    /// The same of a value that may be left out.
    fn optional(value: &mut Option<Self>, range: Self::Range) -> Slot<'_> {
        value.get_or_insert(Self::UNSET).slot(range)
    }
}

impl<T: Kind> Kind for Option<T> {
    type Range = T::Range;
    const UNSET: Self = None;
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, range: Self::Range) -> Slot<'_> {
        T::optional(self, range)
    }
}

/// A type of single values.
pub trait Scalar: Debug + Sized {
    /// The range that a declaration states for it.
    type Range;
    /// Value of an option without a default until it is set.
    const UNSET: Self;

    /// What it may be.
    fn shape(range: Self::Range) -> Shape;

    /// The value without its type.
    fn to_setting(&self) -> Setting;

    /// The value of a setting that fits the shape.
    ///
    /// # Errors
    /// Why there is none.
    fn from_setting(setting: Setting) -> Result<Self, String>;
}

/// An option that may be left out.
#[derive(Debug)]
struct Maybe<'o, T>(&'o mut Option<T>);

impl<T: Scalar> Value for Maybe<'_, T> {
    fn get(&self) -> Option<Setting> {
        self.0.as_ref().map(T::to_setting)
    }

    fn set(&mut self, setting: Setting) -> Result<(), String> {
        *self.0 = Some(T::from_setting(setting)?);
        Ok(())
    }
}

/// A value at its place.
#[derive(Debug)]
struct There<'o, T>(&'o mut T);

impl<T: Scalar> Value for There<'_, T> {
    fn get(&self) -> Option<Setting> {
        Some(self.0.to_setting())
    }

    fn set(&mut self, setting: Setting) -> Result<(), String> {
        *self.0 = T::from_setting(setting)?;
        Ok(())
    }
}

impl<T: Scalar> Kind for T {
    type Range = T::Range;
    const UNSET: Self = T::UNSET;

    fn slot(&mut self, range: Self::Range) -> Slot<'_> {
        Slot::Value(Box::new(There(self)), T::shape(range))
    }

    fn optional(value: &mut Option<Self>, range: Self::Range) -> Slot<'_> {
        Slot::Value(Box::new(Maybe(value)), T::shape(range))
    }
}

/// Why a setting is of the wrong type: its reader ignored the shape.
fn mistyped<T>(setting: &Setting) -> Result<T, String> {
    Err(format!("is of another type: {setting:?}"))
}

macro_rules! integers {
    ($($kind:ty)*) => {$(
        impl Scalar for $kind {
            type Range = RangeInclusive<Self>;
            const UNSET: Self = 0;

            fn shape(range: Self::Range) -> Shape {
                let end = |end: Self| i64::try_from(end).unwrap_or(i64::MAX);
                Shape::Integer(end(*range.start())..=end(*range.end()))
            }

            fn to_setting(&self) -> Setting {
                Setting::Integer(i64::try_from(*self).unwrap_or(i64::MAX))
            }

            fn from_setting(setting: Setting) -> Result<Self, String> {
                match setting {
                    Setting::Integer(value) => {
                        Self::try_from(value).map_err(|why| why.to_string())
                    }
                    other => mistyped(&other),
                }
            }
        }
    )*};
}

integers! { u8 u16 u32 u64 usize i64 }

macro_rules! scalars {
    ($($kind:ty, in $range:ty, unset $unset:expr, $shape:expr,
        $variant:ident($value:ident) => $read:expr, $write:expr;)*) => {$(
        impl Scalar for $kind {
            type Range = $range;
            const UNSET: Self = $unset;

            fn shape(range: Self::Range) -> Shape {
                let shape: fn(Self::Range) -> Shape = $shape;
                shape(range)
            }

            fn to_setting(&self) -> Setting {
                let write: fn(&Self) -> Setting = $write;
                write(self)
            }

            fn from_setting(setting: Setting) -> Result<Self, String> {
                match setting {
                    Setting::$variant($value) => $read,
                    other => mistyped(&other),
                }
            }
        }
    )*};
}

scalars! {
    bool, in (), unset false, |()| Shape::Boolean,
        Boolean(value) => Ok(value), |value| Setting::Boolean(*value);
    f64, in RangeInclusive<Self>, unset 0.0, Shape::Number,
        Number(value) => Ok(value), |value| Setting::Number(*value);
    Duration, in RangeInclusive<Self>, unset Self::ZERO, Shape::Time,
        Time(value) => Ok(value), |value| Setting::Time(*value);
    String, in TextRule, unset Self::new(), Shape::Text,
        Text(value) => Ok(value), |value| Setting::Text(value.clone());
    Cow<'static, str>, in TextRule, unset Cow::Borrowed(""), Shape::Text,
        Text(value) => Ok(Self::Owned(value)), |value| Setting::Text(value.clone().into_owned());
    IpAddr, in TextRule, unset Self::V4(Ipv4Addr::UNSPECIFIED), Shape::Text,
        Text(value) => value.parse().map_err(|_why: AddrParseError| format!("\"{value}\" is no IP address")),
        |value| Setting::Text(value.to_string());
    SocketAddr, in TextRule, unset Self::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0), Shape::Text,
        Text(value) => value.parse().map_err(|_why: AddrParseError| format!("\"{value}\" is no ADDRESS:PORT")),
        |value| Setting::Text(value.to_string());
    BTreeMap<String, String>, in (), unset Self::new(), |()| Shape::Texts,
        Texts(value) => Ok(value), |value| Setting::Texts(value.clone());
}

macro_rules! lists {
    ($($item:ty, $form:ident;)*) => {$(
        impl Scalar for Vec<$item> {
            type Range = <$item as Scalar>::Range;
            const UNSET: Self = Self::new();

            fn shape(range: Self::Range) -> Shape {
                Shape::$form(Box::new(<$item>::shape(range)))
            }

            fn to_setting(&self) -> Setting {
                Setting::List(self.iter().map(Scalar::to_setting).collect())
            }

            fn from_setting(setting: Setting) -> Result<Self, String> {
                listed(setting)
            }
        }
    )*};
}

impl<T: Scalar + Clone> Scalar for Cow<'static, [T]> {
    type Range = T::Range;
    const UNSET: Self = Cow::Borrowed(&[]);

    fn shape(range: Self::Range) -> Shape {
        Shape::List(Box::new(T::shape(range)))
    }

    fn to_setting(&self) -> Setting {
        Setting::List(self.iter().map(Scalar::to_setting).collect())
    }

    fn from_setting(setting: Setting) -> Result<Self, String> {
        listed(setting)
    }
}

/// The values of a setting that is a list.
fn listed<T: Scalar, L: FromIterator<T>>(setting: Setting) -> Result<L, String> {
    match setting {
        Setting::List(values) => values.into_iter().map(T::from_setting).collect(),
        other => mistyped(&other),
    }
}

lists! {
    Duration, List;
    f64, List;
    String, List;
    u16, OneOrMore;
}

/// Tables by name, in the order of the names.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Named<T>(pub BTreeMap<String, T>);

impl<T: Options + Kind> Tables for Named<T> {
    fn open(&mut self, name: &str) -> &mut dyn Options {
        self.0.entry(name.to_owned()).or_insert(T::UNSET)
    }

    fn check_all(&mut self, key: &str) -> Result<(), ParameterError> {
        self.0.iter_mut().try_for_each(|(name, table)| {
            let checked = Options::check_all(table);
            checked.map_err(|error| error.below(&format!("{key}.{name}")))
        })
    }
}

impl<T: Options + Kind> Kind for Named<T> {
    /// Whether a name may have slashes.
    type Range = bool;
    const UNSET: Self = Self(BTreeMap::new());
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, has_slashes: bool) -> Slot<'_> {
        Slot::Tables(self, has_slashes)
    }
}

/// Tables in the order of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Rows<T>(pub Vec<T>);

impl<T: Options + Kind> Tables for Rows<T> {
    fn open(&mut self, _name: &str) -> &mut dyn Options {
        let index = self.0.len();
        self.0.push(T::UNSET);
        &mut self.0[index]
    }

    fn check_all(&mut self, key: &str) -> Result<(), ParameterError> {
        self.0
            .iter_mut()
            .enumerate()
            .try_for_each(|(index, table)| {
                let checked = Options::check_all(table);
                checked.map_err(|error| error.below(&format!("{key}[{index}]")))
            })
    }
}

impl<T: Options + Kind> Kind for Rows<T> {
    type Range = ();
    const UNSET: Self = Self(Vec::new());
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, (): ()) -> Slot<'_> {
        Slot::Rows(self)
    }
}

/// A table whose options stand in the table that has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Part<T>(pub T);

impl<T: Options + Kind> Kind for Part<T> {
    type Range = ();
    const UNSET: Self = Self(T::UNSET);
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, (): ()) -> Slot<'_> {
        Slot::Part(&mut self.0)
    }
}

/// A table that its reader hands on as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Free;

impl Kind for Free {
    type Range = ();
    const UNSET: Self = Self;
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, (): ()) -> Slot<'_> {
        Slot::Free
    }
}

impl<T: Options> Table for There<'_, T> {
    fn options(&mut self) -> Option<&mut dyn Options> {
        Some(self.0)
    }

    fn open(&mut self, _template: usize) -> &mut dyn Options {
        self.0
    }
}

impl<T: Options + Kind> Table for Maybe<'_, T> {
    fn options(&mut self) -> Option<&mut dyn Options> {
        self.0.as_mut().map(|options| options as &mut dyn Options)
    }

    fn open(&mut self, _template: usize) -> &mut dyn Options {
        self.0.insert(T::UNSET)
    }
}

/// The slot of a table that is always there, at its defaults where a file says nothing of it.
pub fn table<T: Options>(options: &mut T) -> Slot<'_> {
    Slot::Table(Box::new(There(options)))
}

/// The slot of a table that may be left out.
pub fn optional_table<T: Options + Kind>(options: &mut Option<T>) -> Slot<'_> {
    Slot::Table(Box::new(Maybe(options)))
}

/// The slot of a table that may be left out, and that a single value may stand for.
pub fn short_table<T: Short>(options: &mut Option<T>) -> Slot<'_> {
    Slot::Table(Box::new(Abbreviated(options)))
}

/// Declares the options of a table: its struct, its defaults as `TEMPLATE`, its checks and [`Options`].
///
/// A line is `key: type = default, in range, needs(key, condition, "why not");`
/// below its documentation, and what does not apply is left out. An option without a default is required,
/// unless its type is an `Option`. One whose condition does not hold is refused in a file and not written.
/// `with { field: type = value, }` adds what is no option, `as part` makes the options stand in the table
/// of which this is a field, `as short` is for a table that is [`Short`], and `check` names what is checked
/// of all of them together.
///
/// ```
/// use std::time::Duration;
/// use hil_core::options::Options as _;
///
/// hil_core::options! {
///     /// How a thing waits.
///     pub struct Waiting {
///         /// How often it looks.
///         period: Duration, in Duration::from_millis(1)..=Duration::from_secs(1);
///         /// How often it looks before it gives up.
///         count: u32 = 3, in 1..=100;
///     }
/// }
/// let mut waiting = Waiting { period: Duration::from_secs(2), ..Waiting::TEMPLATE };
/// assert_eq!(waiting.check().unwrap_err().to_string(), "period 2s is outside 1ms to 1s");
/// assert_eq!(waiting.fields()[1].about.trim(), "How often it looks before it gives up.");
/// ```
#[macro_export]
macro_rules! options {
    (@or $value:expr) => { $value };
    (@or $default:expr, $value:expr) => { $value };
    (@slot $this:ident) => { $crate::options::table($this) };
    (@slot $this:ident part) => { $crate::options::Slot::Part($this) };
    (@slot $this:ident short) => { $crate::options::table($this) };
    (@optional $value:ident short) => { $crate::options::short_table($value) };
    (@optional $value:ident $($part:ident)?) => { $crate::options::optional_table($value) };
    ($(#[$meta:meta])* $vis:vis struct $name:ident $(as $form:ident)?
        $(with { $($(#[$note:meta])* $extra:ident: $extra_kind:ty = $extra_value:expr,)* })?
    {
        $($(#[doc = $about:literal])* $key:ident: $kind:ty $(= $default:expr)? $(, in $range:expr)?
            $(, hint $hint:literal)? $(, needs($other:ident, $met:expr, $why:expr))?;)*
    } $(check $check:path;)?) => {
        #[derive(Debug, Clone, PartialEq, $crate::serde::Serialize, $crate::serde::Deserialize)]
        #[serde(crate = "hil_core::serde", deny_unknown_fields, default)]
        $(#[$meta])*
        $vis struct $name {
            $($($(#[$note])* $vis $extra: $extra_kind,)*)?
            $($(#[doc = $about])* $vis $key: $kind,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self::TEMPLATE
            }
        }

        impl $name {
            /// Every option at its default; those that are required are unset.
            $vis const TEMPLATE: Self = Self {
                $($($extra: $extra_value,)*)?
                $($key: $crate::options!(@or <$kind as $crate::options::Kind>::UNSET $(, $default)?),)*
            };

            /// Checks every option.
            ///
            /// # Errors
            /// The first key that is refused, with its value and its range.
            $vis fn check(&self) -> Result<(), $crate::case_study::ParameterError> {
                $crate::options::Options::check_all(&mut self.clone())
            }
        }

        impl $crate::options::Options for $name {
            fn fields(&mut self) -> Vec<$crate::options::Field<'_>> {
                let conditions: Vec<Option<$crate::options::Condition>> = vec![$(
                    $crate::options!(@or None $(, Some({
                        let met: fn(&Self) -> bool = $met;
                        let (key, is_met, why) = (stringify!($other), met(self), $why);
                        $crate::options::Condition { key, is_met, why }
                    }))?),
                )*];
                let mut conditions = conditions.into_iter();
                vec![$($crate::options::Field {
                    key: stringify!($key).trim_start_matches("r#"),
                    about: concat!($($about, "\n"),*),
                    is_required: <[&str]>::is_empty(&[$(stringify!($default))?])
                        && !<$kind as $crate::options::Kind>::IS_OPTIONAL,
                    hint: $crate::options!(@or "" $(, $hint)?),
                    condition: conditions.next().flatten(),
                    slot: $crate::options::Kind::slot(
                        &mut self.$key,
                        $crate::options!(@or Default::default() $(, $range)?),
                    ),
                },)*]
            }

            $(fn check_together(&self) -> Result<(), $crate::case_study::ParameterError> {
                $check(self)
            })?
        }

        impl $crate::options::Kind for $name {
            type Range = ();
            const UNSET: Self = Self::TEMPLATE;
            const IS_OPTIONAL: bool = true;

            fn slot(&mut self, (): ()) -> $crate::options::Slot<'_> {
                $crate::options!(@slot self $($form)?)
            }

            fn optional(value: &mut Option<Self>, (): ()) -> $crate::options::Slot<'_> {
                $crate::options!(@optional value $($form)?)
            }
        }
    };
}

/// Declares an option that is one word of a list: its enum, with the word of each variant. The range of
/// such an option is a slice of variants; an empty one allows all.
#[macro_export]
macro_rules! words {
    ($(#[$meta:meta])* pub enum $name:ident {
        $($(#[$about:meta])* $variant:ident = $word:literal,)*
    }) => {
        $crate::labelled! {
            #[derive(Debug, Clone, Copy, PartialEq, Eq, $crate::serde::Serialize, $crate::serde::Deserialize)]
            #[serde(crate = "hil_core::serde")]
            $(#[$meta])*
            pub enum $name, word { $($(#[$about])* #[serde(rename = $word)] $variant = $word,)* }
        }

        impl $crate::options::Scalar for $name {
            type Range = &'static [Self];
            const UNSET: Self = Self::ALL[0];

            fn shape(range: Self::Range) -> $crate::options::Shape {
                let allowed = if range.is_empty() { &Self::ALL } else { range };
                $crate::options::Shape::Words(allowed.iter().map(|one| one.word()).collect())
            }

            fn to_setting(&self) -> $crate::options::Setting {
                $crate::options::Setting::Text(self.word().to_owned())
            }

            fn from_setting(setting: $crate::options::Setting) -> Result<Self, String> {
                let found = match &setting {
                    $crate::options::Setting::Text(text) => {
                        Self::ALL.iter().find(|one| one.word() == text)
                    }
                    _ => None,
                };
                found.copied().ok_or_else(|| format!("is no word of the list: {setting:?}"))
            }
        }
    };
}
